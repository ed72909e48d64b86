"""Formulas of the functions of robots, on a fixed and on a floating base; `floating` has those of the latter alone."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import reduce

from torchdq.algebra import dual_quaternion, quaternion, screw
from torchdq.algebra.dual_quaternion import DualQuaternion
from torchdq.algebra.quaternion import Number
from torchdq.algebra.screw import Screw
from torchdq.dynamics import closures
from torchdq.dynamics import posed as mechanics
from torchdq.dynamics.aligned.posed import Aligned
from torchdq.functions.posed import BASE, as_screw, factors, frame, gaps, general, solve
from torchdq.functions.recipe import RecipeInputs, Results
from torchdq.numbers.functions import absolute, maximum, minimum, sqrt
from torchdq.program.program import GROWTH, Value


def inverse_dynamics(x: RecipeInputs) -> Results:
    """Torques tau, and before them the wrench on a floating base."""
    at = x.posed()
    forces = at.torques(x.velocities(), x.accelerations(), x.exerted(at))
    if x.base() is None:
        return {"tau": forces}
    return {"F_B": [*forces[3:BASE], *forces[:3]], "tau": forces[BASE:]}


def mass_matrix(x: RecipeInputs) -> Results:
    """Mass matrix M, row-major."""
    return {"M": [entry for row in x.posed().mass_matrix() for entry in row]}


def forward_dynamics(x: RecipeInputs, linear: bool = False) -> Results:
    """Accelerations qdd, by the factors of the mass matrix or, if `linear`, by articulated bodies.

    Before them comes the rate of the twist of a floating base, on which no other wrench acts than that of `f_base`.
    """
    x.require_inertia()
    at, free = x.posed(), () if x.base() is None else (0.0,) * BASE
    bias = at.torques(x.velocities(), None, x.exerted(at))
    forces = (*free, *x.arguments["tau"])
    held = [
        closures.stabilised(gap, len(free))
        for gap in gaps(x.robot, x.on_fixed_base(), x.arguments.get("qd") or (0.0,) * x.robot.n)
    ]
    net = [f if b is None else f - b for f, b in zip(forces, bias, strict=True)]
    a, growth = solve(x.robot, at, net, linear, held)
    rows = {"A_WB_B": a[:BASE], "qdd": a[BASE:]} if free else {"qdd": a}
    return {**rows, GROWTH: [growth]}  # (63) solved for qdd


def forward_dynamics_articulated(x: RecipeInputs) -> Results:
    """Accelerations qdd, by articulated bodies."""
    return forward_dynamics(x, linear=True)


def error_growth(x: RecipeInputs, linear: bool = False) -> Results:
    """Largest ratio of M_ii to its pivot."""
    x.require_inertia()
    return {"growth": [factors(x.robot, x.posed(), linear).growth]}


def error_growth_articulated(x: RecipeInputs) -> Results:
    """Largest ratio of M_ii to its pivot, by articulated bodies."""
    return error_growth(x, linear=True)


def closed_form(x: RecipeInputs, tip_name: str = "") -> Results:
    """Mass matrix M, Coriolis torques c, gravity torques g, and the Jacobian Jt if there is a tip."""
    at = x.posed()
    M, c, g = mechanics.closed_form(at, x.velocities() or ())
    rows: Results = {"M": [entry for row in M for entry in row], "c": c, "g": g}
    if tip_name:
        columns = at.jacobian(*frame(x.robot, tip_name), world=False)
        # a wrench is (force, moment) and a twist (angular, linear)
        rows["Jt"] = [entry for c in columns for entry in _six(None if c is None else screw.swap(c))]  # (72)
    return rows


def loop_torques(x: RecipeInputs) -> Results:
    """Torques tau of a motion of the tree, and the Jacobian J of all closures in the joints, row-major."""
    return {"tau": inverse_dynamics(x)["tau"], "J": closure_gaps(x)["J"]}


def closure_gaps(x: RecipeInputs) -> Results:
    """Gaps of all closures, and their Jacobian J in the joints, row-major."""
    n = x.robot.n
    found = gaps(x.robot, x.on_fixed_base(), None)
    J = [g.columns[k][i] if k in g.columns else None for g in found for i in range(len(g.values)) for k in range(n)]
    return {"g": [value for g in found for value in g.values], "J": J, "cosine": [g.cosine for g in found]}


def loop_step(x: RecipeInputs) -> Results:
    """Step of the free joints towards closed positions; with qd, the part of it that opens the loops.

    Then the largest gap, of a machine of a metre, and the least cosine of an angle between axes that are held together.
    """
    n, free, qd = x.robot.n, x.arguments["free"], x.arguments.get("qd")
    found = gaps(x.robot, x.on_fixed_base(), None)
    size = reduce(maximum, [absolute(y) for g in found for c in g.columns.values() for y in c], 1.0)
    largest = reduce(maximum, [absolute(y) for g in found for y in g.values]) / size
    moved = [g._replace(columns={k: [free[k] * y for y in c] for k, c in g.columns.items()}) for g in found]
    if qd is not None:
        rates = [sum((c[i] * qd[k] for k, c in g.columns.items()), 0.0) for g in moved for i in range(len(g.values))]
        step = closures.nearest(moved, rates, n)
    else:
        whole = closures.nearest(moved, [-y for g in found for y in g.values], n)
        length = sqrt(sum((y * y for y in whole), 0.0))
        step = [closures.FARTHEST / maximum(length, closures.FARTHEST) * y for y in whole]  # as the gap is not linear
    return {"step": step, "gap": [largest], "cosine": [reduce(minimum, [g.cosine for g in found])]}


def regressor(x: RecipeInputs) -> Results:
    """Regressor Y, row-major."""
    blocks = x.posed().regressor(x.velocities(), x.accelerations())
    return {"Y": [entry for row in blocks for block in row for entry in (block or (None,) * 10)]}


def kinetic_energy(x: RecipeInputs) -> Results:
    """Kinetic energy T."""
    return {"T": [x.posed().kinetic_energy(x.velocities() or ())]}


def potential_energy(x: RecipeInputs) -> Results:
    """Potential energy U."""
    return {"U": [x.posed().potential_energy()]}


def forward_kinematics(x: RecipeInputs, *names: str) -> Results:
    """Poses of frames, joint by joint, by elementary screws."""
    at = x.bodies()
    X_WB = at.poses_in_chain() if isinstance(at, Aligned) else at.poses()
    return _poses(x, names, lambda link, X_BF: dual_quaternion.mul(X_WB[link], X_BF))


def forward_kinematics_in_link_frames(x: RecipeInputs, *names: str) -> Results:
    """Poses of frames, joint by joint, in the link frames of the description."""
    X_WB = general(x.robot, x.arguments["q"], x.overrides, x.base()).poses()
    return _poses(x, names, lambda link, X_BF: dual_quaternion.mul(X_WB[link], X_BF))


def forward_kinematics_from_base(x: RecipeInputs, *names: str) -> Results:
    """Poses of frames, by joint screws in the base frame."""
    at = x.bodies()
    if not isinstance(at, Aligned):
        return forward_kinematics(x, *names)
    links = at.poses_from_base()
    mul = dual_quaternion.mul
    return _poses(x, names, lambda link, X_BF: mul(links[link].motion, mul(links[link].home, X_BF)))


def _poses(x: RecipeInputs, names: Sequence[str], pose: Callable[[int, DualQuaternion], DualQuaternion]) -> Results:
    """Poses of frames; `pose(link, X_BF)` is that of a frame on a link."""
    rows: list[Value] = []
    for p, d in (pose(*frame(x.robot, name)) for name in names):
        rows += [*p, *d]
    return {"X": rows}


def jacobian(x: RecipeInputs, name: str, expressed: str) -> Results:
    """Jacobian J, row-major, twist components by joints."""
    columns = x.posed().jacobian(*frame(x.robot, name), world=expressed == "world")
    return {"J": [_six(c)[i] for i in range(6) for c in columns]}


def external_wrenches(x: RecipeInputs, expressed: str, *names: str) -> Results:
    """Wrenches f_ext on the links, and f_base on a floating base, in their frames, of wrenches at frames."""
    links, found = x.bodies().poses(), [screw.ZERO] * (1 + x.robot.sizes["links"])
    for k, name in enumerate(names):
        link, X_BF = frame(x.robot, name)
        turn = quaternion.conj(links[link][0]) if expressed == "world" else X_BF[0]
        X = dual_quaternion.from_pose(turn, dual_quaternion.translation(X_BF))
        F = screw.ad(screw.columns(X), as_screw(x.arguments["wrenches"][6 * k : 6 * k + 6]))
        found[link] = screw.add(found[link], F)
    base = {} if x.base() is None else {"f_base": _six(found[0])}
    return {"f_ext": [entry for F in found[1:] for entry in _six(F)], **base}


def _six(s: Screw | None) -> tuple[Number | None, ...]:
    return (None,) * 6 if s is None else (*s[0], *s[1])
