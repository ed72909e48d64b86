"""Command `id`: a robot identified from logs, tried on what was not learned from, with a page about it."""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from torchdq.command.command import RobotCommand, numbers
from torchdq.command.outcome import Grid, Outcome, Verbatim
from torchdq.command.robots import NamedRobot
from torchdq.errors import ArgumentError, DescriptionError
from torchdq.learning import identify as seek
from torchdq.learning import identify_payload, read, smooth
from torchdq.learning.bodies.payload import IdentifiedPayload
from torchdq.learning.identification.identified import Identified
from torchdq.learning.logs.layouts import Layout, LogError
from torchdq.learning.logs.motions import Motion
from torchdq.learning.page import page
from torchdq.learning.trial import HEADER, TorqueTrial, apart, torques_by, trial
from torchdq.notice import Notice
from torchdq.optional import imported

# in messages of the package, and here
OPTIONS = {
    "rows=(first, last)": "--rows FIRST LAST",
    "Layout(columns=...), e.g. {'q': 'position_{0}'}": "--columns, e.g. --columns q position_{0}",
    "columns={'qd': None}": "--columns qd none",
    "Layout(--columns qd none)": "--columns qd none",
    "Layout(gain=...)": "--gains",
    "gains=True": "--seek-gains",
    "a Layout(header=False, joints=...)": "--blocks, e.g. --blocks q qd tau",
}
NEEDED = {"scipy": "'torchdq[learn]'", "matplotlib": "'torchdq[viz]'"}  # before the work, not after it


@dataclass(kw_only=True)
class IdCommand(RobotCommand):
    """A robot identified from logs: errors, what the data tell and do not, a verdict, one HTML page, and its URDF.

    A log is a CSV file with columns time [s], q1 ... [rad], qd1 ... [rad/s], tau1 ... [N m], or names by --columns.
    Tested is the last log, or the last third of the only one.

    Example: torchdq id arm.urdf a.csv b.csv --columns q position_{0} qd velocity_{0} tau effort_{0}
    """

    logs: Annotated[tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="LOG")]
    """Logs to learn from and to test on."""
    test: tuple[str, ...] = ()
    """Logs to test on instead; then all LOGs are learned from."""
    columns: dict[str, str] = field(default_factory=dict)
    """Names of columns: time, q, qd, tau, each with a pattern; {0} is the number of a joint that counts from 0, {1}
    from 1. "none" for qd: not recorded."""
    blocks: tuple[str, ...] = ()
    """For a file without a header: names of its blocks of columns after the time, e.g. q qd tau."""
    rows: tuple[int, int] | None = None
    """First row of each log that is used, and the one after the last, counted from 0."""
    gains: tuple[float, ...] = ()
    """Torque per unit of tau where it is a current, one for each joint [N m/A]."""
    seek_gains: bool = False
    """Seek these gains, too."""
    friction: Literal["choose", "simple", "none"] = "choose"
    """Friction: what the data ask for; viscous and Coulomb; or none."""
    offset: bool = False
    """Seek a constant torque of every joint."""
    rotors: bool = False
    """Seek the rotor inertia of every joint."""
    prior: float | None = None
    """Weight of the description; by default chosen on blocks of the logs that are left out."""
    rate: float = 50.0
    """Rows per second that are learned from [Hz]."""
    cutoff: float | None = None
    """Low-pass filter of all signals [Hz]; by default 8, or less for slow logs."""
    payload: tuple[str, ...] = ()
    """Logs with something in the hand, whose mass and inertia are sought."""
    frame: str | None = None
    """Frame that holds the payload; by default the end effector."""
    out: Path = Path(".")
    """Folder of the page and the URDF."""

    def outcome(self) -> Outcome:
        """Errors before and after, the verdict, and the files that were written."""
        for module, extra in NEEDED.items():
            imported(module, module, "torchdq id", extra)
        if not self.logs:
            raise ArgumentError("LOG must be a file at least, found none; torchdq id --help has an example")
        self.out.mkdir(parents=True, exist_ok=True)
        if not os.access(self.out, os.W_OK):
            raise ArgumentError(f"out must be a folder that you can write, found {str(self.out)!r}")
        source = self.load()
        robot = source.robot
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            motions = [self._motion(log, robot.n) for log in self.logs]
            tests = [self._motion(log, robot.n) for log in self.test]
            held = [self._motion(log, robot.n) for log in self.payload]
            train, test = (motions, tests) if tests else apart(motions)
            found = self._sought(source, train)
            payload = None
            if held:
                payload = identify_payload(found, torques_by(found, held), frame=self.frame)
        measured = trial(robot, found, test)
        doubts = list(dict.fromkeys(str(one.message) for one in said))
        for doubt in doubts:
            warnings.warn(doubt, stacklevel=2)
        files, lost = self._written(source, found, measured, test, doubts, payload)
        return _outcome(found, measured, payload, files, lost)

    def _motion(self, log: str, n: int) -> Motion:
        """Motion of a log, filtered, with accelerations."""
        try:
            recorded = read(log, self._layout(n), self.rows)
        except LogError as error:
            raise LogError(_with_options(str(error))) from error
        motion = smooth(recorded, self.cutoff, self.cutoff, self.rate)
        if motion.q.shape[1] != n:
            cure = "--joints keeps some joints of the robot"
            raise ArgumentError(f"{log} holds {motion.q.shape[1]} joints, the robot has {n}; {cure}")
        return motion

    def _layout(self, n: int) -> Layout:
        """Layout of the logs, as the options say."""
        columns = {name: None if x.lower() == "none" else x for name, x in self.columns.items()}
        options: dict[str, Any] = {"columns": columns}
        if self.gains and len(self.gains) != n:
            raise ArgumentError(f"gains must be {n} numbers, one for each joint, found {len(self.gains)}")
        options["gain"] = numbers(self.gains) or (None if self.seek_gains else ())
        if self.blocks:
            options |= {"blocks": self.blocks, "header": False, "joints": n}
        return Layout(**options)

    def _sought(self, source: NamedRobot, train: Sequence[Motion]) -> Identified:
        friction: Any = {"choose": "choose", "simple": True, "none": False}[self.friction]
        options = dict(offset=self.offset, armature=self.rotors, prior=self.prior, gains=self.seek_gains)
        return seek(source.robot, train, friction=friction, **options)  # type: ignore[arg-type]

    def _written(
        self,
        source: NamedRobot,
        found: Identified,
        measured: TorqueTrial,
        test: Sequence[Motion],
        doubts: Sequence[str],
        payload: IdentifiedPayload | None,
    ) -> tuple[dict[str, Path], str]:
        """Files by kind, and why there is no description of the robot among them; "" if there is."""
        name = "".join(c if c.isalnum() or c in "-_" else "_" for c in source.robot.name) or "robot"
        files = {"page": self.out / f"{name}_identified.html"}
        lines = [f"robot: {self.robot}", f"logs: {', '.join(self.logs)}"]
        lines += [f"tested on: {', '.join(self.test)}"] if self.test else []
        with Notice("drawing the page"):
            text = page(found, measured, test, lines, doubts, payload)
        files["page"].write_text(text, encoding="utf-8")
        if source.format not in ("urdf", "mjcf"):
            return files, f"no description is written: {self.robot} is no URDF or MJCF file"
        try:
            if source.format == "urdf":
                files["urdf"] = self.out / f"{name}_identified.urdf"
                files["urdf"].write_text(found.to_urdf(source.file), encoding="utf-8")
            else:
                files["mjcf"] = self.out / f"{name}_identified.xml"
                files["mjcf"].write_text(found.robot.to_mjcf(source.file), encoding="utf-8")
        except (ArgumentError, DescriptionError) as error:
            files.pop(source.format)
            return files, f"no description is written: {error}"
        return files, ""


