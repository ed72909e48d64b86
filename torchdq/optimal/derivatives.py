"""Derivatives of solutions: of optimal costs by the envelope theorem, of torques by the implicit function theorem.

Optimal torques u of parameters p, the start among them, have no slope, J_u(u, p) = 0, where no limit holds them:

    dJ = J_p dp,   du = -J_uu^-1 J_up dp

J_p and J_up are gradients of a rollout, and of its gradient. J_uu^-1 is a Riccati recursion over the Hessians of

    L = cost(f(s, u), u) + costate . f(s, u)

of every step f: exact ones, with second derivatives of step and costs, which iterative LQR leaves out.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from torchdq.backends.call import Repeated, evaluate
from torchdq.base.checks import require_object
from torchdq.dynamics.posed import Row, dot
from torchdq.errors import ArgumentError
from torchdq.optimal.ilqr import by_rows
from torchdq.optimal.knot import COSTATE, NEXT, Knot, named_rows
from torchdq.optimal.problem import Passes, Plan, Problem
from torchdq.program.autodiff import vjp_jacobian
from torchdq.program.program import Argument, record, replay, results
from torchdq.program.transforms import outside_of_graphs
from torchdq.scene.free_base import displacements, rates_of
from torchdq.scene.recording import Stage
from torchdq.scene.spec import POSES, Rows
from torchdq.scene.state import State, require_state

ROUNDING = 8.0  # units in the last place by which a torque that is held may differ from its limit


@outside_of_graphs
def differentiable(problem: Problem, state: State, plan: Plan, **inputs: Any) -> Plan:
    """Plan whose cost, torques and states have gradients: in the start, goals, weights, limits and the scene's tensors.

    The gradient of the cost is that with the torques held, by the envelope theorem, and takes one rollout. That of
    torques and states takes the exact Hessian of the problem, in a program of its own that is compiled where it is
    first asked for; torques at their limits stay there. There are first derivatives alone. Their error is of first
    order in the distance of the plan from the minimum: solve with a tolerance such as 1e-14, in float64. Gains have no
    gradients.

    Args:
        problem: that of the plan, whose tensors may require grad.
        state: start of the plan, shape [...].
        plan: its solution by `solve` or `Receding`, with torques [steps, ..., n] [N m or N].
        inputs: as in `solve`.

    Raises:
        ArgumentError: the plan is that of a sampling method, which is no minimum.

    >>> import torch, torchdq
    >>> from torchdq import Scene, optimal
    >>> scene = Scene(torchdq.robots.load("two_link"), dt=0.05)
    >>> goal = torch.tensor([0.5, -0.3], dtype=torch.float64, requires_grad=True)
    >>> final = [optimal.Posture(goal, 100.0), optimal.Speeds(10.0)]
    >>> problem = optimal.Problem(scene, 20, [optimal.Torques(1e-2)], final)
    >>> state = scene.start(torch.zeros(2, dtype=torch.float64))
    >>> plan = optimal.solve(problem, state, tolerance=1e-14)
    >>> plan = optimal.differentiable(problem, state, plan)
    >>> plan.states.q[-1, 0].backward()
    >>> goal.grad
    tensor([ 0.9289, -0.0282], dtype=torch.float64)
    """
    require_state(state)
    require_object("problem", problem, Problem, "torchdq.optimal", "Problem(scene, 50, costs)")
    require_object("plan", plan, Plan, "torchdq.optimal", "solve(problem, state)")
    for name, x in state.rows().items():
        if not torch.equal(x.detach().expand(plan.states.rows()[name][0].shape), plan.states.rows()[name][0]):
            raise ArgumentError("plan must be that of the start, found another first state; solve from this state")
    if plan.gain is None:
        raise ArgumentError("plan must be that of iterative LQR, found one of a sampling method, which is no minimum")
    torque, free = plan.torque.detach(), torch.ones_like(plan.torque)
    limits = problem.limits(state.q)
    with torch.enable_grad():
        for bound in limits or ():
            near = ROUNDING * torch.finfo(torque.dtype).eps * bound.detach().abs().clamp(min=1.0)
            held = (torque - bound).abs() <= near
            torque, free = torch.where(held, bound, torque), free.masked_fill(held, 0.0)
        torque = torque if torque.requires_grad else torque.requires_grad_()
        cost = problem.cost(state, torque, **inputs)
        (slope,) = torch.autograd.grad(cost.sum(), torque, create_graph=True)
        torque = _Implicit.apply(torque, slope, _inverse(problem, state, plan.torque, free, inputs))
        after = problem.scene.rollout(state, torque, nonfinite="ignore", **inputs).rows()
        rows = {
            name: torch.cat([x.expand(after[name].shape[1:])[None], after[name]]) for name, x in state.rows().items()
        }
        cost, torque = _Once.apply(cost), _Once.apply(torque)
        states = State(**{name: _Once.apply(x) for name, x in rows.items()})
    return plan._replace(torque=torque, states=states, cost=cost)


class _Once(torch.autograd.Function):
    """Tensor that is differentiable once: second derivatives would be those with the torques held."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        """Tensor as it is."""
        return x.clone()

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Tensor:
        """Gradient as it is; raises where a graph of it is asked for."""
        if torch.is_grad_enabled():
            raise ArgumentError("create_graph must be False, since plans have first derivatives alone")
        return grad


class _Implicit(torch.autograd.Function):
    """Torques that follow their slope: free ones change by a solution with the Hessian, those at limits with these."""

    @staticmethod
    def forward(ctx: Any, torque: Tensor, slope: Tensor, solved: Callable[[Tensor], Tensor]) -> Tensor:
        """Torques as they are."""
        ctx.solved = solved
        return torque.clone()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, Tensor, None]:
        """Gradients in torques and slope."""
        return grad, -ctx.solved(grad), None


def _inverse(
    problem: Problem, state: State, torque: Tensor, free: Tensor, inputs: dict[str, Tensor]
) -> Callable[[Tensor], Tensor]:
    """Function that solves with the Hessian of the cost among torques that are free, for a right side like torques."""
    passes, free = Passes.of(problem, state.q, inputs), by_rows(free, 1)
    start, torque, s = {name: by_rows(x, 0) for name, x in state.rows().items()}, by_rows(torque, 1), passes.size

    @cache
    def curvatures() -> tuple[Tensor, Tensor]:
        """Hessians [steps, rows, s + n, s + n] of every step, and derivatives [steps, rows, s, s + n] of its state."""
        what = Knot(problem.scene.spec, problem.objective, part=curvature)
        last = {COSTATE: torque.new_zeros(torque.shape[1], s)}
        stepped = passes.knots(passes.forward(start, torque)[0], torque)
        repeated = Repeated(problem.steps, (COSTATE,), tuple(stepped), ends=True, backwards=True)
        given = {**last, **stepped, **passes.fixed, **passes.shared}
        found = evaluate(what, given, problem.scene.backend, repeated=repeated)
        return found["hessian"], found["T"]

    def solved(right: Tensor) -> Tensor:
        b, (H, T) = by_rows(right, 1), curvatures()
        V, v, steps = torch.zeros_like(H[0, :, :s, :s]), torch.zeros_like(H[0, :, :s, 0]), list[tuple[Tensor, Tensor]]()
        for k in reversed(range(problem.steps)):
            M, g = H[k] + T[k].mT @ V @ T[k], (T[k].mT @ v[..., None])[..., 0]
            own, cross = free[k, :, None] * free[k, :, :, None], free[k, :, :, None] * M[:, s:, :s]
            among = own * M[:, s:, s:] + torch.diag_embed(1.0 - free[k])
            right_side = torch.cat([cross, (free[k] * (g[:, s:] - b[k]))[..., None]], -1)
            gain = -torch.linalg.solve_ex(among, right_side)[0]
            V, v = M[:, :s, :s] + cross.mT @ gain[..., :s], g[:, :s] + (cross.mT @ gain[..., s:])[..., 0]
            steps.append((gain[..., :s], gain[..., s]))
        ds, found = torch.zeros_like(v), list[Tensor]()
        for k, (gain, change) in enumerate(reversed(steps)):
            du = change + (gain @ ds[..., None])[..., 0]
            ds = (T[k] @ torch.cat([ds, du], -1)[..., None])[..., 0]
            found.append(du)
        return torch.stack(found).view(right.shape)

    return solved


def curvature(what: Knot, arguments: Sequence[Argument]) -> Callable[[Rows], Rows]:
    """Formula of the exact Hessian of a step about its states, of its derivatives, and of the costate before it."""
    spec, (control, asked) = what.spec, (what.objective.control, what.objective.inputs(what.spec.robot.n))
    taken = tuple([a for a in arguments if a.name not in (*asked, *what.own)])
    step, s = Stage(spec, "step", unguarded=True).program(taken), what.own[COSTATE][0]
    judged = tuple([a._replace(name=a.name.removeprefix(NEXT)) for a in arguments if _judged(a, what, asked)])
    cost = Stage(spec, "judge", what.objective).program(judged)
    whole = (*arguments, Argument("by", s, False))

    def about(*rows: Row) -> Rows:
        """Cost, and displacement of the state after the step, of a displaced state."""
        known, used = named_rows(whole, rows), 0
        moved = dict(known)
        for name, width in spec.displaced.items():
            moved[name], used = _displaced(name, known[name], known["by"][used : used + width]), used + width
        after = results(step, replay(step, [moved[a.name] for a in taken]))
        given = {**known, **{name: after[name] for name in spec.state}}
        (value,) = results(cost, replay(cost, [given[a.name] for a in judged]))["cost"]
        return {"cost": [value], "after": [x for name in spec.displaced for x in _apart(name, after, known)]}

    along = record("displaced", whole, about)
    at = [k for k, a in enumerate(whole) if a.name == control]
    second = vjp_jacobian(along, [len(whole) - 1, *at])

    def algorithm(known: Rows) -> Rows:
        costate = known[COSTATE]
        rows = [known[a.name] for a in arguments]
        found = results(second, replay(second, [*rows, [0.0] * s, [1.0], costate]))
        ss, us, su, uu, cs, _, ts, tu = found.values()  # blocks of Hessian, slope and T^T, each row by row
        n = len(known[control])
        upper = [[*ss[s * i : s * i + s], *su[n * i : n * i + n]] for i in range(s)]
        lower = [[*us[s * i : s * i + s], *uu[n * i : n * i + n]] for i in range(n)]
        T = list(
            zip(*[ts[s * i : s * i + s] for i in range(s)], *[tu[s * i : s * i + s] for i in range(n)], strict=True)
        )
        before = [a + dot([row[i] for row in T], costate) for i, a in enumerate(cs)]
        hessian = [x for row in (*upper, *lower) for x in row]
        return {"hessian": hessian, "T": [x for row in T for x in row], COSTATE: before}

    return algorithm


def _judged(a: Argument, what: Knot, asked: dict[str, int]) -> bool:
    """Whether the cost of a step has an argument."""
    return a.name.startswith(NEXT) or "." in a.name or a.name in (*asked, what.objective.control)


def _displaced(name: str, row: Row, by: Row) -> Row:
    """Row of a state after a displacement, of poses to second order."""
    first = rates_of(row, by) if name in POSES else by
    second = [0.5 * x for x in rates_of(first, by)] if name in POSES else [0.0] * len(row)
    return [a + b + c for a, b, c in zip(row, first, second, strict=True)]


def _apart(name: str, after: Mapping[str, Row], known: Rows) -> Row:
    """Displacement of a row from that of the state after the step, of poses to second order."""
    at = known[NEXT + name]
    return displacements(at, after[name]) if name in POSES else [a - b for a, b in zip(after[name], at, strict=True)]
