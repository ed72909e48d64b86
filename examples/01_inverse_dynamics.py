"""Inverse dynamics of a real robot, compared with other libraries, an analytic solution and, if available, a log.

    python examples/01_inverse_dynamics.py
    python examples/01_inverse_dynamics.py --robot my_arm.urdf
    python examples/01_inverse_dynamics.py --log panda_exciting_traj1.csv

Every comparison is a check with a tolerance; the exit status is 1 if one fails. Figures are written to `out/`.
"""

import contextlib
import io
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.metadata import files
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import pinocchio as pin
import pytorch_kinematics
import torch
import tyro
from closed_loop import simulated
from matplotlib import pyplot as plt
from pictures import BLUE, GREY, ORANGE, label, panels, prepare, save
from recordings import LAYOUTS, layout_of
from rich.console import Console
from rich.progress import track
from rich.table import Table
from torch import Tensor
from torch.utils.benchmark import Timer

import torchdq
from torchdq import learning
from torchdq.learning import Log, LogError, Motion, smooth
from torchdq.learning.logs.checks import GAP

EPS = {torch.float64: 2.0**-52, torch.float32: 2.0**-23}
NAME = {torch.float64: "float64", torch.float32: "float32"}
# R2 that the descriptions of two public data sets state, by the names of their files: model alone, with friction.
# The Panda's motion repeats itself after 13.3 s, so that most of its test rows are a motion that was fitted on.
STATED = {
    ("panda_exciting_traj1.csv",): (
        (0.98, 0.998, 0.998, 0.98, 0.90, 0.96, -0.02),
        (0.995, 0.999, 0.999, 0.996, 0.986, 0.991, 0.948),
    ),
    ("ur-20_02_10-30sec_12harm.csv", "ur-20_02_12-40sec_12harm.csv", "ur-20_02_19_14harm50sec.csv"): (
        (0.02, 0.89, 0.86, 0.29, 0.00, -0.01),
        (0.996, 0.990, 0.997, 0.987, 0.984, 0.996),
    ),
}


@dataclass
class Args:
    robot: Path | None = None
    """URDF of the robot; none: the xArm7 of the example-robot-data package, and the log's own robot for a log."""
    batch: int = 4096
    """Number of random states."""
    log: tuple[str, ...] = ()
    """Recordings of a real arm, each PATH or PATH:FIRST:LAST (rows, counted from 0)."""
    test_log: str | None = None
    """Recording to test the friction on; none: it is fitted on the first 60 % of each log, tested on the rest."""
    format: Literal["auto", "panda", "ur10e", "double_pendulum", "csv"] = "auto"
    """Layout of the recordings, see `recordings.LAYOUTS`; auto: detected by the file's name and its columns."""
    step: float = 1e-3
    """Step of the simulated two-link arm [s]."""
    timing: float = 0.2
    """Time spent on each timing [s]; 0: none is taken."""
    seed: int = 0
    """Seed of the random states."""
    out: Path = Path("out")
    """Folder of the pictures."""


class Check(NamedTuple):
    """A number and what it must not exceed."""

    value: float
    limit: float

    @property
    def passed(self) -> bool:
        return self.value <= self.limit  # false for NaN, as it should be


def main(args: Args) -> dict[str, Check]:
    """Run everything; returns the checks by name."""
    console = Console(highlight=False, soft_wrap=True, width=None if sys.stdout.isatty() else 100)
    prepare()
    torch.manual_seed(args.seed)
    checks: dict[str, Check] = {}

    # 0. a bad log ends the program here, before the work
    sources = (*args.log, args.test_log) if args.log and args.test_log else args.log
    recorded = [read_log(source, args.format) for source in sources]

    # 1. a robot, from its file
    path = args.robot or xarm7()
    robot = torchdq.Robot.from_urdf(path)
    model = pin.buildModelFromUrdf(str(path))
    console.print(str(robot.report()), markup=False)

    # 2. accuracy and speed on random states
    states = random_states(robot, args.batch)
    checks |= compare(console, robot, model, path, *states)
    if args.timing:
        time_all(console, robot, model, path, *states, seconds=args.timing)

    # 3. gradients through the layer
    checks |= differentiate(console, robot, model, *(x[:64] for x in states))

    # 4. the paper's controller on the paper's arm
    checks |= track_two_link(console, args.step, args.out / "tracking.png")

    # 5. torques along a motion
    plot_torques(robot, model, args.out / "torques.png")

    # 6. a motion that really happened
    if recorded:
        own = None if args.robot is None else robot
        picture = args.out / "measured.png"
        checks |= explain_logs(console, recorded, args.test_log is not None, own, picture)[2]

    console.print()
    for name, check in checks.items():
        verdict = "[green]pass[/]" if check.passed else "[bold red]FAIL[/]"
        console.print(f"{verdict}  {name}: {check.value:.1e}, at most {check.limit:.0e}")
    console.print(f"pictures in {args.out}/")
    return checks


