"""Signals of joints from those of the motors that drive them, through gears and coupled wrists.

Joints' positions are linear in the motors', q = S m + q0, so that velocities and accelerations follow by S, and, the
transmission being lossless, torques at the joints are S^-T times those at the motors.
"""

import numpy as np

from torchdq.errors import ArgumentError
from torchdq.learning.logs.layouts import Layout
from torchdq.learning.logs.tables import Table


def joint_side(table: Table) -> Table:
    """Table with positions, velocities, accelerations and torques of the joints; efforts by their gains, if known.

    Raises:
        ArgumentError: the layout's gains, transmission or zero are not as many as the joints.
    """
    layout = table.layout
    for name, given in (("gain", layout.gain), ("transmission", layout.transmission), ("zero", layout.zero)):
        if given and len(given) != layout.joints:
            rows = "rows" if name == "transmission" and np.ndim(layout.transmission) == 2 else "numbers"
            raise ArgumentError(f"{name} must have {layout.joints} {rows}, one per joint, found {len(given)}")
    blocks = {signal: _at_joint(layout, signal, x) for signal, x in table.blocks.items()}
    return table._replace(values=np.column_stack([table.time, *blocks.values()]))


def _at_joint(layout: Layout, signal: str, x: np.ndarray) -> np.ndarray:
    """Signal of the joints [rows, n]."""
    if signal == "tau" and layout.gain:
        x = x * [1.0 if gain is None else gain for gain in layout.gain]
    if not layout.transmission or signal not in layout.at_motors:
        return x
    given = np.array(layout.transmission)
    S = np.diag(given) if given.ndim == 1 else given
    if signal == "tau":
        return x @ np.linalg.inv(S)
    return x @ S.T + (np.array(layout.zero or 0.0) if signal == "q" else 0.0)
