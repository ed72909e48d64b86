"""Contact measured: price beside MuJoCo, gradients, accuracy by the step, stability, creep, limits of servos.

    python benchmarks/contact.py [--quick] [--parts NAME ...] [--go2 URDF] [--g1 URDF] [--store]

The robots are those of example-robot-data, or the files that are given; their feet are spheres, in MuJoCo as well,
which reads the same files. Times are CPU times of one thread, of both packages in turns. `--store` writes what was
measured into benchmarks/results/contact.json, from which `python benchmarks/effects.py --write` writes the page.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import math
import os
import re
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import mujoco
import numpy as np
import report
import torch
from pages.contact_tables import STORED, TABLES
from torch import Tensor

import torchdq
from torchdq import Scene, dq, effects
from torchdq.robot import ContactPoint, Robot
from torchdq.scene import State

F32, F64 = torch.float32, torch.float64
G, MU, K = 9.81, 0.5, 2e4  # gravity, friction and stiffness of the accuracy tables
STEPS = (1e-3, 5e-3, 1e-2)
STAND = torch.tensor([0.0, 0.8, -1.5] * 4, dtype=F64)  # Go2
LEGS = ("FL", "FR", "RL", "RR")
FEET = tuple(ContactPoint(f"{leg}_foot", radius=0.022) for leg in LEGS)
LIMBS = tuple(ContactPoint(f"{leg}_{part}", radius=0.03) for part in ("calf", "thigh", "hip") for leg in LEGS)
SOLE = ((-0.05, 0.025), (-0.05, -0.025), (0.12, 0.03), (0.12, -0.03))  # of a foot of G1 [m]
SOLES = tuple(
    ContactPoint(f"{side}_ankle_roll_link", (x, y, -0.03), 0.005) for side in ("left", "right") for x, y in SOLE
)
UPPER = tuple(
    ContactPoint(f"{side}_{part}_link", radius=0.04)
    for part in ("knee", "hip_pitch", "elbow", "wrist_yaw")
    for side in ("left", "right")
)


# --- robots ----------------------------------------------------------------------------------------------------------


def file_of(given: Path | None, name: str) -> Path:
    """File that is given, or the one of example-robot-data."""
    if given is not None:
        return given
    for path in importlib.metadata.files("example-robot-data") or []:
        if path.name == f"{name}.urdf":
            return Path(str(path.locate()))
    raise SystemExit(f"there is no {name}.urdf: install example-robot-data, or give the file")


def in_mujoco(path: Path, points: tuple[ContactPoint, ...], damping: float, rotor: float, dt: float = 5e-3) -> Any:
    """MuJoCo's model of a file on a plane, whose shapes are replaced by spheres."""
    text = path.read_text(encoding="utf-8")
    for word in ("visual", "collision", "mujoco"):
        text = re.sub(rf"<{word}>.*?</{word}>", "", text, flags=re.S)
    spec = mujoco.MjSpec.from_string(
        text.replace("</robot>", '<mujoco><compiler fusestatic="false"/></mujoco></robot>')
    )
    spec.worldbody.first_body().add_freejoint()
    friction = [0.8, 0.005, 1e-4]
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 0.1], friction=friction)
    bodies = {body.name: body for body in spec.bodies}
    for p in points:
        sphere = {"size": [p.radius, 0, 0], "pos": p.center, "friction": friction, "mass": 0}
        bodies[p.frame].add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, **sphere)
    model = spec.compile()
    model.opt.timestep, model.opt.integrator = dt, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    model.dof_damping[6:], model.dof_armature[6:] = damping, rotor
    return model


def rigid(mass: float, inertia: tuple[float, float, float]) -> Robot:
    """Single body."""
    xx, yy, zz = inertia
    return Robot.from_urdf(
        f"""<robot name="body"><link name="body"><inertial><mass value="{mass}"/>
        <inertia ixx="{xx}" ixy="0" ixz="0" iyy="{yy}" iyz="0" izz="{zz}"/></inertial></link></robot>""",
        base="floating",
    )


BALL = rigid(1.0, (0.004, 0.004, 0.004)), (ContactPoint("body", radius=0.1),)
BOX = (
    rigid(1.0, (0.0101 / 3, 0.0101 / 3, 0.02 / 3)),
    tuple(ContactPoint("body", (x, y, -0.01)) for x in (-0.1, 0.1) for y in (-0.1, 0.1)),
)


