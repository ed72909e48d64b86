"""Joints of a model that MuJoCo compiled, and the linear couplings between them."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any, NamedTuple

from torchdq.algebra import dual_quaternion
from torchdq.algebra import quaternion as quat
from torchdq.algebra.dual_quaternion import DualQuaternion
from torchdq.algebra.screw import Screw
from torchdq.dynamics.joints import KINDS
from torchdq.robot.arrays import unused
from torchdq.robot.edit.couplings import Follows
from torchdq.robot.mjcf.source import MjcfModel

FREE = "free"


class MjcfJoint(NamedTuple):
    """Joint of a model; free joints have zero-filled numbers."""

    row: int  # among the joints of the model
    name: str
    kind: str  # "revolute", "prismatic" or FREE
    body: int
    screw: Screw  # in the frame of the body
    home: float  # [rad or m]
    lower: float  # [rad or m]
    upper: float  # [rad or m]
    effort: float | None  # greatest that its actuators reach [N m or N]; None: it has no actuator
    damping: float
    friction: float
    armature: float
    velocity: float = math.inf  # no limit of it in the format

    @property
    def single(self) -> bool:
        """Whether a joint has one coordinate."""
        return self.kind in KINDS


def joints_of(of: MjcfModel) -> list[MjcfJoint]:
    """Joints of a model, in its order."""
    kinds = {
        of.mujoco.mjtJoint.mjJNT_HINGE: "revolute",
        of.mujoco.mjtJoint.mjJNT_SLIDE: "prismatic",
        of.mujoco.mjtJoint.mjJNT_FREE: FREE,
    }
    names = names_of(of, "JOINT", of.model.njnt)
    return [_joint(of, i, name, kinds[of.mujoco.mjtJoint(of.model.jnt_type[i])]) for i, name in enumerate(names)]


def names_of(of: MjcfModel, kind: str, count: int) -> list[str]:
    """Names of all elements of a kind; one without a name is called by its kind and number, as in joint3."""
    kinds = of.mujoco.mjtObj.__members__
    found = [of.mujoco.mj_id2name(of.model, kinds[f"mjOBJ_{kind}"], i) or "" for i in range(count)]
    taken = {*found}
    return [name or unused(f"{kind.lower()}{i}", taken) for i, name in enumerate(found)]


def _joint(of: MjcfModel, i: int, name: str, kind: str) -> MjcfJoint:
    m = of.model
    body = int(m.jnt_bodyid[i])
    if kind == FREE:
        none = (quat.ZERO, quat.ZERO)
        return MjcfJoint(i, name, kind, body, none, 0.0, -math.inf, math.inf, None, 0.0, 0.0, 0.0)
    axis, point = tuple(m.jnt_axis[i].tolist()), tuple(m.jnt_pos[i].tolist())
    length = math.sqrt(quat.norm2(axis))
    axis = quat.scale(1.0 / length, axis)
    at, dof = int(m.jnt_qposadr[i]), int(m.jnt_dofadr[i])
    lower, upper = m.jnt_range[i].tolist() if m.jnt_limited[i] else (-math.inf, math.inf)
    effort, damping, armature = _actuated(of, i)
    return MjcfJoint(
        i,
        name,
        kind,
        body,
        (axis, quat.cross(point, axis)) if kind == "revolute" else (quat.ZERO, axis),
        float(m.qpos0[at]),
        lower,
        upper,
        effort,
        float(m.dof_damping[dof]) + damping,
        float(m.dof_frictionloss[dof]),
        float(m.dof_armature[dof]) + armature,
    )


def actuators_at(of: MjcfModel, joint: int) -> list[int]:
    """Actuators that act on a joint directly."""
    # arrays hold plain numbers, which no enumeration of MuJoCo's is equal to
    direct = (int(of.mujoco.mjtTrn.mjTRN_JOINT), int(of.mujoco.mjtTrn.mjTRN_JOINTINPARENT))
    m = of.model
    return [k for k in range(m.nactuator) if m.actuator_trntype[k] in direct and m.actuator_trnid[k, 0] == joint]


def _actuated(of: MjcfModel, joint: int) -> tuple[float | None, float, float]:
    """Greatest effort of the actuators of a joint, and their damping and rotor inertia, all at the joint."""
    m, found = of.model, actuators_at(of, joint)
    gears = [abs(float(m.actuator_gear[m.actuator_outadr[k], 0])) for k in found]
    effort = sum(gear * _force(of, k) for k, gear in zip(found, gears, strict=True) if gear) if found else None
    if m.jnt_actfrclimited[joint]:
        bound = float(abs(m.jnt_actfrcrange[joint]).max())
        effort = bound if effort is None else min(bound, effort)

    def reflected(numbers: Any) -> float:
        return sum(gear * gear * float(numbers[k]) for k, gear in zip(found, gears, strict=True))

    return effort, reflected(m.actuator_damping), reflected(m.actuator_armature)


def _force(of: MjcfModel, k: int) -> float:
    """Greatest force of an actuator before its gear; infinite where nothing limits it."""
    m = of.model
    out, control = int(m.actuator_outadr[k]), int(m.actuator_ctrladr[k])
    bound = float(abs(m.actuator_forcerange[out]).max()) if m.actuator_forcelimited[out] else math.inf
    motor = m.actuator_ctrlnum[k] == 1 and m.actuator_gaintype[k] == int(of.mujoco.mjtGain.mjGAIN_FIXED)
    motor = motor and m.actuator_biastype[k] == int(of.mujoco.mjtBias.mjBIAS_NONE)
    if motor and m.actuator_ctrllimited[control]:
        bound = min(bound, abs(float(m.actuator_gainprm[k, 0])) * float(abs(m.actuator_ctrlrange[control]).max()))
    return bound


class Equality(NamedTuple):
    """Equality constraint that is no linear coupling of joints."""

    name: str
    kind: str  # as in the file: "connect", "weld", "joint" ...
    ends: str  # what it holds together
    bodies: tuple[int, ...]  # that it holds together; () where it holds others
    places: tuple[DualQuaternion, ...]  # of the frames on them that come together; () where it is no closure
    disabled: bool  # by a flag of the file

    def __str__(self) -> str:
        return f"{self.kind} {self.name!r}"


class Equalities(NamedTuple):
    """Equality constraints of a model that are active from the start."""

    couplings: list[tuple[str, int, Follows]]  # name, joint that follows, and how
    others: list[Equality]  # those that are not, or are disabled by a flag


def equalities(of: MjcfModel, joints: list[MjcfJoint]) -> Equalities:
    """Linear couplings of joints, and the other equality constraints."""
    m, found, others = of.model, [], []
    flags = of.mujoco.mjtDisableBit
    off = bool(m.opt.disableflags & int(flags.mjDSBL_EQUALITY | flags.mjDSBL_CONSTRAINT))
    for i, name in enumerate(names_of(of, "EQUALITY", m.neq)):
        if not m.eq_active0[i]:
            continue
        a0, a1, *more = m.eq_data[i, :5].tolist()
        first, second = int(m.eq_obj1id[i]), int(m.eq_obj2id[i])
        kind = of.mujoco.mjtEq(m.eq_type[i])
        linear = kind == of.mujoco.mjtEq.mjEQ_JOINT and (second < 0 or not any(more))
        if linear and not off and joints[first].single and (second < 0 or joints[second].single):
            leader, factor = (None, 0.0) if second < 0 else (second, a1)
            found.append((name, first, Follows(leader, factor, a0)))
        else:
            word = kind.name.removeprefix("mjEQ_")
            held = "connect" if word == "WELD" and not m.eq_data[i, 10] else word.lower()  # a weld may be free to turn
            others.append(Equality(name, held, *_held_together(of, i, word), off))
    return Equalities(found, others)


def _held_together(of: MjcfModel, equality: int, word: str) -> tuple[str, tuple[int, ...], tuple[DualQuaternion, ...]]:
    """Names of what an equality constraint holds together, and its bodies and frames on them, if it has any."""
    m, ids = of.model, [int(x[equality]) for x in (of.model.eq_obj1id, of.model.eq_obj2id) if x[equality] >= 0]
    if word in ("JOINT", "TENDON") or word.startswith("FLEX"):
        kind = word[:4] if word.startswith("FLEX") else word
        count = {"JOINT": m.njnt, "TENDON": m.ntendon, "FLEX": m.nflex}[kind]
        return f"{kind.lower()} {_both(names_of(of, kind, count), ids)}", (), ()
    if m.eq_objtype[equality] == int(of.mujoco.mjtObj.mjOBJ_SITE):
        at = tuple(pose(m.site_quat[k], m.site_pos[k]) for k in ids)
        return f"site {_both(names_of(of, 'SITE', m.nsite), ids)}", tuple(int(m.site_bodyid[k]) for k in ids), at
    first, second, turn = (m.eq_data[equality, k : k + size] for k, size in ((0, 3), (3, 3), (6, 4)))
    unit = (1.0, 0.0, 0.0, 0.0)
    if word == "CONNECT":
        at = (pose(unit, first), pose(unit, second))
    else:
        at = (pose(turn, second), pose(unit, first)) if word == "WELD" else ()
    return f"body {_both(names_of(of, 'BODY', m.nbody), ids)}", (*ids, *[0] * (2 - len(ids))), at


def pose(rotation: Iterable[float], position: Iterable[float]) -> DualQuaternion:
    """Pose of a unit quaternion and a position of a model."""
    return dual_quaternion.from_pose(tuple(map(float, rotation)), tuple(map(float, position)))


def _both(names: list[str], ids: list[int]) -> str:
    return " and ".join(repr(names[k]) for k in ids)
