"""`python -m horus`: recordings from the command line."""

from __future__ import annotations

import sys

from horus.cli import main

if __name__ == "__main__":
    sys.exit(main())
