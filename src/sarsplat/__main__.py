"""`python -m sarsplat`: the command line."""

import sys

from sarsplat.cli import main

if __name__ == "__main__":
    sys.exit(main())
