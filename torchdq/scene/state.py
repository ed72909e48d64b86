"""State of a scene."""

from __future__ import annotations

from typing import Any, NamedTuple

from torch import Tensor, dtype

from torchdq.base.checks import require_tensor
from torchdq.errors import ArgumentError


class State(NamedTuple):
    """State of a scene: everything that the next step depends on."""

    q: Tensor  # [..., n] positions [rad or m]
    qd: Tensor  # [..., n] velocities [rad/s or m/s]
    memory: Tensor | None = None  # [..., m] what the effects of its scene remember, in their order; None: nothing
    reading: Tensor | None = None  # [..., 2 n] measured positions and velocities; None: there are no sensors
    X_WB: Tensor | None = None  # [..., 8] pose of a free base; None: the base is fixed
    V_WB_B: Tensor | None = None  # [..., 6] twist (angular, linear) of a free base in its axes [rad/s, m/s]

    @property
    def measured(self) -> tuple[Tensor, Tensor]:
        """Positions and velocities as the sensors read them; without sensors, those of the state itself."""
        if self.reading is None:
            return self.q, self.qd
        n = self.q.shape[-1]
        return self.reading[..., :n], self.reading[..., n:]

    def rows(self) -> dict[str, Tensor]:
        """Tensors of the state that are there, by name."""
        return {name: x for name, x in zip(self._fields, self, strict=True) if x is not None}

    def to(self, dtype: dtype) -> State:
        """State in another dtype."""
        return State._make(None if x is None else x.to(dtype) for x in self)


def require_state(x: Any) -> None:
    """Raise unless x is a state with positions and velocities."""
    if not isinstance(x, State):
        raise ArgumentError(
            f"state must be a torchdq.envs.State, found {type(x).__name__}; scene.start(q, qd) makes one"
        )
    for name in ("q", "qd"):
        require_tensor(f"{name} of the state", getattr(x, name))
