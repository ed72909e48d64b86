"""Simulated recordings of arms, with faults, for tests of logs, diagnostics and identification; the laws stand here.

A two-link arm whose bodies differ from those described, with viscous and dry friction and correlated noise; any shipped
robot with masses off by 30 %; logs of both, late or filtered; and CSV files of sines known in closed form.
"""

import math
import re
import warnings
from contextlib import contextmanager
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from messages import said
from places import DATA
from scipy import signal

import torchdq
from torchdq import effects
from torchdq.learning import Layout, Log, LogError, LogWarning, Model, Motion, Samples, identify

WIDTH, STEP = 1e-2, 0.02
F64 = torch.float64
ROBOT = torchdq.robots.load("two_link")
REAL = ROBOT.replace(
    mass=ROBOT.mass * torch.tensor([1.2, 0.85], dtype=F64),
    com=ROBOT.com + torch.tensor([[0.03, 0.0, 0.0], [-0.02, 0.0, 0.0]], dtype=F64),
)
VISCOUS, COULOMB = torch.tensor([[0.3, 0.2], [0.8, 0.5]], dtype=F64)


# --- models and findings ---------------------------------------------------------------------------------------------


def plain(sign_width=WIDTH, **options):
    """Model of viscous and Coulomb friction."""
    return Model((effects.Viscous(), effects.Coulomb(sign_width=sign_width)), **options)


def fitted(robot, *rows, prior=1.0, sign_width=WIDTH, **options):
    """Robot identified from signals or motions, with viscous and Coulomb friction and without a selection."""
    model = Model(**options) if "friction" in options else plain(sign_width, **options)
    return identify(robot, Samples(*rows) if len(rows) == 4 else rows[0], model, prior, sign_width)


def whitened(found, truth):
    """Deviations of the base parameters from true ones, in units of their stated covariance [rank]."""
    root = found.base @ found.spread
    off = found.base @ (found.parameters - truth)
    return torch.linalg.solve_triangular(torch.linalg.cholesky(root @ root.T), off[:, None], upper=False)[:, 0]


def with_findings(function, *arguments, **options):
    """Result of a function, and the findings of the warnings about logs that it gave."""
    with warnings.catch_warnings(record=True) as given:
        warnings.simplefilter("always")
        result = function(*arguments, **options)
    return result, [one for warning in given if warning.category is LogWarning for one in warning.message.findings]


def codes(findings):
    """Codes of findings, each once."""
    return list(dict.fromkeys(one.code for one in findings))


PYTHON = re.compile(r"Layout|\w=|[({]'|read_log\(|identify\(|smooth\(")  # what no cure of the command line holds


@contextmanager
def log_refused(code):
    """Context in which a log is refused by a fault of this code, in the words of the snapshot, and those of options."""
    with pytest.raises(LogError) as raised:
        yield
    (fault,) = raised.value.findings
    cure = fault.cure if fault.option is None else fault.option
    assert fault.code == code and not PYTHON.search(cure), fault
    if code not in ("log.damaged", "array.kind"):  # which hold words of other libraries
        said(str(raised.value))
        said(raised.value.text(command_line=True))


def recordings(name):
    """Folder of recordings of a real arm; the test is skipped without it."""
    if not (DATA / name).exists():
        pytest.skip(f"no recording {DATA / name}; TORCHDQ_DATA names the folder that holds it")
    return DATA / name


# --- a two-link arm --------------------------------------------------------------------------------------------------


def states(motions=5, rows=400, seed=0, joints=2):
    """Sums of sinusoids [motions, rows, n], fast and slow ones: positions, velocities, accelerations."""
    g = torch.Generator().manual_seed(seed)
    w = math.pi / 5 * torch.arange(1, 6, dtype=F64)
    size = (0.3 + torch.rand(motions, 1, joints, 5, generator=g, dtype=F64)) / w
    phase = 6.3 * torch.rand(motions, 1, joints, 5, generator=g, dtype=F64)
    angle = w * STEP * torch.arange(rows, dtype=F64)[:, None, None] + phase
    return (size * angle.sin()).sum(-1), (size * w * angle.cos()).sum(-1), -(size * w * w * angle.sin()).sum(-1)


