"""Text of the page about all environments: construction, arguments, custom tasks, other libraries."""

from __future__ import annotations

import inspect
import re

import torch

from pages.docstrings import documented
from pages.environment_cases import ENVIRONMENTS
from pages.environment_page import SCRIPT, measured, newest, rate_words, rates, robot_of
from pages.text import MADE, sentence, table, wrapped
from torchdq.envs import Actions, RobotVectorEnv, Simulation, randomization, vector_env

INTRODUCTION = """\
An environment is a [scene](../effects/index.md), a task, and random numbers. Thousands of environments run as one
program: a step of all of them is one call, including observations, rewards, terminations and resets."""

WAYS = """\
## Construction

```python
import gymnasium
import torch

import torchdq.envs

one = gymnasium.make("torchdq/Reach-v0")  # numpy, one arm
# numpy, reset at the next step
many = gymnasium.make_vec("torchdq/Reach-v0", num_envs=64, robot="ur10e")
envs = torchdq.envs.RobotVectorEnv(64, "reach", "ur10e")  # torch tensors, reset at once

observation, info = envs.reset(seed=0)
observation, reward, terminated, truncated, info = envs.step(torch.zeros(64, 6))
```

`gymnasium.make_vec` returns numpy arrays and resets finished rows at the next step, as gymnasium's wrappers expect,
unless `output="torch"` and `autoreset_mode` are given. Rows are independent: row i of a batch with the seed s is
bitwise the same as the single environment with the seed s + i. Seeds that differ by less than the number of rows share
episodes: test on a seed that is further away. A failed simulation ends its own row only."""

TASKS = """\
## Custom tasks

A `TorchTask` takes reward, observation, end or start of an episode from functions of tensors, and everything else from
a registered task, if it names one. Without, as in [the guide](../guides/million.md#a-task-of-your-own), an episode
starts at rest and the observation is the measured state.

```python
from torchdq.envs import RobotVectorEnv, TorchTask


def reward(now):  # tensors [N, ...] after a step
    return -now.rows["distance"] - 0.01 * now.qd.square().sum(1)


envs = RobotVectorEnv(64, TorchTask("reach", reward), "panda")
observation, info = envs.reset(seed=0)
observation, reward, terminated, truncated, info = envs.step(torch.zeros(64, 7))
```

A recorded task is part of the program of the step, and faster; it is a class like `torchdq.envs.tasks.Reach`, see
[Contributing](../contributing.md#a-task)."""

SERVOS = """\
## Servos, floating bases and pushes

With an [`effects.Servo`](../effects/servo.md), actions are offsets of its targets. A robot with a floating base starts
at the origin and at rest, unless the start of the task has the pose `"X_WB"` and the twist `"V_WB_B"`. `Pushes` come at
random times.

```python
from torchdq import effects
from torchdq.envs import Pushes

servo = effects.Servo(300.0, 30.0)
parts = (effects.Gravity(), effects.RotorInertia(0.1), servo, effects.Push())
# [N, N m], between two pushes [s]
pushes = {"push": Pushes((20.0, 20.0, 0.0, 0.0, 0.0, 0.0), every=(0.5, 2.0))}
envs = RobotVectorEnv(64, "reach", "panda", effects=parts, pushes=pushes)
observation, info = envs.reset(seed=0)
observation, reward, terminated, truncated, info = envs.step(torch.zeros(64, 7))
```"""

RANDOMISE = """\
## Domain randomisation

`randomise` draws parameters in every episode. Values are a number, a pair (lower, upper), or a torch distribution with
`icdf`, such as `Normal`. They are factors; an `Absolute` range is of the numbers of a parameter themselves. `envs.set`
changes ranges, pushes and commands while a policy learns, as a [curriculum](../guides/legs.md#a-curriculum).

```python
from torchdq.envs import Absolute

tilted = Absolute([-1.0, -1.0, -9.81], [1.0, 1.0, -9.81])  # [m/s^2]
drawn = {"mass": 0.1, "friction": (0.5, 1.5), "payload": 1.0}
drawn["Gravity.acceleration"] = tilted
envs = RobotVectorEnv(64, "reach", "panda", randomise=drawn)
observation, info = envs.reset(seed=0)
```

Several effects of a kind are counted from zero, in the order of the scene: `"Contact.0.height"` and
`"Contact.1.height"`."""

SAVING = """\
## Checkpoints

```python
saved = envs.get_state()  # states, goals, random numbers and drawn parameters
envs.step(torch.zeros(64, 7))
envs.set_state(saved)  # the step is undone
```"""


def index() -> str:
    """Page about all environments."""
    stored, rows = rates(), []
    for task in ENVIRONMENTS:
        spec, kind, robot = newest(task), ENVIRONMENTS[task].task, robot_of(task)
        best = max(rate for _, _, rate in stored["rates"][task])
        rows.append(
            (
                f"[{spec.id}]({task}.md)",
                sentence(documented(kind).summary),
                f"`{robot.name}`",
                f"{len(kind().bounds(robot))}",
                f"{robot.n}",
                f"{spec.max_episode_steps}",
                rate_words(best),
            )
        )
    head = ("id", "task", "robot", "observation", "action", "steps of an episode", "steps per second")
    parts = [
        "# Environments",
        MADE.format(script=SCRIPT),
        INTRODUCTION,
        f"{table(head, rows)}\n\nOf the default robots. {measured(stored)}",
        WAYS,
        "## Arguments",
        "All three take the arguments of `RobotVectorEnv`, listed here with their defaults.",
        arguments(RobotVectorEnv),
        "`action` may be an `Actions` with these fields:",
        arguments(Actions),
        " ".join(documented(Actions).text),
        "`simulation` is a `Simulation` with these fields:",
        arguments(Simulation),
        TASKS,
        SERVOS,
        f"{RANDOMISE}\n\n{_randomised()}",
        SAVING,
        f"## With other libraries\n\n{_libraries()}",
    ]
    return (
        "\n\n".join(part if "```" in part else wrapped(part) if "\n\n" not in part else part for part in parts) + "\n"
    )


def arguments(of: type) -> str:
    """Table of the arguments of a constructor, values with a meaning of their own on lines of their own."""
    said, rows = documented(of).arguments, []
    for name, parameter in inspect.signature(of).parameters.items():
        default = parameter.default
        value = str(default) if isinstance(default, torch.dtype) else repr(getattr(default, "value", default))
        text, unit = said[name].meaning, said[name].unit
        text = re.sub(r' (?=("(reference|target|torque|residual|pose)"|SAME_STEP|NEXT_STEP|DISABLED): )', "<br>", text)
        rows.append((f"`{name}`", f"`{value}`", sentence(text) + (f" [{unit}]" if unit else "")))
    return table(("argument", "default", "meaning"), rows).replace("&lt;br>", "<br>")


def _randomised() -> str:
    """Table of the module that draws parameters."""
    lines = inspect.getdoc(randomization).splitlines() if inspect.getdoc(randomization) else []
    rows = [match.groups() for line in lines if (match := re.match(r' +("[\w.]+") {2,}(.+?) {2,}(.+)$', line))]
    return table(("name", "parameter", "range for a number x"), [(f"`{a}`", b, c) for a, b, c in rows])


def _libraries() -> str:
    """Table of the module of the environments."""
    block = (inspect.getdoc(vector_env) or "").partition("Other libraries take")[2]
    rows = [match.groups() for line in block.splitlines() if (match := re.match(r" {4}(\S.+?) {2,}(.+)$", line))]
    return table(("library", "how"), [(a, " or ".join(f"`{x}`" for x in b.split(", or "))) for a, b in rows])
