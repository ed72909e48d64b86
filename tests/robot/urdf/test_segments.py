"""Links and joints of real files stand where Pinocchio puts them, and Pinocchio is not needed for it."""

import subprocess
import sys
import textwrap
from functools import partial

import numpy as np
import oracles
import pinocchio as pin
import pytest
import torch
from urdf_text import fixed, joint, link, urdf

from torchdq import dq
from torchdq.robot.urdf import read as urdf_reader

NAMES = [name for name in oracles.urdf_paths() if name not in oracles.UNREADABLE]


def matrix(X):
    return dq.to_matrix(X).numpy()


@pytest.mark.parametrize("name", NAMES)
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
        I = body.inertia
        size = 1e-14 * np.abs(I).max() + 1e-14 * body.mass
        np.testing.assert_allclose(found.inertia[i], [I[0, 0], I[0, 1], I[1, 1], I[0, 2], I[1, 2], I[2, 2]], 0, size)


def test_a_file_is_read_without_pinocchio():
    code = """
        import sys
        sys.modules["pinocchio"] = None  # an import raises
        import torchdq
        robot = torchdq.Robot.from_urdf(sys.argv[1], on_unphysical="ignore", lock="*_w?")
        print(robot.n)
    """
    path = str(oracles.urdf_paths()["baxter"])
    done = subprocess.run([sys.executable, "-c", textwrap.dedent(code), path], capture_output=True, text=True)
    assert done.returncode == 0 and int(done.stdout) > 5, done.stderr


def comb(n, kind):
    """Chain of n links, on fixed joints and joints of a kind by turns."""
    kinds = (fixed, partial(joint, kind=kind, axis=(0, 1, 0), more=""))
    places = {"rpy": (0.1, 0.2, 0.3), "xyz": (0, 0, 0.1)}
    joints = (kinds[i % 2](f"j{i}", f"l{i}", f"l{i + 1}", **(places if i % 2 == 0 else {})) for i in range(n - 1))
    return urdf(*(link(f"l{i}") for i in range(n)), *joints)


def test_a_tree_may_be_deep_and_poses_stay_unit():
    description = urdf_reader.read(comb(2000, "continuous"))
    assert len(description.joint_names) == 999 and len(description.frames) == 2000
    X = torch.stack([frame.X_BF for frame in urdf_reader.read(comb(2000, "fixed")).frames])
    assert float((X[:, :4].norm(dim=-1) - 1).abs().max()) < 1e-15
    assert float((X[:, :4] * X[:, 4:]).sum(-1).abs().max()) < 1e-12 * float(X[:, 4:].abs().max())
