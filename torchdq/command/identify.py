"""Command `id`: a robot identified from logs, tried on what was not learned from, with a page about it."""

import math
import os
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import tyro

from torchdq.base.files import write_atomically
from torchdq.base.optional import require_packages
from torchdq.base.progress import Progress
from torchdq.command.command import ENDINGS, NamedRobot, RobotCommand
from torchdq.command.identification_page import page
from torchdq.command.outcome import Grid, Outcome, Verbatim
from torchdq.effects import Coulomb, Viscous
from torchdq.errors import ArgumentError, DescriptionError
from torchdq.learning import (
    Evaluation,
    Identified,
    IdentifiedPayload,
    Layout,
    LogWarning,
    Model,
    Motion,
    evaluate,
    identify,
    identify_payload,
    read_log,
    smooth,
    train_test_split,
)
from torchdq.learning.evaluate import MEANING, torques_by
from torchdq.robot import Robot

# module, extra that brings it: looked for before the work, not after it
NEEDED = {"scipy": "learn", "matplotlib": "viz"}
ROBOTS, LOGS = (*ENDINGS, ".urdf.xacro"), (".csv", ".csv.gz", ".npz", ".txt")  # how files of each kind end
JOINT = "{joint}"  # in patterns of columns, the name of a joint


class RobotFile(NamedTuple):
    """File of the robot found."""

    text: str  # "" if there is none
    robot: Robot | None  # robot that it holds, with its damping and friction
    omitted: str  # what it lacks, or why there is none; "" for nothing


