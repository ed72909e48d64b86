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

from torchdq.backends.choice import BackendName
from torchdq.base.checks import (
    device_of,
    dtype_of,
    require_choice,
    require_count,
    require_object,
    require_tensor,
    tensor_of,
)
from torchdq.control.law import Law
from torchdq.effects import Effect
from torchdq.envs.actions import Actions, Kind, actuated_joints, full, kind_of, pose_of_actions, with_controller
from torchdq.envs.block import WORST
from torchdq.envs.pushes import Pushes
from torchdq.envs.randomization import Randomise, randomised, with_ranges
from torchdq.envs.reset import KEPT, NOISE, PUSHED, Reset, task_inputs
from torchdq.envs.rng import Streams, seeds_of
from torchdq.envs.rollout import Blocks, Rollout, rollout_of, stepped
from torchdq.envs.row_selection import Indexed, Masked, SomeRows, column
from torchdq.envs.task_names import task_of
from torchdq.envs.tasks import ROBOT, STATE, Checked, EpisodeTask
from torchdq.envs.torch_task import Functions, TorchTask
from torchdq.errors import ArgumentError, UnknownNameError
from torchdq.functions.posed import GEOMETRY
from torchdq.robot import Robot
from torchdq.robot.fields import SHAPES
from torchdq.robot.shipped import load
from torchdq.scene.defaults import default_effects, mean_robot
from torchdq.scene.integrators import Integrator, LinearlyImplicit
from torchdq.scene.loops import loops
from torchdq.scene.policies import Network
from torchdq.scene.scene import Scene
from torchdq.scene.state import State

_HELD = ("observation", "finished")  # buffers that callers may hold, and that are never written into
_RESTORED = (*STATE, *KEPT)  # buffers set back after a failed step