def tensor(x: Any, dtype: torch.dtype = F64) -> Tensor:
    """Parameter that is an argument, so that all its values share a program."""
    return torch.as_tensor(x, dtype=dtype)


def ground(body: tuple[Robot, tuple[ContactPoint, ...]], dt: float, **parameters: Any) -> Scene:
    """Scene of a single body on the ground."""
    usual = {"normal": (0.0, 0.0, 1.0), "stiffness": K, "dissipation": 1.0, "friction": MU}
    given = {name: tensor(x) for name, x in {**usual, **parameters}.items()}
    return Scene(body[0], (effects.Gravity(), effects.Contact(body[1], **given)), dt=dt)


def above(height: float, *batch: int, turn: Tensor | None = None) -> Tensor:
    """Poses above the origin."""
    turn = tensor([1.0, 0.0, 0.0, 0.0]) if turn is None else turn
    return dq.from_pose(turn.expand(*batch, 4), tensor([0.0, 0.0, height]).expand(*batch, 3)).contiguous()


def begun(scene: Scene, X: Tensor, V: Any = None) -> State:
    """Start of a single body."""
    V = torch.zeros(*X.shape[:-1], 6, dtype=F64) if V is None else tensor(V).expand(*X.shape[:-1], 6)
    return scene.start(torch.zeros(*X.shape[:-1], 0, dtype=F64), X_WB=X, V_WB_B=V)


def after(
    scene: Scene, state: State, seconds: float, watch: Callable[[State], None] | None = None, **inputs: Any
) -> State:
    """State after a time."""
    with torch.no_grad():
        for _ in range(round(seconds / scene.dt)):
            state = scene.step(state, **inputs)
            if watch is not None:
                watch(state)
    return state


def place(state: State) -> Tensor:
    """Positions of the base."""
    return dq.translation(state.X_WB)


def legged(
    robot: Robot, points: tuple[ContactPoint, ...], dt: float, dtype: torch.dtype, kp: float, kd: float, **more: Any
) -> Scene:
    """Scene of a robot with servos, whose parameters are tensors."""
    given = {name: tensor(x, dtype) for name, x in {"stiffness": K, **more}.items()}
    servo = effects.Servo(tensor(kp, dtype), tensor(kd, dtype))
    parts = (effects.Gravity(), effects.RotorInertia(0.01), servo, effects.Contact(points, **given))
    return Scene(robot, parts, dt=dt)


# --- price -----------------------------------------------------------------------------------------------------------


def cpu(call: Callable[[], object], calls: int) -> float:
    """CPU time of a call [s]."""
    start = time.process_time()
    for _ in range(calls):
        call()
    return (time.process_time() - start) / calls


def price(files: dict[str, Path], quick: bool) -> list[dict[str, Any]]:
    """Steps of Go2 and G1 by the number of points, in float32, beside MuJoCo's with the usual number in contact."""
    rows = []
    for name, sets, usual, height, kp, kd, rotor in (
        ("Go2", (FEET[:0], FEET, FEET + LIMBS[:4], FEET + LIMBS), FEET, 0.31, 40.0, 1.0, 0.01),
        ("G1", (SOLES[:0], SOLES, SOLES + UPPER), SOLES, 0.79, 300.0, 5.0, 0.03),
    ):
        robot = Robot.from_urdf(str(files[name]), base="floating")
        model = in_mujoco(files[name], usual, kd, rotor)
        data = mujoco.MjData(model)
        pose = STAND.numpy() if name == "Go2" else np.zeros(robot.n)
        data.qpos[:7], data.qpos[7:] = [0, 0, height, 1, 0, 0, 0], pose
        for _ in range(20):
            data.qfrc_applied[6:] = kp * (pose - data.qpos[7:])
            mujoco.mj_step(model, data)
        start, count, bare = (data.qpos.copy(), data.qvel.copy()), int(data.ncon), 0
        for points in sets:
            parts = (effects.Gravity(), effects.RotorInertia(rotor), effects.Servo(kp, kd))
            parts += (effects.Contact(points, stiffness=K),) if points else ()
            scene = Scene(robot, parts, dt=5e-3)
            rows.append({"robot": name, "points": len(points), "in contact": count})
            rows[-1] |= _beside(scene, model, data, start, tensor(pose, F32), height, 20 if quick else 1000)
            bare = bare or rows[-1]["operations"]
            rows[-1]["over none"] = rows[-1]["operations"] / bare
            print(rows[-1], flush=True)
    return rows


