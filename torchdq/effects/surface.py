"""Planes that are tangent to uneven ground: to a recorded function, and to a map of heights, which torch looks up."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchdq.base.checks import floating, require_finite, require_number
from torchdq.errors import ArgumentError
from torchdq.numbers.ops import Value
from torchdq.numbers.record import Recorded
from torchdq.program.autodiff import gradient
from torchdq.program.program import Argument, record, replay, results
from torchdq.program.transforms import without_values


@dataclass(frozen=True, eq=False)
class HeightMap:
    """Heights of the ground on a square grid, bilinear in between; beyond the edge its height continues.

    The height at x, y = origin + spacing (column, row) is heights[..., row, column]. Robots of a batch share a map, or
    have one each. Gradients flow to the heights. A map is the `surface` of an `effects.Contact`: before each step torch
    looks up the plane that is tangent to it below every point, and the step takes that plane for the ground.

    Args:
        heights: [m], shape [..., rows, columns], at least two of each.
        spacing: distance of neighbouring heights [m].
        origin: x and y of the first height [m], in the world frame, or in that of a fixed base.

    >>> import torch
    >>> from torchdq import effects
    >>> stairs = effects.HeightMap(torch.tensor([[0.0, 0.0, 0.2, 0.2]] * 2), spacing=0.5)
    >>> height, slope_x, slope_y = stairs(
    ...     torch.tensor([0.25, 0.75, 9.0]), torch.tensor([0.1, 0.1, 0.1])
    ... )
    >>> height, slope_x
    (tensor([0.0000, 0.1000, 0.2000]), tensor([0.0000, 0.4000, 0.0000]))
    """

    heights: Tensor
    spacing: float
    origin: Sequence[float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        floating("heights of HeightMap", self.heights)
        if self.heights.ndim < 2 or min(self.heights.shape[-2:]) < 2:
            found = tuple(self.heights.shape)
            raise ArgumentError(f"heights of HeightMap must have two rows and columns at least, found {found}")
        if not without_values((self.heights,)):
            require_finite(**{"heights of HeightMap": self.heights})
        require_number("spacing of HeightMap", self.spacing, positive=True)
        if not isinstance(self.origin, Sequence) or len(self.origin) != 2:
            raise ArgumentError(f"origin of HeightMap must be two numbers, x and y [m], found {self.origin!r}")
        for x in self.origin:
            require_number("origin of HeightMap", x)

    def __call__(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Height [m] of the ground below points, and its slopes dz/dx and dz/dy, each of shape [..., points].

        Args:
            x, y: places of the points [m], shape [..., points]; the other axes are batch axes, as those of the heights.
        """
        *batch, rows, columns = self.heights.shape
        heights = self.heights.to(x.device).flatten()
        first = torch.arange(0, heights.numel(), rows * columns, device=x.device).reshape(*batch, 1) if batch else 0
        (left, right, a), (front, back, b) = self._cell(x, 0, columns), self._cell(y, 1, rows)
        try:
            front, back = first + columns * front, first + columns * back
        except RuntimeError as error:
            found = f"heights of HeightMap {tuple(batch)}, places {tuple(x.shape[:-1])}"
            raise ArgumentError(f"the batch axes of the arguments must broadcast, found {found}") from error

        def of(row: Tensor, column: Tensor) -> Tensor:
            at = row + column
            return heights.index_select(0, at.flatten()).reshape(at.shape).to(x.dtype)

        corner, behind = of(front, left), of(back, left)
        slope, slope_behind = of(front, right) - corner, of(back, right) - behind
        turn = slope_behind - slope
        slope_y = behind - corner + a * turn
        return corner + a * slope + b * slope_y, (slope + b * turn) / self.spacing, slope_y / self.spacing

    def _cell(self, x: Tensor, axis: int, count: int) -> tuple[Tensor, Tensor, Tensor]:
        """Numbers of the heights on both sides of places along an axis, and the part of the way between them.

        Outside the map both are the edge's. A row with NaN has neighbours too, but no height.
        """
        u = (x - self.origin[axis]) / self.spacing
        lower = u.detach().floor()
        left = lower.nan_to_num()
        return left.clamp(0, count - 1).long(), (left + 1).clamp(0, count - 1).long(), u - lower


def tangent(surface: Callable[[Value, Value], Value], x: Value, y: Value) -> tuple[Value, Value, Value]:
    """Height of a surface at a place, and its slopes along x and y, by reverse mode on the recorded function."""

    def height(x: Sequence[Value], y: Sequence[Value]) -> dict[str, list[Value]]:
        z = surface(x[0], y[0])
        if not isinstance(z, Recorded | float | int):
            raise ArgumentError(f"surface of Contact must return one number, the height, found {z!r:.80}")
        return {"z": [z]}

    program = record("surface", [Argument("x", 1), Argument("y", 1)], height)
    values = replay(program, [[x], [y]])
    (z,) = results(program, values)["z"]
    found = gradient(program, values, program.results[0].values[0])
    return z, found.get((0, 0), 0.0), found.get((1, 0), 0.0)
