"""Training data: joint positions, velocities, accelerations and torques, validated."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchdq.base.checks import require_tensor
from torchdq.base.tables import summary
from torchdq.errors import ArgumentError

UNITS = {"time": "s", "q": "rad", "qd": "rad/s", "qdd": "rad/s^2", "tau": "N m", "command": "as in the file"}


def signal_table(title: str, signals: Mapping[str, Any], known_gains: Any = True) -> str:
    """Table of the signals that were recorded, among other things, with their units."""
    units = UNITS if np.all(known_gains) else UNITS | {"tau": "unknown gains"}
    return summary(title, {name: (x, units[name]) for name, x in signals.items() if name in units and x is not None})


class Samples(NamedTuple):
    """States of an arm and the torques that go with them, `[N, n]` each; in the order of time, if that matters."""

    q: Tensor  # [rad]
    qd: Tensor  # [rad/s]
    qdd: Tensor  # [rad/s^2]
    tau: Tensor  # [N m]

    def __repr__(self) -> str:
        return signal_table("Samples", self._asdict())

    def to(self, device: torch.device) -> "Samples":
        """Samples on a device."""
        return Samples(*(x.to(device) for x in self))


def validated(name: str, samples: Samples) -> Samples:
    """Samples, detached, after checking that they are finite real numbers of one shape and dtype."""
    if not isinstance(samples, Sequence | Tensor) or len(samples) != len(Samples._fields):
        raise ArgumentError(f"{name} must be Samples(q, qd, qdd, tau), found {type(samples).__name__}")
    samples = Samples(*samples)
    for field, x in samples._asdict().items():
        require_tensor(f"{name}.{field}", x)
    for field, x in samples._asdict().items():
        alike = x.shape == samples.q.shape and x.dtype == samples.q.dtype
        if not alike or x.ndim != 2 or not len(x) or not x.dtype.is_floating_point:
            expected = f"real numbers [N, n] with N > 0, all {samples.q.dtype} {list(samples.q.shape)} as {name}.q"
            raise ArgumentError(f"{name}.{field} must be {expected}, found {x.dtype} {list(x.shape)}")
        for row, joint in (~x.isfinite()).nonzero()[:1].tolist():
            found = f"{float(x[row, joint])} in row {row}, joint {joint + 1}"
            raise ArgumentError(f"{name}.{field} must be finite, found {found}; leave the row out")
    return Samples(*(x.detach() for x in samples))


def of_motions(name: str, motions: Any) -> tuple[Samples, tuple[int, ...]]:
    """Rows of one or several motions as one, after checking them, and the number of rows of each."""
    if not isinstance(motions, Sequence) or not motions or not all(isinstance(motion, Samples) for motion in motions):
        rows = validated(name, motions)
        return rows, (len(rows.q),)
    parts = [validated(f"{name}[{k}]", motion) for k, motion in enumerate(motions)]
    if len(kinds := {(part.q.shape[1], part.q.dtype) for part in parts}) > 1:
        found = " and ".join(f"{dtype} of {n} joints" for n, dtype in sorted(kinds, key=str))
        raise ArgumentError(f"{name} must be motions of the same joints and dtype, found {found}")
    return Samples(*(torch.cat(rows) for rows in zip(*parts, strict=True))), tuple(len(part.q) for part in parts)


def torque_variance(tau: Tensor) -> Tensor:
    """Variance of each joint's torque, [n]; a joint whose torque never changes gets the mean of the others."""
    variance = tau.var(dim=0, correction=0)
    changes = variance > 1e-12 * variance.max()
    if not bool(changes.any()):
        raise ArgumentError("train.tau must change from row to row, found the same torques in all")
    return torch.where(changes, variance, variance[changes].mean())
