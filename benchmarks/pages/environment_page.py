"""Text and picture of the page of each registered environment."""

from __future__ import annotations

import io
import json
import re
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Any, get_args

import gymnasium
import numpy as np
import torch

import torchdq
from pages.docstrings import documented
from pages.effect_page import address as effect_address
from pages.environment_cases import ENVIRONMENTS
from pages.formulas import tex
from pages.pictures import Curve, Picture, svg
from pages.text import MADE, sentence, table, wrapped
from torchdq.effects import Contact
from torchdq.envs import Pushes, RobotVectorEnv, episode
from torchdq.envs.actions import Kind
from torchdq.envs.render import Painter
from torchdq.envs.task_names import task_of
from torchdq.robot import Robot

ROOT = Path(__file__).resolve().parents[2]
RATES = ROOT / "benchmarks" / "results" / "environments.json"
LEARNED = ROOT / "benchmarks" / "results" / "learning.json"
SCRIPT = "benchmarks/environments.py"
ROBOT = "panda"  # the default
DATA = "positions"  # entry of a PNG file: positions of the joints at the moments
SEED = 3  # of the picture
ACTIONS = {
    "torque": "torque of each joint",
    "residual": "torque added to a controller that follows the task's reference",
    "reference": "offset of the position that the controller follows",
    "target": "offset of the target of the servo",
    "pose": "rotation vector and displacement of the desired pose of the end effector",
}
ACTION_UNITS = dict.fromkeys(("torque", "residual"), "N m or N") | dict.fromkeys(("reference", "target"), "rad or m")
ACTION_UNITS["pose"] = "rad or m"


def registered() -> dict[str, list[gymnasium.envs.registration.EnvSpec]]:
    """Registered environments of the package: versions by task."""
    found: dict[str, list[Any]] = {}
    for spec in gymnasium.registry.values():
        if spec.namespace == "torchdq":
            found.setdefault(spec.kwargs["task"], []).append(spec)
    return found


def newest(task: str) -> gymnasium.envs.registration.EnvSpec:
    """Newest version of an environment."""
    return max(registered()[task], key=lambda spec: spec.version or 0)


def robot_of(task: str) -> Robot:
    """The default robot of an environment."""
    return torchdq.robots.load(newest(task).kwargs.get("robot", task_of(task).ROBOT))


def rates() -> dict[str, Any]:
    """Rates of every environment, measured and stored."""
    return json.loads(RATES.read_text(encoding="utf-8"))


def learned(task: str) -> dict[str, Any] | None:
    """Stored results of learning in an environment; None: there are none."""
    return json.loads(LEARNED.read_text(encoding="utf-8"))["learning"].get(task)