def waves(seed, size, rates, spread, seconds):
    """Sums of sines at 50 Hz [rows, 2], of these sizes or up to twice them, and the generator that drew them."""
    g, t = torch.Generator().manual_seed(seed), torch.arange(0, seconds, STEP, dtype=F64)[:, None, None]
    u, v, phase = torch.rand(3, 2, len(rates), generator=g, dtype=F64)
    sizes, w = size + size * u, rates + spread * v
    angle = w * t + 6.3 * phase
    return [(x * sizes).sum(-1) for x in (angle.sin(), w * angle.cos(), -w * w * angle.sin())], g


def noise(shape, memory, seed=0):
    """Noise [motions, rows, n] of variance one, with a correlation that falls by a factor from row to row."""
    x = np.random.default_rng(seed).normal(size=shape)
    x[:, 1:] *= (1 - memory**2) ** 0.5
    return torch.from_numpy(signal.lfilter([1.0], [1.0, -memory], x, axis=1))


def sign(qd, width=WIDTH):
    """Smooth sign of velocities."""
    return qd / (qd**2 + width**2).sqrt()


def dry(qd):
    """Viscous and Coulomb friction of the arm."""
    return VISCOUS * qd + COULOMB * sign(qd)


def torques(robot, q, qd, qdd, friction=dry, size=0.1, memory=0.8, seed=0):
    """Measured torques [motions, rows, n], with noise."""
    return torchdq.inverse_dynamics(robot, q, qd, qdd) + friction(qd) + size * noise(q.shape, memory, seed)


def motion_of(*signals, **options):
    """Motion of signals [rows, n]: positions, velocities, accelerations, torques, and signs of velocities."""
    return Motion(STEP * np.arange(len(signals[0])), *(x.numpy() for x in signals), **options)


def late_log(late, seed, rate=100.0, seconds=30.0):
    """Log of the arm whose torques are stamped late [s]."""
    g = np.random.default_rng(seed)
    w = 2 * math.pi * 0.1 * np.arange(1, 6)
    size, phase = (0.2 + 0.5 * g.uniform(size=(2, 5))) / np.sqrt(w), 6.3 * g.uniform(size=(2, 5))
    time = np.arange(0, seconds, 1 / rate)

    def at(t):
        angle = w * t[:, None, None] + phase
        x = (size * np.sin(angle), size * w * np.cos(angle), -size * w**2 * np.sin(angle))
        return [torch.from_numpy(one.sum(-1)) for one in x]

    q, qd, _ = at(time)
    past = at(time - late)
    tau = torchdq.inverse_dynamics(REAL, *past) + dry(past[1]) + 0.1 * torch.from_numpy(g.normal(size=q.shape))
    return Log(Path(f"log{seed}"), Layout(), time, q.numpy(), qd.numpy(), tau.numpy(), 0)


# --- any robot -------------------------------------------------------------------------------------------------------


@cache
def recorded(name, seed=0, rows=600, noise=0.05):
    """Description, and samples of a robot whose masses are off by 30 %, with dry friction of 30 % of the torque."""
    robot = torchdq.robots.load(name).replace(on_unphysical="repair")  # one of them breaks the triangle inequality
    g = torch.Generator().manual_seed(seed)
    n, t = robot.n, torch.linspace(0, 30, rows, dtype=F64)[:, None, None]
    q, qd, qdd, real = _moved(robot, t, g)
    tau = torchdq.inverse_dynamics(real, q, qd, qdd)
    size = tau.std(0)
    tau = tau + 0.3 * size.clamp_min(0.02 * size.max()) * (sign(qd) + 0.3 * qd)
    return robot, Samples(q, qd, qdd, tau + noise * tau.std(0) * torch.randn(rows, n, generator=g, dtype=F64))


