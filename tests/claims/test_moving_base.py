"""A moving base passes through every form of the algorithms: forces, base wrench, mass matrix, solutions, energies.

The reference is Pinocchio with a free-flyer whose body has an inertia of its own. A generalised force of the base is a
moment and a force in the base's frame, as its twist is (angular, linear); Pinocchio's order is the other way round.
"""

from functools import cache
from typing import NamedTuple

import numpy as np
import pinocchio as pin
import pytest
import torch
from free_flyers import B, FreeFlyer, case, motion, over
from helpers import thinned
from oracles import EPS, se3, stack

import torchdq
from torchdq.algebra import dual_quaternion as dq
from torchdq.algebra import quaternion as quat
from torchdq.algebra import screw
from torchdq.dynamics.aligned.posed import Aligned
from torchdq.dynamics.general.posed import General
from torchdq.dynamics.joints import KINDS, Coordinate
from torchdq.dynamics.posed import closed_form
from torchdq.functions import posed
from torchdq.paper import closed_form as paper_closed_form

F64 = torch.float64
X_BT = dq.from_pose((0.5, 0.5, -0.5, 0.5), (0.3, -0.2, 0.4))  # a tool on the last link


class Moving(NamedTuple):
    """A random robot on a floating base in every form, Pinocchio's model of it, and a motion."""

    case: FreeFlyer
    forms: dict[str, General | Aligned]
    v: torch.Tensor  # twist of the base (angular, linear), and joint velocities [B, 6 + n]
    a: torch.Tensor  # rate of the twist, and joint accelerations

    def pinocchio(self, function) -> np.ndarray:
        """Results of function(model, data, q, v, a, row) for every sample."""
        return over(function, self.case, motion(self.case))

    def forces(self, *still: str) -> np.ndarray:
        """Pinocchio's forces, in our order, with some parts of the motion zero."""
        m = motion(self.case)
        m = {name: 0 * x if name in still else x for name, x in m.items()}
        return over(lambda model, data, q, v, a, _: pin.rnea(model, data, q, v, a), self.case, m)[:, self.case.order]


@cache
def moving(name: str) -> Moving:
    c = case(name)
    m = motion(c)
    X_WB, q = (m["X_WB"][:, :4].unbind(-1), m["X_WB"][:, 4:].unbind(-1)), m["q"].unbind(-1)
    forms = {
        "general": posed.general(c.robot, q, {}, X_WB),
        "aligned": posed.aligned(c.robot, q, {}, False, X_WB),
        "grouped": posed.aligned(c.robot, q, {}, True, X_WB),
    }
    return Moving(c, forms, torch.cat([m["V_WB_B"], m["qd"]], -1), torch.cat([m["A_WB_B"], m["qdd"]], -1))


def near(found, expected, size=None, tolerance=1e-12):
    """Whether results are those expected, relative to their largest."""
    found, expected = np.asarray(found), np.asarray(expected)
    assert found.shape == expected.shape
    assert abs(found - expected).max() <= tolerance * (abs(expected).max() if size is None else size)


FORMS = pytest.mark.parametrize("form", ["general", "aligned", "grouped"])
EVERY = pytest.mark.parametrize("robot", thinned(["tree1", "tree4", "tree7", "tree12"], ["tree1", "tree7"]))


@FORMS
@EVERY
def test_forces_and_base_wrench_equal_pinocchios_with_a_free_flyer(robot, form):
    m = moving(robot)
    near(stack(m.forms[form].torques(m.v.unbind(-1), m.a.unbind(-1), None), (B,)), m.forces())


@FORMS
@EVERY
def test_the_mass_matrix_equals_pinocchios(robot, form):
    m = moving(robot)
    M = m.pinocchio(lambda model, data, q, *_: np.array(pin.crba(model, data, q)))
    M = np.triu(M) + np.triu(M, 1).swapaxes(-1, -2)
    near(stack(m.forms[form].mass_matrix(), (B,)), M[:, m.case.order][..., m.case.order])


def paper_terms(m: Moving):
    general = m.forms["general"]
    return [stack(x, (B,)) for x in paper_closed_form.closed_form(general.tree, general.Ad, m.v.unbind(-1))[:3]]


@EVERY
def test_the_closed_form_with_a_moving_base_is_the_recursion(robot):
    m = moving(robot)
    M, c, g = paper_terms(m)
    expected = m.forces()
    size = abs(expected).max()
    near((M @ m.a[..., None])[..., 0] + c + g, expected)
    near(c + g, m.forces("A_WB_B", "qdd"), size)
    near(g, m.forces("V_WB_B", "qd", "A_WB_B", "qdd"), size)


@FORMS
@EVERY
def test_the_terms_of_the_form_that_runs_are_those_of_the_paper(robot, form):
    m = moving(robot)
    for ours, papers in zip(closed_form(m.forms[form], m.v.unbind(-1)), paper_terms(m), strict=True):
        near(stack(ours, (B,)), papers)


