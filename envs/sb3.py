"""Vector environment of Stable-Baselines3; only this module needs that library."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from gymnasium.vector import AutoresetMode

from torchdq.base.optional import imported
from torchdq.envs.vector_env import RobotVectorEnv
from torchdq.errors import ArgumentError

__all__ = ["StableBaselinesVecEnv"]

VecEnv: Any = imported(
    "stable_baselines3.common.vec_env", "stable-baselines3", "StableBaselinesVecEnv", "'torchdq[rl]'"
).VecEnv


class StableBaselinesVecEnv(VecEnv):
    """A vector environment of Stable-Baselines3, numpy in and out.

    model = stable_baselines3.PPO("MlpPolicy", StableBaselinesVecEnv(RobotVectorEnv(256, "reach")))

    The info of an environment has its row of everything in `info`. At the end of an episode it also has "is_success",
    whether a row or term named "success" is above zero, if the task has one: Stable-Baselines3 logs its mean as
    `rollout/success_rate`.

    Args:
        envs: in the mode SAME_STEP.
    """

    def __init__(self, envs: RobotVectorEnv) -> None:
        if envs.autoreset_mode != AutoresetMode.SAME_STEP:
            raise ArgumentError(f"envs must have the autoreset_mode SAME_STEP, found {envs.autoreset_mode}")
        self.envs = envs
        self.render_mode = envs.render_mode
        super().__init__(envs.num_envs, envs.single_observation_space, envs.single_action_space)

    def reset(self) -> np.ndarray:
        """Observations [N, ...] at the start of new episodes, with the seed passed to `seed`."""
        seed = self._seeds[0]  # row i has seed + i, as theirs have
        observations, _ = self.envs.reset(seed=seed)
        self._reset_seeds()
        self._reset_options()
        return _array(observations)

    def step_async(self, actions: np.ndarray) -> None:
        """Keep the actions until `step_wait`."""
        self._actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Observations, rewards, whether episodes are done, and an info for each environment."""
        observations, rewards, terminated, truncated, info = self.envs.step(self._actions)
        terminated, done = _array(terminated), _array(terminated) | _array(truncated)
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for name in info.keys() - {"final_obs", "_final_obs", "final_info", "_final_info"}:
            column = _array(info[name])
            for row, x in zip(infos, column.tolist() if column.ndim == 1 else column, strict=True):
                row[name] = x
        if done.any():
            last = _array(info["final_obs"])
            for i in done.nonzero()[0]:
                infos[i] |= {"terminal_observation": last[i], "TimeLimit.truncated": not terminated[i]}
                if "success" in infos[i]:
                    infos[i]["is_success"] = infos[i]["success"] > 0  # NaN where the simulation has failed
        return _array(observations), _array(rewards), done, infos

    def close(self) -> None:
        """Close the environments."""
        self.envs.close()

    def get_images(self) -> Sequence[np.ndarray | None]:
        """Frames of the first environments."""
        return self.envs.render() or ()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """An attribute, which all environments share, once for each."""
        return [getattr(self.envs, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Not supported: environments of a batch share their attributes."""
        raise NotImplementedError("environments of a batch share their attributes; change them in `envs`")

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        """Not supported: environments of a batch have no methods of their own."""
        raise NotImplementedError("environments of a batch have no methods of their own; call those of `envs`")

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        """False for each environment."""
        return [False for _ in self._get_indices(indices)]


def _array(x: Any) -> np.ndarray:
    return x.cpu().numpy() if isinstance(x, torch.Tensor) else x