def noisy_log(robot, rate, seed, width=1e-3):
    """Log of such a robot, whose dry friction is this sharp; and its viscous and Coulomb friction."""
    g = torch.Generator().manual_seed(seed)
    t = torch.arange(0, 40, 1 / rate, dtype=F64)[:, None, None]

    def white(x):
        return torch.randn(x.shape, generator=g, dtype=F64)

    q, qd, qdd, real = _moved(robot, t, g)
    tau = torchdq.inverse_dynamics(real, q, qd, qdd)
    coulomb = 0.3 * tau.std(0).clamp_min(0.02 * tau.std(0).max())
    viscous = 0.3 * coulomb
    tau = tau + viscous * qd + coulomb * sign(qd, width)
    signals = (q + 1e-5 * white(q), qd + 1e-3 * white(q), tau + 0.05 * tau.std(0) * white(q))
    return Log(Path("log"), Layout(), t[:, 0, 0].numpy(), *(x.numpy() for x in signals), 0), viscous, coulomb


def _moved(robot, t, g):
    """Motion of a robot at times [rows, 1, 1], and a robot with masses off by 30 %."""

    def uniform(*shape):
        return torch.rand(shape, generator=g, dtype=F64)

    n, w = robot.n, 2 * math.pi * 0.1 * torch.arange(1, 6).double()
    size, phase = (0.2 + 0.5 * uniform(n, 5)) / w.sqrt(), w * t + 6.3 * uniform(n, 5)
    factor = 0.7 + 0.6 * uniform(n)
    real = robot.replace(mass=factor * robot.mass, inertia=factor[:, None] * robot.inertia)
    return (size * phase.sin()).sum(-1), (size * w * phase.cos()).sum(-1), -(size * w**2 * phase.sin()).sum(-1), real


# --- files -----------------------------------------------------------------------------------------------------------

RATE = 2 * np.pi * 0.7  # [rad/s] of the motion in files


def sines(time, n=7):
    """q, qd, qdd and tau of n joints, each [rows, n]."""
    phase = RATE * time[:, None] + np.arange(n)
    return np.sin(phase), RATE * np.cos(phase), -(RATE**2) * np.sin(phase), 3 * np.cos(phase) + np.arange(n)


def table(seconds=5.0, n=7):
    """Rows of a log at about 1 kHz, in uneven steps: time, q, qd, tau."""
    time = np.cumsum(np.random.default_rng(0).uniform(0.4e-3, 1.6e-3, round(1000 * seconds)))
    q, qd, _, tau = sines(time, n)
    return np.column_stack([time, q, qd, tau])


def arrays(n=3, time=None):
    """Arrays of the same motion, with accelerations, or at other times."""
    time = table(n=n)[:, 0] if time is None else time
    return dict(zip(("time", "q", "qd", "qdd", "tau"), (time, *sines(time, n)), strict=True))


def names(n, blocks=("q", "qd", "tau")):
    """Header of a file."""
    return ["time", *(f"{block}{joint}" for block in blocks for joint in range(1, n + 1))]


def written(path, rows, heads):
    """CSV file of rows under a header, or without."""
    np.savetxt(path, rows, delimiter=",", fmt="%.12g", header=",".join(heads or ()), comments="")
    if heads is None:
        path.write_text(path.read_text().removeprefix("\n"))
    return path


TIME = np.arange(0, 4, 0.002)
KNOWN = arrays(2, TIME)
HEADS = names(2)
TABLE = np.column_stack([KNOWN[name] for name in ("time", "q", "qd", "tau")])


def assert_holds(found, known=KNOWN, atol=1e-9):
    """The log has these arrays."""
    for name in ("time", "q", "qd", "tau"):
        np.testing.assert_allclose(getattr(found, name), known[name], atol=atol)
