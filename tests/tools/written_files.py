"""Robots with other numbers, to be written into the files that they were read from, and what differs in the files."""

import xml.etree.ElementTree as ET

import numpy as np
import oracles
import torch

import torchdq
from torchdq.robot.description import Limits

TOLERANCE = 1e-12


def changed(robot: torchdq.Robot, seed: int = 0) -> torchdq.Robot:
    """Robot with other bodies, damping, friction and limits."""
    rng = np.random.default_rng(seed)
    bodies = [oracles.random_inertia(rng, 1.0) for _ in robot.link_names]
    inertia = robot.inertia + torch.tensor(np.array([I[np.tril_indices(3)] for I in bodies])).reshape(-1, 6)
    shift = 0.125 if robot.joint_map is None else -0.001  # limits that are wider than those of followers have no place
    finite = [x.where(x.isinf(), x + shift * k) for k, x in enumerate(robot.limits)]
    return robot.replace(
        mass=robot.mass + torch.from_numpy(rng.uniform(0.1, 1, len(robot.link_names))),
        com=robot.com + torch.from_numpy(rng.normal(size=(len(robot.link_names), 3))) * 0.1,
        inertia=inertia,
        damping=robot.damping + torch.from_numpy(rng.uniform(size=robot.n)),
        friction=robot.friction + torch.from_numpy(rng.uniform(size=robot.n)),
        limits=Limits(*finite),
        on_unphysical="ignore",
    )


def with_limit(robot: torchdq.Robot, field: str, i: int, value: float) -> torchdq.Robot:
    """Robot with another limit of a joint."""
    x = getattr(robot.limits, field).clone()
    x[i] = value
    return robot.replace(limits=robot.limits._replace(**{field: x}), on_unphysical="ignore")


def with_rows(robot: torchdq.Robot, field: str, rows) -> torchdq.Robot:
    """Robot with other rows of a field; None: as they are."""
    value = getattr(robot, field).clone()
    for i, row in enumerate(rows):
        if row is not None:
            value[i] = torch.as_tensor(row, dtype=torch.float64)
    return robot.replace(**{field: value}, on_unphysical="ignore")


def require_equal(a: torchdq.Robot, b: torchdq.Robot, tolerance: float = TOLERANCE) -> None:
    """Compare all numbers that are written."""
    pairs = {name: (getattr(a, name), getattr(b, name)) for name in ("mass", "com", "inertia", "damping", "friction")}
    pairs |= dict(zip(a.limits._fields, zip(a.limits, b.limits, strict=True), strict=True))
    for name, (x, y) in pairs.items():
        assert torch.allclose(x, y, rtol=tolerance, atol=tolerance), name
    assert (a.armature is None) == (b.armature is None)
    assert a.armature is None or torch.allclose(a.armature, b.armature, rtol=tolerance, atol=tolerance)


def elements(text: str) -> list[tuple[str, tuple[tuple[str, str], ...]]]:
    """Tags and attributes of all elements, and the comments, in the order of the text."""
    root = ET.fromstring(text, ET.XMLParser(target=ET.TreeBuilder(insert_comments=True)))
    return [("!", ((x.text or "", ""),)) if x.tag is ET.Comment else (x.tag, tuple(x.items())) for x in root.iter()]


def differences(old: str, new: str) -> dict[str, str]:
    """Attributes that differ, or are new, as "tag attribute"; elements that are new count with all theirs."""
    before, after, found = elements(old), elements(new), {}
    k = 0
    for tag, attributes in after:
        own = dict(before[k][1]) if k < len(before) and before[k][0] == tag else {}
        if k < len(before) and before[k][0] == tag and (own.keys() <= dict(attributes).keys() or tag == "inertial"):
            k += 1
        else:
            own = {}
        found |= {f"{tag} {key}": value for key, value in attributes if own.get(key) != value}
    assert k == len(before)  # all that was there still is
    return found
