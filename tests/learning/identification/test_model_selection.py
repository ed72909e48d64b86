"""Ladder of models: what the motions can tell is found, and nothing else is; on simulated arms and on recordings.

The truth is that of the simulation, made by `torchdq.inverse_dynamics` and the laws of friction written out here.
"""

import math
import re
import warnings

import numpy as np
import pytest
import torch
from helpers import PAIR
from places import DATA

import torchdq
import torchdq.envs
from torchdq import effects
from torchdq.errors import ArgumentError
from torchdq.learning import Layout, LogWarning, Motion, identify, posterior_samples, read, samples, smooth
from torchdq.learning.evaluation.blocks import blocks, of_motions, of_tensors, regions, too_few
from torchdq.learning.evaluation.correlation import correlation_times
from torchdq.learning.identification import model_selection as ladder
from torchdq.learning.identification import terms
from torchdq.learning.identification.feasible import Neighbourhood
from torchdq.robot.pseudo_inertia import BASIS, bodies_of, pseudo_inertia

WIDTH, STEP = 1e-2, 0.02
ROBOT = torchdq.robots.load("two_link")
REAL = ROBOT.replace(
    mass=ROBOT.mass * torch.tensor([1.2, 0.85], dtype=torch.float64),
    com=ROBOT.com + torch.tensor([[0.03, 0.0, 0.0], [-0.02, 0.0, 0.0]], dtype=torch.float64),
)
VISCOUS, COULOMB = torch.tensor([[0.3, 0.2], [0.8, 0.5]], dtype=torch.float64)
SLOW = math.pi / 5  # [rad/s]


def states(motions=5, rows=400, seed=0, joints=2):
    """Sums of sinusoids [motions, rows, n], fast and slow ones."""
    g = torch.Generator().manual_seed(seed)
    w = SLOW * torch.arange(1, 6, dtype=torch.float64)
    size = (0.3 + torch.rand(motions, 1, joints, 5, generator=g, dtype=torch.float64)) / w
    phase = 6.3 * torch.rand(motions, 1, joints, 5, generator=g, dtype=torch.float64)
    angle = w * STEP * torch.arange(rows, dtype=torch.float64)[:, None, None] + phase
    return (
        (size * angle.sin()).sum(-1),
        (size * w * angle.cos()).sum(-1),
        -(size * w * w * angle.sin()).sum(-1),
    )


def noise(shape, memory, seed=0):
    """Noise [motions, rows, n] of variance one, with a correlation that falls by a factor from row to row."""
    x = torch.from_numpy(np.random.default_rng(seed).normal(size=shape))
    found = [x[:, 0]]
    for row in x.unbind(1)[1:]:
        found.append(memory * found[-1] + (1 - memory**2) ** 0.5 * row)
    return torch.stack(found, 1)


def sign(qd):
    return qd / (qd**2 + WIDTH**2).sqrt()


def dry(qd):
    return VISCOUS * qd + COULOMB * sign(qd)


def torques(robot, q, qd, qdd, friction=dry, size=0.1, memory=0.8, seed=0):
    return torchdq.inverse_dynamics(robot, q, qd, qdd) + friction(qd) + size * noise(q.shape, memory, seed)


