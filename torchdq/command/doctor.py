"""Command `doctor`: whether the installation is well, and how to mend what is not."""

from __future__ import annotations

from dataclasses import dataclass

from torchdq import __version__
from torchdq.command.command import Command
from torchdq.command.outcome import Grid, Outcome
from torchdq.command.reports.health import findings


@dataclass(kw_only=True)
class DoctorCommand(Command):
    """Compiler, threads, GPU, packages, cache: what works, and how to mend what does not.

    Example: torchdq doctor
    """

    def outcome(self) -> Outcome:
        """Table of findings; it failed if something is broken."""
        found = findings()
        cures = [(finding.what, finding.cure) for finding in found if finding.cure]
        counts = {state: sum(finding.state == state for finding in found) for state in ("warning", "broken")}
        if counts["broken"]:
            verdict = f"broken: {', '.join(finding.what for finding in found if finding.state == 'broken')}"
        elif counts["warning"]:
            verdict = f"it works; {counts['warning']} warning{'s' * (counts['warning'] > 1)}"
        else:
            verdict = "all is well"
        rows = [(finding.state, finding.what, finding.found) for finding in found]
        mend = ("to do:", Grid((), [("-", f"{what}:", cure) for what, cure in cures])) if cures else ()
        text = (f"torchdq {__version__}", Grid(("state", "what", "found"), rows), *mend, verdict)
        data = {"version": __version__, "verdict": verdict, "findings": [finding._asdict() for finding in found]}
        return Outcome(text, data, counts["broken"] > 0)