@pytest.mark.parametrize("linear", [False, True])
@FORMS
@EVERY
def test_accelerations_undo_forces(robot, form, linear):
    m = moving(robot)
    at = m.forms[form]
    M = stack(at.mass_matrix(), (B,))
    b = (M @ m.a[..., None])[..., 0]
    x = stack(at.factors(linear).solve(b.unbind(-1)), (B,))
    bound = 64 * EPS[F64] * np.linalg.cond(M.numpy()).max() * m.a.norm(dim=-1).max()
    assert (x - m.a).norm(dim=-1).max() <= bound


@FORMS
@EVERY
def test_energies_equal_pinocchios(robot, form):
    m = moving(robot)
    at = m.forms[form]

    def kinetic(model, data, q, v, a, row):
        M = pin.crba(model, data, q)
        return 0.5 * v @ (np.triu(M) + np.triu(M, 1).T) @ v  # rotors included

    potential = m.pinocchio(lambda model, data, q, *_: pin.computePotentialEnergy(model, data, q))
    near(stack(at.kinetic_energy(m.v.unbind(-1)), (B,)), m.pinocchio(kinetic))
    near(stack(at.potential_energy(), (B,)), potential, np.maximum(abs(potential), 10.0).min())


@pytest.mark.parametrize("world", [False, True])
@FORMS
@EVERY
def test_jacobians_and_poses_equal_pinocchios(robot, form, world):
    m = moving(robot)
    at, i = m.forms[form], m.case.robot.n  # the last link
    reference = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED if world else pin.ReferenceFrame.LOCAL
    model = pin.Model(m.case.model)
    link = model.frames[m.case.frame_id(m.case.robot.link_names[-1])]
    placement = link.placement * se3([*X_BT[0], *X_BT[1]])
    tool = model.addFrame(pin.Frame("tool", link.parentJoint, placement, pin.FrameType.OP_FRAME))

    def jacobian(_, __, q, *rest):
        return pin.computeFrameJacobian(model, model.createData(), q, tool, reference)[[3, 4, 5, 0, 1, 2]]

    def pose(_, __, q, *rest):
        data = model.createData()
        pin.framesForwardKinematics(model, data, q)
        return data.oMf[tool].homogeneous

    J = stack([[0.0] * 6 if c is None else [*c[0], *c[1]] for c in at.jacobian(i, X_BT, world)], (B,)).mT
    expected = m.pinocchio(jacobian)[..., m.case.order]
    near(J, expected, max(1.0, abs(expected).max()))
    for X in [at.poses(), *([at.poses_in_chain()] if form != "general" else [])]:
        p, d = dq.mul(X[i], X_BT)
        near(torchdq.dq.to_matrix(stack([*p, *d], (B,))), m.pinocchio(pose), 1.0, 1e-11)


@EVERY
def test_poses_by_screws_in_the_base_frame_are_those_by_elementary_screws(robot):
    at = moving(robot).forms["aligned"]
    for found, expected in zip(at.poses_from_base(), at.poses_in_chain(), strict=True):
        pair = (dq.mul(found.motion, found.home), expected)  # which may differ in their sign
        found, expected = (torchdq.dq.to_matrix(stack([*p, *d], (B,))) for p, d in pair)
        near(found, expected, 1.0)


@FORMS
@EVERY
def test_twists_and_points_are_those_of_the_world(robot, form):
    """The velocity of a point is the derivative of its position along the motion."""
    m = moving(robot)
    at, i = m.forms[form], m.case.robot.n
    com, (w, v) = at.com(i), at.twists(m.v.unbind(-1))[i]
    near(stack(at.to_link(i, at.to_world(i, com)), (B,)), stack(com, (B,)), 1.0, 64 * EPS[F64])
    frame, lever = m.case.frame_id(m.case.robot.link_names[-1]), m.case.robot.com[-1].numpy()

    def moved(model, data, q, v, a, row):
        pin.forwardKinematics(model, data, q, v)
        pin.updateFramePlacements(model, data)
        twist = pin.getFrameVelocity(model, data, frame, pin.ReferenceFrame.LOCAL)
        velocity = data.oMf[frame].rotation @ (twist.linear + np.cross(twist.angular, lever))
        return [data.oMf[frame].act(lever), velocity]

    velocity = at.to_world(i, quat.add(v, quat.cross(w, com)))
    near(stack([list(at.position(i, com)), list(velocity)], (B,)), m.pinocchio(moved), 1.0, 1e-11)


@pytest.mark.parametrize("kind", KINDS)
def test_a_joint_moves_along_its_screw(kind):
    """The motion over a time is the exponential of the rate, times half of that time."""
    direction, point = (0.6, 0.0, 0.8), (0.2, -0.3, 0.5)
    moment = quat.add(quat.cross(point, direction), quat.scale(0.25 * (kind == "helical"), direction))
    joint = KINDS[kind](((0.0, 0.0, 0.0), direction) if kind == "prismatic" else (direction, moment))
    q, v, h = (torch.tensor(x, dtype=F64) for x in (0.7, -1.1, 0.3))

    def motion(q):
        p, d = joint.motion(Coordinate(q, (0.5 * q).cos(), (0.5 * q).sin()))
        return stack([*p, *d], ())

    step = torchdq.dq.exp(stack([x for part in screw.scale(0.5 * h, joint.rate((v,))) for x in part], ()))
    assert (torchdq.dq.mul(motion(q), step) - motion(q + h * v)).abs().max() <= 16 * EPS[F64]