def _beside(
    scene: Scene, model: Any, data: Any, start: tuple[Any, Any], pose: Tensor, height: float, rounds: int
) -> dict[str, float]:
    """Operations and time of a step of 4096 samples, and MuJoCo's time, in turns."""
    B = 4096
    target = pose.expand(B, -1).contiguous()
    state = scene.start(target, X_WB=above(height, B).to(F32))

    def theirs() -> None:
        data.qpos[:], data.qvel[:] = start
        for _ in range(20):
            data.qfrc_applied[6:] = 0
            mujoco.mj_step(model, data)

    with torch.no_grad():
        state = after(scene, state, 4 * scene.dt, target=target)
        turns = [(cpu(lambda: scene.step(state, target=target), 1) / B, cpu(theirs, 1) / 20) for _ in range(rounds)]
    ours, other = (min(x) for x in zip(*turns, strict=True))  # other load on the machine only adds
    return {"operations": scene.count().total, "ns": 1e9 * ours, "MuJoCo ns": 1e9 * other, "ratio": other / ours}


def gradient(files: dict[str, Path], quick: bool) -> list[dict[str, Any]]:
    """Gradient of 24 steps of a standing robot: time over that of the rollout, and error against differences."""
    rows = []
    for name, points, height, kp, kd in (("Go2", FEET, 0.31, 40.0, 1.0), ("G1", SOLES, 0.79, 300.0, 5.0)):
        robot = Robot.from_urdf(str(files[name]), base="floating")
        pose = STAND if name == "Go2" else torch.zeros(robot.n, dtype=F64)
        contact = effects.Contact(points, stiffness=K)
        scene = Scene(robot, (effects.Gravity(), effects.RotorInertia(0.02), effects.Servo(kp, kd), contact), dt=5e-3)
        ratio, error = _differentiated(scene, pose, height, 3 if quick else 8)
        rows.append({"robot": name, "ratio": ratio, "error": error})
        print(rows[-1], flush=True)
    return rows


def _differentiated(scene: Scene, pose: Tensor, height: float, rounds: int) -> tuple[float, float]:
    """Time of the gradient of 24 steps over the rollout's, 512 samples in float32, and its error in float64."""

    def end(target: Tensor) -> Tensor:
        B, dtype = len(target), target.dtype
        state = scene.start(pose.to(dtype).expand(B, -1), X_WB=above(height, B).to(dtype))
        last = scene.rollout(state, target=target.expand(24, *target.shape)).last
        return last.q.square().sum(-1) + last.V_WB_B.square().sum(-1)

    target = pose.to(F32).expand(512, -1).clone().requires_grad_()
    end(target).sum().backward()
    forward, both = [], []
    for _ in range(rounds):
        with torch.no_grad():
            forward.append(cpu(lambda: end(target), 1))
        both.append(cpu(lambda: end(target).sum().backward(), 1))
    at = (pose + 0.1 * torch.cos(torch.arange(scene.n, dtype=F64))).requires_grad_()
    (found,) = torch.autograd.grad(end(at[None]).sum(), at)
    with torch.no_grad():
        step = 1e-6 * torch.eye(scene.n, dtype=F64)
        difference = (end(at + step) - end(at - step)) / 2e-6
    return min(both) / min(forward), float((difference - found).abs().max() / found.abs().max())


# --- accuracy --------------------------------------------------------------------------------------------------------


