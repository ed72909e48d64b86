"""Command `id`: a robot identified from logs, tried on what was not learned from, with a page about it."""

import math
import os
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import tyro

from torchdq.base.files import write_atomically
from torchdq.base.optional import require_packages
from torchdq.base.progress import Progress
from torchdq.command.command import ENDINGS, NamedRobot, RobotCommand
from torchdq.command.identification_page import page
from torchdq.command.outcome import Grid, Outcome, Verbatim
from torchdq.command.trials import HEADER, Trial, trials
from torchdq.effects import Coulomb, Viscous
from torchdq.errors import ArgumentError, DescriptionError
from torchdq.learning import (
    Evaluation,
    Identified,
    IdentifiedPayload,
    Layout,
    Log,
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
from torchdq.learning.identification.gains import RESTS
from torchdq.learning.identification.identified import GAINS
from torchdq.robot import Robot

# module, extra that brings it: looked for before the work, not after it
NEEDED = {"scipy": "learn", "matplotlib": "viz"}
ROBOTS = (*ENDINGS, ".urdf.xacro")  # how files of each kind end
LOGS = (".csv", ".csv.gz", ".txt", ".npz", ".npy", ".mat", ".mcap")


class RobotFile(NamedTuple):
    """File of the robot found."""

    text: str  # "" if there is none
    robot: Robot | None  # robot that it holds, with its damping and friction
    omitted: str  # what it lacks, or why there is none; "" for nothing


@dataclass(kw_only=True)
class IdCommand(RobotCommand):
    """A robot identified from logs: errors, a verdict, identifiable parameters, one HTML page, and its URDF.

    A log is a text (CSV), NPZ, MATLAB or MCAP file with columns time [s], q1 ... [rad], qd1 ... [rad/s] and
    tau1 ... [N m], or names by --columns. Files of one log stand together: positions.csv+torques.csv. Tested is the
    last log, or the last third of the only one.

    Names in --columns: position_{0} reads position_0, position_1, ... for the joints, position_{1} begins with
    position_1, {2} is the second column of a file without a header; in effort_{joint} {joint} is replaced by the
    joint's own name; a1,b2,c3 are the names of all columns, in the robot's order of joints; torques:tau{1} is in
    torques.csv; none: not recorded.

    Example: torchdq id arm.urdf a.csv --columns q pos_{0} qd vel_{0} tau eff_{0}
    """

    logs: Annotated[tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="LOG")]
    """Logs to learn from and to test on."""
    test: tuple[str, ...] = ()
    """Logs to test on instead; then all LOGs are learned from."""
    columns: Annotated[dict[str, str], tyro.conf.arg(metavar="SIGNAL NAMES ...")] = field(default_factory=dict)
    """Names of columns, for each of time, q, qd and tau that has others; see above."""
    rate: float | None = None
    """Rows per second of logs without times [Hz]."""
    transmission: tuple[float, ...] = ()
    """Change of the joints' positions per change of the motors' where those were measured: one for each joint, 0.01
    for a gear of 100:1, or the rows of a matrix, one after the other; coupled motors are what is identified then."""
    degrees: bool = False
    """Positions, velocities and accelerations are in degrees, as in files of many controllers."""
    scale: Annotated[dict[str, str], tyro.conf.arg(metavar="SIGNAL FACTORS ...")] = field(default_factory=dict)
    """Factors that take time, q, qd or qdd to s, rad (m) and so on: a number, or one per joint, 0.001,0.0175,0.0175."""
    zero: tuple[float, ...] = ()
    """Positions of the joints where those in the logs are zero, one for each joint, after the scale [rad or m]."""
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
    """Estimate the rotor inertia of every joint; by default of those that gain on blocks left out."""
    prior: float | None = None
    """Weight of the description; by default chosen on blocks of the logs left out."""
    keep: float = 50.0
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
        joints = source.robot
        source = source._replace(robot=self._motors(joints))
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            logs = [[self._log(log, source.robot) for log in some] for some in (self.logs, self.test, self.payload)]
            motions, tests, held = ([self._motion(log) for log in some] for some in logs)
            if tests:
                train, test = motions, tests
            else:
                train, test = train_test_split(motions) if len(motions) == 1 else (motions[:-1], motions[-1:])
            found = self._identified(source.robot, train)
            payload = identify_payload(found, torques_by(found, held), frame=self.frame) if held else None
            description = _described(source, joints, found)
            measured = evaluate(source.robot, found, test, description.robot)
            tried = trials(source.robot, found, measured, test, self._others(source.robot, train), self.frame)
        messages = list({str(one.message): one.message for one in said}.values())
        for message in messages:
            warnings.warn(message, stacklevel=2)
        joined = [*dict.fromkeys(log.joined for some in logs for log in some if log.joined)]
        with Progress("drawing the page"):
            words = [x.text(command_line=True) if isinstance(x, LogWarning) else str(x) for x in messages]
            sources = [f"robot: {self.robot}", f"logs: {', '.join(self.logs)}"]
            sources += [f"tested on: {', '.join(self.test)}"] if self.test else []
            sources += joined
            text = page(found, measured, test, sources, words, payload, tried)
        files = self._written(source, text, description)
        return _outcome(found, measured, (payload, tried), files, [*joined, description.omitted])

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

    def _motors(self, robot: Robot) -> Robot:
        """Robot whose coordinates are its motors, if the transmission couples them, with what joints have for each."""
        coupling = self._layout(robot).coupling
        if coupling is None:
            return robot
        own = {name: getattr(robot, name) for name in ("damping", "friction", "armature")}
        return robot.couple(coupling, robot.joint_names, limits=math.inf, **own)

    def _log(self, name: str, robot: Robot) -> Log:
        """Log in a file, or in several that are joined by a plus sign."""
        files = [name] if "+" not in name or os.path.exists(name) else name.split("+")
        return read_log(files, self._layout(robot), self.rows, robot=robot)

    def _motion(self, log: Log) -> Motion:
        """Motion of a log, filtered, with accelerations."""
        width = {} if self.sign_width is None else {"sign_width": self.sign_width}
        return smooth(log, self.cutoff, self.cutoff, self.keep, delay=self.delay, **width)

    def _layout(self, robot: Robot) -> Layout:
        """Layout of the logs, as the options say."""
        options: dict[str, Any] = {"columns": {name: _names(x) for name, x in self.columns.items()}}
        options |= {"farthest": self.farthest, "fastest": self.fastest, "rate": self.rate}
        turns = [kind.turns for kind in robot.joint_types]
        degrees = [math.pi / 180 if x else 1.0 for x in turns] if not all(turns) else math.pi / 180
        options["scale"] = dict.fromkeys(("q", "qd", "qdd"), degrees) if self.degrees else {}
        options["scale"] |= {signal: _factors(signal, x) for signal, x in self.scale.items()}
        options["zero"] = self.zero
        options["gain"] = self.gains or (None if self.estimate_gains else ())
        n, S = robot.n, self.transmission
        options["transmission"] = [S[i : i + n] for i in range(0, n * n, n)] if n > 1 and len(S) == n * n else S
        return Layout(**options)

    def _identified(self, robot: Robot, train: Sequence[Motion]) -> Identified:
        """Robot identified with the model that the options ask for."""
        width = 1e-2 if self.sign_width is None else self.sign_width
        friction: Any = {"auto": "auto", "simple": (Viscous(), Coulomb(sign_width=width)), "none": None}[self.friction]
        model = Model(friction, self.offset, self.rotors or "auto", self.estimate_gains)
        return identify(robot, train, model, self.prior, width)

    def _others(self, robot: Robot, train: Sequence[Motion]) -> dict[str, Callable[[], Identified]]:
        """Other models, by the options that ask for them."""
        others = {"--estimate-gains": replace(self, estimate_gains=True), "--rotors": replace(self, rotors=True)}
        return {option: partial(other._identified, robot, train) for option, other in others.items() if other != self}

    def _written(self, source: NamedRobot, text: str, description: RobotFile) -> dict[str, Path]:
        """Files by kind."""
        name = "".join(c if c.isalnum() or c in "-_" else "_" for c in source.robot.name) or "robot"
        texts = {"page": (f"{name}_identified.html", text)}
        if description.text:
            kind, ending = ("mjcf", "xml") if source.format == "mjcf" else ("urdf", "urdf")
            texts[kind] = (f"{name}_identified.{ending}", description.text)
        for file, content in texts.values():
            write_atomically({self.out / file: content})
        return {kind: self.out / file for kind, (file, _) in texts.items()}


