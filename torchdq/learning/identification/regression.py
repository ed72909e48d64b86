"""Least squares for the parameters of a robot: the information in samples, gathered in one small matrix per joint.

Joint torques are linear in the parameters phi, tau = Z(q, qd, qdd) phi, so that the sums of [Z tau]^T [Z tau] hold all
that the samples say, however many there are. A joint depends on the inertial parameters of all links and on its own
terms alone; its columns are those [p], and `places` says where they are in phi [k].
"""

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchdq.functional import regressor
from torchdq.learning.evaluation.blocks import MotionRows
from torchdq.learning.identification.base_parameters import inverse_of
from torchdq.learning.identification.feasible import Neighbourhood
from torchdq.robot import Robot

COARSE = 1e-2  # least noise relative to the joint's torques, where there are too few samples to estimate it
EXACT = 1e-5  # least noise relative to the joint's torques otherwise; more weight costs more digits than it gives
FREE = 0.25  # least part of the samples that are not spent on parameters: the joint's noise would have no bound
CHUNK = 2**22  # numbers of the regressor that are held at a time


def places(links: int, terms: int, joints: int) -> Tensor:
    """Places in phi of the parameters of each joint [n, p]."""
    inertial = torch.arange(10 * links).expand(joints, -1)
    own = 10 * links + joints * torch.arange(terms) + torch.arange(joints)[:, None]
    return torch.cat([inertial, own], 1)


def parted(robot: Robot, phi: Tensor) -> tuple[Tensor, Tensor]:
    """Inertial parameters [..., 10 links] and coefficients [..., terms, n] of parameters [..., k]."""
    bodies = 10 * len(robot.link_names)
    return phi[..., :bodies], phi[..., bodies:].unflatten(-1, (-1, robot.n))


def columns(robot: Robot, q: Tensor, qd: Tensor, qdd: Tensor, own: Tensor) -> Tensor:
    """Torque per unit of every parameter of each joint [rows, n, p]; `own` [rows, n, terms] is that of its terms."""
    Y = regressor(robot, q, qd, qdd)
    return torch.cat([Y, own], -1) if own.shape[-1] else Y


