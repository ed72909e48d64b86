"""Identified robot: the parameters that explain recorded torques, their errors, and what to do with them."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import compress
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchdq import effects
from torchdq.base.checks import tensor_of
from torchdq.base.tables import summary, table
from torchdq.effects.effect import Effect
from torchdq.effects.friction import Friction
from torchdq.effects.steady import at_speeds
from torchdq.errors import ArgumentError
from torchdq.findings import Finding
from torchdq.learning.evaluation.blocks import MotionRows, of_motions, of_tensors
from torchdq.learning.identification.base_parameters import base_names
from torchdq.learning.identification.gains import RESTS, Gains
from torchdq.learning.identification.model_selection import ModelSelection
from torchdq.learning.identification.regression import by_chunks, parted, places, rigid
from torchdq.learning.identification.terms import COULOMB, OFFSET, ROTOR, VISCOUS, Term, at_rest, rows_of, unit_torques
from torchdq.learning.logs.motions import Motion
from torchdq.nn import InverseDynamics
from torchdq.robot import Robot

INERTIAL = ("m", "mx", "my", "mz", "Ixx", "Ixy", "Iyy", "Ixz", "Iyz", "Izz")  # parameters of a link, about its frame
FORCE = "N m or N"
PARAMETERS = ("parameter", "estimate", "standard error", "unit", "identifiable")  # heads of tables
FRICTION = ("joint", "at rest", "at 0.1", "at the fastest", "fastest [rad/s or m/s]")
STATED = "friction at rest, at 0.1 rad/s or m/s, and at the fastest recorded speed [N m or N]"
NUMBERED = "numbers in names are speeds [rad/s or m/s], after lugre deflections [rad or m]"
BASE = ("base parameter", "estimate", "standard error", "unit of the first")
GAINS = ("joint", "torque per unit of effort", "standard error", "identifiable")
UNITS = ("kg", *["kg m"] * 3, *["kg m^2"] * 6)


class Prediction(NamedTuple):
    """Torques with their standard errors and intervals, each [..., n]."""

    tau: Tensor  # [N m or N]
    error: Tensor  # [N m or N], of the parameters and of the model; noise comes on top
    low: Tensor  # [N m or N], end of the interval that holds 95 % of measured torques
    high: Tensor  # [N m or N]

    def __repr__(self) -> str:
        return summary("Prediction", {name: (x, FORCE) for name, x in self._asdict().items()})


class Identified(NamedTuple):
    """Identified robot with its parameters and their errors.

    `parameters` are phi [k] with the names `names`: ten per link in the order of `Robot.inertial_parameters`, then
    those of the `terms`, of all joints each. The samples identify `rank` combinations of them, the base parameters
    `base` @ `parameters`.

    `covariance` [k, k] is that of the least squares with the prior, linearised at the description, for noise of the
    found size; as many rows as `correlation` says count as one. Where gains of the drives were estimated, it includes
    their errors, and `by_these_gains` leaves them out. Parameters that the samples do not identify, as most single
    masses and inertias, have the width of the prior instead, the described size over sqrt(prior), right as long as the
    description is not off by more; that the robot must be physical is not counted. `identifiable` is false for them.

    Printed, it is a table of the parameters.
    """

    robot: Robot  # baked; its damping, friction and rotor inertia are those found
    terms: tuple[Term, ...]  # kinds of the parameters that are not those of bodies
    names: tuple[str, ...]  # [k] names of the parameters
    parameters: Tensor  # [k]
    spread: Tensor  # [k, t] F, the covariance being F F^T: exact where huge errors cancel in a combination
    base: Tensor  # [rank, k]: each row one parameter and those that the samples cannot separate from it
    noise: Tensor  # [n] standard deviation of a torque's residual, by which the joints were weighted [N m or N]
    model: Tensor  # [n] standard deviation of what the model has no term for, as blocks left out show [N m or N]
    half_width: Tensor  # [n] half-width of the intervals of `predict`, in units of errors of parameters and noise
    rms: Tensor  # [n] root mean square of the residual torque [N m or N]
    correlation: Tensor  # [n] correlation time of the residual torque, in rows
    sign_width: float  # width of the Coulomb friction [rad/s or m/s]
    fastest: Tensor  # [n] largest speed in the samples [rad/s or m/s]
    simple: Tensor  # [2, n] viscous and Coulomb friction that come nearest to all friction found, in these samples
    identifiable: Tensor  # [k] bool: parameters that the samples decide, not the prior; false if the joint hardly moves
    selection: ModelSelection | None  # how the model was chosen; None: it was given, or there are too few rows
    gains: Gains | None  # torque per unit of `tau`, by which it was multiplied; None: not estimated
    findings: tuple[Finding, ...] = ()  # what is probably wrong in the motions or missing in the model

    def coefficients(self, name: str) -> Tensor | None:
        """Parameters [n] of the joints of one kind: "rotor", "viscous", "coulomb", "offset"; None: not estimated."""
        return coefficients_of(self.robot, self.terms, self.parameters, name)

    @property
    def viscous(self) -> Tensor | None:
        """Viscous friction [n] [N m s/rad or N s/m]; None: not estimated."""
        return self.coefficients(VISCOUS.name)

    @property
    def coulomb(self) -> Tensor | None:
        """Coulomb friction [n] [N m or N]; None: not estimated."""
        return self.coefficients(COULOMB.name)

    @property
    def offset(self) -> Tensor | None:
        """Constant torques [n] [N m or N]; None: not estimated."""
        return self.coefficients(OFFSET.name)

    @property
    def rank(self) -> int:
        """Number of combinations of parameters that the samples identify."""
        return len(self.base)

    @property
    def unidentifiable(self) -> tuple[str, ...]:
        """Inertial parameters that the samples do not identify one by one, a line per link: "link2: m, mx"."""
        rows = self.identifiable[: 10 * len(self.robot.link_names)].reshape(-1, 10).tolist()
        names = [[name for name, yes in zip(INERTIAL, row, strict=True) if not yes] for row in rows]
        return tuple(
            f"{link}: {'all' if len(some) == 10 else ', '.join(some)}"
            for link, some in zip(self.robot.link_names, names, strict=True)
            if some
        )

    @property
    def covariance(self) -> Tensor:
        """Covariance of the parameters [k, k]; see the class for what it means."""
        return self.spread @ self.spread.T

    @property
    def errors(self) -> Tensor:
        """Standard errors of the parameters [k]; see the class for what they mean."""
        return self.spread.norm(dim=1)

    def by_these_gains(self) -> Identified:
        """Identified robot with errors as if gains were exact, for torques that are efforts times the same gains."""
        return self if self.gains is None else self._replace(spread=self.spread[:, : -self.robot.n])

    @property
    def base_names(self) -> tuple[str, ...]:
        """Base parameters as sums, `link2 Izz + 0.0825 link3 mx`, of at most three terms; `base_table` has all."""
        return base_names(self.base, self.names, self.errors)

    @property
    def base_errors(self) -> Tensor:
        """Standard errors of the base parameters [rank]."""
        return (self.base @ self.spread).norm(dim=1)

    def base_rows(self) -> list[tuple[str, float, float, str]]:
        """Base parameters, sums of all their terms, with values, standard errors and the units of their first terms."""
        units = [self.units[int((row == 1).int().argmax())] for row in self.base]
        values, errors = (self.base @ self.parameters).tolist(), self.base_errors.tolist()
        return list(zip(base_names(self.base, self.names, self.errors, None), values, errors, units, strict=True))

    @property
    def base_table(self) -> str:
        """Table of the base parameters."""
        return table(BASE, [(name, f"{x:.4g}", f"{e:.2g}", unit) for name, x, e, unit in self.base_rows()])

    def friction(self) -> tuple[Friction, ...]:
        """Friction effects with the numbers found, the same for layers and scenes."""
        return friction_of(self.terms, parted(self.robot, self.parameters)[1].tolist(), self.sign_width)

    def effects(self) -> tuple[Effect, ...]:
        """Effects of a scene of the identified robot: gravity, rotor inertia if there is any, and friction.

        A scene simulates no offset: add `offset` to its torques. A residual network around `layer()` is a further
        effect, `torchdq.effects.Residual`, which brings the offset.

        >>> import torch, torchdq, torchdq.envs
        >>> from torchdq.learning import Samples, identify
        >>> robot = torchdq.robots.load("two_link")
        >>> q, qd, qdd = torch.randn(3, 200, 2, dtype=torch.float64)
        >>> tau = torchdq.inverse_dynamics(robot, q, qd, qdd) + 0.5 * qd
        >>> found = identify(robot, Samples(q, qd, qdd, tau))
        >>> torchdq.Scene(found.robot, found.effects()).robot.name
        'two_link'
        """
        return effects_of(self.robot, self.friction())

    def layer(self, learn: Sequence[str] = ()) -> InverseDynamics:
        """Torques as a module: the robot found, with its friction, the width of dry friction, and the offset.

        A layer has no memory, so it uses the steady-state friction. `Model(memory=False)` selects the best friction
        without memory.

        Args:
            learn: quantities that the layer goes on learning, as in `torchdq.InverseDynamics`; "friction" only if no
                two effects of `friction()` are of one kind.
        """
        friction = _summed([one.steady(self.sign_width) for one in self.friction()])
        learned = tuple(dict.fromkeys([*learn, *(["offset"] if self.offset is not None else [])]))
        layer = InverseDynamics(self.robot, learned, sign_width=self.sign_width, friction=friction)
        if self.offset is not None:
            layer.offset = self.offset
        return layer

    def with_simple_friction(self) -> Robot:
        """Identified robot with the viscous and Coulomb friction nearest to all friction found."""
        damping, friction = self.simple.to(self.robot.damping)
        return self.robot.replace(damping=damping, friction=friction)

    def to_urdf(self, original: Any = None) -> str:
        """URDF text of the robot found: the original with other numbers, as `Robot.to_urdf`.

        Its viscous and Coulomb friction are those of `with_simple_friction`. A `UserWarning` names friction of other
        shapes that they stand for, and rotor inertia and offsets, which have no place in the file. Torques computed
        from the file are wrong by that.

        Args:
            original: the file that the robot was read from, as in `Robot.from_urdf`; None: the text is written from the
                robot alone.
        """
        none = [term.name for term in (ROTOR, OFFSET) if term in self.terms]
        others = [term.name for term in self.terms if term not in (ROTOR, VISCOUS, COULOMB, OFFSET)]
        omitted = [f"a URDF file cannot hold {' and '.join(none)}, left out"] if none else []
        if others:
            stand = "a URDF file holds viscous and Coulomb friction alone; they stand for friction of other shapes, too"
            omitted.append(f"{stand}: {', '.join(others)}")
        if omitted:
            warnings.warn("; ".join(omitted), stacklevel=2)
        return self.with_simple_friction().replace(armature=None).to_urdf(original)

    def __repr__(self) -> str:
        return f"Identified({self.robot.name}: {len(self.names)} parameters, rank {self.rank})"

    def __str__(self) -> str:
        title = f"{self.robot.name}, identified: {len(self.names)} parameters, rank {self.rank}"
        parameters = table(PARAMETERS, [row for rows in self.parameter_rows() for row in rows])
        residuals = summary(
            "residual", {"rms": (self.rms, FORCE), "noise": (self.noise, FORCE), "model": (self.model, FORCE)}
        )
        if self.gains is not None:
            residuals += f"\n\n{table(GAINS, self.gain_rows())}\n{RESTS}"
        selection = "" if self.selection is None else f"\n\n{self.selection}"
        rows = self.friction_rows()
        friction = f"\n{NUMBERED}\n\n{STATED}:\n{table(FRICTION, rows)}" if rows else ""
        return f"{title}\n\n{parameters}{friction}\n\n{residuals}{selection}"

    def friction_rows(self) -> list[tuple[str, ...]]:
        """Joints with the friction found at a few speeds, of all terms together; [] if there is none."""
        fastest, effects = self.fastest.tolist(), [effect.resolved(self.robot) for effect in self.friction()]
        found = at_speeds(effects, self.robot.n, (0.0, 0.1, fastest))
        speeds = [f"{x:.3g}" for x in fastest]
        return list(zip(self.robot.joint_names, *found, speeds, strict=True)) if found else []

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the parameters [k]."""
        slides = [not joint.turns for joint in self.robot.joint_types]
        return (*UNITS * len(self.robot.link_names), *(term.units[joint] for term in self.terms for joint in slides))

    def parameter_rows(self) -> tuple[list[tuple[str, ...]], list[tuple[str, ...]]]:
        """Rows of a table of the parameters of bodies, and of those of joints that are there."""
        bodies = 10 * len(self.robot.link_names)
        found = (x.tolist() for x in (self.parameters, self.errors, self.identifiable))
        numbers = zip(self.names, self.units, *found, strict=True)
        rows: list[tuple[str, ...]] = [
            (name, f"{x:.4g}", f"{e:.2g}", unit, "yes" if known else "no") for name, unit, x, e, known in numbers
        ]
        there = ((self.errors != 0) | (self.parameters != 0))[bodies:]
        return rows[:bodies], [*compress(rows[bodies:], there.tolist())]

    def gain_rows(self) -> list[tuple[str, ...]]:
        """Rows of a table of the gains of the drives; [] if they were not estimated."""
        if self.gains is None:
            return []
        found = zip(self.robot.joint_names, *(x.tolist() for x in self.gains), strict=True)
        return [(name, f"{x:.4g}", f"{error:.2g}", "yes" if shown else "no") for name, x, error, shown in found]

    def predict(
        self, motions: Motion | Sequence[Motion] | Tensor, qd: Tensor | None = None, qdd: Tensor | None = None
    ) -> Prediction:
        """Torques of the identified robot with friction and offset, [..., n], standard errors and intervals.

        The errors are those of the parameters, and those of the model, `model`. The intervals are as wide as they had
        to be to hold 95 % of the measured torques of blocks that were left out, and of a block more; where no model was
        chosen, errors are taken for normal. They are wider at rest, by the dry friction that may hold a joint, and
        where a joint is faster than in the samples. In motions that go elsewhere they hold less.

        Args:
            motions: motions from `smooth`, whose rows follow each other in the result; or joint positions [..., n]
                [rad or m], the last of the leading axes being time, which friction with a memory depends on.
            qd, qdd: joint velocities [rad/s or m/s] and accelerations [rad/s^2 or m/s^2], [..., n], with positions.
        """
        batch, recording = recorded(self.robot, motions, qd, qdd)
        n, at = self.robot.n, places(len(self.robot.link_names), len(self.terms), self.robot.n)
        phi, spread = self.parameters[at], self.spread[at]
        tau, error = torch.empty_like(recording.q), torch.empty_like(recording.q)
        with torch.no_grad():
            pi, loaded = parted(self.robot, self.parameters)[0], any(term.loaded for term in self.terms)
            load = rigid(self.robot, recording, pi, self.robot.armature) if loaded else None
            own = unit_torques(self.terms, rows_of(self.robot, recording, self.sign_width, load))
            for part, Z in by_chunks(self.robot, recording, own, n * spread.shape[1] + spread.numel()):
                tau[part] = torch.einsum("rjp,jp->rj", Z, phi.to(Z))
                error[part] = torch.einsum("rjp,jpt->rjt", Z, spread.to(Z)).norm(dim=-1)
            if ROTOR not in self.terms and self.robot.armature is not None:
                tau += self.robot.armature.to(tau) * recording.qdd
            margin = self.half_width.to(error) * torch.hypot(error, self.noise.to(error))
            margin += self.simple[1].to(error) * at_rest(recording.qd, self.sign_width)
            fastest = self.fastest.where(self.fastest > self.sign_width, torch.inf).to(error)  # inf: it never moved
            margin *= (recording.qd.abs() / fastest).amax(-1, keepdim=True).clamp_min(1)
            error = torch.hypot(error, self.model.to(error))
        return Prediction(*(x.reshape(*batch, n) for x in (tau, error, tau - margin, tau + margin)))


