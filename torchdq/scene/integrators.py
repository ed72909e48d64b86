"""Integrators: the state at the end of a step from the state at its start.

They are recorded into programs of a scene, so their formulas are written for numbers of any type. A system has
positions x and velocities v (of the joints, and of the rotors of elastic joints) and accelerations.

| integrator | order | evaluations | energy of a conservative arm |
|---|---|---|---|
| ExplicitEuler | 1 | 1 | grows |
| SemiImplicitEuler | 1 | 1 | drifts: the mass matrix depends on q, so it is not symplectic in (q, qd) |
| LinearlyImplicit (default) | 1 | 1 | drifts; damping, stiffness and friction of joints cannot make it unstable |
| RungeKutta4 | 4 | 4 | falls slowly |
| StoermerVerlet | 2 | about 2 + 2 iterations | stays within a band of width dt^2: symplectic in (q, p) |
| DormandPrince | 5 | 7 in every attempt of a step, whose size adapts | to tolerance |

All but StoermerVerlet serve robots with a floating base; see `free_base`. They keep the linear momentum of a single
body up to rounding; its angular momentum, and both of a robot with joints, to their order.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Protocol

from torchdq.algebra.quaternion import Number
from torchdq.base.checks import require_count, require_number
from torchdq.dynamics.posed import Row
from torchdq.numbers.functions import absolute, at_least, below, clip, exp, log, maximum, minimum, select, sqrt

__all__ = [
    "DormandPrince",
    "ExplicitEuler",
    "Integrator",
    "LinearlyImplicit",
    "RungeKutta4",
    "SemiImplicitEuler",
    "StoermerVerlet",
]


class System(Protocol):
    """Equations of motion, as integrators evaluate them.

    Positions need not have as many numbers as velocities: the pose of a floating base has eight, it has six velocities,
    and what friction remembers is among the velocities alone.
    """

    def moved(self, x: Row, h: Number, rate: Row) -> list[Number]:
        """Positions at a displacement h times `rate` from x."""
        return _plus(x, h, rate)

    def rates(self, h: Number, rate: Row, v: Row) -> Row:
        """Rates, at velocities v, of the displacement of the positions, which is h times `rate`."""
        return v

    def sizes(self, x: Row) -> Row:
        """Sizes that errors of a displacement from x are relative to."""
        return [absolute(y) for y in x]

    def accelerations(self, x: Row, v: Row) -> list[Number]:
        """Accelerations in a state."""

    def implicit_velocities(self, x: Row, v: Row, h: Number) -> list[Number]:
        """Velocities at the end of a step h whose impedances act on the state at its end."""

    def momentum_accelerations(self, x: Row, v: Row) -> list[Number]:
        """M(x)^-1 (dL/dx + forces): the rate of the momentum at (x, v), as an acceleration."""

    def velocities_at(self, x: Row, v: Row, to: Row) -> list[Number]:
        """Velocities at the positions `to` that have the momentum of (x, v)."""


@dataclass(frozen=True)
class Integrator:
    """Base of the integrators."""

    order: ClassVar[int]
    FIXED: ClassVar[str] = ""  # reason why it is for robots with a fixed base only; "": it is for all

    def step(self, system: System, x: Row, v: Row, h: Number) -> tuple[Row, Row]:
        """State after a step h [s]."""
        raise NotImplementedError


def _plus(a: Row, h: Number, b: Row) -> list[Number]:
    """Row a + h b."""
    return [x + h * y for x, y in zip(a, b, strict=True)]


@dataclass(frozen=True)
class ExplicitEuler(Integrator):
    """Explicit Euler method, x + h v, v + h a; for comparison only."""

    order = 1

    def step(self, system: System, x: Row, v: Row, h: Number) -> tuple[Row, Row]:
        """Positions and velocities, both with the rates at the start of the step."""
        return system.moved(x, h, v), _plus(v, h, system.accelerations(x, v))


@dataclass(frozen=True)
class SemiImplicitEuler(Integrator):
    """Semi-implicit Euler method, v' = v + h a(x, v), x' = x + h v'. The cheapest; most simulators call it Euler.

    Its inertial torques are those at the start of a step, so that a floating base that spins gains energy, by a factor
    of about exp(h w^2 t); `LinearlyImplicit` takes them in the middle.
    """

    order = 1

    def step(self, system: System, x: Row, v: Row, h: Number) -> tuple[Row, Row]:
        """Velocities first, positions with the new ones."""
        v = _plus(v, h, system.accelerations(x, v))
        return system.moved(x, h, v), v


@dataclass(frozen=True)
class LinearlyImplicit(Integrator):
    """Linearly implicit Euler method: (M + h D + h^2 K)(v' - v) = h (forces(x, v) - h K v), x' = x + h v'.

    D and K are the damping and stiffness of the joint effects, on the diagonal, where they cost an addition each, and
    those of points of bodies, such as contacts, as masses on their links. For stiff friction, servos, limits and
    ground; other wrenches on bodies, and actuators, stay explicit. Inertial torques of a floating base are those in the
    middle of the step: a free body keeps the size of its angular momentum, and gains no energy. Those of links on its
    joints are not: where these swing freely and the base spins, the robot gains energy and may diverge, after 14 s at
    5 rad/s in steps of 5 ms in one example; take `RungeKutta4`.

    >>> import torchdq
    >>> from torchdq.scene import Scene, integrators
    >>> scene = Scene(
    ...     torchdq.robots.load("two_link"), integrator=integrators.LinearlyImplicit(), dt=0.01
    ... )
    """

    order = 1

    def step(self, system: System, x: Row, v: Row, h: Number) -> tuple[Row, Row]:
        """Velocities first, the impedances acting on the end of the step; positions with the new ones."""
        v = system.implicit_velocities(x, v, h)
        return system.moved(x, h, v), v


@dataclass(frozen=True)
class RungeKutta4(Integrator):
    """Classical Runge-Kutta method of order 4.

    >>> import torchdq
    >>> from torchdq.scene import Scene, integrators
    >>> scene = Scene(
    ...     torchdq.robots.load("two_link"), integrator=integrators.RungeKutta4(), dt=0.01
    ... )
    """

    order = 4

    def step(self, system: System, x: Row, v: Row, h: Number) -> tuple[Row, Row]:
        """State plus increments."""
        dx, dv = self.increments(system, x, v, h)
        return system.moved(x, 1.0, dx), _plus(v, 1.0, dv)

    def increments(self, system: System, x: Row, v: Row, h: Number) -> tuple[Row, Row]:
        """Displacement and increments of the velocities: the step times the weighted mean of four rates."""
        a, half = system.accelerations, 0.5 * h
        a1 = a(x, v)
        v2 = _plus(v, half, a1)
        a2, k2 = a(system.moved(x, half, v), v2), system.rates(half, v, v2)
        v3 = _plus(v, half, a2)
        a3, k3 = a(system.moved(x, half, k2), v3), system.rates(half, k2, v3)
        v4 = _plus(v, h, a3)
        a4, k4 = a(system.moved(x, h, k3), v4), system.rates(h, k3, v4)

        def mean(k1: Row, k2: Row, k3: Row, k4: Row) -> list[Number]:
            return [h / 6.0 * (p + 2.0 * (q + r) + s) for p, q, r, s in zip(k1, k2, k3, k4, strict=True)]

        return mean(v, k2, k3, k4), mean(a1, a2, a3, a4)


@dataclass(frozen=True)
class StoermerVerlet(Integrator):
    """Generalised leapfrog in positions and momenta p = M(x) v, symplectic and symmetric.

        p1 = p + h/2 f(x, v1),  M(x) v1 = p1
        x' = x + h/2 (v1 + v2),  M(x') v2 = p1
        p' = p1 + h/2 f(x', v2)

    with f = dL/dx + forces. The two implicit lines are iterated a fixed number of times; each iteration takes a factor
    of order h off their error. For energies over long times; over short ones RungeKutta4 is more accurate at the same
    cost.

    Source: E. Hairer, C. Lubich, G. Wanner, Geometric Numerical Integration, 2006, section VI.3.

    Args:
        iterations: number of iterations of the implicit lines.

    >>> import torchdq
    >>> from torchdq.scene import Scene, integrators
    >>> scene = Scene(
    ...     torchdq.robots.load("two_link"), integrator=integrators.StoermerVerlet(), dt=0.01
    ... )
    """

    order = 2
    FIXED = "its momenta are those of joint positions"
    iterations: int = 3

    def __post_init__(self) -> None:
        require_count(f"iterations of {type(self).__name__}", self.iterations)

    def step(self, system: System, x: Row, v: Row, h: Number) -> tuple[Row, Row]:
        """Half a kick, a drift with the velocities of both ends, half a kick."""
        v1: Row = v
        for _ in range(self.iterations):
            v1 = _plus(v, 0.5 * h, system.momentum_accelerations(x, v1))
        v2, to = v1, x
        for _ in range(self.iterations):
            to = system.moved(system.moved(x, 0.5 * h, v1), 0.5 * h, v2)
            v2 = system.velocities_at(x, v1, to)
        return to, _plus(v2, 0.5 * h, system.momentum_accelerations(to, v2))


@dataclass(frozen=True)
class DormandPrince(Integrator):
    """The embedded pair of order 5(4), every sample with steps of its own.

    The step sizes are not differentiated: gradients are those of the steps that were taken.

    Source: J. R. Dormand, P. J. Prince, "A family of embedded Runge-Kutta formulae", 1980.

    Args:
        rtol, atol: tolerated error of a step, relative to the state and absolute; an rtol below 100 roundings cannot be
            met: it is raised to that, with a warning.
        most: number of attempts of a step after which a sample that has not reached the end becomes NaN, as does one
            that fails at any step size.

    >>> import torchdq
    >>> from torchdq.scene import Scene, integrators
    >>> scene = Scene(
    ...     torchdq.robots.load("two_link"), integrator=integrators.DormandPrince(), dt=0.1
    ... )
    """

    order = 5
    rtol: float = 1e-9
    atol: float = 1e-12
    most: int = 100_000

    def __post_init__(self) -> None:
        require_number("rtol", self.rtol, positive=True)
        require_number("atol", self.atol, positive=True)
        require_count("most", self.most)

    def step(self, system: System, x: Row, v: Row, h: Number) -> tuple[Row, Row]:
        """State by the formula of order 5."""
        increment, _ = _increments(system, x, v, h)
        n = len(v)
        return system.moved(x, 1.0, increment[:n]), _plus(v, 1.0, increment[n:])

    def attempt(self, system: System, x: Row, v: Row, clock: Row, goal: Row) -> tuple[Row, Row, Row, Number]:
        """State and clock after an attempt of a step, and the size of the step if its error is tolerated, otherwise 0.

        Args:
            clock: time reached [s], size of the next step unless it is cut at the end [s], and 1 while it goes on.
            goal: time to reach [s], `rtol`, `atol`, and relative rounding of times.
        """
        (t, h, going), (end, rtol, atol, rounding) = clock, goal
        step = select(going, minimum(h, end - t), 0.0)
        increment, error = _increments(system, x, v, step)
        to, w = system.moved(x, 1.0, increment[: len(v)]), _plus(v, 1.0, increment[len(v) :])
        now, then = ([*system.sizes(y), *map(absolute, u)] for y, u in ((x, v), (to, w)))
        sizes = [atol + rtol * maximum(a, b) for a, b in zip(now, then, strict=True)]
        squares = [(e / size) * (e / size) for e, size in zip(error, sizes, strict=True)]
        size = sqrt(sum(squares[1:], squares[0]) / float(len(squares)))
        good = going * at_least(1.0, size)
        factor = clip(0.9 * exp(-0.2 * log(maximum(size, 1e-10))), 0.2, 5.0)
        factor = select(at_least(size, 0.0), factor, 0.2)  # of an error that is NaN
        # the last step was cut to end on time, and does not suggest the size of the next
        kept = select(going, good * below(step, h), 1.0)
        failed = (1.0 - good) * at_least(rounding * end, step)
        t = select(good, t + step, t)
        going = going * below(t, end * (1.0 - rounding)) * (1.0 - failed)
        x, v = ([select(good, a, b) for a, b in zip(*rows, strict=True)] for rows in ((to, x), (w, v)))
        return x, v, [t, select(kept, h, step * factor), going], select(good, step, 0.0)


def _increments(system: System, x: Row, v: Row, h: Number) -> tuple[Row, Row]:
    """Displacement and increments of the velocities over a step of Dormand and Prince, and their errors."""
    n, k = len(v), [[*v, *system.accelerations(x, v)]]

    def combined(weights: Sequence[float]) -> list[Number]:
        terms = [[h * weight * s for s in slope] for weight, slope in zip(weights, k, strict=True) if weight]
        return [sum(row[1:], row[0]) for row in zip(*terms, strict=True)]

    increment: Row = ()
    for weights in _TABLEAU:
        increment = combined(weights)
        moved, w = increment[:n], _plus(v, 1.0, increment[n:])
        k.append([*system.rates(1.0, moved, w), *system.accelerations(system.moved(x, 1.0, moved), w)])
    return increment, combined(_ERROR)


_TABLEAU = (
    (1 / 5,),
    (3 / 40, 9 / 40),
    (44 / 45, -56 / 15, 32 / 9),
    (19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729),
    (9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656),
    (35 / 384, 0.0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84),
)
_ERROR = (71 / 57600, 0.0, -71 / 16695, 71 / 1920, -17253 / 339200, 22 / 525, -1 / 40)
