"""python -m torchdq cost: the paper's cost tables, counted."""

import argparse
import sys

from torchdq.paper import cost


def main() -> None:
    """What the arguments ask for."""
    parser = argparse.ArgumentParser(prog="python -m torchdq")
    parser.add_argument(
        "what", choices=["cost"], help="cost: the paper's Tables 2, 3 and 4, counted by running its formulas"
    )
    parser.parse_args()
    sys.stdout.write(cost.report() + "\n")


if __name__ == "__main__":
    main()