def page(task: str) -> str:
    """Page of an environment."""
    case, spec, robot = ENVIRONMENTS[task], newest(task), robot_of(task)
    said, envs = documented(case.task, frozenset({"action"})), RobotVectorEnv(1, task, robot)
    limit, dt = spec.max_episode_steps or 0, envs.scene.dt
    start = documented(case.task.start)
    joints = f"`{robot.name}`, {robot.n} joints"
    parts = [
        f"# {spec.id.split('/')[1]}",
        MADE.format(script=SCRIPT),
        sentence(said.summary),
        f'`gymnasium.make("{spec.id}")` creates one environment, `gymnasium.make_vec` many, and '
        f'`torchdq.envs.RobotVectorEnv(4096, "{task}")` many on tensors.',
        f"![{robot.name} at {len(case.moments)} moments: {said.summary[0].lower()}{said.summary[1:-1]}]({task}.png)",
        f"One episode, after {', '.join(f'{k * dt:g}' for k in case.moments)} s.",
        "## Task",
        *case.about,
        *_paragraphs(case.task, "Goal", "Reference", "Table", "By default"),
        "## Observation",
        f"`Box({len(case.task().bounds(robot))},)` for the default robot ({joints}), as measured by the sensors. "
        "Entries are clipped to their bounds.",
        _observation(task, robot),
        "## Action",
        f"`Box(-1, 1, ({robot.n},))`. The argument `action` sets the meaning of a full action; "
        "`Actions(..., scale=...)` replaces the numbers.",
        _actions(task, robot),
        "## Reward",
        *[f"$$\n{tex(formula, frozenset({'action'}))}\n$$" for formula in said.formulas],
        *_paragraphs(case.task, "Reward: ", "Here "),
        *([] if case.reward is None else [case.reward.words]),
        "It is computed from the true state, not from measurements. If the simulation fails, because a state is not "
        f"finite, the reward of that step is {episode.WORST:g} instead.",
        "## End of an episode",
        table(
            ("flag", "condition"),
            [
                ("terminated", case.ends),
                ("truncated", f"after {limit} steps, {limit * dt:g} s; `max_episode_steps` replaces it"),
            ],
        ),
        "## Start of an episode",
        f"{start.summary} An episode starts from {case.task().draws(robot)} random numbers, determined by the seed: "
        "row i of a batch with the seed s is bitwise the same as the single environment with the seed s + i. "
        "[`randomise`](index.md#domain-randomisation) draws parameters of the robot and of effects.",
        "## Effects",
        f"With `effects=None` {case.effects}. For `{robot.name}`:",
        table(("effect", "parameters"), _effects(task, robot)),
        f"One step is {dt:g} s, in {envs.scene.substeps} substeps of `{type(envs.scene.integrator).__name__}`.",
        "## info",
        table(("entry", "meaning"), [(f"`{name}`", words) for name, words in case.info.items()]),
        *_learning(task),
        *case.more,
        "## Speed",
        _rates(task),
        "## Versions",
        table(("id", "changes"), [(f"`torchdq/{task.title()}-{v}`", words) for v, words in case.versions.items()]),
        "## Example",
        f"```python\n{_example(task, spec.id)}\n```",
    ]
    return "\n\n".join(wrapped(part) for part in parts) + "\n"


def _paragraphs(task: type, *about: str) -> list[str]:
    """Sentences of the docstring that begin with some words."""
    sentences = [
        words
        for paragraph in documented(task, frozenset({"action"})).text
        for words in re.split(r"(?<=\.)\s+(?=Goal|Observation|Success|Reward|Reference|End)", paragraph)
    ]
    return [sentence(x) for x in sentences if x.startswith(about)]


def _observation(task: str, robot: Robot) -> str:
    bounds, rows, at = ENVIRONMENTS[task].task().bounds(robot), [], 0
    for entries, width in zip(ENVIRONMENTS[task].observation, widths(task), strict=True):
        low, high = zip(*bounds[at : at + width], strict=True)
        numbers = f"{at} to {at + width - 1}" if width > 1 else f"{at}"
        rows.append((numbers, entries.what, entries.unit, _range(low), _range(high)))
        at += width
    return table(("entries", "quantity", "unit", "lower bound", "upper bound"), rows)


def widths(task: str) -> list[int]:
    """Number of entries of each part of an observation, of the default robot."""
    envs = RobotVectorEnv(1, task, robot_of(task))
    envs.reset(seed=0)
    now = situation(envs)
    return [entries.value(now).shape[1] for entries in ENVIRONMENTS[task].observation]


def situation(envs: RobotVectorEnv) -> Any:
    """State of environments without sensors."""
    from pages.environment_cases import Situation

    found, scene = envs.get_state(), envs.scene
    touching = any(isinstance(effect, Contact) for effect in scene.effects)
    contacts, time = scene.contacts(envs.state) if touching else None, float(found["steps"][0]) * scene.dt
    return Situation(envs.robot, found["q"], found["qd"], found["goal"], time, contacts, scene.touching, found)


def _range(numbers: tuple[float, ...]) -> str:
    low, high = (f"{x:.3g}" for x in (min(numbers), max(numbers)))
    return low if low == high else f"{low} to {high}"


def _actions(task: str, robot: Robot) -> str:
    rows, own = [], RobotVectorEnv(1, task, robot)
    usual = own._meaning.kind
    for kind in (usual,) if usual == "target" else (kind for kind in get_args(Kind) if kind != "target"):
        made = own if kind == usual else RobotVectorEnv(1, task, robot, action=kind)
        numbers, default = ", ".join(f"{x:.3g}" for x in made._scale.tolist()), " (default)" if made is own else ""
        rows.append((f'`"{kind}"`{default}', ACTIONS[kind], numbers, ACTION_UNITS[kind]))
    return table(("`action`", "meaning", "a full action, joint by joint", "unit"), rows)


