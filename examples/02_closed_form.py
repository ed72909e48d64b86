"""Closed form of the paper's two-link arm, tau = M qdd + c + g + Jt f_tip, compared with textbook equations.

    python examples/02_closed_form.py

The arm is planar: two uniform rods of 1 kg and 1 m, the first angle from the horizontal, gravity along -y.
"""

import sys
from math import cos, sin

import torch

import torchdq

m, l, gravity = 1.0, 1.0, 9.81
a = m * l**2 / 12 + m * (l / 2) ** 2  # a rod about its end
b = m * l * l / 2  # a rod's mass, on the lever of the other


def main() -> float:
    """Largest difference between the equations and the closed form."""
    q1, q2 = q = 0.4, -1.1
    v1, v2 = qd = 0.8, 1.5
    arm = torchdq.robots.load("two_link")
    M, c, g, Jt = torchdq.closed_form(arm, *(torch.tensor(x, dtype=torch.float64) for x in (q, qd)))
    rows = [
        ("M11", "2a + m l^2 + 2b cos q2", 2 * a + m * l**2 + 2 * b * cos(q2), M[0, 0]),
        ("M12", "a + b cos q2", a + b * cos(q2), M[0, 1]),
        ("M21", "a + b cos q2", a + b * cos(q2), M[1, 0]),
        ("M22", "a", a, M[1, 1]),
        ("c1", "-b sin q2 (2 q1' + q2') q2'", -b * sin(q2) * (2 * v1 + v2) * v2, c[0]),
        ("c2", "b sin q2 q1'^2", b * sin(q2) * v1**2, c[1]),
        ("g1", "m g (3/2 l cos q1 + l/2 cos(q1 + q2))", m * gravity * l * (3 * cos(q1) + cos(q1 + q2)) / 2, g[0]),
        ("g2", "m g l/2 cos(q1 + q2)", m * gravity * l * cos(q1 + q2) / 2, g[1]),
        # on the force (fx, fy) and the moment tz, in the axes of the second rod; the rest is zero
        ("Jt1 fx", "l sin q2", l * sin(q2), Jt[0, 0]),
        ("Jt1 fy", "l + l cos q2", l + l * cos(q2), Jt[0, 1]),
        ("Jt1 tz", "1", 1.0, Jt[0, 5]),
        ("Jt2 fx", "0", 0.0, Jt[1, 0]),
        ("Jt2 fy", "l", l, Jt[1, 1]),
        ("Jt2 tz", "1", 1.0, Jt[1, 5]),
    ]
    print(f"q = {q} rad, q' = {qd} rad/s; a = m l^2/3, b = m l^2/2\n")
    print(f"{'term':8}{'equation':42}{'by hand':>12}{'torchdq':>12}{'difference':>12}")
    for term, equation, expected, found in rows:
        print(f"{term:8}{equation:42}{expected:12.6f}{found:12.6f}{found - expected:12.0e}")
    return max(abs(float(found) - expected) for _, _, expected, found in rows)


if __name__ == "__main__":
    sys.exit(0 if main() < 1e-13 else 1)
