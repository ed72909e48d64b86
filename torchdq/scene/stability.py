"""Stability of a scene's steps: whether they are short enough for its stiffness and damping.

With mass matrix, damping and stiffness frozen as they are in a state, the joints are a linear system of springs and
dampers, M a + D v + K x = 0, whose motions never grow. A step of an integrator multiplies them by a matrix; if one of
its eigenvalues is larger than 1, the integrator makes them grow. That is asked at the start and along a trial run, in
which all rows must stay within bounds, whatever else acts: controllers, speed, contacts. The run tells how far a
floating base turns in a step, how deep points sink into the ground, how much of the cone their friction uses, and
whether they touched it at all. Controllers, whose torques are held over a step, are part of that matrix once more: a
run that holds the start, where they have nothing to correct, does not show how they correct.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchdq.base.checks import require_number, tensor_of
from torchdq.base.progress import Progress
from torchdq.control.joints import ComputedTorque, Feedback
from torchdq.dynamics.posed import Row
from torchdq.effects.closures import Closures
from torchdq.effects.contact import Contact, Contacts
from torchdq.errors import ArgumentError
from torchdq.scene.integrators import DormandPrince, Integrator, LinearlyImplicit, RungeKutta4, System
from torchdq.scene.model import SceneModel
from torchdq.scene.rollout import rollout
from torchdq.scene.state import State, nonfinite_rows, require_state

GROWTH = 1.001  # factor per step from which motions count as growing
MOST = 2**15  # steps of a trial run
ENOUGH = 2**11  # shorter steps within which springs and dampers that do not settle show it
FEW = 2**13  # steps of a trial run of shorter steps where rows diverge for another reason, which may take its time
SHORTEST = 2**12  # shorter steps that are tried, in one of the scene's
FAR = 1e6  # positions and velocities beyond which a row has diverged, though it may stay finite [rad, m, s]
STATES = 16  # states of a trial run that are looked at
FINE = 64  # parts of a step that stand for steps that adapt
FAST = 1.5  # turn of a floating base in a step up to which inertial torques give no energy [rad]
OPEN = 1e-4  # gap of a loop that is pointed out [m]
DEEP = 0.01  # depth from which points that sink into the ground are pointed out [m]


class Steps(NamedTuple):
    """An integrator, and a number of its steps within one of the scene, that are stable."""

    integrator: Integrator
    substeps: int
    step: float  # duration of each [s]

    def __str__(self) -> str:
        steps = f"substeps={self.substeps}, " if self.substeps > 1 else ""
        return f"integrator={self.integrator}, {steps}steps of {self.step:.3g} s"


class GroundCheck(NamedTuple):
    """Contact with the ground in the rows of a trial run that stay within bounds."""

    deepest: float  # largest depth of a point in it [m]
    slip: float  # largest speed along the ground of a point that touches at its end [m/s]
    cone: float  # largest impulse of the friction of a point over the run, over mu times that of its normal force
    aloft: int  # rows that never touched
    rows: int
    stiffness: float  # of the firmest contact [N/m]

    def __str__(self) -> str:
        lines = []
        if self.aloft < self.rows:
            lines.append(
                f"- contact: points sink up to {1e3 * self.deepest:.2g} mm and slip at {self.slip:.2g} m/s at the end; "
                f"over the run friction uses up to {self.cone:.3g} of mu times the normal impulse of a point; "
                f"stiffness {self.stiffness:.3g} N/m"
            )
        if self.deepest > DEEP:
            lines.append(
                "- contact: that is deep; take firmer ground, or a start that is neither in it nor far above it"
            )
        if self.aloft:
            lines.append(f"- contact: not checked in {self.aloft} of {self.rows} rows, which did not touch the ground")
        return "\n".join(lines)


@dataclass(frozen=True)
class Check:
    """Whether the steps of a scene are stable; true if they are. `print` it."""

    integrator: Integrator
    step: float  # duration of a step of the integrator [s]
    seconds: float  # duration of the trial run [s]
    growth: float  # largest factor by which a step magnifies a motion of the springs and dampers; up to 1 they settle
    joint: str  # joint that moves most in it
    diverged: Tensor  # [...] rows that are beyond 1e6 rad, m or rad/s at the end of the trial run, or not finite
    alternatives: tuple[Steps, ...] = ()  # stable ones, where these are not
    ground: GroundCheck | None = None  # None: the scene has no `effects.Contact`
    held: float = 1.0  # the same factor with the torques of the controller, held over a step of the scene
    turn: float = 0.0  # largest turn of a floating base in a step [rad]

    @property
    def stable(self) -> bool:
        """True if springs, dampers and the controller settle, and no row diverges."""
        return max(self.growth, self.held) <= GROWTH and not bool(self.diverged.any())

    def __bool__(self) -> bool:
        return self.stable

    def __str__(self) -> str:
        lines = [f"steps of {self.step:.3g} s with {self.integrator} are {'stable' if self.stable else 'unstable'}"]
        if self.growth > GROWTH:
            lines.append(f"- stiffness and damping: a step magnifies a motion {self.growth:.3g} times, of {self.joint}")
        if bool(self.diverged.any()):
            rows = f"{int(self.diverged.sum())} of {self.diverged.numel()} rows"
            lines.append(f"- {rows} are out of bounds after {self.seconds:g} s")
        if self.held > GROWTH:
            lines.append(
                f"- controller: its torques, held over a step, magnify a motion {self.held:.3g} times, of "
                f"{self.joint}; take smaller gains (kp dt^2 / I + 2 kd dt / I below 4, of the inertia I that a joint "
                "moves), a shorter dt, or effects.Servo, which acts at the end of a step"
            )
        if self.turn > FAST:
            lines.append(
                f"- base: it turns by up to {self.turn:.2g} rad in a step; beyond {FAST:g} rad inertial torques may "
                "give it energy, take shorter steps"
            )
        if not self.stable:
            lines += [f"- stable: {found}" for found in self.alternatives]
        if not (self.stable or self.alternatives or self.held > GROWTH):
            lines.append("- none of the shorter steps that were tried is stable; is the motion itself?")
        return "\n".join([*lines, *([] if self.ground is None else [str(self.ground)])])


def check(scene: SceneModel, state: State, seconds: float = 1.0, **inputs: Tensor | None) -> Check:
    """Whether the steps are stable under the stiffness and damping that is there; if not, which are.

    A step must let the springs and dampers at the joints settle, as they are at the state and along a trial run
    from it, with the torques of `PD` and `ComputedTorque` held over it, too; and all rows of that run must
    stay below 1e6 rad or m, and 1e6 rad/s or m/s. Computed in float64. Stable steps need not be accurate: compare with
    steps half as long. Contacts are checked where points touch the ground during the run, and the result says how many
    rows did not.

    Args:
        state: states to start from.
        seconds: duration of the trial run [s].
        inputs: as in `step`, the same at every step; a controller without `reference` holds the start.

    >>> import torch, torchdq
    >>> from torchdq import effects
    >>> from torchdq.scene import integrators
    >>> parts = (effects.Viscous(500.0),)
    >>> scene = torchdq.Scene(
    ...     torchdq.robots.load("two_link"), parts, integrator=integrators.SemiImplicitEuler()
    ... )
    >>> print(scene.check(scene.start(torch.zeros(2)), seconds=0.1))  # doctest: +ELLIPSIS
    steps of 0.01 s with SemiImplicitEuler() are unstable...
    """
    require_state(state)
    require_number("seconds", seconds, positive=True)
    scene.spec.require_inputs(inputs)
    intervals = max(1, round(seconds / scene.dt))
    if intervals > MOST:
        raise ArgumentError(f"seconds={seconds:g} are {intervals} steps, and {MOST} are the most; shorten them")
    if unusable := nonfinite_rows(state, scene.robot):
        if not bool(state.finite().any()):
            raise ArgumentError(f"state must be finite to start a trial run from, found: {unusable}")
        warnings.warn(f"{unusable}; the others are checked", stacklevel=2)
    rigid = scene.robot.closures and not scene.spec.of(Closures)
    if rigid and (gap := float(scene.closure_errors(state).distance.nan_to_num().max())) > OPEN:
        warnings.warn(f"loops are open by up to {gap:.3g} m in the state; scene.start closes them", stacklevel=2)
    given = {name: x.double() for name, x in inputs.items() if x is not None}
    trial = _Trial(scene, state.to(torch.float64), given, intervals)
    integrator, times = scene.integrator, scene.substeps
    with Progress(f"checking {intervals} steps of a scene of robot {scene.robot.name!r}") as notice:
        found = trial.run(scene, integrator, times)
        if found.stable or found.held > GROWTH:  # which no shorter steps of the integrator mend
            return found
        candidates: list[tuple[Integrator, int]] = []
        if not isinstance(integrator, DormandPrince):
            candidates.append((integrator, 2 * times))
            if not isinstance(integrator, LinearlyImplicit):
                candidates.insert(0, (LinearlyImplicit(), times))
            elif scene.robot.floating and found.ground is None:  # whose joints may give it energy
                candidates.append((RungeKutta4(), times))
        stable: list[Steps] = []
        for other, first in candidates:
            notice.at(f"trying shorter steps of {other}")
            stable += trial.shortened(other, first, stiff=found.growth > GROWTH)
    return replace(found, alternatives=tuple(stable))


@dataclass(frozen=True)
class _Trial:
    """A scene with an initial state and inputs that stay, over a number of its steps."""

    scene: SceneModel
    state: State
    inputs: Mapping[str, Tensor]
    intervals: int

    def shortened(self, integrator: Integrator, times: int, stiff: bool) -> list[Steps]:
        """The first power of two of shorter steps that is stable, if one is."""
        while times <= SHORTEST:
            intervals = min(self.intervals, max(1, ENOUGH // times)) if stiff else self.intervals
            if not stiff and times * intervals > FEW:
                break
            # a look at the start alone saves most trial runs
            well = all(self._growth(integrator, times, self.state, held)[0] <= GROWTH for held in (False, True))
            scene = self.scene.replace(substeps=times, integrator=integrator, unroll=False)
            if well and replace(self, intervals=intervals).run(scene, integrator, times):
                return [Steps(integrator, times, self.scene.dt / times)]
            times *= 2
        return []

    def run(self, scene: SceneModel, integrator: Integrator, times: int) -> Check:
        """Check of a scene that takes a number of steps of an integrator, without alternatives."""
        step, seconds = self.scene.dt / times, self.intervals * self.scene.dt
        series: dict[str, Any] = {name: x.expand(self.intervals, *x.shape) for name, x in self._inputs().items()}
        with torch.no_grad():
            path = rollout(scene, self.state, steps=self.intervals, nonfinite="ignore", **series)
        begins = self.state.finite()
        moving = [x for name, x in path.rows().items() if name in scene.spec.moving]
        ends = path.finite() & (torch.cat(moving, -1).abs() < FAR).all(-1)
        diverged = begins & ~ends[-1]
        if isinstance(integrator, DormandPrince):
            held, joint = self._growth(LinearlyImplicit(), FINE, self.state, held=True)
            return Check(integrator, step, seconds, 1.0, joint, diverged, held=held)
        at = torch.linspace(0, self.intervals - 1, min(STATES, self.intervals)).long()
        kept = ends[at][..., None]
        seen = State._make(
            None if x is None or first is None else torch.cat([first.expand_as(x[:1]), torch.where(kept, x[at], first)])
            for x, first in zip(path, self.state, strict=True)
        )
        ground = self._ground(scene, path, step) if scene.spec.of(Contact) else None
        (growth, joint), held, turn = self._growth(integrator, times, seen), 1.0, 0.0
        if growth <= GROWTH and isinstance(scene.controller, Feedback):
            held, joint = self._growth(integrator, times, seen, held=True)
        if path.V_WB_B is not None and bool(ends.any()):
            turn = step * float(path.V_WB_B[ends][..., :3].norm(dim=-1).max())
        return Check(integrator, step, seconds, growth, joint, diverged, (), ground, held, turn)

    def _ground(self, scene: SceneModel, path: State, step: float) -> GroundCheck | None:
        """Contact along a trial run."""
        kept = path.finite().all(0)
        if not bool(kept.any()):
            return None
        with torch.no_grad():  # of all rows, each with its own parameters
            found = Contacts._make(x[:, kept] for x in scene.contacts(path))
        aloft = ~found.touching.any(-1).any(0)
        slip = torch.where(found.touching[-1], found.slip[-1], 0.0)
        contacts: Sequence[Any] = [scene.effects[i].of_objects(scene.objects) for i, _ in scene.spec.of(Contact)]
        stiffness = max(float(tensor_of(contact.stiffness).detach().max()) for contact in contacts)
        each = [
            (tensor_of(contact.friction).detach().double()[..., None], len(contact.touching)) for contact in contacts
        ]
        mu = torch.cat([x.expand(*kept.shape, points) for x, points in each], -1)[kept]
        friction = (found.force.square().sum(-1) - found.normal_force.square()).clamp(min=0.0).sqrt().sum(0)
        most = mu * found.normal_force.sum(0)
        shares = torch.where(most > 0, friction / most, 0.0)
        deepest, fastest, cone = (float(x.max()) for x in (found.depth, slip, shares))
        return GroundCheck(max(0.0, deepest), fastest, cone, int(aloft.sum()), aloft.numel(), stiffness)

    def _inputs(self) -> dict[str, Tensor]:
        """Inputs of a step; where nothing else is given, sensors read without noise and controllers hold the start."""
        found = dict(self.inputs)
        if self.scene.controller is not None and "reference" not in found:
            found["reference"] = self.scene.controller.holding(self.scene.robot, self.state.q)
        if self.scene.noises:
            found.setdefault("noise", self.state.q.new_full((self.scene.noises,), 0.5))
        return found

    def _growth(self, integrator: Integrator, times: int, states: State, held: bool = False) -> tuple[float, str]:
        """Largest factor by which a step magnifies a motion of frozen springs and dampers, and the joint that moves.

        `held`: by which a step of the scene does, with the torques of its controller.
        """
        if not self.scene.n:
            return 1.0, ""
        frozen = self._frozen(states)
        if not len(frozen.M):
            return 0.0, ""
        found = frozen.transition(integrator, self.scene.dt / times, times if held else 0)
        if not bool(found.isfinite().all()):
            return math.inf, self.scene.robot.joint_names[0]
        factors = torch.linalg.eigvals(found).abs().amax(-1)
        worst, m = int(factors.argmax()), found.shape[-1] // 2
        values, vectors = torch.linalg.eig(found[worst])
        mode = vectors[m:, values.abs().argmax()].abs()
        return float(factors[worst]), self.scene.robot.joint_names[int(mode.argmax()) % self.scene.n]

    def _frozen(self, states: State) -> _Frozen:
        """Springs and dampers in those of some states that are finite."""
        inputs = {name: x for name, x in self._inputs().items() if name != "noise"}
        with torch.no_grad():
            rows = self.scene._evaluate("frozen", {**states.rows(), **inputs, **self.scene._outside(states)})
        control, n = self.scene.controller, self.scene.n
        if isinstance(control, Feedback):
            accelerates = isinstance(control, ComputedTorque)  # the others' gains are torques
            weight = rows["M"].unflatten(-1, (n, n)) if accelerates else torch.eye(n).to(rows["M"])
            gains = {name: tensor_of(getattr(control, name)).detach().to(rows["D"]) for name in ("kp", "kd")}
            rows |= {name: (weight * x.expand_as(rows["D"])[..., None, :]).flatten(-2) for name, x in gains.items()}
        there = states.finite().expand(rows["D"].shape[:-1])
        return _Frozen.of({name: x[there] for name, x in rows.items()})


@dataclass(frozen=True)
class _Frozen(System):
    """Linear system M a + D v + K x = 0 of the springs and dampers in some states; its rows are one tensor [..., m]."""

    M: Tensor  # [samples, m, m]
    D: Tensor
    K: Tensor
    kp: Tensor | None = None  # gains of the torques of a controller
    kd: Tensor | None = None
    held: Tensor | float = 0.0  # torques [samples, m, states] that stay over a step

    @classmethod
    def of(cls, rows: Mapping[str, Tensor]) -> _Frozen:
        """System of joints and, if there are any, of the rotors behind them."""
        n = rows["D"].shape[-1]
        whole = rows["M"].unflatten(-1, (math.isqrt(rows["M"].shape[-1]), -1)).flatten(0, -3)
        free, M = whole.shape[-1] - n, whole[:, -n:, -n:]
        if free:  # a base that may move takes inertia off its joints
            M = M - whole[:, free:, :free] @ torch.linalg.solve(whole[:, :free, :free], whole[:, :free, free:])
        D, K = (torch.diag_embed(rows[name].reshape(-1, n)) for name in "DK")
        gains = [rows[name].reshape(-1, n, n) for name in ("kp", "kd") if name in rows]
        if "inertia" in rows:
            d, k, J = (torch.diag_embed(rows[name].reshape(-1, n)) for name in ("damping", "stiffness", "inertia"))
            none = torch.zeros_like(M)
            M = torch.cat([torch.cat([M, none], -1), torch.cat([none, J.expand_as(M)], -1)], -2)
            D, K = (
                torch.cat([torch.cat([own + c, -c], -1), torch.cat([-c, c], -1)], -2) for own, c in ((D, d), (K, k))
            )
            gains = [pad(x, (0, n, n, 0)) for x in gains]  # of the links, by the rotors
        return cls(M, D, K, *gains)

    def transition(self, integrator: Integrator, h: float, held: int = 0) -> Tensor:
        """Matrix [samples, 2 m, 2 m] that takes (x, v) over a step h, or a number of them with the torques held."""
        units = torch.eye(2 * self.M.shape[-1], dtype=self.M.dtype, device=self.M.device)
        x, v = units.expand(len(self.M), *units.shape).chunk(2, -1)
        system = self
        if held and self.kp is not None and self.kd is not None:
            system = replace(self, held=-(self.kp @ x.mT + self.kd @ v.mT))
        for _ in range(max(1, held)):
            (x,), (v,) = integrator.step(system, [x], [v], h)
        return torch.cat([x, v], -1).mT

    def _solved(self, M: Tensor, D: Tensor, x: Tensor, v: Tensor) -> list[Tensor]:
        return [torch.linalg.solve(M, self.held - self.K @ x.mT - D @ v.mT).mT]

    def accelerations(self, x: Row, v: Row) -> list[Tensor]:
        return self._solved(self.M, self.D, x[0], v[0])

    def implicit_velocities(self, x: Row, v: Row, h: float) -> list[Tensor]:
        at_end = self.D + h * self.K
        (a,) = self._solved(self.M + h * at_end, at_end, x[0], v[0])
        return [v[0] + h * a]

    momentum_accelerations = accelerations

    def velocities_at(self, x: Row, v: Row, to: Row) -> list[Tensor]:
        return list(v)
