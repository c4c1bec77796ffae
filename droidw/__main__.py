"""`python -m droidw`: the command line."""

import sys

from droidw.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
