"""Command line: `python -m torchdq cost` prints the paper's cost tables, and the steps to the program that runs."""

import argparse
import sys

from torchdq.paper import cost, ladder


def main() -> None:
    """Print the report that the arguments name."""
    parser = argparse.ArgumentParser(prog="python -m torchdq")
    explanation = (
        "cost: the paper's Tables 2, 3 and 4, counted, and the steps from Algorithm 1 to the program that runs"
    )
    parser.add_argument("report", choices=["cost"], help=explanation)
    parser.parse_args()
    sys.stdout.write(f"{cost.report()}\n\n## From Algorithm 1 to the program that runs\n\n")
    sys.stdout.flush()
    sys.stderr.write("compiling and timing the steps ...\n")
    sys.stdout.write(ladder.table(7, ladder.times(7)) + "\n")


if __name__ == "__main__":
    main()