# --- rungs -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("robot", "friction", "rung"),
    [
        (ROBOT, torch.zeros_like, "description"),
        (ROBOT, dry, "+ friction"),
        (REAL, dry, "identified"),
    ],
)
@pytest.mark.parametrize("motions", [1, 5])
def test_the_rung_that_is_the_truth_is_chosen(robot, friction, rung, motions):
    q, qd, qdd = states(motions, 2000 // motions, seed=motions)
    found = identify(ROBOT, q, qd, qdd, torques(robot, q, qd, qdd, friction), width=WIDTH)
    assert found.report.rung.name == rung
    noise_alone = 0.01 / torchdq.inverse_dynamics(robot, q, qd, qdd).var((0, 1))
    assert found.report.rung.score < 2 * float(noise_alone.mean())
    if rung != "identified":
        assert torch.equal(found.robot.mass, ROBOT.mass) and torch.equal(found.robot.com, ROBOT.com)


def test_the_simplest_as_good_as_the_best_is_chosen():
    """By the standard error of paired differences, not by those of the scores."""
    blocks = torch.tensor([1.0, 3.0, 9.0, 2.0])
    off = torch.tensor([0.3, -0.1, 0.2, -0.2])
    best = blocks[:, None]
    assert ladder._simplest([best + 0.5, best + off[:, None], best]) == 1
    assert ladder._simplest([best + 0.05 + 0.01 * off[:, None], best, best + 0.1]) == 1
    assert ladder._simplest([best, best + 1]) == 0


SHAPES = {
    "load": (lambda qd, load: 0.12 * load.abs() * sign(qd), 0.12),
    "stribeck 0.1": (lambda qd, load: 1.5 * sign(qd) / (1 + (qd / 0.1) ** 2), 1.5),
    "saturating 1": (lambda qd, load: 2.0 * qd / (qd**2 + 1).sqrt(), 2.0),
    "quadratic": (lambda qd, load: 0.5 * qd * qd.abs(), 0.5),
    "forward": (lambda qd, load: 0.8 * sign(qd) * (1 + sign(qd)) / 2, 0.8),
    "ripple sine": (None, 0.7),
    "lugre 0.01": (None, 1.5),
}


@pytest.mark.parametrize("name", SHAPES)
def test_friction_of_each_shape_is_found_with_its_size(name):
    q, qd, qdd = states(6, 800, seed=3)
    tau = torques(ROBOT, q, qd, qdd, size=0.03)
    law, size = SHAPES[name]
    if name == "ripple sine":
        tau = tau + size * q.sin()
    elif name == "lugre 0.01":
        z, bristles = torch.zeros_like(q[:, 0]), []
        for before, now in zip(q[:, :-1].unbind(1), q[:, 1:].unbind(1), strict=True):
            bristles.append(z)
            for _ in range(50):  # dz/dq = (sign(dq) - z) / distance, in small steps
                step = (now - before) / 50
                z = z + (step - step.abs() * z) / 0.01
        tau = tau + size * torch.stack([*bristles, z], 1)
    else:
        tau = tau + law(qd, torchdq.inverse_dynamics(ROBOT, q, qd, qdd))
    found = identify(ROBOT, q, qd, qdd, tau, width=WIDTH)
    number = found.coefficients(name)
    assert number is not None, found.report
    assert float((number / size - 1).abs().max()) < 0.2
    assert name not in found.report.useless
    assert re.search(rf"joint1: .*{re.escape(name)} \(", str(found.report))
    clean = tau - 0.03 * noise(q.shape, 0.8)
    left = (found.predict(q, qd, qdd).tau.reshape(q.shape) - clean).square().mean((0, 1)).sqrt()
    assert bool((left < 0.03).all())


@pytest.mark.parametrize("amplitude", [0.0, 5e-4, 0.05])
def test_a_joint_that_hardly_moves_has_no_friction_that_depends_on_where_it_is(amplitude):
    """A wave is a slope and a constant there: a small fault of the model would make hundreds of N m of it."""
    q, qd, qdd = (x.clone() for x in states(5, 400, seed=3))
    k = amplitude / float(q[..., 1].abs().max())
    q[..., 1], qd[..., 1], qdd[..., 1] = 0.6 + k * q[..., 1], k * qd[..., 1], k * qdd[..., 1]
    tau = torques(REAL, q, qd, qdd) + 0.7 * q.sin() + (50 * (q - 0.6).square() if amplitude > 0.01 else 0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = identify(ROBOT, q, qd, qdd, tau, width=WIDTH)
        asked = identify(ROBOT, q, qd, qdd, tau, (effects.Viscous(), effects.Ripple(2 * math.pi)), prior=1.0)
    own = found.parameters[20:].reshape(-1, 2)[:, 1], found.errors[20:].reshape(-1, 2)[:, 1]
    assert not any("ripple" in gain.term for gain in found.report.rung.gains if gain.joint == "joint2")
    assert float(own[0].abs().max()) < 1.0 and float(own[1].max()) < 4.0
    waves = [k for k, name in enumerate(asked.names) if name.startswith("joint2 ripple")]
    size = float(tau[..., 1].square().mean().sqrt())
    assert len(waves) == 2 and float(asked.errors[waves].max()) <= 1.01 * size
    assert float(asked.parameters[waves].abs().max()) < 4 * size


def test_a_wave_is_told_from_a_quarter_of_its_period_on():
    sine = next(term for term in terms.SHAPES if term.name == "ripple sine")
    for part, told in ((0.2, False), (0.3, True), (1.0, True)):
        q = torch.linspace(-0.5, 0.5, 500).double()[:, None] * part * 2 * math.pi + torch.tensor([0.4, 2.0])
        rows = terms.rows_of(ROBOT, of_tensors(ROBOT, q=q, qd=q, qdd=q), WIDTH)
        assert sine.told(rows).tolist() == [told, told]


def test_friction_by_load_stays_below_one():
    """More than the load would lock the joint: no effect is such friction."""
    q, qd, qdd = states(5, 400)
    load = torchdq.inverse_dynamics(ROBOT, q, qd, qdd)
    tau = load + 1.4 * load.abs() * sign(qd) + 0.1 * noise(q.shape, 0.8)
    friction = (effects.Viscous(), effects.LoadDependent(sign_width=WIDTH))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = identify(ROBOT, q, qd, qdd, tau, friction, prior=math.inf, width=WIDTH)
        chosen = identify(ROBOT, q, qd, qdd, tau, prior=math.inf, width=WIDTH)
    number = found.coefficients("load")
    assert bool((number > 0.9).all()) and bool((number < 1).all())
    for one in (found, chosen):
        assert len(one.effects()) > 1 and one.layer()(q, qd, qdd).shape == q.shape
    wide = found._replace(spread=torch.cat([found.spread, 0.3 * torch.eye(24, dtype=torch.float64)[:, -2:]], 1))
    assert bool((posterior_samples(wide, 8).coefficients("load") < 1).all()) and posterior_samples(wide, 8).effects()


def test_nothing_is_made_worse_by_little_data_and_a_wrong_guess():
    """Over draws of noise, with 3 s of motion: never much worse than friction beside the description."""
    test = states(3, 400, seed=50)
    truth = torchdq.inverse_dynamics(REAL, *test) + dry(test[1])
    ratios = []
    for seed in range(4):
        q, qd, qdd = states(1, 150, seed=seed)
        tau = torques(REAL, q, qd, qdd, size=1.0, memory=0.9, seed=seed)
        simple = identify(ROBOT, q, qd, qdd, tau, friction=True, prior=math.inf, width=WIDTH)
        found = identify(ROBOT, q, qd, qdd, tau, width=WIDTH)
        off = [float((one.predict(*test).tau - truth).square().mean()) for one in (found, simple)]
        ratios.append(off[0] / off[1])
    assert np.median(ratios) < 1.05 and max(ratios) < 2


def test_what_a_motion_does_not_excite_is_named_and_left():
    q, qd, qdd = (x.clone() for x in states(3, 400))
    q[..., 1], qd[..., 1], qdd[..., 1] = 0.3, 0.0, 0.0
    with pytest.warns(UserWarning, match="joint2"):
        found = identify(ROBOT, q, qd, qdd, torques(REAL, q, qd, qdd), width=WIDTH)
    assert found.report is not None
    text = str(found.report)
    assert "not told by the samples" in text and re.search(r"link2: .*Izz", text)
    assert not bool(found.excited[10 * 2 :].reshape(-1, 2)[:, 1].any())


def test_too_few_rows_to_choose_by_are_said():
    q, qd, qdd = (x[0, :60] for x in states())
    tau = torques(REAL, q[None], qd[None], qdd[None])[0]
    few = "60 rows of motion are too few to leave any out and choose by them; 120 rows would do"
    with pytest.warns(LogWarning, match=f"no model could be chosen, since {few}; taken is viscous, coulomb, bodies"):
        found = identify(ROBOT, q, qd, qdd, tau, width=WIDTH)
    with warnings.catch_warnings():
        warnings.simplefilter("error", LogWarning)
        plain = identify(ROBOT, q, qd, qdd, tau, True, prior=1.0, width=WIDTH)
    assert plain.report is None and torch.equal(found.parameters, plain.parameters)
    assert torch.equal(found.errors, plain.errors) and not bool(found.model.any())
    lines = str(found.report).splitlines()
    assert lines[0] == f"viscous, coulomb, bodies with a prior of 1, not chosen, since {few}"
    assert lines[1] == "not told by the samples, left near the description:" and "not chosen" in repr(found.report)
    motion = Motion(np.arange(60) * STEP, *(x.numpy() for x in (q, qd, qdd, tau)))
    with pytest.warns(LogWarning, match=r"60 rows \(1.2 s\) .* 120 rows \(2.4 s\) would do; taken is bodies"):
        identify(ROBOT, motion, friction=False, width=WIDTH)


def test_a_fit_without_a_block_keeps_enough_rows():
    """Beside a block, half a second is left out, which may be all that there is."""
    x = np.random.default_rng(0).normal(size=(1000, 2))

    def recording(rows, rate, motions=1):
        return of_motions(ROBOT, [Motion(np.arange(rows) / rate, *[x[:rows]] * 4)] * motions)

    assert blocks(recording(500, 500)) == [] and "858 rows (1.7 s) would do" in too_few(recording(500, 500))
    assert len(blocks(recording(858, 500))) == 6 and blocks(recording(840, 500)) == []
    words = too_few(recording(50, 100, 2))
    assert words.startswith("50 rows (0.5 s)") and words.endswith("60 rows (0.6 s) would do for each motion")
    assert len(blocks(recording(60, 100, 2))) == 6 and blocks(recording(50, 100, 2)) == []


def test_an_infinite_prior_keeps_the_bodies():
    q, qd, qdd = states()
    found = identify(ROBOT, q, qd, qdd, torques(REAL, q, qd, qdd), friction=True, prior=math.inf, width=WIDTH)
    assert torch.equal(found.robot.mass, ROBOT.mass) and not bool(found.errors[:20].any())
    assert bool((found.viscous > 0).all())


# --- errors ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("memory", [0.0, 0.95])
def test_errors_hold_for_noise_that_is_correlated(memory):
    q, qd, qdd = states(2, 1000, seed=7)
    truth = torch.cat([REAL.inertial_parameters, VISCOUS, COULOMB])
    far, plain = [], []
    for seed in range(20):
        tau = torques(REAL, q, qd, qdd, size=0.3, memory=memory, seed=seed)
        found = identify(ROBOT, q, qd, qdd, tau, friction=True, prior=1e-2, width=WIDTH)
        off = (found.base @ (found.parameters - truth)) / found.base_errors
        far.append(off.square().mean())
        plain.append((off.square() * float(found.correlation.mean())).mean())
    expected = (1 + memory) / (1 - memory)
    assert 0.6 * expected < float(found.correlation.mean()) < 1.3 * expected
    assert 0.6 < float(torch.stack(far).mean()) < 1.6
    if memory:
        assert float(torch.stack(plain).mean()) > 5  # what independent rows would claim


def test_correlation_times_are_those_of_the_process():
    for memory in (0.0, 0.5, 0.9):
        x = noise((3, 20000, 2), memory)
        found = correlation_times(x.reshape(-1, 2), (20000,) * 3)
        assert torch.allclose(found, torch.full_like(found, (1 + memory) / (1 - memory)), rtol=0.1)
    assert torch.equal(correlation_times(torch.zeros(10, 2).double(), (10,)), torch.ones(2).double())


# --- blocks ----------------------------------------------------------------------------------------------------------


def rows_of(part):
    return set(range(part.start, part.stop))


def test_blocks_are_whole_motions_or_parts_with_gaps():
    q, qd, qdd = states(4, 100)
    whole = blocks(of_tensors(ROBOT, q=q, qd=qd, qdd=qdd, tau=q))
    assert [rows_of(block.rows) for block in whole] == [set(range(100 * k, 100 * k + 100)) for k in range(4)]
    assert not any(block.beside for block in whole)
    time = np.arange(700) * STEP
    x = np.random.default_rng(0).normal(size=(700, 2))
    one = Motion(time, x, x, x, x, x)
    recording = of_motions(ROBOT, one)
    parts = blocks(recording)
    assert len(parts) == 6 and set().union(*(rows_of(block.rows) for block in parts)) == set(range(700))
    for block in parts:
        beside = set().union(*map(rows_of, block.beside))
        assert not beside & rows_of(block.rows)
        near = {k for k in range(700) for end in (block.rows.start, block.rows.stop - 1) if abs(k - end) * STEP < 0.49}
        assert near - rows_of(block.rows) <= beside and len(beside) <= 2 * 26
    for first, second in regions(recording):
        assert {*first.tolist(), *second.tolist()} == set(range(700)) and len(first) + len(second) == 700
    slow, fast = regions(recording)[0]
    speed = np.linalg.norm(x / x.std(0), axis=1)
    assert speed[slow].max() <= speed[fast].min()
    assert regions(of_tensors(ROBOT, q=q, qd=qd, qdd=qdd)) == []
    assert blocks(of_tensors(ROBOT, q=q[0, :50], qd=q[0, :50], qdd=q[0, :50])) == []
    many = blocks(of_tensors(ROBOT, q=q.reshape(20, 20, 2), qd=q.reshape(20, 20, 2), qdd=q.reshape(20, 20, 2)))
    assert len(many) == 10


def test_a_fold_holds_nothing_of_its_block():
    """Torques that are wrong in a block and beside it do not change the fit that is measured on it."""
    from torchdq.learning.identification.evidence import gather
    from torchdq.learning.identification.terms import COULOMB as DRY
    from torchdq.learning.identification.terms import VISCOUS as OIL

    q, qd, qdd = (x[0] for x in states(1, 600))
    tau = torques(REAL, q[None], qd[None], qdd[None])[0]
    recording = of_tensors(ROBOT, q=q, qd=qd, qdd=qdd, tau=tau)
    spoilt = tau.clone()
    third = blocks(recording)[2]
    for part in (third.rows, *third.beside):
        spoilt[part] += 100.0
    folds = [
        gather(ROBOT, one, (OIL, DRY), WIDTH, None, blocks(one), lambda _: None).folds
        for one in (recording, of_tensors(ROBOT, q=q, qd=qd, qdd=qdd, tau=spoilt))
    ]
    assert torch.allclose(folds[0][2], folds[1][2], rtol=1e-9, atol=1e-6 * float(folds[0][2].abs().max()))
    assert not torch.allclose(folds[0][0], folds[1][0], rtol=1e-2)


# --- what is done with the result ------------------------------------------------------------------------------------


def test_a_layer_a_scene_and_a_file_have_all_that_was_found():
    described = torchdq.Robot.from_urdf(PAIR)
    real = described.replace(mass=described.mass * torch.tensor([1.2, 0.85], dtype=torch.float64))
    q, qd, qdd = states(4, 600)
    load = torchdq.inverse_dynamics(real, q, qd, qdd)
    tau = torques(real, q, qd, qdd, size=0.01) + 0.1 * load.abs() * sign(qd) + torch.tensor([0.4, -0.3]).double()
    found = identify(described, q, qd, qdd, tau, offset=True, width=WIDTH)
    assert found.coefficients("load") is not None
    expected = found.predict(q, qd, qdd).tau
    assert torch.allclose(found.layer()(q, qd, qdd), expected, rtol=1e-9, atol=1e-9)
    assert torch.allclose(found.layer(learn=("mass",)).mass, found.robot.mass)
    kinds = [type(effect) for effect in found.effects()]
    assert kinds[0] is effects.Gravity and effects.LoadDependent in kinds and effects.Viscous in kinds
    scene = torchdq.envs.Scene(found.robot, found.effects(), dt=1e-4)
    state = scene.start(q[0, ::50], qd[0, ::50])
    after = scene.step(state, expected[0, ::50] - found.offset)
    assert torch.allclose((after.qd - state.qd) / 1e-4, qdd[0, ::50], atol=0.05 * float(qdd.std()))
    with pytest.warns(UserWarning, match="no place for offset, left out; .* for friction of other shapes, too: load"):
        text = found.to_urdf(PAIR)
    again = torchdq.Robot.from_urdf(text)
    assert torch.allclose(again.mass, found.robot.mass)


def test_motions_and_tensors_say_the_same():
    q, qd, qdd = states(3, 300)
    tau = torques(REAL, q, qd, qdd)
    time = np.arange(300) * STEP
    motions = [Motion(time, *(x[k].numpy() for x in (q, qd, qdd, tau)), sign(qd[k]).numpy()) for k in range(3)]
    a = identify(ROBOT, motions, width=WIDTH)
    b = identify(ROBOT, q, qd, qdd, tau, width=WIDTH)
    assert torch.allclose(a.parameters, b.parameters, rtol=1e-6, atol=1e-9)
    assert torch.allclose(a.predict(motions).tau.reshape(q.shape), b.predict(q, qd, qdd).tau, atol=1e-6)
    with pytest.raises(ArgumentError, match="qd must not be given beside motions"):
        identify(ROBOT, motions, qd)
    with pytest.raises(ArgumentError, match="tau must be given beside positions"):
        identify(ROBOT, q, qd, qdd)
    with pytest.raises(ArgumentError, match="motions must be at least one"):
        identify(ROBOT, [])
    with pytest.raises(
        ArgumentError, match=r"friction must be True, False, 'choose', or a sequence of friction effects, found 'yes'"
    ):
        identify(ROBOT, q, qd, qdd, tau, friction="yes")
    with pytest.raises(ArgumentError, match=r"which has 6 joints, found one with 2"):
        identify(torchdq.robots.load("ur10e"), motions)


def test_the_report_is_a_table_with_reasons():
    q, qd, qdd = states(5, 300)
    found = identify(ROBOT, q, qd, qdd, torques(REAL, q, qd, qdd), width=WIDTH)
    lines = str(found.report).splitlines()
    assert "5 motions that were left out in turn" in lines[0]
    assert lines[1].split() == ["model", "score", "standard", "error", "root", "prior"]
    names = [rung.name for rung in found.report.rungs]
    assert names[:2] == ["description", "+ friction"] and "identified" in names
    assert sum("chosen" in line for line in lines[2 : 2 + len(names)]) == 1
    assert any(line.startswith("chosen: identified") for line in lines)
    assert str(found).endswith(str(found.report)) and "\n" not in repr(found.report)


# --- drive gains -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("known", [True, False])
def test_gains_of_drives_are_found_within_their_errors(known):
    """Efforts by gains that are off by tens of percent, or in other units; the description has the right masses."""
    robot = torchdq.robots.load("ur10e")
    g = torch.Generator().manual_seed(0)
    q, qd, qdd = states(4, 500, joints=6)
    rub = (0.1 * torchdq.inverse_dynamics(robot, q, qd, qdd).std((0, 1))).clamp_min(0.2)
    clean = torchdq.inverse_dynamics(robot, q, qd, qdd) + rub * (qd + sign(qd))
    tau = clean * (1 + 0.01 * noise(q.shape, 0.0)) + 0.02 * clean.std((0, 1)) * noise(q.shape, 0.5, seed=1)
    gains = 0.8 + 0.4 * torch.rand(6, generator=g, dtype=torch.float64)
    gains = gains if known else 10 * gains
    time = np.arange(500) * STEP
    motions = [
        Motion(time, *(x[k].numpy() for x in (q, qd, qdd, tau / gains)), sign(qd[k]).numpy(), known_gains=known)
        for k in range(4)
    ]
    if not known:
        with pytest.raises(ArgumentError, match="give gains=True"):
            identify(robot, motions)
    found = identify(robot, motions, friction=True, prior=1.0, gains=True, width=WIDTH)
    assert found.gains is not None
    off = (found.gains.value / gains)[:5]  # the last joint's torque is nearly all friction, which any gain explains
    assert float((off / off.mean() - 1).abs().max()) < 0.03  # between joints that share a load
    assert float((off.mean() - 1).abs()) < 0.2  # all together: masses would have to be known
    assert float(((found.gains.value - gains) / found.gains.error).abs().max()) < 3
    assert "torque per unit of effort" in str(found)
    predicted = found.predict(motions).tau.reshape(q.shape) / found.gains.value
    assert float(((predicted - clean / gains).std((0, 1)) / (clean / gains).std((0, 1))).max()) < 0.02


def real_arm(described, seed, size=0.1):
    """Arm whose bodies differ from those described as much as gains expect: by a common factor, and each by itself."""
    g = np.random.default_rng(seed)
    C = torch.linalg.cholesky(pseudo_inertia(described.inertial_parameters.reshape(-1, 10)))
    change = size * torch.einsum("li,ijk->ljk", torch.from_numpy(g.normal(size=(len(C), 10))), BASIS)
    J = (1 + size * g.normal()) * C @ (torch.eye(4).double() + change) @ C.mT
    mass, com, inertia = bodies_of(torch.linalg.cholesky(J))
    return described.replace(mass=mass, com=com, inertia=inertia)


@pytest.mark.parametrize("runs", [8, pytest.param(200, marks=pytest.mark.exhaustive)])
@pytest.mark.parametrize("known", [True, False, (True, False)])
def test_errors_hold_those_of_the_gains(known, runs):
    """Over arms, gains and noise: squares of what parameters are off by over the stated errors are about one."""
    far: dict[str, list[float]] = {}
    described = torchdq.Robot.from_urdf(PAIR)
    for seed in range(runs):
        g = np.random.default_rng(1000 + seed)
        real, (q, qd, qdd) = real_arm(described, seed), states(3, 200, seed=seed)
        clean = torchdq.inverse_dynamics(real, q, qd, qdd) + dry(qd)
        tau = clean + 0.02 * clean.std((0, 1)) * torch.from_numpy(g.normal(size=q.shape))
        gains = (1 + 0.3 * torch.from_numpy(g.normal(size=2)).clamp(-2, 2)) / torch.where(torch.tensor(known), 1.0, 10)
        efforts = tau / gains
        motions = [
            Motion(np.arange(200) * STEP, *(x[k].numpy() for x in (q, qd, qdd, efforts)), known_gains=known)
            for k in range(3)
        ]
        found = identify(described, motions, friction=True, prior=1.0, gains=True, width=WIDTH)
        alone = found.by_these_gains()
        off = found.parameters - torch.cat([real.inertial_parameters.flatten(), VISCOUS, COULOMB])
        parts = {"viscous": off[-4:-2] / found.errors[-4:-2], "coulomb": off[-2:] / found.errors[-2:]}
        parts |= {
            "base": found.base @ off / found.base_errors,
            "gains": (found.gains.value - gains) / found.gains.error,
        }
        parts |= {"without": off[-4:] / alone.errors[-4:]}
        told = found.predict(q, qd, qdd)
        parts |= {"torques": ((told.tau - clean) / told.error).flatten(0, 1)}
        for name, x in parts.items():
            far.setdefault(name, []).append(float(x.square().mean()))
        inside = (tau / gains * found.gains.value - told.tau).abs() < 2 * alone.noise
        far.setdefault("inside", []).append(float(inside.double().mean()))
        if not seed:
            drawn = posterior_samples(found, 100).coefficients("viscous").std(0)
            assert torch.allclose(drawn, found.errors[-4:-2], rtol=0.4)
    mean = {name: float(np.mean(x)) for name, x in far.items()}
    least, most = (0.8, 1.25) if runs > 100 else (0.3, 3.0)
    for name in ("viscous", "coulomb", "base", "gains", "torques"):
        assert least < mean[name] < most, mean
    assert mean["without"] > 10 and mean["inside"] > 0.9, mean


def test_a_gain_that_is_not_known_stands_beside_those_that_are():
    assert Layout(gain=(1, None, 2)).gain == (1.0, None, 2.0)
    assert Layout(gain=(1, None)).known_gains == (True, False) and Layout(gain=(None, None)).gain is None
    assert Layout().known_gains is True and Layout(gain=None).known_gains is False
    time = np.arange(0, 10, 0.01)
    x = np.stack([np.sin(time), np.cos(2 * time)], 1)
    signals = {"time": time, "q": x, "qd": x, "tau": np.ones_like(x)}
    log = read(signals, Layout(gain=(3, None)))
    assert (log.tau == [3, 1]).all() and "unknown gains" in str(log)
    motion = smooth(log)
    assert motion.known_gains == (True, False) and "unknown gains" in repr(motion)
    with pytest.raises(ArgumentError, match="efforts of unknown gains"):
        samples(motion)
    with pytest.raises(ArgumentError, match="efforts of unknown gains; give gains=True"):
        identify(ROBOT, motion)
    assert of_motions(ROBOT, [motion, motion._replace(known_gains=True)]).known_gains == (True, False)


# --- recordings ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def splits():
    pytest.importorskip("scipy", reason="smoothing needs scipy")
    return pytest.importorskip("splits")


@pytest.mark.parametrize(
    ("arm", "folder", "k", "most"),
    [
        ("ur10e", "ur10e_innopolis", 0, 0.055),
        ("pendulum", "double_pendulum_dfki_A0", 0, 0.30),
        ("pendulum", "double_pendulum_dfki_A0", 1, 0.35),
    ],
)
def test_recordings_of_real_arms_are_explained_no_worse_than_by_friction(splits, arm, folder, k, most):
    if not (DATA / folder).is_dir():
        pytest.skip("the recordings are not here")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        split = getattr(splits, arm)(DATA, True)[k]
        row = splits.measured(split, splits.learned(split))
    assert not row.worse
    assert row.chosen[1] < most


def test_slopes_of_the_distance_to_the_description_are_those_of_differences():
    """With bodies, friction that must be positive, a number of any sign, and a fraction that is below one."""
    load, offset = next(x for x in terms.SHAPES if x.loaded), terms.OFFSET
    sought = torch.ones(3, 2, dtype=torch.bool)
    torque, unit = torch.tensor([2.0, 5.0]).double(), torch.tensor([[1.0, 2.0], [1.0, 1.0], [0.4, 6.0]]).double()
    near = Neighbourhood(ROBOT, (terms.VISCOUS, offset, load), sought, torque, unit)
    y = 0.3 * torch.rand(len(near.inverse), dtype=torch.float64)
    slope, curvature = near.slopes(y)
    steps = 1e-5 * torch.eye(len(y), dtype=torch.float64)
    found = torch.tensor([(near.distance(y + h) - near.distance(y - h)) / 2e-5 for h in steps]).double()
    assert float((slope - found).abs().max()) < 1e-7 * float(slope.abs().max())
    turned = torch.stack([(near.slopes(y + h)[0] - near.slopes(y - h)[0]) / 2e-5 for h in steps])
    assert float((turned - curvature).abs().max()) < 1e-7 * float(curvature.abs().max())