def _described(source: NamedRobot, joints: Robot, found: Identified) -> RobotFile:
    """File of the robot found: its URDF or MJCF with other numbers, or a new URDF; `joints` has its coordinates."""
    robot, original = found.with_simple_friction(), source.file if source.format in ("urdf", "mjcf") else None
    try:
        if joints is not source.robot:
            bodies = {name: getattr(robot, name) for name in ("mass", "com", "inertia")}
            written = joints.replace(on_unphysical="warn", **bodies)
            text = written.to_mjcf(original) if source.format == "mjcf" else written.to_urdf(original)
            return RobotFile(text, None, "friction and rotors are those of the coupled motors, which no file describes")
        if source.format == "mjcf":
            return RobotFile(robot.to_mjcf(original), robot, "")
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            text = found.to_urdf(original)
        return RobotFile(text, robot.replace(armature=None), "; ".join(str(one.message) for one in said))
    except (ArgumentError, DescriptionError) as error:
        return RobotFile("", None, f"no description is written: {error}")


def _names(pattern: str) -> str | list[str] | None:
    """Names of columns as `Layout` takes them; None: not recorded."""
    names = pattern.split(",")
    return None if pattern.lower() == "none" else names if len(names) > 1 else pattern


def _factors(signal: str, text: str) -> float | list[float]:
    """Factor of a signal, or one for each joint."""
    try:
        factors = [float(x) for x in text.split(",")]
    except ValueError as error:
        raise ArgumentError(f"scale must be numbers such as 0.001, found {text!r} for {signal}") from error
    return factors if len(factors) > 1 else factors[0]