class RobotVectorEnv(VectorEnv):
    """Environments of one robot and one task, stepped by one program.

    Actions are in [-1, 1]^k, one number for each actuated joint, in the order of `actuated`. Others are clipped, and
    `info["clipped"]` counts them per row. Rows are independent: row i of a batch that was seeded with s is, bit for
    bit, the single environment seeded with s + i.

    A row whose numbers have left the finite range terminates alone: its observation is the last finite one, its reward
    -1000, worse than any episode, and `info["nonfinite"]` is true; the other entries of `info` are NaN then.

    Args:
        num_envs: number of environments.
        task: "reach", "track", "walk" or "wipe", an object like those of `torchdq.envs.tasks`, or a
            `torchdq.envs.TorchTask`.
        robot: name of a shipped robot, path of a URDF file, or a robot, with a fixed or a floating base; it needs an
            end effector to reach. None: a Panda, or a Go2 to walk.
        effects: effects of the scene; None: those of the task, or `torchdq.scene.defaults.default_effects(robot)`.
        action: meaning of the actions. "reference": offsets of the positions that a controller follows, full ones as
            far as a joint moves in 0.2 s at its velocity limit. "target": offsets of the targets of `effects.Servo`,
            full ones 0.25 rad or m. "torque": fractions of the torque limits. "residual": fractions of a fifth of them,
            added to the torques of the controller. Controller and servo follow the reference of the task: in "track"
            the motion to track, in "reach" the position at the start of each step. There an offset tells a joint where
            to go from where it is, and without offsets the arm comes to rest. None: "target" if there is a servo, or
            "reference", or "torque" if some joints are passive or the base floats.
            "pose": displacements of the desired pose of the controller's frame in the axes of its error, a rotation
            vector and a displacement, full ones 0.5 rad and 0.1 m; `pose_action` turns absolute poses into them. The
            task's reference is not followed.
        controller: controller of residual, reference and pose actions; None: computed torque, or operational space of
            the tip in axes of the world, of the rigid bodies as described, which knows nothing of friction or of what
            is randomised; a floating base needs another one.
        scale: size of a full action [N m or N; rad or m for "reference", "target" and "pose"], one number or k, in the
            order of `actuated`, or of the controller's axes; None: as above.
        leash: for "pose", the farthest that the desired pose is from the measured one after a step [rad, m], so that it
            does not run ahead of an arm that is slower; displacements beyond it are lost. (0, 0): actions displace the
            measured pose.
        actuated: names or patterns of the joints that actions move, one column each in the order given, those of a
            pattern in the order of the robot; None: all. The others are passive: they get no torque, from actions or a
            controller, and `action` is "torque" or "target", where the servo's gains say how firmly they are held.
        integrator: None: `LinearlyImplicit()`, which friction and limits cannot make unstable.
        dt: duration of a step [s].
        substeps: steps of the integrator within it; None: 2, unless the task says otherwise.
        max_episode_steps: steps after which an episode is truncated; None: never.
        randomise: parameters drawn for every episode, such as {"mass": 0.1, "gravity": (0.9, 1.1), "payload": 2.0};
            fractions, ranges, distributions or `Absolute` ranges, see `torchdq.envs.randomization`.
        pushes: `torchdq.envs.Pushes` at random times by the names of the inputs of `effects.Push`.
        autoreset_mode: time at which finished rows are reset, as gymnasium defines it. SAME_STEP: at once, and
            `info["final_obs"]` [N, ...] and `info["final_info"]` hold what came before in the rows of the masks
            `info["_final_obs"]` and `info["_final_info"]`. NEXT_STEP: at the next step, which ignores their action:
            its reward is 0, and `info` has the rows of the task at the start, and otherwise 0.
            DISABLED: when `reset(options={"reset_mask": mask})` is called; stepping a finished row is an error.
        dtype: float32 or float64, torch's, numpy's or by name.
        device: device of the environments. On a GPU the host does not wait for flags: instead of an error, a row fails
            whose action is not finite, or that has finished and was not reset; `info["final_obs"]` is always there.
        output: "torch" or "numpy": type of everything that `reset` and `step` return.
        render_mode: "rgb_array": `render` returns a frame of every environment; "human": every step shows the first
            one in a browser.
        backend: as in `torchdq.functional`.

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
        task: str | EpisodeTask | TorchTask = "reach",
        robot: str | Path | Robot | None = None,
        effects: Sequence[Effect] | None = None,
        action: Kind | None = None,
        controller: Law | None = None,
        scale: float | Sequence[float] | None = None,
        leash: tuple[float, float] = (0.5, 0.05),
        actuated: str | Sequence[str] | None = None,
        integrator: Integrator | None = None,
        dt: float = 0.02,
        substeps: int | None = None,
        max_episode_steps: int | None = 250,
        randomise: Randomise | None = None,
        pushes: Mapping[str, Pushes] | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP,
        dtype: torch.dtype | str = torch.float32,
        device: torch.device | str = "cpu",
        output: Literal["torch", "numpy"] = "torch",
        render_mode: Literal["rgb_array", "human"] | None = None,
        backend: BackendName | None = None,
    ) -> None:
        require_count("num_envs", num_envs)
        if max_episode_steps is not None:
            require_count("max_episode_steps", max_episode_steps)
        require_choice("output", output, ("torch", "numpy"))
        require_choice("render_mode", render_mode, (None, "rgb_array", "human"))
        self.num_envs, self.max_episode_steps, self.output = num_envs, max_episode_steps, output
        own = ROBOT if isinstance(task, TorchTask) else getattr(task_of(task), "ROBOT", ROBOT)
        self.robot = _robot_of(own if robot is None else robot)
        self.task = _described(task, self.robot)
        given = {"effects": effects, "scale": scale, "substeps": substeps, "randomise": randomise, "pushes": pushes}
        chosen = dict(self.task.defaults(mean_robot(self.robot))) if effects is None else {}
        chosen |= {name: x for name, x in given.items() if x is not None}
        joints = actuated_joints(self.robot, actuated)
        self.dtype, self.device = dtype_of("dtype", dtype), device_of("device", device)
        modes = AutoresetMode.__members__
        self.autoreset_mode = modes[autoreset_mode] if autoreset_mode in modes else AutoresetMode(autoreset_mode)  # type: ignore[index]
        self.render_mode = render_mode
        like = torch.empty(0, dtype=self.dtype, device=self.device)
        scene = Scene(
            self.robot,
            chosen["effects"] if "effects" in chosen else default_effects(self.robot),
            integrator=integrator or LinearlyImplicit(),
            dt=dt,
            substeps=chosen.get("substeps", 2),
            backend=backend,
        )
        self.robot = _within_limits(scene)
        scene = scene.replace(robot=self.robot)
        kind = kind_of(action, self.robot, joints, scene.effects)
        self.metadata = {
            "autoreset_mode": self.autoreset_mode,
            "render_modes": ["rgb_array", "human"],
            "render_fps": max(1, round(1 / dt)),
        }
        scene = with_controller(scene, kind, controller)
        pose = pose_of_actions(scene.controller, leash)
        pushed: Mapping[str, Pushes] = chosen.get("pushes", {})
        _check_scene(scene, num_envs, pushed)
        drawn = chosen.get("randomise", {})
        self._nominal, self._scene, drawn = randomised(scene.to(self.device), drawn, num_envs, like)
        if kind == kind_of(None, self.robot, joints, scene.effects):
            scale = chosen.get("scale")  # of the actions that the task is made for
        size = torch.as_tensor(full(self.robot, kind, scale, joints, pose)).to(like)
        self._actions = Actions(kind, self.robot, joints, size, pose)
        self._reset = Reset(self._scene, Checked(self.task, pose), drawn, pushed, self._functions(task))
        self.single_observation_space = self._observed(task)
        self.single_action_space = Box(-1.0, 1.0, (len(self._actions.names),), np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        # single numbers as tensors, since torch takes 2 us to make one
        self._valid = like.new_ones(())
        self._one = torch.tensor(1, dtype=torch.int32, device=self.device)
        self._buffers: dict[str, Tensor] = {}  # all that steps change, a row per environment; empty before a reset
        self._unreset = False  # True if a row has finished, or may have, and was not reset
        self._looks = self.device.type == "cpu"  # whether the host looks at flags; at those of a GPU it would wait
        self._painter: Any = None
        self._blocks: Blocks | None = None

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
        mask = torch.ones(self.num_envs, dtype=torch.bool, device=self.device)
        if options and options["reset_mask"] is not None:
            mask = torch.as_tensor(options["reset_mask"], device=self.device)
            if mask.dtype != torch.bool or mask.shape != (self.num_envs,):
                raise ArgumentError(
                    f"reset_mask must be a bool of shape ({self.num_envs},), found {mask.dtype} of {tuple(mask.shape)}"
                )
            if not self._buffers:
                raise ResetNeeded("a first reset must be of all environments; call reset() without a reset_mask")
        buffers = dict(self._buffers) or self._blank()
        if seed is not None:
            seeds = seeds_of(seed.tolist() if isinstance(seed, Tensor | np.ndarray) else seed, self.num_envs)
            if isinstance(seed, Integral):
                super().reset(seed=int(seed))
            given = mask & torch.tensor([s is not None for s in seeds], device=self.device)
            fresh = self._reset.streams([s or 0 for s in seeds], self.num_envs, self.device)
            buffers |= Streams.of(buffers).with_rows(Masked(given), fresh)._asdict()
        buffers, _ = self._begun(buffers, self._some(mask))
        self._keep(buffers)
        self._unreset = self._any(buffers["finished"])
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
        finished, counter = self._buffers["finished"], self._buffers["counter"]
        unreset = self._unreset and self.autoreset_mode == AutoresetMode.DISABLED
        if unreset and self._looks and bool(finished.any()):
            raise ResetNeeded(
                f"environments {finished.nonzero().squeeze(1).tolist()[:8]} have finished; reset them with "
                f"options={{'reset_mask': terminated | truncated}}, or choose another autoreset_mode"
            )
        actions, clipped = self._actions.clipped(actions, self.num_envs, self._looks)
        rows, buffers = self._advanced(actions)
        reward, failed = rows.pop("reward"), rows.pop("valid") != self._valid
        terminated = failed = failed | finished if unreset else failed
        if "terminated" in rows:
            terminated = failed | (rows.pop("terminated") != 0)
        limit = self.max_episode_steps
        truncated = torch.zeros_like(failed) if limit is None else buffers["steps"] >= limit
        buffers["finished"] = done = terminated | truncated
        info: dict[str, Any] = {"clipped": clipped, "nonfinite": failed, **rows}
        any_done = self._any(done)
        if any_done and self._any(failed):
            for name in _RESTORED:
                if name in buffers:
                    buffers[name] = torch.where(failed[:, None], self._buffers[name], buffers[name])
            reward = reward.masked_fill(failed, WORST)
            info |= {name: x.masked_fill(column(failed, x), torch.nan) for name, x in rows.items()}
        last = buffers["observation"]
        if self._unreset and self.autoreset_mode == AutoresetMode.NEXT_STEP:
            # this step is the reset of the rows that had finished
            buffers["counter"] = torch.where(finished[:, None], counter, buffers["counter"])
            buffers, seen = self._begun(buffers, begun := self._some(finished))
            going = ~finished
            reward, terminated, truncated = reward.masked_fill(finished, 0.0), terminated & going, truncated & going
            info = {name: x.masked_fill(column(finished, x), 0) for name, x in info.items()}
            info |= {name: begun.replaced(info[name], seen[name]) for name in info.keys() & seen.keys()}
            any_done = self._any(buffers["finished"])
        elif any_done and self.autoreset_mode == AutoresetMode.SAME_STEP:
            info.update(final_obs=last, _final_obs=done, final_info=dict(info), _final_info=done)
            buffers, _ = self._begun(buffers, self._some(done))
            any_done = False
        self._keep(buffers)
        self._unreset = any_done
        if self.render_mode == "human":
            self._frames()
        return buffers["observation"], reward, terminated, truncated, info

    @torch.no_grad()
    def rollout(
        self, policy: Callable[[Tensor], Tensor], steps: int, noise: Tensor | None = None, unit: float = 1.0
    ) -> Rollout:
        """Results of a number of steps with the actions unit (policy(observation) + noise).

        They are those of `step` with these actions, to the bit. Where the policy is a `torch.nn.Sequential` of the
        layers of `torchdq.scene.policies.Network`, all steps are one call of one compiled program, with the resets
        within it; it has other rounding errors than torch. Steps are taken one by one with any other policy, with
        functions of tensors (a `TorchTask`), another `autoreset_mode` than SAME_STEP, an integrator that is not
        recorded, the backend "eager" and on a GPU.

        Args:
            policy: function or module that returns actions [N, k] of observations [N, ...].
            steps: number of steps.
            noise: [steps, N, k], added to what the policy returns; None: none.
            unit: an output of the policy, as an action.

        >>> import torch
        >>> envs = RobotVectorEnv(64, "reach", "panda")
        >>> _ = envs.reset(seed=0)
        >>> policy = torch.nn.Sequential(torch.nn.Linear(27, 32), torch.nn.ELU(), torch.nn.Linear(32, 7))
        >>> found = envs.rollout(policy, 25, noise=0.1 * torch.randn(25, 64, 7))
        >>> found.observations.shape, found.rewards.shape
        (torch.Size([26, 64, 27]), torch.Size([25, 64]))
        """
        self._started("rollout")
        require_count("steps", steps)
        shape = (steps, self.num_envs, len(self._actions.names))
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
            if self._blocks is None:
                self._blocks = Blocks(self._reset, self._actions, self.max_episode_steps or math.inf)
            rows, buffers = self._blocks(self._buffers, network, steps, noise, unit)
            self._keep(buffers)
            found = rollout_of(rows)
        return found if self.output == "torch" else Rollout(*map(self._out, found))

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
        return self._out(self._actions.towards(X, self._buffers["reference"]))

    def _recorded(self, policy: Any) -> Network | None:
        """Policy that can be part of a program together with the steps; None: it cannot."""
        same = self.autoreset_mode == AutoresetMode.SAME_STEP and self.render_mode != "human"
        simple = same and self._looks and self._reset.functions is None and loops(self._scene, self._state)
        try:
            return Network(policy, ("observation",)) if simple and isinstance(policy, torch.nn.Sequential) else None
        except ArgumentError:  # other layers
            return None

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
        if self.render_mode == "human":
            self._painter.show(q[0], target[0], X_WB=X_WB[0])
            return None
        return tuple(self._painter.frame(q[i], target[i], X_WB=X_WB[i]) for i in range(self.num_envs))

    def set(
        self,
        *,
        task: str | EpisodeTask | TorchTask | None = None,
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
            described = _described(task, self.robot)
            if described != self.task or self._observed(task) != self.single_observation_space:
                own, other = type(self.task).__name__, type(described).__name__
                if own == other and is_dataclass(described):
                    names = [x.name for x in fields(described) if x.compare]
                    names = [x for x in names if getattr(described, x) != getattr(self.task, x)]
                    other = f"one with another {' and '.join(names) or 'observation'}"
                raise ArgumentError(
                    f"task must have the program and the observation of the {own} that is there, found {other}; change "
                    "its commands or functions of a TorchTask alone, or make other environments"
                )
            reset = replace(reset, checked=replace(reset.checked, task=described), functions=self._functions(task))
        if randomise is not None:
            reset = replace(reset, randomised=with_ranges(self._nominal, reset.randomised, randomise, self._valid))
        if pushes is not None:
            reset = replace(reset, pushes={**reset.pushes, **pushes})
            _check_scene(self._scene, self.num_envs, reset.pushes)
        self._reset, self._blocks, self.task = reset, None, reset.checked.task

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
        return State(**{name: x.clone() for name, x in self._state.rows().items()})

    @property
    def _state(self) -> State:
        """State that is in the buffers."""
        return State(**{name: self._buffers[name] for name in STATE if name in self._buffers})

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
        own = {self._saved(name): (name, x) for name, x in {**self._blank(), **self._reset.drawn}.items()}
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
        self._unreset = self._any(self._buffers["finished"]) and self.autoreset_mode != AutoresetMode.SAME_STEP

    def _saved(self, name: str) -> str:
        """Name of a buffer in a saved state; that of a memory says whose it is, so that no other effect takes it."""
        owners = ", ".join(type(effect).__name__ for effect in self._scene.effects if effect.memory(self._scene.n))
        return f"{name} of {owners}" if name == "memory" else name

    # --- internals ---

    def _open(self) -> None:
        if self.closed:
            raise ClosedEnvironmentError("the environment was closed; make another one")

    def _functions(self, task: str | EpisodeTask | TorchTask) -> Functions | None:
        """Functions of tensors of a task; None: it has none."""
        return Functions.of(task, self.robot, self._scene, self.device) if isinstance(task, TorchTask) else None

    def _observed(self, task: str | EpisodeTask | TorchTask) -> Box:
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

    def _advanced(self, actions: Tensor) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """The task's rows after a step, and the buffers."""
        buffers = dict(self._buffers)
        buffers["steps"] = buffers["steps"] + self._one
        given = task_inputs(self.task, buffers, self._scene, actions)
        given |= self._actions.inputs(actions, buffers["reference"])
        streams, noise = Streams.of(buffers), None
        for k, (name, pushes) in enumerate(self._reset.pushes.items(), PUSHED):
            time = self._buffers["steps"].to(self.dtype) * self._scene.dt
            given[name], buffers[name], after = pushes.at(time, buffers[name], streams.column(k), self._some)
            streams = streams.with_column(k, after)
        if self._scene.noises:
            noise, after = streams.column(NOISE).uniform(self._scene.noises, self.dtype)
            streams = streams.with_column(NOISE, after)
        buffers |= streams._asdict()
        state, rows = self._scene._advance(self._state, given, noise, self._reset.checked)
        if (functions := self._reset.functions) is not None:
            rows = functions.after(functions.now(state, buffers["goal"].clone(), buffers["steps"], rows, actions))
        buffers.update(state.rows(), **{name: rows.pop(name) for name in KEPT if name in buffers})
        return rows, buffers

    def _any(self, mask: Tensor) -> bool:
        """Whether a row of a mask [N] is true, or may be."""
        # `any` of one row takes a microsecond
        return not self._looks or bool(mask if self.num_envs == 1 else mask.any())

    def _some(self, mask: Tensor) -> SomeRows:
        """Rows of a mask [N]."""
        return Indexed(mask.nonzero().squeeze(1)) if self._looks else Masked(mask)

    def _begun(self, buffers: Mapping[str, Tensor], rows: SomeRows) -> tuple[dict[str, Tensor], Mapping[str, Tensor]]:
        """Buffers with new episodes in some rows, and the task's rows at their start."""
        found = dict(buffers)
        fresh, seen = self._reset(rows, Streams.of(buffers).rows(rows), self.dtype)
        held = _HELD if self._reset.functions is None else fresh  # functions see everything
        for name, x in fresh.items():
            if name in held or isinstance(rows, Masked):
                found[name] = rows.replaced(buffers[name], x)
            else:
                rows.write(buffers[name], x)
        return found, seen

    def _keep(self, buffers: dict[str, Tensor]) -> None:
        """Make them the buffers; on a GPU in memory that stays, so that a CUDA graph of a step can be repeated."""
        if self._looks:
            self._buffers = buffers
            return
        self._buffers = self._buffers or {name: torch.empty_like(x) for name, x in buffers.items()}
        for name, x in self._buffers.items():
            if buffers[name] is not x:
                x.copy_(buffers[name])

    def _blank(self) -> dict[str, Tensor]:
        """Buffers before a first episode."""
        width, seed = self.single_observation_space.shape[0], int(self.np_random.integers(2**62))  # type: ignore[index]
        return self._reset.blank(self.num_envs, width, seed, self.dtype, self.device)