def friction_of(terms: Sequence[Term], numbers: Iterable[Any], width: float) -> tuple[Friction, ...]:
    """Friction effects of terms with the numbers of each."""
    return tuple(effect for term, own in zip(terms, numbers, strict=True) for effect in term.found(own, width))


def effects_of(robot: Robot, friction: Sequence[Friction]) -> tuple[Effect, ...]:
    """Effects of a scene: gravity, rotor inertia if there is any, and friction."""
    return (effects.Gravity(), *(() if robot.armature is None else [effects.RotorInertia()]), *friction)


def coefficients_of(robot: Robot, terms: Sequence[Term], parameters: Tensor, name: str) -> Tensor | None:
    """Coefficients [..., n] of the term with a name among parameters [..., k]; None: there is none."""
    names = [term.name for term in terms]
    return parted(robot, parameters)[1][..., names.index(name), :] if name in names else None


def recorded(
    robot: Robot,
    motions: Motion | Sequence[Motion] | Tensor,
    qd: Tensor | None,
    qdd: Tensor | None,
    **others: Tensor | None,
) -> tuple[tuple[int, ...], MotionRows]:
    """Rows of motions, or of tensors, and the shape of their batch."""
    rest = {"qd": qd, "qdd": qdd, **others}
    if isinstance(motions, Tensor):
        given = {name: x for name, x in rest.items() if x is not None}
        for name in rest.keys() - given.keys():
            raise ArgumentError(f"{name} must be given with positions, found None")
        recording = of_tensors(robot, q=motions, **given)
        return torch.broadcast_shapes(motions.shape, *(x.shape for x in given.values()))[:-1], recording
    for name, x in rest.items():
        if x is not None:
            raise ArgumentError(f"{name} must not be given with motions, which hold it")
    recording = of_motions(robot, motions)
    return (len(recording.q),), recording


def _summed(effects: Sequence[Friction]) -> list[Friction]:
    """Effects in which those that differ only in linear coefficients are summed."""
    sums: dict[Friction, Friction] = {}
    for effect in effects:
        law = replace(effect, **dict.fromkeys(effect.LINEAR))
        if law in sums:
            pairs = {name: (getattr(sums[law], name), getattr(effect, name)) for name in effect.LINEAR}
            added = {name: tensor_of(a) + tensor_of(b) for name, (a, b) in pairs.items()}
            effect = replace(effect, **{name: tuple(x.tolist()) if x.ndim else float(x) for name, x in added.items()})
        sums[law] = effect
    return list(sums.values())
