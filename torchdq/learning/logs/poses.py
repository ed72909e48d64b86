"""Static poses of a log, each approached from both sides, so that dry friction cancels."""

from typing import NamedTuple

import numpy as np
import torch

from torchdq.base.checks import require_number
from torchdq.base.tables import summary
from torchdq.findings import Finding
from torchdq.learning.logs.errors import LogError
from torchdq.learning.logs.samples import Samples

AT_REST = 0.02  # [rad/s or m/s] speed of every joint below which an arm may rest
SETTLED = (0.4, 0.95)  # part of a rest that is averaged: vibrations have died away, and the next motion is yet to begin
SPREAD = 5.0  # distance of a resting arm from its pose, in median distances: beyond it the arm moves
ROUNDS = 20  # of narrowing slow rows down to those at rest
CAME = 1e-4  # least distance that a joint came from to have a side [rad or m]


class StaticPoses(NamedTuple):
    """Poses at which an arm rested, and its torques after approaches from both sides, [poses, n] each."""

    q: torch.Tensor  # [rad or m]
    tau: torch.Tensor  # mean of both sides, which gravity and springs make [N m or N]
    friction: torch.Tensor  # half of their difference, the dry friction [N m or N]

    @property
    def samples(self) -> Samples:
        """Poses as samples at rest, for `identify` and `identify_payload`."""
        return Samples(self.q, torch.zeros_like(self.q), torch.zeros_like(self.q), self.tau)

    def __repr__(self) -> str:
        return summary(
            "StaticPoses", {name: (x, "rad" if name == "q" else "N m") for name, x in self._asdict().items()}
        )


def poses_at_rest(
    path: object,
    time: np.ndarray,
    q: np.ndarray,
    qd: np.ndarray | None,
    tau: np.ndarray | None,
    seconds: float,
    near: float,
) -> StaticPoses:
    """Poses of a log, as `Log.static_poses`."""
    for name, x in (("seconds", seconds), ("near", near)):
        require_number(name, x, positive=True)
    if tau is None:
        raise LogError(Finding("torques.missing", "", "static poses need torques"), where=path)
    speed = np.gradient(q, time, axis=0) if qd is None else qd
    still = (abs(speed) < AT_REST).all(axis=1)
    ends = np.flatnonzero(np.diff(still, prepend=False, append=False)).reshape(-1, 2)
    stops = [_at_rest(q, first, last) for first, last in ends.tolist()]
    lengths = np.array([time[last - 1] - time[first] for first, last in stops])
    rests = [stop for stop, length in zip(stops, lengths, strict=True) if length >= seconds]
    poses: list[tuple[np.ndarray, list[tuple[np.ndarray, np.ndarray]]]] = []  # positions; sides with torques
    before = 0
    for first, last in rests:
        start, end = (first + round(part * (last - first)) for part in SETTLED)
        settled = slice(min(start, end - 1), end)
        pose, torque = q[settled].mean(0), tau[settled].mean(0)
        came = pose - q[first - (first - before) // 4]  # in the last quarter of the way from the rest before
        before = last
        same = next((visits for at, visits in poses if (abs(at - pose) < near).all()), None)
        if same is None:
            poses.append((pose, same := []))
        same.append((np.where(abs(came) > CAME, np.sign(came), 0.0), torque))
    both = [(at, *_sides(visits)) for at, visits in poses]
    whole = [x for x in both if np.isfinite(x[1]).all() and np.isfinite(x[2]).all()]
    if not whole:
        claim = "poses must be approached from both sides by every joint"
        cure = f"visit each pose again after {seconds:g} s elsewhere, with all joints coming from the other side"
        rested = f"{len(rests)} rests at {len(poses)} poses"
        if 2 * len(rests) < len(stops):
            rested += f", and {len(stops) - len(rests)} shorter than {seconds:g} s"
            cure = f"give a smaller seconds, as most rests last {np.median(lengths):.2g} s, or {cure}"
        raise LogError(Finding("poses.sides", "", claim, rested, cure), where=path)
    found, up, down = (torch.from_numpy(np.stack(x)) for x in zip(*whole, strict=True))
    return StaticPoses(found, (up + down) / 2, (up - down) / 2)


def _at_rest(q: np.ndarray, first: int, last: int) -> tuple[int, int]:
    """First row, and the one after the last, in which slow joints rest: smooth motions begin and end as slowly."""
    for _ in range(ROUNDS):
        off = abs(q[first:last] - np.median(q[first:last], axis=0))
        within = np.flatnonzero((off <= SPREAD * np.median(off, axis=0)).all(1))
        if not len(within) or within[-1] - within[0] + 1 == last - first:
            break
        first, last = first + int(within[0]), first + int(within[-1]) + 1
    return first, last


def _sides(visits: list[tuple[np.ndarray, np.ndarray]]) -> list[np.ndarray]:
    """Mean torques [n] after approaches from below and from above; NaN where there are none."""
    sides, tau = (np.stack(x) for x in zip(*visits, strict=True))
    return [
        np.where(chosen.any(0), (tau * chosen).sum(0) / chosen.sum(0).clip(1), np.nan)
        for chosen in (sides > 0, sides < 0)
    ]
