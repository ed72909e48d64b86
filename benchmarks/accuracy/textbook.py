"""Rigid-body dynamics as textbooks have it: vectors and rotation matrices in the base frame, any numpy precision.

It shares nothing with torchdq but the robot's numbers: no dual quaternions, no link frames, no recursion of inertias.
Columns of the mass matrix are torques of unit accelerations, all at once, and it is solved by elimination.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from accuracy.rows import LONG, exact
from accuracy.scenes import Case, Forces, no_forces
from torchdq import Robot

Array = np.ndarray


def cross(a: Array, b: Array) -> Array:
    """Cross product along the first axis, where vectors have their components here."""
    return np.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def dot(a: Array, b: Array) -> Array:
    """Inner product along the first axis."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def apply(R: Array, v: Array) -> Array:
    """R v for matrices [3, 3, ...]."""
    return np.stack([dot(R[i], v) for i in range(3)])


def rotation(r: Array) -> Array:
    """Rotation matrix of a unit quaternion."""
    w, x, y, z = r
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def position(x: Array) -> Array:
    """Position of a unit dual quaternion r + (eps/2) p r: the vector part of 2 D r*."""
    (w, *v), (dw, *dv) = x[:4], x[4:]
    v, dv = np.array(v), np.array(dv)
    return 2 * (w * dv - dw * v + cross(v, dv))


