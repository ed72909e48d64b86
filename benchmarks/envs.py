"""Speed of scenes and environments: steps per second beside MuJoCo's C, on one thread.

    python benchmarks/envs.py [--quick] [--json FILE] [--page]

A seven-joint arm with gravity, damping and dry friction, the same URDF for both. MuJoCo steps its batch in C
(`mujoco.rollout`), as torchdq does (`Scene.rollout`): no Python stands between the steps. Environments are called step
by step. The systems of a row run in turns.
"""

from __future__ import annotations

import os
import xml.etree.ElementTree as ET
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import front_page
import mujoco
import numpy as np
import report
import torch
from mujoco import rollout
from peers import bare, timed, urdf

import torchdq
from torchdq import Scene, effects
from torchdq.envs import RobotVectorEnv, Simulation
from torchdq.scene import integrators

BATCH, DT, STEPS = 4096, 2e-3, 5
SHORT = 1e-5  # for an explicit integrator: damping over inertia of the arm's light links is 1e5 per second


@dataclass
class Row:
    """Steps of one system."""

    what: str
    system: str
    dtype: str
    nanoseconds: float  # per step of one arm


def mujoco_model(path: Path, integrator: int, dt: float, friction: bool) -> mujoco.MjModel:
    """The arm in MuJoCo, without what it has to show, with or without its friction loss."""
    root = bare(path)
    for joint in root.findall("joint"):
        limit = joint.find("limit")
        if limit is not None:  # neither side simulates limits here
            joint.set("type", "continuous" if joint.get("type") == "revolute" else joint.get("type", ""))
    model = mujoco.MjModel.from_xml_string(ET.tostring(root, encoding="unicode"))
    model.opt.timestep = dt
    model.opt.integrator = integrator
    model.dof_frictionloss[:] = model.dof_frictionloss if friction else 0.0
    return model


def mujoco_steps(model: mujoco.MjModel):
    """STEPS steps of a batch in C."""
    data = mujoco.MjData(model)
    rng = np.random.default_rng(0)
    size = mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    state = np.zeros((BATCH, size))
    state[:, 1 : 1 + model.nq + model.nv] = rng.uniform(-1, 1, (BATCH, model.nq + model.nv))
    return lambda: rollout.rollout(model, data, state, nstep=STEPS)


def torchdq_steps(scene: Scene, dtype: torch.dtype):
    """STEPS steps of a batch."""
    generator = torch.Generator().manual_seed(0)
    q, qd, u = (2 * torch.rand(BATCH, scene.n, generator=generator, dtype=dtype) - 1 for _ in range(3))
    state, series = scene.start(q, qd), u.expand(STEPS, BATCH, scene.n)
    return lambda: scene.rollout(state, series, ends=True)


def gradient_steps(scene: Scene, dtype: torch.dtype, steps: int):
    """Gradient of a rollout in its torques."""
    generator = torch.Generator().manual_seed(0)
    q = 2 * torch.rand(BATCH, scene.n, generator=generator, dtype=dtype) - 1
    u = torch.zeros(steps, BATCH, scene.n, dtype=dtype, requires_grad=True)
    state = scene.start(q)

    def call() -> None:
        u.grad = None
        scene.rollout(state, u).q[-1].square().sum().backward()

    return call


def environment_steps(env: RobotVectorEnv):
    """One step of an environment, rewards, observations and resets included, some in every step."""
    env.reset(seed=0)
    state = env.get_state()
    ages = torch.randint(250, state["steps"].shape, generator=torch.Generator().manual_seed(0))
    env.set_state({**state, "steps": ages.to(env.dtype)})
    action = torch.zeros(env.num_envs, env.single_action_space.shape[0], dtype=torch.float32)
    return lambda: env.step(action)


def alone(call: Callable[[], object], what: str, steps: int, seconds: float) -> Row:
    """Row of torchdq in float32, of a call that makes so many steps."""
    return Row(what, "torchdq", "float32", timed({"torchdq": call}, steps, seconds)["torchdq"])


def steps_table(rows: list[tuple[str, float, float, float]]) -> str:
    """Steps [ns] of torchdq, of MuJoCo, and of MuJoCo without dry friction, as a table."""
    lines = ["| step | torchdq | other package | ratio | ratio without dry friction |", "|---|---|---|---|---|"]
    for what, ours, theirs, without in rows:
        ratios = f"{theirs / ours:.0f} x | {without / ours:.0f} x"
        lines.append(f"| {what} | {ours:.0f} ns | {theirs:.0f} ns, MuJoCo | {ratios} |")
    return "\n".join(lines)


def main() -> None:
    arguments = report.parser(__doc__, quick="shorter measurements").parse_args()
    torch.set_num_threads(1)
    seconds = 0.5 if arguments.quick else 2.0
    path = urdf("example-robot-data", "xarm7.urdf")
    robot = torchdq.Robot.from_urdf(path, on_unphysical="ignore", tip="link7")
    parts = (effects.Gravity(), effects.Viscous(), effects.Coulomb())
    found: list[Row] = []
    compared: list[tuple[str, float, float, float]] = []
    lines: list[report.Line] = []

    matched = [
        ("Euler", mujoco.mjtIntegrator.mjINT_EULER, integrators.LinearlyImplicit(), DT),
        ("RK4", mujoco.mjtIntegrator.mjINT_RK4, integrators.RungeKutta4(), SHORT),
    ]
    for name, method, integrator, dt in matched:
        peers = {"MuJoCo": True, "MuJoCo without dry friction": False}
        calls = {x: mujoco_steps(mujoco_model(path, method, dt, friction)) for x, friction in peers.items()}
        for dtype in (torch.float64, torch.float32):
            calls[f"torchdq, {dtype}"] = torchdq_steps(Scene(robot, parts, integrator=integrator, dt=dt), dtype)
        times = timed(calls, BATCH * STEPS, seconds)
        what = f"step, {name}, gravity, damping, friction"
        found += [Row(what, system, "float32" if "float32" in system else "float64", x) for system, x in times.items()]
        theirs, without = (times[system] for system in peers)
        for dtype in ("float64", "float32"):
            compared.append((f"{name}, {dtype}", times[f"torchdq, torch.{dtype}"], theirs, without))

    for task in ("reach", "track"):
        env = RobotVectorEnv(BATCH, task=task, robot=robot, effects=parts, action="torque", simulation=Simulation(DT))
        row = alone(environment_steps(env), f"environment, {task}", BATCH, seconds)
        found.append(row)
        lines.append((f"{task} environment, steps per second, float32", f"{1e3 / row.nanoseconds:.1f} million"))

    scene = Scene(robot, parts, integrator=integrators.LinearlyImplicit(), dt=DT)
    gradient = gradient_steps(scene, torch.float32, 20)
    row = alone(gradient, "gradient of a rollout of 20 steps", 20 * BATCH, seconds)
    found.append(row)
    lines.append(("rollout of 20 steps with gradient in the torques, float32", f"{row.nanoseconds:.0f} ns per step"))

    table = f"{steps_table(compared)}\n\n{report.table('torchdq alone', lines)}"
    description = scene.describe(BATCH, torch.float32)
    print(f"{table}\n\n{description}")
    everything = {"compared": compared, "lines": lines, "rows": [asdict(row) for row in found]}
    report.finish(arguments, __file__, table, report.machine("mujoco"), **everything)
    front_page.follow(arguments)


if __name__ == "__main__":
    main()