def accuracy(files: dict[str, Path], quick: bool) -> list[dict[str, Any]]:
    """Accuracy at 1, 5 and 10 ms, against analysis and MuJoCo."""
    return [
        {"what": what, "expected": expected, "found": [measure(dt) for dt in STEPS]}
        for what, expected, measure in (
            ("sliding acceleration on a slope of 1.1 friction angles, over analysis", "1", lambda h: _slope(h, 1.1)[0]),
            ("creep on a slope of 0.9 friction angles [mm/s]", "0", lambda h: _slope(h, 0.9)[1]),
            ("sliding distance from 2 m/s, over v^2 / (2 mu g)", "1", _slid),
            ("speed of a ball that slid and rolls, over 5/7", "1", _rolled),
            ("depth at rest, over m g / (4 k)", "1", _sunk),
            ("restitution of a ball, c = 0.5 s/m, k = 20 kN/m, 1 m/s", f"{_bounce():.3f}", _bounced),
            (
                "friction impulse of a ball that lands at 1 m/s and slides at 8 m/s, over mu times the normal impulse",
                f"1 ({_impact_of_mujoco():.2f} MuJoCo)",
                _impact,
            ),
            ("the same at a stiffness of 4 m / h^2", "1", lambda h: _impact(h, 4 / h**2)),
            ("height gained by 64 boxes that tumble down, without friction and damping [mm]", "0", _gained),
            ("friction of a wiping Panda, over mu f_n", "1", _wiped),
            ("height of a jump of Go2 [m]", f"{_jump_of_mujoco(files):.2f} (MuJoCo)", lambda h: _jumped(files, h)),
        )
    ]


_CORNERS = [(x, y, z) for x in (-0.2, 0.2) for y in (-0.05, 0.05) for z in (-0.1, 0.1)]


def _slope(dt: float, share: float) -> tuple[float, float]:
    """Acceleration over g (sin - mu cos), and creep [mm/s], of a box on a slope."""
    angle = tensor(share * math.atan(MU))
    normal = torch.stack([-angle.sin(), 0 * angle, angle.cos()])
    turn = torch.stack([(angle / 2).cos(), 0 * angle, -(angle / 2).sin(), 0 * angle])
    scene = ground(BOX, dt, normal=normal)
    first = after(scene, begun(scene, dq.from_pose(turn, 0.01 * normal)[None]), 0.5)
    last = after(scene, first, 1.0)
    exact = G * (float(angle.sin()) - MU * float(angle.cos()))
    speeds = [float(state.V_WB_B[0, 3]) for state in (first, last)]
    return abs(speeds[1] - speeds[0]) / exact, 1e3 * float((place(last) - place(first)).norm())


def _slid(dt: float) -> float:
    scene = ground(BOX, dt)
    state = after(scene, begun(scene, above(0.01 - G / (4 * K), 1), [0, 0, 0, 2.0, 0, 0]), 1.0)
    return float(place(state)[0, 0]) / (4 / (2 * MU * G))


def _rolled(dt: float) -> float:
    scene = ground(BALL, dt)
    state = after(scene, begun(scene, above(0.1 - G / K, 1), [0, 0, 0, 1.0, 0, 0]), 1.0)
    return float(state.V_WB_B[0, 3:].norm()) * 7 / 5


def _sunk(dt: float) -> float:
    scene = ground(BOX, dt)
    return float(scene.contacts(after(scene, begun(scene, above(0.012, 1)), 2.0)).depth.mean()) * 4 * K / G


def _bounce() -> float:
    """Restitution of the law in continuous time, by steps of 1 us of its own."""
    d, v, h = 0.0, 1.0, 1e-6
    while d >= 0:
        a = G - max(K * d * (1 + 0.5 * v), 0.0)
        d, v = d + h * (v + h / 2 * a), v + h * a
    return -v


def _bounced(dt: float) -> float:
    scene, tops = ground(BALL, dt, dissipation=0.5), [0.0]
    start = begun(scene, above(0.1001, 1), [0, 0, 0, 0, 0, -1.0])
    after(scene, start, 0.06, lambda state: tops.append(float(state.V_WB_B[0, 5])))
    return max(tops)


def _impact(dt: float, k: float = K) -> float:
    """Momentum that friction took over the first 60 ms, over mu times what the ground gave upwards."""
    scene = ground(BALL, dt, stiffness=k, friction=0.2)
    end = after(scene, begun(scene, above(0.1001, 1), [0, 0, 0, 8.0, 0, -1.0]), 0.06)
    v = dq.rotate(dq.rotation(end.X_WB), end.V_WB_B[:, 3:])[0]
    return float((8.0 - v[0]) / (0.2 * (v[2] + 1.0 + G * 0.06)))


