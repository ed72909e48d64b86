"""Parameters from rollouts against `mujoco.sysid`, on the five-joint arm of its own tests, in turns on the same cores.

    python benchmarks/sysid.py [--quick] [--json FILE]

The task is `test_arm_recover_armature` of the tests of mujoco.sysid, which need `pip install mujoco[sysid]`: two
seconds of torques, positions and velocities at 500 Hz; five rotor inertias, from 0.01. torchdq gets the positions
alone, and not the state at the start; it has one thread, mujoco.sysid as many as there are cores. The residual of both
answers is that of mujoco.sysid's own function. A run contains everything but the recording and compilation of the
scene's programs, once per machine; the time of the first run is printed beside it.

Then the stated errors: arms with friction and noisy positions, fitted over and over; the deviations in their stated
covariance are chi-square.
"""

from __future__ import annotations

import contextlib
import importlib.util
import io
import os
import statistics
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import report
import torch
from mujoco import sysid
from scipy import stats

import torchdq
from torchdq.envs import Scene, effects
from torchdq.learning import Recording, RolloutFit, fit_rollout

DT, ROUNDS = 0.002, 15
DEGREES = 6  # parameters of the noisy arm: degrees of freedom of the chi-square


def their_tests() -> ModuleType:
    """Module of the tests that come with mujoco.sysid, which holds the arm."""
    path = Path(str(sysid.__file__)).parent / "tests" / "test_integration.py"
    spec = importlib.util.spec_from_file_location("sysid_tests", path)
    if spec is None or spec.loader is None:
        raise SystemExit(f"{path} is missing; install mujoco[sysid]")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def torques(t: np.ndarray) -> np.ndarray:
    """Torques [rows, 5] of the task."""
    size, frequency, phase = np.array([(5, 4, 3, 2, 1), (0.5, 0.7, 0.4, 0.9, 0.6), (0, 0.5, 1, 1.5, 2)])
    return size * np.sin(2 * np.pi * frequency * t[:, None] + phase)


class Task:
    """The arm, its log, and the two ways to find its rotor inertias."""

    def __init__(self) -> None:
        tests = their_tests()
        self.joints, self.true = tests.JOINT_NAMES, tests.TRUE_ARMATURE
        self.spec, self.start, self.commands, self.measured = tests._generate_data(tests.ARM_XML, torques, 2.0)
        robot = torchdq.Robot.from_mjcf(tests.ARM_XML)
        parts = (effects.Gravity((0.0, 0.0, -9.81)), effects.Viscous(), effects.RotorInertia(0.01))
        self.scene = Scene(robot, parts, dt=DT)
        rows = len(self.measured.times)
        q = self.measured.data[:, : robot.n]  # every sensor is read at the start of its step
        self.log = Recording(DT * np.arange(rows), q, {"torque": self.commands.data[:rows]})

    def parameters(self) -> Any:
        """Parameters of mujoco.sysid at their start."""
        found = sysid.ParameterDict()
        for name in self.joints:

            def change(spec: Any, parameter: Any, joint: str = name) -> None:
                spec.joint(joint).armature = parameter.value[0]

            found.add(sysid.Parameter(name, nominal=self.true[name], min_value=0.001, max_value=1.0, modifier=change))
            found[name].value[:] = 0.01
        return found

    def residuals(self) -> Callable[..., Any]:
        """Function of mujoco.sysid that returns the residuals at some parameters."""
        pieces = sysid.ModelSequences("arm", self.spec, "sinusoidal", self.start, self.commands, self.measured)
        return sysid.build_residual_fn(models_sequences=[pieces])

    def theirs(self) -> np.ndarray:
        """Rotor inertias by mujoco.sysid."""
        with contextlib.redirect_stdout(io.StringIO()):
            found, _ = sysid.optimize(self.parameters(), self.residuals(), optimizer="mujoco", verbose=False)
        return np.array([found[name].value[0] for name in self.joints])

    def ours(self) -> np.ndarray:
        """Rotor inertias by torchdq."""
        return fit_rollout(self.scene, self.log, "RotorInertia.inertia", segment=None).estimate.numpy()

    def left(self, values: np.ndarray) -> float:
        """Root of the sum of squares of mujoco.sysid's residuals at some rotor inertias."""
        return float(np.linalg.norm(np.concatenate(self.residuals()(values, self.parameters())[0])))


