"""Actions of an environment: what numbers in [-1, 1] mean as inputs of a scene."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
import torch
from torch import Tensor

from torchdq.base.checks import and_more, is_number, matching, require_choice, require_tensor
from torchdq.control.frames import FrameLaw, OperationalSpaceControl
from torchdq.control.joints import ComputedTorque
from torchdq.control.law import Law
from torchdq.dq.components import form
from torchdq.dynamics.posed import Row
from torchdq.effects import Effect
from torchdq.envs.pose_actions import POSITION, ROTATION, PoseActions
from torchdq.envs.tasks import ranges, velocities
from torchdq.errors import ArgumentError
from torchdq.functions.options import independent
from torchdq.robot import Robot
from torchdq.robot.description import UNACTUATED
from torchdq.scene.defaults import nominal_robot
from torchdq.scene.free_base import POSE
from torchdq.scene.scene import Scene
from torchdq.scene.spec import Rows

Kind = Literal["reference", "target", "torque", "residual", "pose"]
FOLLOWED = ("reference", "residual", "pose")  # by a controller
KP, KD = 100.0, 20.0  # gains of the default controller of joints [1/s^2, 1/s]
RATE = 20.0  # at which the error of a pose decays under that of frames [1/s]
SHARE = {"torque": 1.0, "residual": 0.2}  # full action as a share of the torque limits
OFFSET = 0.25  # full action of a servo's target [rad or m]
HORIZON = 0.2  # time in which a joint at its velocity limit moves by a full reference action [s]


@dataclass(frozen=True, eq=False)
class Actions:
    """Meaning of the actions of environments; the name of a kind alone stands for it with these defaults.

    Controllers and servos follow the reference of the task, except for "pose". In "track" it is the motion to track; in
    "reach" it is the measured position, so that a zero action holds still.

    Args:
        kind: what an action is; None: "target" if the scene has a servo, otherwise "torque" if joints are passive, the
            base floats or the robot has closures, otherwise "reference".
            "reference": offsets of the joint positions that a controller follows, at most as far as a joint moves in
            0.2 s at its velocity limit.
            "target": offsets of the targets of `effects.Servo`, at most 0.25 rad or m.
            "torque": fractions of the torque limits.
            "residual": torques added to those of a controller, at most a fifth of the torque limits.
            "pose": displacements of the desired pose of the controller's frame, a rotation vector of at most 0.5 rad
            and a translation of at most 0.1 m along each axis; `RobotVectorEnv.pose_action` converts absolute poses.
        controller: controller for "reference", "residual" and "pose". It uses the nominal rigid-body model, without
            friction and randomisation, unless it has a model of its own. None: computed torque, or for "pose"
            operational space control of the tip in those world axes that the joints move independently; needed if the
            base floats.
        scale: size of a full action, one number or one for each joint or axis; None: as above [N m or N; rad or m].
        leash: largest distance of the desired pose from the measured one after a "pose" step; larger displacements are
            cut. (0, 0): actions displace the measured pose [rad, m].
        joints: names or patterns of the actuated joints, one number of an action for each, in this order; None: all,
            or of a robot with closures those to which its MJCF file gives actuators. The others are passive, which
            "torque" and "target" permit.

    >>> from torchdq.envs import Actions, RobotVectorEnv
    >>> envs = RobotVectorEnv(
    ...     64, "reach", "panda", action=Actions("torque", joints="*[1-4]", scale=20.0)
    ... )
    >>> envs.single_action_space.shape
    (4,)
    """

    kind: Kind | None = None
    controller: Law | None = None
    scale: float | Sequence[float] | None = None
    leash: tuple[float, float] = (0.5, 0.05)
    joints: str | Sequence[str] | None = None

    def __post_init__(self) -> None:
        if self.kind is not None:
            require_choice("action", self.kind, get_args(Kind))
        leash = self.leash
        if not (isinstance(leash, Sequence) and len(leash) == 2 and all(is_number(x) and x >= 0 for x in leash)):
            raise ArgumentError(f"leash must be two numbers that are not negative [rad, m], found {leash!r}")


class Meaning(NamedTuple):
    """Actions of a robot: what programs depend on."""

    kind: Kind
    n: int  # joints of the robot
    joints: tuple[int, ...]  # the actuated ones, in the order of the numbers of an action
    names: tuple[str, ...]  # of these numbers
    pose: PoseActions | None = None  # None: actions are of joints

    @property
    def reference(self) -> int:
        """Number of numbers of the reference that actions refer to, none of torques."""
        return POSE if self.pose is not None else 0 if self.kind == "torque" else 3 * self.n

    def inputs(self, action: Row, scale: Row, reference: Row) -> tuple[Row, Rows]:
        """Action of all joints, or axes, and the inputs of a scene that it changes, of numbers in [-1, 1]."""
        if self.pose is not None:
            X = self.pose.moved(form(reference), action, scale)
            return action, {"reference": [*X[0], *X[1], *[0.0] * self.pose.still]}
        wide, scaled = list[Any]([0.0] * self.n), list[Any]([0.0] * self.n)
        for joint, a, s in zip(self.joints, action, scale, strict=True):
            wide[joint], scaled[joint] = a, s * a
        if self.kind in SHARE:
            return wide, {"torque": scaled}
        moved = [a + b for a, b in zip(reference, scaled, strict=False)]
        whole = moved if self.kind == "target" else [*moved, *reference[self.n :]]
        return wide, {self.kind: whole}

    def checked(self, actions: Any, num_envs: int, like: Tensor, synchronises: bool) -> Tensor:
        """Actions [N, k] as a tensor; raises in a graph, where the host `synchronises`."""
        if isinstance(actions, Tensor):
            require_tensor("actions", actions)
        try:
            if actions.is_complex() if isinstance(actions, Tensor) else np.iscomplexobj(actions):
                raise TypeError("complex numbers, whose imaginary parts would be dropped")
            found = torch.as_tensor(actions, dtype=like.dtype, device=like.device)
        except (TypeError, ValueError, RuntimeError) as error:
            raise ArgumentError(
                f"actions must be a tensor or an array of numbers, found {type(actions).__name__} ({error})"
            ) from error
        shape = (num_envs, len(self.names))
        if found.shape != shape:
            raise ArgumentError(
                f"actions must have the shape {shape}, one row for each environment and one number for each of "
                f"{', '.join(self.names)}, found {tuple(found.shape)}"
            )
        if synchronises and torch.compiler.is_compiling():
            raise ArgumentError(
                "a step of an environment cannot be in a graph of torch.compile or torch.export: it depends on "
                "values, of which a graph has none; trace the policy, or scene.step"
            )
        return found

    def require_finite(self, actions: Tensor) -> None:
        """Raise unless actions [..., N, k] are finite."""
        if not math.isfinite(actions.sum().item()) and len(bad := (~actions.isfinite()).nonzero()):
            row, number = bad[0, -2:].tolist()
            what = f"{'joint' if self.pose is None else 'axis'} {self.names[number]!r}{and_more(bad)}"
            raise ArgumentError(
                f"actions must be finite, found {actions[tuple(bad[0])].item()} in row {row} for {what}; that step was "
                "not taken"
            )


def resolved(actions: Actions, scene: Scene, defaults: Mapping[str, Any]) -> tuple[Scene, Meaning, list[float]]:
    """Scene with the controller of the actions, their meaning, and the size of a full one.

    Args:
        defaults: those of the task, whose scale is of the default kind of action.
    """
    robot, joints = scene.robot, actuated(scene.robot, actions.joints)
    default = _kind(None, robot, joints, scene.effects)
    kind = default if actions.kind is None else _kind(actions.kind, robot, joints, scene.effects)
    scene = _with_controller(scene, kind, actions.controller)
    law, pose = scene.controller, None
    if isinstance(law, FrameLaw) and law.task is not None:
        pose = PoseActions(law.task, (float(actions.leash[0]), float(actions.leash[1])), law.reference(0) - POSE)
    names = tuple([robot.joint_names[i] for i in joints]) if pose is None else pose.names
    meaning = Meaning(kind, robot.n, joints if pose is None else (), names, pose)
    scale = defaults.get("scale") if actions.scale is None and kind == default else actions.scale
    return scene, meaning, _full(robot, meaning, scale)


def actuated(robot: Robot, given: str | Sequence[str] | None) -> tuple[int, ...]:
    """Numbers of the actuated joints, each once, in the order given; those of a pattern or a set in the robot's."""
    names = robot.joint_names
    if given is None and robot.closures:
        passive = {name for x in robot.notes if x.code == UNACTUATED for name in x.subject.split(", ")}
        given = [name for name in names if name not in passive]
        if not passive <= {*names} or not 0 < len(given) < robot.n:
            raise ArgumentError(
                f"joints of Actions must name those of robot {robot.name!r} that have motors, since those of its loops "
                f"move each other; for instance Actions('torque', joints={names[0]!r}), or joints='*' for all"
            )
    if given is None:
        return tuple(range(robot.n))
    if not matching("joints", given, names, "joint"):
        raise ArgumentError("joints must name at least one actuated joint, found none")
    words = (given,) if isinstance(given, str | Set) else given
    found = [name for one in words for name in matching("joints", one, names, "joint")]
    return tuple(map(names.index, dict.fromkeys(found)))


