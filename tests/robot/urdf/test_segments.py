"""Links and joints of real files stand where Pinocchio puts them, and Pinocchio is not needed for it."""

import sys
from functools import partial

import numpy as np
import oracles
import pinocchio as pin
import pytest
import torch
from helpers import thinned
from rotations import flat
from urdf_text import fixed, joint, link, urdf

from torchdq import Robot, dq
from torchdq.robot.urdf import read as urdf_reader

NAMES = [name for name in oracles.urdf_paths() if name not in oracles.UNREADABLE]
FEW = (*oracles.REPRESENTATIVE_ROBOTS, *oracles.JOINTLESS, "talos_full_v2", "tiago_dual")


def matrix(X):
    return dq.to_matrix(X).numpy()


@pytest.mark.parametrize("name", thinned(NAMES, FEW[::2]))
def test_links_and_joints_are_placed_as_by_pinocchio(name):
    path = oracles.urdf_paths()[name]
    found = urdf_reader.read(path, mimic="independent")
    model = pin.buildModelFromUrdf(str(path))
    assert found.joint_names == tuple(model.names)[1:]
    assert found.parents == tuple(int(parent) - 1 for parent in model.parents)[1:]
    frames = [frame for frame in model.frames if frame.type == pin.FrameType.BODY]
    assert [frame.name for frame in found.frames] == [frame.name for frame in frames]
    for ours, theirs in zip(found.frames, frames, strict=True):
        assert ours.link == theirs.parentJoint - 1
        np.testing.assert_allclose(matrix(ours.X_BF), theirs.placement.homogeneous, rtol=0, atol=2e-15)
    for i, placement in enumerate(list(model.jointPlacements)[1:]):
        np.testing.assert_allclose(matrix(found.X_PB_home[i]), placement.homogeneous, rtol=0, atol=2e-15)
    for i, body in enumerate(list(model.inertias)[1:]):
        np.testing.assert_allclose(found.mass[i], body.mass, rtol=4e-15)
        np.testing.assert_allclose(found.com[i], body.lever, rtol=0, atol=2e-14)
        size = 1e-14 * np.abs(body.inertia).max() + 1e-14 * body.mass
        np.testing.assert_allclose(found.inertia[i], flat(body.inertia), 0, size)


def test_a_file_is_read_without_pinocchio(monkeypatch):
    """No module that reads files imports it at its top, which `claims/test_architecture.py` holds."""
    monkeypatch.setitem(sys.modules, "pinocchio", None)  # an import raises
    assert Robot.from_urdf(oracles.urdf_paths()["baxter"], on_unphysical="ignore", lock="*_w?").n > 5


def comb(n, kind):
    """Chain of n links, on fixed joints and joints of a kind by turns."""
    kinds = (fixed, partial(joint, kind=kind, axis=(0, 1, 0), more=""))
    places = {"rpy": (0.1, 0.2, 0.3), "xyz": (0, 0, 0.1)}
    joints = (kinds[i % 2](f"j{i}", f"l{i}", f"l{i + 1}", **(places if i % 2 == 0 else {})) for i in range(n - 1))
    return urdf(*(link(f"l{i}") for i in range(n)), *joints)


def test_a_tree_may_be_deep_and_poses_stay_unit():
    description = urdf_reader.read(comb(1100, "continuous"))
    assert len(description.joint_names) == 549 and len(description.frames) == 1100
    X = torch.stack([frame.X_BF for frame in urdf_reader.read(comb(1100, "fixed")).frames])
    assert float((X[:, :4].norm(dim=-1) - 1).abs().max()) < 1e-15
    assert float((X[:, :4] * X[:, 4:]).sum(-1).abs().max()) < 1e-12 * float(X[:, 4:].abs().max())
