"""Terms of a joint's torque that are linear in one number per joint: rotor inertia, friction, offset.

Each states its torque per unit, which is a column of the least squares of `regression`. Friction is that of the effects
in `torchdq.effects`, with one of its linear parameters one and the others zero.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchdq import effects
from torchdq.base.checks import is_number
from torchdq.dynamics.friction import smooth_sign
from torchdq.effects.friction import Friction, parts_of
from torchdq.effects.resistance import columns
from torchdq.errors import ArgumentError
from torchdq.learning.evaluation.blocks import MotionRows
from torchdq.robot import Robot

FORCE = ("N m", "N")  # units of joints that turn, and that slide
STILL = 1e-9  # least speed by which the sign of friction is divided [rad/s or m/s]
WAVE = 0.125  # least deviation of a wave from its mean, relative to that in whole periods, to be identifiable


class TermRows(NamedTuple):
    """Quantities that torques per unit depend on, [rows, n] each."""

    robot: Robot
    recording: MotionRows
    sign: Tensor  # smooth sign of the velocity
    load: Tensor | None  # torque of the bodies and the rotor; None: unknown
    width: float  # velocity below which dry friction is viscous


class Term(NamedTuple):
    """Torque of every joint in proportion to one number."""

    name: str
    units: tuple[str, str]  # unit of the number at a joint that turns, and at one that slides
    law: Friction | None = None  # None: no friction
    parameter: str = ""  # linear parameter of the friction that the number is
    described: str = ""  # attribute of the robot that holds the number
    signed: bool = False  # whether the number may be negative
    dry: bool = False  # whether the torque has the sign of the velocity, sharp but for a width of choice
    loaded: bool = False  # whether the torque per unit depends on the load
    bristles: float = 0.0  # deflection of bristles that slide, of friction that remembers it [rad or m]

    def effect(self, width: float) -> Friction | None:
        """Friction, with a width where it is dry, if it is friction."""
        return replace(self.law, **{"sign_width": width}) if self.law is not None and self.dry else self.law

    def unit(self, rows: TermRows) -> Tensor:
        """Torque per unit [rows, n]."""
        q, qd, effect = rows.recording.q, rows.recording.qd, self.effect(rows.width)
        if effect is None:
            return rows.recording.qdd if self.name == "rotor" else torch.ones_like(qd)
        if self.bristles:
            starts = torch.tensor([0, *rows.recording.lengths[:-1]], device=q.device).cumsum(0)
            return deflection(q, starts, self.bristles)
        qd = qd.where(qd.abs() > STILL, STILL) if self.dry else qd
        torque = columns(rows.robot, effect, q, qd, rows.load if self.loaded else None, backend="eager")[self.parameter]
        return torque / smooth_sign(qd, rows.width) * rows.sign if self.dry else torque

    @property
    def fraction(self) -> bool:
        """Whether the number is below one."""
        return self.law is not None and self.law.interval(self.parameter).below == 1.0

    def size(self, unit: Tensor, torque: Tensor, identifiable: Tensor) -> Tensor:
        """Torque per unit [n] at which the number makes the torque that it is expected to make.

        It is the root mean square `unit` over the rows, so that terms that they cannot separate share it evenly. But a
        fraction is at most one, and what no row identifies is as if the joint moved at 1 rad/s or 1 rad/s^2.
        """
        return unit.maximum(torque) if self.fraction else torch.where(identifiable, unit, unit.clamp_min(1.0))

    def identifiable(self, rows: TermRows) -> Tensor:
        """Joints [n] whose rows identify the term: they move, and for a wave through about a quarter of a period.

        In less, a wave looks like a constant torque and a slope, as gravity does: errors go as one over the least
        standard deviation of a sin(x) + b cos(x), with a^2 + b^2 = 1, which is 1 / sqrt(2) in whole periods.
        """
        q, qd, effect = rows.recording.q, rows.recording.qd, self.effect(rows.width)
        if not self.signed:  # rotors and friction, which resist
            return (qd.abs().amax(0) > rows.width).cpu()
        if effect is None:
            return torch.ones(rows.robot.n, dtype=torch.bool)
        wave = torch.stack([*columns(rows.robot, effect, q, qd, backend="eager").values()], -1)
        wave = wave - wave.mean(0)
        least = torch.linalg.eigvalsh(torch.einsum("rjk,rjl->jkl", wave, wave) / len(wave))[:, 0]
        return (least >= WAVE**2 / 2).cpu()

    def found(self, numbers: Sequence[float] | Tensor, width: float) -> tuple[Friction, ...]:
        """Friction with the numbers of the joints [n], or of the joints of many robots [..., n], if it is friction."""
        if (effect := self.effect(width)) is None:
            return ()
        values: dict[str, Any] = dict.fromkeys(effect.LINEAR, 0.0)
        values[self.parameter] = numbers if isinstance(numbers, Tensor) else tuple(numbers)
        return (replace(effect, **values),)


def rows_of(robot: Robot, recording: MotionRows, width: float, load: Tensor | None = None) -> TermRows:
    """Rows of a recording; the sign is that of qd / sqrt(qd^2 + width^2), unless it was filtered."""
    sign = smooth_sign(recording.qd, width) if recording.direction is None else recording.direction
    return TermRows(robot, recording, sign, load, width)


def at_rest(qd: Tensor, width: float) -> Tensor:
    """Parts [..., n] of dry friction that may be anything: all of it at rest, none of it where a joint slides."""
    return 1 - smooth_sign(qd, width).abs()


def unit_torques(terms: Sequence[Term], rows: TermRows) -> Tensor:
    """Torques per unit of every term [rows, n, terms]."""
    q = rows.recording.q
    return torch.stack([term.unit(rows).expand_as(q) for term in terms], -1) if terms else q.new_zeros(*q.shape, 0)


def deflection(q: Tensor, starts: Tensor, distance: float) -> Tensor:
    """Deflection of the bristles of `effects.LuGre` in units of that at which they slide, from zero [rows, n].

    Where positions run evenly from row to row, dz/dq = (sign(dq) - z) / distance has a closed form, however long the
    steps are.
    """
    step = torch.diff(q, dim=0, prepend=q[:1])
    step[starts] = 0
    keep = torch.exp(-step.abs() / distance)
    keep[starts] = 0
    found = step.sign() * (1 - keep)
    shift = 1
    while shift < len(q):  # a linear recurrence, by doubling
        found[shift:] += keep[shift:] * found[:-shift]
        keep = torch.cat([keep[:shift], keep[shift:] * keep[:-shift]])
        shift *= 2
    return found


ROTOR = Term("rotor", ("kg m^2", "kg"), described="armature")
VISCOUS = Term("viscous", ("N m s/rad", "N s/m"), effects.Viscous(), "coefficient", "damping")
COULOMB = Term("coulomb", FORCE, effects.Coulomb(), "coulomb", "friction", dry=True)
OFFSET = Term("offset", FORCE, signed=True)

SPEEDS, WIDTHS = (0.1, 0.3), (0.03, 0.3, 1.0)  # of Stribeck and of saturating friction [rad/s or m/s]
BRISTLES = (5e-4, 2e-3, 1e-2)  # [rad or m]
SHAPES = (  # friction of other shapes, each of which lowers the errors on recordings of real arms
    Term("load", ("1", "1"), effects.LoadDependent(), "coefficient", dry=True, loaded=True),
    *(Term(f"stribeck {v:g}", FORCE, effects.Stribeck(velocity=v), "static", dry=True) for v in SPEEDS),
    *(Term(f"saturating {v:g}", FORCE, effects.Coulomb(sign_width=v), "coulomb") for v in WIDTHS),
    Term("quadratic", ("N m s^2/rad^2", "N s^2/m^2"), effects.Quadratic(), "coefficient"),
    *(Term(way, FORCE, effects.Directional(), way, dry=True) for way in ("forward", "backward")),
    *(Term(f"lugre {x:g}", FORCE, effects.LuGre(deflection=x), "coulomb", bristles=x) for x in BRISTLES),
    *(Term(f"ripple {x}", FORCE, effects.Ripple(2 * math.pi), x, signed=True) for x in ("sine", "cosine")),
)


def terms_of(friction: Any, robot: Robot, width: float) -> tuple[Term, ...]:
    """Terms of friction effects, one for each number per joint in which their torque is linear; others hold.

    Dry friction of this width has the sign of the rows, which may be filtered, that of others their own.
    """
    return tuple([_term(law, parameter, width) for law, parameter in parts_of(friction, robot)])


def _term(law: Friction, parameter: str, width: float) -> Term:
    """Term of one parameter of an effect: a known one if it has that law, or one like it."""
    name = type(law).__name__
    own = {key: getattr(law, key) for key in law.SHAPES if key not in (*law.LINEAR, "warming")}
    alike = Term(f"{name.lower()} {parameter}", ("", ""), parameter=parameter, signed=law.interval(parameter).signed)
    # first, since saturating friction may have the same width; and last, since it is like all dry friction
    for term in (COULOMB, *reversed(SHAPES), COULOMB, VISCOUS):
        known = term.effect(width)
        if known == law and term.parameter == parameter:
            return term
        alike = term if type(known) is type(law) and term.parameter == parameter else alike
    if not is_number(own.get("sign_width", width)):
        raise ArgumentError(f"sign_width of {name} must be one number to be identified, found {law!r}")
    dry, bristles = alike.dry and own.get("sign_width") == width, law.bristles()
    if bristles:
        own = {"deflection": bristles}
    numbers = [x for key, x in own.items() if not (dry and key == "sign_width")]
    words = [word for word in alike.name.split() if not word[0].isdigit()]
    words += ["/".join(f"{one:g}" for one in (x if isinstance(x, Sequence) else (x,))) for x in numbers]
    return alike._replace(name=" ".join(words), law=law, described="", dry=dry, bristles=bristles)
