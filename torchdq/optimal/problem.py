"""Problems of optimal control and their plans, and the two passes that solvers take over all steps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from torchdq.backends.call import Repeated, evaluate
from torchdq.base.checks import frozen, require_choice, require_count, require_object, require_tensor, tensor_of
from torchdq.effects.model import Gravity
from torchdq.errors import ArgumentError
from torchdq.functional import inverse_dynamics
from torchdq.optimal import riccati
from torchdq.optimal.costs import Objective, Residuals, named
from torchdq.optimal.knot import LARGEST, NEXT, Knot
from torchdq.scene import Scene, linearize
from torchdq.scene.policies import STEPPED, Linear, LinearForm
from torchdq.scene.recording import Stage
from torchdq.scene.spec import ORDER, POLICY
from torchdq.scene.state import State

Limits = tuple[Tensor, Tensor]
TOGETHER = 2**22  # numbers of matrices of knots that are in memory together
STATUS = (
    "converged: no step is expected to decrease the cost by more than the tolerance",
    "stopped after all iterations; give more, or go on by solve(problem, state, plan)",
    "stalled: no step decreases the cost, although one is expected to; costs may have kinks, or the tolerance may be "
    "below their rounding errors",
    "diverged: start, goals, weights or limits are not finite, a weight is negative, torques cost nothing, or the "
    "simulation leaves the finite range; in the last case begin with other torques or states, or take shorter steps",
)
CONVERGED, STOPPED, STALLED, DIVERGED = range(len(STATUS))


@frozen
@dataclass(frozen=True, eq=False)
class Problem:
    """Costs of a number of steps of a scene, to be minimised over the torques within limits.

    The cost of a step is that of the state at its end and of its torques; at the last step those of `final` are added.

    Args:
        scene: what is planned for: its step is one program, without random noise.
        steps: number of steps.
        costs: costs of every step.
        final: costs of the last state, added to those.
        torques: "limits": those of the efforts in the robot's description hold in every step; None: there are none; or
            smallest and largest torques [N m or N], each a tensor [..., n] or a number.
        control: input that is planned: "torque", or "target", the positions that an `effects.Servo` is given [rad or
            m]. What is said of torques is said of targets then: their limits are those of the joints, and
            `Torques(weight, reference)` is their cost.

    >>> import torch, torchdq
    >>> from torchdq import Scene, effects, optimal
    >>> scene = Scene(
    ...     torchdq.robots.load("two_link"), (effects.Gravity(), effects.Viscous(0.1)), dt=0.02
    ... )
    >>> goal = torch.tensor([1.2, 0.4, 0.0], dtype=torch.float64)
    >>> costs = [optimal.Torques(1e-3), optimal.Speeds(1e-2)]
    >>> problem = optimal.Problem(
    ...     scene, 40, costs, [optimal.Point("tip", goal, 1e3), optimal.Speeds(10.0)]
    ... )
    >>> plan = optimal.solve(problem, scene.start(torch.zeros(2, dtype=torch.float64)))
    >>> bool(plan.converged), plan.torque.shape, plan.gain.shape
    (True, torch.Size([40, 2]), torch.Size([40, 2, 4]))

    Targets of servos, by the same costs of a motion:

    >>> servo = effects.Servo(torch.tensor([200.0, 80.0]), torch.tensor([20.0, 8.0]))
    >>> driven = scene.replace(effects=(effects.Gravity(), servo))
    >>> plan = optimal.solve(
    ...     problem.replace(scene=driven, control="target"), scene.start(plan.states.q[0])
    ... )
    >>> driven.rollout(
    ...     scene.start(plan.states.q[0] + 0.01), policy=plan.policy, steps=40
    ... ).q.shape
    torch.Size([40, 2])
    """

    scene: Scene
    steps: int
    costs: Sequence[Residuals]
    final: Sequence[Residuals] = ()
    torques: Literal["limits"] | tuple[Any, Any] | None = "limits"
    control: Literal["torque", "target"] = "torque"
    objective: Objective = field(init=False, repr=False)

    def __post_init__(self) -> None:
        require_object("scene", self.scene, Scene, "torchdq", "Scene(robot)")
        require_count("steps", self.steps)
        if self.scene.looped or self.scene.computed or self.scene.noises:
            found = "noise" if self.scene.noises else ", ".join(self.scene.computed)
            found = f"{self.scene.integrator} and substeps={self.scene.substeps}" if self.scene.looped else found
            raise ArgumentError(
                "scene must have steps of one program, without sensor noise, residuals of torch, height maps and loops "
                f"of substeps; found one with {found}; plan for a simpler one"
            )
        for name in ("costs", "final"):
            if not isinstance(getattr(self, name), Sequence):
                raise ArgumentError(f"{name} must be a list of costs, found {getattr(self, name)!r}")
        for cost in (*self.costs, *self.final):
            require_object("a cost", cost, Residuals, "torchdq.optimal", "Torques(1e-3)")
        if not (self.costs or self.final):
            raise ArgumentError("costs must not be empty if final is; give optimal.Torques(1e-3), for example")
        terms = tuple([cost.term for cost in (*self.costs, *self.final)])
        require_choice("control", self.control, ("torque", "target"))
        if self.control not in self.scene.inputs:
            raise ArgumentError('control="target" needs a scene with effects.Servo(kp), found one without')
        object.__setattr__(self, "objective", Objective(terms, self.control))
        self.limits(torch.zeros(self.scene.n, dtype=torch.float64))  # raises

    def replace(self, **changes: Any) -> Problem:
        """Problem with some fields replaced; costs of equal formulas need no new program."""
        return replace(self, **changes)

    def limits(self, like: Tensor) -> Limits | None:
        """Smallest and largest torques, each [..., n]; None: there are none."""
        if self.torques is None:
            return None
        bounds: Any = self.torques
        if isinstance(bounds, str):
            lower, upper, _, effort = self.scene.robot.limits
            own = (-effort, effort) if self.control == "torque" else (lower, upper)
            bounds = own if bounds == "limits" else ()
        if not isinstance(bounds, tuple | list) or len(bounds) != 2:
            raise ArgumentError(f'torques must be "limits", None or a pair (lower, upper), found {self.torques!r}')
        n, bounds = like.shape[-1], [tensor_of(x).to(like) for x in bounds]
        for x in bounds:
            if x.ndim and x.shape[-1] not in (1, n):
                raise ArgumentError(f"limits of torques must be numbers, or tensors [..., {n}], found {tuple(x.shape)}")
        lower, upper = (x.expand(torch.broadcast_shapes(x.shape, (n,))) for x in bounds)
        if bool((lower > upper).any()):
            raise ArgumentError("torques must be (lower, upper), found a lower one above the upper")
        return None if bool(torch.isinf(lower).all() & torch.isinf(upper).all()) else (lower, upper)

    def inputs(self, like: Tensor) -> dict[str, Tensor]:
        """Tensors of all costs for states like a tensor [..., n], by name: [..., k], or those of every step."""
        found = dict[str, Tensor]()
        for k, cost in enumerate((*self.costs, *self.final)):
            for name, x in cost.inputs.items():
                x, last = x.to(like), name == "weight" and k >= len(self.costs)
                if x.ndim > like.ndim and (last or len(x) != self.steps):
                    raise ArgumentError(
                        f"{named(name, k)} has one axis more than the states, {tuple(x.shape)}, so it must be "
                        + (
                            "that of one step, since the cost is final"
                            if last
                            else f"[{self.steps}, ...], of every step; goals of many problems need as many states"
                        )
                    )
                if last:
                    x = x.reshape(*(1,) * (like.ndim - x.ndim), *x.shape)
                    x = torch.cat([torch.zeros_like(x).expand(self.steps - 1, *x.shape), x[None]])
                found[named(name, k)] = x
        return found

    def cost(self, state: State, torque: Tensor, **inputs: Tensor) -> Tensor:
        """Cost [...] of torques [steps, ..., n] that are applied from a state on, with other inputs of the scene."""
        steps: Any = {name: x.expand(self.steps, *x.shape[-state.q.ndim :]) for name, x in self.inputs(state.q).items()}
        steps |= {self.control: torque, **inputs}
        _, rows = self.scene.rollout(state, task=self.objective, total="cost", ends=True, nonfinite="ignore", **steps)
        return rows["cost"]

    def holding(self, state: State) -> Tensor:
        """Torques [steps, ..., n] that hold a fixed base's joints at rest, or targets at the state, within limits."""
        q, gravity = state.q, [x for _, x in self.scene.spec.of(Gravity)]
        held = q if self.control == "target" else torch.zeros_like(q)
        if self.control == "torque" and gravity and not self.scene.robot.floating:
            held = inverse_dynamics(self.scene.robot, q)
        limits = self.limits(q)
        return (held if limits is None else held.clamp(*limits)).expand(self.steps, *q.shape)