@dataclass(kw_only=True)
class IdCommand(RobotCommand):
    """A robot identified from logs: errors, a verdict, identifiable parameters, one HTML page, and its URDF.

    A log is a CSV file with columns time [s], q1 ... [rad], qd1 ... [rad/s], tau1 ... [N m], or names by --columns.
    Tested is the last log, or the last third of the only one.

    Names in --columns: position_{0} reads position_0, position_1, ... for the joints, position_{1} begins with
    position_1; in effort_{joint} {joint} is replaced by the joint's own name; a1,b2,c3 are the names of all
    columns, in the robot's order of joints; none: not recorded.

    Example: torchdq id arm.urdf a.csv b.csv --columns q position_{0} qd velocity_{0} tau effort_{0}
    """

    logs: Annotated[tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="LOG")]
    """Logs to learn from and to test on."""
    test: tuple[str, ...] = ()
    """Logs to test on instead; then all LOGs are learned from."""
    columns: Annotated[dict[str, str], tyro.conf.arg(metavar="SIGNAL NAMES ...")] = field(default_factory=dict)
    """Names of columns, for each of time, q, qd and tau that has others; see above."""
    blocks: tuple[str, ...] = ()
    """For a file without a header: names of its blocks of columns after the time, e.g. q qd tau."""
    rows: tuple[int, int] | None = None
    """First row of each log that is used, and the one after the last, counted from 0."""
    gains: tuple[float, ...] = ()
    """Torque per unit of tau where it is a current, one for each joint [N m/A]."""
    estimate_gains: bool = False
    """Estimate these gains, too."""
    friction: Literal["auto", "simple", "none"] = "auto"
    """Friction: selected on blocks of the logs left out; viscous and Coulomb; or none."""
    offset: bool = False
    """Estimate a constant torque of every joint."""
    rotors: bool = False
    """Estimate the rotor inertia of every joint."""
    prior: float | None = None
    """Weight of the description; by default chosen on blocks of the logs left out."""
    rate: float = 50.0
    """Rows per second that are learned from [Hz]."""
    cutoff: float | None = None
    """Low-pass filter of all signals [Hz]; by default 8, or less for slow logs."""
    delay: float = 0.0
    """Time by which the torques come after the positions in the logs [s]; a warning says if there is one."""
    sign_width: float | None = None
    """Velocity below which dry friction is viscous [rad/s]; by default 0.001 in the logs, 0.01 in the result."""
    farthest: float = 8 * math.pi
    """Position beyond which a column is taken for one in degrees or millimetres [rad or m]."""
    fastest: float = 50.0
    """Speed beyond which it is, too [rad/s or m/s]."""
    payload: tuple[str, ...] = ()
    """Logs with something in the hand, whose mass and inertia are estimated."""
    frame: str | None = None
    """Frame that holds the payload; by default the end effector."""
    out: Path = Path(".")
    """Folder of the page and the URDF."""

    def outcome(self) -> Outcome:
        """Errors before and after, the verdict, and the files that were written."""
        require_packages("torchdq id", NEEDED)
        self._require_order()
        self.out.mkdir(parents=True, exist_ok=True)
        if not os.access(self.out, os.W_OK):
            raise ArgumentError(f"out must be a folder that you can write, found {str(self.out)!r}")
        source = self.load_moving()
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            motions, tests, held = (
                [self._motion(log, source.robot) for log in logs] for logs in (self.logs, self.test, self.payload)
            )
            if tests:
                train, test = motions, tests
            else:
                train, test = train_test_split(motions) if len(motions) == 1 else (motions[:-1], motions[-1:])
            found = self._identified(source.robot, train)
            payload = identify_payload(found, torques_by(found, held), frame=self.frame) if held else None
            description = _described(source, found)
            measured = evaluate(source.robot, found, test, description.robot)
        messages = list({str(one.message): one.message for one in said}.values())
        for message in messages:
            warnings.warn(message, stacklevel=2)
        with Progress("drawing the page"):
            words = [x.text(command_line=True) if isinstance(x, LogWarning) else str(x) for x in messages]
            sources = [f"robot: {self.robot}", f"logs: {', '.join(self.logs)}"]
            sources += [f"tested on: {', '.join(self.test)}"] if self.test else []
            text = page(found, measured, test, sources, words, payload)
        files = self._written(source, text, description)
        return _outcome(found, measured, payload, files, description.omitted)

    def _require_order(self) -> None:
        """Raise unless there is a robot first, and logs after it."""
        usual = "the robot comes first, then the logs: torchdq id arm.urdf a.csv b.csv"
        if self.robot.lower().endswith(LOGS):
            raise ArgumentError(f"ROBOT must be a file or a name of a robot, found {self.robot!r}, a log; {usual}")
        known = {os.path.realpath(log) for log in self.logs}
        for log in self.test:
            if os.path.realpath(log) in known:
                raise ArgumentError(f"test must be other logs than those to learn from, found {log!r} among both")
        for log in (*self.logs, *self.test, *self.payload):
            if log.lower().endswith(ROBOTS):
                raise ArgumentError(f"LOG must be a log, found {log!r}, a file of a robot; {usual}")
        if not self.logs:
            raise ArgumentError("LOG must be a file at least, found none; torchdq id --help has an example")

    def _motion(self, log: str, robot: Robot) -> Motion:
        """Motion of a log, filtered, with accelerations."""
        recorded = read_log(log, self._layout(robot), self.rows)
        if recorded.q.shape[1] != robot.n:
            cure = "--joints keeps some joints of the robot"
            raise ArgumentError(f"{log} holds {recorded.q.shape[1]} joints, the robot has {robot.n}; {cure}")
        width = {} if self.sign_width is None else {"sign_width": self.sign_width}
        return smooth(recorded, self.cutoff, self.cutoff, self.rate, delay=self.delay, **width)

    def _layout(self, robot: Robot) -> Layout:
        """Layout of the logs, as the options say."""
        options: dict[str, Any] = {"columns": {name: _names(x, robot) for name, x in self.columns.items()}}
        options |= {"farthest": self.farthest, "fastest": self.fastest}
        options["gain"] = self.gains or (None if self.estimate_gains else ())
        if self.blocks:
            options |= {"blocks": self.blocks, "header": False, "joints": robot.n}
        return Layout(**options)

    def _identified(self, robot: Robot, train: Sequence[Motion]) -> Identified:
        """Robot identified with the model that the options ask for."""
        width = 1e-2 if self.sign_width is None else self.sign_width
        friction: Any = {"auto": "auto", "simple": (Viscous(), Coulomb(sign_width=width)), "none": None}[self.friction]
        model = Model(friction, self.offset, self.rotors, self.estimate_gains)
        return identify(robot, train, model, self.prior, width)

    def _written(self, source: NamedRobot, text: str, description: RobotFile) -> dict[str, Path]:
        """Files by kind."""
        name = "".join(c if c.isalnum() or c in "-_" else "_" for c in source.robot.name) or "robot"
        texts = {"page": (f"{name}_identified.html", text)}
        if description.text:
            ending = {"urdf": "urdf", "mjcf": "xml"}[source.format]
            texts[source.format] = (f"{name}_identified.{ending}", description.text)
        for file, content in texts.values():
            write_atomically({self.out / file: content})
        return {kind: self.out / file for kind, (file, _) in texts.items()}


