"""Worker processes: a compute node off the interpreter of its scheduler."""