def _kind(kind: Kind | None, robot: Robot, joints: Sequence[int], effects: Sequence[Effect]) -> Kind:
    """Kind of the actions, checked; None: the default."""
    passive = [name for i, name in enumerate(robot.joint_names) if i not in joints]
    servo = any("target" in effect.inputs(robot.n) for effect in effects)
    if kind is None:
        return "target" if servo else "torque" if passive or robot.floating or robot.closures else "reference"
    if servo != (kind == "target"):
        expected = "be 'target', since effects have a Servo" if servo else "have effects with a Servo(kp, kd)"
        raise ArgumentError(f"action must {expected}, found {kind!r}")
    if passive and kind in FOLLOWED:
        raise ArgumentError(
            f"action must be 'torque' or 'target' where joints are passive, found {kind!r}: its controller would "
            f"drive {', '.join(passive)}, too"
        )
    return kind


def _with_controller(scene: Scene, kind: Kind, controller: Law | None) -> Scene:
    """Scene with the controller of the actions; None: one that knows the nominal rigid bodies."""
    if kind not in FOLLOWED:
        if controller is not None:
            raise ArgumentError(f"controller must be None for {kind} actions; did you mean 'residual'?")
        return scene
    if controller is not None:
        if isinstance(controller, FrameLaw) != (kind == "pose"):
            wanted = "OperationalSpaceControl" if kind == "pose" else "ComputedTorque"
            raise ArgumentError(
                f"controller must be one of {'a frame' if kind == 'pose' else 'joints'} for {kind} actions, such as "
                f"{wanted}, found {type(controller).__name__}"
            )
        return scene.replace(controller=controller)
    model = nominal_robot(scene)
    if kind != "pose":
        return scene.replace(controller=ComputedTorque(KP, KD, model=model))
    middle = tuple([r.lower + 0.5 * r.span for r in ranges(scene.robot)])
    rate = min(RATE, 0.5 / scene.dt)  # torques that are held for dt would overshoot beyond
    axes = independent(scene.robot, scene.robot.end_effector().name, "world")
    firm = OperationalSpaceControl(rate**2, 2 * rate, expressed="world", axes=axes, q_null=middle, model=model)
    return scene.replace(controller=firm)


