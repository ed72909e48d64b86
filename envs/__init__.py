"""Gymnasium environments of torchdq; imported as `torchdq.envs`, never as `envs`."""

from gymnasium import register

from torchdq.envs.actions import Actions
from torchdq.envs.env import RobotEnv
from torchdq.envs.pushes import Pushes
from torchdq.envs.randomization import Absolute
from torchdq.envs.setup import Simulation
from torchdq.envs.torch_task import TorchTask
from torchdq.envs.vector_env import RobotVectorEnv

__all__ = ["Absolute", "Actions", "Pushes", "RobotEnv", "RobotVectorEnv", "Simulation", "TorchTask"]

_STEPS = {"Reach": 250, "Track": 250, "Walk": 1000, "Wipe": 250, "Push": 50, "Lift": 50, "Pick": 50}
for _task, _steps in _STEPS.items():
    register(
        f"torchdq/{_task}-v0",
        entry_point="torchdq.envs.env:RobotEnv",
        vector_entry_point="torchdq.envs.vector_env:made_by_gymnasium",
        max_episode_steps=_steps,
        kwargs={"task": _task.lower()},
    )
