"""Parameters from rollouts against `mujoco.sysid`, on the five-joint arm of its own tests, in turns on the same cores.

    python benchmarks/sysid.py [--quick] [--json FILE]

The task is `test_arm_recover_armature` of the tests of mujoco.sysid, which need `pip install mujoco[sysid]`: two
seconds of torques, positions and velocities at 500 Hz; five rotor inertias, from 0.01. torchdq gets the positions
alone, and not the state at the start; it has one thread, mujoco.sysid as many as there are cores. The residual of both
answers is that of mujoco.sysid's own function. A run contains everything but the recording and compilation of the
scene's programs, once per machine; the time of the first run is printed beside it.

Then the stated errors: an arm of three joints that MuJoCo moves in steps of 0.25 ms, with viscous or dry friction, and
noisy positions of it, fitted over and over; the deviations in their stated covariance are chi-square.
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
from typing import Any, NamedTuple

os.environ.setdefault("OMP_NUM_THREADS", "1")

import mujoco
import numpy as np
import report
import torch
from mujoco import sysid
from scipy import stats

import torchdq
from torchdq import Scene, effects
from torchdq.learning import Recording, RolloutFit, fit_rollout

DT, ROUNDS = 0.002, 15
DEGREES = 6  # parameters of the noisy arm: degrees of freedom of the chi-square
FINE, NOISE, WIDTH = 2.5e-4, 2e-4, 0.05  # [s] of MuJoCo's steps, [rad] and [rad/s]
VISCOUS, COULOMB, ROTORS = np.array([(1.0, 0.8, 0.3), (0.8, 0.6, 0.3), (0.1, 0.08, 0.04)])
THREE_JOINTS = f"""<mujoco><option timestep="{FINE}" integrator="RK4"/><worldbody>
  <body><joint name="a" axis="0 0 1" armature="0.1"/><inertial pos="0 0 .1" mass="3" diaginertia=".02 .02 .02"/>
    <body pos="0 0 .2"><joint name="b" axis="0 1 0" armature=".08"/>
      <inertial pos=".2 .02 0" mass="2.5" diaginertia=".01 .03 .03"/>
      <body pos=".4 0 0"><joint name="c" axis="0 1 0" armature=".04"/>
        <inertial pos=".15 0 .02" mass="1.2" diaginertia=".005 .01 .01"/></body></body></body></worldbody>
  <actuator><motor joint="a"/><motor joint="b"/><motor joint="c"/></actuator></mujoco>"""


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
        # the recording is of MuJoCo's own steps, as a scene takes them by default
        how = {"segment": None, "integrator": self.scene.integrator}
        return fit_rollout(self.scene, self.log, "RotorInertia.inertia", **how).estimate.numpy()

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


def recorded(dt: float, seconds: float, coulomb: np.ndarray) -> Recording:
    """Recording of the three joints, with the smooth friction of the effects."""
    model = mujoco.MjModel.from_xml_string(THREE_JOINTS)
    data, time = mujoco.MjData(model), dt * np.arange(round(seconds / dt) + 1)
    slow, fast = 2 * np.pi * np.array([(0.5, 0.7, 1.1), (1.3, 1.9, 2.3)])
    torque = np.array([6, 8, 2]) * (np.sin(slow * time[:, None]) + 0.6 * np.sin(fast * time[:, None] + 1))
    data.qpos[:], q = (0.0, 0.3, 0.5), []

    def friction(_: Any, data: Any) -> None:
        data.qfrc_passive[:] -= (VISCOUS + coulomb / np.sqrt(data.qvel**2 + WIDTH**2)) * data.qvel

    mujoco.set_mjcb_passive(friction)
    try:
        for row in torque:
            q.append(data.qpos.copy())
            data.ctrl[:] = row
            mujoco.mj_step(model, data, round(dt / FINE))
    finally:
        mujoco.set_mjcb_passive(None)
    return Recording(time, np.stack(q), {"torque": torque})


class Errors(NamedTuple):
    """Stated errors of fits of a recording whose noise differs."""

    squares: list[float]  # deviations from the true parameters, in their stated covariance
    seconds: float  # of a fit, the first left out
    integrator: str  # that most fits took


def noisy(runs: int, dt: float, dry: bool) -> Errors:
    """Errors of fits with viscous friction and rotors unknown, or viscous and dry friction."""
    log = recorded(dt, 4.0 if dt > 1e-3 else 2.0, COULOMB if dry else np.zeros(3))
    friction = effects.Coulomb(0.3, WIDTH) if dry else effects.RotorInertia(0.02)
    rotors = (effects.RotorInertia(torch.tensor(ROTORS)),) if dry else ()
    robot = torchdq.Robot.from_mjcf(THREE_JOINTS)
    guess = Scene(robot, (effects.Gravity(), effects.Viscous(0.3), friction, *rotors), dt=dt)
    learn = ("Viscous.coefficient", "Coulomb.coulomb" if dry else "RotorInertia.inertia")
    true = torch.from_numpy(np.concatenate([VISCOUS, COULOMB if dry else ROTORS]))
    squares, times, rules = [], [], []
    for seed in range(runs):
        q = np.asarray(log.q) + NOISE * np.random.default_rng(seed).normal(size=np.shape(log.q))
        begin = time.process_time()
        fit: RolloutFit = fit_rollout(guess, log._replace(q=q), learn)
        times.append(time.process_time() - begin)
        steps = fit.scene.substeps
        rules.append(f"`{fit.scene.integrator}`" + (f", {steps} substeps" if steps > 1 else ""))
        off = fit.estimate - true
        squares.append(float(off @ torch.linalg.solve(fit.covariance, off)))
    return Errors(squares, statistics.median(times[1:]), statistics.mode(rules))


def main() -> tuple[dict[str, float], dict[str, Errors]]:
    arguments = report.parser(__doc__, quick="3 rounds and 20 noisy runs of each case", page=False).parse_args()
    if not hasattr(sysid, "create_initial_state"):
        raise SystemExit("mujoco.sysid has not all that it needs; run pip install 'mujoco[sysid]'")
    warnings.simplefilter("ignore", DeprecationWarning)
    torch.set_num_threads(1)
    rounds, runs = (3, 20) if arguments.quick else (ROUNDS, 100)
    found = compared(rounds)
    print("| quantity | value |\n|---|---|")
    for name, value in found.items():
        print(f"| {name} | {value:.3g} |")
    cases = {
        f"{1e3 * dt:g} ms, {'dry' if dry else 'viscous'}": noisy(runs, dt, dry)
        for dry in (False, True)
        for dt in (0.001, 0.005, 0.02)
    }
    print(f"\n| rows and `dt`, friction | chi-square per parameter, {runs} runs | steps | CPU time of a fit |")
    print("|---|---|---|---|")
    for name, case in cases.items():
        size = np.mean(case.squares) / DEGREES
        print(f"| {name} | {size:.2f} | {case.integrator} | {case.seconds:.2g} s |")
    whole = [x for case in cases.values() for x in case.squares]
    p = float(stats.kstest(whole, stats.chi2(DEGREES).cdf).pvalue)
    print(f"\nprobability of a distribution as far from chi-square: {p:.2g}")
    facts = report.machine("mujoco", "scipy")
    print(f"\n{report.words(facts)}, torch threads {torch.get_num_threads()}")
    report.into_json(arguments.json, machine=facts, compared=found, errors=cases)
    return found, cases


if __name__ == "__main__":
    main()