def _effects(task: str, robot: Robot) -> list[tuple[str, str]]:
    """Rows of the table of effects, with the ranges of what is drawn, of many episodes."""
    envs = RobotVectorEnv(1024, task, robot)
    envs.reset(seed=0)
    pushes = envs.task.defaults(robot).get("pushes", {})
    return [_effect(effect, pushes.get(getattr(effect, "name", None))) for effect in envs.scene.effects]


def _effect(effect: Any, pushes: Pushes | None) -> tuple[str, str]:
    name = type(effect).__name__
    numbers = [f"{k} {_numbers(getattr(effect, k))}" for k in effect.SHAPES if k not in ("warming",)]
    numbers = [x for x in [effect.label().partition(": ")[2]] if x] + numbers
    if pushes:
        wrench, (least, most) = ", ".join(f"{x:.3g}" for x in pushes.wrench), pushes.every
        numbers = [f"up to {wrench} [N, N m] along each axis for {pushes.duration:g} s, every {least:g} to {most:g} s"]
    return f"[{name}](../effects/{effect_address(name)})", "; ".join(numbers)


def _numbers(x: Any) -> str:
    """Numbers of all joints, once if they are equal, or the range of those that are drawn."""
    if isinstance(x, torch.Tensor):
        low, high = float(x.min()), float(x.max())
        digits = 2 if high > 1.5 * low else 3
        return f"drawn, {low:.{digits}g} to {high:.{digits}g}"
    row = x if isinstance(x, tuple) else (x,)
    return f"{row[0]:.4g}" if len(set(row)) == 1 else ", ".join(f"{value:.4g}" for value in row)


def _learning(task: str) -> list[str]:
    """Section on the policy that learns, with its curve; nothing where none was measured."""
    if (found := learned(task)) is None:
        return []
    seeds, tests = found["seeds"], found["tests"]
    seconds, steps = seeds[0][-1][0], sum(curve[-1][1] for curve in seeds) / len(seeds)

    def row(what: str, results: Sequence[Sequence[float]]) -> tuple[str, str, str]:
        distances = ", ".join(f"{1e3 * distance:.0f}" for _, _, distance, *_ in results)
        return what, f"{distances} mm", ", ".join(f"{success:.0%}" for _, _, _, success, *_ in results)

    rows = [row(name, [result]) for name, result in found["policies"].items()]
    for at in (0.0, seconds / 3, seconds):
        rows.append(row(f"PPO after {at:.0f} s", [min(curve, key=lambda x: abs(x[0] - at)) for curve in seeds]))
    blocks = found["blocks"]
    for at in (5.0, 10.0, blocks[0][-1][0]):
        rows.append(row(f"PPO on blocks after {at:.0f} s", [min(c, key=lambda x: abs(x[0] - at)) for c in blocks]))
    machine = ", ".join(f"{k} {v}" for k, v in json.loads(LEARNED.read_text(encoding="utf-8"))["machine"].items())
    return [
        "## Learning",
        f"PPO of Stable-Baselines3 learns the task in {seconds / 60:.0f} minutes on one core:",
        _learning_code(task, found),
        f"![Median distance and success against the processor time of training, two kinds of PPO]({task}_learning.svg)",
        f"Of {tests} episodes that training never saw: the median distance from the goal at the end, and the share of "
        f"success. Lines are medians of {len(seeds)} seeds, {len(blocks)} on blocks, and bands their ranges. Seconds "
        f"are processor time of training, {steps / 1e6:.1f} million steps of Stable-Baselines3 in {seconds:.0f} s.",
        table(("policy", "median distance at the end", "success"), rows),
        "PPO on blocks is that of `examples/21_walk_ppo.py`; its rollouts are single calls. The policy without action "
        "stands still. The one with known kinematics moves along the damped inverse of the Jacobian; PPO is given no "
        "model of the arm. `python benchmarks/learn.py --page` measures curve and table: "
        f"{machine}.",
    ]


