"""Learning model errors: nine controllers of one arm, from no model to the true one.

    python examples/06_residual_learning.py
    python examples/06_residual_learning.py --quick [--device cuda]

The arm is simulated by MuJoCo, not by torchdq. Both read the xArm7's URDF, but MuJoCo's arm has other masses (each by
10 to 20 %), a payload of 1.5 kg, rotor inertia, damping and dry friction, and two effects that no model here has a term
for: friction that is higher at low speed, and cables that pull. Motors lag by 5 ms, and all measurements are noisy.
Every seed is another such arm, with its own motions and networks.

A model is learned from measurements of some motions, filtered as those of a real arm would be. Hyperparameters (sizes,
weight decay, early stopping) are selected on other motions, and the results are on yet others: the mean over joints of
the squared torque error over the torque's variance, and the tracking error under
tau = model(q, qd, qdd_des) + kp e + kd ed with the same kp and kd in every row. No row is a lower bound of the torque
errors: true parameters do not model the effect of the filter on the measurements, and a network can learn it.
"""

import json
import sys
import time
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, replace
from importlib.metadata import files
from itertools import pairwise
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
import torch
import tyro
from devices import OnDevice, fit_on
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator, NullFormatter
from pictures import BLUE, GREY, ORANGE, prepare, save
from rich.console import Console
from rich.progress import Progress
from rich.table import Table
from scipy.signal import butter, sosfiltfilt
from scipy.stats import bootstrap
from torch import Tensor, nn

import torchdq
from torchdq.learning import Samples

STEP, LAG = 2e-3, 5e-3  # [s] of the control loop, of the motors
CUTOFF = 10.0  # [Hz] of the filter that readings pass before anything is learned from them
WIDTH = 0.02  # [rad/s] over which modelled dry friction changes sign, about the noise of the filtered velocities
CENTRE = np.array([0.0, -0.3, 0.0, 1.2, 0.0, 0.9, 0.0])  # [rad] about which the arm moves
ELSEWHERE = np.array([0.9, 0.6, 0.9, 0.8, 0.9, 0.6, 0.9])  # [rad] from there, out of distribution
PAYLOAD = """<held>
  <link name="payload"><inertial>
    <origin xyz="0 0.02 0.06"/><mass value="1.5"/>
    <inertia ixx="0.002" iyy="0.002" izz="0.001" ixy="0" ixz="0" iyz="0"/>
  </inertial></link>
  <joint name="grasp" type="fixed"><parent link="link_eef"/><child link="payload"/></joint>
</held>"""


@dataclass
class Args(OnDevice):
    seeds: int = 5
    """Number of arms."""
    samples: tuple[int, ...] = (100, 300, 1000, 3000, 10000)
    """Numbers of samples to learn from, upwards: the same motions, thinned. The table is of the last one."""
    seconds: float = 12.0
    """Length of every motion [s]."""
    steps: int = 1500
    """Optimiser steps of every training."""
    jobs: int = 2
    """Processes to share the work."""
    quick: bool = False
    """One arm, few samples and steps: to see that it runs."""
    per_joint: bool = False
    """Print the torque errors joint by joint, too."""
    json: Path | None = None
    """File for all numbers."""
    out: Path = Path("out")
    """Folder of the picture."""


# --- the arm: MuJoCo, and what is wrong about the URDF ---------------------------------------------------------------


def description() -> ET.Element:
    """URDF of the xArm7 without meshes and limits."""
    path = next(Path(f.locate()) for f in files("example-robot-data") if f.name == "xarm7.urdf")
    root = ET.fromstring(path.read_bytes())
    for parent in (root, *root.findall("link"), *root.findall("joint")):
        for child in list(parent):
            if child.tag in ("visual", "collision", "limit", "ros2_control"):
                parent.remove(child)
    for joint in root.findall("joint[@type='revolute']"):
        joint.set("type", "continuous")
    return root


def nominal_robot() -> torchdq.Robot:
    """Robot as its URDF describes it."""
    return torchdq.Robot.from_urdf(ET.tostring(description(), encoding="unicode"), tip="link_eef")


