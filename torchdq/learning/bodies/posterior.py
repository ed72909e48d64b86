"""Robots drawn from what recordings leave open about one: for training on all that it may be.

In the identifiable directions, the base parameters, a draw is one of the normal distribution with the covariance of
`Identified`. In the others, that distribution knows nothing of bodies: a mass may come out negative. So each link is
drawn as J' = C exp(s) C^T, with the pseudo-inertia J = C C^T found and s the symmetric matrix that is the drawn change
of J in its own axes: to first order the same, and positive definite always. Then the robot is found that has the drawn
base parameters, kappa (base phi - drawn)^T covariance^-1 (base phi - drawn) being small, and is nearest to these bodies
(`nearest`).
"""

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchdq.base.checks import require_count, require_number
from torchdq.base.progress import Progress
from torchdq.base.tables import summary
from torchdq.effects import Effect, Gravity, RotorInertia
from torchdq.errors import ArgumentError
from torchdq.learning.bodies.nearest import nearest
from torchdq.learning.identification.identified import Identified, coefficients_of
from torchdq.learning.identification.regression import parted
from torchdq.learning.identification.terms import ROTOR, Term
from torchdq.learning.threads import one_thread
from torchdq.robot import Robot
from torchdq.robot.pseudo_inertia import BASIS, bodies_of, inertial_parameters, pseudo_inertia, relative

KAPPA = 100.0  # weight of the base parameters: so many times that of the bodies that are drawn
MOST = 0.99  # most of a number that is below one, such as friction over load
TOGETHER = 256  # robots at a time
DTYPE = torch.float64


class PosteriorSamples(NamedTuple):
    """Robots drawn from the posterior of an identification, as one robot with a batch axis, and their friction."""

    robot: Robot  # [samples] in mass, com, inertia and, if it was estimated, armature
    terms: tuple[Term, ...]  # kinds of the parameters that are not those of bodies
    names: tuple[str, ...]  # [k]
    parameters: Tensor  # [samples, k], as in `Identified`
    sign_width: float  # velocity below which dry friction is viscous [rad/s or m/s]

    def __repr__(self) -> str:
        return summary(f"PosteriorSamples {self.robot.name}", {"mass": (self.robot.mass, "kg")})

    def coefficients(self, kind: str) -> Tensor | None:
        """Coefficients [samples, n] of the joints, of one kind as in `Identified.coefficients`; None: not estimated."""
        return coefficients_of(self.robot, self.terms, self.parameters, kind)

    def effects(self) -> tuple[Effect, ...]:
        """Gravity, rotor inertia and all friction found, a row per robot, as effects of a scene.

        Constant torques are not among them: `coefficients("offset")` is added to the torques of the scene.
        """
        rotors = () if self.robot.armature is None else (RotorInertia(),)
        rows = zip(self.terms, parted(self.robot, self.parameters)[1].unbind(1), strict=True)
        friction = (effect for term, numbers in rows for effect in term.found(numbers, self.sign_width))
        return (Gravity(), *rotors, *friction)


@one_thread()
def posterior_samples(identified: Identified, n: int, most: float = 1.0, seed: int = 0) -> PosteriorSamples:
    """Robots drawn from the posterior of `identify`, each of which can exist, with their friction.

    Base parameters have the mean and the covariance found; what is not identifiable has the width that the prior
    leaves it, as a factor: exp(normal number).

    Args:
        identified: from `identify`.
        n: number of robots.
        most: greatest standard deviation of a link's relative change where it is not identifiable: 1 is a mass that
            is e times as large or as small; 0 leaves all as found that the base parameters allow.
        seed: seed of the draws.

    Raises:
        ArgumentError: an argument is of another type or not positive.

    >>> import torchdq
    >>> from torchdq import effects
    >>> from torchdq.learning import Model, Samples, identify
    >>> robot = torchdq.robots.load("two_link")
    >>> q, qd, qdd = torch.randn(3, 200, 2, dtype=torch.float64)
    >>> tau = torchdq.inverse_dynamics(robot, q, qd, qdd) + 0.1 * torch.randn(200, 2, dtype=torch.float64)
    >>> plain = Model(friction=(effects.Viscous(), effects.Coulomb()))
    >>> drawn = posterior_samples(identify(robot, Samples(q, qd, qdd, tau), plain, prior=1.0), 16)
    >>> drawn.robot.mass.shape, bool((drawn.robot.mass > 0).all()), len(drawn.effects())
    (torch.Size([16, 2]), True, 3)
    """
    if not isinstance(identified, Identified):
        raise ArgumentError(f"identified must be what identify returns, found {type(identified).__name__}")
    require_count("n", n)
    require_number("most", most, least=0.0)
    require_count("seed", seed, 0)
    generator = torch.Generator().manual_seed(seed)
    draws = torch.randn(n, identified.spread.shape[1], dtype=DTYPE, generator=generator)
    with torch.no_grad(), Progress(f"drawing robots from {identified.robot.name}") as notice:
        space = _Space(identified, most)
        parts = []
        for i in range(0, n, TOGETHER):
            notice.at(f"{i} of {n}")
            parts.append(space.nearest(draws[i : i + TOGETHER]))
    parameters = torch.cat([part[0] for part in parts])
    bodies = bodies_of(torch.linalg.cholesky(torch.cat([part[1] for part in parts])))
    robot, changes = identified.robot, dict[str, Any]()
    for name, x in zip(("mass", "com", "inertia"), bodies, strict=True):
        before = getattr(robot, name).double()
        changes[name] = torch.index_copy(before.expand(n, *before.shape), 1, space.links, x)
    drawn = PosteriorSamples(robot, identified.terms, identified.names, parameters, identified.sign_width)
    if (rotors := drawn.coefficients(ROTOR.name)) is not None:
        changes["armature"] = rotors
    return drawn._replace(robot=robot.replace(**{name: x.to(robot.mass) for name, x in changes.items()}))


