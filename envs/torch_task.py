"""Tasks whose reward, observation, end or start are functions of tensors.

Recorded tasks (`torchdq.envs.tasks`) are part of the program of a step and are faster. A `TorchTask` runs after the
step and needs no number-generic code. It may name a recorded task, from which it takes what it does not define:

    def reward(now: Now) -> dict[str, Tensor]:  # terms [N], which also are in `info`
        return {"near": torch.exp(-10 * now.rows["distance"]), "effort": -0.01 * now.action.square().mean(1)}

    def observation(now: Now) -> Tensor:  # [N, k]
        tip = torchdq.forward_kinematics(now.robot, now.q_measured, now.robot.end_effector().name)
        return torch.cat([torchdq.dq.translation(tip), now.qd_measured, now.goal], 1)

    def terminated(now: Now) -> Tensor:  # [N] bool
        return now.rows["distance"] < 0.01

    def start(robot: Robot, u: Tensor) -> dict[str, Tensor]:  # u [N, draws] in (0, 1)
        return {"q": robot.limits.lower + (robot.limits.upper - robot.limits.lower) * u}

    task = TorchTask("reach", reward, observation, terminated, start, bounds=[(-10, 10)] * 13, draws=7)
    envs = RobotVectorEnv(4096, task, "panda")

or stand alone: `TorchTask(reward=..., observation=..., start=..., bounds=..., draws=...)`.
"""

from __future__ import annotations

import inspect
import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchdq.base.checks import floating, require_count, require_tensor
from torchdq.envs.tasks import RESERVED, SENSIBLE, EpisodeTask, Plain
from torchdq.errors import ArgumentError, UnknownNameError
from torchdq.program.program import Argument
from torchdq.robot import Robot
from torchdq.robot.fields import SHAPES, trailing
from torchdq.robot.model import batches
from torchdq.scene.recording import Stage
from torchdq.scene.scene import Scene
from torchdq.scene.spec import POSES
from torchdq.scene.state import State, require_unit


class TaskRows(dict[str, Tensor]):
    """Rows of a task by name."""

    def __missing__(self, name: str) -> Tensor:
        """Raise, naming the rows that there are."""
        raise UnknownNameError("row of the recorded task", name, self)


class Now(NamedTuple):
    """A batch of environments after a step, or at the start of an episode, as the functions of a task see it."""

    q: Tensor  # [N, n] positions [rad or m]
    qd: Tensor  # [N, n] velocities [rad/s or m/s]
    q_measured: Tensor  # [N, n] as the sensors read them
    qd_measured: Tensor  # [N, n]
    goal: Tensor  # [N, ...] of the start
    time: Tensor  # [N] since the start of the episode [s]
    action: Tensor  # [N, n] in [-1, 1]; zeros at a start, and for passive joints
    rows: Mapping[str, Tensor]  # those of the recorded task: "observation", "reward", "reference" and others
    simulated: Callable[[], Robot]  # function that returns `robot`
    X_WB: Tensor | None = None  # [N, 8] pose of a floating base
    V_WB_B: Tensor | None = None  # [N, 6] its twist, in its own axes [rad/s, m/s]

    @property
    def robot(self) -> Robot:
        """Rigid bodies as they are simulated, a row for each environment where they differ.

        They have the gravity, the rotors and the payloads of the scene's effects, and masses, centres of mass and
        gravity as they were drawn. Friction and delays are not part of them. An observation that depends on them gives
        a policy what no sensor of a real arm measures; close over the robot as described where that is not meant.
        """
        return self.simulated()


