"""Command line: `python -m torchdq cost` prints the paper's cost tables, counted."""

import argparse
import sys

from torchdq.paper import cost


def main() -> None:
    """Print the report that the arguments name."""
    parser = argparse.ArgumentParser(prog="python -m torchdq")
    explanation = "cost: the paper's Tables 2, 3 and 4, counted by running its formulas"
    parser.add_argument("report", choices=["cost"], help=explanation)
    parser.parse_args()
    sys.stdout.write(cost.report() + "\n")


if __name__ == "__main__":
    main()
