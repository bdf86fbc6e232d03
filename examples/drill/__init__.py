"""The parts of the example `fault_drill.py`."""
