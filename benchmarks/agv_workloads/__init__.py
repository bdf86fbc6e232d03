"""The warehouse AGV on each contender, and how fast this package reacts.

Run as a directory in the interpreter of the package under test; see ``__main__.py``.
"""
