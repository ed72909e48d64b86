"""Numpy arrays as a kind of number, one array per component, so that torchdq's formulas run in any precision."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

import torchdq
from accuracy.scenes import Case
from torchdq.program.program import Argument, record, replay, results
from torchdq.robot.fields import LINK_BODY
from torchdq.scene import spec
from torchdq.scene.equations_of_motion import with_growths

LONG = np.longdouble  # 64 bits of mantissa on x86, 53 on machines that have no more: agreements tell


class Rows(np.ndarray):
    """An array [batch...] that knows the operations of programs."""

    def sin(self) -> Rows:
        """Sine."""
        return np.sin(self)

    def cos(self) -> Rows:
        """Cosine."""
        return np.cos(self)

    @staticmethod
    def applied(code: str, x: Sequence[Any]) -> np.ndarray:
        """Value of an operation that is not one of arithmetic."""
        return FUNCTIONS[code](*x).view(Rows)


FUNCTIONS: dict[str, Callable[..., np.ndarray]] = {
    "sin": np.sin,
    "cos": np.cos,
    "sqrt": np.sqrt,
    "max": np.maximum,
    "min": np.minimum,
    "ge": lambda a, b: np.greater_equal(a, b).astype(np.result_type(a, b)),
    "select": lambda mask, a, b: np.where(mask != 0, a, b),
}


def split(x: np.ndarray) -> list[Rows]:
    """Components along the last axis."""
    return [np.ascontiguousarray(x[..., i]).view(Rows) for i in range(x.shape[-1])]


def joined(components: Sequence[Any]) -> np.ndarray:
    """The array of components; numbers among them become constants."""
    return np.stack([np.asarray(c) for c in np.broadcast_arrays(*components)], -1)


def unit(x: np.ndarray) -> np.ndarray:
    """Unit dual quaternions or lines [..., 2 k]: primary parts of length one, dual parts at right angles to them."""
    p, d = np.split(x, 2, -1)
    size = np.sqrt((p * p).sum(-1, keepdims=True))
    p, d = p / size, d / size
    return np.concatenate([p, d - (p * d).sum(-1, keepdims=True) * p], -1)


def exact(robot: torchdq.Robot) -> dict[str, np.ndarray]:
    """Numbers of a robot of revolute joints in extended precision; poses and axes are made unit to that."""
    found = {name: getattr(robot, name).numpy().astype(LONG) for name in ("X_PB_home", "screw", *LINK_BODY)}
    return {**found, "X_PB_home": unit(found["X_PB_home"]), "screw": unit(found["screw"])}


class Formulas:
    """Accelerations of a scene by torchdq's own formulas in the paper's frames, on arrays of any precision.

    They are recorded with the robot's numbers as arguments, all but zeros and ones: a constant would be a float64.
    """

    def __init__(self, case: Case):
        known = {(spec.ROBOT, name): x.ravel() for name, x in exact(case.robot).items()}
        self.numbers = [x for row in known.values() for x in row if x not in (0, 1, -1)]
        inputs = {name: x.tolist() for name, x in case.inputs.items()}
        n = case.robot.n

        def algorithm(q: Sequence, qd: Sequence, u: Sequence, numbers: Sequence) -> dict[str, Sequence]:
            given = iter(numbers)
            tensors = {
                key: tuple(float(x) if x in (0, 1, -1) else next(given) for x in row) for key, row in known.items()
            }
            scene = spec.recorded(case.scene.spec, False, inputs, tensors, ())
            return with_growths(scene, u, lambda system: {"a": system.accelerations(q, qd)})

        arguments = [Argument(name, n) for name in ("q", "qd", "u")] + [Argument("numbers", len(self.numbers))]
        self.program = record("accelerations", arguments, algorithm)

    def __call__(self, q: np.ndarray, qd: np.ndarray, torque: np.ndarray) -> np.ndarray:
        """Accelerations [..., n]."""
        u = np.broadcast_to(torque, q.shape)
        values = replay(self.program, [split(q), split(qd), split(u), self.numbers])
        return joined(results(self.program, values)["a"])
