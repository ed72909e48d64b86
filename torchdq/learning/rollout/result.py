"""Result of a fit of rollouts: the scene, its parameters with standard errors, and what is not identifiable."""

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchdq.base.tables import summary, table
from torchdq.learning.rollout.problem import End
from torchdq.learning.rollout.unknowns import changed
from torchdq.scene.scene import Scene

IDENTIFIABLE = 1.0  # greatest standard error of an identifiable combination, relative to the sizes of its parameters
PART = 0.05  # part of an unidentifiable combination from which a parameter is unidentifiable, too


class RolloutFit(NamedTuple):
    """Scene that moves as recorded, and how well its parameters are known.

    An unidentifiable parameter is NaN in `values` and `errors`; in `scene` it is where the others are best while it
    stays near its start. `unidentifiable` names changes of parameters that do not change the recorded motions. Where
    the scene does not come to move as recorded, all are NaN, and `warning` says so.

    The standard errors are those of independent errors of the measurements, and of steps that are too long. Errors of
    the scene are not among them: where residuals are correlated, the parameters are less certain than they say.
    """

    scene: Scene  # with the steps of the fit, a choice for accuracy; `replace` gives it those for simulation
    values: dict[str, Tensor]  # by name in `learn`; NaN where unidentifiable
    errors: dict[str, Tensor]  # standard errors of the values; NaN where unidentifiable
    names: tuple[str, ...]  # [p] of single numbers, such as "Viscous.coefficient[elbow]"
    estimate: Tensor  # [p] single numbers, those of the scene
    covariance: Tensor  # [p, p] of the numbers, as far as they are identifiable
    unidentifiable: tuple[str, ...]  # changes of parameters that do not change the motions
    delay: float  # by which the inputs come late [s]; it is not part of the scene
    residuals: tuple[np.ndarray, ...]  # [rows, n] of each log, measured less predicted positions [rad or m]
    noise: Tensor  # [n] standard deviation of the measured positions [rad or m]
    iterations: int
    warning: str  # reason why the parameters may not be the best; "": there is none

    @property
    def rms(self) -> Tensor:
        """Root mean square [n] of the residuals [rad or m]."""
        return torch.from_numpy(np.sqrt(np.square(np.concatenate(self.residuals)).mean(axis=0)))

    def __repr__(self) -> str:
        known = sum(int(x.isfinite().sum()) for x in self.values.values())
        return f"RolloutFit({self.scene.robot.name}: {known} of {len(self.names)} parameters identified)"

    def __str__(self) -> str:
        values, errors = (torch.cat([x.flatten() for x in part.values()]) for part in (self.values, self.errors))
        known = f"{self.scene.robot.name}, {int(values.isfinite().sum())} of {len(self.names)} parameters identified"
        rows = [
            (name, f"{x:.4g}", f"{e:.2g}") if x == x else (name, "unidentifiable", "-")
            for name, x, e in zip(self.names, values.tolist(), errors.tolist(), strict=True)
        ]
        title = f"{known}\nby steps of {self.scene.dt / self.scene.substeps:.4g} s with {self.scene.integrator}"
        parts = [title, table(("parameter", "estimate", "standard error"), rows)]
        if self.unidentifiable:
            parts.append("\n".join(("unidentifiable changes:", *self.unidentifiable)))
        parts.append(summary("residual", {"rms": (self.rms, "rad or m"), "noise": (self.noise, "rad or m")}))
        return "\n\n".join(parts)


def result(end: End, warning: str, followed: bool) -> RolloutFit:
    """Result of a search; `followed`: whether the scene moves from state to state at its end."""
    problem, at, linear = end.problem, end.at, end.linear
    unknowns, p = problem.unknowns, len(at.values)
    sizes = unknowns.each("sizes", at.values)
    R = problem.information(at, linear)[:p, :p] * sizes  # in changes relative to the sizes
    _, e, V = np.linalg.svd(R)
    identifiable = (e > 1 / IDENTIFIABLE) & (e > 1e-10 * e[0])
    # standard errors that shorter steps do not contradict
    spread = math.sqrt(1 + end.shift**2) * sizes[:, None] * V[identifiable].T / e[identifiable]
    slopes = unknowns.slopes(at.values)
    covariance = slopes @ spread @ spread.T @ slopes.T
    hidden = (V[~identifiable] * sizes) @ slopes.T / unknowns.each("scales", at.values)
    known = (np.square(hidden).sum(0) < PART**2) & followed
    values, errors = (np.where(known, x, np.nan) for x in (at.values, np.sqrt(covariance.diagonal())))
    n, pieces = problem.pieces.n, problem.pieces
    residuals = tuple(np.zeros(log.q.shape) for log in problem.logs)
    for k, rows, found in zip(pieces.log, pieces.row, at.motions.residual, strict=True):
        residuals[k][rows[rows >= 0]] = found[rows >= 0, :n]

    return RolloutFit(
        changed(problem.scene, unknowns.parameters(at.values)),
        unknowns.by_name(values),
        unknowns.by_name(errors),
        unknowns.labels,
        torch.from_numpy(at.values),
        torch.from_numpy(covariance),
        _combinations(hidden, unknowns.labels),
        unknowns.delay(at.values),
        residuals,
        torch.from_numpy(problem.noise(at)[:n]),
        end.steps,
        warning,
    )


def _combinations(V: np.ndarray, labels: tuple[str, ...]) -> tuple[str, ...]:
    """Changes that span the rows of V [k, p], each of few parameters, in percent of their sizes."""
    rows, found = V.copy(), []
    for k in range(len(rows)):
        best, lead = divmod(int(abs(rows[k:]).argmax()), rows.shape[1])
        if abs(rows[k + best, lead]) < PART:  # what is left changes nothing
            rows = rows[:k]
            break
        rows[[k, k + best]] = rows[[k + best, k]]
        rows[k] = rows[k] / rows[k, lead]
        others = [i for i in range(len(rows)) if i != k]
        rows[others] -= rows[others, lead][:, None] * rows[k]
    for row in rows:
        terms = [(label, float(x)) for label, x in zip(labels, row, strict=True) if abs(x) > PART]
        found.append(", ".join(f"{label} by {100 * x:+.3g} %" for label, x in terms))
    return tuple(found)