def _impact_of_mujoco() -> float:
    """The same in MuJoCo, with its default ground, at steps of 2 ms."""
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><geom type="plane" size="0 0 1" friction="0.2"/><body pos="0 0 0.1001"><freejoint/>'
        '<geom type="sphere" size="0.1" mass="1" friction="0.2"/></body></worldbody></mujoco>'
    )
    data = mujoco.MjData(model)
    data.qvel[:3] = 8.0, 0.0, -1.0
    mujoco.mj_step(model, data, 30)
    return float((8.0 - data.qvel[0]) / (0.2 * (data.qvel[2] + 1.0 + G * 0.06)))


def _gained(dt: float) -> float:
    """Largest height above the start of 64 boxes of low inertia over a second [mm], by their energy."""
    random, (robot, points) = torch.Generator().manual_seed(0), BOX
    corners = tuple(ContactPoint(point.frame, (x, y, z)) for point in points[:1] for x, y, z in _CORNERS)
    light = robot.replace(base_inertia=tensor([0.004, 0.0, 0.006, 0.0, 0.0, 0.008]))
    scene = ground((light, corners), dt, friction=0.0, dissipation=0.0)
    turn = torch.nn.functional.normalize(torch.randn(64, 4, generator=random, dtype=F64), dim=-1)
    state = scene.start(
        turn.new_zeros(64, 0),
        X_WB=above(0.6, 64, turn=turn),
        V_WB_B=torch.randn(64, 6, generator=random, dtype=F64) * tensor([5.0, 5, 5, 1, 1, 1]),
    )
    energies: list[Tensor] = []
    after(scene, state, 1.0, lambda state: energies.append(scene.energy(state).sum(-1)))
    return max(0.0, 1e3 / G * float((torch.stack(energies) - scene.energy(state).sum(-1)).max()))