def timed(run: Callable[[], np.ndarray]) -> tuple[float, np.ndarray]:
    """Time of a run [s], and what it returns."""
    begin = time.perf_counter()
    found = run()
    return time.perf_counter() - begin, found


def compared(rounds: int) -> dict[str, float]:
    """Ratio of the times, and what is left of the residual."""
    task = Task()
    first, ours = timed(task.ours)
    theirs = task.theirs()
    times = [(timed(task.theirs)[0], statistics.median([timed(task.ours)[0] for _ in range(3)])) for _ in range(rounds)]
    a, b = (np.array(column) for column in zip(*times, strict=True))
    start = task.left(np.full(5, 0.01))
    return {
        "first run of torchdq [s]": first,
        "mujoco.sysid [ms]": 1e3 * float(np.median(a)),
        "torchdq [ms]": 1e3 * float(np.median(b)),
        "mujoco.sysid, least [ms]": 1e3 * float(a.min()),
        "torchdq, least [ms]": 1e3 * float(b.min()),
        "ratio": float(np.median(a / b)),
        "ratio of the least": float(a.min() / b.min()),
        "residual at the start": start,
        "residual of mujoco.sysid": task.left(theirs),
        "residual of torchdq": task.left(ours),
    }


def noisy(runs: int) -> list[float]:
    """Deviations of fits from the true parameters, in their stated covariance."""
    robot, dt = torchdq.robots.load("two_link"), 0.01
    t = dt * torch.arange(301, dtype=torch.float64)
    torque = 8 * torch.stack([(5 * t).sin() + 0.5 * (11 * t).cos(), 0.6 * (7 * t).cos()], -1)

    def scene(viscous: Any, coulomb: Any, rotor: Any) -> Scene:
        parts = (effects.Viscous(viscous), effects.Coulomb(coulomb, 0.05), effects.RotorInertia(rotor))
        return Scene(robot, (effects.Gravity(), *parts), dt=dt)

    real, guess = scene((0.5, 0.3), (0.4, 0.2), (0.05, 0.03)), scene(0.1, 0.1, 0.01)
    state = real.start(torch.zeros(2, dtype=torch.float64))
    q = torch.cat([state.q[None], real.rollout(state, torque[:-1]).q])
    true = torch.tensor([0.5, 0.3, 0.4, 0.2, 0.05, 0.03], dtype=torch.float64)
    found = []
    for seed in range(runs):
        noise = 1e-3 * torch.randn(q.shape, dtype=q.dtype, generator=torch.Generator().manual_seed(seed))
        fit: RolloutFit = fit_rollout(
            guess,
            Recording(t, q + noise, {"torque": torque}),
            ("Viscous.coefficient", "Coulomb.coulomb", "RotorInertia.inertia"),
        )
        off = fit.estimate - true
        found.append(float(off @ torch.linalg.solve(fit.covariance, off)))
    return found


def main() -> tuple[dict[str, float], list[float]]:
    arguments = report.parser(__doc__, quick="3 rounds and 20 noisy runs", page=False).parse_args()
    if not hasattr(sysid, "create_initial_state"):
        raise SystemExit("mujoco.sysid has not all that it needs; run pip install 'mujoco[sysid]'")
    warnings.simplefilter("ignore", DeprecationWarning)
    torch.set_num_threads(1)
    rounds, runs = (3, 20) if arguments.quick else (ROUNDS, 200)
    found = compared(rounds)
    print("| quantity | value |\n|---|---|")
    for name, value in found.items():
        print(f"| {name} | {value:.3g} |")
    squares = noisy(runs)
    p = float(stats.kstest(squares, stats.chi2(DEGREES).cdf).pvalue)
    print(f"| chi-square per degree of freedom, {runs} runs | {np.mean(squares) / DEGREES:.3f} |")
    print(f"| probability of a distribution as far from chi-square | {p:.2g} |")
    facts = report.machine("mujoco", "scipy")
    print(f"\n{report.words(facts)}, torch threads {torch.get_num_threads()}")
    report.into_json(arguments.json, machine=facts, compared=found, squares=squares)
    return found, squares


if __name__ == "__main__":
    main()
