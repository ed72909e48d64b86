"""Command line as `python -m torchdq`."""

import sys

from torchdq.command.main import main

if __name__ == "__main__":
    sys.exit(main())
