"""One robot as a gymnasium environment: a view, in numpy, of a vector environment of one."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from torch import Tensor

from torchdq.envs.rng import seeds_of
from torchdq.envs.vector_env import RobotVectorEnv
from torchdq.errors import ArgumentError, UnknownNameError

_METADATA: dict[str, Any] = {"render_modes": ["rgb_array", "human"], "render_fps": 50}


class RobotEnv(gymnasium.Env):
    """One environment, bit for bit the row of an `RobotVectorEnv` with the same seed.

    Args:
        max_episode_steps: steps after which an episode is truncated; None: never, since `gymnasium.make` does it.
        render_mode: as in `RobotVectorEnv`; `render` returns one frame.
        arguments: arguments of `RobotVectorEnv`, except `num_envs`, `autoreset_mode` and `output`.

    >>> from torchdq.envs import RobotEnv
    >>> observation, info = RobotEnv(task="reach", robot="panda").reset(seed=0)
    >>> observation.shape
    (27,)
    """

    metadata = _METADATA

    def __init__(
        self, *, max_episode_steps: int | None = None, render_mode: str | None = None, **arguments: Any
    ) -> None:
        for name in ("num_envs", "autoreset_mode", "output"):
            if name in arguments:
                raise ArgumentError(f"{name} is not an argument of a single environment; use RobotVectorEnv")
        self.envs = RobotVectorEnv(
            num_envs=1,
            max_episode_steps=max_episode_steps,
            render_mode=render_mode,  # type: ignore[arg-type]
            autoreset_mode=AutoresetMode.DISABLED,
            **arguments,
        )
        self.observation_space = self.envs.single_observation_space
        self.action_space = self.envs.single_action_space
        self.render_mode = render_mode
        self.metadata = {**_METADATA, "render_fps": self.envs.metadata["render_fps"]}

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Observation at the start of a new episode, and an empty `info`; there are no options."""
        for name in options or {}:
            raise UnknownNameError("option of reset of a single environment", name, ())
        if seed is not None:
            (seed,) = seeds_of(seed, 1)
        super().reset(seed=seed)
        observations, _ = self.envs.reset(seed=seed)
        return observations.cpu().numpy()[0], {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Observation, reward, termination, truncation and `info`, after `dt`.

        Args:
            action: [n] in [-1, 1].
        """
        rows = action.detach()[None] if isinstance(action, Tensor) and action.ndim else np.asarray(action)[None]
        observations, rewards, terminated, truncated, info = self.envs.step(rows)
        one = {name: x.item() if x.ndim == 1 else x.cpu().numpy()[0] for name, x in info.items()}
        return observations.cpu().numpy()[0], rewards.item(), terminated.item(), truncated.item(), one

    def render(self) -> np.ndarray | None:
        """Frame [H, W, 3] uint8, or None in the mode "human"."""
        frames = self.envs.render()
        return None if frames is None else frames[0]

    def close(self) -> None:
        """Close the environment."""
        self.envs.close()