def _with_options(message: str) -> str:
    """Message about a log with the options of the command line in place of arguments of functions."""
    for argument, option in OPTIONS.items():
        message = message.replace(argument, option)
    return message


def _outcome(
    found: Identified, measured: TorqueTrial, payload: IdentifiedPayload | None, files: dict[str, Path], lost: str
) -> Outcome:
    """Text and data of what was found."""
    untold = () if found.report is None else found.report.untold
    text: list[str | Grid | Verbatim] = [Grid(HEADER, measured.rows())]
    if found.report is not None:
        text.append(f"model: {found.report.rung.name}, chosen on {found.report.parts}")
    if untold:
        text += ["not told by the data, left near the description:", Grid((), [("-", line) for line in untold])]
    if payload is not None:
        text.append(str(payload))
    text.append(measured.verdict)
    text.append(Grid((), [("wrote", str(path)) for path in files.values()]))
    text += [lost] if lost else []
    rows = zip(found.names, found.parameters, found.errors, found.excited, strict=True)
    data: dict[str, Any] = {
        "robot": found.robot.name,
        "verdict": measured.verdict,
        "trial": measured._asdict(),
        "model": None if found.report is None else found.report.rung.name,
        "parameters": [{"name": name, "estimate": x, "error": error, "told": told} for name, x, error, told in rows],
        "base_parameters": [
            {"combination": name, "estimate": x, "error": error}
            for name, x, error in zip(found.base_names, found.base @ found.parameters, found.base_errors, strict=True)
        ],
        "untold": untold,
        "noise": found.noise,
        "gains": None if found.gains is None else found.gains._asdict(),
        "payload": None
        if payload is None
        else {name: x for name, x in payload._asdict().items() if name not in ("robot",)},
        "files": files,
        "lost": lost,
    }
    return Outcome(tuple(text), data)