def xarm7() -> Path:
    """URDF of the xArm7, wherever the example-robot-data package is installed."""
    return Path(next(file for file in files("example-robot-data") if file.name == "xarm7.urdf").locate())


def show(console: Console, title: str, words: int, heads: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Print a table: the first columns are words, the others numbers."""
    table = Table()
    for i, head in enumerate(heads):
        table.add_column(head, justify="left" if i < words else "right")
    for row in rows:
        table.add_row(*row)
    console.print(f"\n[bold]{title}[/]")
    console.print(table)


# --- random states ---------------------------------------------------------------------------------------------------


def random_states(robot: torchdq.Robot, batch: int) -> tuple[Tensor, Tensor, Tensor]:
    """q within the limits, qd and qdd normal, [batch, n].

    The numbers are float32 numbers held in float64, so that both precisions see exactly the same states.
    """
    lower, upper = (x.clamp(-torch.pi, torch.pi) for x in (robot.limits.lower, robot.limits.upper))
    q = lower + (upper - lower) * torch.rand(batch, robot.n)
    qd, qdd = torch.randn(2, batch, robot.n)
    return tuple(x.float().double() for x in (q, qd, qdd))


def configurations(model: pin.Model, q: Tensor) -> np.ndarray:
    """Pinocchio's configurations [batch, nq]: it writes the angle of a continuous joint as cosine and sine."""
    return np.stack([pin.integrate(model, pin.neutral(model), x) for x in q.numpy()])


def error(x: Tensor, reference: np.ndarray) -> float:
    """Largest error of a sample, relative to the sample's largest number."""
    reference = torch.as_tensor(np.asarray(reference)).flatten(1)
    return float(((x.double().flatten(1) - reference).abs().amax(-1) / reference.abs().amax(-1)).max())


def compare(
    console: Console, robot: torchdq.Robot, model: pin.Model, path: Path, q: Tensor, qd: Tensor, qdd: Tensor
) -> dict[str, Check]:
    """Errors of torques, mass matrix, accelerations and frames, in both precisions."""
    data = model.createData()
    states = list(zip(configurations(model, q), qd.numpy(), qdd.numpy(), strict=True))
    tau = np.array([pin.rnea(model, data, *x) for x in states])
    M = np.array([pin.crba(model, data, x[0]) for x in states])
    acceleration = np.array([pin.aba(model, data, x[0], x[1], t) for x, t in zip(states, tau, strict=True)])
    condition = float(np.linalg.cond(M).max())
    chain = kinematic_chain(path, q.dtype)
    poses = chain.forward_kinematics(dict(zip(robot.joint_names, q.T, strict=True)))
    names = [name for name in robot.frame_names if name in poses]
    frames = torch.stack([poses[name].get_matrix().expand(len(q), 4, 4) for name in names], dim=1).numpy()

    found = {}
    for dtype in EPS:
        x, v, a, t = (x.to(dtype) for x in (q, qd, qdd, torch.as_tensor(tau)))
        found[dtype] = {
            "torques": torchdq.inverse_dynamics(robot, x, v, a),
            "mass matrix": torchdq.mass_matrix(robot, x),
            "accelerations": torchdq.forward_dynamics(robot, x, v, t),
            "frames": torchdq.dq.to_matrix(torchdq.forward_kinematics(robot, x, names)),
        }
    rows = [  # what, against, its numbers, their precision, how many times the precision the error may be
        ("torques", "pinocchio.rnea", tau, 0.0, 4000.0),
        ("mass matrix", "pinocchio.crba", M, 0.0, 4000.0),
        ("accelerations", f"pinocchio.aba (condition of M {condition:.0e})", acceleration, 0.0, 10.0 * condition),
        ("frames", "pytorch_kinematics (float32 inside)", frames, EPS[torch.float32], 50.0),
    ]
    checks, lines = {}, []
    for what, against, reference, precision, times in rows:
        errors = [error(found[dtype][what], reference) for dtype in EPS]
        lines.append((what, against, *(f"{e:.1e}" for e in errors)))
        for (dtype, eps), value in zip(EPS.items(), errors, strict=True):
            checks[f"{what}, {NAME[dtype]}"] = Check(value, times * max(eps, precision))
    title = f"Largest relative error of {len(q)} random states of {robot.name}"
    show(console, title, 2, ("", "against", *NAME.values()), lines)
    return checks


def kinematic_chain(path: Path, dtype: torch.dtype) -> pytorch_kinematics.Chain:
    """Chain of pytorch_kinematics, without its parser's remarks on tags that are not kinematics."""
    with contextlib.redirect_stderr(io.StringIO()):
        return pytorch_kinematics.build_chain_from_urdf(path.read_bytes()).to(dtype=dtype)


def time_all(
    console: Console,
    robot: torchdq.Robot,
    model: pin.Model,
    path: Path,
    q: Tensor,
    qd: Tensor,
    qdd: Tensor,
    seconds: float,
) -> None:
    """Median time per sample of whole-batch calls, on one thread and on as many as torch uses."""
    tau = torchdq.inverse_dynamics(robot, q, qd, qdd)
    columns = [np.asfortranarray(x.T) for x in (configurations(model, q), qd.numpy(), qdd.numpy(), tau.numpy())]
    result = np.zeros_like(columns[1])

    def median(call: Callable[[], object], threads: int) -> float:
        timer = Timer("call()", globals={"call": call}, num_threads=threads)
        return timer.blocked_autorange(min_run_time=seconds).median / len(q) * 1e6

    def pinocchio(call: Callable, last: np.ndarray, threads: int) -> Callable[[], object]:
        pool = pin.ModelPool(model, threads)
        return lambda: call(threads, pool, *columns[:2], last, result)

    chain, angles = kinematic_chain(path, q.dtype), dict(zip(robot.joint_names, q.T, strict=True))
    rnea, aba = partial(pinocchio, pin.rneaInParallel, columns[2]), partial(pinocchio, pin.abaInParallel, columns[3])
    rows = {
        "inverse dynamics": (torchdq.inverse_dynamics, (q, qd, qdd), rnea),
        "forward dynamics": (torchdq.forward_dynamics, (q, qd, tau), aba),
        "mass matrix": (torchdq.mass_matrix, (q,), None),
        "all frames": (torchdq.forward_kinematics, (q,), lambda threads: lambda: chain.forward_kinematics(angles)),
    }
    lines = []
    for name, (ours, inputs, other) in rows.items():
        for threads in sorted({1, torch.get_num_threads()}):
            with torch.inference_mode():
                single = [x.float() for x in inputs]
                t64 = median(lambda f=ours, x=inputs: f(robot, *x), threads)
                t32 = median(lambda f=ours, x=single: f(robot, *x), threads)
            against = ("-", "-")
            if other is not None:
                peer = median(other(threads), threads)
                against = (f"{peer:.2f}", f"{t64 / peer:.2f}")
            lines.append((name, str(threads), f"{t64:.2f}", f"{t32:.2f}", *against))
    title = f"Median time per sample in microseconds, {len(q)} samples in a call, no gradients"
    heads = ("", "threads", "torchdq\nfloat64", "torchdq\nfloat32", "the other\nfloat64", "ratio of\nfloat64")
    show(console, title, 1, heads, lines)
    console.print(
        "torchdq runs compiled programs if there is a C compiler, on rows of samples. The other is Pinocchio's\n"
        "rneaInParallel and abaInParallel, on arrays in its own order of memory (it has no batched crba), and\n"
        "pytorch_kinematics for the frames. The ratio is torchdq's time over the other's, on as many threads."
    )


# --- gradients -------------------------------------------------------------------------------------------------------


def differentiate(console: Console, robot: torchdq.Robot, model: pin.Model, *state: Tensor) -> dict[str, Check]:
    """Gradients of half the sum of squared torques in the state, the masses and the centres of mass."""
    mass, com = robot.mass.clone().requires_grad_(), robot.com.clone().requires_grad_()
    layer = torchdq.DQRNEA(robot.replace(mass=mass, com=com))
    inputs = [x.clone().requires_grad_() for x in state]
    tau = layer(*inputs)
    (tau.square().sum() / 2).backward()

    # Pinocchio differentiates the torques in the state; the chain rule with the loss is tau^T dtau
    data, tau = model.createData(), tau.detach().numpy()
    q = configurations(model, state[0])
    states = list(zip(q, state[1].numpy(), state[2].numpy(), strict=True))
    derivatives = [[d.copy() for d in pin.computeRNEADerivatives(model, data, *x)] for x in states]
    expected = [np.stack([t @ d[k] for t, d in zip(tau, derivatives, strict=True)]) for k in range(3)]

    # it does not differentiate in the masses, but torques are linear in a mass and quadratic in a centre of mass, for
    # which a central difference is exact however wide it is
    def slope(i: int, mass: float = 0.0, com: np.ndarray | float = 0.0) -> float:
        ends = []
        for sign in (1, -1):
            changed = model.copy()
            body = changed.inertias[i + 1]  # 0 is the world
            changed.inertias[i + 1] = pin.Inertia(body.mass + sign * mass, body.lever + sign * com, body.inertia)
            ends.append(np.array([pin.rnea(changed, data, *x) for x in states]))
        return float((tau * (ends[0] - ends[1])).sum() / 2)

    expected += [np.array([slope(i, mass=1.0) for i in range(robot.n)])]
    expected += [np.array([[slope(i, com=e) for e in np.eye(3)] for i in range(robot.n)])]

    def torques_of(qdd: Tensor, q: Tensor, qd: Tensor) -> Tensor:
        return torchdq.inverse_dynamics(robot, q, qd, qdd)

    jacobian = torch.func.vmap(torch.func.jacrev(torques_of))(state[2], state[0], state[1])
    derivative = "pinocchio.computeRNEADerivatives"
    rows = [
        ("loss in q", derivative, inputs[0].grad, expected[0]),
        ("loss in qd", derivative, inputs[1].grad, expected[1]),
        ("loss in qdd", derivative, inputs[2].grad, expected[2]),
        ("loss in the masses", "pinocchio.rnea, differences", mass.grad, expected[3]),
        ("loss in the centres of mass", "pinocchio.rnea, differences", com.grad, expected[4]),
        ("torques in qdd: all of M", derivative, jacobian, np.array([d[2] for d in derivatives])),
    ]
    checks, lines = {}, []
    for name, against, found, reference in rows:
        value = float(np.abs(found.numpy() - reference).max() / np.abs(reference).max())
        lines.append((name, against, f"{value:.1e}"))
        checks[f"gradient of the {name}"] = Check(value, 1e-11)
    title = f"Gradients through the layer DQRNEA, {len(tau)} states, float64"
    show(console, title, 2, ("gradient of the", "against", "relative error"), lines)
    return checks


# --- computed torque -------------------------------------------------------------------------------------------------


def track_two_link(console: Console, step: float, picture: Path) -> dict[str, Check]:
    """Two-link arm from hanging at rest onto (sin t, cos(2t)/2), by computed torque with kp = 25, kd = 10.

    With the true model the error must obey e'' + 10 e' + 25 e = 0, of which the solution is known.
    """
    robot = torchdq.robots.load("two_link")
    controller = torchdq.ComputedTorque(robot, kp=25.0, kd=10.0)
    time = torch.arange(round(2.0 / step) + 1, dtype=torch.float64) * step

    def reference(t: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        q_des = torch.stack([torch.sin(t), torch.cos(2 * t) / 2], -1)
        qd_des = torch.stack([torch.cos(t), -torch.sin(2 * t)], -1)
        return q_des, qd_des, torch.stack([-torch.sin(t), -2 * torch.cos(2 * t)], -1)

    hanging = torch.tensor([[-torch.pi / 2, 0.0], [0.0, 0.0]], dtype=torch.float64)
    times = track(time[:-1], "computed torque", console=console, transient=True, disable=not console.is_terminal)
    with torch.inference_mode():
        states = simulated(robot, lambda t, q, qd: controller(q, qd, *reference(t)), hanging, times, step)
    q = states[:, 0]
    q_des, qd_des, _ = reference(time)
    e = q_des - q
    decay = torch.exp(-5.0 * time)[:, None] * (e[0] + (qd_des[0] + 5.0 * e[0]) * time[:, None])  # critically damped
    deviation = (e - decay).abs()
    checks = {"tracking error of the two-link arm against the analytic decay": Check(float(deviation.max()), 1e-9)}

    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.8), layout="constrained")
    dashed = {"linestyle": (0, (4, 2)), "linewidth": 1.2}
    for j, colour in enumerate((BLUE, ORANGE)):
        left.plot(time, q[:, j], color=colour, label=f"joint {j + 1}")
        left.plot(time, q_des[:, j], color=colour, **dashed)
        right.semilogy(time, e[:, j].abs(), color=colour, linewidth=3.5, alpha=0.5)
        right.semilogy(time[1:], deviation[1:, j], color=colour, linewidth=1)
    left.plot([], [], color=GREY, label="reference", **dashed)
    left.set(xlabel="time [s]", ylabel="angle [rad]", title="Computed torque, two-link arm")
    left.legend(loc="lower right")
    right.semilogy(time, decay.abs(), color="black", linestyle=(0, (1.5, 2)), linewidth=1.4)
    right.axhline(1e-9, color=GREY, linewidth=1)
    for height, text in ((2e-4, "tracking error, analytic dotted"), (2e-9, "limit of the check"), (2e-15, "deviation")):
        right.text(0.05, height, text, color="#555555", fontsize=10)
    right.set(xlabel="time [s]", ylabel="[rad]", ylim=(1e-16, 10), title="Tracking error, and deviation from theory")
    save(figure, picture)
    return checks


