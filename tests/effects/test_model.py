"""Model effects: gravity, rotors, payloads and scaled masses, against changed models of pinocchio."""

import dataclasses
import itertools

import numpy as np
import pinocchio as pin
import pytest
from effect_harness import CASES, ON_ROBOTS, SAMPLES, accelerations, agrees, bare, close, double, given, pinocchio
from helpers import thinned

from torchdq import Scene, effects
from torchdq.scene import State


@pytest.mark.parametrize("form", ["list", "tensor", "batched"])
@pytest.mark.parametrize("name", CASES)
def test_gravity_pulls_in_its_direction(name, form):
    b = bare(name)
    g, values = given(form, -9.0, 9.0, 3, 0)
    models = [pin.Model(b.model) for _ in range(SAMPLES)]
    for model, vector in zip(models, values, strict=True):
        model.gravity.linear = vector
    assert agrees(b, effects.Gravity(g), model=models)


@pytest.mark.parametrize("own", [True, False], ids=["its own", "none"])
@pytest.mark.parametrize("name", CASES)
def test_gravity_is_the_robots_own_or_points_downwards(name, own):
    b = bare(name)
    model = pin.Model(b.model)
    model.gravity.linear = b.robot.gravity.numpy() if own else np.array([0.0, 0.0, -9.81])
    if not own:
        b = b._replace(case=dataclasses.replace(b.case, robot=b.robot.replace(gravity=None)))
    assert agrees(b, effects.Gravity(), model=model)


@pytest.mark.parametrize(("name", "form"), ON_ROBOTS)
def test_rotors_add_to_the_diagonal_of_the_mass_matrix(name, form):
    b = bare(name)
    inertia, values = given(form, 0.05, 2.0, b.n, 0)
    expected = pinocchio(b, implicit=values)
    assert close(accelerations(b, effects.RotorInertia(inertia)), *expected)


def test_rotors_are_the_robots_own_unless_given_and_add_up():
    b = bare("tree")
    expected = pinocchio(b, implicit=np.broadcast_to(b.robot.armature.numpy() + 0.5, (SAMPLES, b.n)))
    assert close(accelerations(b, (effects.RotorInertia(), effects.RotorInertia(0.5))), *expected)


def full(row):
    xx, xy, yy, xz, yz, zz = row
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


@pytest.mark.parametrize("form", thinned(["constant", "tensor", "batched", "masses"], ("batched", "masses")))
@pytest.mark.parametrize("frame", ["tip", "link"])
@pytest.mark.parametrize("name", CASES)
def test_a_payload_is_a_body_more(name, frame, form):
    b = bare(name)
    link = b.robot.link_names[b.n // 2]
    frame = b.robot.end_effector().name if frame == "tip" else link
    rng = np.random.default_rng(3)
    rows = SAMPLES if form == "batched" else 1
    mass, com = rng.uniform(0.5, 3.0, rows), rng.normal(size=(rows, 3)) * 0.2
    masses = mass[0] + np.arange(SAMPLES) if form == "masses" else np.resize(mass, SAMPLES)
    spread = rng.normal(size=(rows, 3, 3)) * 0.1
    second = spread @ spread.swapaxes(-1, -2) * mass[:, None, None]  # of a body about its centre of mass
    inertia = np.trace(second, axis1=-2, axis2=-1)[:, None, None] * np.eye(3) - second
    six = inertia[:, (0, 0, 1, 0, 1, 2), (0, 1, 1, 2, 2, 2)]
    models = []
    for k in range(SAMPLES):
        model = pin.Model(b.model)
        at = model.frames[b.case.frame_id(frame)]
        held = pin.Inertia(masses[k], com[k % rows], inertia[k % rows])
        model.appendBodyToJoint(at.parentJoint, held, at.placement)
        models.append(model)
    parameters = {
        "constant": lambda: (float(mass[0]), com[0].tolist(), six[0].tolist()),
        "tensor": lambda: (double(mass[0]), double(com[0]), double(six[0])),
        "batched": lambda: (double(mass), double(com), double(six)),
        "masses": lambda: (double(masses), com[0].tolist(), six[0].tolist()),
    }[form]()
    assert agrees(b, effects.Payload(*parameters, frame=frame), model=models)


@pytest.mark.parametrize(("name", "form"), ON_ROBOTS)
def test_denser_links_have_more_mass_and_inertia_about_the_same_centres(name, form):
    b = bare(name)
    factor, values = given(form, 0.5, 2.0, b.n, 0)
    models = []
    for row in values:
        model = pin.Model(b.model)
        for i, joint in enumerate(b.case.joints):
            body = model.inertias[joint.id]
            model.inertias[joint.id] = pin.Inertia(body.mass * row[i], body.lever, body.inertia * row[i])
        models.append(model)
    assert agrees(b, effects.MassScale(factor), model=models)


def test_payloads_are_not_scaled_with_the_links_wherever_they_stand():
    b = bare("tree")
    parts = (
        effects.MassScale(2.0),
        effects.Payload(1.0, (0.0, 0.1, 0.2)),
        effects.MassScale(1.5),
        effects.Payload(0.5),
    )
    heavy = b.case.robot.replace(mass=3.0 * b.case.robot.mass, inertia=3.0 * b.case.robot.inertia, armature=None)
    q, qd, u = b.q[:2], b.qd[:2], b.u[:2]
    expected = Scene(heavy, parts[1::2]).step(State(q, qd), u)
    for order in itertools.permutations(parts):
        found = Scene(b.case.robot, order).step(State(q, qd), u)
        assert close(found.qd, expected.qd, float(expected.qd.abs().max()))