def _full(robot: Robot, meaning: Meaning, scale: float | Sequence[float] | None) -> list[float]:
    """Size of a full action; None: from the robot's limits."""
    pose, names = meaning.pose, meaning.names
    if scale is not None:
        given = scale.tolist() if isinstance(scale, np.ndarray | Tensor) else scale
        numbers = list(given) if isinstance(given, Sequence) else [given] * len(names)
        if len(numbers) != len(names) or not all(is_number(x) and 0 < x < math.inf for x in numbers):
            raise ArgumentError(
                f"scale must be a positive number or {len(names)} of them, one for each "
                f"{'actuated joint' if pose is None else 'axis'}, found {scale!r}"
            )
    elif pose is not None:
        return [ROTATION if name.startswith("r") else POSITION for name in names]
    elif meaning.kind == "target":
        numbers = [OFFSET] * len(names)
    elif meaning.kind == "reference":
        numbers = [HORIZON * velocities(robot)[i] for i in meaning.joints]
    else:
        numbers = [SHARE[meaning.kind] * robot.limits.effort[i].item() for i in meaning.joints]
    for name, x in zip(names, numbers, strict=True):
        if not 0 < x < math.inf:
            raise ArgumentError(
                f"scale must be given: joint {name!r} of robot {robot.name!r} has no torque limit that actions could "
                "be fractions of; for instance Actions(scale=10.0)"
            )
    return [float(x) for x in numbers]
