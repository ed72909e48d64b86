"""Solutions of problems of optimal control: iterative LQR of batches, with limits.

An iteration takes two loops over the steps. Backward, every knot has its change and gain of the torques; forward, steps
are simulated under them, by lengths 1, 1/2, 1/4 ... of the change until the cost falls by a tenth of what is expected.
A row that does not find one is damped: DAMPED of the diagonal of its quadratic form, and ten times that every time.

Limits that bind: a problem is first solved without them, roughly. The torques of that solution would lose their way if
they were clipped; its states are followed by its own gains under the limits instead, and from there on every knot is a
box QP (Y. Tassa, N. Mansard, E. Todorov, "Control-limited differential dynamic programming", ICRA 2014).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchdq.base.checks import require_count, require_number, require_object
from torchdq.base.progress import Progress
from torchdq.errors import ArgumentError
from torchdq.optimal.problem import CONVERGED, DIVERGED, STALLED, STOPPED, Passes, Plan, Problem, expanded, joined
from torchdq.optimal.sampling import Sampling
from torchdq.program.transforms import outside_of_graphs
from torchdq.scene.state import State, require_state

TOLERANCES = {torch.float32: 1e-5, torch.float64: 1e-9}
ROUGH = 0.02  # share of the cost that an iteration without limits may still gain
LEAST = 0.1  # share of the expected decrease that a step must have
LENGTHS = 10  # lengths of a step that are tried
TOGETHER = 32  # steps of different lengths that are simulated in one pass
NEAR = 1e6  # units in the last place of 1 by which states may differ from those that torques lead to
DAMPED, MOST = 1e-3, 1e6  # damping at first, and where a row is given up

Method = Sampling | str


class Found(NamedTuple):
    """Rows that are being solved, or were."""

    states: dict[str, Tensor]  # [steps + 1, rows, ...]
    torque: Tensor  # [steps, rows, n]
    gain: Tensor  # [steps, rows, n, s]
    cost: Tensor  # [rows]
    damping: Tensor  # [rows]
    status: Tensor  # [rows]
    iterations: Tensor  # [rows]

    @property
    def followed(self) -> tuple[Tensor, Tensor]:
        """Gains, and the states that they follow."""
        return self.gain, joined(self.states)[:-1]

    @property
    def tensors(self) -> list[Tensor]:
        """All tensors; those of more than one axis have the rows second."""
        return [*self.states.values(), *self[1:]]

    def made(self, tensors: Sequence[Tensor]) -> Found:
        """Rows of other tensors in the same order."""
        count = len(self.states)
        return Found(dict(zip(self.states, tensors[:count], strict=True)), *tensors[count:])

    def among(self, rows: Tensor) -> Found:
        """Some of the rows."""
        return self.made([x.index_select(int(x.ndim > 1), rows) for x in self.tensors])

    def put(self, rows: Tensor, of: Found) -> None:
        """Take some rows from others."""
        for x, y in zip(self.tensors, of.tensors, strict=True):
            x.index_copy_(int(x.ndim > 1), rows, y)


@outside_of_graphs
def solve(
    problem: Problem,
    state: State,
    torque: Tensor | Plan | None = None,
    states: State | None = None,
    method: Method = "ilqr",
    iterations: int = 100,
    tolerance: float | None = None,
    **inputs: Tensor,
) -> Plan:
    """Plan of torques [steps, ..., n] that cost least from a state on, with states and gains.

    Rows of a batch are problems of their own, and have the same result in every batch, but for rounding if the robot is
    large; those that have converged leave. Iterative LQR finds the nearest minimum that it comes to. It needs
    derivatives, which Gauss-Newton takes of the costs; a sampling method needs none, and its plan is a start for
    iterative LQR where contacts must be found.

    Robots on legs are planned for through their contacts. Derivatives of a large step, as that of a quadruped, compile
    for half a minute, once for a machine.

    Args:
        problem: costs and limits.
        state: initial states, shape [...].
        torque: torques to begin with [N m or N], shape [steps, ..., n], or an earlier plan, which is followed by its
            gains from the state on; None: those that hold a fixed base's joints, and limits hold after some iterations
            without them.
        states: states to begin with, [steps + 1, ...], that no torques need lead to, such as a straight line; None:
            those of the torques.
        method: "ilqr", `MPPI(...)` or `CEM(...)`.
        iterations: largest number of iterations, and of those without limits.
        tolerance: expected decrease of the cost, as a share of it or, below 1, absolute, from which a row has
            converged; None: 1e-9, in float32 1e-5.
        inputs: other inputs of the scene, shape [steps, ..., k].
    Raises:
        ArgumentError: an argument has another shape than that of the problem.

    >>> import torch, torchdq
    >>> from torchdq import Scene, optimal
    >>> scene = Scene(torchdq.robots.load("two_link"), dt=0.02)
    >>> goal = torch.tensor([[0.5, -0.3], [0.2, 0.4], [-0.6, 0.1]], dtype=torch.float64)
    >>> final = [optimal.Posture(goal, 100.0), optimal.Speeds(10.0)]
    >>> problem = optimal.Problem(
    ...     scene, 30, [optimal.Torques(1e-3)], final, torques=(-0.5, 0.5)
    ... )
    >>> plan = optimal.solve(problem, scene.start(torch.zeros(3, 2, dtype=torch.float64)))
    >>> print(plan.why())
    3 of 3, the first is row 0: converged: no step is expected to decrease the cost by
    more than the tolerance
    """
    require_state(state)
    require_object("problem", problem, Problem, "torchdq.optimal", "Problem(scene, 50, costs)")
    if not isinstance(method, Sampling) and method != "ilqr":
        raise ArgumentError(f'method must be "ilqr", optimal.MPPI(...) or optimal.CEM(...), found {method!r}')
    require_count("iterations", iterations)
    tolerance = TOLERANCES[state.q.dtype] if tolerance is None else tolerance
    require_number("tolerance", tolerance, least=0.0)
    batch, steps = state.q.shape[:-1], problem.steps
    near = torque if isinstance(torque, Plan) else None
    torque = torque.torque if isinstance(torque, Plan) else torque
    with torch.no_grad(), Progress(f"optimal control, {batch.numel()} rows") as notice:
        u = problem.holding(state) if torque is None else expanded("torque", torque, (steps, *state.q.shape))
        u, passes = by_rows(u, 1), Passes.of(problem, state.q, inputs)
        start = {name: by_rows(x, 0) for name, x in state.rows().items()}
        if isinstance(method, Sampling):
            u = method.improved(passes, start, u, iterations, notice.at)
            found = begun(passes, *passes.forward(start, u))._replace(torque=u)
            status = torch.where(found.cost.isfinite(), STOPPED, DIVERGED)
            found = found._replace(status=status, iterations=found.iterations + iterations)
            return planned(passes, batch, found)._replace(gain=None)
        follow = None if near is None or near.gain is None else rows_of(near).followed
        x, v, cost = passes.forward(start, u, follow)
        if states is not None:
            own = {
                name: by_rows(expanded(name, y, (steps + 1, *batch, y.shape[-1])), 1)
                for name, y in states.rows().items()
            }
            far = torch.stack([(y - x[name]).abs().amax((0, 2)) for name, y in own.items()]).amax(0)
            x, v, cost = own, u, torch.where(far <= NEAR * torch.finfo(u.dtype).eps, cost, torch.inf)
        found = begun(passes, x, v, cost)
        return planned(passes, batch, converged(passes, start, found, torque is None, iterations, tolerance, notice))


def by_rows(x: Tensor, axis: int) -> Tensor:
    """Tensor whose batch axes, between an axis and the last, are one of rows."""
    return x.detach().flatten(axis, -2) if x.ndim > axis + 1 else x.detach().unsqueeze(axis)


def begun(passes: Passes, states: dict[str, Tensor], torque: Tensor, cost: Tensor) -> Found:
    """Rows to be solved of states, torques and their costs, infinite where they are not finite."""
    cost = cost.nan_to_num(torch.inf, torch.inf)
    count = torch.zeros_like(cost, dtype=torch.int64)
    gain = torque.new_empty(*torque.shape, passes.size)
    return Found(states, torque, gain, cost, torch.zeros_like(cost), count + STOPPED, count)


def rows_of(plan: Plan) -> Found:
    """Rows of a plan that has gains."""
    states = {name: by_rows(x, 1) for name, x in plan.states.rows().items()}
    torque, gain, rows = by_rows(plan.torque, 1), plan.gain, plan.cost.numel()
    if gain is None:
        raise ArgumentError("plan must have gains, found that of a sampling method; give its torques")
    gain = gain.reshape(len(gain), rows, *gain.shape[-2:])
    cost, status, iterations = (x.reshape(rows) for x in (plan.cost, plan.status, plan.iterations))
    return Found(states, torque, gain, cost, torch.zeros_like(cost), status, iterations)


def planned(passes: Passes, batch: torch.Size, found: Found) -> Plan:
    """Plan of rows, with their batch axes."""

    def shaped(x: Tensor, axis: int) -> Tensor:
        return x.unflatten(axis, batch) if batch else x.squeeze(axis)

    states = State(**{name: shaped(x, 1) for name, x in found.states.items()})
    cost, status, iterations = (shaped(x, 0) for x in (found.cost, found.status, found.iterations))
    limits = passes.limits and (shaped(passes.limits[0], 0), shaped(passes.limits[1], 0))
    plan = Plan(shaped(found.torque, 1), states, shaped(found.gain, 1), cost, status, iterations, limits)
    return plan._replace(control=passes.problem.control)


def converged(
    passes: Passes,
    start: Mapping[str, Tensor],
    found: Found,
    cold: bool,
    iterations: int,
    tolerance: float,
    notice: Progress,
) -> Found:
    """Rows after iterations of LQR; limits hold from the first one on unless the start is `cold`."""
    if passes.limits is not None and cold:
        found = _roughly(passes, start, found, iterations, notice.within("first without limits"))
    return improved(passes, start, found, iterations, tolerance, notice.at)


def _roughly(
    passes: Passes, start: Mapping[str, Tensor], found: Found, iterations: int, at: Callable[[str], None]
) -> Found:
    """Start of problems with limits: the states of solutions without them, followed under them."""
    least = torch.full_like(found.torque[0], -torch.inf)  # the programs are those that have limits
    free = improved(passes._replace(limits=(least, -least)), start, found, iterations, 0.0, at, ROUGH)
    x, u, cost = passes.forward(start, free.torque, free.followed)
    begin = begun(passes, x, u, cost)._replace(iterations=free.iterations)
    lost = begin.cost.isinf().nonzero()[:, 0]
    if len(lost):  # the start itself is what is left
        of = passes.among(lost)
        own = {name: x.index_select(0, lost) for name, x in start.items()}
        begin.put(lost, begun(of, *of.forward(own, found.torque.index_select(1, lost))))
    return begin


def improved(
    passes: Passes,
    start: Mapping[str, Tensor],
    found: Found,
    iterations: int,
    tolerance: float | None,
    at: Callable[[str], None],
    share: float = 0.0,
) -> Found:
    """Rows after iterations of LQR, each until its expected decrease is below the tolerance, or a share of its cost.

    Without a tolerance all rows take all iterations.
    """
    whole, rows = found, None  # positions of the rows that are left; None: of all
    for k in range(iterations):
        at(f"iteration {k + 1}, {len(found.cost)} left")
        gain, change, terms = passes.backward(found.states, found.torque, found.damping)
        found = found._replace(gain=gain)
        if tolerance is not None:
            expected = _expected(terms)
            least = torch.maximum(tolerance * found.cost.clamp(min=1.0), share * found.cost)
            enough = (expected * (1.0 + found.damping) <= least) & found.cost.isfinite()
            lost = ~expected.isfinite()
            out = enough | lost | (found.damping > MOST)
            if out.any():
                status = torch.where(enough, CONVERGED, torch.where(lost, DIVERGED, STALLED))
                done, on = out.nonzero()[:, 0], (~out).nonzero()[:, 0]
                if rows is None:
                    whole = whole.made([x.clone() for x in found.tensors])
                    rows = torch.arange(len(out), device=out.device)
                whole.put(rows[done], found._replace(status=status).among(done))
                if not len(on):
                    return whole
                rows, found, passes = rows[on], found.among(on), passes.among(on)
                start = {name: x.index_select(0, on) for name, x in start.items()}
                change, terms = change.index_select(1, on), terms.index_select(0, on)
        found = _stepped(passes, start, found, change, terms)
    if rows is None:
        return found
    whole.put(rows, found)
    return whole


def _stepped(passes: Passes, start: Mapping[str, Tensor], found: Found, change: Tensor, terms: Tensor) -> Found:
    """Rows after a step, the longest of some lengths that decreases the cost enough; damped more if there is none."""
    x, u, cost = passes.forward(start, found.torque + change, found.followed)
    good = found.cost - cost >= LEAST * _expected(terms)  # false of what is not a number
    eased = torch.threshold(0.1 * found.damping, 0.1 * DAMPED, 0.0)
    moved = Found(x, u, found.gain, cost, eased, found.status, found.iterations + 1)
    if good.all():
        return moved
    pairs = zip(moved.tensors, found._replace(iterations=moved.iterations).tensors, strict=True)
    moved = found.made([a if a is b else torch.where(good[:, None] if a.ndim > 1 else good, a, b) for a, b in pairs])
    wait, tried = (~good).nonzero()[:, 0], 1
    while len(wait) and tried < LENGTHS:
        number = min(max(TOGETHER // len(wait), 1), LENGTHS - tried)
        each = wait.repeat(number)  # rows by lengths
        length = 0.5 ** torch.arange(tried, tried + number, device=u.device, dtype=u.dtype).repeat_interleave(len(wait))
        of, begin = moved.among(each), {name: y.index_select(0, each) for name, y in start.items()}
        u = torch.addcmul(of.torque, length[:, None], change.index_select(1, each))
        x, u, cost = passes.among(each).forward(begin, u, of.followed)
        good = (of.cost - cost >= LEAST * _expected(terms[each], length)).view(number, -1)
        some = good.any(0)
        best = (good.int().argmax(0) * len(wait) + torch.arange(len(wait), device=wait.device))[some]
        moved.put(wait[some], of._replace(states=x, torque=u, cost=cost, damping=eased[each]).among(best))
        wait, tried = wait[~some], tried + number
    moved.damping.index_copy_(0, wait, (10.0 * found.damping[wait]).clamp(min=DAMPED))
    return moved


def _expected(terms: Tensor, length: Tensor | float = 1.0) -> Tensor:
    """Expected change of the costs, by steps of some length along the changes of the torques."""
    return (terms[:, 0] + 0.5 * length * terms[:, 1]).mul(length).abs()