# --- pictures --------------------------------------------------------------------------------------------------------


def plot_torques(robot: torchdq.Robot, model: pin.Model, picture: Path) -> None:
    """Torques along a smooth motion, a panel per joint, Pinocchio's as markers; the last panel is the difference."""
    t = torch.linspace(0, 4, 401, dtype=torch.float64)[:, None]
    lower, upper = (x.clamp(-torch.pi, torch.pi) for x in (robot.limits.lower, robot.limits.upper))
    middle, swing = (lower + upper) / 2, 0.35 * (upper - lower)
    rate = 1.5 + 0.25 * torch.arange(robot.n, dtype=torch.float64)
    q = middle + swing * torch.sin(rate * t)
    qd, qdd = swing * rate * torch.cos(rate * t), -swing * rate**2 * torch.sin(rate * t)
    tau = torchdq.inverse_dynamics(robot, q, qd, qdd)
    data = model.createData()
    states = zip(configurations(model, q), qd.numpy(), qdd.numpy(), strict=True)
    theirs = np.array([pin.rnea(model, data, *x) for x in states])

    figure, (*joints, last) = panels(robot.n + 1, min(4, robot.n + 1), 2.1)
    for j, panel in enumerate(joints):
        panel.plot(t, tau[:, j], color=BLUE, label="torchdq")
        panel.plot(t[::20], theirs[::20, j], "o", color=ORANGE, markersize=4, label="Pinocchio")
        panel.set_title(robot.joint_names[j])
    last.semilogy(t, np.abs(tau.numpy() - theirs) + 1e-18, ".", color=GREY, markersize=1.5)
    last.set(title="difference, all joints", ylim=(1e-17, 1e-11))
    label(figure, joints[0], "time [s]")
    save(figure, picture)


