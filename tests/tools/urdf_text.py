"""URDF files as text: elements, small robots, and random robots."""

import random

import numpy as np
import torch
from robots import same as same
from rotations import flat, rotation

import torchdq
from torchdq import dq

LIMIT = '<limit lower="-1" upper="2" velocity="3" effort="4"/>'
ENTRIES = ("ixx", "ixy", "iyy", "ixz", "iyz", "izz")
ORDINARY = (0.04, 0.001, 0.05, -0.002, 0.003, 0.03)  # an inertia without any symmetry

# --- elements --------------------------------------------------------------------------------------------------------


def words(x):
    """Numbers as text, with all digits; text as it is."""
    return x if isinstance(x, str) else " ".join(map(repr, map(float, np.ravel(x))))


def link(name, mass=1.0, inertia=ORDINARY, xyz=(0.02, -0.03, 0.1), rpy=(0, 0, 0), more=""):
    """A <link>; without mass it has no <inertial>."""
    if mass is None:
        return f'<link name="{name}">{more}</link>'
    entries = " ".join(f'{key}="{words(value)}"' for key, value in zip(ENTRIES, inertia, strict=True))
    origin = f'<origin xyz="{words(xyz)}" rpy="{words(rpy)}"/>'
    inertial = f'<inertial>{origin}<mass value="{words(mass)}"/><inertia {entries}/></inertial>'
    return f'<link name="{name}">{inertial}{more}</link>'


def joint(name, parent, child, kind="revolute", xyz=(0, 0, 0), rpy=(0, 0, 0), axis=(0, 0, 1), more=LIMIT):
    """A <joint>."""
    ends = f'<parent link="{parent}"/><child link="{child}"/>'
    axis = "" if axis is None else f'<axis xyz="{words(axis)}"/>'
    origin = f'<origin xyz="{words(xyz)}" rpy="{words(rpy)}"/>'
    return f'<joint name="{name}" type="{kind}">{ends}{origin}{axis}{more}</joint>'


def fixed(name, parent, child, xyz=(0, 0, 0), rpy=(0, 0, 0)):
    """A fixed <joint>."""
    return joint(name, parent, child, "fixed", xyz, rpy, axis=None, more="")


def mimic(driver, multiplier=1, offset=0):
    """A <mimic>."""
    return f'<mimic joint="{driver}" multiplier="{multiplier}" offset="{offset}"/>'


def urdf(*elements, name="arm"):
    """A file."""
    return f'<robot name="{name}">' + "".join(elements) + "</robot>"


def also(more, text=None):
    """A file, or an arm, with more elements at its end."""
    return (text or arm()).replace("</robot>", more + "</robot>")


# --- robots ----------------------------------------------------------------------------------------------------------


def arm(**upper):
    """Two joints: base - shoulder - upper - elbow - lower; arguments are those of the upper link."""
    return urdf(
        link("base", None),
        link("upper", **upper),
        link("lower", 0.5, xyz=(0, 0.2, 0)),
        joint("shoulder", "base", "upper", axis=(0, 1, 0), xyz=(0, 0, 0.3)),
        joint("elbow", "upper", "lower", axis=(1, 0, 0), xyz=(0.1, 0, 0.4)),
    )


def tree(order=None):
    """A trunk with a left arm of two joints and a right arm of one; `order` shuffles the elements of the file."""
    elements = [
        link("base", None),
        *(link(name, mass) for name, mass in (("trunk", 3.0), ("left1", 1.0), ("left2", 0.5), ("right1", 0.8))),
        joint("waist", "base", "trunk", axis=(0, 0, 1)),
        joint("left_a", "trunk", "left1", axis=(0, 1, 0), xyz=(0, 0.2, 0.5)),
        joint("left_b", "left1", "left2", axis=(1, 0, 0), xyz=(0, 0.3, 0)),
        joint("right_a", "trunk", "right1", axis=(0, 1, 0), xyz=(0, -0.2, 0.5)),
    ]
    if order is not None:
        random.Random(order).shuffle(elements)
    return urdf(*elements)


def random_elements(seed, n=8, kinds=("revolute", "prismatic", "fixed", "fixed")):
    """Elements of a tree of n joints of these kinds in shuffled order, with bodies, axes and placements of any kind."""
    rng = np.random.default_rng(seed)
    found = [link("l0", 2.0)]
    for i in range(1, n + 1):
        moments = np.diag(rng.uniform(0.1, 0.2, 3))
        R = rotation(rng.uniform(-3, 3, 3))
        body = (rng.uniform(0.1, 2), flat(R @ moments @ R.T), rng.normal(size=3), rng.uniform(-3, 3, 3))
        axis = rng.normal(size=3)
        limit = f'<limit lower="{-rng.uniform(1, 2)}" upper="{rng.uniform(1, 2)}" velocity="{i}" effort="{i}"/>'
        found.append(link(f"l{i}", *body) if rng.random() < 0.8 else link(f"l{i}", None))
        place = rng.normal(size=3), rng.uniform(-3, 3, 3)
        parent = f"l{max(0, i - int(rng.integers(1, 4)))}"
        found.append(
            joint(f"j{i}", parent, f"l{i}", str(rng.choice(kinds)), *place, axis / np.linalg.norm(axis), limit)
        )
    rng.shuffle(found)
    return found


# --- robots of files -------------------------------------------------------------------------------------------------


def position(robot, q, frame):
    """Position of a frame."""
    return dq.translation(torchdq.forward_kinematics(robot, torch.tensor(q, dtype=torch.float64), frame))


def codes(robot, severity=("error", "warning", "note")):
    """Codes and subjects of a robot's notes."""
    return {(note.code, note.subject) for note in robot.notes if note.severity in severity}
