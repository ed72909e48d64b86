"""Command line: `python -m torchdq COMMAND`; errors of a user are one message, without a traceback."""

import argparse
import sys
from pathlib import Path
from typing import Any

from torchdq import __version__
from torchdq.errors import TorchdqError
from torchdq.overview import overview
from torchdq.paper import cost, ladder
from torchdq.robot import Robot
from torchdq.robot import shipped as robots

COMMANDS = {
    "cost": "the paper's Tables 2, 3 and 4, counted, and the steps from Algorithm 1 to the program that runs",
    "report": "what is read of a robot's file, and what is wrong with it: report FILE, or the name of a shipped robot",
}


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
    parser.add_argument(
        "robot", metavar="FILE", nargs="?", help="for report: file of a robot, or name of a shipped one"
    )
    parser.add_argument("--base", choices=("fixed", "floating"), help="for report: base of the robot")
    given = parser.parse_intermixed_args()
    if given.command not in COMMANDS:
        found = "none" if given.command is None else repr(given.command)
        parser.error(f"COMMAND must be one of the following, found {found}:\n{listed}")
    if (given.robot is None) == (given.command == "report"):
        parser.error("report takes the FILE of a robot" if given.robot is None else f"{given.command} takes no FILE")
    try:
        {"cost": _cost, "report": _report}[given.command](given)
    except TorchdqError as error:
        sys.exit(f"{given.command}: {error}")


def _cost(given: argparse.Namespace) -> None:
    sys.stdout.write(f"{cost.report()}\n\n## From Algorithm 1 to the program that runs\n\n")
    sys.stdout.flush()
    sys.stderr.write("compiling and timing the steps ...\n")
    sys.stdout.write(ladder.table(7, ladder.times(7)) + "\n")


def _report(given: argparse.Namespace) -> None:
    sys.stdout.write(overview(_read(given.robot, given.base)))


def _read(name: str, base: str | None) -> Robot:
    """Robot of a name or a file: URDF, xacro by its ending, MJCF by its root element."""
    if name in robots.names():
        return robots.load(name)
    options: dict[str, Any] = {"on_unphysical": "warn"} | ({} if base is None else {"base": base})
    if name.endswith(".xacro"):
        return Robot.from_xacro(name, **options)
    path = Path(name)
    if path.suffix == ".xml" and path.is_file() and b"<mujoco" in path.read_bytes():
        return Robot.from_mjcf(name, **options)
    return Robot.from_urdf(name, **options)


if __name__ == "__main__":
    main()