def _robot_of(robot: str | Path | Robot) -> Robot:
    """Robot with one geometry: a shipped one by its name, one of a URDF file, or itself."""
    if isinstance(robot, str) and not robot.lstrip().startswith("<") and Path(robot).suffix == "":
        robot = load(robot)
    found = robot if isinstance(robot, Robot) else Robot.from_urdf(robot)
    one = {name: (getattr(found, name), len(SHAPES[name])) for name in (*GEOMETRY, "home")}
    one["limits"] = (max(found.limits, key=Tensor.dim), 1)
    for name, (x, axes) in one.items():
        if x is not None and x.ndim > axes:
            raise ArgumentError(
                f"{name} of robot {found.name!r} must be one for all environments, found batch axes; give one by "
                f"robot.replace({name}=...), or make environments for each robot"
            )
    return found


def _described(task: str | EpisodeTask | TorchTask, robot: Robot) -> EpisodeTask:
    """Recorded task for a robot."""
    return task_of(task.recorded_for(robot) if isinstance(task, TorchTask) else task).described(robot)


def _within_limits(scene: Scene) -> Robot:
    """The scene's robot with the limits that effects simulate, which may be narrower than those described."""
    limits = scene.robot.limits
    for low, high in [bounds for effect in scene.effects if (bounds := effect.free_range()) is not None]:
        lower, upper = (tensor_of(x).detach().to(limits.lower).reshape(-1, scene.n) for x in (low, high))
        limits = limits._replace(
            lower=torch.maximum(lower.amax(0), limits.lower), upper=torch.minimum(upper.amin(0), limits.upper)
        )
    same = all(map(torch.equal, limits, scene.robot.limits))
    return scene.robot if same else scene.robot.replace(limits=limits)


