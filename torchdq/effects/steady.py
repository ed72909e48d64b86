"""Friction of sliding joints at a few speeds, as text for reports and exported files.

Parameters of several effects do not show how large their sum is: a smooth sign of a large width hides Coulomb friction
at low speeds, and identification spreads friction over laws of similar shapes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from torchdq.base.checks import is_number
from torchdq.dynamics.friction import SPEEDS
from torchdq.dynamics.posed import Row
from torchdq.effects.effect import Effect
from torchdq.effects.friction import TEMPERATURE, Friction, resisting
from torchdq.effects.joint import total

SHARP = 0.03  # sign widths below it stand for joints that stick [rad/s or m/s]
CREEP, NARROW = 1e-30, 1e-40  # speed just above rest, and the sign width there [rad/s or m/s]
DECIMALS = 9  # smaller friction torques are rounding errors or those of creeping


def at_speeds(
    effects: Sequence[Effect], n: int, speeds: Sequence[float | Sequence[float]] = SPEEDS
) -> tuple[tuple[str, ...], ...]:
    """Friction torques [N m or N] of resolved effects, a row for each speed, of all joints or of each, a text a joint.

    "0.5" holds in both directions, "0.5/0.7" forwards and backwards, "0.5 + 0.1 load" depends on the load. It is the
    torque in steady motion at the temperature of the coefficients. At rest, signs that are smooth below `SHARP` are
    taken for exact. Ripple, which resists in no direction, is left out. The result is () if there is no friction, or a
    number is a tensor.

    >>> from torchdq.effects.friction import Coulomb, Viscous
    >>> at_speeds((Coulomb((0.5, 0.0), 0.001), Viscous((0.1, 0.2))), 2)
    (('0.5', '0'), ('0.51', '0.02'), ('0.6', '0.2'))
    """
    friction = resisting(effects)
    if not friction or not all(map(_known, friction)):
        return ()
    found = []
    for speed in speeds:
        each = [x or CREEP for x in (speed if isinstance(speed, Sequence) else [speed] * n)]
        ways = [_torques(friction, each, way, n) for way in (1.0, -1.0)]
        found.append(tuple("/".join(dict.fromkeys(both)) for both in zip(*ways, strict=True)))
    return tuple(found)


def lines(effects: Sequence[Effect], n: int) -> list[str]:
    """Lines about `at_speeds`, one for each speed, joint by joint; one text is that of all joints."""
    names = [f"at {speed:g} rad/s or m/s" if speed else "at rest" for speed in SPEEDS]
    rows = [row[0] if len(set(row)) == 1 else ", ".join(row) for row in at_speeds(effects, n)]
    return [f"friction {name} = {row} [N m or N]" for name, row in zip(names, rows, strict=False)]


def _known(effect: Effect) -> bool:
    """True if all parameters are numbers."""
    values = [getattr(effect, name) for name in effect.SHAPES]
    return all(is_number(x) or (isinstance(x, tuple) and all(map(is_number, x))) for x in values)


def _torques(effects: Sequence[Friction], speeds: Sequence[float], way: float, n: int) -> list[str]:
    """Friction of each joint at its speed in one direction."""
    q, qd, inputs = (0.0,) * n, tuple(way * speed for speed in speeds), {TEMPERATURE: (0.0,) * n}
    found = []
    for effect in effects:
        if max(speeds) == CREEP and getattr(effect, "sign_width", SHARP) < SHARP:
            effect = replace(effect, sign_width=NARROW)  # type: ignore[call-arg]
        found.append(effect.impedances_at_end(q, qd, inputs, _settled(effect, q, qd), 0.0))
    result = []
    for i in range(n):
        D, f, g = total([row[i] for row in found])
        size, share = round(way * (D * qd[i] + f), DECIMALS), round(g * speeds[i], DECIMALS)
        words = ([f"{size:.4g}"] if size or not share else []) + ([f"{share:.4g} load"] if share else [])
        result.append(" + ".join(words))
    return result


def _settled(effect: Friction, q: Row, qd: Row) -> Row:
    """Memory that no longer changes at these velocities; its rates are linear in it."""
    size = effect.memory(len(q))
    at = [effect.memory_rates(q, qd, {}, (z,) * size, qd, 0.0) for z in (0.0, 1.0)]
    return tuple(a / (a - b) for a, b in zip(*at, strict=True))
