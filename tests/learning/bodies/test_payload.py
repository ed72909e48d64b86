"""Payloads from seconds of motion: exact from exact torques, as far off as stated from noisy ones, always physical.

The references are `Robot.with_payload`, draws of the noise, and recordings of a UR10e with and without a known mass.
"""

import math
import warnings

import pytest
import torch
from helpers import EVERYTHING, all_in_one, random, thinned
from messages import refused, warned
from recorded_logs import fitted, recordings

import torchdq
from torchdq.errors import ArgumentError, UnknownNameError
from torchdq.learning import LogWarning, Model, Motion, identify, identify_payload, read_log, smooth, stack_samples
from torchdq.robot.pseudo_inertia import bodies_of, inertial_parameters, moved, pseudo_inertia

MASS, COM, INERTIA = 2.0, (0.03, -0.02, 0.1), (0.01, 0.002, 0.02, 0.001, -0.001, 0.015)
TRUTH = torch.tensor([MASS, *COM, *INERTIA], dtype=torch.float64)


def moving(rows, seed=0, n=6):
    """Random positions, velocities and accelerations [3, rows, n]."""
    return random(3, rows, n, seed=seed)


def with_friction(robot, q, qd, qdd, seed=None):
    """Torques with friction, and with noise of 0.2 N m if there is a seed."""
    tau = torchdq.inverse_dynamics(robot, q, qd, qdd) + 3 * qd + 5 * qd / (qd**2 + 1e-4).sqrt()
    return tau if seed is None else tau + 0.2 * random(*tau.shape, seed=seed)


def exact(robot, q, qd, qdd):
    """Robot identified from exact torques."""
    return fitted(robot, q, qd, qdd, torchdq.inverse_dynamics(robot, q, qd, qdd), friction=None)


def values(found):
    return torch.cat([found.mass[None], found.com, found.inertia])


@pytest.fixture(scope="module")
def arm():
    return torchdq.robots.load("ur10e")


@pytest.fixture(scope="module")
def empty(arm):
    """Identified arm without payload, from noisy torques with friction."""
    moved = moving(2000)
    return fitted(arm, *moved, with_friction(arm, *moved, seed=1))


def test_moved_parameters_are_those_of_a_body_held_in_a_frame(arm):
    frame = arm.frame("tip")
    change = (arm.with_payload(MASS, COM, INERTIA).inertial_parameters - arm.inertial_parameters).reshape(-1, 10)
    J = pseudo_inertia(moved(frame.X_BF).inverse() @ change[frame.link])
    for x, y in zip(bodies_of(torch.linalg.cholesky(J)), (TRUTH[0], TRUTH[1:4], TRUTH[4:]), strict=True):
        assert torch.allclose(x, y, atol=1e-7)
    assert torch.allclose(moved(frame.X_BF) @ inertial_parameters(J), change[frame.link], atol=1e-12)


@pytest.mark.parametrize("frame", thinned([None, "wrist_2_link"], ["wrist_2_link"]))
def test_exact_torques_give_the_exact_payload(arm, frame):
    moved = moving(300)
    heavy = arm.with_payload(MASS, COM, INERTIA, frame=frame)
    tau = torchdq.inverse_dynamics(heavy, *moved)
    found = identify_payload(exact(arm, *moved), *moved, tau, frame=frame, prior=1e-4)
    assert found.frame == frame or frame is None
    assert torch.allclose(values(found), TRUTH, rtol=1e-3, atol=1e-4)
    again, expected = (torchdq.inverse_dynamics(robot, *moving(20, seed=3)) for robot in (found.robot, heavy))
    assert float((again - expected).abs().max()) < 1e-3 * float(expected.abs().max())


def test_errors_are_those_that_noise_makes(arm, empty):
    """Mean square of the deviations over the stated errors, over draws of the noise of 150 samples each."""
    heavy = arm.with_payload(MASS, COM, INERTIA)
    squares = []
    for k in range(40 if EVERYTHING else 8):
        q, qd, qdd = moving(150, seed=10 + k)
        found = identify_payload(empty, q, qd, qdd, with_friction(heavy, q, qd, qdd, seed=k), prior=1e-3)
        errors = torch.cat([found.mass_error[None], found.com_error, found.inertia_error])
        squares.append(((values(found) - TRUTH) / errors) ** 2)
    # the error of the empty arm is the same in all draws; correlation times of noise come out a little above one
    assert 0.4 < float(torch.stack(squares)[:, :4].mean()) < 1.6
    assert 0.3 < float(torch.stack(squares)[:, 4:].mean()) < 1.6


