"""`python -m sarsplat`: the command line."""

from __future__ import annotations

import sys

from sarsplat.cli import main

if __name__ == "__main__":
    sys.exit(main())