def _described(source: NamedRobot, found: Identified) -> RobotFile:
    """File of the robot found: that which it was read from, with other numbers."""
    if source.format not in ("urdf", "mjcf"):
        return RobotFile("", None, "no description is written: the robot is not from a URDF or MJCF file")
    robot = found.with_simple_friction()
    try:
        if source.format == "mjcf":
            return RobotFile(robot.to_mjcf(source.file), robot, "")
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            text = found.to_urdf(source.file)
        return RobotFile(text, robot.replace(armature=None), "; ".join(str(one.message) for one in said))
    except (ArgumentError, DescriptionError) as error:
        return RobotFile("", None, f"no description is written: {error}")


def _names(pattern: str, robot: Robot) -> str | list[str] | None:
    """Names of columns as `Layout` takes them; None: not recorded."""
    if JOINT in pattern:
        return [pattern.replace(JOINT, name) for name in robot.joint_names]
    names = [name.strip() for name in pattern.split(",")]
    return None if pattern.lower() == "none" else names if len(names) > 1 else pattern


def _outcome(
    found: Identified, measured: Evaluation, payload: IdentifiedPayload | None, files: dict[str, Path], omitted: str
) -> Outcome:
    """Text and data of what was found."""
    selection, unidentifiable = found.selection, found.unidentifiable
    text: list[str | Grid | Verbatim] = [Grid(measured.header, measured.rows())]
    if selection is not None:
        text.append(f"model: {selection.summary}")
    if unidentifiable:
        title = "not identifiable from these logs, kept near the description:"
        text += [title, Grid((), [("-", line) for line in unidentifiable])]
    if payload is not None:
        text.append(str(payload))
    text += [measured.summary, MEANING]
    text.append(Grid((), [("wrote", str(path)) for path in files.values()]))
    text += [omitted] if omitted else []
    rows = zip(found.names, found.parameters, found.errors, found.identifiable, strict=True)
    base = zip(found.base_names, found.base @ found.parameters, found.base_errors, strict=True)
    data: dict[str, Any] = {
        "robot": found.robot.name,
        "verdict": measured.verdict.value,
        "summary": measured.summary,
        "evaluation": {name: x for name, x in measured._asdict().items() if name != "findings"},
        "findings": [one._asdict() for one in (*found.findings, *measured.findings)],
        "model": None if selection is None else selection.chosen.name,
        "parameters": [{"name": name, "estimate": x, "error": e, "identifiable": known} for name, x, e, known in rows],
        "base_parameters": [{"combination": name, "estimate": x, "error": error} for name, x, error in base],
        "unidentifiable": unidentifiable,
        "noise": found.noise,
        "gains": None if found.gains is None else found.gains._asdict(),
        "payload": None if payload is None else {k: x for k, x in payload._asdict().items() if k != "robot"},
        "files": files,
        "omitted": omitted,
    }
    return Outcome(tuple(text), data)