def _learning_code(task: str, found: dict[str, Any]) -> str:
    line = found["line"].replace("(", "(\n    ").replace(", ", ",\n    ").replace(")", ",\n)")
    return f'''```python
from stable_baselines3 import PPO

from torchdq.envs import RobotVectorEnv
from torchdq.envs.sb3 import StableBaselinesVecEnv

vec = StableBaselinesVecEnv(RobotVectorEnv({found["arms"]}, "{task}", "{ROBOT}"))
model = {line}
# model.learn(5_000_000)
```'''


def learning_picture(task: str) -> str:
    """SVG of the learning curves of an environment: medians and ranges of the seeds."""
    found = learned(task) or {}

    def panel(label: str, column: int, factor: float, log: str = "") -> Picture:
        curves = {}
        for words, name in {"PPO of Stable-Baselines3": "seeds", "PPO on blocks": "blocks"}.items():
            tests = [list(zip(*at, strict=True)) for at in zip(*found[name], strict=False)]  # of all seeds at a time
            rows = [sorted(factor * y for y in test[column]) for test in tests]
            ends = [row[0] for row in rows], [row[-1] for row in rows]
            curves[words] = Curve([median(test[0]) for test in tests], [median(row) for row in rows], ends)
        return Picture("processor time [s]", label, curves, log)

    return svg(panel("median distance at the end [mm]", 2, 1e3, "y"), panel("success [%]", 3, 100.0))


def _rates(task: str) -> str:
    stored = rates()
    rows = [(what, f"{envs}", rate_words(rate)) for what, envs, rate in stored["rates"][task]]
    made = table(("constructor", "environments", "steps of an environment per second"), rows)
    return f"{made}\n\n{measured(stored)}"


def rate_words(rate: float) -> str:
    """Steps per second in words."""
    return f"{rate / 1e6:.2f} million" if rate >= 1e6 else f"{rate / 1e3:.1f} thousand"


def measured(stored: dict[str, Any]) -> str:
    """Conditions and machine of the measured rates."""
    machine = ", ".join(f"{key} {value}" for key, value in stored["machine"].items())
    return f"float32, one thread, observations, rewards and resets included: {machine}."


def _example(task: str, id: str) -> str:
    hint, other = ENVIRONMENTS[task].hint, ENVIRONMENTS[task].other
    return f'''import gymnasium
import torch

import torchdq.envs

env = gymnasium.make("{id}")  # one, in numpy
observation, info = env.reset(seed=0)
observation, reward, terminated, truncated, info = env.step(env.action_space.sample())

# 64 of them, in tensors
envs = torchdq.envs.RobotVectorEnv(64, "{task}", "{other}", action="{hint}")
observation, info = envs.reset(seed=0)
total = torch.zeros(64)
for _ in range(50):
    observation, reward, terminated, truncated, info = envs.step(torch.zeros(64, {torchdq.robots.load(other).n}))
    total += reward'''


# --- pictures ------------------------------------------------------------------------------------------------------


def picture(task: str) -> bytes:
    """PNG of one arm at some moments of an episode, under a simple policy, with its positions as numbers."""
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    case = ENVIRONMENTS[task]
    # in double, because contact multiplies what is rounded
    envs = RobotVectorEnv(1, task, robot_of(task), action=case.hint, dtype=torch.float64)  # type: ignore[arg-type]
    envs.reset(seed=SEED)
    painter, frames, positions = Painter(envs.scene if envs.scene.objects else envs.robot, (240, 280)), [], []
    for step in range(case.moments[-1] + 1):
        now = situation(envs)
        if step in case.moments:
            target, X_WB = now.goal[0] if now.goal.shape[1] == 3 else None, now.state.get("X_WB", [None])[0]
            X_WO = None if envs.state.X_WO is None else envs.state.X_WO[0]
            frames.append(painter.frame(now.q[0], target, None, X_WB, X_WO))
            positions.append([round(x, 4) for x in now.q[0].tolist()])
        envs.step(torch.zeros(1, envs.robot.n) if case.policy is None else case.policy(now))
    file, data = io.BytesIO(), PngInfo()
    data.add_text(DATA, json.dumps(positions))
    Image.fromarray(np.concatenate(frames, 1)).save(file, format="PNG", optimize=True, pnginfo=data)
    return file.getvalue()
