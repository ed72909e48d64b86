"""Linearization of a step: a compiled program of its derivatives, or reverse mode through what torch computes in it.

The program has all columns of the matrices, which share their common terms, and the many numbers that vanish cost
nothing; or, where that would be too long to compile, one column for each branch of the robot, such as a leg, and the
columns of a branch are samples.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from torchdq import dq
from torchdq.backends.call import batch_of, evaluate
from torchdq.backends.choice import BackendName
from torchdq.base.caches import PROGRAMS, Bounded
from torchdq.program.transforms import constant_in_graphs
from torchdq.robot.robot import constants
from torchdq.scene.free_base import POSE
from torchdq.scene.model import SceneModel
from torchdq.scene.recording import Stage, branches
from torchdq.scene.spec import POSES, SceneSpec
from torchdq.scene.state import State, require_state

LARGEST = 150_000  # operations of a step times columns, up to which a program of all columns compiles within 20 s
_lengths: Bounded[SceneSpec, int] = Bounded(PROGRAMS)  # that number for a scene
PURE = [1, 2, 3, 5, 6, 7]  # numbers of a pure dual quaternion


class Linearization(NamedTuple):
    """Linear system of a step: s' + ds' = s' + A ds + B du.

    The numbers of ds are (q, qd) for a fixed base and (xi, q, V_WB_B, qd) for a floating one, then memory and reading
    where there are such. xi, six numbers, displaces the pose to X_WB exp(xi/2): a rotation and a translation (angular,
    linear) in the axes of the base [rad, m].
    """

    A: Tensor  # [..., s, s] derivative with respect to the state before the step
    B: Tensor  # [..., s, n] derivative with respect to the torques


def linearize(
    scene: SceneModel, state: State, torque: Tensor | None = None, noise: Tensor | None = None, **inputs: Tensor | None
) -> Linearization:
    """Derivatives of the state after a step, with respect to the state before it and the torques: `A, B`.

    A is larger than [2 n, 2 n] if effects have memory, as elastic joints, or there are sensors, whose numbers are part
    of the state: see `Linearization`. `(dq.Pose(X).inverse() @ dq.Pose(X_WB)).log()` is the displacement xi of a
    floating base from a pose X. The first call compiles a program of all columns of A and B, or, where that would take
    longer than 20 s, of one for each branch of the robot; where torch computes a part of a step (`HeightMap`,
    `Residual`) or it is a loop (of many substeps, or of `DormandPrince`), there are gradients instead.

    Args:
        state: states, shape [..., n]; derivatives are those of every row by itself.
        torque, noise, inputs: as in `step`.

    >>> import torch, torchdq
    >>> scene = torchdq.Scene(torchdq.robots.load("two_link"), dt=0.01)
    >>> A, B = scene.linearize(scene.start(torch.zeros(5, 2)))
    >>> A.shape, B.shape
    (torch.Size([5, 4, 4]), torch.Size([5, 4, 2]))
    """
    require_state(state)
    scene.spec.require_inputs(inputs)
    torque = torch.zeros_like(state.q) if torque is None else torque
    given = {"torque": torque, **{name: x for name, x in inputs.items() if x is not None}}
    if scene.looped or scene.computed:
        return _by_reverse_mode(scene, state, given, noise)
    given = scene._with_noise({**state.rows(), **given}, noise)
    constants(scene.robot)  # raises if they were changed in place
    what, given = Stage(scene.spec, "step", wrt=("torque",)), {**given, **scene.parameters}
    _, A, B = derivatives(what, given, length(scene) <= LARGEST, scene.backend, scene.precision == "double")
    return Linearization(A, B)


@constant_in_graphs
def length(scene: SceneModel) -> int:
    """Operations of a step times columns of its matrices, more than a program of all columns has."""
    if scene.spec not in _lengths:
        _lengths[scene.spec] = scene.count().total * (sum(scene.spec.displaced.values()) + scene.n)
    return _lengths[scene.spec]


def derivatives(
    what: Stage, given: Mapping[str, Tensor], whole: bool, backend: BackendName | None, double: bool = False
) -> tuple[Tensor, Tensor, Tensor]:
    """State after a step and its derivatives A, B in the state and `what.wrt`, by all columns or one of a branch."""
    (control,) = what.wrt or ()
    if whole:
        found = evaluate(what, given, backend, double)
        return found["after"], found["A"], found[control]
    q, sizes = given["q"], (sum(what.spec.displaced.values()), given[control].shape[-1])
    columns = branches(what.spec)
    units = torch.zeros(max(map(len, columns)), sum(sizes), dtype=q.dtype, device=q.device)
    for branch in columns:
        units[range(len(branch)), branch] = 1.0
    units = units.unflatten(0, (-1, *(1,) * len(batch_of(what._replace(wrt=None), given))))
    found = evaluate(what, {**given, "direction": units}, backend, double)
    along, both = found["A"].movedim(-1, 0), q.new_empty(*found["A"].shape[1:-2], sum(sizes), sizes[0])
    for k, branch in enumerate(columns):
        both[..., branch, :] = along[k, : len(branch)].movedim(0, -2)
    return found["after"][0], *both.mT.split(sizes, -1)


def _by_reverse_mode(
    scene: SceneModel, state: State, given: Mapping[str, Tensor], noise: Tensor | None
) -> Linearization:
    """Linearization by the gradients of every number of the state after a step, through what torch computes in it."""
    rows = state.rows()
    given = given if noise is None else {**given, "noise": noise}
    batch = batch_of(Stage(scene.spec, "step"), {**rows, **given, **scene.parameters})
    names = list(scene.spec.displaced)
    parts = [*(rows[name] for name in names), given["torque"]]
    widths = [x.shape[-1] for x in parts]

    def after(z: Tensor) -> Tensor:
        *before, u = z.split(widths, -1)
        found = scene.step(State(**dict(zip(names, before, strict=True))), **{**given, "torque": u}).rows()
        return torch.cat([found[name] for name in names], -1)

    ends, pull, *_ = torch.func.vjp(after, torch.cat([x.expand(*batch, x.shape[-1]) for x in parts], -1))
    units = torch.eye(ends.shape[-1], dtype=ends.dtype, device=ends.device).expand(*batch, -1, -1)
    poses = POSE * scene.spec.free
    if poses:  # a pose X changes by dX = X xi/2, so that xi = 2 conj(X) dX
        each = 2 * dq.paper.hamilton_left(dq.conj(ends[..., :poses].unflatten(-1, (-1, POSE))))[..., PURE, :]
        displaced = _block_diagonal(each)
        units = torch.cat([torch.nn.functional.pad(displaced, (0, units.shape[-1] - poses)), units[..., poses:, :]], -2)
    # samples do not depend on each other, so that one gradient per row of the state is enough for all of them
    (found,) = torch.func.vmap(pull)(units.movedim(-2, 0))
    found = found.movedim(0, -2)
    if poses:
        X = torch.cat([rows[name] for name in POSES if name in rows], -1).unflatten(-1, (-1, POSE))
        directions = _block_diagonal(dq.paper.hamilton_left(X)[..., PURE] / 2)
        found = torch.cat([found[..., :poses] @ directions, found[..., poses:]], -1)
    A, B = found.split([units.shape[-2], scene.n], -1)
    return Linearization(A, B)


def _block_diagonal(blocks: Tensor) -> Tensor:
    """Matrices [..., k rows, k columns] of k blocks [..., k, rows, columns] on their diagonals."""
    k, rows, columns = blocks.shape[-3:]
    found = torch.eye(k, dtype=blocks.dtype, device=blocks.device)[:, None, :, None] * blocks.unsqueeze(-2)
    return found.reshape(*blocks.shape[:-3], k * rows, k * columns)