def _outcome(
    found: Identified,
    measured: Evaluation,
    besides: tuple[IdentifiedPayload | None, tuple[Trial, ...]],
    files: dict[str, Path],
    notes: Sequence[str],
) -> Outcome:
    """Text and data of what was found, a payload, what was tried besides, and notes, the last about the files."""
    payload, tried = besides
    selection, unidentifiable = found.selection, found.unidentifiable
    text: list[str | Grid | Verbatim] = [Grid(*measured.table())]
    if selection is not None:
        text.append(f"model: {selection.summary}")
    if unidentifiable:
        title = "not identifiable from these logs, kept near the description:"
        text += [title, Grid((), [("-", line) for line in unidentifiable])]
    if found.gains is not None:
        text += [Grid(GAINS, found.gain_rows()), RESTS]
    if payload is not None:
        text.append(str(payload))
    text += [measured.summary, *([Grid(HEADER, [one.cells for one in tried])] if tried else []), MEANING]
    text.append(Grid((), [("wrote", str(path)) for path in files.values()]))
    text += [one.text(command_line=True) for one in found.findings if one.severity == "note"]
    text += filter(None, notes)
    rows = zip(found.names, found.parameters, found.errors, found.identifiable, strict=True)
    data: dict[str, Any] = {
        "robot": found.robot.name,
        "verdict": measured.verdict.value,
        "summary": measured.summary,
        "evaluation": {name: x for name, x in measured._asdict().items() if name not in ("findings", "far")},
        "findings": [one._asdict() for one in (*found.findings, *measured.findings)],
        "model": None if selection is None else selection.chosen.name,
        "parameters": [{"name": name, "estimate": x, "error": e, "identifiable": known} for name, x, e, known in rows],
        "base_parameters": [
            dict(zip(("combination", "estimate", "error", "unit"), row, strict=True)) for row in found.base_rows()
        ],
        "unidentifiable": unidentifiable,
        "noise": found.noise,
        "gains": None if found.gains is None else found.gains._asdict(),
        "payload": None if payload is None else {k: x for k, x in payload._asdict().items() if k != "robot"},
        "tried": [one._asdict() for one in tried],
        "files": files,
        "omitted": notes[-1],
    }
    return Outcome(tuple(text), data)
