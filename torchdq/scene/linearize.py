"""Linearization of a step: Jacobian matrices of the state after it, by reverse mode through its program."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchdq.backends.call import batch_of
from torchdq.errors import ArgumentError
from torchdq.scene.recording import Stage
from torchdq.scene.state import State, require_state

if TYPE_CHECKING:
    from torchdq.scene.scene import Scene


class Linearization(NamedTuple):
    """Linear system of a step: s' + ds' = s' + A ds + B du.

    A state s has its rows one after the other: q, qd, then memory and reading where there are such.
    """

    A: Tensor  # [..., s, s] derivative with respect to the state before the step
    B: Tensor  # [..., s, n] derivative with respect to the torques


def linearize(scene: Scene, state: State, given: Mapping[str, Tensor | None]) -> Linearization:
    """Jacobian matrices of a step; see `Scene.linearize`."""
    require_state(state)
    if scene.robot.floating:
        raise ArgumentError(
            f"robot {scene.robot.name!r} must have a fixed base to be linearized, found a free one, whose pose has 8 "
            "components for 6 directions; differentiate scene.step with torch.func.jacrev, which gives the derivatives "
            "in these components, or take finite differences of it"
        )
    scene.spec.require_inputs(name for name in given if name != "noise")
    inputs = {name: x for name, x in given.items() if x is not None}
    batch_of(Stage(scene.spec, "step"), {**state.rows(), **inputs})  # raises, naming what does not fit
    torque = inputs.pop("torque", state.q.new_zeros(scene.n))
    parts = [*state.rows().values(), torque]
    batch = torch.broadcast_shapes(*(x.shape[:-1] for x in (*parts, *inputs.values())), *scene.batches.values())
    names, widths = tuple(state.rows()), [x.shape[-1] for x in parts]

    def after(z: Tensor) -> Tensor:
        *rows, u = z.split(widths, -1)
        stepped = scene.step(State(**dict(zip(names, rows, strict=True))), u, **inputs)
        return torch.cat(list(stepped.rows().values()), -1)

    ends, pull, *_ = torch.func.vjp(after, torch.cat([x.expand(*batch, x.shape[-1]) for x in parts], -1))
    s = ends.shape[-1]
    # samples do not depend on each other, so that one gradient per row of the state is enough for all of them
    units = torch.eye(s, dtype=ends.dtype, device=ends.device).reshape(s, *[1] * len(batch), s)
    (found,) = torch.func.vmap(pull)(units.expand(s, *ends.shape))
    A, B = found.movedim(0, -2).split([s, scene.n], -1)
    return Linearization(A, B)
