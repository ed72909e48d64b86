"""Command `cost`: the paper's tables, counted."""

from dataclasses import dataclass

from torchdq.base.progress import Progress
from torchdq.command.command import Command
from torchdq.command.outcome import Outcome, Verbatim
from torchdq.paper import cost, ladder

JOINTS = 7


@dataclass(kw_only=True)
class CostCommand(Command):
    """The paper's Tables 2, 3 and 4, counted, and the steps from Algorithm 1 to the program that runs.

    Example: torchdq cost
    """

    def outcome(self) -> Outcome:
        """Tables in Markdown."""
        with Progress("compiling and timing the steps from Algorithm 1 to the program"):
            times = ladder.times(JOINTS)
        table = ladder.table(JOINTS, times)
        tables = {
            title: [{"operation": e.operation, "counted": e.counted._asdict()} for e in entries]
            for title, entries in cost.TABLES.items()
        }
        steps = [{"step": form.name, "nanoseconds": t} for form, t in zip(ladder.FORMS, times, strict=True)]
        text = f"{cost.report()}\n\n## From Algorithm 1 to the program that runs\n\n{table}\n\n{ladder.COUNTED}"
        return Outcome((Verbatim(text),), {"tables": tables, "steps": steps})