def by_chunks(robot: Robot, recording: MotionRows, own: Tensor, numbers: int) -> Iterator[tuple[slice, Tensor]]:
    """Slices of the rows, each small enough for so many numbers per row, with their `columns`."""
    size = max(1, CHUNK // max(1, numbers))
    for i in range(0, len(own), size):
        part = slice(i, min(i + size, len(own)))
        yield part, columns(robot, recording.q[part], recording.qd[part], recording.qdd[part], own[part])


def rigid(robot: Robot, recording: MotionRows, pi: Tensor, rotors: Tensor | None) -> Tensor:
    """Torques [rows, n] of bodies with inertial parameters pi [10 links], and of rotors [n]."""
    tau, pi = torch.empty_like(recording.q), pi.to(recording.q)
    for part, Y in by_chunks(robot, recording, tau[..., None][..., :0], robot.n * len(pi)):
        tau[part] = Y @ pi
    return tau if rotors is None else tau + rotors.to(tau) * recording.qdd


def gram(
    robot: Robot,
    recording: MotionRows,
    own: Tensor,
    parts: Sequence[Tensor],
    some: Sequence[int],
    say: Callable[[str], None],
) -> Tensor:
    """Sums [parts, n, p, c] of Z^T Z over parts of the rows, and of all columns by some [c]; see `columns`.

    `say` is called with the number of rows that were read.
    """
    p, read, whole = 10 * len(robot.link_names) + own.shape[-1], 0, sum(map(len, parts))
    sums = recording.q.new_zeros(len(parts), robot.n, p, len(some))
    for found, rows in zip(sums, parts, strict=True):
        for part, Z in by_chunks(robot, recording.some(rows), own[rows], robot.n * p):
            Z = Z.transpose(0, 1)
            found += Z.mT @ (Z if len(some) == p else Z[..., some])
            read += part.stop - part.start
            say(f"{read} of {whole} samples")
    return sums.cpu()


def added(sums: Tensor, at: Tensor) -> Tensor:
    """Sums [..., k + 1, k + 1] of all joints together, in the parameters phi [k], of those of `gram`."""
    k = int(at.max()) + 1
    at = torch.nn.functional.pad(at, (0, 1), value=k)
    found = sums.new_zeros(*sums.shape[:-3], (k + 1) ** 2)
    places = at[:, :, None] * (k + 1) + at[:, None]
    return found.index_add_(-1, places.flatten(), sums.flatten(-3)).unflatten(-1, (k + 1, k + 1))


def shifted(sums: Tensor, change: Tensor) -> Tensor:
    """Sums [..., p + 1, p + 1] about other parameters, which differ by a change [..., p]."""
    found = sums.clone()
    found[..., -1] -= (sums[..., :-1] @ change[..., None])[..., 0]
    found[..., -1, :] -= (change[..., None, :] @ found[..., :-1, :])[..., 0, :]
    return found


def squared(sums: Tensor, change: Tensor) -> Tensor:
    """Sums of squared residuals [..., n] after changes of the parameters [..., n, p]."""
    error = torch.cat([-change, change.new_ones(*change.shape[:-1], 1)], -1)[..., None, :]
    return (error @ sums @ error.mT)[..., 0, 0].clamp_min(0)


class Information(NamedTuple):
    """Sum of e (w - w_0)^2 that the samples add to the cost of y = V w."""

    e: Tensor  # [..., t], zero where they hold no information
    V: Tensor  # [..., t, t]
    w: Tensor  # [..., t] w_0
    noise: Tensor  # [n] standard deviation by which the joints are weighted [N m or N]


def information(
    sums: Tensor,  # [n, p + 1, p + 1] by `gram`, each divided by the correlation time of its joint's residuals
    S: Tensor,  # [n, p, t] changes of the parameters of each joint per unit of y
    squares: Tensor,  # [n] mean squares of the torques
    floor: Tensor,  # [n] least noise
    samples: Tensor,  # [n] number of independent samples
) -> Information:
    """Least squares with joints weighted by their noise, which follow from each other (restricted maximum likelihood).

    The noise divides by the samples less the parameters they were spent on. A joint's share of those is its part of the
    trace of the matrix that takes measured torques to fitted ones.
    """
    A, b, c = S.mT @ sums[:, :-1, :-1] @ S, (sums[:, -1:, :-1] @ S)[:, 0], sums[:, -1, -1]
    squares = squares.clamp_min(1e-6 * float(squares.max()))
    squares = torch.where(squares > 0, squares, 1.0)  # torques that vanish: any weight will do
    # which combinations are identifiable does not depend on the weights, and is clearest where they differ least
    e, Q = torch.linalg.eigh((A / squares[:, None, None]).sum(0))
    identifiable = e > 1e-13 * e[-1:]  # beyond rounding
    P, unknown = Q[:, identifiable], Q[:, ~identifiable]
    A, b = P.T @ A @ P, b @ P
    least = squares * (EXACT if float(samples.sum()) >= 2 * P.shape[1] else COARSE) ** 2
    least = least.maximum(floor**2)
    variance = (c / samples).maximum(least)
    for _ in range(50):
        e, V = torch.linalg.eigh((A / variance[:, None, None]).sum(0))
        inverse = (V / (e.clamp_min(0) + 1e-3)) @ V.T  # a prior that is negligible against a few samples
        y = inverse @ (b / variance[:, None]).sum(0)
        left = (c - 2 * b @ y + (A @ y) @ y).clamp_min(0)
        spent = (A * inverse).sum((1, 2)) / variance
        before, variance = variance, (left / (samples - spent).maximum(FREE * samples)).maximum(least)
        if float((variance / before - 1).abs().max()) < 1e-3:
            break
    e, V, w = _solved((A / variance[:, None, None]).sum(0), (b / variance[:, None]).sum(0))
    none = e.new_zeros(unknown.shape[1])
    return Information(torch.cat([none, e]), torch.cat([unknown, P @ V], 1), torch.cat([none, w]), variance.sqrt())


def known(sums: Tensor, near: Neighbourhood, variance: Tensor, at: Tensor) -> Information:
    """Least squares of sums about the description, with joints weighted by known noise."""
    H = added(sums / variance[:, None, None], at)
    H = shifted(H, near.described - near.zero)
    used = near.S.any(1)  # others are not estimated
    S, used = near.S[used], torch.cat([used, used.new_ones(1)])
    H = H[..., used, :][..., used]
    return Information(*_solved(S.T @ H[..., :-1, :-1] @ S, H[..., -1, :-1] @ S), variance.sqrt())


def _solved(A: Tensor, b: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Eigenvalues e and eigenvectors V of A [..., t, t], and w such that y = V w is a solution of A y = b."""
    e, V = torch.linalg.eigh(A)
    e = torch.where(e > 1e-15 * e[..., -1:], e, 0.0)
    return e, V, (b[..., None, :] @ V)[..., 0, :] * inverse_of(e)
