"""Every registered environment has a page that says what it does: observations, actions, reward, ends, versions."""

import inspect
import io
import json
import re

import environments as benchmark
import gymnasium
import pytest
import torch
from pages.docstrings import documented
from pages.environment_cases import ENVIRONMENTS, towards
from pages.environment_page import (
    DATA,
    learned,
    learning_picture,
    newest,
    picture,
    rates,
    registered,
    robot_of,
    situation,
)
from pages.pictures import curves_of

from torchdq.envs import RobotVectorEnv
from torchdq.envs.walk import WEIGHTS

REMEDY = "write it again with `python benchmarks/environments.py --write`"
FOLDER = benchmark.FOLDER
EVERY = pytest.mark.parametrize("task", ENVIRONMENTS)
F64 = torch.float64
GENTLE = {"wipe": 0.1, "walk": 0.1}  # share of full random actions, of which some would end an episode
BACKEND = "auto"  # many steps


def moving(task, robot=None):
    """Environments after some random actions, their last observation and what `step` returned."""
    envs = RobotVectorEnv(8, task, robot or robot_of(task), dtype=F64)
    envs.reset(seed=4)
    generator = torch.Generator().manual_seed(2)
    for _ in range(30):
        actions = GENTLE.get(task, 1.0) * (2 * torch.rand(8, envs.robot.n, generator=generator, dtype=F64) - 1)
        found = envs.step(actions)
    return envs, found, actions


def test_every_registered_environment_has_a_page_with_all_of_its_versions():
    assert sorted(registered()) == sorted(ENVIRONMENTS) == sorted(rates()["rates"])
    for task, specs in registered().items():
        page = (FOLDER / f"{task}.md").read_text(encoding="utf-8")
        assert sorted(f"v{spec.version}" for spec in specs) == sorted(ENVIRONMENTS[task].versions)
        assert all(f"| `{spec.id}` |" in page for spec in specs)


def test_the_pages_are_what_the_environments_say():
    for name, page in benchmark.pages().items():
        assert (FOLDER / name).read_text(encoding="utf-8") == page, f"docs/environments/{name} is old; {REMEDY}"


def test_the_folder_holds_nothing_else():
    made = {f"{task}.{kind}" for task in ENVIRONMENTS for kind in ("md", "png")}
    made |= {f"{task}_learning.svg" for task in ENVIRONMENTS if learned(task)}
    assert {path.name for path in FOLDER.iterdir()} == {"index.md", *made}


@pytest.mark.parametrize("other", [False, True], ids=["default", "other"])
@EVERY
def test_entries_of_an_observation_are_what_the_table_says(task, other):
    envs, (observation, *_), _ = moving(task, ENVIRONMENTS[task].other if other else None)
    now, at = situation(envs), 0
    for entries in ENVIRONMENTS[task].observation:
        expected = entries.value(now)
        torch.testing.assert_close(observation[:, at : at + expected.shape[1]], expected, rtol=1e-9, atol=1e-9)
        at += expected.shape[1]
    assert at == envs.single_observation_space.shape[0]


@EVERY
def test_the_reward_is_the_formula_of_the_page(task):
    case = ENVIRONMENTS[task]
    (formula, *_) = documented(case.task, frozenset({"action"})).formulas or ("",)
    code = re.sub(r"(?<=\d) (?=[a-z])", " * ", formula.partition(",  ")[0].replace("^", "**"))
    envs, (_, reward, _, _, info), actions = moving(task)
    if case.reward:
        torch.testing.assert_close(reward, case.reward.value(situation(envs)), rtol=1e-9, atol=1e-9)
        return
    if task == "walk":  # a sum of terms
        expected = 0.02 * sum(info[name] for name in WEIGHTS).clamp(min=0)
        torch.testing.assert_close(reward, expected, rtol=1e-9, atol=1e-9)
        return
    known = {"d": info.get("distance"), "e": info.get("error"), "action": actions, "mean": lambda x: x.mean(1)}
    torch.testing.assert_close(reward, eval(code, known), rtol=1e-9, atol=1e-9)