@dataclass(frozen=True)
class TorchTask:
    """Task whose reward, observation, end and start are functions of tensors, called after every step.

    Functions take rows that are independent of each other, and must return tensors whose row i depends on row i alone.
    They are called without gradients, and must not change tensors in place. A reward or an observation that is not
    finite ends the episode as a failure.

    Args:
        recorded: task that defines everything else, above all goal and reference, by its name or by itself; None:
            `torchdq.envs.tasks.Plain`, without goal and reward: a start at rest in the middle half of the joints'
            ranges, an observation of measured positions and velocities, and a reference that stands still.
        reward: function of a `Now` that returns [N], or a dict of terms [N] by name, of which the reward is the sum and
            which `info` has, too; None: that of the recorded task.
        observation: function of a `Now` that returns [N, k], also called at starts; it needs `bounds`. None: likewise.
        terminated: function of a `Now` that returns a bool [N]; None: likewise.
        start: function of the robot, as described, and of random numbers in (0, 1) [N, draws] that returns
            {"q": [N, n]}, and may return "qd" [N, n], "goal" and, of a floating base, "X_WB" [N, 8] and "V_WB_B"
            [N, 6]; what it leaves out is that of the recorded task. None: likewise.
        bounds: a pair (lower, upper) for each of the k numbers of an observation, such as [(-10, 10)] * k; may be
            infinite. They become `single_observation_space`; observations are not clipped.
        draws: random numbers that `start` takes for each episode.

    >>> import torch
    >>> from torchdq.envs import RobotVectorEnv, TorchTask
    >>> still = TorchTask(reward=lambda now: -now.qd.square().sum(1))
    >>> envs = RobotVectorEnv(3, still, "panda")
    >>> observations, info = envs.reset(seed=0)
    >>> envs.step(torch.zeros(3, 7))[1].shape
    torch.Size([3])
    """

    recorded: str | EpisodeTask | None = None
    reward: Callable[[Now], Tensor | Mapping[str, Tensor]] | None = None
    observation: Callable[[Now], Tensor] | None = None
    terminated: Callable[[Now], Tensor] | None = None
    start: Callable[[Robot, Tensor], Mapping[str, Tensor]] | None = None
    bounds: Sequence[tuple[float, float]] | None = None
    draws: int = 0

    def __post_init__(self) -> None:
        require_count("draws", self.draws, least=0)
        for name in ("reward", "observation", "terminated", "start"):
            if not (getattr(self, name) is None or callable(getattr(self, name))):
                raise ArgumentError(f"{name} must be a function or None, found {getattr(self, name)!r}")
        if inspect.isroutine(self.recorded):
            raise ArgumentError("recorded must be a task or its name, found a function; did you mean reward=...?")
        if (self.observation is None) != (self.bounds is None):
            raise ArgumentError(
                "bounds must be given with an observation, and only then: a pair (lower, upper) for each of its k "
                "numbers, such as bounds=[(-10, 10)] * k"
            )
        if self.bounds is not None:
            pairs = np.asarray(self.bounds, dtype=float)
            if pairs.ndim != 2 or pairs.shape[1] != 2 or not (pairs[:, 0] <= pairs[:, 1]).all():
                raise ArgumentError(
                    f"bounds must be pairs (lower, upper), one for each number of an observation, found {self.bounds!r}"
                )
            object.__setattr__(self, "bounds", tuple(map(tuple, pairs.tolist())))
        if self.recorded is None and self.reward is None:
            raise ArgumentError("reward must be given unless a recorded task has one, such as TorchTask('reach', ...)")

    def recorded_for(self, robot: Robot) -> str | EpisodeTask:
        """The recorded task; a plain one has goals as wide as those of `start`, which is called once to see."""
        if self.recorded is not None:
            return self.recorded
        begun = {} if self.start is None else self.start(robot, torch.full((1, self.draws), 0.5))
        goal = begun.get("goal") if isinstance(begun, Mapping) else None
        return Plain(goal.shape[-1] if isinstance(goal, Tensor) and goal.ndim else 0)


