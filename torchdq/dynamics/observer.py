"""Momentum observer, on numbers: the torques of contacts, and the force at a frame that exerts them.

The momentum p = M qd balances p' = u + tau + tau_ext, where u = dT/dq - g - friction is its rate without the motors
(De Luca, Mattone, Sensorless robot collision detection and hybrid force/motion control, 2005; C^T qd = dT/dq there).
"""

from torchdq.algebra.matrix import Matrix
from torchdq.algebra.quaternion import Number
from torchdq.dynamics import error_growth, ltdl
from torchdq.dynamics.posed import Row, dot
from torchdq.numbers.functions import maximum

LEAST = 1e-12  # mean square of a Jacobian's rows below which a frame does not move [1 or m^2]


def step(r, p, u, tau, dt, keep):
    """Residual after a step with r' = K (tau_ext - r) and the mean tau_ext in it, on numbers or tensors.

    p and u are pairs before and after the step, tau is that in it, keep is exp(-K dt).
    """
    mean = (p[1] - p[0]) / dt - tau - 0.5 * (u[0] + u[1])
    return mean + keep * (r - mean)


def force(J: Matrix, rows: tuple[int, ...], r: Row, damping: Number) -> tuple[Row, Row, Number]:
    """Force F of least |J^T F - r|^2 + d^2 |F|^2, the part of each component that it shows, and the growth of errors.

    Components count by the scales D of their kind, rotation or displacement: F = (J J^T + d^2 D)^-1 J r = R F_true,
    and the parts are R_ii = 1 - d^2 D_i (J J^T + d^2 D)^-1_ii. R is nearly a projector: where R_ii is 1 the component
    has nothing of others. J has all six rows, `rows` are the numbers of the components, d is the damping.
    """
    squares = [dot(row, row) for row in J]
    scales = [maximum((squares[k] + squares[k + 1] + squares[k + 2]) / 3.0, LEAST) for k in (0, 3)]
    more = [damping * damping * scales[k // 3] for k in rows]
    A = tuple(tuple(dot(J[i], J[k]) + (d if i == k else 0.0) for k in rows) for i, d in zip(rows, more, strict=True))
    m = len(rows)
    before = ltdl.dense(m)
    found = ltdl.factorise(before, A)
    part = [1.0 - d * ltdl.solve(before, found, [float(i == k) for i in range(m)])[k] for k, d in enumerate(more)]
    growth = error_growth.growth([A[k][k] for k in range(m)], found.inverses)
    return ltdl.solve(before, found, [dot(J[k], r) for k in rows]), part, growth
