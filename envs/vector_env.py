"""Many robots at once as one gymnasium vector environment.

    envs = RobotVectorEnv(4096, "reach", "ur10e")  # tensors in, tensors out
    envs = gymnasium.make_vec("torchdq/Reach-v0", num_envs=4096, robot="ur10e")  # numpy, as gymnasium's wrappers ask
    observations, info = envs.reset(seed=0)
    observations, rewards, terminated, truncated, info = envs.step(actions)

Other libraries take an `RobotVectorEnv`:

    TorchRL               torchrl.envs.GymWrapper(envs, convert_actions_to_numpy=False, device=envs.device)
    skrl                  skrl.envs.wrappers.torch.wrap_env(envs, wrapper="gymnasium")
    Stable-Baselines3     torchdq.envs.sb3.StableBaselinesVecEnv(envs)
    numpy                 RobotVectorEnv(..., output="numpy")
    gymnasium's wrappers  gymnasium.make_vec, or RobotVectorEnv(..., output="numpy", autoreset_mode="NextStep")
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from numbers import Integral
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from gymnasium.error import ClosedEnvironmentError, ResetNeeded
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from torch import Tensor

from torchdq.base.checks import device_of, dtype_of, require_choice, require_count, require_tensor, tensor_in
from torchdq.dq.formulas import computed
from torchdq.effects import Effect
from torchdq.envs.actions import Actions, Kind
from torchdq.envs.pushes import Pushes
from torchdq.envs.randomization import Randomise, with_ranges
from torchdq.envs.reset import SPARE, Reset
from torchdq.envs.rng import Streams, seeds_of
from torchdq.envs.rollout import Rollout, Steps, state_of, stepped
from torchdq.envs.row_selection import Host, Masked, SomeRows, column
from torchdq.envs.setup import AnyTask, Simulation, check_scene, described, functions_of, setup
from torchdq.envs.torch_task import TorchTask
from torchdq.errors import ArgumentError, UnknownNameError
from torchdq.robot import Robot
from torchdq.scene.free_base import POSE
from torchdq.scene.loops import loops
from torchdq.scene.policies import Network
from torchdq.scene.scene import Scene
from torchdq.scene.state import State

_KEPT = ("observation", "finished")  # buffers that callers may hold, and that are never written into


class RobotVectorEnv(VectorEnv):
    """Environments of one robot and one task, stepped by one program.

    An action has one number in [-1, 1] for each actuated joint. Numbers outside are clipped, and `info["clipped"]`
    counts them for each row. Rows are independent: row i of a batch that was seeded with s is, bit for bit, the single
    environment seeded with s + i.

    If the simulation of a row fails, because its state is not finite or far too large, that row alone terminates. Its
    reward is -1000, its last observation is the last finite one, `info["nonfinite"]` is true, and its other entries of
    `info` are NaN.

    Args:
        num_envs: number of environments.
        task: "reach", "track", "walk", "wipe", "push", "lift" or "pick", an object like those of
            `torchdq.envs.tasks`, or a `torchdq.envs.TorchTask`.
        robot: name of a shipped robot, path of a URDF file, or a robot, with a fixed or a floating base; to reach, it
            needs an end effector. Its loops are closed at every start. None: a Panda, or a Go2 to walk.
        effects: effects of the scene; None: those of the task, or `torchdq.scene.defaults.default_effects(robot)`.
        action: what an action means, "reference", "target", "torque", "residual" or "pose", or an
            `torchdq.envs.Actions` with further settings; None: the default that `Actions` describes.
        simulation: time step, integrator and backend, `torchdq.envs.Simulation`; None: those of the task, or 0.02 s.
        max_episode_steps: steps after which an episode is truncated; None: never.
        randomise: parameters drawn for every episode, such as {"mass": 0.1, "gravity": (0.9, 1.1), "payload": 2.0};
            fractions, ranges, distributions or `Absolute` ranges, see `torchdq.envs.randomization`.
        pushes: `torchdq.envs.Pushes` at random times, by the input names of `effects.Push`.
        autoreset_mode: when finished rows are reset, as gymnasium defines it.
            SAME_STEP: at once. `info["final_obs"]` [N, ...] and `info["final_info"]` have the values before the reset
            in the rows of the masks `info["_final_obs"]` and `info["_final_info"]`.
            NEXT_STEP: at the next step, which ignores their actions. The reward is 0, and `info` has the rows of the
            task at the start, and 0 otherwise.
            DISABLED: by `reset(options={"reset_mask": mask})`; stepping a finished row is an error.
        dtype: float32 or float64, torch's, numpy's or by name.
        device: device of the environments. On a GPU the host never synchronises: where a CPU raises an error, because
            an action is not finite or a finished row was not reset, the row fails; `info["final_obs"]` is always there.
        output: "torch" or "numpy": type of everything that `reset` and `step` return.
        render_mode: "rgb_array": `render` returns a frame of every environment; "human": every step shows the first
            one in a browser.

    >>> import torch
    >>> envs = RobotVectorEnv(3, "reach", "panda")
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
        task: AnyTask = "reach",
        robot: str | Path | Robot | None = None,
        effects: Sequence[Effect] | None = None,
        action: Kind | Actions | None = None,
        simulation: Simulation | None = None,
        max_episode_steps: int | None = 250,
        randomise: Randomise | None = None,
        pushes: Mapping[str, Pushes] | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP,
        dtype: torch.dtype | str = torch.float32,
        device: torch.device | str = "cpu",
        output: Literal["torch", "numpy"] = "torch",
        render_mode: Literal["rgb_array", "human"] | None = None,
    ) -> None:
        require_count("num_envs", num_envs)
        if max_episode_steps is not None:
            require_count("max_episode_steps", max_episode_steps)
        require_choice("output", output, ("torch", "numpy"))
        require_choice("render_mode", render_mode, (None, "rgb_array", "human"))
        self.num_envs, self.max_episode_steps, self.output = num_envs, max_episode_steps, output
        self.dtype, self.device, self.render_mode = dtype_of("dtype", dtype), device_of("device", device), render_mode
        modes = AutoresetMode.__members__
        if not isinstance(autoreset_mode, AutoresetMode):
            require_choice("autoreset_mode", autoreset_mode, [*(mode.value for mode in AutoresetMode), *modes])
        self.autoreset_mode = modes[autoreset_mode] if autoreset_mode in modes else AutoresetMode(autoreset_mode)  # type: ignore[index]
        like = torch.empty(num_envs, 0, dtype=self.dtype, device=self.device)
        made = setup(task, robot, effects, action, simulation, randomise, pushes, like)
        self._nominal, self._meaning, self._scale = made.nominal, made.meaning, made.scale
        self._use(made.reset)
        self.robot, names = self._scene.robot, ("rgb_array", "human")
        rate = max(1, round(1 / self._scene.dt))
        self.metadata = {"autoreset_mode": self.autoreset_mode, "render_modes": [*names], "render_fps": rate}
        self.single_observation_space = self._observed(task)
        self.single_action_space = Box(-1.0, 1.0, (len(self._meaning.names),), np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._buffers: dict[str, Tensor] = {}  # all that steps change, a row per environment; empty before a reset
        self._unreset = False  # True if a row has finished, or may have, and was not reset
        self._host = Host(synchronises=self.device.type == "cpu")
        self._painter: Any = None

    # --- gymnasium ---

    @torch.no_grad()
    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Observations [N, ...] at the start of new episodes, and an empty `info`.

        Args:
            seed: seed of the random numbers; row i has the seed seed + i, so seeds closer than N share rows: test on
                a seed that is at least N away. A sequence has one for every row. None: the streams continue; before
                the first reset they are seeded at random.
            options: {"reset_mask": mask}: a bool [N], numpy or torch; only those rows are reset.
        """
        self._open()
        for name in options or {}:
            if name != "reset_mask":
                raise UnknownNameError("option of reset", name, ("reset_mask",))
        seeded = mask = self._every
        if options and options["reset_mask"] is not None:
            mask = torch.as_tensor(options["reset_mask"], device=self.device)
            if mask.dtype != torch.bool or mask.shape != (self.num_envs,):
                raise ArgumentError(
                    f"reset_mask must be a bool of shape ({self.num_envs},), found {mask.dtype} of {tuple(mask.shape)}"
                )
            if not self._buffers:
                raise ResetNeeded("a first reset must be of all environments; call reset() without a reset_mask")
        buffers = dict(self._buffers) or self._streams()
        if seed is not None:
            seeds = seeds_of(seed.tolist() if isinstance(seed, Tensor | np.ndarray) else seed, self.num_envs)
            if isinstance(seed, Integral):
                super().reset(seed=int(seed))
            given = mask & torch.tensor([s is not None for s in seeds], device=self.device)
            fresh = self._reset.streams([s or 0 for s in seeds], self.num_envs, self.device)
            buffers |= Streams.of(buffers).with_rows(Masked(given), fresh)._asdict()
            seeded = given if self._buffers else seeded
        if seed is not None or not self._buffers:
            buffers = self._with_spares(buffers, seeded)
        buffers, _ = self._begun(buffers, self._host.some(mask))
        self._keep(buffers)
        self._unreset = self._host.any(buffers["finished"])
        if self.render_mode == "human":
            self._frames()
        return self._out(buffers["observation"].clone()), {}

    @torch.no_grad()
    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Observations [N, ...], rewards [N], terminated [N], truncated [N] and `info` after `dt`.

        Args:
            actions: [N, k] in [-1, 1], numpy or torch.
        """
        observations, reward, terminated, truncated, info = self._stepped(actions)
        observations = observations.clone()  # a rollout begins from them
        found = observations, reward, terminated, truncated, info
        return found if self.output == "torch" else tuple(self._out(x) for x in found)

    def _stepped(self, actions: Any) -> tuple[Tensor, Tensor, Tensor, Tensor, dict[str, Any]]:
        """Results of a step, as tensors."""
        self._started("step")
        before, mode, host = self._buffers, self.autoreset_mode, self._host
        finished = before["finished"]
        waiting = finished if self._unreset and mode == AutoresetMode.DISABLED else None
        if waiting is not None and host.synchronises and bool(finished.any()):
            raise ResetNeeded(
                f"environments {finished.nonzero().squeeze(1).tolist()[:8]} have finished; reset them with "
                f"options={{'reset_mask': terminated | truncated}}, or choose another autoreset_mode"
            )
        actions = self._meaning.checked(actions, self.num_envs, before["observation"], host.synchronises)
        after, reward, terminated, truncated, done, ends, info = self._steps(before, actions, host, waiting)
        after["finished"], last = done, after["observation"]
        if self._unreset and mode == AutoresetMode.NEXT_STEP:  # this step is the reset of the rows that had finished
            drawn = ("counter", *(SPARE + push for push in self._reset.pushes))
            after |= {name: torch.where(column(finished, after[name]), before[name], after[name]) for name in drawn}
            after, seen = self._begun(after, begun := host.some(finished))
            going = ~finished
            reward, terminated, truncated = reward.masked_fill(finished, 0.0), terminated & going, truncated & going
            info = {name: x.masked_fill(column(finished, x), 0) for name, x in info.items()}
            info |= {name: begun.replaced(info[name], seen[name]) for name in info.keys() & seen.keys()}
        elif mode == AutoresetMode.SAME_STEP and ends:
            info.update(final_obs=last, _final_obs=done, final_info=dict(info), _final_info=done)
            after, _ = self._begun(after, host.some(done))
        self._keep(after)
        self._unreset = mode != AutoresetMode.SAME_STEP and host.any(after["finished"])
        if self.render_mode == "human":
            self._frames()
        return after["observation"], reward, terminated, truncated, info

    @torch.no_grad()
    def rollout(
        self, policy: Callable[[Tensor], Tensor], steps: int, noise: Tensor | None = None, unit: float = 1.0
    ) -> Rollout:
        """Results of a number of steps with the actions unit (policy(observation) + noise).

        They are bitwise those of `step` with these actions. If the policy is a `torch.nn.Sequential` of the layers
        of `torchdq.scene.policies.Network`, all steps are one call of one compiled program, with the resets within it;
        its rounding errors are not those of torch. Steps are taken one by one with any other policy, with functions of
        tensors (a `TorchTask`), an `autoreset_mode` other than SAME_STEP, an integrator that is not recorded, the
        backend "eager" and on a GPU.

        Args:
            policy: function or module that returns actions [N, k] of observations [N, ...].
            steps: number of steps.
            noise: [steps, N, k], added to what the policy returns; None: none.
            unit: an output of the policy, as an action.

        >>> import torch
        >>> envs = RobotVectorEnv(64, "reach", "panda")
        >>> _ = envs.reset(seed=0)
        >>> policy = torch.nn.Sequential(
        ...     torch.nn.Linear(27, 32), torch.nn.ELU(), torch.nn.Linear(32, 7)
        ... )
        >>> found = envs.rollout(policy, 25, noise=0.1 * torch.randn(25, 64, 7))
        >>> found.observations.shape, found.rewards.shape
        (torch.Size([26, 64, 27]), torch.Size([25, 64]))
        """
        self._started("rollout")
        require_count("steps", steps)
        shape = (steps, self.num_envs, len(self._meaning.names))
        if noise is not None:
            require_tensor("noise", noise)
            if noise.shape != shape:
                raise ArgumentError(f"noise must have the shape {shape}, found {tuple(noise.shape)}")
        if not callable(policy) or isinstance(policy, Network):
            kind = type(policy).__name__
            raise ArgumentError(f"policy must be a function of observations or a torch.nn.Sequential, found {kind}")
        network = self._recorded(policy)
        if network is None:
            found = stepped(self._stepped, self._buffers["observation"], policy, steps, noise, unit)
        else:
            found, buffers = self._steps.rollout(self._buffers, network, steps, noise, unit)
            self._keep(buffers)
        return found if self.output == "torch" else Rollout(*map(self._out, found))

    def _recorded(self, policy: Any) -> Network | None:
        """Policy that can be part of a program together with the steps; None: it cannot."""
        same = self.autoreset_mode == AutoresetMode.SAME_STEP and self.render_mode != "human"
        simple = same and self._host.synchronises and self._reset.functions is None
        if not (simple and isinstance(policy, torch.nn.Sequential) and loops(self._scene, state_of(self._buffers))):
            return None
        try:
            return Network(policy, ("observation",))
        except ArgumentError:  # other layers
            return None

    @torch.no_grad()
    def pose_action(self, X: Any) -> Any:
        """Actions [N, k] in [-1, 1] that move the desired poses to X, or by a full action towards it.

        Args:
            X: poses of the controller's frame in the base, of any norm, [N, 8] or [8]; where `action` is "pose".

        >>> import torch, torchdq
        >>> envs = RobotVectorEnv(2, "reach", "panda", action="pose")
        >>> _ = envs.reset(seed=0)
        >>> up = torchdq.dq.exp(torch.tensor([0.0, 0.0, 0.0, 0.0, 0.0, 0.01]))  # by 0.02 m
        >>> envs.pose_action(torchdq.dq.mul(up, envs.get_state()["reference"]))[:, 5]
        tensor([0.2000, 0.2000])
        """
        self._started("pose_action")
        pose, reference = self._meaning.pose, self._buffers["reference"]
        if pose is None:
            raise ArgumentError(f"pose_action needs an environment with action='pose', found {self._meaning.kind!r}")
        goal = torch.as_tensor(tensor_in(X)).to(reference)
        if goal.shape not in ((8,), reference.shape):
            raise ArgumentError(f"X must have the shape {tuple(reference.shape)} or (8,), found {tuple(goal.shape)}")
        return self._out(computed(pose.towards, x=reference, goal=goal, scale=self._scale))

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Frames [H, W, 3] uint8 of all environments, or None in the mode "human"."""
        self._open()
        if self.render_mode is None:
            raise ArgumentError("render_mode must be 'rgb_array' or 'human' to render; it is chosen at construction")
        self._started("render")
        return self._frames()

    def close_extras(self, **kwargs: Any) -> None:
        """Close the view, if there is one."""
        if self._painter is not None and self.render_mode == "human":
            self._painter.close()
        self._painter = None

    def _frames(self) -> tuple[np.ndarray, ...] | None:
        from torchdq.envs.render import Painter, Viewer

        if self._painter is None:
            kind = Painter if self.render_mode == "rgb_array" else Viewer
            self._painter = kind(self._scene)
        none, q, goal = [None] * self.num_envs, self._buffers["q"].cpu(), self._buffers["goal"].cpu()
        target = goal if goal.shape[1] == 3 and self.task.POINT else none
        X_WB = self._buffers["X_WB"].cpu() if self.robot.floating else none
        X_WO = self._buffers["poses"].cpu().unflatten(1, (-1, POSE)) if self._scene.objects else none
        if self.render_mode == "human":
            self._painter.show(q[0], target[0], X_WB=X_WB[0], X_WO=X_WO[0])
            return None
        return tuple(self._painter.frame(q[i], target[i], None, X_WB[i], X_WO[i]) for i in range(self.num_envs))

    def set(
        self,
        *,
        task: AnyTask | None = None,
        randomise: Randomise | None = None,
        pushes: Mapping[str, Pushes] | None = None,
    ) -> None:
        """Change what episodes are drawn from, as a curriculum does, without a new program.

        Functions of a `TorchTask` for reward, observation and end act from the next step, pushes from the next one on,
        and all else from the next episode of a row. `get_state` has none of it; a captured CUDA graph does not change.

        Args:
            task: the same task with other commands, which its `spans` reads, or functions of tensors; None: no change.
            randomise: ranges of parameters that these environments draw; those that are not named keep theirs.
            pushes: likewise.

        Raises:
            ArgumentError: it would need another program, such as one for a parameter that was not drawn before.

        >>> from torchdq.envs.walk import Walk
        >>> envs = RobotVectorEnv(64, Walk(forward=(0.0, 0.3)), "go2")
        >>> envs.set(task=Walk(forward=(0.0, 1.0)), randomise={"mass": 0.2})
        """
        self._open()
        reset = self._reset
        if task is not None:
            known = described(task, self.robot)
            if known != self.task or self._observed(task) != self.single_observation_space:
                own, other = type(self.task).__name__, type(known).__name__
                if own == other and is_dataclass(known):
                    names = [x.name for x in fields(known) if x.compare]
                    names = [x for x in names if getattr(known, x) != getattr(self.task, x)]
                    other = f"one with another {' and '.join(names) or 'observation'}"
                raise ArgumentError(
                    f"task must have the program and the observation of the {own} that is there, found {other}; change "
                    "its commands or functions of a TorchTask alone, or make other environments"
                )
            functions = functions_of(task, self.robot, self._scene, self.device)
            reset = replace(reset, checked=replace(reset.checked, task=known), functions=functions)
        if randomise is not None:
            reset = replace(reset, randomised=with_ranges(self._nominal, reset.randomised, randomise, self._scale))
        if pushes is not None:
            reset = replace(reset, pushes={**reset.pushes, **pushes})
            check_scene(self._scene, self.num_envs, reset.pushes)
        self._use(reset)
        if pushes is not None and self._buffers:
            self._keep(self._with_spares(self._buffers, self._every))

    # --- state ---

    @property
    def scene(self) -> Scene:
        """Copy of the scene, with the parameters that were drawn for the present episodes."""
        drawn = {name: x.clone() for name, x in self._reset.drawn.items()}
        return self._scene.with_parameters(drawn) if drawn else self._scene

    @property
    def state(self) -> State:
        """Copy of the state of the environments' scenes, of which `scene` tells more: `scene.contacts(state)`."""
        self._started("state")
        return State(**{name: x.clone() for name, x in state_of(self._buffers).rows().items()})

    def get_state(self) -> dict[str, Tensor]:
        """Copy of all that steps change: states, goals, random numbers, parameters; for `set_state`."""
        self._started("get_state")
        return {self._saved(name): x.clone() for name, x in {**self._buffers, **self._reset.drawn}.items()}

    def set_state(self, state: Mapping[str, Tensor]) -> None:
        """Continue from a state of an environment that was constructed alike.

        Args:
            state: from `get_state`, or from `torch.load` of such.
        """
        self._open()
        known = self._buffers or self._first()
        own = {self._saved(name): (name, x) for name, x in {**known, **self._reset.drawn}.items()}
        if not isinstance(state, Mapping) or set(state) != set(own):
            found = sorted(state) if isinstance(state, Mapping) else type(state).__name__
            raise ArgumentError(
                f"state must be a dict with the entries {sorted(own)}, found {found}; was it saved by an environment "
                "with other effects?"
            )
        rows: dict[str, Tensor] = {}
        for label, (name, like) in own.items():
            rows[name] = x = state[label]
            require_tensor(f"state[{label!r}]", x)
            if x.shape != like.shape or x.dtype != like.dtype:
                raise ArgumentError(
                    f"state[{label!r}] must be {like.dtype} of shape {tuple(like.shape)}, found {x.dtype} of shape "
                    f"{tuple(x.shape)}; was it saved by an environment with other arguments?"
                )
            wrong = x.isnan() if "." in name else ~x.isfinite()  # a parameter may be an infinite limit
            if len(bad := wrong.nonzero()):
                raise ArgumentError(
                    f"state[{label!r}] must be finite, found {x[tuple(bad[0])].item()} in row {bad[0, 0].item()}"
                )
        for name, x in self._reset.drawn.items():
            x.copy_(rows[name])
        self._keep({name: x.to(self.device, copy=True) for name, x in rows.items() if "." not in name})
        self._unreset = self._host.any(self._buffers["finished"]) and self.autoreset_mode != AutoresetMode.SAME_STEP

    def _saved(self, name: str) -> str:
        """Name of a buffer in a saved state; that of a memory says whose it is, so that no other effect takes it."""
        owners = ", ".join(type(effect).__name__ for effect in self._scene.effects if effect.memory(self._scene.n))
        return f"{name} of {owners}" if name == "memory" else name

    # --- internals ---

    def _use(self, reset: Reset) -> None:
        """Take this start of episodes, with its scene and its task."""
        self._reset, self._scene, self.task = reset, reset.scene, reset.checked.task
        self._steps = Steps(reset, self._meaning, self._scale, self.max_episode_steps or math.inf)

    def _open(self) -> None:
        if self.closed:
            raise ClosedEnvironmentError("the environment was closed; make another one")

    def _observed(self, task: AnyTask) -> Box:
        """Space of the observations of a task."""
        bounds = (task.bounds if isinstance(task, TorchTask) else None) or self.task.bounds(self.robot)
        low, high = np.array(bounds, dtype=np.dtype(str(self.dtype).removeprefix("torch."))).T
        return Box(low, high, dtype=low.dtype.type)

    def _started(self, method: str) -> None:
        self._open()
        if not self._buffers:
            raise ResetNeeded(f"call reset() before {method}()")

    def _out(self, x: Any) -> Any:
        """Tensors as the caller wants them."""
        if self.output == "torch":
            return x
        return {k: self._out(v) for k, v in x.items()} if isinstance(x, dict) else x.cpu().numpy()

    def _streams(self) -> dict[str, Tensor]:
        """Buffers before a first episode: streams of a random seed."""
        return self._reset.streams(int(self.np_random.integers(2**62)), self.num_envs, self.device)._asdict()

    @property
    def _every(self) -> Tensor:
        """Mask [N] of all environments."""
        return torch.ones(self.num_envs, dtype=torch.bool, device=self.device)

    def _first(self) -> dict[str, Tensor]:
        """Buffers of first episodes."""
        return self._begun(self._with_spares(self._streams(), self._every), self._host.some(self._every))[0]

    def _with_spares(self, buffers: Mapping[str, Tensor], mask: Tensor) -> dict[str, Tensor]:
        """Buffers with other pushes drawn ahead in the rows of a mask."""
        return self._reset.with_spares(buffers, [mask] * len(self._reset.pushes), self._host)

    def _begun(self, buffers: Mapping[str, Tensor], rows: SomeRows) -> tuple[dict[str, Tensor], Mapping[str, Tensor]]:
        """Buffers with new episodes in some rows, and the task's rows at their start."""
        found = dict(buffers)
        fresh, seen = self._reset(rows, Streams.of(buffers).rows(rows))
        held = _KEPT if self._reset.functions is None else fresh  # functions see everything
        for name, x in fresh.items():
            if name in held or name not in found or isinstance(rows, Masked):
                found[name] = rows.replaced(buffers.get(name, x), x)  # at first all of them are new
            else:
                rows.write(buffers[name], x)
        return found, seen

    def _keep(self, buffers: dict[str, Tensor]) -> None:
        """Make them the buffers; on a GPU in memory that stays, so that a CUDA graph of a step can be repeated."""
        if self._host.synchronises:
            self._buffers = buffers
            return
        self._buffers = self._buffers or {name: torch.empty_like(x) for name, x in buffers.items()}
        for name, x in self._buffers.items():
            if buffers[name] is not x:
                x.copy_(buffers[name])


def made_by_gymnasium(**arguments: Any) -> RobotVectorEnv:
    """Environments of `gymnasium.make_vec`: numpy, and finished rows reset at the next step, unless asked otherwise."""
    return RobotVectorEnv(**{"output": "numpy", "autoreset_mode": AutoresetMode.NEXT_STEP, **arguments})
