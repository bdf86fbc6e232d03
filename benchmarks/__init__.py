"""Benchmarks of this package, run as ``python -m benchmarks <name>``.

Nothing here is part of the installed package: the benchmarks measure the checkout they live in and,
when asked, the comparable package from the registry, side by side on the same machine.
"""
