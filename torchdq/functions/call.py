"""Calls of public functions: from a robot, tensors and options to the results of a recorded program."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from typing import Any, Literal, get_args

import numpy as np
import torch
from torch import Tensor
from torch.compiler import is_compiling

from torchdq.backends.call import Tensors, common_batch, results_of
from torchdq.backends.choice import BackendName
from torchdq.backends.fast_call import quick
from torchdq.base.caches import PROGRAMS, Bounded, remembered
from torchdq.base.checks import NOT_NEGATIVE, NUMBERS, REAL, Check, OneOf, names_of, require, require_tensor, tensor_in
from torchdq.base.progress import FIRST, warn_once
from torchdq.dq.components import unit
from torchdq.errors import ArgumentError
from torchdq.functions.catalogue import Function, recordings
from torchdq.functions.distances import GROUND, pairs
from torchdq.functions.options import options_of
from torchdq.program.transforms import dispatching, with_values
from torchdq.robot import Robot
from torchdq.robot.argument import require_robot
from torchdq.robot.constants import Constants
from torchdq.robot.fields import SHAPES, trailing
from torchdq.robot.robot import arguments, constants

Precision = Literal["auto", "double"]
PRECISION = OneOf(get_args(Precision))
FEW = 2  # programs of single frames of a robot that need no warning
_built: Bounded[tuple[str, Constants], tuple[int, float]] = Bounded(PROGRAMS)  # programs of single frames, and seconds


def function_of(
    name: str,
    robot: Robot,
    given: Tensors,
    backend: BackendName | None,
    options: tuple[Any, ...] = (),
    precision: Precision = "auto",
) -> list[Tensor]:
    """Results of a function of the catalogue, with the broadcast batch axes of all tensors."""
    known, key = constants(require_robot(robot)), None
    if backend is None and precision == "auto" and not robot._arguments:
        key, _, found = quick((known.digest, name, options), given.values())
        if found is not None:
            return found  # type: ignore[return-value]  # a tuple, which is unpacked in a fraction of a list's time
    what = Function(known, name, options)
    double = precision != "auto" and check_precision(precision) == "double"
    return [*results_of(what, with_tensors(robot, given), backend, double, key=key)[1]]


def with_options(name: str, robot: Robot, given: Tensors, backend: BackendName | None, *options: Any) -> list[Tensor]:
    """Results of a function with options, None where they are absent."""
    return function_of(name, robot, given, backend, options_of(require_robot(robot), name, options))


def with_tensors(robot: Robot, given: Tensors) -> Tensors:
    """Arguments of a function, together with the tensors of the robot that are arguments of its programs."""
    names = arguments(robot)
    return {**given, **{name: getattr(robot, name) for name in names}} if names else given


def check_precision(precision: Precision) -> Precision:
    """Precision, after a check of its name."""
    require("precision", precision, PRECISION)
    return precision


def check(robot: Robot, optional: Sequence[str] = (), **quantities: Tensor | None) -> tuple[int, ...]:
    """Broadcast batch axes of quantities [..., n] of the joints, or `f_tip` [..., 6], and a robot with a fixed base.

    Raises, naming the argument, unless all have their trailing axes, one dtype, one device, and batch axes that
    broadcast with each other and with the robot's; those that `optional` names may be None.
    """
    sizes = require_robot(robot).sizes
    if robot.floating:
        raise ArgumentError(f"robot {robot.name!r} must have a fixed base here, found a floating one")
    for name, x in quantities.items():
        if name not in optional:
            require_tensor(name, x)
    inputs = [
        (name, x, (6,) if name == "f_tip" else (robot.n,), False) for name, x in quantities.items() if x is not None
    ]
    parameters = [
        (f"robot.{name}", getattr(robot, name), trailing(SHAPES[name], sizes), True) for name in arguments(robot)
    ]
    return common_batch([*inputs, *parameters], f" for the {robot.n} joints of robot {robot.name!r}")


def gain(name: str, value: Tensor | float, q: Tensor, check: Check = NOT_NEGATIVE) -> Tensor:
    """Parameter as a tensor, one number in the dtype of q; entries of a tensor are not checked."""
    if isinstance(value, Tensor) and value.ndim:
        return value
    if isinstance(value, Tensor):
        if value.is_complex() or value.dtype == torch.bool:
            raise ArgumentError(f"{name} must be a real number, found {value}")
        return value.to(q)
    if not isinstance(value, NUMBERS):
        cure = "; use torch.as_tensor" if isinstance(value, list | tuple | np.ndarray) else ""
        raise ArgumentError(f"{name} must be a number or a tensor, found {type(value).__name__}{cure}")
    require(name, value, check)
    if is_compiling() or dispatching() or q.device.type != "cpu":  # a CUDA graph takes back the memory that it fills
        return torch.full((), value, dtype=q.dtype, device=q.device)
    return _number(name, value, q.dtype)


@remembered(PROGRAMS)
def _number(name: str, value: float, dtype: torch.dtype) -> Tensor:
    """Number as a tensor, for all calls, since to make one takes longer than the rest of a check; no two are one."""
    with torch.inference_mode(False), with_values():
        return torch.full((), value, dtype=dtype, device="cpu")


def poses(
    name: str, robot: Robot, given: Tensors, frame: str | Sequence[str] | None, backend: BackendName | None
) -> Tensor:
    """Pose [..., 8] of one frame by its name, or [..., frames, 8] of several or all."""
    known = require_robot(robot).frame_names
    if isinstance(frame, str):
        otherwise = "frame=[...] takes the names of all of them in one program"
        return of_one_frame(name, robot, given, (frame,), backend, otherwise, 5).squeeze(-2)
    names = known if frame is None else names_of("frame", frame, known, f"frame of robot {robot.name!r}")
    if not names:
        raise ArgumentError(f"frame must name one frame at least, found none; known: {', '.join(known)}")
    return function_of(name, robot, given, backend, names)[0]


def on_links(
    name: str,
    robot: Robot,
    given: Tensors,
    wrenches: Mapping[str, Tensor],
    expressed: str,
    backend: BackendName | None,
) -> list[Tensor]:
    """Results of wrenches [..., 6] at frames, by the name of their frame."""
    if not (isinstance(wrenches, Mapping) and wrenches):
        found = "none" if isinstance(wrenches, Mapping) else type(wrenches).__name__
        raise ArgumentError(f"wrenches must be a dictionary of wrenches by the name of their frame, found {found}")
    options = options_of(require_robot(robot), name, (expressed, *wrenches))
    batch = common_batch([(f"wrenches[{x!r}]", F, (6,), False) for x, F in wrenches.items()], "")
    rows = torch.stack([F.expand(*batch, 6) for F in wrenches.values()], -2)
    return function_of(name, robot, {**given, "wrenches": rows}, backend, options)


def of_pairs(
    name: str,
    robot: Robot,
    given: dict[str, Any],
    of: tuple[Any, Sequence[Any], bool],
    backend: BackendName | None,
) -> tuple[Tensor, tuple[tuple[str, str], ...]]:
    """Distances [..., pairs], and the pairs; `of` are the points, the objects, and whether those among points count."""
    (points, objects, own), q = of, given["q"]
    bodies, ground = [body.shape for body in objects], given["height"] is not None
    templates = tuple(body.template() for body in bodies)
    points = tuple(points) if isinstance(points, list) else points  # hashable
    options = options_of(require_robot(robot), name, (points, templates, GROUND * ground, "own" * bool(own)))
    names = pairs(robot, *options)
    if not names:
        raise ArgumentError("distances must be from something: give objects, a height of the ground, or own=True")
    require_tensor("q", q)
    tensors = [(f"{key} of {x.name}", y.to(q), x.SHAPES[key], True) for x in bodies for key, y in x.tensors().items()]
    if tensors:
        batch = common_batch(tensors, "")
        rows = [y.expand((*batch, *axes)).reshape((*batch, math.prod(axes))) for _, y, axes, _ in tensors]
        given = {**given, "sizes": torch.cat(rows, -1)}
    if ground:
        given = {**given, "height": gain("height", given["height"], q, REAL)}
    (found,) = function_of(name, robot, given, backend, options)
    for key in ("X_WB", "X_WO", "normal"):  # whose shapes are right by now
        if given.get(key) is not None:
            unit(key, tensor_in(given[key]))
    return found, names


def of_one_frame(
    name: str,
    robot: Robot,
    given: Tensors,
    options: tuple[str, ...],
    backend: BackendName | None,
    otherwise: str = "they are kept on disk, and the next process finds them there",
    stacklevel: int = 4,
) -> Tensor:
    """Result for one frame; warns once if the programs of single frames of a robot took more than 2 s in all."""
    names = options_of(require_robot(robot), name, options)
    if is_compiling():
        return function_of(name, robot, given, backend, names)[0]
    before, start = recordings(), time.perf_counter()
    found = function_of(name, robot, given, backend, names)[0]
    if recordings() != before:
        key = (name, constants(robot))
        number, seconds = _built.get(key, (0, 0.0))
        _built[key] = number, seconds = number + 1, seconds + time.perf_counter() - start
        if number > FEW and seconds > FIRST:
            text = f"{name} built {number} programs in {seconds:.1f} s, one for each frame of robot {robot.name!r}"
            warn_once(f"{name} of {key[1].digest}", f"{text}; {otherwise}", stacklevel=stacklevel)
    return found
