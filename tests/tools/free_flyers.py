"""Robots with a floating base, each with a Pinocchio model of it whose root is a free-flyer.

Trees are the random ones of `oracles`, on a base with a random body. The robots of example-robot-data get the body of
their root link as Pinocchio reads it, or a made-up one where their file gives it none.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import oracles
import pinocchio as pin
import torch
from rotations import flat

import torchdq
from torchdq import dq

B = 3  # samples
TREES = tuple(f"tree{n}" for n in range(1, 13))  # trees with 1 to 12 joints
ROBOTS = ("solo12", "anymal_c_simple-anymal", "hextilt_flying_arm_5", "g1_29dof_rev_1_0", "quadrotor_base")
MORE_ROBOTS = (
    *("a1", "go1", "go2", "hyq_no_sensors", "bolt", "icub_reduced", "simple_humanoid_classical", "talos_reduced"),
    *("borinot_flying_arm_2", "b1-z1", "panda", "tiago_no_hand", "iris", "centauro", "laikago", "human"),
)
ANGULAR_FIRST = [3, 4, 5, 0, 1, 2]


class FreeFlyer(oracles.Case):
    """Robot and model, whose joints and frames are found by name."""

    root = 1

    @property
    def order(self) -> list[int]:
        """Index in Pinocchio's velocities of each of ours: (angular, linear) of the base, then the joints."""
        return [*ANGULAR_FIRST, *super().order]

    def configuration(self, X_WB, q) -> np.ndarray:
        """Pinocchio's configuration."""
        found = super().configuration(q)
        found[:7] = pin.SE3ToXYZQUAT(oracles.se3(X_WB))
        return found

    def velocity(self, base, joints) -> np.ndarray:
        """Velocities or accelerations in Pinocchio's order."""
        return super().velocity(np.concatenate([base, joints]))

    def wrenches(self, f_ext=None, f_tip=None, f_base=None) -> list[pin.Force]:
        """Wrenches on Pinocchio's joints: those on the links and on the base, less that of the tip."""
        forces = [pin.Force.Zero() for _ in range(self.model.njoints)]
        given = [] if f_ext is None else list(zip(self.robot.link_names, f_ext, strict=True))
        given += [] if f_tip is None else [(self.robot.tip, -f_tip)]
        for name, f in given:
            frame = self.model.frames[self.frame_id(name)]
            forces[frame.parentJoint] += frame.placement.act(pin.Force(np.array(f)))
        if f_base is not None:
            forces[1] += pin.Force(np.array(f_base))
        return forces


class Motion(dict):
    """Random arguments of the functions by name, [B, ...]."""

    def pick(self, *names: str) -> dict[str, torch.Tensor]:
        return {name: self[name] for name in names}


@cache
def motion(c: FreeFlyer, seed: int = 0, batch: int = B) -> Motion:
    """Random place, motion and wrenches."""
    rng = np.random.default_rng([c.robot.n, seed])
    n, random = c.robot.n, lambda *shape: torch.from_numpy(rng.normal(size=(batch, *shape)))
    slides = torch.tensor([kind == "prismatic" for kind in c.robot.kinds], dtype=torch.bool)
    return Motion(
        X_WB=dq.from_pose(dq.normalize(random(4)), random(3)),
        q=random(n) * torch.where(slides, 0.3, 3.0).double(),
        V_WB_B=random(6),
        qd=2 * random(n),
        A_WB_B=4 * random(6),
        qdd=5 * random(n),
        tau=10 * random(n),
        f_tip=10 * random(6),
        f_ext=10 * random(n, 6),
        f_base=10 * random(6),
    )


def over(function, c: FreeFlyer, m: Motion) -> np.ndarray:
    """Results of function(model, data, q, v, a, row of m) for every sample."""
    data, found = c.model.createData(), []
    for k in range(len(m["q"])):
        row = {name: x[k].numpy() for name, x in m.items()}
        q = c.configuration(m["X_WB"][k], row["q"])
        v, a = c.velocity(row["V_WB_B"], row["qd"]), c.velocity(row["A_WB_B"], row["qdd"])
        found.append(np.array(function(c.model, data, q, v, a, row)))
    return np.array(found)


def body(inertia: pin.Inertia) -> dict[str, torch.Tensor]:
    """Fields of a robot for the body of its base."""
    values = {"base_mass": inertia.mass, "base_com": inertia.lever, "base_inertia": flat(inertia.inertia)}
    return {name: torch.tensor(np.array(x)) for name, x in values.items()}


def random_body(seed: int) -> pin.Inertia:
    rng = np.random.default_rng([7, seed])
    return pin.Inertia(4.0, rng.normal(size=3) * 0.2, oracles.random_inertia(rng, 4.0))


def on_free_flyer(fixed: pin.Model) -> pin.Model:
    """Model with a free-flyer between its universe and everything else."""
    model = pin.Model()
    root = model.addJoint(0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "free_flyer")
    for i in range(1, fixed.njoints):
        j = model.addJoint(root + fixed.parents[i], fixed.joints[i], fixed.jointPlacements[i], fixed.names[i])
        model.appendBodyToJoint(j, fixed.inertias[i], pin.SE3.Identity())
    for frame in fixed.frames:
        if frame.type == pin.FrameType.BODY:
            model.addBodyFrame(frame.name, root + frame.parentJoint, frame.placement, 0)
    model.gravity = fixed.gravity
    model.armature = np.concatenate([np.zeros(6), fixed.armature])
    return model


@cache
def case(name: str) -> FreeFlyer:
    """Case of a name in `TREES`, `ROBOTS` or `MORE_ROBOTS`; the tensors of its robot are constants."""
    if name in TREES:
        n = int(name.removeprefix("tree"))
        built = oracles.random_tree(n, n, armature=n % 2 == 1)
        robot, model = built.robot, on_free_flyer(built.model)
        model.inertias[1] = random_body(n)
    else:
        path = oracles.urdf_paths()[name]
        robot = torchdq.Robot.from_urdf(path, on_unphysical="ignore")
        model = pin.buildModelFromUrdf(str(path), pin.JointModelFreeFlyer())
        model.armature = np.zeros(model.nv)
        moving = [frame.name for frame in robot.frames if frame.link >= 0]
        robot = robot.with_tip(moving[-1]) if moving else robot
        if model.inertias[1].mass == 0:
            model.inertias[1] = random_body(robot.n)
    return FreeFlyer(robot.replace(on_unphysical="ignore", **body(model.inertias[1])).bake(), model)