# --- recordings ------------------------------------------------------------------------------------------------------


class Recording(NamedTuple):
    """A recorded motion, what the model makes of it, and the rows that friction is fitted on."""

    motion: Motion
    model: np.ndarray  # torques of the rigid body [rows, n]
    friction: np.ndarray  # terms of the friction [rows, terms, n]
    fitted: np.ndarray  # [rows], bool


def explain_logs(
    console: Console, recorded: Sequence[Log], test_last: bool, robot: torchdq.Robot | None, picture: Path
) -> tuple[np.ndarray, np.ndarray, dict[str, Check]]:
    """R2 of the measured torques on the test rows, per joint: of the model alone, and with fitted friction.

    The test rows are the last log, or the last 40 % of each. The robot is the log's own if none is given.
    """
    kind = recorded[0].layout
    if robot is None and kind.robot is None:
        raise LogError(f"{recorded[0].path} does not say which robot it is of; name its URDF by --robot")
    robot = robot or torchdq.robots.load(kind.robot)
    if any(log.layout != kind for log in recorded) or robot.n != kind.joints:
        raise LogError(f"the recordings must be of one robot, with the {robot.n} joints of {robot.name}")
    recordings = []
    console.print()
    for log in recorded:
        motion = smooth(log)
        rigid = torchdq.inverse_dynamics(robot, *(torch.as_tensor(x) for x in (motion.q, motion.qd, motion.qdd)))
        terms = [motion.qd, np.tanh(motion.qd / kind.slow), np.ones_like(motion.qd)]  # viscous, Coulomb, offset
        terms += [motion.qdd] if kind.rotors else []
        share = float(log is not recorded[-1]) if test_last else 0.6
        fitted = np.arange(len(motion.time)) < share * len(motion.time)
        recordings.append(Recording(motion, rigid.numpy(), np.stack(terms, axis=1), fitted))
        steps = 1e3 * np.diff(log.time)
        console.print(
            f"{log.path.name}: {len(log.time)} rows, steps of {steps.min():.2g} to {steps.max():.2g} ms, "
            f"{log.repeats} repeated stamps left out; {len(motion.time)} rows used, {fitted.sum()} to fit friction"
        )

    tau = np.concatenate([recording.motion.tau for recording in recordings])
    model, friction, fitted = (np.concatenate([r[k] for r in recordings]) for k in (1, 2, 3))
    coefficients = np.stack(
        [np.linalg.lstsq(friction[fitted, :, j], (tau - model)[fitted, j], rcond=None)[0] for j in range(robot.n)], -1
    )
    measured = tau[~fitted]
    predictions = [x[~fitted] for x in (model, model + (friction * coefficients).sum(1))]
    mse = [((measured - x) ** 2).mean(0) for x in predictions]
    r2 = [1 - x / measured.var(0) for x in mse]

    stated = STATED.get(tuple(log.path.name for log in recorded))
    lines = []
    for j, name in enumerate(robot.joint_names):
        cells = [f"{x:.3f}" for k in (0, 1) for x in (r2[k][j], np.sqrt(mse[k][j]))]
        lines.append((name, f"{measured[:, j].std():.2f}", *cells, *(f"{x[j]:.3f}" for x in stated or ())))
    heads = ["joint", "std\nN m", "model\nR2", "\nRMSE N m", "+ friction\nR2", "\nRMSE N m"]
    heads += ["stated R2\nmodel", "\n+ friction"] if stated else []
    show(console, f"Measured torques of {robot.name} explained, on rows the fit has not seen", 1, heads, lines)
    what = "viscous, Coulomb, offset" + (", rotor inertia" if kind.rotors else "")
    console.print(f"friction: {what}, by least squares{'; stated: by the description of the data' if stated else ''}")
    plot_recording(robot, recordings[-1], coefficients, r2, picture)
    if stated is None:
        return *r2, {}
    worst = float(np.abs(r2[1] - stated[1]).max())
    return *r2, {f"R2 with friction of {recorded[-1].path.name}, distance from the stated one": Check(worst, 0.01)}


