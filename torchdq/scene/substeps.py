"""The flow of a step as a loop over one program: of a substep, or of an attempt of a step of `DormandPrince`.

Where a backend compiles, many evaluations of the program are one call. Adaptive rows go on until all have arrived,
which the host looks at after blocks of attempts; a row that has arrived stands still. Gradients are those of the
accepted steps, which are taken once more with the sizes that were found.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping

import torch
from torch import Tensor

from torchdq.backends.choice import BackendName
from torchdq.backends.loop_call import repeat, repeatable
from torchdq.base.progress import Progress
from torchdq.errors import ArgumentError
from torchdq.program.autograd import in_a_graph
from torchdq.scene.integrators import DormandPrince
from torchdq.scene.recording import CLOCK, GOAL, TAKEN, Stage
from torchdq.scene.spec import SceneSpec

FIRST, MOST = 8, 64  # attempts in the first block and, doubled from one to the next, in the largest


def flow(
    spec: SceneSpec, x: Tensor, v: Tensor, held: Mapping[str, Tensor], backend: BackendName | None
) -> tuple[Tensor, Tensor]:
    """Positions and velocities [..., n] at the end of a step, under rows and parameters that are held over it."""
    if isinstance(spec.integrator, DormandPrince):
        return _adaptive(spec, spec.integrator, x, v, held, backend)
    h = x.new_full((1,), spec.dt / spec.substeps)
    start, fixed = {"x": x, "v": v}, {"h": h, **held}
    rows = repeat(Stage(spec, "substep"), spec.substeps, start, {}, fixed, ends=True, backend=backend)
    return rows["x"], rows["v"]


def _adaptive(
    spec: SceneSpec,
    integrator: DormandPrince,
    x: Tensor,
    v: Tensor,
    held: Mapping[str, Tensor],
    backend: BackendName | None,
) -> tuple[Tensor, Tensor]:
    """Positions and velocities at the end of a step by attempts whose sizes adapt; NaN in rows that do not arrive."""
    if torch.compiler.is_compiling():
        raise ArgumentError(
            "integrator must not be DormandPrince in a graph of torch.compile or torch.export: its steps depend on "
            "values, of which a graph has none; RungeKutta4 has steps of one size"
        )
    rounding, T, most = 100 * torch.finfo(x.dtype).eps, spec.dt, integrator.most
    rtol = max(integrator.rtol, rounding)
    if rtol > integrator.rtol:
        warnings.warn(f"rtol {integrator.rtol:g} is below the rounding of {x.dtype}; {rtol:.1g} is used", stacklevel=2)
    goal = x.new_tensor([T, rtol, integrator.atol, rounding])
    fixed = {GOAL: goal, **{name: y.detach() for name, y in held.items()}}
    # a sixteenth of the way as first step
    rows = {"x": x.detach(), "v": v.detach(), CLOCK: x.new_tensor([0.0, T / 16, 1.0]).expand(*x.shape[:-1], -1)}
    found, count, block = list[Tensor](), 0, FIRST if repeatable(x, backend) else 1
    with torch.no_grad(), Progress(f"steps of DormandPrince over {T:g} s") as notice:
        while count < most and bool((rows[CLOCK][..., 2] > 0).any()):  # NaN in rows without a mass matrix
            notice.at(f"{count} of at most {most}")
            times = min(block, most - count)
            rows = repeat(Stage(spec, "attempt"), times, rows, {}, fixed, ends=True, backend=backend)
            found.append(rows.pop(TAKEN))
            count, block = count + times, min(2 * block, MOST) if block > 1 else 1
    arrived = rows[CLOCK][..., :1] >= goal[0] * (1.0 - goal[3])
    if in_a_graph([x, v, *held.values()]):
        sizes = torch.cat(found) if found else x.new_empty(0, *x.shape[:-1], 1)
        sizes = sizes[sizes.flatten(1).any(1)]
        start, accepted = {"x": x, "v": v}, {TAKEN: sizes}
        rows = repeat(Stage(spec, "substep"), len(sizes), start, accepted, held, ends=True, backend=backend)
    return torch.where(arrived, rows["x"], torch.nan), torch.where(arrived, rows["v"], torch.nan)
