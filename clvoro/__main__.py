"""`python -m clvoro` is the command `clvoro`."""

import sys

from .cli import main

if __name__ == "__main__":
    sys.exit(main())