class Plan(NamedTuple):
    """Solution of a problem."""

    torque: Tensor  # [steps, ..., n] within the limits [N m or N]
    states: State  # [steps + 1, ...] from the start on
    gain: Tensor | None  # [steps, ..., n, s] of the torques in displacements of the state; None: of a sampling method
    cost: Tensor  # [...]
    status: Tensor  # [...] position in `optimal.STATUS`
    iterations: Tensor  # [...] steps that were taken
    limits: Limits | None = None  # of the torques
    control: str = "torque"  # input that the torques are: "target" of a servo, [rad or m]

    @property
    def converged(self) -> Tensor:
        """True where no step is expected to decrease the cost by more than the tolerance, shape [...]."""
        return self.status == CONVERGED

    @property
    def policy(self) -> Linear:
        """Torques and gains as a policy of `Scene.rollout`, which stays near the plan where a simulation differs."""
        if self.gain is None:
            raise ArgumentError("policy needs gains, which sampling methods have not; solve by method='ilqr'")
        return Linear(self.gain, self.torque, joined(self.states.rows())[:-1], self.limits, self.control)

    def why(self) -> str:
        """Text that says what became of the rows."""
        found = []
        for k, text in enumerate(STATUS):
            rows = (self.status.reshape(-1) == k).nonzero()[:, 0].tolist()
            if rows:
                first = "" if self.status.ndim == 0 else f", the first is row {rows[0]}"
                found.append(f"{len(rows)} of {self.status.numel()}{first}: {text}")
        return "\n".join(found)


