"""Command line: `python -m torchdq cost` prints the paper's cost tables, and the steps to the program that runs."""

import argparse
import sys

from torchdq import __version__
from torchdq.paper import cost, ladder

COMMANDS = {"cost": "the paper's Tables 2, 3 and 4, counted, and the steps from Algorithm 1 to the program that runs"}


def main() -> None:
    """Run the command that the arguments name."""
    listed = "\n".join(f"  {name:8} {what}" for name, what in COMMANDS.items())
    parser = argparse.ArgumentParser(
        prog="python -m torchdq",
        epilog=f"commands:\n{listed}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"torchdq {__version__}")
    parser.add_argument("command", metavar="COMMAND", nargs="?", help="one of the commands below")
    command = parser.parse_args().command
    if command not in COMMANDS:
        found = "none" if command is None else repr(command)
        parser.error(f"COMMAND must be one of the following, found {found}:\n{listed}")
    sys.stdout.write(f"{cost.report()}\n\n## From Algorithm 1 to the program that runs\n\n")
    sys.stdout.flush()
    sys.stderr.write("compiling and timing the steps ...\n")
    sys.stdout.write(ladder.table(7, ladder.times(7)) + "\n")


if __name__ == "__main__":
    main()