def _check_scene(scene: Scene, num_envs: int, pushes: Mapping[str, Pushes]) -> None:
    """Raise if an effect takes an input that is not supplied, if pushes have no effect, or a tensor has other rows."""
    wanted = {name: type(effect).__name__ for effect in scene.effects for name in effect.inputs(scene.n)}
    for name in wanted.keys() - {"target", *pushes}:
        cure = "give it by pushes, or leave it out" if wanted[name] == "Push" else "leave it out"
        raise ArgumentError(
            f"effects: {wanted[name]} takes the input {name!r}, which an environment does not supply; {cure}"
        )
    for name, one in pushes.items():
        if wanted.get(name) != "Push":
            raise UnknownNameError("input to push", name, [known for known, kind in wanted.items() if kind == "Push"])
        require_object(f"pushes[{name!r}]", one, Pushes, "torchdq.envs", "Pushes((20.0, 20.0, 0.0, 0.0, 0.0, 0.0))")
    for name, batch in scene.batches.items():
        if batch not in ((), (1,), (num_envs,)):
            raise ArgumentError(f"{name} must be one for all or have {num_envs} rows, found the batch axes {batch}")


def made_by_gymnasium(**arguments: Any) -> RobotVectorEnv:
    """Environments of `gymnasium.make_vec`: numpy, and finished rows reset at the next step, unless asked otherwise."""
    return RobotVectorEnv(**{"output": "numpy", "autoreset_mode": AutoresetMode.NEXT_STEP, **arguments})
