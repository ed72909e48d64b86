"""Robots with loops measured: accuracy by the step, gaps, float32, and price, beside MuJoCo.

    python benchmarks/loops.py                        # the four-bar linkage
    python benchmarks/loops.py --menagerie FOLDER     # and the 2F-85 and Cassie of a clone of MuJoCo Menagerie
    python benchmarks/loops.py --files a.xml b.xml    # and other MJCF files

Robots of files are held at their base and move for a second under gravity, from home, with their springs and dampers,
without contacts, limits and motors; springs close the drivers of the gripper. Errors are those of the body's frame that
is farthest from where RungeKutta4 has it with steps so small that MuJoCo agrees. Times are processor times of one
thread, of both packages in turns, the least of several.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.append(str(Path(__file__).parents[1] / "tests" / "scene"))
sys.path.append(str(Path(__file__).parents[1] / "tests" / "tools"))

import mujoco
import numpy as np
import report
import torch
from torch import Tensor

import torchdq
from torchdq import Scene, dq, effects
from torchdq.scene import integrators

F32, F64 = torch.float32, torch.float64
BATCH, STEPS, TURNS, SECONDS = 4096, 8, 10, 1.0
IMPLICIT, EXPLICIT = integrators.LinearlyImplicit(), integrators.RungeKutta4()
MENAGERIE = ("robotiq_2f85/2f85.xml", "agility_cassie/cassie.xml")
DRIVE = (2.0, 0.5, 0.05)  # spring, its rest and damping at joints *_driver_joint [N m/rad, rad, N m s/rad]
FINEST = 1 / 16e3  # step of the reference [s]
STIFF = 1e-4  # time constant of MuJoCo's constraints in its own reference [s], with steps of half of it


# --- four bars -------------------------------------------------------------------------------------------------------


def four_bar() -> None:
    """Four-bar linkage beside its one equation."""
    from test_closures import crank, moved

    exact = crank(SECONDS)
    for name, integrator in (("RungeKutta4", EXPLICIT), ("implicit", IMPLICIT)):
        for h in (5e-4, 1e-3, 5e-3):
            scene, states = moved(integrator, h, 20.0)
            error = abs(float(states.q[round(SECONDS / h) - 1, 0]) - exact)
            energy = scene.energy(states).sum(-1)
            gap = torchdq.closure_errors(scene.robot, states.q).distance.max()
            lost = float((energy - energy[0]).abs().max() / energy[0].abs())
            print(
                f"{name:12s} {1e3 * h:4.1f} ms: error after 1 s {error:.1e} rad; in 20 s gap {float(gap):.1e} m, "
                f"energy changes by {lost:.1e}"
            )


# --- robots of files -------------------------------------------------------------------------------------------------


class Linkage(NamedTuple):
    """Robot of a file, here and in MuJoCo."""

    robot: torchdq.Robot
    parts: tuple[effects.Effect, ...]
    spec: Any  # mujoco.MjSpec of the same numbers
    bodies: list[str]

    def scene(self, h: float, integrator: integrators.Integrator = IMPLICIT) -> Scene:
        return Scene(self.robot, self.parts, integrator=integrator, dt=h)

    def moved(
        self, h: float, integrator: integrators.Integrator = IMPLICIT, dtype: torch.dtype = F64
    ) -> tuple[Tensor, float]:
        """Joint positions after the time, and the largest gap on the way [m]."""
        scene = self.scene(h, integrator)
        q = scene.rollout(scene.start(self.home().to(dtype)), steps=round(SECONDS / h)).q
        return q[-1], float(torchdq.closure_errors(self.robot, q).distance.max())

    def home(self) -> Tensor:
        home = self.robot.home
        return torch.zeros(self.robot.n, dtype=F64) if home is None else home.double()

    def places(self, q: Tensor) -> np.ndarray:
        return dq.translation(torchdq.forward_kinematics(self.robot, q, self.bodies)).numpy()

    def model(self, h: float, integrator: str = "", stiff: float = 0.0) -> Any:
        """MuJoCo's model with a step, and the file's integrator and constraints unless others are given."""
        spec = self.spec.copy()
        spec.option.timestep = h
        if integrator:
            spec.option.integrator = mujoco.mjtIntegrator.__members__[f"mjINT_{integrator.upper()}"]
        for equality in spec.equalities if stiff else ():
            equality.solref, equality.solimp = [stiff, 1.0], [0.9999, 0.9999, 0.001, 0.5, 2.0]
        return spec.compile()

    def in_mujoco(self, model: Any) -> tuple[np.ndarray, float]:
        """Places of the bodies after the time, and the gap there [m]."""
        data = mujoco.MjData(model)
        mujoco.mj_step(model, data, round(SECONDS / model.opt.timestep))
        mujoco.mj_forward(model, data)
        if any(warning.number for warning in data.warning):  # MuJoCo resets what diverges
            return np.full((len(self.bodies), 3), math.nan), math.nan
        gap = [data.efc_pos[i] for i in range(data.nefc) if data.efc_type[i] == mujoco.mjtConstraint.mjCNSTR_EQUALITY]
        return np.array([data.body(name).xpos for name in self.bodies]), float(np.abs(gap).max())


def linkage(path: Path) -> Linkage:
    """Robot of a file without what is not compared, with masses that its meshes have."""
    spec = mujoco.MjSpec.from_file(str(path))
    for element in (*spec.geoms, *spec.sites, *spec.tendons):
        element.material = ""
    _without(spec, "keys", "materials", "textures")
    model = spec.compile()
    for body in spec.bodies[1:]:
        i = body.id
        body.mass, body.ipos, body.iquat = model.body_mass[i], model.body_ipos[i], model.body_iquat[i]
        body.inertia, body.explicitinertial = model.body_inertia[i], True
        body.fullinertia = [math.nan] * 6
    _without(
        spec, "sensors", "actuators", "tendons", "pairs", "excludes", "geoms", "cameras", "lights", "meshes", "hfields"
    )
    of_joints = [x for x in spec.equalities if x.type == mujoco.mjtEq.mjEQ_JOINT]
    for element in (*of_joints, *(x for x in spec.joints if x.type == mujoco.mjtJoint.mjJNT_FREE)):
        spec.delete(element)
    for joint in spec.joints:
        joint.limited, joint.frictionloss = mujoco.mjtLimited.mjLIMITED_FALSE, 0.0
        if joint.name.endswith("driver_joint"):
            (joint.stiffness[0], joint.springref, damping) = DRIVE
            joint.damping[0] += damping
    model = spec.compile()
    robot = torchdq.Robot.from_mjcf(spec.to_xml())
    springs = {
        model.joint(i).name: (float(model.jnt_stiffness[i]), float(model.qpos_spring[model.jnt_qposadr[i]]))
        for i in range(model.njnt)
    }
    springs |= dict.fromkeys({*robot.joint_names} - {*springs}, (0.0, 0.0))  # hinges of a ball joint
    stiffness, rest = zip(*(springs[name] for name in robot.joint_names), strict=True)
    parts = (effects.Gravity(), effects.RotorInertia(), effects.Viscous(), effects.Spring(stiffness, rest))
    return Linkage(robot, parts, spec, [body.name for body in spec.bodies[1:]])


def _without(spec: Any, *kinds: str) -> None:
    for kind in kinds:
        for element in list(getattr(spec, kind)):
            spec.delete(element)


def of_file(path: Path) -> None:
    """Accuracy of a robot by the step, here and in MuJoCo; float32; price."""
    it = linkage(path)
    exact, coarser = (it.places(it.moved(h, EXPLICIT)[0]) for h in (FINEST, 2 * FINEST))
    theirs, _ = it.in_mujoco(it.model(STIFF / 2, "RK4", STIFF))
    start = it.places(torchdq.closed(it.robot, it.home()))

    def off(places: np.ndarray, of: np.ndarray = exact) -> tuple[float, str]:
        """Largest distance of a frame [mm], and whose."""
        far = 1e3 * np.linalg.norm(places - of, axis=-1)
        return float(far.max()), it.bodies[int(far.argmax())]

    moves, where = off(start)
    print(f"{path.stem}: {it.robot.n} coordinates, {len(it.robot.closures)} closures; {where} moves by {moves:.0f} mm")
    print(
        f"the reference, of steps of {1e3 * FINEST:g} ms, differs by {off(coarser)[0]:.1e} mm from that of twice as "
        f"long ones, and by {off(theirs)[0]:.1e} mm from MuJoCo's"
    )
    for h in (1e-3, 5e-3):
        for name, integrator in (("implicit", IMPLICIT), ("RungeKutta4", EXPLICIT)):
            q, gap = it.moved(h, integrator)
            (error, where), single = off(it.places(q)), it.moved(h, integrator, F32)[0]
            print(
                f"{1e3 * h:.0f} ms, {name:12s}: {error:8.4f} mm ({where}), gap {1e3 * gap:.1e} mm, "
                f"float32 off by {float((single.double() - q).abs().max()):.1e} rad"
            )
        places, gap = it.in_mujoco(it.model(h))
        error, where = off(places)
        print(f"{1e3 * h:.0f} ms, MuJoCo      : {error:8.4f} mm ({where}), gap {1e3 * gap:.1e} mm")
    price(it)


def price(it: Linkage) -> None:
    """Times of a step of 1 ms, at states of the motion."""
    scene, calls = it.scene(1e-3), dict[str, tuple[Callable[[], object], int]]()
    tree = Scene(it.robot.replace(closures=()), it.parts, dt=1e-3)
    for name, where, dtype in (("float64", scene, F64), ("float32", scene, F32), ("tree alone, float32", tree, F32)):
        state = scene.rollout(scene.start(it.home()), steps=100).last
        rows = type(state)._make(None if x is None else x.to(dtype).expand(BATCH, -1).contiguous() for x in state)
        calls[name] = (lambda w=where, s=rows: w.rollout(s, steps=STEPS, ends=True)), BATCH * STEPS
    model = it.model(1e-3)
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 100)
    calls["MuJoCo"] = (lambda: mujoco.mj_step(model, data, 300)), 300
    best = report.least(calls, TURNS)
    print(f"operations {scene.count().total}, of the tree {tree.count().total}")
    print(", ".join(f"{name} {x:.0f} ns ({best['MuJoCo'] / x:.0f} x)" for name, x in best.items()))


def main() -> None:
    """Print the parts."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--menagerie", type=Path, help="clone of MuJoCo Menagerie")
    options.add_argument("--files", type=Path, nargs="+", default=[], help="MJCF files of robots with loops")
    given = options.parse_args()
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    print(report.machine("mujoco"))
    print(f"\n{four_bar.__doc__}")
    four_bar()
    for path in (*(given.menagerie / name for name in MENAGERIE if given.menagerie), *given.files):
        print()
        of_file(path)


if __name__ == "__main__":
    main()
