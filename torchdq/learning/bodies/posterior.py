"""Robots drawn from what recordings leave open about one: for training on all that it may be.

Base parameters are drawn from the normal distribution with the covariance of `Identified`. In other directions a mass
might come out negative, so each link is drawn as J' = C exp(s) C^T, with the pseudo-inertia J = C C^T found and s the
drawn change of J in its own axes: to first order the same, and positive definite always. Then the robot is found that
has the drawn base parameters, kappa (base phi - drawn)^T covariance^-1 (base phi - drawn) being small, and is nearest
to these bodies (`nearest`).
"""

from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchdq.base.checks import require_count, require_number, require_object
from torchdq.base.progress import Progress
from torchdq.base.tables import summary
from torchdq.effects import Effect
from torchdq.learning.identification.identified import Identified, coefficients_of, effects_of, friction_of
from torchdq.learning.identification.regression import parted
from torchdq.learning.identification.solution import nearest, of_numbers
from torchdq.learning.identification.terms import ROTOR
from torchdq.learning.threads import one_thread
from torchdq.robot import Robot
from torchdq.robot.pseudo_inertia import BASIS, bodies_of, inertial_parameters, pseudo_inertia, relative

KAPPA = 100.0  # weight of the base parameters: so many times that of the bodies that are drawn
TOGETHER = 256  # robots at a time
DTYPE = torch.float64


class PosteriorSamples(NamedTuple):
    """Robots drawn from the posterior of an identification, as one robot with a batch axis, and their friction."""

    robot: Robot  # [samples] in mass, com, inertia and, if it was estimated, armature
    parameters: Tensor  # [samples, k], as in `Identified`
    identified: Identified  # whose posterior they are drawn from

    def __repr__(self) -> str:
        return summary(f"PosteriorSamples {self.robot.name}", {"mass": (self.robot.mass, "kg")})

    def coefficients(self, kind: str) -> Tensor | None:
        """Coefficients [samples, n] of the joints, of one kind as in `Identified.coefficients`; None: not estimated."""
        return coefficients_of(self.robot, self.identified.terms, self.parameters, kind)

    def effects(self) -> tuple[Effect, ...]:
        """Gravity, rotor inertia and all friction found, a row per robot, as effects of a scene.

        Constant torques are not among them: add `coefficients("offset")` to the scene's torques.
        """
        numbers = parted(self.robot, self.parameters)[1].unbind(1)
        return effects_of(self.robot, friction_of(self.identified.terms, numbers, self.identified.sign_width))


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
    >>> tau = torchdq.inverse_dynamics(robot, q, qd, qdd) + 0.1 * torch.randn_like(q)
    >>> plain = Model(friction=(effects.Viscous(), effects.Coulomb()))
    >>> found = identify(robot, Samples(q, qd, qdd, tau), plain, prior=1.0)
    >>> drawn = posterior_samples(found, 16)
    >>> drawn.robot.mass.shape, bool((drawn.robot.mass > 0).all()), len(drawn.effects())
    (torch.Size([16, 2]), True, 3)
    """
    require_object("identified", identified, Identified, "torchdq.learning", "identify(robot, motions)")
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
    parameters, J = (torch.cat(part) for part in zip(*parts, strict=True))
    robot, terms, changes = identified.robot, identified.terms, dict[str, Any]()
    for name, x in zip(("mass", "com", "inertia"), bodies_of(torch.linalg.cholesky(J)), strict=True):
        before = getattr(robot, name).double()
        changes[name] = torch.index_copy(before.expand(n, *before.shape), 1, space.links, x)
    if (rotors := coefficients_of(robot, terms, parameters, ROTOR.name)) is not None:
        changes["armature"] = rotors
    drawn = robot.replace(**{name: x.to(robot.mass) for name, x in changes.items()})
    return PosteriorSamples(drawn, parameters, identified)


class _Space:
    """Coordinates y [samples, t] around drawn bodies and coefficients: ten per link with mass, one per coefficient."""

    def __init__(self, identified: Identified, most: float):
        n, bodies = identified.robot.n, 10 * len(identified.robot.link_names)
        self.F, self.phi, base = (x.double() for x in (identified.spread, identified.parameters, identified.base))
        pi, own = self.phi[:bodies].reshape(-1, 10), self.F[:bodies].unflatten(0, (-1, 10))
        self.links = ((pi[:, 0] > 0) & (own != 0).any(-1).any(-1)).nonzero()[:, 0]
        self.bodies = (10 * self.links[:, None] + torch.arange(10)).flatten()
        self.C = torch.linalg.cholesky(pseudo_inertia(pi[self.links]))
        # change of each link in its own axes per draw [links, 4, 4, t], whose greatest width is bounded
        inverse, change = torch.linalg.inv(self.C), pseudo_inertia(own[self.links].mT)
        change = torch.einsum("lij,ltjk,lmk->limt", inverse, change, inverse)
        self.most, least = most, max(most, 1e-300)
        width = torch.linalg.matrix_norm(change.flatten(1, 2), 2)
        self.change = change * (most / width.clamp_min(least))[:, None, None, None]
        kinds = [(term.signed, term.fraction) for term in identified.terms for _ in range(n)]
        signed, fraction = torch.tensor(kinds, dtype=torch.bool).reshape(-1, 2).T
        estimated, positive = self.F[bodies:].norm(dim=1) > 0, ~signed & (self.phi[bodies:] > 0)
        chosen = estimated & positive, estimated & ~positive, fraction
        self.positive, self.signed, self.fraction = (x.nonzero()[:, 0] + bodies for x in chosen)
        # whitening of the base parameters, whose errors may differ by many powers of ten
        BF = base @ self.F
        size = BF.norm(dim=1)
        R = torch.linalg.qr((BF / size[:, None]).T).R
        self.white = KAPPA**0.5 * torch.linalg.solve_triangular(R.T, base / size[:, None], upper=False)

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
        links, at = len(self.links), torch.cat([self.positive, self.signed])
        white = self.white[:, self.bodies].unflatten(1, (links, 10))
        scale = torch.cat([phi[:, self.positive], self.F[self.signed].norm(dim=1).expand(len(draws), -1)], 1)
        bodies = torch.einsum("rlp,nlep->nrle", white, blocks).flatten(2)
        A = torch.cat([bodies, self.white[:, at] * scale[:, None]], -1)
        offset = (phi - self.phi - gaussian) @ self.white.T
        y = nearest(of_numbers(links, len(self.positive), len(self.signed)), A, offset)
        J = C @ relative(y[:, : 10 * links].unflatten(1, (links, 10))) @ C.mT
        phi[:, self.bodies] = inertial_parameters(J).flatten(1)
        phi[:, at] += scale * y[:, 10 * links :]
        phi[:, self.fraction] = phi[:, self.fraction].clamp_max(0.99)  # such as friction over load
        return phi, J
