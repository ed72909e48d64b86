"""Planar joints of a URDF file as what they are made of: two slides in the plane and a turn about its normal."""

from __future__ import annotations

import math
from collections.abc import Mapping

from torchdq.algebra.quaternion import ZERO, Pure
from torchdq.robot.urdf.elements import Inertial, UrdfJoint

PARTS = ("x", "y", "angle")  # ends of the names of the joints
UNLIMITED = {"lower": -math.inf, "upper": math.inf, "velocity": math.inf, "effort": math.inf}


def taken_apart(
    links: Mapping[str, Inertial | None], joints: Mapping[str, UrdfJoint], faults: list[str]
) -> tuple[dict[str, Inertial | None], dict[str, UrdfJoint]]:
    """Links and joints with two more links and three joints in place of each planar joint."""
    more, found = dict(links), dict(joints)
    for name, joint in joints.items():
        if joint.kind != "planar":
            continue
        names = [f"{name}_{part}" for part in PARTS]
        if taken := [x for x in names if x in joints] + [x for x in names[:2] if x in links]:
            faults.append(f"joint {name!r}: its parts are named {', '.join(names)}, but the file has {taken} already")
            continue
        del found[name]
        more |= dict.fromkeys(names[:2])
        ends = [joint.parent, *names[:2], joint.child]
        axes = (*_beside(joint.axis), joint.axis)
        for i, part in enumerate(names):
            found[part] = joint._replace(
                kind="continuous" if i == 2 else "prismatic",
                parent=ends[i],
                child=ends[i + 1],
                origin=joint.origin if i == 0 else {"xyz": ZERO, "rpy": ZERO},
                axis=axes[i],
                limits=UNLIMITED,
                mimics=None,
            )
    return more, found


def _beside(axis: Pure) -> tuple[Pure, Pure]:
    """Two unit vectors that make a right-handed frame with an axis, x and y for z (Duff et al., JCGT 6(1), 2017)."""
    x, y, z = axis
    s = math.copysign(1.0, z)
    a = -1.0 / (s + z)
    b = x * y * a
    return (1.0 + s * x * x * a, s * b, -s * x), (b, s + y * y * a, -y)