def test_friction_and_offset_may_have_changed(arm, empty):
    q, qd, qdd = moving(600, seed=4)
    tau = with_friction(arm.with_payload(MASS, COM, INERTIA), q, qd, qdd) + qd + 2 * qd / (qd**2 + 1e-4).sqrt() + 1.5
    found = identify_payload(empty, q, qd, qdd, tau, friction=True, offset=True)
    with warned(LogWarning):
        without = identify_payload(empty, q, qd, qdd, tau)
    assert float(found.rms.max()) < 0.1 < float(without.rms.min())
    assert abs(float(found.mass) - MASS) < 0.02
    assert bool((found.before > found.rms).all())


@pytest.mark.filterwarnings("ignore:no payload explains")
def test_a_payload_can_exist_however_few_the_samples(arm, empty):
    q, qd, qdd = moving(4, seed=5)
    for sign in (1, -1):
        tau = empty.predict(q, qd, qdd).tau + 5 * sign * random(4, 6)
        found = identify_payload(empty, q, qd, qdd, tau)
        second = pseudo_inertia(torch.cat([torch.zeros(4).double(), found.inertia]))[1:, 1:]
        assert float(found.mass) > 0 and float(torch.linalg.eigvalsh(second).min()) > 0
        found.robot.check()


def test_correlated_faults_of_the_empty_arm_widen_the_errors(arm, empty):
    q, qd, qdd = moving(300, seed=6)
    tau = empty.predict(q, qd, qdd).tau
    held, bare = (torchdq.inverse_dynamics(robot, q, qd, qdd) for robot in (arm.with_payload(MASS), arm))
    loaded = tau + held - bare
    slow = 2 * torch.sin(torch.linspace(0, 12, 300)).double()[:, None]
    mixed = slow[torch.randperm(300, generator=torch.Generator().manual_seed(0))]
    found = [
        float(identify_payload(empty, q, qd, qdd, loaded, reference=reference).mass_error)
        for reference in (None, (q, qd, qdd, tau + mixed), (q, qd, qdd, tau + slow))
    ]
    assert found[1] > 2 * found[0] and found[2] > 2 * found[1]


def test_no_payload_is_none_within_its_error(arm, empty):
    for k in range(3):
        q, qd, qdd = moving(300, seed=20 + k)
        tau = empty.predict(q, qd, qdd).tau + 0.2 * random(300, 6, seed=k)
        found = identify_payload(empty, q, qd, qdd, tau)
        assert 0 < float(found.mass) < 3 * float(found.mass_error) < 0.05


MISUSE = {
    "a robot": lambda empty, x: identify_payload(empty.robot, *[x] * 4),
    "unknown frame": lambda empty, x: identify_payload(empty, *[x] * 4, frame="hand"),
    "base": lambda empty, x: identify_payload(empty, *[x] * 4, frame="base"),
    "shoulder": lambda empty, x: identify_payload(empty, *held(empty.robot), frame="shoulder_link"),
    "upper arm": lambda empty, x: identify_payload(empty, *held(empty.robot), frame="upper_arm_link"),
    "no rows": lambda empty, x: identify_payload(empty, *[x[0]] * 4),
    "half a reference": lambda empty, x: identify_payload(empty, *[x] * 4, reference=(x, x)),
    "not finite": lambda empty, x: identify_payload(empty, x, x, x, x / 0),
    "no torques": lambda empty, x: identify_payload(empty, x, x, x),
}


@all_in_one(MISUSE)
def test_misuse_is_refused(misuse, empty):
    with refused((ArgumentError, UnknownNameError)):
        MISUSE[misuse](empty, random(10, 6))


def held(arm, rows=400, seed=7):
    """Motion with a payload, with torques as those of the empty arm."""
    moved = moving(rows, seed=seed)
    return *moved, with_friction(arm.with_payload(MASS, COM), *moved, seed=seed)


def test_torques_of_a_payload_are_explained(arm, empty):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert identify_payload(empty, *held(arm)).findings == ()


def held_by_friction(arm, moved):
    """Torques with a payload, of rows whose every third is at rest, held by dry friction of any size up to its own."""
    q, qd, qdd = moved
    qd[::3] = qdd[::3] = 0
    tau = with_friction(arm.with_payload(MASS, COM), q, qd, qdd, seed=7)
    tau[::3] += 10 * torch.rand(*tau[::3].shape, generator=torch.Generator().manual_seed(0)).double() - 5
    return q, qd, qdd, tau


def test_dry_friction_at_stops_is_explained(arm, empty):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert identify_payload(empty, *held_by_friction(arm, moving(400, seed=7))).findings == ()


