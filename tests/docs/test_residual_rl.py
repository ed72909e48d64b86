"""The example of a residual policy: it starts as the controller, learns, and is compared with what it says it is."""

import json
import math
from dataclasses import replace
from importlib import import_module

import pytest
import torch

for needed in ("matplotlib", "scipy", "stable_baselines3", "tyro"):
    pytest.importorskip(needed, reason="the examples need the extra 'examples'")
from matplotlib.image import imread  # noqa: E402

BACKEND = "auto"
N = 7


@pytest.fixture(scope="module")
def example():
    module = import_module("08_residual_rl")
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield module
    torch.set_num_threads(threads)


@pytest.fixture(scope="module")
def alone(example):
    """The controller without a policy, on the episodes that are kept for evaluation."""
    return example.evaluate(example.Base(), example.nothing)


def test_the_untrained_policy_is_the_controller(example, alone):
    untrained = example.evaluate(example.Base(), example.greedy(example.learner(example.Base(), seed=3)))
    torch.testing.assert_close(untrained.returns, alone.returns, rtol=0, atol=1e-6)
    torch.testing.assert_close(untrained.errors, alone.errors, rtol=0, atol=1e-6)


def test_training_improves_on_the_controller(example, alone):
    result, curve = example.train(example.Base(), seed=0, steps=100_000)
    assert curve[0] == (0, *alone.means)
    assert curve[-1] == (102_400, *result.means)  # whole rollouts of 20 steps of 256 environments
    assert result.means[0] > alone.means[0] + 3.0
    assert result.means[1] < 0.95 * alone.means[1]
    assert float((result.errors < alone.errors).float().mean()) > 0.9  # not in a few episodes alone


def test_quick_run(example, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(example, "GAINS", [(100.0, 20.0), (400.0, 40.0)])
    monkeypatch.setattr(example, "CHECKS", 3)
    file, out = tmp_path / "found.json", tmp_path / "new"
    results = example.main(example.Args(quick=True, steps=30_000, json=file, out=out))
    assert [len(found) for found in results.values()] == [1] * 7
    assert example.better(results)
    controller, *_, learned = results.values()
    assert not example.better(dict.fromkeys(results, controller))
    assert not example.better({"the other way round": learned, "PPO": controller})
    printed, picture = capsys.readouterr().out, imread(out / "residual_rl.png")[..., :3]
    rows = [line for line in printed.splitlines() if line.startswith("| ")]
    assert len(rows) == 8 and all(row.count(" [") == 2 for row in rows[1:])
    assert picture.shape[0] > 500 and picture.shape[1] > 900 and picture.std() > 0.03
    written = json.loads(file.read_text())
    for name, found in results.items():
        mean, low, high = written["summary"][name]["return"]
        assert low < mean < high
        assert math.isclose(mean, found[0].means[0], rel_tol=1e-5)
        assert len(written["methods"][name][0]["returns"]) == example.TESTED


def test_evaluation_repeats_and_knows_other_episodes(example, alone):
    again = example.evaluate(example.Base(), example.nothing)
    assert torch.equal(again.returns, alone.returns) and torch.equal(again.trace, alone.trace)
    others = example.evaluate(example.Base(), example.nothing, 512, example.CHOICE)
    assert not torch.isin(others.returns, alone.returns).any()


def test_errors_are_those_of_the_positions(example):
    base, episodes = example.Base(), 4
    seen = []

    def shaken(observation):
        seen.append(observation[:, :N])
        return 0.3 * torch.sin(torch.arange(episodes)[:, None] + len(seen) * torch.ones(N))

    result = example.evaluate(base, shaken, episodes)
    errors = torch.stack(seen)  # the first is that at the start, where there is none
    assert float(errors[0].abs().max()) < 1e-6 and len(errors) == example.EPISODE
    torch.testing.assert_close(result.trace[:-1], 1e3 * errors[1:, 0, example.JOINT])
    without_last = 1e3 * (errors.square().sum(0).mean(1) / example.EPISODE).sqrt()
    assert ((without_last <= result.errors) & (result.errors < 1.05 * without_last)).all()


def test_what_is_called_friction_is_the_friction(example):
    qd = torch.linspace(-1.0, 1.0, 6)[:, None].expand(6, N)
    observation = torch.zeros(6, 5 * N)
    observation[:, 3 * N : 4 * N] = qd / torch.tensor([2.175] * 4 + [2.61] * 3)
    torque = example.friction(observation) * 0.2 * torch.tensor([87.0] * 4 + [12.0] * 3)
    viscous, coulomb, static = (torch.tensor([a] * 4 + [b] * 3) for a, b in ((4.0, 2.0), (3.0, 1.0), (5.0, 1.6)))
    dry = (coulomb + (static - coulomb) / (1 + (qd / 0.1) ** 2)) * qd / (qd**2 + 1e-4).sqrt()
    torch.testing.assert_close(torque, viscous * qd + dry)


def test_the_full_truth_is_followed_better(example, alone):
    gains = example.Base()
    bodies = example.evaluate(replace(gains, true=True), example.nothing).means
    both = example.evaluate(replace(gains, true=True), example.friction).means
    assert alone.means[1] > bodies[1] > both[1]
    assert alone.means[0] < bodies[0] < both[0]


def test_gains_are_chosen_by_return(example, monkeypatch):
    monkeypatch.setattr(example, "GAINS", [(100.0, 20.0), (400.0, 40.0), (1600.0, 80.0)])  # weak, good, unstable
    assert example.best(False, example.nothing) == example.Base(400.0, 40.0)


def test_intervals_are_over_seeds_if_there_are_several(example):
    returns = [torch.full((3,), x) for x in (1.0, 2.0, 6.0)]
    several = [example.Result(x, 10 * x, x) for x in returns]
    (mean, low, high), errors = example.summary(several)
    assert mean == 3.0 and 1.0 <= low < mean < high <= 6.0
    assert errors[0] == 30.0
    one = example.Result(torch.tensor([1.0, 2.0, 6.0]), torch.tensor([3.0, 4.0, 5.0]), torch.zeros(1))
    assert example.summary([one])[0] == (mean, low, high)


def test_gains_are_of_the_same_episodes(example):
    before = example.Result(torch.tensor([10.0, 50.0, 90.0]), torch.zeros(3), torch.zeros(1))
    after = before._replace(returns=before.returns + torch.tensor([1.0, 2.0, 3.0]))
    mean, low, high = example.gain([after], before)
    assert mean == 2.0 and 1.0 <= low < high <= 3.0  # far less than the returns differ
    assert example.gain([after, after], before) == (2.0, 2.0, 2.0)
