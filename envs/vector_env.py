"""Many arms at once as one gymnasium vector environment, tensors in and tensors out.

    envs = gymnasium.make_vec("torchdq/Reach-v0", num_envs=4096, robot="ur10e")
    observations, info = envs.reset(seed=0)
    observations, rewards, terminated, truncated, info = envs.step(actions)

Other libraries:

    TorchRL               torchrl.envs.GymWrapper(envs, convert_actions_to_numpy=False, device=envs.device)
    skrl                  skrl.envs.wrappers.torch.wrap_env(envs, wrapper="gymnasium")
    Stable-Baselines3     torchdq.envs.sb3.StableBaselinesVecEnv(envs)
    numpy                 ArmVectorEnv(..., output="numpy")
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import torch
from gymnasium.error import ClosedEnvironmentError, ResetNeeded
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from torch import Tensor

from torchdq.backends.choice import BackendName
from torchdq.effects import Effect
from torchdq.envs.actions import Actions, Kind, full
from torchdq.envs.controllers import ComputedTorque, Controller
from torchdq.envs.integrators import Integrator, LinearlyImplicit
from torchdq.envs.randomization import nominal, usual, varied
from torchdq.envs.reset import Beginning, asked
from torchdq.envs.rng import Streams, seeded
from torchdq.envs.scene import Scene, State
from torchdq.envs.tasks import EpisodeTask, Reach, Track, Watched
from torchdq.errors import ArgumentError, DtypeError, UnknownNameError
from torchdq.robot import Robot
from torchdq.robot.posed import GEOMETRY
from torchdq.robot.robot import DTYPES, SHAPES
from torchdq.robot.shipped import ROBOTS, load

TASKS: dict[str, EpisodeTask] = {"reach": Reach(), "track": Track()}
KP, KD = 100.0, 20.0  # of the controller that is there unless told [1/s^2, 1/s]
SHOWN = 4  # environments that are rendered
_GIVEN_AWAY = ("observation", "finished")  # tensors that callers may hold, and that are never written into
WORST = -1000.0  # reward of a step that failed, worse than any episode


class ArmVectorEnv(VectorEnv):
    """Environments of one robot and one task, stepped by one program.

    Actions are in [-1, 1]^n. What is outside is clipped, and `info["clipped"]` counts it per row. Rows do not know of
    each other: row i of a batch that was seeded with s is, bit for bit, the single environment seeded with s + i.

    A row whose numbers have left the finite range terminates alone: its observation is the last finite one, its reward
    -1000, worse than any episode, and `info["nonfinite"]` says so; what else is in `info` is not a number then.

    Args:
        num_envs: number of environments.
        task: "reach", "track", or an object like those of `torchdq.envs.tasks`.
        robot: name of a shipped robot, path of a URDF file, or a robot; it needs an end effector to reach.
        effects: what is simulated; None: `torchdq.envs.randomization.usual(robot)`.
        action: what actions are. "torque": fractions of the torque limits. "residual": fractions of a fifth of them, on
            top of a controller that follows the task's reference. "reference": offsets of the position that the
            controller is to follow, full ones as far as the joint gets in 0.2 s. The reference of "reach" is to stand
            still wherever the robot is: a residual pushes an arm that has no weight and comes to rest by itself, and
            an offset moves it on.
        controller: of residual and reference actions; None: computed torque of the rigid bodies as described, which
            knows nothing of friction or of what is randomised.
        scale: what a full action is [N m or N; rad or m for "reference"], one number or n; None: as above.
        integrator: None: `LinearlyImplicit()`, which friction and limits cannot make unstable.
        dt: duration of a step [s].
        substeps: of the integrator within it.
        max_episode_steps: after which an episode is truncated; None: never.
        randomise: what differs between episodes, such as {"mass": 0.1, "friction": 0.2, "payload": 2.0}; see
            `torchdq.envs.randomization.varied`.
        autoreset_mode: when finished rows begin anew, as gymnasium defines it. SAME_STEP: at once, and
            `info["final_obs"]` [N, ...] and `info["final_info"]` hold what came before in the rows of the masks
            `info["_final_obs"]` and `info["_final_info"]`. NEXT_STEP: at the next step, which ignores their action.
            DISABLED: when `reset(options={"reset_mask": mask})` is called; stepping a finished row is an error.
        dtype: float32 or float64, of everything.
        device: where the environments are.
        output: "torch" or "numpy", of everything that `reset` and `step` return.
        render_mode: "rgb_array": `render` returns frames of the first four environments; "human": every
            step shows the first one in a browser.
        backend: as in `torchdq.functional`.

    >>> import torch
    >>> envs = ArmVectorEnv(3, "reach", "panda")
    >>> observations, info = envs.reset(seed=0)
    >>> observations.shape
    torch.Size([3, 27])
    >>> _, rewards, terminated, truncated, info = envs.step(torch.zeros(3, 7))
    >>> rewards.shape, bool(terminated.any())
    (torch.Size([3]), False)
    """

    def __init__(
        self,
        num_envs: int = 1,
        task: str | EpisodeTask = "reach",
        robot: str | Path | Robot = "panda",
        effects: Sequence[Effect] | None = None,
        action: Kind = "torque",
        controller: Controller | None = None,
        scale: float | Sequence[float] | None = None,
        integrator: Integrator | None = None,
        dt: float = 0.02,
        substeps: int = 2,
        max_episode_steps: int | None = 250,
        randomise: Mapping[str, float] | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str = "cpu",
        output: Literal["torch", "numpy"] = "torch",
        render_mode: Literal["rgb_array", "human"] | None = None,
        backend: BackendName | None = None,
    ) -> None:
        if not isinstance(num_envs, int) or num_envs < 1:
            raise ArgumentError(f"num_envs must be a whole number from 1, found {num_envs!r}")
        if max_episode_steps is not None and (not isinstance(max_episode_steps, int) or max_episode_steps < 1):
            raise ArgumentError(f"max_episode_steps must be a whole number from 1 or None, found {max_episode_steps!r}")
        if dtype not in DTYPES:
            raise DtypeError(f"dtype must be torch.float32 or torch.float64, found {dtype}")
        _one_of("action", action, get_args(Kind))
        _one_of("output", output, ("torch", "numpy"))
        _one_of("render_mode", render_mode, (None, "rgb_array", "human"))
        if isinstance(task, str) and task not in TASKS:
            raise UnknownNameError("task", task, TASKS)
        if not isinstance(task, str) and not callable(getattr(task, "start", None)):
            raise ArgumentError(f"task must be the name of one or like those of torchdq.envs.tasks, found {task!r}")
        modes = {mode for member in AutoresetMode for mode in (member, member.value)}
        if autoreset_mode not in modes:
            raise ArgumentError(f"autoreset_mode must be one of {[*AutoresetMode]}, found {autoreset_mode!r}")
        self.num_envs, self.max_episode_steps, self.output = num_envs, max_episode_steps, output
        self.task = TASKS[task] if isinstance(task, str) else task
        self.robot = _robot(robot)
        self.dtype, self.device = dtype, torch.device(device)
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.render_mode = render_mode
        like = torch.empty(0, dtype=dtype, device=self.device)
        scene = Scene(
            self.robot,
            usual(self.robot) if effects is None else effects,
            integrator=integrator or LinearlyImplicit(),
            dt=dt,
            substeps=substeps,
            backend=backend,
        )
        self.metadata = {
            "autoreset_mode": self.autoreset_mode,
            "render_modes": ["rgb_array", "human"],
            "render_fps": max(1, round(1 / dt)),
        }
        if action != "torque":
            scene = scene.replace(controller=controller or ComputedTorque(KP, KD, nominal(scene)))
        elif controller is not None:
            raise ArgumentError("controller must be None for torque actions; did you mean action='residual'?")
        self.scene, self._varied = varied(scene, randomise or {}, num_envs, like)
        _fits(self.scene, num_envs)
        self._actions = Actions(action, self.robot, torch.as_tensor(full(self.robot, action, scale)).to(like))
        self._watched = Watched(self.task)
        self._beginning = Beginning(self.scene, self.task, self._watched, self._varied)
        low, high = np.array(self.task.bounds(self.robot), dtype=np.dtype(str(dtype).removeprefix("torch."))).T
        self.single_observation_space = Box(low, high, dtype=low.dtype.type)
        self.single_action_space = Box(-1.0, 1.0, (self.robot.n,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._now: dict[str, Tensor] = {}  # everything that changes, a row per environment; empty before a reset
        self._pending = False  # whether a row has finished and was not begun anew
        self._painter: Any = None

    # --- gymnasium ---

    @torch.no_grad()
    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Observations [N, ...] at the beginning of new episodes, and an empty `info`.

        Args:
            seed: of the random numbers; row i has those of seed + i. A sequence has one for every row. None: they go
                on, and if there are none yet, the seed is a surprise.
            options: {"reset_mask": mask}: a bool [N], numpy or torch; only those rows begin anew.
        """
        self._open()
        for name in options or {}:
            if name != "reset_mask":
                raise UnknownNameError("option of reset", name, ("reset_mask",))
        mask = self._mask((options or {}).get("reset_mask"))
        if mask is not None and not self._now:
            raise ResetNeeded("a first reset must be of all environments; call reset() without a reset_mask")
        rows = torch.arange(self.num_envs, device=self.device) if mask is None else mask.nonzero().squeeze(1)
        now = self._now or self._blank()
        streams = self._streams(now)
        if seed is not None:
            if isinstance(seed, Tensor | np.ndarray):
                seed = seed.tolist()
            if isinstance(seed, Sequence):
                seeds = list(seed)
            else:
                super().reset(seed=int(seed))
                seeds = [int(seed) + i for i in range(self.num_envs)]
            if len(seeds) != self.num_envs:
                raise ArgumentError(f"seed must be one number or {self.num_envs}, found {len(seeds)}")
            chosen = {i: s for i in rows.tolist() if (s := seeds[i]) is not None}
            fresh = seeded(list(chosen.values()), len(chosen), self.device)
            streams = streams.with_rows(torch.tensor(list(chosen), dtype=torch.int64, device=self.device), fresh)
        self._now = {**now, **streams._asdict()}
        self._begin(rows)
        self._pending = bool(self._now["finished"].any())
        self._show()
        return self._out(self._now["observation"]), {}

    @torch.no_grad()
    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Observations [N, ...], rewards [N], terminated [N], truncated [N] and `info` after `dt`.

        Args:
            actions: [N, n] in [-1, 1], numpy or torch.
        """
        self._open()
        if not self._now:
            raise ResetNeeded("call reset() before step()")
        finished, counter = self._now["finished"], self._now["counter"]
        if self._pending and self.autoreset_mode == AutoresetMode.DISABLED:
            raise ResetNeeded(
                f"environments {finished.nonzero().squeeze(1).tolist()[:8]} have finished; reset them with "
                f"options={{'reset_mask': terminated | truncated}}, or choose another autoreset_mode"
            )
        actions, clipped = self._actions.clipped(actions, self.num_envs)
        rows, now = self._advanced(actions)
        reward, lost = rows.pop("reward").squeeze(1), rows.pop("sound").squeeze(1) != 1
        terminated = lost
        if "terminated" in rows:
            terminated = lost | (rows.pop("terminated").squeeze(1) != 0)
        steps = now["steps"]
        limit = self.max_episode_steps
        truncated = torch.zeros_like(lost) if limit is None else steps >= limit
        now["finished"] = done = terminated | truncated
        info: dict[str, Any] = {"clipped": clipped, "nonfinite": lost, **{k: x.squeeze(1) for k, x in rows.items()}}
        any_done = bool(done.any())
        if any_done and bool(lost.any()):
            now = self._without(lost, now)
            reward = reward.masked_fill(lost, WORST)
            for name in rows:
                info[name][lost] = torch.nan
        self._now = now
        if self._pending:  # in the mode NEXT_STEP, this step was the reset of what had finished
            now["counter"] = torch.where(finished, counter, now["counter"])
            self._begin(finished.nonzero().squeeze(1))
            going = ~finished
            reward, terminated, truncated = reward.masked_fill(finished, 0.0), terminated & going, truncated & going
            info["nonfinite"] = lost & going
            any_done = bool(self._now["finished"].any())
        if any_done and self.autoreset_mode == AutoresetMode.SAME_STEP:
            info.update(final_obs=now["observation"], _final_obs=done, final_info=dict(info), _final_info=done)
            self._begin(done.nonzero().squeeze(1))
            any_done = False
        self._pending = any_done
        self._show()
        observation = self._now["observation"]
        if self.output == "torch":
            return observation, reward, terminated, truncated, info
        return tuple(self._out(x) for x in (observation, reward, terminated, truncated, info))

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Frames [H, W, 3] uint8 of the first four environments, or None in the mode "human"."""
        self._open()
        if self.render_mode is None:
            raise ArgumentError("render_mode must be 'rgb_array' or 'human' to render; it is chosen at construction")
        if not self._now:
            raise ResetNeeded("call reset() before render()")
        return self._shown()

    def close_extras(self, **kwargs: Any) -> None:
        """Close the view, if there is one."""
        if self._painter is not None and self.render_mode == "human":
            self._painter.close()
        self._painter = None

    def _show(self) -> None:
        if self.render_mode == "human":
            self._shown()

    def _shown(self) -> tuple[np.ndarray, ...] | None:
        from torchdq.envs.render import Painter, Viewer

        if self._painter is None:
            self._painter = Painter(self.robot) if self.render_mode == "rgb_array" else Viewer(self.robot)
        q, goal = self._now["q"].cpu(), self._now["goal"].cpu()
        target = goal if goal.shape[1] == 3 else [None] * len(q)  # three numbers are a point
        if self.render_mode == "human":
            self._painter.show(q[0], target[0])
            return None
        return tuple(self._painter.frame(q[i], target[i]) for i in range(min(SHOWN, self.num_envs)))

    # --- saving ---

    def get_state(self) -> dict[str, Tensor]:
        """Everything that steps change: states, goals, random numbers, parameters. `set_state` goes on from there."""
        self._open()
        if not self._now:
            raise ResetNeeded("call reset() before get_state()")
        return {name: x.clone() for name, x in (*self._now.items(), *self._parameters().items())}

    def set_state(self, state: Mapping[str, Tensor]) -> None:
        """Go on from a state of an environment that was constructed alike.

        Args:
            state: from `get_state`, or from `torch.load` of such.
        """
        self._open()
        own = {**self._blank(), **self._parameters()}
        if set(state) != set(own):
            raise ArgumentError(f"state must have the entries {sorted(own)}, found {sorted(state)}")
        for name, x in state.items():
            if x.shape != own[name].shape or x.dtype != own[name].dtype:
                raise ArgumentError(
                    f"state[{name!r}] must be {own[name].dtype} of shape {tuple(own[name].shape)}, found {x.dtype} of "
                    f"shape {tuple(x.shape)}; was it saved by an environment with other arguments?"
                )
        for name, x in self._parameters().items():
            x.copy_(state[name])
        self._now = {name: x.to(self.device, copy=True) for name, x in state.items() if "." not in name}
        self._pending = bool(self._now["finished"].any()) and self.autoreset_mode != AutoresetMode.SAME_STEP

    def _parameters(self) -> dict[str, Tensor]:
        """The scene's own tensors that are drawn anew for every episode."""
        return {f"{v.effect}.{name}": x for v in self._varied for name, x in v.tensors(self.scene).items()}

    # --- how ---

    def _open(self) -> None:
        if self.closed:
            raise ClosedEnvironmentError("the environment was closed; make another one")

    def _out(self, x: Any) -> Any:
        """Tensors as the caller wants them."""
        if self.output == "torch":
            return x
        return {k: self._out(v) for k, v in x.items()} if isinstance(x, dict) else x.cpu().numpy()

    def _mask(self, mask: Any) -> Tensor | None:
        if mask is None:
            return None
        mask = torch.as_tensor(mask, device=self.device)
        if mask.dtype != torch.bool or mask.shape != (self.num_envs,):
            raise ArgumentError(
                f"reset_mask must be a bool of shape ({self.num_envs},), found {mask.dtype} of {tuple(mask.shape)}"
            )
        if not bool(mask.any()):
            raise ArgumentError("reset_mask must be true in at least one row, found none; do not call reset then")
        return mask

    def _advanced(self, actions: Tensor) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """What the task says of a step, and what is then."""
        now = dict(self._now)
        now["steps"] = now["steps"] + 1
        given = asked(self.task, now, self.scene, actions) | self._actions.inputs(actions, now["reference"])
        noise = None
        if self.scene.noises:
            noise, (now["key"], now["counter"]) = self._streams(now).uniform(self.scene.noises, self.dtype)
        state, rows = self.scene.advance(self._state(now), given, noise, self._watched)
        return rows, self._after(now, state, rows)

    def _begin(self, rows: Tensor) -> None:
        """Begin new episodes in some rows, which are given by their numbers [k]."""
        now = dict(self._now)
        fresh = self._beginning(rows, self._streams(now).rows(rows), self.dtype)
        for name, x in fresh.items():
            if name in _GIVEN_AWAY:
                now[name] = now[name].index_copy(0, rows, x)
            else:
                now[name].index_copy_(0, rows, x)
        self._now = now

    def _blank(self) -> dict[str, Tensor]:
        """Everything that changes, before a first episode."""
        N, n = self.num_envs, self.robot.n
        widths = {"q": n, "qd": n, "goal": self.task.inputs(n)["goal"], "reference": 3 * n}
        widths["observation"] = self.single_observation_space.shape[0]  # type: ignore[index]
        memory = sum(effect.memory(n) for effect in self.scene.effects)
        widths.update({"memory": memory} if memory else {})
        widths.update({"reading": 2 * n} if self.scene.blueprint.of_slot("sensor") else {})
        now = {name: torch.zeros(N, width, dtype=self.dtype, device=self.device) for name, width in widths.items()}
        now["steps"] = torch.zeros(N, dtype=torch.int32, device=self.device)
        now["finished"] = torch.zeros(N, dtype=torch.bool, device=self.device)
        seed = int(self.np_random.integers(2**62))
        return {**now, **seeded(seed, N, self.device)._asdict()}

    def _streams(self, now: Mapping[str, Tensor]) -> Streams:
        return Streams(now["key"], now["counter"])

    def _state(self, now: Mapping[str, Tensor]) -> State:
        return State(now["q"], now["qd"], now.get("memory"), now.get("reading"))

    def _after(self, now: dict[str, Tensor], state: State, rows: dict[str, Tensor]) -> dict[str, Tensor]:
        """What is, with a new state and what the task says of it."""
        now.update({name: x for name, x in state._asdict().items() if x is not None})
        now.update(observation=rows.pop("observation"), reference=rows.pop("reference"))
        return now

    def _without(self, lost: Tensor, now: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """What is, but in the rows that were lost what was last."""
        kept = ("q", "qd", "memory", "reading", "observation", "reference")
        return {name: torch.where(lost[:, None], self._now[name], x) if name in kept else x for name, x in now.items()}


def _robot(robot: str | Path | Robot) -> Robot:
    if isinstance(robot, str) and robot in ROBOTS:
        robot = load(robot)
    elif isinstance(robot, str) and not robot.lstrip().startswith("<") and Path(robot).suffix == "":
        raise UnknownNameError("shipped robot", robot, ROBOTS)
    found = robot if isinstance(robot, Robot) else Robot.from_urdf(robot)
    for name in (*GEOMETRY, "home"):
        x = getattr(found, name)
        if x is not None and x.ndim > len(SHAPES[name]):
            raise ArgumentError(f"{name} of robot {found.name!r} has batch axes; environments need one geometry")
    return found


def _fits(scene: Scene, num_envs: int) -> None:
    """Raise if an effect asks for what an environment does not give, or has rows of another number."""
    for effect in scene.effects:
        for name in effect.inputs(scene.n):
            raise ArgumentError(
                f"effects must not hold {type(effect).__name__}, whose input {name!r} an environment has nobody to give"
            )
        for name, x in effect.tensors().items():
            batch = tuple(x.shape[: x.ndim - len(effect.SHAPES[name])])
            if batch not in ((), (1,), (num_envs,)):
                raise ArgumentError(
                    f"{name} of {type(effect).__name__} must be one for all or have {num_envs} rows, found the batch "
                    f"axes {batch}"
                )


def _one_of(name: str, value: Any, known: Sequence[Any]) -> None:
    if value not in known:
        raise ArgumentError(f"{name} must be one of {', '.join(map(repr, known))}, found {value!r}")
