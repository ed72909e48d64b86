"""Command `doctor`: whether the installation is well, and how to mend what is not."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

from torchdq import __version__
from torchdq.command.command import Command
from torchdq.command.outcome import Grid, Outcome
from torchdq.command.reports.health import findings

STATES = {"ok": "ok", "note": "ok", "warning": "warning", "error": "broken"}  # states that are shown, by severity


@dataclass(kw_only=True)
class DoctorCommand(Command):
    """Compiler, threads, GPU, packages, cache: what works, and how to mend what does not.

    Example: torchdq doctor
    """

    def outcome(self) -> Outcome:
        """Table of findings; it failed if something is broken."""
        found = [{"what": f.subject, "state": STATES[f.severity], "found": f.found, "cure": f.cure} for f in findings()]
        counts = Counter(one["state"] for one in found)
        verdict = "all is well"
        if counts["broken"]:
            verdict = f"broken: {', '.join(one['what'] for one in found if one['state'] == 'broken')}"
        elif counts["warning"]:
            verdict = f"it works; {counts['warning']} warning{'s' * (counts['warning'] > 1)}"
        rows = [(one["state"], one["what"], one["found"]) for one in found]
        cures = [("-", f"{one['what']}:", one["cure"]) for one in found if one["cure"]]
        mend = ("to do:", Grid((), cures)) if cures else ()
        text = (f"torchdq {__version__}", Grid(("state", "what", "found"), rows), *mend, verdict)
        data = {"version": __version__, "verdict": verdict, "findings": found}
        return Outcome(text, data, counts["broken"] > 0)
