"""Inverse kinematics on numbers: steps of Levenberg-Marquardt within the joint limits, with restarts.

    q <- projection of q + J^T (J J^T + (DAMPING e.e + LEAST) 1)^-1 e

e is the error of a frame and J its rate -de/dq. A joint at a limit that the gradient J^T e pushes outwards is left out
of the step, so that the others make up for it. A start is given up where e.e is not below SLOWEST of its running mean.

Where no start has converged, the last steps go on from the best of all, and from LAST of the starts once more, as long
as e.e falls. There e does not vanish, and J J^T lacks the curvature of its components, which is of the size |e| |J|:
damped by SPREAD of that, steps are short enough to end at the closest point.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import reduce

import torch
from torch import Tensor

from torchdq.algebra import dual_quaternion as dq
from torchdq.algebra import quaternion as quat
from torchdq.algebra import screw
from torchdq.algebra.matrix import Matrix
from torchdq.algebra.quaternion import Number
from torchdq.algebra.screw import Screw
from torchdq.backends.call import Computation
from torchdq.backends.choice import BackendName
from torchdq.backends.loop_call import repeat_while
from torchdq.base.caches import PROGRAMS, remembered
from torchdq.dq import pose_error
from torchdq.dynamics import ltdl
from torchdq.dynamics.posed import Row, dot
from torchdq.dynamics.task_space import Task
from torchdq.functions.recipe import RecipeInputs, Results
from torchdq.functions.task_space import pose_of, pose_of_any_norm
from torchdq.functions.task_space_formulas import task_of
from torchdq.numbers.functions import absolute, at_least, below, clip, floor, maximum, minimum, select, sqrt
from torchdq.program.transforms import with_values
from torchdq.robot.constants import Constants
from torchdq.robot.robot import Robot, arguments, constants, recorded

DAMPING, LEAST = 0.03, 1e-9
SLOWEST, FIRST = 0.9, 2.0  # below 1, so that every start ends; the mean at a start is FIRST times its e.e
PATIENT, SPREAD, LAST = 1.0 - 2.0**-30, 0.5, 8  # of the last steps
SINGULAR = 1e-10  # pivots of J J^T are at least this share of its diagonal where it is not damped
STEPS, FEW = 8, 64  # steps until rows are looked at, and rows from which a look is cheaper than their steps
FAR = 1e3  # [m] distance beyond which the direction of a goal decides, and its square does not overflow
GIVEN = 1e-3  # share of a twist that may be missing


def deviation(x: RecipeInputs, name: str, expressed: str, axes: str) -> tuple[Screw, Task, Matrix, Number]:
    """Error of a frame, (rotation vector, displacement) to the desired pose, its task, rates -de/dq, and a share.

    It is that which is left of a translation farther than `FAR`.
    """
    at, task, X_des = x.posed(), task_of(x, name, expressed, axes), x.arguments["X"]
    near, far = (reduce(maximum, map(absolute, half)) for half in (X_des[:4], X_des[4:]))
    share = select(below(FAR * near, far), FAR * near / far, 1.0)
    X, goal = pose_of(at, task), pose_of_any_norm([*X_des[:4], *[share * a for a in X_des[4:]]])
    if task.world:  # the other way round, since the axes do not turn with the frame
        back, p = quat.mul(X[0], quat.conj(goal[0])), quat.sub(dq.translation(goal), dq.translation(X))
    else:
        to_goal = dq.mul(dq.conj(X), goal)
        back, p = to_goal[0], dq.translation(to_goal)
    turn = pose_error.error((back, dq.ZERO))[0]
    turns, moves = (sum(r // 3 == kind for r in task.rows) for kind in (0, 1))
    columns = []
    for c in at.jacobian(task.link, task.X_BF, task.world):
        w, v = c or screw.ZERO
        # components that are left out do not vanish at a solution, and count in the rates of the others
        rate = pose_error.error_rate((turn, quat.ZERO), (w, quat.ZERO))[0] if 0 < turns < 3 else w
        columns.append(task.of((rate, quat.add(v, quat.cross(w, p)) if 0 < moves < 3 and not task.world else v)))
    return (quat.neg(turn) if task.world else turn, p), task, tuple(zip(*columns, strict=True)), share


@remembered(PROGRAMS)
def _given(of: Constants, settings: tuple[float, ...], dtype: torch.dtype, device: torch.device) -> tuple[Tensor, ...]:
    """Limits, the first start, no best yet, the first state, and the settings, for all calls; see `step`."""
    with torch.inference_mode(False), with_values():
        robot = recorded(of)
        middle = start(0.0, ranges(robot))
        numbers = (middle, [math.nan] * len(middle), [1.0, 0.0, 0.0, *[math.inf] * 3], settings)
        made = [torch.tensor(x, dtype=dtype, device=device) for x in numbers]
        return (*(bound.to(device, dtype) for bound in robot.limits[:2]), *made)


def ranges(robot: Robot) -> list[tuple[float, float]]:
    """Limits of the joints."""
    return list(zip(robot.limits.lower.tolist(), robot.limits.upper.tolist(), strict=True))


def start(k: Number, limits: Sequence[tuple[float, float]]) -> list[Number]:
    """Point k of a sequence that fills the limits evenly, the middle first; without limits a turn.

    It is the additive recurrence of the powers of 1/g, g^(n+1) = g + 1 (Roberts, The unreasonable effectiveness of
    quasirandom sequences, 2018).
    """
    g, found = 2.0, []
    for _ in range(64):
        g = (1.0 + g) ** (1.0 / (len(limits) + 1))
    for j, (lower, upper) in enumerate(limits):
        least = lower if math.isfinite(lower) else upper - 2 * math.pi if math.isfinite(upper) else -math.pi
        size = upper - least if math.isfinite(upper) else 2 * math.pi
        u = 0.5 + k * g ** -(j + 1.0)
        found.append(least + size * (u - floor(u)))
    return found


def _factors(J: Matrix, damping: Number | None) -> ltdl.TreeFactors:
    """Factors of J J^T, with a damping on its diagonal; None: with pivots that are not zero."""
    A = [[dot(a, b) for b in J[: i + 1]] for i, a in enumerate(J)]
    least = [SINGULAR * row[-1] + LEAST**2 for row in A]
    if damping is not None:
        A = [[*row[:-1], row[-1] + damping] for row in A]
    pivot = None if damping is not None else lambda k, d: maximum(d, least[k])
    return ltdl.factorise(ltdl.dense(len(J)), tuple(map(tuple, A)), pivot)


def _free(J: Matrix, held: Row) -> Matrix:
    """Jacobian without the joints that are held."""
    return tuple(tuple(select(h, 0.0, c) for h, c in zip(held, row, strict=True)) for row in J)


def _least_norm(J: Matrix, factors: ltdl.TreeFactors, b: Row) -> list[Number]:
    y = ltdl.solve(ltdl.dense(len(J)), factors, b)
    return [dot(column, y) for column in zip(*J, strict=True)]


def step(x: RecipeInputs, *options: str) -> Results:
    """Next q of a row, its best so far, and its state; where it has converged or has no starts left, the same again.

    The state is whether it goes on, the number of the start, whether it has converged, the mean of e.e, and the sizes
    of both parts of the best e; the settings are the largest of these, the number of starts, and that with the last
    steps.
    """
    q, best, state, settings = (x.arguments[name] for name in ("q", "best", "state", "settings"))
    active, k, converged, mean, *least = state
    limits, (e, task, J, share) = ranges(x.robot), deviation(x, *options)
    kinds = [[a for r, a in enumerate((*e[0], *e[1])) if r in task.rows and r // 3 == kind] for kind in (0, 1)]
    squares, wanted = [dot(kind, kind) for kind in kinds], task.of(e)
    total = squares[0] + squares[1]
    close = at_least(settings[0] * settings[0], squares[0]) * at_least(settings[1] * settings[1], squares[1])
    last, sizes = at_least(k, settings[2]), (sqrt(squares[0]), sqrt(squares[1]) / share)
    so_far = (least[0], share * least[1])
    better = active * below(total, dot(so_far, so_far))
    best = [select(better, a, b) for a, b in zip(q, best, strict=True)]
    runs = below(total, select(last, PATIENT, SLOWEST) * mean)
    again, goes = (active * (1.0 - close) * share for share in (1.0 - runs, runs))

    push = [dot(column, wanted) for column in zip(*J, strict=True)]
    held = [
        at_least(lower, a) * at_least(0.0, p) + at_least(a, upper) * at_least(p, 0.0)
        for a, p, (lower, upper) in zip(q, push, limits, strict=True)
    ]
    free = _free(J, held)
    curved = select(last, SPREAD * sqrt(total * sum(dot(row, row) for row in free)), 0.0)
    change = _least_norm(free, _factors(free, DAMPING * total + LEAST + curved), wanted)
    moved = [clip(a + d, *bounds) for a, d, bounds in zip(q, change, limits, strict=True)]
    after, converged = k + again, maximum(converged, active * close)
    number = select(at_least(after, settings[2]), after - settings[2], after)  # 0 after the first: the best
    fresh = [select(at_least(0.0, number), b, a) for a, b in zip(start(number, limits), best, strict=True)]
    mean = select(at_least(mean, math.inf), FIRST * total, select(last, total, 0.5 * (mean + total)))
    return {
        "q": [select(again, s, select(goes, b, a)) for s, b, a in zip(fresh, moved, q, strict=True)],
        "best": best,
        "state": [
            at_least(settings[3], after) * (1.0 - converged),
            after,
            converged,
            select(again, math.inf, mean),
            *[select(better, a, b) for a, b in zip(sizes, least, strict=True)],
        ],
    }


def solve(
    what: Computation,
    robot: Robot,
    X: Tensor,
    begin: Tensor | None,
    settings: tuple[float, ...],
    backend: BackendName | None,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Best q, whether it has converged, both parts of its error, and the number of starts taken.

    Args:
        what: `step` as a computation.
        robot, X: as in `inverse_kinematics`.
        begin: positions of the first start; None: the middle of the limits.
        settings: as in `step`.
    """
    lower, upper, middle, none, state, numbers = _given(constants(robot), settings, X.dtype, X.device)
    q = middle if begin is None else begin.detach().clamp(lower, upper)
    found = repeat_while(
        lambda now: now["state"][..., 0] > 0,
        what,
        lambda rows: STEPS if rows > FEW else 4 * STEPS,
        {"q": q, "best": none, "state": state},  # NaN is left where no start has an error
        {"X": X, "settings": numbers, **{k: getattr(robot, k).detach() for k in arguments(robot)}},
        backend,
    )
    _, k, converged, _, error = found["state"].split_with_sizes((1, 1, 1, 1, 2), -1)
    return found["best"], converged[..., 0] > 0, error, (k[..., 0].long() + 1).clamp(max=int(settings[2]))


