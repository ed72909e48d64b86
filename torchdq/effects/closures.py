"""Elastic closures: springs and dampers in the loops of a robot."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Self

from torchdq.base.checks import POSITIVE
from torchdq.dynamics.closures import ROWS, Spring
from torchdq.effects.effect import Effect
from torchdq.errors import ArgumentError
from torchdq.functions.parametric import Parameter
from torchdq.functions.signature import parameter
from torchdq.robot import Robot


@dataclass(frozen=True)
class Closures(Effect):
    """Springs and dampers instead of rigid closures: f = -k g - d g', of a gap g.

    The gap is the vector between the origins of a closure's frames, and the sines of the angles between the axes that
    it holds. A linearly implicit step takes both at its end, so that it holds any stiffness. States may start with a
    gap, which loads the spring.

    Args:
        stiffness: k of the distance between the origins [N/m], shape [..., closures].
        damping: d of that distance [N s/m], shape [..., closures].
        rotational_stiffness: k of the angles of hinges and welds [N m/rad], shape [..., closures].
        rotational_damping: d of those angles [N m s/rad], shape [..., closures].
    """

    SLOT: ClassVar[str] = "body"
    ONCE: ClassVar[str] = "a closure has one spring"
    stiffness: Parameter = field(metadata=parameter("closures", check=POSITIVE))
    damping: Parameter = field(default=0.0, metadata=parameter("closures"))
    rotational_stiffness: Parameter = field(default=1e3, metadata=parameter("closures", check=POSITIVE))
    rotational_damping: Parameter = field(default=0.0, metadata=parameter("closures"))

    def described(self, robot: Robot) -> Self:
        """The effect itself; raises for a robot without closures."""
        if not robot.closures:
            raise ArgumentError(
                f"robot {robot.name!r} must have closures for effects.Closures, found none; see Robot.with_closures"
            )
        return self

    def springs(self, robot: Robot) -> Sequence[Sequence[Spring]]:
        """Springs of the rows of every closure."""
        numbers = (self.stiffness, self.damping, self.rotational_stiffness, self.rotational_damping)
        return [
            [Spring(k, d)] * 3 + [Spring(turning, turning_d)] * (ROWS[closure.kind] - 3)
            for closure, k, d, turning, turning_d in zip(robot.closures, *numbers, strict=True)
        ]
