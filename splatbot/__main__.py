"""`python -m splatbot` is `splatbot`."""

import sys

from splatbot.cli import main

if __name__ == "__main__":
    sys.exit(main())