def read_log(source: str, layout: str) -> Log:
    """Log of PATH or PATH:FIRST:LAST."""
    path, *rows = source.rsplit(":", 2) if source.count(":") >= 2 else (source,)
    kind = LAYOUTS[layout] if layout != "auto" else layout_of(Path(path))
    log = learning.read_log(path, kind, tuple(map(int, rows)) if rows else None)
    if layout == "auto":
        name = next(name for name, arm in LAYOUTS.items() if arm is kind)
        found = f"recognised as {name} by its name and columns; --format csv if it is none of that data set"
        other = "of no data set that is known; its columns are read as they are named, --format names a data set"
        print(f"{Path(path).name}: {found if kind.files else other}")
    return log


def plot_recording(
    robot: torchdq.Robot, recording: Recording, coefficients: np.ndarray, r2: Sequence[np.ndarray], picture: Path
) -> None:
    """Measured and predicted torques, a panel per joint; the rows that friction was fitted on are shaded."""
    time = recording.motion.time - recording.motion.time[0]
    end_of_fit = time[recording.fitted].max(initial=0.0)
    time = np.where(np.diff(time, prepend=0.0) > GAP, np.nan, time)  # no line across rows at rest
    full = recording.model + (recording.friction * coefficients).sum(1)
    figure, joints = panels(robot.n, 2, 1.75)
    for j, panel in enumerate(joints):
        panel.plot(time, recording.motion.tau[:, j], color="#B8B8B8", linewidth=3.5, label="measured")
        panel.plot(time, recording.model[:, j], color=ORANGE, linewidth=1.0, label="model")
        panel.plot(time, full[:, j], color=BLUE, linewidth=1.1, label="model + friction")
        panel.set_title(f"{robot.joint_names[j]}   R² {r2[0][j]:.3f}, with friction {r2[1][j]:.3f}", fontsize=10)
        if recording.fitted.any():
            panel.axvspan(0, end_of_fit, color="#F3F3F3", zorder=0, label="friction fitted here")
    label(figure, joints[0], "time [s]")
    save(figure, picture)


if __name__ == "__main__":
    try:
        results = main(tyro.cli(Args))
    except (LogError, torchdq.TorchdqError, OSError) as fault:
        sys.exit(f"{type(fault).__name__}: {fault}")
    sys.exit(0 if all(check.passed for check in results.values()) else 1)