def altered(root: ET.Element, rng: np.random.Generator) -> str:
    """The URDF of an arm with other masses and a payload at its tip."""
    for inertial in root.iter("inertial"):
        factor = 1 + rng.choice((-1, 1)) * rng.uniform(0.1, 0.2)
        for element in (inertial.find("mass"), inertial.find("inertia")):
            element.attrib.update({name: str(factor * float(x)) for name, x in element.attrib.items()})
    root.extend(ET.fromstring(PAYLOAD))
    return ET.tostring(root, encoding="unicode")


class Reference(NamedTuple):
    """Wanted motions, [time, motions, n] each."""

    q: np.ndarray
    qd: np.ndarray
    qdd: np.ndarray


class Readings(NamedTuple):
    """Measurements along the way, [time, motions, n] each."""

    q: np.ndarray
    qd: np.ndarray
    tau: np.ndarray
    error: np.ndarray  # error of tracking, not a reading: the true position counts


Controller = Callable[[np.ndarray, np.ndarray, Reference], np.ndarray]


class Plant:
    """The arm that is controlled and learned."""

    def __init__(self, seed: int):
        rng = np.random.default_rng(seed)
        text = altered(description(), rng)
        self.robot = torchdq.Robot.from_urdf(text, tip="link_eef")  # with the true masses, for the last row alone
        size = np.array([50.0, 50.0, 30.0, 30.0, 30.0, 20.0, 20.0])  # [N m], rated torque of the motors
        self.kp, self.kd = 4.0 * size, 0.3 * size
        self.noise = 0.02 * size  # [N m] of a torque reading
        self.damping = size / 20 * rng.uniform(0.5, 1.5, 7)
        self.friction = size / 20 * rng.uniform(0.5, 1.5, 7)
        self.armature = size / 200 * rng.uniform(0.5, 1.5, 7)
        self.breakaway = 0.4 * self.friction
        self.pull, self.rest = size / 40 * rng.uniform(0.5, 1.5, 7), rng.uniform(-1.5, 1.5, 7)
        self.model = mujoco.MjModel.from_xml_string(text)
        self.model.opt.timestep = STEP / 2
        self.model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        self.model.dof_damping[:] = self.damping
        self.model.dof_frictionloss[:] = self.friction
        self.model.dof_armature[:] = self.armature
        self.model.dof_solref[:, 0] = STEP  # dry friction as dry as the steps allow; by default it creeps at 0.1 rad/s

    def unmodelled(self, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
        """Torque that no model has a term for: more friction at low speed, and cables."""
        slow = np.exp(-((qd / 0.15) ** 2)) * qd / np.sqrt(qd**2 + WIDTH**2)
        return -self.breakaway * slow - self.pull * np.sin(1.5 * (q - self.rest))

    def run(self, controller: Controller, wanted: Reference, rng: np.random.Generator) -> Readings:
        """Run motions under a controller, which sees noisy readings and whose torques arrive late."""
        arms = [mujoco.MjData(self.model) for _ in wanted.q[0]]
        for arm, q, qd in zip(arms, wanted.q[0], wanted.qd[0], strict=True):
            arm.qpos[:], arm.qvel[:] = q, qd
        motor, rows = None, []
        for k in range(len(wanted.q)):
            now = Reference(*(x[k] for x in wanted))
            q, qd = np.stack([arm.qpos for arm in arms]), np.stack([arm.qvel for arm in arms])
            q_read = q + rng.normal(0, 1e-4, q.shape)
            qd_read = qd + rng.normal(0, 1e-2, q.shape)
            tau = controller(q_read, qd_read, now)
            motor = tau if motor is None else motor + (1 - np.exp(-STEP / LAG)) * (tau - motor)
            applied = motor + self.unmodelled(q, qd)
            for arm, torque in zip(arms, applied, strict=True):
                arm.qfrc_applied[:] = torque
                mujoco.mj_step(self.model, arm, 2)
            rows.append((q_read, qd_read, motor + rng.normal(0, self.noise, q.shape), now.q - q))
        return Readings(*map(np.array, zip(*rows, strict=True)))


# --- motions, and what is learned from -------------------------------------------------------------------------------


def waves(rng: np.random.Generator, motions: int, seconds: float, speed: float, centre: np.ndarray) -> Reference:
    """Sums of five sinusoids at every joint, about a centre that differs a little from motion to motion."""
    time = np.arange(0, seconds, STEP)[:, None, None, None]
    shape = (motions, 7, 5)
    rate = 2 * np.pi * speed * rng.uniform(0.05, 0.4, shape)
    amplitude, phase = 0.8 * rng.dirichlet(np.ones(5), shape[:2]), rng.uniform(0, 2 * np.pi, shape)
    s, c = amplitude * np.sin(rate * time + phase), amplitude * np.cos(rate * time + phase)
    middle = centre + rng.uniform(-0.2, 0.2, shape[:2])
    return Reference(middle + s.sum(-1), (rate * c).sum(-1), (-(rate**2) * s).sum(-1))


def learnable(readings: Readings) -> Samples:
    """Samples at 100 Hz of motions, filtered without delay and differentiated; half a second at either end is cut."""
    low_pass = butter(4, CUTOFF, fs=1 / STEP, output="sos")
    qd, tau = (sosfiltfilt(low_pass, x, axis=0) for x in (readings.qd, readings.tau))
    signals = (readings.q, qd, np.gradient(qd, STEP, axis=0), tau)
    inside = slice(round(0.5 / STEP), -round(0.5 / STEP), round(0.01 / STEP))
    return Samples(*(torch.tensor(x[inside].reshape(-1, 7).copy(), dtype=torch.float32) for x in signals))


class Data(NamedTuple):
    """Samples of different motions."""

    train: Samples
    valid: Samples
    near: Samples  # test set of motions like those in `train`
    far: Samples  # test set, faster and elsewhere


def recorded(plant: Plant, nominal: torchdq.Robot, args: Args, rng: np.random.Generator) -> Data:
    """Motions of the arm under the controller that the URDF gives."""
    motions = -(-args.samples[-1] // round(100 * (args.seconds - 1)))
    controller = following(plant, lambda *state: torchdq.inverse_dynamics(nominal, *state))

    def motion(count: int, speed: float = 1.0, centre: np.ndarray = CENTRE) -> Samples:
        return learnable(plant.run(controller, waves(rng, count, args.seconds, speed, centre), rng))

    return Data(motion(motions), motion(2), motion(3), motion(3, 1.6, CENTRE + ELSEWHERE))


def following(plant: Plant, model: "Model") -> Controller:
    """The model's torque for the wanted acceleration, and the same feedback for every model."""

    def controller(q: np.ndarray, qd: np.ndarray, wanted: Reference) -> np.ndarray:
        with torch.inference_mode():
            tau = model(*(torch.tensor(x, dtype=torch.float32) for x in (q, qd, wanted.qdd)))
        return tau.double().numpy() + plant.kp * (wanted.q - q) + plant.kd * (wanted.qd - qd)

    return controller


# --- models: torques from q, qd and qdd ------------------------------------------------------------------------------


Model = Callable[[Tensor, Tensor, Tensor], Tensor]


class BlackBox(nn.Module):
    """Torques by a network of all joints that knows no mechanics; what it sees and returns is standardised."""

    def __init__(self, data: Samples, width: int):
        super().__init__()
        x = self.features(*data[:3])
        self.register_buffer("mean", x.mean(0))
        self.register_buffer("std", x.std(0))
        self.register_buffer("offset", data.tau.mean(0))
        self.register_buffer("scale", data.tau.std(0))
        sizes = (x.shape[1], width, width)
        hidden = [layer for a, b in pairwise(sizes) for layer in (nn.Linear(a, b), nn.SiLU())]
        self.network = nn.Sequential(*hidden, nn.Linear(width, 7))

    @staticmethod
    def features(q: Tensor, qd: Tensor, qdd: Tensor) -> Tensor:
        """The state, and the direction of motion as friction sees it."""
        return torch.cat([q.sin(), q.cos(), qd, qd / (qd**2 + WIDTH**2).sqrt(), qdd], -1)

    def forward(self, q: Tensor, qd: Tensor, qdd: Tensor) -> Tensor:
        """Torques [..., 7]."""
        return self.offset + self.scale * self.network((self.features(q, qd, qdd) - self.mean) / self.std)


def with_friction(nominal: torchdq.Robot, data: Samples) -> Model:
    """The nominal model and viscous and dry friction, by least squares for every joint."""

    def terms(qd: Tensor) -> Tensor:
        return torch.stack([qd, qd / (qd**2 + WIDTH**2).sqrt()], -1)

    left = data.tau - torchdq.inverse_dynamics(nominal, *data[:3])
    solution = torch.linalg.lstsq(terms(data.qd).transpose(0, 1), left.T[..., None]).solution[..., 0]  # [7, 2]
    return lambda q, qd, qdd: torchdq.inverse_dynamics(nominal, q, qd, qdd) + (terms(qd) * solution).sum(-1)


def truth(plant: Plant) -> Model:
    """Model with the true parameters of the arm; dry friction alone is smoothed."""
    robot = plant.robot.replace(armature=torch.tensor(plant.armature))
    damping, friction = (torch.tensor(x, dtype=torch.float32) for x in (plant.damping, plant.friction))

    def model(q: Tensor, qd: Tensor, qdd: Tensor) -> Tensor:
        unmodelled = torch.as_tensor(plant.unmodelled(q.double().numpy(), qd.double().numpy()), dtype=q.dtype)
        dissipation = damping * qd + friction * qd / (qd**2 + WIDTH**2).sqrt()
        return torchdq.inverse_dynamics(robot, q, qd, qdd) + dissipation - unmodelled

    return model


# --- learning --------------------------------------------------------------------------------------------------------

NOTHING, GRAVITY, NOMINAL, FRICTION = "PD", "PD + gravity", "computed torque", "computed torque + friction"
BLACK, RESIDUAL, PHYSICS, BOTH = "black box", "nominal + residual", "learned physics", "learned physics + residual"
TRUE = "true parameters"
LEARNED = ("mass", "com", "inertia", "friction", "armature")


class Candidate(NamedTuple):
    """A way to learn a model; of several the one with the least validation error is taken."""

    model: nn.Module
    rate: float
    decay: float = 0.0
    prior: float = 0.0


def candidates(nominal: torchdq.Robot, data: Samples, quick: bool) -> Iterator[tuple[str, list[Candidate]]]:
    """Names and candidates of the models that are learned by gradient, in the order they are to be learned in."""
    grid = [(64, 1.0)] if quick else [(width, decay) for width in (64, 256) for decay in (0.3, 3.0)]
    yield BLACK, [Candidate(BlackBox(data, width), 3e-3, decay) for width, decay in grid]
    fixed = torchdq.DQRNEA(nominal, sign_width=WIDTH)
    yield RESIDUAL, [Candidate(torchdq.ResidualDynamics(fixed), 3e-3, decay=1.0)]
    guess = nominal.replace(armature=torch.full((7,), 0.1, dtype=torch.float64))  # the URDF says nothing about rotors
    physics = torchdq.DQRNEA(guess, learn=LEARNED, sign_width=WIDTH)
    yield PHYSICS, [Candidate(physics, 2e-2, prior=1e-4)]
    yield BOTH, [Candidate(torchdq.ResidualDynamics(physics), 3e-3, decay=1.0)]  # beside the last one, as it is


def learned(choices: Sequence[Candidate], train: Samples, valid: Samples, args: Args, seed: int) -> nn.Module:
    """The best of several models by their validation error, trained."""
    errors = []
    for model, rate, decay, prior in choices:
        options = {"rate": rate, "decay": decay, "prior": prior, "seed": seed}
        history = fit_on(args.place, model, train, valid, steps=args.steps, **options)
        errors.append(min(history.valid))
    return choices[int(np.argmin(errors))].model


# --- one arm, one number of samples ----------------------------------------------------------------------------------


class Result(NamedTuple):
    """Result of one model on one arm; None where it makes no torques to compare or was not tried."""

    near: list[float] | None  # squared torque error over variance, per joint
    far: list[float] | None
    track_near: float | None = None  # tracking error, root mean square over time and joints [mrad]
    track_far: float | None = None


def torque_error(model: Model, test: Samples) -> list[float]:
    """Squared torque error over variance, per joint."""
    with torch.no_grad():
        return ((model(*test[:3]) - test.tau).square().mean(0) / test.tau.var(0)).tolist()


def tracking(plant: Plant, model: Model, seed: int, seconds: float) -> list[float]:
    """Tracking errors [mrad] on new motions, like those that were learned from, and faster and elsewhere."""
    errors = []
    for speed, centre in ((1.0, CENTRE), (1.6, CENTRE + ELSEWHERE)):
        rng = np.random.default_rng(1000 + seed)  # the same motions and noise for every model
        readings = plant.run(following(plant, model), waves(rng, 2, seconds, speed, centre), rng)
        errors.append(1e3 * float(np.sqrt((readings.error**2).mean())))
    return errors


def record(seed: int, args: Args) -> tuple[int, Data]:
    """The samples of one arm."""
    return seed, recorded(Plant(seed), nominal_robot(), args, np.random.default_rng(seed))


def study(seed: int, size: int, data: Data, args: Args) -> tuple[int, int, dict[str, Result]]:
    """All models of one arm, learned from so many samples; those of the most samples also control it."""
    torch.manual_seed(seed)
    nominal, plant = nominal_robot(), Plant(seed)
    train = Samples(*(x[torch.linspace(0, len(x) - 1, size).long()] for x in data.train))
    models: dict[str, Model] = {
        NOTHING: lambda q, qd, qdd: torch.zeros_like(q),
        GRAVITY: lambda q, qd, qdd: torchdq.inverse_dynamics(nominal, q),
        NOMINAL: lambda q, qd, qdd: torchdq.inverse_dynamics(nominal, q, qd, qdd),
        FRICTION: with_friction(nominal, train),
    }
    for name, choices in candidates(nominal, train, args.quick):
        models[name] = learned(choices, train, data.valid, args, seed)
    models[TRUE] = truth(plant)
    results = {}
    for name, model in models.items():
        compared = () if name in (NOTHING, GRAVITY) else (data.near, data.far)
        predicted = [torque_error(model, test) for test in compared] or (None, None)
        tracked = tracking(plant, model, seed, args.seconds) if size == args.samples[-1] else ()
        results[name] = Result(*predicted, *tracked)
    return seed, size, results


def finished(function: Callable, rows: Sequence[tuple], jobs: int) -> Iterator:
    """Results of a function for every row of arguments, in any order, in several processes."""
    if jobs == 1:
        yield from (function(*row) for row in rows)
        return
    with ProcessPoolExecutor(jobs, get_context("spawn"), torch.set_num_threads, (1,)) as pool:
        for future in as_completed([pool.submit(function, *row) for row in rows]):
            yield future.result()


# --- all of it -------------------------------------------------------------------------------------------------------

Arms = dict[int, dict[str, Result]]  # by seed and by model
Study = dict[int, Arms]  # by number of samples


def main(args: Args) -> Study:
    """Results of every model, by number of samples and by seed."""
    if args.quick:
        args = replace(args, seeds=1, samples=(300, 2000), seconds=4.0, steps=200, jobs=1)
    threads, start = torch.get_num_threads(), time.perf_counter()
    torch.set_num_threads(1)
    console = Console(width=130)
    found: Study = {size: {} for size in args.samples}
    with Progress(console=console, transient=True) as progress:
        shown = progress.add_task("arms", total=args.seeds)
        data = {}
        for seed, samples in finished(record, [(seed, args) for seed in range(args.seeds)], args.jobs):
            data[seed] = samples
            progress.advance(shown)
        rows = [(seed, size, data[seed], args) for size in reversed(args.samples) for seed in data]
        shown = progress.add_task("models", total=len(rows))
        for seed, size, results in finished(study, rows, args.jobs):
            found[size][seed] = results
            progress.advance(shown)
    torch.set_num_threads(threads)
    size = args.samples[-1]
    console.print(table(found[size], size))
    if args.per_joint:
        console.print(joints(found[size]))
    draw(found, args.out / "residual_learning.png")
    if args.json:
        everything = {"settings": {name: str(x) for name, x in vars(args).items()}, "results": plain(found)}
        args.json.write_text(json.dumps(everything, indent=1))
    console.print(f"{time.perf_counter() - start:.0f} s")
    return found


def numbers(arms: Arms, name: str, field: str) -> list[float]:
    """A number of a model for every arm; torque errors are means over joints."""
    values = [getattr(results[name], field) for _, results in sorted(arms.items())]
    return [float(np.mean(value)) for value in values if value is not None]


def interval(values: Sequence[float]) -> tuple[float, float]:
    """95 % bootstrap interval of the mean over arms."""
    if len(values) < 2:
        return values[0], values[0]
    low, high = bootstrap((values,), np.mean, method="percentile", rng=np.random.default_rng(0)).confidence_interval
    return float(low), float(high)


def table(arms: Arms, size: int) -> Table:
    """All models on all arms."""
    title = f"{len(arms)} arms, {size} samples: mean over arms [95 % bootstrap interval]"
    columns = ("torque error near", "torque error far", "tracking near, mrad", "tracking far, mrad")
    result = Table("model", *columns, title=title)
    for name in next(iter(arms.values())):
        result.add_row(name, *(cell(numbers(arms, name, field)) for field in Result._fields))
    return result


def cell(values: Sequence[float]) -> str:
    """Mean and interval in words."""
    if not values:
        return "-"
    low, high = interval(values)
    return f"{np.mean(values):.3g}" + (f" [{low:.3g}, {high:.3g}]" if len(values) > 1 else "")


def joints(arms: Arms) -> Table:
    """Torque errors near, joint by joint, means over arms."""
    result = Table("model", *(f"joint {j}" for j in range(1, 8)), title="torque error near")
    for name in next(iter(arms.values())):
        rows = [results[name].near for results in arms.values() if results[name].near is not None]
        if rows:
            result.add_row(name, *(f"{x:.3g}" for x in np.mean(rows, axis=0)))
    return result


def plain(found: Study) -> dict:
    """The study as JSON can hold it."""
    return {
        size: {seed: {name: result._asdict() for name, result in results.items()} for seed, results in arms.items()}
        for size, arms in found.items()
    }


def draw(found: Study, path: Path) -> None:
    """Torque errors by number of samples, near and far, and tracking errors."""
    prepare()
    figure = plt.figure(figsize=(9, 8), layout="constrained")
    upper, lower = figure.subfigures(2, 1)
    near, far = upper.subplots(1, 2, sharey=True)
    draw_curves(near, found, "near")
    draw_curves(far, found, "far")
    near.set(title="Motions like those learned from", ylabel="torque error, MSE / variance")
    far.set_title("Faster and elsewhere")
    upper.legend(*near.get_legend_handles_labels(), loc="outside upper left", ncols=3)
    draw_tracking(lower.subplots(), found[max(found)])
    save(figure, path)


def draw_curves(axis: Axes, found: Study, field: str) -> None:
    """Torque errors by number of samples, with intervals; lines for those that hardly depend on it."""
    for name, colour in ((BLACK, GREY), (RESIDUAL, "#E69F00"), (PHYSICS, BLUE), (BOTH, ORANGE)):
        values = [numbers(arms, name, field) for arms in found.values()]
        axis.loglog(list(found), np.mean(values, -1), "o-", color=colour, linewidth=2, markersize=4, label=name)
        axis.fill_between(list(found), *np.transpose([interval(x) for x in values]), color=colour, alpha=0.15, lw=0)
    for name, line in ((FRICTION, "k:"), (TRUE, "k--")):
        axis.loglog(list(found), [np.mean(numbers(arms, name, field)) for arms in found.values()], line, label=name)
    axis.set_xlabel("samples")
    axis.xaxis.set_minor_formatter(NullFormatter())


def draw_tracking(axis: Axes, arms: Arms) -> None:
    """Tracking errors of all models, with intervals."""
    names = list(next(iter(arms.values())))
    for shift, field, colour, label in (
        (-0.2, "track_near", BLUE, "like those learned from"),
        (0.2, "track_far", "#56B4E9", "faster and elsewhere"),
    ):
        values = [numbers(arms, name, field) for name in names]
        means = np.mean(values, -1)
        spread = np.abs(np.transpose([interval(x) for x in values]) - means)
        style = {"color": colour, "label": label, "error_kw": {"elinewidth": 1}}
        axis.barh(np.arange(len(names)) + shift, means, 0.38, xerr=spread, **style)
    axis.set_yticks(range(len(names)), names)
    axis.invert_yaxis()
    axis.set(xscale="log", xlabel="tracking error, RMS [mrad]", title="Control with the same feedback")
    axis.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axis.xaxis.set_major_formatter("{x:g}")
    axis.xaxis.set_minor_formatter(NullFormatter())
    axis.grid(visible=False, axis="y")
    axis.legend()


if __name__ == "__main__":
    arms = main(tyro.cli(Args)).popitem()[1]
    sys.exit(0 if np.mean(numbers(arms, BOTH, "track_near")) < np.mean(numbers(arms, FRICTION, "track_near")) else 1)