class Textbook:
    """A chain or tree of revolute joints."""

    def __init__(self, robot: Robot, gravity: Any, forces: Forces = no_forces):
        assert all(kind == "revolute" for kind in robot.kinds) and robot.armature is None
        known = exact(robot)
        self.parents, self.n, self.forces = robot.parents, robot.n, forces
        self.R = [rotation(x[:4]) for x in known["X_PB_home"]]
        self.p = [position(x) for x in known["X_PB_home"]]
        self.axis = known["screw"][:, :3]
        self.point = [cross(s[:3], s[3:]) for s in known["screw"]]  # on the axis, in the link
        self.mass, self.com = known["mass"], known["com"]
        xx, xy, yy, xz, yz, zz = known["inertia"].T
        self.inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]).transpose(2, 0, 1)
        self.gravity = np.zeros(3, LONG) if gravity is None else np.array(gravity, LONG)

    @classmethod
    def of(cls, case: Case) -> Textbook:
        """The bodies and joint effects of a scene."""
        return cls(case.robot, case.gravity, case.forces)

    def placed(self, q: Array) -> list[tuple[Array, ...]]:
        """Axis, a point on it, centre of mass and inertia of every link, in the base frame; q is [..., n]."""
        frames: list[tuple[Array, Array]] = []
        found = []
        batch = (1,) * (q.ndim - 1)
        for i in range(self.n):
            x, a = q[..., i], self.axis[i]
            c, s = np.cos(x), np.sin(x)
            K = np.array([[0 * a[0], -a[2], a[1]], [a[2], 0 * a[0], -a[0]], [-a[1], a[0], 0 * a[0]]])
            wide = (slice(None), slice(None), *(None,) * len(batch))
            turn = np.eye(3, dtype=LONG)[wide] + s * K[wide] + (1 - c) * (K @ K)[wide]  # Rodrigues
            home, p = self.R[i], self.p[i].reshape(3, *batch)
            point, com = (y.reshape(3, *batch) for y in (self.point[i], self.com[i]))
            R = np.stack(
                [np.stack([sum(home[j, k] * turn[k, m] for k in range(3)) for m in range(3)]) for j in range(3)]
            )
            o = p + (home @ self.point[i]).reshape(3, *batch) - apply(R, point)
            if self.parents[i] >= 0:
                R_P, o_P = frames[self.parents[i]]
                o = o_P + apply(R_P, o)
                R = np.stack([apply(R_P, R[:, m]) for m in range(3)], 1)
            frames.append((R, o))
            axis = apply(R, a.reshape(3, *batch))
            half = np.stack([sum(R[:, k] * self.inertia[i][k, m] for k in range(3)) for m in range(3)], 1)
            I = np.stack([np.stack([dot(half[j], R[m]) for m in range(3)]) for j in range(3)])
            found.append((axis, o + apply(R, point), o + apply(R, com), I))
        return found

    def torques(self, placed: list[tuple[Array, ...]], qd: Array, qdd: Array, gravity: Array) -> Array:
        """Torques of a motion, by Newton and Euler; gravity is [3, ...]."""
        zero = np.zeros((3, *qdd.shape[:-1]), LONG)
        motion: list[tuple[Array, ...]] = []
        for i, (axis, c, G, _) in enumerate(placed):
            w_P, wd_P, c_P, acc_P = motion[self.parents[i]][:4] if self.parents[i] >= 0 else (zero, zero, zero, zero)
            acc = acc_P + cross(wd_P, c - c_P) + cross(w_P, cross(w_P, c - c_P))
            rate = axis * qd[..., i]
            w, wd = w_P + rate, wd_P + axis * qdd[..., i] + cross(w_P, rate)
            pull = acc + cross(wd, G - c) + cross(w, cross(w, G - c)) - gravity
            motion.append((w, wd, c, acc, pull))
        force, moment = [zero] * self.n, [zero] * self.n
        tau = [zero[0]] * self.n
        for i in reversed(range(self.n)):
            (axis, c, G, I), (w, wd, _, _, pull) = placed[i], motion[i]
            f = self.mass[i] * pull
            # moments about the origin of the base, so that wrenches of links simply add
            force[i] = force[i] + f
            moment[i] = moment[i] + cross(G, f) + apply(I, wd) + cross(w, apply(I, w))
            tau[i] = dot(axis, moment[i] - cross(c, force[i]))
            if self.parents[i] >= 0:
                force[self.parents[i]] = force[self.parents[i]] + force[i]
                moment[self.parents[i]] = moment[self.parents[i]] + moment[i]
        return np.stack(np.broadcast_arrays(*tau), -1)

    def terms(self, q: Array, qd: Array) -> tuple[Array, Array]:
        """Mass matrix [..., n, n] and bias torques [..., n]."""
        placed = self.placed(q[None])
        # row k < n: a unit acceleration of joint k at rest without gravity; the last row: none, at the velocity given
        axes = (1,) * (q.ndim - 1)
        moving = np.zeros((self.n + 1, *axes, 1), LONG)
        moving[-1] = 1
        unit = np.concatenate([np.eye(self.n, dtype=LONG), np.zeros((1, self.n), LONG)])
        unit = unit.reshape(self.n + 1, *axes, self.n) + np.zeros((*q.shape[:-1], self.n), LONG)
        gravity = self.gravity.reshape(3, 1, *axes) * moving[None, ..., 0]
        rows = self.torques(placed, moving * qd, unit, gravity)
        return np.moveaxis(rows[:-1], 0, -2), rows[-1]

    def __call__(self, q: Array, qd: Array, torque: Array) -> Array:
        """Accelerations [..., n]."""
        M, bias = self.terms(q, qd)
        return solved(M, torque + self.forces(q, qd) - bias)


def solved(M: Array, b: Array) -> Array:
    """Solution of M x = b, symmetric and positive definite, by elimination without pivots."""
    M, x, n = M.copy(), b.copy(), b.shape[-1]
    for k in range(n - 1):
        ratio = M[..., k + 1 :, k] / M[..., k, k][..., None]
        M[..., k + 1 :, k + 1 :] -= ratio[..., None] * M[..., k, k + 1 :][..., None, :]
        x[..., k + 1 :] -= ratio * x[..., k][..., None]
    for k in reversed(range(n)):
        x[..., k] = (x[..., k] - (M[..., k, k + 1 :] * x[..., k + 1 :]).sum(-1)) / M[..., k, k]
    return x
