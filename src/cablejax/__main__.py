"""`python -m cablejax`: the command line."""

import sys

from cablejax.cli import main

if __name__ == "__main__":
    sys.exit(main())
