"""Command `accuracy`: the cheapest precision, integrator and step that keep an error."""

from dataclasses import dataclass

from torchdq.base import machine
from torchdq.command.command import RobotCommand
from torchdq.command.outcome import Outcome
from torchdq.recommend.recommend import recommend_settings
from torchdq.recommend.recommendation import SceneRecommendation
from torchdq.recommend.trajectories import MOST_STEPS


@dataclass(kw_only=True)
class AccuracyCommand(RobotCommand):
    """Price of accuracy: the cheapest precision, integrator and step that keep an error, found by trials.

    Example: torchdq accuracy panda --error 1e-4 --horizon 0.5
    """

    error: float = 1e-3
    """Largest error of a joint's position [rad or m]; of accelerations, relative, with --accelerations."""
    horizon: float = 1.0
    """Time over which it must be kept [s]."""
    accelerations: bool = False
    """Accelerations alone, without an integrator."""
    most_steps: int = MOST_STEPS
    """Largest number of steps of a trajectory that is tried; fewer shorten the search."""

    def outcome(self) -> Outcome:
        """Recommendation with its alternatives."""
        robot = self.load_moving().robot
        found = recommend_settings(
            robot, self.error, None if self.accelerations else self.horizon, most_steps=self.most_steps
        )
        data = {
            "robot": robot.name,
            "machine": machine.words(),
            "dtype": str(found.dtype).removeprefix("torch."),
            **{name: getattr(found, name) for name in ("precision", "backend", "method", "error", "nanoseconds")},
            "others": [str(other) for other in found.others[1:]],
        }
        if isinstance(found, SceneRecommendation):
            data["integrator"] = type(found.integrator).__name__
            data |= {name: getattr(found, name) for name in ("step", "horizon", "limit", "growth")}
        asked = "accelerations" if self.accelerations else f"{self.horizon:g} s under gravity, without torques"
        title = f"{robot.name}, error of {self.error:g} at most: {asked}"
        return Outcome((title, str(found), machine.words()), data)