class _Space:
    """Coordinates y [samples, t] around drawn bodies and coefficients: ten per link with mass, one per coefficient."""

    def __init__(self, identified: Identified, most: float):
        F, phi = identified.spread.double(), identified.parameters.double()
        bodies = 10 * len(identified.robot.link_names)
        self.phi, self.F, self.base = phi, F, identified.base.double()
        pi, own = phi[:bodies].reshape(-1, 10), F[:bodies].unflatten(0, (-1, 10))
        self.links = ((pi[:, 0] > 0) & (own != 0).any(-1).any(-1)).nonzero()[:, 0]
        self.C = torch.linalg.cholesky(pseudo_inertia(pi[self.links]))
        # change of each link in its own axes per draw [links, 4, 4, t], whose greatest width is bounded
        change = pseudo_inertia(own[self.links].mT).movedim(1, -1)
        inverse = torch.linalg.inv(self.C)
        change = torch.einsum("lij,ljkt,lmk->limt", inverse, change, inverse)
        width = torch.linalg.matrix_norm(change.flatten(1, 2), 2)
        self.change = change * (most / width.clamp_min(most))[:, None, None, None] if most else 0 * change
        rest = F[bodies:].norm(dim=1)
        signed = [term.signed for term in identified.terms for _ in range(identified.robot.n)]
        positive = ~torch.tensor(signed, dtype=torch.bool) & (phi[bodies:] > 0)
        self.positive = (positive & (rest > 0)).nonzero()[:, 0] + bodies
        self.signed = (~positive & (rest > 0)).nonzero()[:, 0] + bodies
        fraction = [term.fraction for term in identified.terms for _ in range(identified.robot.n)]
        self.fraction = torch.tensor(fraction, dtype=torch.bool).nonzero()[:, 0] + bodies
        self.bodies = (10 * self.links[:, None] + torch.arange(10)).flatten()
        self.most = most
        # whitening of the base parameters, whose errors may differ by many powers of ten
        BF = self.base @ F
        size = BF.norm(dim=1)
        R = torch.linalg.qr((BF / size[:, None]).T).R
        self.white = torch.linalg.solve_triangular(R.T, self.base / size[:, None], upper=False)

    def nearest(self, draws: Tensor) -> tuple[Tensor, Tensor]:
        """Parameters [samples, k] and pseudo-inertias [samples, links, 4, 4] of robots that can exist."""
        gaussian = draws @ self.F.T
        s = torch.einsum("limt,nt->nlim", self.change, draws)
        C = torch.linalg.cholesky(self.C @ torch.linalg.matrix_exp((s + s.mT) / 2) @ self.C.mT)
        phi = self.phi.repeat(len(draws), 1)
        phi[:, self.bodies] = inertial_parameters(C @ C.mT).flatten(1)
        ratio = gaussian[:, self.positive] / self.phi[self.positive]
        width = self.F[self.positive].norm(dim=1) / self.phi[self.positive]
        phi[:, self.positive] *= (ratio * (self.most / width.clamp_min(max(self.most, 1e-300)))).exp()
        phi[:, self.signed] += gaussian[:, self.signed]

        blocks = inertial_parameters(torch.einsum("nlij,ejk,nlmk->nleim", C, BASIS, C))  # [samples, links, entries, 10]
        count, links = len(draws), len(self.links)
        A = self.white.new_zeros(count, len(self.white), 10 * links + len(self.positive) + len(self.signed))
        white = self.white[:, self.bodies].reshape(len(self.white), links, 10)
        A[..., : 10 * links] = torch.einsum("rlp,nlep->nrle", white, blocks).flatten(2)
        at = torch.cat([self.positive, self.signed])
        scale = torch.cat([phi[:, self.positive], self.F[self.signed].norm(dim=1).expand(count, -1)], 1)
        A[..., 10 * links :] = self.white[:, at] * scale[:, None]
        offset = (phi - self.phi - gaussian) @ self.white.T
        y = nearest(math.sqrt(KAPPA) * A, math.sqrt(KAPPA) * offset, links, len(self.positive))
        J = C @ relative(y[:, : 10 * links].unflatten(1, (links, 10))) @ C.mT
        phi[:, self.bodies] = inertial_parameters(J).flatten(1)
        phi[:, at] += scale * y[:, 10 * links :]
        phi[:, self.fraction] = phi[:, self.fraction].clamp_max(MOST)
        return phi, J
