"""Physically consistent robots around a described one: their parameters, and their distance to the description.

The distance of a link is the divergence of its pseudo-inertia from the described one (`torchdq.robot.pseudo_inertia`).
The distance of a coefficient of friction is 2 (x - log x - 1), x being its ratio to the described one. Where a
coefficient t x must be below one, 2 (log((1 - t) / (1 - t x)) - (x - 1) t / (1 - t)) is added: nothing at x = 1,
infinite at t x = 1.
"""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from torchdq.errors import ArgumentError
from torchdq.learning.identification.base_parameters import inverse_of
from torchdq.learning.identification.terms import ROTOR, Term
from torchdq.robot import Robot
from torchdq.robot.arrays import second_moments
from torchdq.robot.pseudo_inertia import BASIS, bodies_of, divergence, divergence_slopes, inertial_parameters, relative

THIN = 1e-2  # least extent of a body relative to its size: coordinates of points, rods and plates would be infinite
SMALL = 0.1  # prior scale of an undescribed effect, relative to the joint's RMS torque


class Distance:
    """Distance of y [..., t]: ten entries of (B - 1) sqrt(strength) per link, and changes of coefficients per size.

    Coefficients may have either sign (`signed`), or must be below one, t being their size then (`fraction`, else zero).
    """

    def __init__(self, links: int, signed: Tensor, fraction: Tensor, strength: float = 1.0):
        self.inertial, self.signed, self.fraction, self.strength = 10 * links, signed, fraction, strength

    def _split(self, y: Tensor) -> tuple[Tensor, Tensor]:
        """B [..., links, 4, 4] and the ratio [..., coefficients] of every coefficient to its size."""
        change = y[..., : self.inertial].unflatten(-1, (-1, 10)) / math.sqrt(self.strength)
        return relative(change), 1 + y[..., self.inertial :]

    def distance(self, y: Tensor) -> Tensor:
        """Distance to the description [...] of y [..., t]; infinite where no robot can exist."""
        B, x = self._split(y)
        t = self.fraction
        exists = ((self.signed | (x > 0)) & (t * x < 1)).all(-1)
        below_one = 2 * (((1 - t) / (1 - t * x)).log() - (x - 1) * t / (1 - t))
        coefficients = torch.where(self.signed, (x - 1).square(), 2 * (x - 1 - x.abs().log()) + below_one).sum(-1)
        return torch.where(exists, self.strength * divergence(B).sum(-1) + coefficients, torch.inf)

    def apart(self, y: Tensor) -> float:
        """Distance of the bodies alone, were the strength one."""
        return float(divergence(self._split(y)[0]).sum())

    def slopes(self, y: Tensor, V: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Gradient [..., t] and Hessian [..., t, t] of the distance, at y [..., t]; with V [..., t, t], by V^-1 y."""
        V = torch.eye(y.shape[-1], dtype=y.dtype) if V is None else V
        B, ratio = self._split(y)
        slopes, blocks = divergence_slopes(B)
        x, t, b = torch.where(self.signed, 1.0, ratio), self.fraction, self.inertial
        rest = torch.where(self.signed, 2 * (ratio - 1), 2 - 2 / x + 2 * t / (1 - t * x) - 2 * t / (1 - t))
        gradient = torch.cat([math.sqrt(self.strength) * slopes.flatten(-2), rest], -1)
        of_bodies = (blocks @ V[..., :b, :].unflatten(-2, (-1, 10))).flatten(-3, -2)
        of_others = (2 / x**2 + 2 * (t / (1 - t * x)) ** 2)[..., None] * V[..., b:, :]
        return (gradient[..., None, :] @ V)[..., 0, :], V.mT @ torch.cat([of_bodies, of_others], -2)


class Neighbourhood(Distance):
    """Parameters phi = phi_0 + S y around those of a described robot, and the distance of y [t] from it."""

    def __init__(
        self,
        robot: Robot,
        terms: Sequence[Term],
        estimated: Tensor,  # [terms, n] coefficients that are estimated, the others being zero
        torque: Tensor,  # [n] root mean squares of the torques
        unit: Tensor,  # [terms, n] those of the torques per unit of the coefficients
        strength: float = 1.0,  # weight of the distance of bodies; infinite: they stay as described
    ):
        mass, com, inertia = (getattr(robot, name).detach().double().cpu() for name in ("mass", "com", "inertia"))
        if not bool((mass >= 0).all()):
            raise ArgumentError(f"mass of robot {robot.name!r} must not be negative, found {mass.tolist()}")
        massive = mass.nonzero()[:, 0]
        factor = _factor(mass[massive], com[massive], inertia[massive])
        free = strength < math.inf
        self.links, self.factor = (massive, factor) if free else (massive[:0], factor[:0])
        self.mass, self.com, self.inertia = mass, com, inertia
        given = torch.zeros(len(terms), robot.n, dtype=torch.float64)
        for row, term in zip(given, terms, strict=True):
            if term.described and (x := getattr(robot, term.described)) is not None:
                row.copy_(x.detach())
        signed, below_one = (
            torch.tensor([getattr(term, name) for term in terms for _ in range(robot.n)], dtype=torch.bool)
            for name in ("signed", "fraction")
        )
        large, known = (torque * inverse_of(unit)).flatten(), given.flatten()  # as large as the torques; as described
        scale = torch.where(signed, large, torch.where(known > 0, known, SMALL * large))  # zero: nothing moves it
        self.start = scale * estimated.flatten()
        self.effects = self.start.nonzero()[:, 0]
        fraction = (self.start * below_one)[self.effects]
        super().__init__(len(self.links), signed[self.effects], fraction, strength if free else 1.0)
        if free and not self.inertial + len(self.effects):
            raise ArgumentError(f"robot {robot.name!r} has no mass, and there is nothing else to identify")

        k = 10 * len(mass) + len(self.start)
        self.described = torch.zeros(k, dtype=torch.float64)
        pi = self.described[: 10 * len(mass)].reshape(-1, 10)
        pi[massive] = inertial_parameters(factor @ factor.mT)
        rotors = known * torch.tensor([term == ROTOR for term in terms for _ in range(robot.n)])  # estimated or not
        self.described[10 * len(mass) :] = torch.where(self.start > 0, self.start * ~signed, rotors)
        self.zero = torch.cat([self.described[: 10 * len(mass)], rotors])
        self.S = torch.zeros(k, self.inertial + len(self.effects), dtype=torch.float64)
        self.inverse = torch.zeros_like(self.S).T  # y of a change of phi
        C = self.factor[:, None]
        blocks = inertial_parameters(C @ BASIS @ C.mT).mT / self.strength**0.5  # [links, 10 parameters, 10 entries]
        for i, link in enumerate(self.links.tolist()):
            own, columns = slice(10 * i, 10 * i + 10), slice(10 * link, 10 * link + 10)
            self.S[columns, own], self.inverse[own, columns] = blocks[i], torch.linalg.inv(blocks[i])
        at, to = self.inertial + torch.arange(len(self.effects)), 10 * len(mass) + self.effects
        self.S[to, at], self.inverse[at, to] = self.start[self.effects], 1 / self.start[self.effects]

    def start_of(self, at: Tensor) -> Tensor:
        """Start less the description, whose rotors act and whose friction does not, at places in phi [n, p]."""
        return (self.described - self.zero)[at]

    def at(self, other: "Neighbourhood", y: Tensor) -> Tensor:
        """Coordinates [..., t] here of y [..., s] in another neighbourhood; coefficients it lacks have their size."""
        phi = other.described + y @ other.S.T
        found, b = (phi - self.described) @ self.inverse.T, self.inertial
        coefficients = phi[..., phi.shape[-1] - len(self.start) :][..., self.effects]
        return torch.cat([found[..., :b], found[..., b:].where(coefficients != 0, 0.0)], -1)

    def bodies(self, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Mass [n], centre of mass [n, 3] and inertia about it [n, 6] of the links."""
        mass, com, inertia = self.mass.clone(), self.com.clone(), self.inertia.clone()
        found = bodies_of(self.factor @ torch.linalg.cholesky(self._split(y)[0]))
        mass[self.links], com[self.links], inertia[self.links] = found
        return mass, com, inertia


def _factor(mass: Tensor, com: Tensor, inertia: Tensor) -> Tensor:
    """Cholesky factors C [links, 4, 4] of the pseudo-inertias C C^T, of bodies made thick enough to have one."""
    second = second_moments(inertia)  # about the centre of mass
    trace = second.diagonal(dim1=1, dim2=2).sum(-1).clamp_min(0)
    whole = float(((trace + mass * com.square().sum(-1)).sum() / mass.sum()).sqrt()) if len(mass) else 0.0
    size = (trace / mass).sqrt().clamp_min(0.1 * (whole or 1.0))  # [m]
    moments, axes = torch.linalg.eigh(second)
    thick = moments.maximum((mass * (THIN * size) ** 2)[:, None])
    changed = (thick != moments).any(-1)
    second = torch.where(changed[:, None, None], (axes * thick[:, None]) @ axes.mT, second)
    C = torch.zeros(len(mass), 4, 4, dtype=torch.float64)
    C[:, 0, 0] = mass.sqrt()
    C[:, 1:, 0] = mass.sqrt()[:, None] * com
    C[:, 1:, 1:] = torch.linalg.cholesky(second)
    return C