class Functions(NamedTuple):
    """Functions of a task for the scene of its environments."""

    task: TorchTask
    scene: Scene
    robot: Robot  # as described
    simulated: Robot  # with the scene's gravity, rotors and payloads, and all else that episodes share
    differing: tuple[str, ...]  # names of its tensors that differ from episode to episode, or from row to row

    @classmethod
    def of(cls, task: TorchTask, robot: Robot, scene: Scene, device: torch.device) -> Functions:
        """Functions of a task for a scene, which may simulate more than the robot as described."""
        stage = Stage(scene.spec, "bodies")
        taken = [Argument("q", scene.n), *(Argument(name, math.prod(stage.axes(name))) for name in scene.parameters)]
        found = {result.name: result.values for result in stage.program(tuple(taken)).results}
        same = {name: row for name, row in found.items() if all(isinstance(x, float) for x in row)}
        differing = tuple(name for name in found if name not in same)
        known: dict[str, Any] = {name: None for name in ("gravity", "armature") if name not in differing}
        for name, row in same.items():
            known[name] = torch.tensor(row, dtype=torch.float64).reshape(trailing(SHAPES[name], scene.robot.sizes))
        described = scene.robot._with(**known)
        whole = described if batches(described) else described.bake()
        near = robot if robot.mass.device == device else robot.to(device=device)
        return cls(task, scene, near, whole.to(device=device), differing)

    def now(
        self,
        state: State,
        goal: Tensor,
        steps: Tensor,
        rows: Mapping[str, Tensor],
        action: Tensor | None = None,
        scene: Callable[[], Scene] | None = None,
    ) -> Now:
        """Environments as the functions see them; `scene` returns that of some of them alone."""
        q, qd = state.measured
        time = steps.to(state.q.dtype) * self.scene.dt
        action = torch.zeros_like(state.q) if action is None else action

        def simulated() -> Robot:
            if not self.differing:
                return self.simulated
            simulated_scene = self.scene if scene is None else scene()
            bodies = simulated_scene._evaluate("bodies", {"q": state.q})
            shapes = {name: trailing(SHAPES[name], self.robot.sizes) for name in self.differing}
            return self.simulated._with(**{name: bodies[name].reshape(-1, *shape) for name, shape in shapes.items()})

        return Now(state.q, state.qd, q, qd, goal, time, action, TaskRows(rows), simulated, state.X_WB, state.V_WB_B)

    def started(self, u: Tensor, looks: bool) -> dict[str, Tensor]:
        """Rows of the start that the task defines, of random numbers [N, draws].

        Raises if one is not finite; unless the host `looks`, such an episode fails at its first step.
        """
        if self.task.start is None:
            return {}
        found, widths = self.task.start(self.robot, u), {**self.scene.spec.moving, "goal": None}
        if not isinstance(found, Mapping):
            raise ArgumentError(f"start must return a dict of {', '.join(widths)}, found {type(found).__name__}")
        for name in found:
            if name not in widths:
                raise UnknownNameError("row that start may return", name, widths)
        rows = {name: _row(f"start's {name!r}", x, (len(u), widths[name]), u) for name, x in found.items()}
        for name, x in rows.items() if looks else ():
            require_finite_start(f"start's {name!r}", x)
        for name in [name for name in POSES if looks and name in rows]:
            require_unit(name, rows[name])
        return rows

    def observed(self, now: Now) -> Tensor:
        """Observation [N, k]."""
        if self.task.observation is None:
            return now.rows["observation"]
        return _row("observation", self.task.observation(now), (len(now.q), len(self.task.bounds or ())), now.q)

    def after(self, now: Now) -> dict[str, Tensor]:
        """Rows of a step; "valid" is 0 where a function returned what is not finite."""
        rows = {**now.rows, "observation": self.observed(now)}
        if self.task.reward is not None:
            reward = self.task.reward(now)
            terms = reward if isinstance(reward, Mapping) else {"reward": reward}
            for name in terms.keys() & {*RESERVED, *(now.rows if isinstance(reward, Mapping) else ())}:
                raise ArgumentError(f"reward of the task must not name a term {name!r}: there is a row of that name")
            found = {name: _row(name, x, (len(now.q),), now.q) for name, x in terms.items()}
            rows |= {**found, "reward": sum(found.values(), torch.zeros_like(now.time))}
        if self.task.terminated is not None:
            ended = self.task.terminated(now)
            require_tensor("terminated of the task", ended)
            if ended.dtype != torch.bool or ended.shape != now.q.shape[:1]:
                raise ArgumentError(
                    f"terminated must return a bool tensor of shape ({len(now.q)},), found {ended.dtype} of shape "
                    f"{tuple(ended.shape)}"
                )
            rows["terminated"] = ended.to(now.q.dtype)
        sound = rows["observation"].isfinite().all(1) & (rows["reward"].abs() <= SENSIBLE)
        if now.q.is_cpu and not bool(sound.all()):  # other devices are not waited for
            _warn_of_faults(now, rows)
        return {**rows, "valid": rows["valid"] * sound}


def _warn_of_faults(now: Now, rows: Mapping[str, Tensor]) -> None:
    """Warn where a reward or an observation is NaN although the simulation has not failed: the function is wrong."""
    simulated = (rows["valid"] != 0) & torch.cat([now.q, now.qd], 1).isfinite().all(1)
    for name, nan in {"reward": rows["reward"].isnan(), "observation": rows["observation"].isnan().any(1)}.items():
        if bool((nan & simulated).any()):
            found = f"{int(nan.sum())} of {len(nan)} rows whose positions and velocities are finite"
            warnings.warn(
                f"{name} of the task is NaN in {found}; these rows end as failed. Is there 0 / 0, or a root of "
                "a negative number?",
                stacklevel=4,
            )


def require_finite_start(name: str, x: Tensor) -> None:
    """Raise unless all numbers at the start of an episode are finite; later ones end the episode as a failure."""
    if not bool(x.isfinite().all()):
        row, column = (~x.isfinite()).nonzero()[0].tolist()
        raise ArgumentError(f"{name} of the task must be finite at a start, found {x[row, column].item()}")


def _row(name: str, x: Any, shape: tuple[int | None, ...], like: Tensor) -> Tensor:
    """Tensor that a function of a task returned, in the environments' dtype; None in a shape stands for any number."""
    x = floating(f"{name} of the task", x)
    if x.ndim != len(shape) or any(wanted not in (None, found) for wanted, found in zip(shape, x.shape, strict=True)):
        expected = ", ".join("k" if wanted is None else str(wanted) for wanted in shape)
        raise ArgumentError(f"{name} of the task must have the shape [{expected}], found {tuple(x.shape)}")
    return x.detach().to(like)
