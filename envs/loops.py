"""Starts of episodes at which the loops of a robot are closed; rows do not depend on each other."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchdq.backends.choice import BackendName
from torchdq.closures import towards_closed
from torchdq.errors import ArgumentError
from torchdq.functions.call import function_of
from torchdq.robot import Robot

PARTS, MOST = 8, 20  # parts of the way from home, and Newton steps at its end


class Way(NamedTuple):
    """Joints that go from home to where they were drawn, and those that close the loops: 1, otherwise 0, each [n]."""

    moved: Tensor
    free: Tensor


class Loops(NamedTuple):
    """Loops of a robot at the start of episodes."""

    robot: Robot
    home: Tensor  # [n] closed positions
    bounds: tuple[Tensor, Tensor]  # lower and upper limits, each [n]
    ways: tuple[Way, ...]  # tried one after the other
    backend: BackendName | None

    @classmethod
    def of(cls, robot: Robot, actuated: Sequence[int], q: Tensor, backend: BackendName | None) -> Loops:
        """Loops of a robot with these actuated joints; home is near the first of positions that a task draws [k, n].

        It is on the branch of the robot as drawn, if that is closed, or else that of the first of q that can be closed.
        """
        every, (lower, upper, *_) = torch.ones_like(q[0]), (x.to(q) for x in robot.limits)
        held = torch.zeros_like(q[0]).index_fill(0, torch.tensor(actuated, dtype=torch.int64, device=q.device), 1.0)
        first = (Way(held, every - held),) if 0 < len(actuated) < robot.n else ()
        bounds = lower.where(lower < upper, -torch.inf), upper.where(lower < upper, torch.inf)
        drawn = torch.zeros_like(q[0]) if robot.home is None or robot.joint_map is not None else robot.home.to(q)
        found = cls(robot, drawn, bounds, (*first, Way(every, every)), backend)
        if bool(found.usable(towards_closed(robot, drawn, every, 0, backend))):
            return found._replace(home=found.closed(q[:1])[0])
        for _, free in found.ways:
            at = towards_closed(robot, q, free, backend=backend)
            if len(rows := found.usable(at).nonzero()):
                return found._replace(home=at[0][rows[0, 0]])
        pairs = ", ".join(f"{x.frame_a!r} and {x.frame_b!r}" for x in robot.closures)
        raise ArgumentError(
            f"the task must start near positions at which the loops of robot {robot.name!r} are closed, found none in "
            f"{len(q)} starts at which {pairs} come together within the limits of the joints; give the joints limits "
            "around such positions, or a TorchTask a start"
        )

    def usable(self, found: tuple[Tensor, Tensor, Tensor, int]) -> Tensor:
        """Whether what `towards_closed` returned is closed, and within the limits."""
        at, apart, turned, _ = found
        return ((at >= self.bounds[0]) & (at <= self.bounds[1])).all(-1) & ~(apart | turned)

    def closed(self, q: Tensor) -> Tensor:
        """Closed positions for those that a task drew [k, n].

        The actuated joints go from home to where they were drawn and the others follow, so that a mechanism stays on
        the branch of its home. Where loops stay open so, or joints end beyond limits, all joints give way; where that
        fails, too, the episode starts at home. What was drawn closed is not moved.
        """
        home, every = self.home.expand_as(q), self.ways[-1].free
        _, apart, turned, _ = towards_closed(self.robot, q, every, 0, self.backend)
        there, found = ~(apart | turned), q
        for moved, free in self.ways:
            if q.is_cpu and bool(there.all()):
                break
            at, part = home, (q - home) * (moved / PARTS)
            for _ in range(PARTS):
                at = at + part
                at = at + function_of("loop_step", self.robot, {"q": at, "free": free}, self.backend)[0]
            ended = towards_closed(self.robot, at, free, MOST, self.backend)
            found = torch.where((self.usable(ended) & ~there)[:, None], ended[0], found)
            there = there | self.usable(ended)
        return torch.where(there[:, None], found, home)
