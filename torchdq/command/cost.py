"""Command `cost`: the paper's tables, counted."""

from dataclasses import dataclass

from torchdq.base.progress import Progress
from torchdq.command.command import Command
from torchdq.command.outcome import Grid, Outcome
from torchdq.paper import cost, ladder

JOINTS = 7


@dataclass(kw_only=True)
class CostCommand(Command):
    """Operations in the paper's Tables 2, 3 and 4, not those of a robot, and the steps from Algorithm 1 to the program.

    Operations of a robot's functions are in report, and their times in bench.

    Example: torchdq cost
    """

    def outcome(self) -> Outcome:
        """Tables of operations, and of the steps with their times."""
        with Progress("compiling and timing the steps from Algorithm 1 to the program"):
            times = ladder.times(JOINTS)
        tables = {
            title: [{"operation": e.operation, "counted": e.counted._asdict()} for e in entries]
            for title, entries in cost.TABLES.items()
        }
        steps = [{"step": form.name, "nanoseconds": t} for form, t in zip(ladder.FORMS, times, strict=True)]
        shown = {**cost.sections(), "From Algorithm 1 to the program that runs": ladder.rows(JOINTS, times)}
        text = [part for title, rows in shown.items() for part in (f"{title}:", Grid(rows[0], rows[1:]))]
        return Outcome((*text, ladder.COUNTED), {"tables": tables, "steps": steps})
