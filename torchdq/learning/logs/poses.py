"""Static poses of a log, each approached from both sides, so that dry friction cancels."""

from typing import NamedTuple

import numpy as np
import torch

from torchdq.base.checks import require_number, require_object
from torchdq.base.tables import summary
from torchdq.findings import Finding
from torchdq.learning.logs.errors import LogError
from torchdq.learning.logs.motions import AT_REST
from torchdq.learning.logs.read import Log
from torchdq.learning.logs.samples import Samples

SETTLED = 0.5  # part of a rest that is averaged, its last: vibrations have died away
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


def static_poses(log: Log, seconds: float = 1.0, near: float = 0.01) -> StaticPoses:
    """Poses that a log rests at, approached by every joint from below and from above, as `StaticPoses`.

    A joint that stops is held by any torque within its dry friction. Friction opposes the motion that ended: after an
    approach from below it takes as much of the torque as it adds after one from above. The mean is without it.

    Args:
        log: from `read_log`, with torques; poses follow each other in any order, and must be visited twice at least,
            with all joints coming from one side, and from the other.
        seconds: least time at rest [s].
        near: distance of positions up to which poses are the same [rad or m].
    Raises:
        LogError: there are no torques, or no pose is approached from both sides by all joints.

    >>> import numpy as np
    >>> from torchdq.learning import read_log
    >>> time = np.arange(0, 20, 0.01)
    >>> q = 0.5 + 0.5 * np.interp(time, [0, 3, 5, 8, 10, 20], [-1, 0, 0, 1, 0, 0])[:, None]  # comes from 0, and from 1
    >>> side = np.where(time < 5, 1.0, -1.0)[:, None]
    >>> poses = static_poses(read_log({"time": time, "q": q, "qd": None, "tau": 9.81 * np.cos(q) + 2.0 * side}))
    >>> print(f"{float(poses.tau / poses.q.cos()):.4f}, {float(poses.friction):.4f}")
    9.8100, 2.0000
    """
    require_object("log", log, Log, "torchdq.learning", "read_log(path)")
    for name, x in (("seconds", seconds), ("near", near)):
        require_number(name, x, positive=True)
    if log.tau is None:
        raise LogError(Finding("torques.missing", "", "static poses need torques"), where=log.path)
    speed = np.gradient(log.q, log.time, axis=0) if log.qd is None else log.qd
    still = (abs(speed) < AT_REST).all(axis=1)
    ends = np.flatnonzero(np.diff(still, prepend=False, append=False)).reshape(-1, 2)
    rests = [(first, last) for first, last in ends.tolist() if log.time[last - 1] - log.time[first] >= seconds]
    poses: list[tuple[np.ndarray, list[tuple[np.ndarray, np.ndarray]]]] = []  # positions; sides with torques
    before = 0
    for first, last in rests:
        settled = slice(last - max(1, round(SETTLED * (last - first))), last)
        q, tau = log.q[settled].mean(0), log.tau[settled].mean(0)
        came = q - log.q[first - (first - before) // 4]  # in the last quarter of the way from the rest before
        before = last
        same = next((visits for at, visits in poses if (abs(at - q) < near).all()), None)
        if same is None:
            poses.append((q, same := []))
        same.append((np.where(abs(came) > CAME, np.sign(came), 0.0), tau))
    both = [(q, *_sides(visits)) for q, visits in poses]
    whole = [x for x in both if np.isfinite(x[1]).all() and np.isfinite(x[2]).all()]
    if not whole:
        claim = "poses must be approached from both sides by every joint"
        cure = f"visit each pose again after {seconds:g} s elsewhere, with all joints coming from the other side"
        found = f"{len(rests)} rests at {len(poses)} poses"
        raise LogError(Finding("poses.sides", "", claim, found, cure), where=log.path)
    q, up, down = (torch.from_numpy(np.stack(x)) for x in zip(*whole, strict=True))
    return StaticPoses(q, (up + down) / 2, (up - down) / 2)


def _sides(visits: list[tuple[np.ndarray, np.ndarray]]) -> list[np.ndarray]:
    """Mean torques [n] after approaches from below and from above; NaN where there are none."""
    sides, tau = (np.stack(x) for x in zip(*visits, strict=True))
    return [
        np.where(chosen.any(0), (tau * chosen).sum(0) / chosen.sum(0).clip(1), np.nan)
        for chosen in (sides > 0, sides < 0)
    ]
