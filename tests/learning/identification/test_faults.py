"""A joint's zero or sign, a drive's constant and a tilted base are named, and nothing where there are none."""

import math

import pytest
import torch
from helpers import thinned
from recorded_logs import codes, fitted, recorded, with_findings

import torchdq
from torchdq.learning import Samples

JOINTS = torchdq.robots.load("ur10e").joint_names


def faulty(kind, j=0, size=0.0):
    """Samples of an arm whose masses are off by 30 %, with a fault."""
    robot, data = recorded("ur10e", noise=0.005)
    unit = torch.eye(robot.n).double()[j]
    if kind == "joint.zero":
        return robot, data._replace(q=data.q + size * unit)
    if kind == "motion.sign":  # of a joint, in all signals
        return robot, type(data)(*(x * (1 - 2 * unit) for x in data))
    if kind == "torque.factor":
        return robot, data._replace(tau=data.tau * (1 + (size - 1) * unit))
    if kind == "payload.changed":
        held = robot.with_payload(size, (0.0, 0.0, 0.05))
        more = torchdq.inverse_dynamics(held, *data[:3]) - torchdq.inverse_dynamics(robot, *data[:3])
        more[: len(more) // 2] = 0
        return robot, data._replace(tau=data.tau + more)
    if kind == "time.scale":  # of steps that are longer than said
        return robot, data._replace(qd=data.qd * size, qdd=data.qdd * size**2)
    if kind == "base.tilt":  # the description stands upright, and the arm does not
        a = torch.tensor(size).double()
        robot = robot.replace(gravity=9.81 * torch.stack([a.sin() * 0.6, a.sin() * 0.8, -a.cos()]))
    return robot, data


OF_JOINTS = ("joint.zero", "torque.factor", "motion.sign")
FAULTS = [
    ("joint.zero", 3, -0.2),
    ("motion.sign", 4, None),
    ("joint.zero", 2, -math.pi / 2),
    ("torque.factor", 2, 0.7),
    ("base.tilt", 0, math.radians(40)),
    ("payload.changed", 0, 5.0),
    ("time.scale", 0, 0.5),
]  # an angle that is not its sine


@pytest.mark.parametrize(("kind", "j", "size"), thinned([("joint.zero", 1, 0.3), *FAULTS], FAULTS[::2]))
def test_faults_are_named_with_their_size(kind, j, size):
    robot, data = faulty(kind, j, size)
    found, (one,) = with_findings(fitted, robot, *data)
    assert one.code == kind and one.subject == (JOINTS[j] if kind in OF_JOINTS else "")
    assert one.value == (size and pytest.approx(size, rel=0.05)) and one in found.findings


def test_faults_that_explain_as_much_are_named_too():
    """A wrist that turns the other way is one whose joint before it has turned round."""
    robot, data = faulty("motion.sign", 4)
    _, (one,) = with_findings(fitted, robot, *data)
    assert one.subject == JOINTS[4] and f"or at {JOINTS[3]} with" in one.found


def test_there_are_none_of_an_arm_that_is_only_heavier():
    robot, data = recorded("ur10e", noise=0.005)
    held = robot.with_payload(2.0, (0.0, 0.0, 0.05))
    more = torchdq.inverse_dynamics(held, *data[:3]) - torchdq.inverse_dynamics(robot, *data[:3])
    for tau in (data.tau, data.tau + more):
        found, findings = with_findings(fitted, robot, *data[:3], tau)
        assert not findings
        assert all((one.code, one.severity) == ("mass.far", "note") for one in found.findings)


def test_what_happens_in_a_quarter_of_a_log_has_a_finding():
    robot, data = recorded("ur10e", noise=0.005)
    tau = data.tau.clone()
    contact = torch.randn(len(tau) // 4, generator=torch.Generator().manual_seed(0)).double()
    tau[len(tau) // 2 : len(tau) // 2 + len(contact), 2] += 0.5 * data.tau[:, 2].std() * contact
    _, (one,) = with_findings(fitted, robot, *data[:3], tau)
    assert (one.code, one.subject) == ("residual.uneven", JOINTS[2]) and "quarter 3" in one.found


def test_masses_far_off_and_single_motions_are_noted():
    robot, data = recorded("two_link", noise=0.005)
    light = robot.replace(mass=robot.mass / torch.tensor([1.0, 5.0]).double())
    found, _ = with_findings(torchdq.learning.identify, light, Samples(*data))
    notes = {(one.code, one.subject) for one in found.findings if one.severity == "note"}
    assert {("mass.far", robot.link_names[1]), ("motion.single", "")} <= notes
    assert codes(found.findings)[-1] == "mass.far"
