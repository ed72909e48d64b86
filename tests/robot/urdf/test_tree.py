"""Links and joints of real files stand where Pinocchio puts them, and Pinocchio is not needed for it."""

import subprocess
import sys
import textwrap
import time

import numpy as np
import oracles
import pinocchio as pin
import pytest
import torch

import torchdq
from torchdq import Robot, dq
from torchdq.robot.urdf import read as urdf

NAMES = [name for name in oracles.urdf_paths() if name not in oracles.UNREADABLE]


def matrix(X):
    return dq.to_matrix(X).numpy()


@pytest.mark.parametrize("name", NAMES)
def test_links_and_joints_are_placed_as_by_pinocchio(name):
    path = oracles.urdf_paths()[name]
    found, *_ = urdf.read(path, None, None, mimic="independent")
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


def comb(n):
    """Chain of n links, joints and fixed joints by turns."""
    kinds = ('type="fixed"><origin rpy="0.1 0.2 0.3" xyz="0 0 0.1"/>', 'type="continuous"><axis xyz="0 1 0"/>')
    body = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
    links = "".join(f'<link name="l{i}">{body}</link>' for i in range(n))
    joints = "".join(
        f'<joint name="j{i}" {kinds[i % 2]}<parent link="l{i}"/><child link="l{i + 1}"/></joint>' for i in range(n - 1)
    )
    return f'<robot name="comb">{links}{joints}</robot>'


def test_a_tree_may_be_deep():
    begin = time.thread_time()
    description, faults, *_ = urdf.read(comb(2000), None, None)
    assert time.thread_time() - begin < 2.0 and not faults
    assert len(description.joint_names) == 999 and len(description.frames) == 2000


def test_poses_of_a_deep_tree_stay_unit():
    text = comb(2000).replace('type="continuous"', 'type="fixed"')
    description, *_ = urdf.read(text, None, None)
    X = torch.stack([frame.X_BF for frame in description.frames])
    assert float((X[:, :4].norm(dim=-1) - 1).abs().max()) < 1e-15
    assert float((X[:, :4] * X[:, 4:]).sum(-1).abs().max()) < 1e-12 * float(X[:, 4:].abs().max())


def test_a_locked_robot_moves_as_the_whole_one_does():
    path = oracles.urdf_paths()["baxter"]
    whole = Robot.from_urdf(path, on_unphysical="ignore")
    at = {name: 0.3 + 0.1 * i for i, name in enumerate(whole.joint_names[::3])}
    part = Robot.from_urdf(path, on_unphysical="ignore", lock=at)
    assert part.joint_names == tuple(name for name in whole.joint_names if name not in at)
    g = torch.Generator().manual_seed(0)
    q = torch.randn(5, part.n, generator=g, dtype=torch.float64)
    full = torch.stack(
        [
            q[:, part.joint_index(name)] if name not in at else torch.full((5,), at[name], dtype=torch.float64)
            for name in whole.joint_names
        ],
        -1,
    )
    kept = [whole.joint_index(name) for name in part.joint_names]
    M = torchdq.mass_matrix(whole, full, backend="eager")[:, kept][:, :, kept]
    found = torchdq.mass_matrix(part, q, backend="eager")
    assert float((found - M).abs().max()) < 1e-13 * float(M.abs().max())