def joined(rows: Mapping[str, Tensor]) -> Tensor:
    """Rows of a state as one."""
    found = [rows[name] for name in ORDER if name in rows]
    return found[0] if len(found) == 1 else torch.cat(found, -1)


def expanded(name: str, x: Tensor, shape: tuple[int, ...]) -> Tensor:
    """Tensor of every row; raises with its name unless its batch axes are those of the states."""
    require_tensor(name, x)
    try:
        return x.expand(shape)
    except RuntimeError as error:
        expected = ", ".join(map(str, shape))
        raise ArgumentError(
            f"{name} must expand to the shape [{expected}] for these states, found {tuple(x.shape)}; a batch of "
            "problems needs as many starts"
        ) from error


class Passes(NamedTuple):
    """Passes over the steps of problems that are rows [rows, ...] of tensors, each without the others."""

    problem: Problem
    stepped: dict[str, Tensor]  # inputs of every step [steps, rows, ...] or, of all rows, [steps, 1, ...]
    fixed: dict[str, Tensor]  # those that are the same at all steps [rows, ...]
    shared: dict[str, Tensor]  # parameters of the scene that all rows share
    limits: Limits | None  # of the torques [rows, n]
    size: int  # numbers of a displacement of the state

    @classmethod
    def of(cls, problem: Problem, like: Tensor, inputs: Mapping[str, Tensor]) -> Passes:
        """Passes for states like a tensor [..., n], with other inputs [steps, ..., k] of the scene."""
        scene, batch, count = problem.scene, like.shape[:-1], like.shape[:-1].numel()
        stage, stepped, fixed, shared = Stage(scene.spec, "step", problem.objective), {}, {}, {}
        scene.spec.require_inputs(inputs)
        if problem.control in inputs:
            raise ArgumentError(
                f"{problem.control} is planned, found it among the other inputs; begin with it as torque"
            )
        for name, x in {**scene.parameters, **problem.inputs(like), **inputs}.items():
            axes, x = stage.axes(name), x.detach().to(like)
            rest = tuple(x.shape[x.ndim - len(axes) :])
            if name in inputs or (name not in scene.parameters and x.ndim > len(batch) + len(axes)):
                whole = x.reshape(len(x), *(1,) * (len(batch) + 1 - x.ndim + len(axes)), *x.shape[1:])
                if whole.shape[1:] != (*(1,) * len(batch), *rest):
                    whole = expanded(name, whole, (problem.steps, *batch, *rest))
                rows = whole.shape[1 : whole.ndim - len(axes)].numel()
                stepped[name] = whole.reshape(problem.steps, rows, *rest)  # [steps, 1, ...] of all rows
            elif name in scene.parameters and x.ndim == len(axes):
                shared[name] = x
            else:
                fixed[name] = expanded(name, x, (*batch, *rest)).reshape(count, *rest)
        limits = problem.limits(like)
        if limits is not None:
            limits = tuple([expanded("limits of torques", x, like.shape).reshape(count, -1) for x in limits])  # type: ignore[assignment]
        return cls(problem, stepped, fixed, shared, limits, sum(scene.spec.displaced.values()))

    def among(self, rows: Tensor) -> Passes:
        """Passes of some of the rows."""
        stepped = {name: x if x.shape[1] == 1 else x.index_select(1, rows) for name, x in self.stepped.items()}
        fixed = {name: x.index_select(0, rows) for name, x in self.fixed.items()}
        limits = None if self.limits is None else tuple([x.index_select(0, rows) for x in self.limits])
        return self._replace(stepped=stepped, fixed=fixed, limits=limits)  # type: ignore[arg-type]

    def within(self, torque: Tensor) -> Tensor:
        """Torques within the limits."""
        return torque if self.limits is None else torque.clamp(*self.limits)

    def knots(self, states: Mapping[str, Tensor], torque: Tensor) -> dict[str, Tensor]:
        """Inputs of every knot: states before and after the step, torques, and those of step and costs."""
        near = {name: x[:-1] for name, x in states.items()} | {NEXT + name: x[1:] for name, x in states.items()}
        return {**near, self.problem.objective.control: torque, **self.stepped}

    @property
    def looped(self) -> bool:
        """Whether a knot is one program, over which the backward pass is a loop."""
        return linearize.length(self.problem.scene) + 2 * (self.size + self.problem.scene.n) ** 3 <= LARGEST

    def backward(self, states: Mapping[str, Tensor], torque: Tensor, damping: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Gains [steps, rows, n, s], changes [steps, rows, n], and the two terms of the expected change of the cost."""
        problem, scene, width = self.problem, self.problem.scene, self.size + self.problem.scene.n
        what = Knot(scene.spec, problem.objective, self.limits is not None)
        if self.looped:
            return self._by_loop(what, states, torque, damping)
        parts = []
        for at in torch.arange(len(damping), device=damping.device).split(TOGETHER // (problem.steps * width**2) or 1):
            of, near = self.among(at), {name: x[:, at] for name, x in states.items()}
            given, whole = {**of.stepped, **of.fixed, **of.shared}, linearize.length(scene) <= linearize.LARGEST
            u, limits = torque[:, at], of.bounds()
            derivatives = riccati.derived(what, whole, near, u, given, scene.backend)
            parts.append(riccati.backward(what, derivatives, u, damping[at, None], limits, scene.backend))
        gain, change, expected = zip(*parts, strict=True)
        return torch.cat(gain, 1), torch.cat(change, 1), torch.cat(expected)

    def bounds(self) -> dict[str, Tensor]:
        """Limits by name; none, if there are none."""
        return {} if self.limits is None else dict(zip(("lower", "upper"), self.limits, strict=True))

    def _by_loop(
        self, what: Knot, states: Mapping[str, Tensor], torque: Tensor, damping: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Backward pass of one program that is a loop over the knots."""
        problem, sizes = self.problem, {"V": self.size * (self.size + 1) // 2, "v": self.size}
        start = {name: torque.new_zeros(len(damping), size) for name, size in sizes.items()}
        stepped = self.knots(states, torque)
        fixed = {"damping": damping[:, None], **self.fixed, **self.shared, **self.bounds()}
        repeated = Repeated(problem.steps, ("V", "v"), tuple(stepped), ("expected",), ends=True, backwards=True)
        found = evaluate(what, {**start, **stepped, **fixed}, problem.scene.backend, repeated=repeated)
        return found["gain"], found["change"], found["expected"]

    def forward(
        self, start: Mapping[str, Tensor], torque: Tensor, follow: tuple[Tensor, Tensor] | None = None
    ) -> tuple[dict[str, Tensor], Tensor, Tensor]:
        """States by name [steps + 1, rows, ...], torques and costs [rows].

        Torques are those given, within the limits; to `follow` are gains [steps, rows, n, s] and states [steps, rows,
        ...].
        """
        problem, control = self.problem, self.problem.objective.control
        given = {**self.fixed, **self.shared, **{f"{POLICY}.{name}": x for name, x in self.bounds().items()}}
        if follow is None:  # by the same program
            follow = torque.new_zeros(*torque.shape, self.size), joined(start).expand(problem.steps, -1, -1)
        stepped = {**self.stepped, **dict(zip(STEPPED, (follow[0], torque, follow[1]), strict=True))}
        policy = LinearForm(self.limits is not None, control)
        what = Stage(problem.scene.spec, "step", problem.objective, policy=policy, unguarded=True)
        repeated = Repeated(problem.steps, tuple(start), tuple(stepped), ("cost",))
        found = evaluate(what, {**start, **stepped, **given}, problem.scene.backend, repeated=repeated)
        planned = found["planned"]
        planned = planned if planned.ndim == torque.ndim else planned[..., None]  # one number of a task has no axis
        return {name: found[name] for name in start}, planned, found["cost"]