def newton(x: RecipeInputs, *options: str) -> Results:
    """Error e of the components, and the matrix J^+ of the step J^+ e."""
    e, task, J, _ = deviation(x, *options)
    factors, m = _factors(J, None), len(J)
    columns = [_least_norm(J, factors, [float(i == k) for i in range(m)]) for k in range(m)]
    return {"e": task.of(e), "P": [a for row in zip(*columns, strict=True) for a in row]}


def differential(x: RecipeInputs, name: str, expressed: str, axes: str, bounded: str) -> Results:
    """Joint velocities of a share of a twist, and that share.

    Joints that stand at a limit and would leave it are held, twice, and the others take over.
    """
    q, V, dt = x.arguments["q"], x.arguments["V_des"], x.arguments.get("dt")
    J = task_of(x, name, expressed, axes).jacobian(x.posed())
    rooms: list[tuple[Number, Number]] = []
    for a, (lower, upper), v in zip(q, ranges(x.robot), x.robot.limits.velocity.tolist(), strict=True):
        fastest = v if v > 0 and bounded else math.inf
        near = (math.inf, math.inf) if dt is None else [maximum(r, 0.0) / dt[0] for r in (a - lower, upper - a)]
        rooms.append((minimum(fastest, near[0]), minimum(fastest, near[1])))
    held: list[Number] = [0.0] * len(q)
    for _ in range(3):
        free = _free(J, held)
        qd = _least_norm(free, _factors(free, None), V)
        room = [select(below(v, 0.0), *r) for v, r in zip(qd, rooms, strict=True)]
        stuck = [at_least(0.0, r) * below(0.0, absolute(v)) for r, v in zip(room, qd, strict=True)]
        held = [maximum(h, at) for h, at in zip(held, stuck, strict=True)]
    share: Number = 1.0
    for v, r in zip(qd, room, strict=True):
        fits = at_least(r, absolute(v))
        share = minimum(share, select(fits, 1.0, r / select(fits, 1.0, absolute(v))))
    missing = [dot(row, qd) - v for row, v in zip(J, V, strict=True)]
    share = select(at_least(GIVEN**2 * dot(V, V), dot(missing, missing)), share, 0.0)
    return {"qd": [share * v for v in qd], "scale": [share]}