@EVERY
def test_entries_of_info_are_those_of_the_table(task):
    _, (*_, info), _ = moving(task)
    assert set(info) == set(ENVIRONMENTS[task].info)


@EVERY
def test_an_episode_is_truncated_where_the_page_says_and_never_ends_before(task):
    spec = newest(task)
    env = gymnasium.make(spec.id, disable_env_checker=True)
    env.reset(seed=1)
    env.action_space.seed(1)
    for k in range(1, spec.max_episode_steps + 1):
        _, _, terminated, truncated, _ = env.step(GENTLE.get(task, 1.0) * env.action_space.sample())
        assert not terminated and truncated == (k == spec.max_episode_steps)
    page, dt = (FOLDER / f"{task}.md").read_text(encoding="utf-8"), env.unwrapped.envs.scene.dt
    assert f"| truncated | after {spec.max_episode_steps} steps, {spec.max_episode_steps * dt:g} s" in page


def test_the_line_of_the_guide_is_the_one_that_was_measured_and_it_learns():
    found = learned("reach")
    guide = (FOLDER.parent / "guides" / "million.md").read_text(encoding="utf-8")
    assert (
        "".join(found["line"].split()) in "".join(guide.split()).replace(",)", ")")
        and repr(found["line"]) in (FOLDER.parents[1] / "benchmarks/learn.py").read_text()
    )
    assert f'RobotVectorEnv({found["arms"]}, "reach", "panda")' in guide
    for curve in found["seeds"]:
        seconds, _, distance, success = curve[-1]
        assert seconds < 182 and distance < 0.025 and success > 0.7


def test_the_table_of_arguments_has_all_of_them():
    page = (FOLDER / "index.md").read_text(encoding="utf-8")
    assert all(f"| `{name}` | `" in page for name in inspect.signature(RobotVectorEnv).parameters)


def test_the_policy_of_the_picture_reaches_its_goal():
    envs = RobotVectorEnv(4, "reach", "panda", action="reference")
    envs.reset(seed=0)
    first = situation(envs)
    for _ in range(100):
        info = envs.step(towards(situation(envs)))[4]
    start = (first.goal - ENVIRONMENTS["reach"].observation[3].value(first)).norm(dim=1)
    assert (info["distance"] < 0.5 * start).all()


@pytest.mark.parametrize("task", ["push", "lift", "pick"])
def test_the_policy_of_a_picture_moves_the_object_to_its_goal(task):
    envs = RobotVectorEnv(8, task)
    envs.reset(seed=0)
    for _ in range(ENVIRONMENTS[task].moments[-1]):
        info = envs.step(ENVIRONMENTS[task].policy(situation(envs)))[4]
    assert info["success"].mean() > 0.7


@EVERY
def test_a_picture_shows_the_positions_of_the_episode(task):
    image = pytest.importorskip("PIL.Image")
    pytest.importorskip("matplotlib")
    kept, drawn = image.open(FOLDER / f"{task}.png"), image.open(io.BytesIO(picture(task)))
    assert kept.size == drawn.size and (FOLDER / f"{task}.png").stat().st_size < 150_000
    positions = [torch.tensor(json.loads(x.info[DATA])) for x in (kept, drawn)]
    assert torch.allclose(*positions, rtol=0, atol=1e-3), REMEDY


def test_a_picture_of_learning_shows_the_stored_results():
    for task in filter(learned, ENVIRONMENTS):
        kept, drawn = map(curves_of, ((FOLDER / f"{task}_learning.svg").read_text("utf-8"), learning_picture(task)))
        assert len(kept) == len(drawn) == 4
        assert all((a == b).all() for a, b in zip(kept, drawn, strict=True)), REMEDY
