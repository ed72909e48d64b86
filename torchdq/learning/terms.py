"""Terms of a joint's torque that are linear in one number per joint: rotor inertia, friction, offset.

Each states its torque per unit, which is a column of the least squares of `regression`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchdq.dynamics.friction import smooth_sign
from torchdq.learning.blocks import Recording

FORCE = ("N m", "N")  # units of joints that turn, and that slide


class Rows(NamedTuple):
    """What torques per unit depend on, [rows, n] each."""

    q: Tensor
    qd: Tensor
    qdd: Tensor
    sign: Tensor  # of the velocity, smooth
    load: Tensor | None  # torque of the bodies and the rotor; None: unknown
    starts: Tensor  # rows at which motions begin


class Term(NamedTuple):
    """Torque of every joint in proportion to one number."""

    name: str
    unit: Callable[[Rows], Tensor]  # torque per unit [rows, n]
    units: tuple[str, str]  # units of the number at a joint that turns, and at one that slides
    described: str = ""  # attribute of the robot that holds it
    signed: bool = False  # whether it may be negative
    loaded: bool = False  # whether the torque per unit depends on the load
    effect: Callable[..., object] | None = None


ROTOR = Term("rotor", lambda x: x.qdd, ("kg m^2", "kg"), "armature")
VISCOUS = Term("viscous", lambda x: x.qd, ("N m s/rad", "N s/m"), "damping")
COULOMB = Term("coulomb", lambda x: x.sign, FORCE, "friction")
OFFSET = Term("offset", lambda x: torch.ones_like(x.qd), FORCE, signed=True)


def rows_of(recording: Recording, width: float, load: Tensor | None = None) -> Rows:
    """Rows of a recording; the sign is that of qd / sqrt(qd^2 + width^2), unless it was filtered."""
    sign = smooth_sign(recording.qd, width) if recording.direction is None else recording.direction
    return Rows(recording.q, recording.qd, recording.qdd, sign, load, recording.starts())


def unit_torques(terms: Sequence[Term], rows: Rows) -> Tensor:
    """Torques per unit of every term [rows, n, terms]."""
    if not terms:
        return rows.q.new_zeros(*rows.q.shape, 0)
    return torch.stack([term.unit(rows) for term in terms], -1)


# --- friction of other shapes ----------------------------------------------------------------------------------------


def _load(x: Rows) -> Tensor:
    assert x.load is not None
    return x.load.abs() * x.sign


def _stribeck(velocity: float) -> Term:
    def unit(x: Rows) -> Tensor:
        return x.sign / (1 + (x.qd / velocity) ** 2)

    return Term(f"stribeck {velocity:g}", unit, FORCE)


def _saturating(width: float) -> Term:
    def unit(x: Rows) -> Tensor:
        return smooth_sign(x.qd, width)

    return Term(f"saturating {width:g}", unit, FORCE)


def presliding(q: Tensor, starts: Tensor, distance: float) -> Tensor:
    """Direction of friction that turns over a distance: ds/dq = (sign(dq) - s) / distance, from s = 0 [rows, n]."""
    step = torch.diff(q, dim=0, prepend=q[:1])
    step[starts] = 0
    keep = torch.exp(-step.abs() / distance)
    keep[starts] = 0
    found = step.sign() * (1 - keep)
    found[starts] = 0
    shift = 1
    while shift < len(q):  # a linear recurrence, by doubling
        before = torch.cat([found.new_zeros(shift, found.shape[1]), found[:-shift]])
        kept = torch.cat([keep.new_zeros(shift, keep.shape[1]), keep[:-shift]])
        found, keep = found + keep * before, keep * kept
        shift *= 2
    return found


def _presliding(distance: float) -> Term:
    return Term(f"presliding {distance:g}", lambda x: presliding(x.q, x.starts, distance), FORCE)


SHAPES = (
    Term("load", _load, ("1", "1"), loaded=True),
    *(_stribeck(v) for v in (0.03, 0.1, 0.3, 1.0)),
    *(_saturating(v) for v in (0.03, 0.1, 0.3, 1.0)),
    Term("quadratic", lambda x: x.qd * x.qd.abs(), ("N m s^2/rad^2", "N s^2/m^2")),
    *(_presliding(x) for x in (5e-4, 2e-3, 1e-2)),
)
