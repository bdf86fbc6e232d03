"""What the children of the recording benchmark run, each in the interpreter of its contender.

``__main__`` is run by path, so that it uses the ``horus`` of that interpreter; the parent process
imports what tells it which workloads there are.
"""