def test_poses_approached_from_one_side_have_dry_friction_of_unknown_size(arm, empty):
    at_rest = [x[::3] for x in held_by_friction(arm, moving(60, seed=7))]
    with warned(LogWarning):
        findings = identify_payload(empty, *at_rest).findings
    assert {one.code for one in findings} == {"payload.unexplained"}


@pytest.mark.parametrize(
    ("wrong", "joints"),
    [
        (lambda tau: tau[:, [0, 2, 1, 3, 4, 5]], ("shoulder_lift_joint", "elbow_joint")),
        (lambda tau: -tau, ("shoulder_lift_joint", "elbow_joint")),
        (lambda tau: tau * torch.tensor([1, 1, 1.3, 1, 1, 1]), ("elbow_joint",)),
    ],
)
def test_torques_that_no_payload_explains_are_named_with_their_joints(arm, empty, wrong, joints):
    q, qd, qdd, tau = held(arm)
    with warned(LogWarning):
        found = identify_payload(empty, q, qd, qdd, wrong(tau)).findings
    subjects = {finding.subject for finding in found}
    assert subjects >= {*joints} if len(joints) > 1 else subjects == {*joints}
    assert all(finding.code == "payload.unexplained" and finding.value > 3 for finding in found)


def test_unidentifiable_parameters_of_the_payload_are_listed():
    """In a plane, one moment of inertia is identifiable, and the mass with it; those across the plane are not."""
    robot = torchdq.robots.load("two_link")
    q, qd, qdd = moving(300, n=2)
    tau = torchdq.inverse_dynamics(robot.with_payload(2.0, (0.0, 0.0, 0.0), frame="tip"), q, qd, qdd)
    found = identify_payload(exact(robot, q, qd, qdd), q, qd, qdd, tau)
    assert repr(found).startswith("IdentifiedPayload(") and "at 'tip'" in repr(found)
    assert "inertia yz" in str(found) and "standard error" in str(found)
    assert {"mz", "Ixx", "Iyy", "Ixy", "Ixz", "Iyz"} <= {*found.unidentifiable} and "m" not in found.unidentifiable
    assert "not identifiable one by one" in str(found) and float(found.mass) == pytest.approx(2.0, abs=0.01)


@pytest.fixture(scope="module")
def recorded(arm):
    """Identification of the empty UR10e, and its motion with and without 2.805 kg."""
    folder = recordings("ur10e_innopolis")
    from recordings import LAYOUTS

    def motion(name, rate=None):
        return smooth(read_log(folder / f"ur-20_01_31-{name}.csv", LAYOUTS["ur10e"]), rate=rate)

    few = motion("unload", 20.0)
    empty = identify(arm, few, Model(armature=True, offset=True))
    return empty, stack_samples(motion("load")), stack_samples(motion("unload"))


def test_a_known_mass_is_found_but_for_the_gains_of_the_drives(recorded):
    """The torques of this layout are about 12 % too small, and so is the mass."""
    empty, loaded, unloaded = recorded
    found = identify_payload(empty, *loaded, reference=unloaded)
    assert 0.86 < float(found.mass) / 2.805 < 0.92
    assert float(found.mass_error) < 0.08
    assert float(found.rms[1]) < 0.25 * float(found.before[1])


def test_seconds_of_motion_agree_within_their_errors(recorded):
    empty, loaded, unloaded = recorded
    parts = [[x[i : i + 500] for x in loaded] for i in range(0, 2000, 500)]
    found = [identify_payload(empty, *part, reference=unloaded) for part in parts]
    mass = torch.stack([x.mass for x in found])
    squares = ((mass - mass.mean()) / torch.stack([x.mass_error for x in found])).square()
    assert float(squares.mean()) < 3
    assert float(mass.std()) < 0.15
    assert math.isclose(float(mass.mean()), 2.5, rel_tol=0.1)


def test_motions_with_filtered_directions_are_predicted_by_them(arm):
    """Dry friction that a filter has rounded as it rounded the torques: the residual is that of the payload alone."""
    q, qd, qdd = moving(400, seed=7)
    rounded = (qd / 0.3).tanh()

    def motion(robot):
        tau = torchdq.inverse_dynamics(robot, q, qd, qdd) + 2.0 * rounded
        arrays = (x.numpy() for x in (0.01 * torch.arange(len(q)).double(), q, qd, qdd, tau))
        return Motion(*arrays, direction=rounded.numpy())

    empty = fitted(arm, motion(arm))
    with warnings.catch_warnings():
        warnings.simplefilter("error", LogWarning)
        found = identify_payload(empty, motion(arm.with_payload(2.0, (0.0, 0.0, 0.1))))
    assert abs(float(found.mass) - 2) < 1e-3 and float(found.rms.max()) < 1e-3