def _wiped(dt: float) -> float:
    """A Panda that presses on a table by its servos, and draws its tip along it at 0.1 m/s."""
    robot = torchdq.robots.load("panda")
    home = tensor([0.0, 0.3, 0.0, -2.0, 0.0, 2.3, 0.8])
    tip = robot.end_effector().name
    X = torchdq.forward_kinematics(robot, home, tip)
    height = float(dq.translation(X)[2])
    steps = round(1.0 / dt)
    goal = dq.translation(X) + torch.linspace(0, 0.1, steps, dtype=F64)[:, None] * tensor([0.0, 1.0, 0.0])
    target = home.expand(steps, 7).clone()
    for _ in range(20):
        J = torchdq.jacobian(robot, target, tip, expressed="world")[:, 3:]
        off = goal - dq.translation(torchdq.forward_kinematics(robot, target, tip))
        target = target + (torch.linalg.pinv(J) @ off[..., None])[..., 0]
    table = effects.Contact(height=height + 0.02, friction=0.4, stiffness=1e4)
    scene = Scene(robot, (effects.Gravity(), effects.Servo(2000.0, 100.0), table), dt=dt)
    with torch.no_grad():
        found = scene.contacts(scene.rollout(scene.start(target[0]), target=target))
    late = slice(steps // 2, None)
    return float((found.force[late, 0, :2].norm(dim=-1) / (0.4 * found.normal_force[late, 0])).mean())


CROUCH, UP = tensor([0.0, 1.2, -2.4] * 4), tensor([0.0, 0.5, -1.0] * 4)


def _jumped(files: dict[str, Path], dt: float) -> float:
    """Highest base of Go2 whose servos step from a crouch to stretched legs."""
    scene = legged(Robot.from_urdf(str(files["Go2"]), base="floating"), FEET, dt, F64, 120.0, 2.0)
    state = after(scene, scene.start(CROUCH[None], X_WB=above(0.2, 1)), 1.5, target=CROUCH[None])
    tops: list[float] = []
    after(scene, state, 0.7, lambda state: tops.append(float(place(state)[0, 2])), target=UP[None])
    return max(tops)


def _jump_of_mujoco(files: dict[str, Path]) -> float:
    model = in_mujoco(files["Go2"], FEET, 2.0, 0.01, dt=2e-4)
    data, tops = mujoco.MjData(model), []
    data.qpos[:7], data.qpos[7:] = [0, 0, 0.2, 1, 0, 0, 0], CROUCH.numpy()
    for i in range(round(2.2 / 2e-4)):
        goal = CROUCH if i * 2e-4 < 1.5 else UP
        data.qfrc_applied[6:] = 120.0 * (goal.numpy() - data.qpos[7:])
        mujoco.mj_step(model, data)
        tops.append(data.qpos[2] if i * 2e-4 > 1.5 else 0.0)
    return float(max(tops))


# --- stability -------------------------------------------------------------------------------------------------------


def stability(files: dict[str, Path], quick: bool) -> list[dict[str, Any]]:
    """Go2 with 20 points, dropped in 64 random states, passive and with servos at random targets: energy gained."""
    robot = Robot.from_urdf(str(files["Go2"]), base="floating")
    rows, B = [], 16 if quick else 64
    mass = float(robot.mass.sum() + robot.base_mass)
    for dt in (1e-3, 5e-3, 1e-2, 2e-2):
        most = 0.999 * 4 * mass / dt**2
        for k in (*[k for k in (1e3, 1e4, 1e5, 1e6) if k < most], most):
            passive, servos = (_dropped(robot, B, dt, k, *gains) for gains in ((0.0, 0.2), (40.0, 1.0)))
            lost = passive.isnan().sum() + servos.isnan().sum()
            rows.append({"dt": dt, "k": k, "passive": float(passive.max()), "servos": float(servos.max())})
            rows[-1]["lost"] = int(lost)
            print(rows[-1], flush=True)
    return rows


def _dropped(robot: Robot, B: int, dt: float, k: float, kp: float, kd: float) -> Tensor:
    """Largest gain of kinetic, potential and servo energy over 1.5 s, over that at the start; NaN: it was lost."""
    random = torch.Generator().manual_seed(0)
    q, qd, target, V, turn = (torch.randn(B, n, generator=random, dtype=F64) for n in (12, 12, 12, 6, 4))
    corners = [(x, y, z) for x in (-0.19, 0.19) for y in (-0.05, 0.05) for z in (-0.06, 0.06)]
    points = (*FEET, *LIMBS[:8], *(ContactPoint("base", corner) for corner in corners))
    scene, goal = legged(robot, points, dt, F64, kp, kd, stiffness=k), STAND + 0.5 * target
    X = above(0.8, B, turn=torch.nn.functional.normalize(turn, dim=-1))
    state = scene.start(STAND + 0.6 * q, 3 * qd, X_WB=X, V_WB_B=2 * V)

    def energy(state: State) -> Tensor:
        return scene.energy(state).sum(-1) + 0.5 * kp * (state.q - goal).square().sum(-1)

    found = [energy(state)]
    after(scene, state, 1.5, lambda state: found.append(energy(state)), target=goal)
    return torch.stack(found).amax(0) / found[0] - 1


# --- standing --------------------------------------------------------------------------------------------------------


def standing(files: dict[str, Path], quick: bool) -> list[dict[str, Any]]:
    """Movement of the base of a standing Go2 from 20 s to 80 s [mm]: at rest, shaken, on a slope of 10 degrees."""
    robot, rows = Robot.from_urdf(str(files["Go2"]), base="floating"), []
    seconds, angle = 20.0 if quick else 60.0, math.radians(10)
    normals = tensor([[0.0, 0, 1], [0.0, 0, 1], [-math.sin(angle), 0, math.cos(angle)]])
    for dtype, dt in ((F64, 5e-3), (F64, 1e-2), (F32, 5e-3)):
        scene, random = legged(robot, FEET, dt, dtype, 60.0, 2.0, normal=normals), torch.Generator().manual_seed(0)
        q, means = STAND.to(dtype).expand(3, 12), []
        state = scene.start(q, X_WB=above(0.32, 3).to(dtype))
        shaken = tensor([0.0, 1.0, 0.0], dtype)[:, None]
        with torch.no_grad():
            for part in (18.0, 2.0, seconds - 2.0, 2.0):
                places = []
                for _ in range(round(part / dt)):
                    torque = shaken * torch.randn(3, 12, generator=random, dtype=dtype)
                    state = scene.step(state, torque=torque, target=q)
                    places.append(place(state).double())
                means.append(torch.stack(places).mean(0))
        moved = 1e3 * (means[3] - means[1]).norm(dim=-1)
        rows.append({"who": f"{1e3 * dt:g} ms, {str(dtype)[6:]}", "moved": moved.tolist()})
        print(rows[-1], flush=True)
    for name, cone, ratio in (("default", 0, 1.0), ("elliptic, impratio 10", 1, 10.0)):
        model = in_mujoco(files["Go2"], FEET, 2.0, 0.01, dt=2e-3)
        model.opt.cone, model.opt.impratio = cone, ratio
        moved = [_stood_in_mujoco(model, *case, seconds) for case in ((0.0, 0.0), (1.0, 0.0), (0.0, angle))]
        rows.append({"who": f"MuJoCo, 2 ms, {name}", "moved": moved})
        print(rows[-1], flush=True)
    return rows


def _stood_in_mujoco(model: Any, noise: float, angle: float, seconds: float) -> float:
    """Movement of the base in MuJoCo [mm]."""
    data, random, pose = mujoco.MjData(model), np.random.default_rng(0), STAND.numpy()
    model.opt.gravity[:] = [-G * math.sin(angle), 0, -G * math.cos(angle)]
    data.qpos[:7], data.qpos[7:] = [0, 0, 0.32, 1, 0, 0, 0], pose
    places = []
    for i in range(round((20.0 + seconds) / 2e-3)):
        if i % 2 == 0:
            torque = noise * random.standard_normal(12)
        data.qfrc_applied[6:] = 60.0 * (pose - data.qpos[7:]) + torque
        mujoco.mj_step(model, data)
        places.append(data.qpos[:3].copy())
    return float(1e3 * np.linalg.norm(np.mean(places[-1000:], 0) - np.mean(places[9000:10000], 0)))


def servos(files: dict[str, Path], quick: bool) -> list[dict[str, Any]]:
    """Largest torque of servos over their limit, Go2 that falls and stands with random targets at 50 Hz."""
    robot, rows = Robot.from_urdf(str(files["Go2"]), base="floating"), []
    limit = tensor([23.7, 23.7, 45.4] * 4)
    kp, kd, random = 30.0, 0.7, torch.Generator().manual_seed(0)
    for dt in (1e-3, 5e-3, 1e-2, 2e-2):
        servo = effects.Servo(kp, kd, limit)
        parts = (effects.Gravity(), effects.RotorInertia(0.01), servo, effects.Contact(FEET, stiffness=tensor(K)))
        scene, B = Scene(robot, parts, dt=dt), 64
        state, over = scene.start(STAND.expand(B, 12), X_WB=above(0.4, B)), []
        with torch.no_grad():
            for _ in range(20 if quick else 100):
                target = STAND + 0.5 * torch.randn(B, 12, generator=random, dtype=F64)
                for _ in range(round(0.02 / dt)):
                    free = kp * (target - state.q - dt * state.qd) - kd * state.qd
                    s = limit / torch.maximum(free.abs(), limit)
                    state = scene.step(state, target=target)
                    over.append((s * (kp * (target - state.q) - kd * state.qd)).abs() / limit)
        every = torch.stack(over)
        found = {"dt": dt, "largest": float(every.max()), "share above": float((every > 1 + 1e-9).double().mean())}
        rows.append({**found, "99.9 %": float(every.flatten()[::7].quantile(0.999))})
        print(rows[-1], flush=True)
    return rows


PARTS = {
    "price": price,
    "gradient": gradient,
    "accuracy": accuracy,
    "stability": stability,
    "standing": standing,
    "servos": servos,
}


def main() -> None:
    """Every part that is asked for, as tables."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--quick", action="store_true", help="fewer rounds, robots and seconds")
    options.add_argument("--parts", nargs="*", choices=PARTS, default=list(PARTS), help="which tables; all by default")
    options.add_argument("--go2", type=Path, help="URDF of Go2, by default that of example-robot-data")
    options.add_argument("--g1", type=Path, help="URDF of G1, by default that of example-robot-data")
    options.add_argument("--store", action="store_true", help=f"write {STORED.relative_to(report.ROOT)}")
    given = options.parse_args()
    torch.set_num_threads(1)
    files = {"Go2": file_of(given.go2, "go2"), "G1": file_of(given.g1, "g1_29dof_rev_1_0")}
    found = {part: PARTS[part](files, given.quick) for part in given.parts}
    for part, rows in found.items():
        print(f"\n{TABLES[part](rows)}")
    if given.store:
        before = json.loads(STORED.read_text(encoding="utf-8")) if STORED.exists() else {}
        report.into_json(STORED, **{**before, "machine": report.machine(), **found})


if __name__ == "__main__":
    main()
