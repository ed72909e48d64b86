"""Selection of models: what the motions identify is found, and nothing else is; on simulated arms and on recordings.

The truth is that of the simulation, made by `torchdq.inverse_dynamics` and the laws of friction written out here.
"""

import math
import re

import numpy as np
import pytest
import torch
from helpers import EVERYTHING, exhaustive, thinned
from places import DATA
from recorded_logs import (
    COULOMB,
    REAL,
    ROBOT,
    VISCOUS,
    WIDTH,
    dry,
    fitted,
    motion_of,
    noise,
    recordings,
    sign,
    states,
    torques,
    whitened,
    with_findings,
)

import torchdq
from torchdq import effects
from torchdq.learning import Layout, Model, Samples, identify, posterior_samples, read_log, smooth
from torchdq.learning.evaluation.blocks import of_tensors
from torchdq.learning.identification import model_selection, terms

BACKEND = "auto"  # one arm, whose programs all tests share

# --- candidates ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("robot", "friction", "name"),
    [(ROBOT, torch.zeros_like, "description"), (ROBOT, dry, "+ friction"), (REAL, dry, "identified")],
)
@pytest.mark.parametrize("motions", thinned([1, 4], [4]))
def test_the_candidate_that_is_the_truth_is_chosen(robot, friction, name, motions):
    q, qd, qdd = states(motions, 1200 // motions, seed=motions)
    found = identify(ROBOT, Samples(q, qd, qdd, torques(robot, q, qd, qdd, friction)))
    assert found.selection.chosen.name == name
    noise_alone = 0.01 / torchdq.inverse_dynamics(robot, q, qd, qdd).var((0, 1))
    assert found.selection.chosen.score < 2 * float(noise_alone.mean())
    if name != "identified":
        assert torch.equal(found.robot.mass, ROBOT.mass) and torch.equal(found.robot.com, ROBOT.com)


def test_rotors_are_found_at_the_joints_that_have_them_and_said():
    q, qd, qdd = states(6, 500, seed=3)
    rotor = torch.tensor([0.4, 0.0]).double()
    found = identify(ROBOT, Samples(q, qd, qdd, torques(ROBOT, q, qd, qdd, size=0.03) + rotor * qdd))
    assert float((found.robot.armature - rotor).abs().max()) < 0.02 and float(found.robot.armature[1]) == 0.0
    assert re.search(r"joint1: .*rotor \(", str(found.selection)) and not found.findings
    without = identify(ROBOT, Samples(q, qd, qdd, torques(ROBOT, q, qd, qdd, size=0.03)))
    assert without.robot.armature is None and "rotor" in without.selection.useless


def test_a_joint_that_no_body_explains_better_keeps_the_described_torques():
    """The elbow is as described, and noisy: its torques stay, whatever the shoulder asks of the bodies."""
    q, qd, qdd = states(6, 500, seed=3)
    real = ROBOT.replace(mass=ROBOT.mass * torch.tensor([1.6, 1.0]).double())
    tau = torques(real, q, qd, qdd) + torch.tensor([0.0, 0.5]).double() * noise(q.shape, 0.9, seed=5)
    found = identify(ROBOT, Samples(q, qd, qdd, tau), Model(offset=False, armature=False))
    assert found.selection.chosen.kept == ("joint2",)
    assert {one.kept for one in found.selection.candidates if one.name == "identified"} == {(), ("joint2",)}
    assert re.search(r"joint2 +chosen", str(found.selection))
    change = [torchdq.inverse_dynamics(one, q, qd, qdd) for one in (found.robot, ROBOT)]
    off, size = ((x**2).mean((0, 1)).sqrt() for x in (change[0] - change[1], change[1]))
    assert float(off[1] / size[1]) < 0.02 and float(off[0] / size[0]) > 0.1


def test_a_joint_that_moves_in_one_motion_keeps_the_description():
    q, qd, qdd = (x.clone() for x in states(4, 400, seed=3))
    for x in (qd, qdd):
        x[1:, :, 1] = 0
    q[1:, :, 1] = 0.3
    found = identify(ROBOT, Samples(q, qd, qdd, torques(REAL, q, qd, qdd)))
    assert "joint2" in found.selection.candidates[-1].kept and "joint1" not in found.selection.candidates[-1].kept


def test_the_simplest_as_good_as_the_best_is_chosen():
    """By the standard error of paired differences, not by those of the scores."""
    blocks = torch.tensor([1.0, 3.0, 9.0, 2.0])
    off = torch.tensor([0.3, -0.1, 0.2, -0.2])
    best = blocks[:, None]
    assert model_selection._simplest([best + 0.5, best + off[:, None], best]) == 1
    assert model_selection._simplest([best + 0.05 + 0.01 * off[:, None], best, best + 0.1]) == 1
    assert model_selection._simplest([best, best + 1]) == 0


SHAPES = {
    "load": (lambda qd, load: 0.12 * load.abs() * sign(qd), 0.12),
    "stribeck 0.1": (lambda qd, load: 1.5 * sign(qd) / (1 + (qd / 0.1) ** 2), 1.5),
    "saturating 0.3": (lambda qd, load: 2.0 * qd / (qd**2 + 0.3**2).sqrt(), 2.0),
    "quadratic": (lambda qd, load: 0.5 * qd * qd.abs(), 0.5),
    "forward": (lambda qd, load: 0.8 * sign(qd) * (1 + sign(qd)) / 2, 0.8),
    "ripple sine": (None, 0.7),
    "lugre 0.01": (None, 1.5),
}


@pytest.mark.parametrize("name", thinned(SHAPES, ("load", "stribeck 0.1", "ripple sine", "lugre 0.01")))
def test_friction_of_each_shape_is_found_with_its_size(name):
    q, qd, qdd = states(4, 600, seed=3)
    tau = torques(ROBOT, q, qd, qdd, size=0.03)
    law, size = SHAPES[name]
    if name == "ripple sine":
        tau = tau + size * q.sin()
    elif name == "lugre 0.01":
        z, bristles = torch.zeros_like(q[:, 0]), []
        for before, now in zip(q[:, :-1].unbind(1), q[:, 1:].unbind(1), strict=True):
            bristles.append(z)
            step = now - before  # dz/dq = (1 - z sign(dq)) / distance
            z = step.sign() + (z - step.sign()) * (-step.abs() / 0.01).exp()
        tau = tau + size * torch.stack([*bristles, z], 1)
    else:
        tau = tau + law(qd, torchdq.inverse_dynamics(ROBOT, q, qd, qdd))
    found = identify(ROBOT, Samples(q, qd, qdd, tau))
    number = found.coefficients(name)
    assert number is not None, found.selection
    assert float((number / size - 1).abs().max()) < 0.2
    assert name not in found.selection.useless
    assert re.search(rf"joint1: .*{re.escape(name)} \(", str(found.selection))
    clean = tau - 0.03 * noise(q.shape, 0.8)
    left = (found.predict(q, qd, qdd).tau.reshape(q.shape) - clean).square().mean((0, 1)).sqrt()
    assert bool((left < 0.03).all())


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("amplitude", thinned([0.0, 5e-4, 0.05], [0.05]))
def test_a_joint_that_hardly_moves_has_no_friction_that_depends_on_where_it_is(amplitude):
    """A wave is a slope and a constant there: a small fault of the model would make hundreds of N m of it."""
    q, qd, qdd = (x.clone() for x in states(5, 400, seed=3))
    k = amplitude / float(q[..., 1].abs().max())
    q[..., 1], qd[..., 1], qdd[..., 1] = 0.6 + k * q[..., 1], k * qd[..., 1], k * qdd[..., 1]
    tau = torques(REAL, q, qd, qdd) + 0.7 * q.sin() + (50 * (q - 0.6).square() if amplitude > 0.01 else 0)
    found = identify(ROBOT, Samples(q, qd, qdd, tau))
    asked = fitted(ROBOT, q, qd, qdd, tau, friction=(effects.Viscous(), effects.Ripple(2 * math.pi)))
    own = found.parameters[20:].reshape(-1, 2)[:, 1], found.errors[20:].reshape(-1, 2)[:, 1]
    assert not any("ripple" in gain.term for gain in found.selection.chosen.gains if gain.joint == "joint2")
    assert float(own[0].abs().max()) < 1.0 and float(own[1].max()) < 4.0
    waves = [k for k, name in enumerate(asked.names) if name.startswith("joint2 ripple")]
    size = float(tau[..., 1].square().mean().sqrt())
    assert len(waves) == 2 and float(asked.errors[waves].max()) <= 1.01 * size
    assert float(asked.parameters[waves].abs().max()) < 4 * size


def test_a_wave_is_identifiable_from_a_quarter_of_its_period_on():
    sine = next(term for term in terms.SHAPES if term.name == "ripple sine")
    for part, known in ((0.2, False), (0.3, True), (1.0, True)):
        q = torch.linspace(-0.5, 0.5, 500).double()[:, None] * part * 2 * math.pi + torch.tensor([0.4, 2.0])
        rows = terms.rows_of(ROBOT, of_tensors(ROBOT, q=q, qd=q, qdd=q), WIDTH)
        assert sine.identifiable(rows).tolist() == [known, known]


@pytest.mark.filterwarnings("ignore")
def test_friction_by_load_stays_below_one():
    """More than the load would lock the joint: no effect is such friction. An infinite prior keeps the bodies."""
    q, qd, qdd = states(5, 400)
    load = torchdq.inverse_dynamics(ROBOT, q, qd, qdd)
    tau = load + 1.4 * load.abs() * sign(qd) + 0.1 * noise(q.shape, 0.8)
    friction = (effects.Viscous(), effects.LoadDependent(sign_width=WIDTH))
    found = fitted(ROBOT, q, qd, qdd, tau, friction=friction, prior=math.inf)
    chosen = fitted(ROBOT, q, qd, qdd, tau, friction="auto", prior=math.inf)
    number = found.coefficients("load")
    assert bool((number > 0.9).all()) and bool((number < 1).all())
    assert torch.equal(found.robot.mass, ROBOT.mass) and not bool(found.errors[:20].any())
    for one in (found, chosen):
        assert len(one.effects()) > 1 and one.layer()(q, qd, qdd).shape == q.shape
    wide = found._replace(spread=torch.cat([found.spread, 0.3 * torch.eye(24, dtype=torch.float64)[:, -2:]], 1))
    assert bool((posterior_samples(wide, 8).coefficients("load") < 1).all()) and posterior_samples(wide, 8).effects()


@exhaustive
def test_nothing_is_made_worse_by_little_data_and_a_wrong_guess():
    """Over draws of noise, with 3 s of motion: never much worse than friction beside the description."""
    test = states(3, 400, seed=50)
    truth = torchdq.inverse_dynamics(REAL, *test) + dry(test[1])
    ratios = []
    for seed in range(3):
        q, qd, qdd = states(1, 150, seed=seed)
        tau = torques(REAL, q, qd, qdd, size=1.0, memory=0.9, seed=seed)
        simple = fitted(ROBOT, q, qd, qdd, tau, prior=math.inf)
        found = identify(ROBOT, Samples(q, qd, qdd, tau))
        off = [float((one.predict(*test).tau - truth).square().mean()) for one in (found, simple)]
        ratios.append(off[0] / off[1])
    assert np.median(ratios) < 1.05 and max(ratios) < 2


def test_too_few_rows_to_choose_by_have_a_finding():
    q, qd, qdd = (x[0, :60] for x in states())
    tau = torques(REAL, q[None], qd[None], qdd[None])[0]
    found, (one,) = with_findings(identify, ROBOT, Samples(q, qd, qdd, tau))
    assert (one.code, one.value, one.found) == ("rows.few", 120, "60 rows") and found.findings == (one,)
    chosen, findings = with_findings(fitted, ROBOT, q, qd, qdd, tau)
    assert not findings and chosen.selection is None and torch.equal(found.parameters, chosen.parameters)
    assert torch.equal(found.errors, chosen.errors) and not bool(found.model.any())
    assert found.selection is None and one.cure.startswith("the model is viscous, coulomb, bodies with a prior of 1;")
    found, (one,) = with_findings(identify, ROBOT, motion_of(q, qd, qdd, tau), Model(friction=None))
    assert one.code == "rows.few" and one.found == "60 rows (1.2 s)" and "120 rows (2.4 s)" in one.expected
    assert one.cure.startswith("the model is bodies with a prior")


# --- errors ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("memory", thinned([0.0, 0.95], [0.95]))
def test_errors_hold_for_noise_that_is_correlated(memory):
    q, qd, qdd = states(2, 1000, seed=7)
    truth = torch.cat([REAL.inertial_parameters, VISCOUS, COULOMB])
    far = []
    for seed in range(20 if EVERYTHING else 8):
        tau = torques(REAL, q, qd, qdd, size=0.3, memory=memory, seed=seed)
        found = fitted(ROBOT, q, qd, qdd, tau, prior=1e-2)
        far.append(whitened(found, truth).square().mean())
    expected, mean = (1 + memory) / (1 - memory), float(torch.stack(far).mean())
    assert 0.6 * expected < float(found.correlation.mean()) < 1.3 * expected
    assert 0.6 < mean < 1.6
    if memory:
        assert mean * float(found.correlation.mean()) > 5  # what independent rows would claim


def test_motions_and_samples_say_the_same():
    q, qd, qdd = states(3, 300)
    tau = torques(REAL, q, qd, qdd)
    motions = [motion_of(*(x[k] for x in (q, qd, qdd, tau)), sign(qd[k])) for k in range(3)]
    model = Model((effects.Viscous(), effects.Coulomb()))
    a = identify(ROBOT, motions, model)
    b = identify(ROBOT, Samples(q, qd, qdd, tau), model)
    assert torch.allclose(a.parameters, b.parameters, rtol=1e-6, atol=1e-9)
    assert torch.allclose(a.predict(motions).tau.reshape(q.shape), b.predict(q, qd, qdd).tau, atol=1e-6)
    both = identify(ROBOT, [motions[0], *(Samples(*(x[k] for x in (q, qd, qdd, tau))) for k in (1, 2))], model)
    assert torch.allclose(both.parameters, b.parameters, rtol=1e-6, atol=1e-9)


def test_the_report_is_a_table_with_reasons():
    q, qd, qdd = states(5, 300)
    found = identify(ROBOT, Samples(q, qd, qdd, torques(REAL, q, qd, qdd)))
    lines = str(found.selection).splitlines()
    assert "5 motions and 4 regions of the states that were left out in turn" in lines[0]
    assert lines[1].split() == ["model", "score", "standard", "error", "root", "prior", "as", "described"]
    names = [one.name for one in found.selection.candidates]
    assert names[0] == "description" and names[1].startswith("+ friction") and names[-1].startswith("identified")
    assert sum("chosen" in line for line in lines[2 : 2 + len(names)]) == 1
    assert any(line.startswith("chosen: identified") for line in lines)
    assert str(found).endswith(str(found.selection)) and "\n" not in repr(found.selection)


def test_one_motion_vouches_for_other_bodies_where_they_explain_much_more():
    """Masses that are 3 % larger take a tenth of the squared residual away: enough in three motions, not in one."""
    q, qd, qdd = states(3, 400, seed=2)
    slightly = ROBOT.replace(mass=1.03 * ROBOT.mass).bake()
    tau = torques(slightly, q, qd, qdd, size=0.5, memory=0.5)
    names = [identify(ROBOT, Samples(*(x[:k] for x in (q, qd, qdd, tau)))).selection.chosen.name for k in (1, 3)]
    assert names[0].startswith("+ friction") and names[1].startswith("identified")


# --- recordings ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arm", "folder", "k", "most"),
    [
        ("ur10e", "ur10e_innopolis", 0, 0.055),
        ("pendulum", "double_pendulum_dfki_A0", 0, 0.30),
        ("pendulum", "double_pendulum_dfki_A0", 1, 0.35),
    ],
)
@pytest.mark.filterwarnings("ignore")
def test_recordings_of_real_arms_are_explained_no_worse_than_by_friction(arm, folder, k, most):
    recordings(folder)
    splits = pytest.importorskip("splits")
    split = getattr(splits, arm)(DATA, True)[k]
    row = splits.measured(split, splits.learned(split))
    assert not row.worse
    assert row.chosen[1] < most


@pytest.mark.parametrize("rate", thinned([100, 80, 60, 50, 40, 33, 25], [40, 25]))
@pytest.mark.filterwarnings("ignore")
def test_the_rate_of_the_rows_does_not_matter(rate):
    """Below 16 Hz the filtered log is all there, whichever rows are kept."""
    folder = recordings("airbot_play")
    layout = Layout(rate=100.0, joints=6, columns={"q": "q{0}", "qd": None, "tau": "tau{1}"})
    train, test = (
        read_log([folder / f"{name}_{signal}.csv.gz" for signal in ("q", "tau")], layout)
        for name in ("chirp", "trapezoidal")
    )
    robot, test = torchdq.Robot.from_urdf(folder / "airbot.urdf", on_unphysical="ignore"), smooth(test)
    predicted, tau = identify(robot, smooth(train, rate=rate)).predict(test), torch.from_numpy(test.tau)
    assert float(((predicted.tau - tau).square().mean(0).sqrt() / tau.std(0)).mean()) < 0.14
    assert float(((tau > predicted.low) & (tau < predicted.high)).double().mean(0).amin()) > 0.93
