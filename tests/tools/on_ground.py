"""Bodies and robots on the ground: balls, boxes and a quadruped with spheres as feet, and their starts."""

from functools import cache

import torch
from oracles import urdf_paths

import torchdq
from torchdq import dq
from torchdq.robot import ContactPoint

F64 = torch.float64
G = 9.81
STAND = torch.tensor([0.0, 0.8, -1.5] * 4, dtype=F64)  # of a quadruped's joints
FEET = tuple(ContactPoint(f"{leg}_foot", radius=0.022) for leg in ("FL", "FR", "RL", "RR"))


def body(mass, inertia):
    """Robot of a single body on a floating base, its centre of mass at its origin."""
    xx, yy, zz = inertia
    return torchdq.Robot.from_urdf(
        f"""<robot name="body"><link name="body"><inertial><mass value="{mass}"/>
        <inertia ixx="{xx}" ixy="0" ixz="0" iyy="{yy}" iyz="0" izz="{zz}"/></inertial></link></robot>""",
        base="floating",
    )


@cache
def ball(radius=0.1, mass=1.0):
    """Homogeneous ball, and its sphere."""
    return body(mass, [0.4 * mass * radius**2] * 3), (ContactPoint("body", radius=radius),)


@cache
def box(a=0.2, b=0.2, c=0.02, mass=1.0, upper=False):
    """Homogeneous box, and its lower corners or all."""
    inertia = (mass * (x * x + y * y) / 12 for x, y in ((b, c), (a, c), (a, b)))
    corners = [(x * a / 2, y * b / 2, z * c / 2) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)[: 1 + upper]]
    return body(mass, inertia), tuple(ContactPoint("body", corner) for corner in corners)


@cache
def go2():
    """Quadruped of 15 kg with 12 joints."""
    return torchdq.Robot.from_urdf(str(urdf_paths()["go2"]), base="floating")


def at(height, *batch, turn=(1.0, 0.0, 0.0, 0.0), dtype=F64):
    """Poses above the origin."""
    place = torch.stack([torch.zeros_like(z := torch.as_tensor(height, dtype=F64)), torch.zeros_like(z), z], -1)
    return dq.from_pose(torch.as_tensor(turn, dtype=F64).expand(*batch, 4), place.expand(*batch, 3)).to(dtype)


def tilted(angle):
    """Unit normal of a plane that rises along x, and the turn of what stands on it; angle [...]."""
    none = torch.zeros_like(angle)
    return torch.stack([-angle.sin(), none, angle.cos()], -1), torch.stack(
        [(angle / 2).cos(), none, -(angle / 2).sin(), none], -1
    )


def place(state):
    """Positions of the base in the world."""
    return dq.translation(state.X_WB)


def begin(scene, X, V=None):
    """Start of a single body."""
    none = X.new_zeros(*X.shape[:-1], 0)
    return scene.start(none, X_WB=X, V_WB_B=X.new_zeros(*X.shape[:-1], 6) if V is None else V)


def path(scene, state, steps, **how):
    """States after a number of steps, which are compiled; without gradients."""
    with torch.no_grad():
        return scene.replace(backend="auto").rollout(state, steps=steps, **how)


def rolled(scene, state, seconds, **inputs):
    """State after a time under constant inputs."""
    steps = round(seconds / scene.dt)
    return path(scene, state, steps, ends=True, **{name: x.expand(steps, *x.shape) for name, x in inputs.items()})
