"""The departures of this package from the printed paper, one row per reading of a wrong equation.

Ids are the equation's number, `A` and a number for Algorithm 1, `T` table and row for the tables. Sizes are medians
over twenty draws, where they are torques over twenty random six-joint chains whose torques are about 58 N m;
`paper/test_paper_errata.py` measures them again and shows that the package is right.
"""

from typing import NamedTuple


class Erratum(NamedTuple):
    """A form that is printed, or that the print can be read as, and is wrong."""

    id: str
    reading: str  # tells the readings of one id apart; empty where there is only one
    where: str
    printed: str
    correct: str
    error: float | None  # of the printed form; None: it has no value, its shapes or types do not fit
    unit: str

    @property
    def key(self) -> str:
        """Id and reading."""
        return f"{self.id} {self.reading}".rstrip()


COMPONENT, TORQUE = "largest component", "N m"

ERRATA = (
    Erratum(
        "11",
        "",
        "(11), section 2",
        "Q (Q')^T = sum q_i q'_i, which for the columns of (8) is an n x n matrix",
        "Q^T Q' = sum q_i q'_i",
        None,
        "shape",
    ),
    Erratum(
        "22",
        "",
        "(22), section 3",
        "h+(x) = [vec x, vec(x i), vec(x j), vec(x k)], real vectors: H+(x) over again",
        "h+(x) = [x, x i, x j, x k], h-(x) = [x, i x, j x, k x], quaternions as (23) uses them",
        None,
        "type",
    ),
    Erratum(
        "25",
        "alone",
        "(25), section 4",
        "exp(q) = P(exp) + eps D(q) P(exp), for a unit line a metre from the origin, 1.3 rad",
        "exp(a + eps b) = C + S a + eps (-S (a.b) + S b + K (a.b) a), C = cos|a|, S = sin|a|/|a|, K = (C - S)/|a|^2",
        0.27,
        COMPONENT,
    ),
    Erratum("25", "in (38)", "(38), section 5.1", "the exponential (25)", "the exponential (27)", 15.3, TORQUE),
    Erratum(
        "30",
        "",
        "(30), section 4",
        "I_z = I_xz i + I_yz j + I_yz k",
        "I_z = I_xz i + I_yz j + I_zz k",
        2.1,
        TORQUE,
    ),
    Erratum(
        "30",
        "two-link arm",
        "(30), section 4",
        "the same, on the paper's arm with rods for links: their inertia is lost",
        "the same",
        0.39,
        TORQUE,
    ),
    Erratum(
        "34",
        "",
        "(34), section 4",
        "A_Pi mu_1 + A_Pi mu_2 + A_Pi mu_3",
        "A_Pi mu_1 + A_Pj mu_2 + A_Pk mu_3",
        2.0,
        COMPONENT,
    ),
    Erratum(
        "35",
        "",
        "(35), section 4",
        "A_Dk = 2 Im(x_P j x_D*)",
        "A_De = 2 Im(x_P e x_D*) for e = i, j, k",
        1.1,
        COMPONENT,
    ),
    Erratum(
        "38",
        "",
        "(38), section 5.1; Algorithm 1",
        "x_i^{i-1} = delta_{i-1}^i exp(a_i dq_i/2)",
        "x_i^{i-1} = delta_i^{i-1} exp(a_i dq_i/2)",
        103.0,
        TORQUE,
    ),
    Erratum(
        "38",
        "indices exchanged",
        "(38), (40), (44), (46), sections 5.1 and 5.2",
        "(38), (40), (44) and the index of (46) as printed, x_i^{i-1} read as the pose of F_{i-1} in F_i",
        "no reading makes (38) and (40) right together: F_i in F_{i-1}, delta_i^{i-1}, and Ad(x_{i-1}^i) in (40)",
        91.0,
        TORQUE,
    ),
    Erratum(
        "40",
        "",
        "(40), (44), section 5.1; Algorithm 1",
        "w_i = a_i qd_i + Ad(x_i^{i-1}) w_{i-1}, and the same adjoint in (44)",
        "w_i = a_i qd_i + Ad(x_{i-1}^i) w_{i-1}, x_{i-1}^i = (x_i^{i-1})*",
        71.0,
        TORQUE,
    ),
    Erratum(
        "42",
        "",
        "(42), section 5.1",
        "d/dt x_{i-1}^i = 1/2 x_{i-1}^i a_i qd_i",
        "d/dt x_i^{i-1} = 1/2 x_i^{i-1} a_i qd_i",
        1.2,
        "1/s",
    ),
    Erratum(
        "46",
        "sign",
        "(46), section 5.2",
        "f_R,i = f_i + Ad(..) f_{i+1}",
        "f_R,i = f_i - Ad(x_{i+1}^i) f_{i+1}",
        67.0,
        TORQUE,
    ),
    Erratum(
        "46",
        "index",
        "(46), (47), section 5.2; Algorithm 1",
        "Ad(x_i^{i+1}) f_{i+1}",
        "Ad(x_{i+1}^i) f_{i+1}",
        78.0,
        TORQUE,
    ),
    Erratum(
        "47",
        "",
        "(47), section 5.2",
        "f_i = f_R,i - Ad(..) f_{i+1}",
        "f_i = f_R,i + Ad(x_{i+1}^i) f_{i+1}, as in Algorithm 1",
        67.0,
        TORQUE,
    ),
    Erratum(
        "A1",
        "",
        "Algorithm 1, last line",
        "tau_i = f_i (.) a_i",
        "tau_i = f_i (.) (D(a_i) + eps P(a_i)), as in (48)",
        95.0,
        TORQUE,
    ),
    Erratum(
        "A1",
        "every line as printed",
        "Algorithm 1",
        "the whole algorithm, with (30)",
        "errata 30, 38, 40, 46 and A1",
        116.0,
        TORQUE,
    ),
    Erratum("57", "", "(57), section 5.3", "A_S, row 1: D(a_1) + eps P(a_2)", "D(a_1) + eps P(a_1)", 42.0, TORQUE),
    Erratum(
        "T1.2",
        "",
        "Table 1, row 2",
        "Wd = L (A qdd + C qdd + Wd_BASE)",
        "Wd = L (A qdd + C qd + Wd_BASE)",
        21.0,
        TORQUE,
    ),
    Erratum(
        "T1.4",
        "not transposed",
        "Table 1, row 4; (64)-(72)",
        "L* as (13) defines it, conjugated without transposing",
        "L^H, the conjugate transpose: block (j, i) is A_H(x_i^j)",
        60.0,
        TORQUE,
    ),
    Erratum(
        "T1.4",
        "real transpose",
        "Table 1, row 4; (64)-(72)",
        "L* as the transpose of the real 8n x 8n matrix, which also exchanges primary and dual parts",
        "the transpose of the 4n x 4n matrix of dual numbers",
        63.0,
        TORQUE,
    ),
    Erratum(
        "T1.4",
        "not conjugated",
        "Table 1, row 4; (64)-(72)",
        "L* as the transpose of the blocks without conjugating them",
        "the conjugate transpose",
        59.0,
        TORQUE,
    ),
    Erratum(
        "T1.4",
        "wrench not carried",
        "Table 1, row 4; (65), (72)",
        "F_BASE = [0, .., 0, f_EF]",
        "F_EF = [0, .., 0, Ad(x_{n+1}^n) f_EF]",
        10.5,
        TORQUE,
    ),
    Erratum(
        "61",
        "",
        "(61), (62), section 5.3",
        "A_H(x_i^{i-1}) below the diagonal of Q, A_H(x_i^j) in L",
        "A_H(x_{i-1}^i) in row i, column i-1 of Q; A_H(x_j^i) in row i, column j of L",
        113.0,
        TORQUE,
    ),
    Erratum(
        "63",
        "",
        "(63), section 5.3",
        "f_EF without a side, read as the wrench the environment exerts on the end effector",
        "the wrench the end effector exerts on the environment",
        20.5,
        TORQUE,
    ),
    Erratum(
        "67",
        "",
        "(67), section 5.3",
        "the inertial term of (66) is missing",
        "A_S (*) [L* G(L A qdd + L C qd + L Wd_BASE)]",
        57.0,
        TORQUE,
    ),
    Erratum(
        "68",
        "bracket",
        "(68), (70), section 5.3",
        "A_S (*) [L* W (x) (G(L A) qd)], read as a product with L* W",
        "A_S (*) [L* (W (x) (G(L A) qd))]",
        12.0,
        TORQUE,
    ),
    Erratum("68", "L W", "(68), section 5.3", "last inertial term G(L W)", "G(L Wd_BASE)", 86.0, TORQUE),
    Erratum(
        "70",
        "",
        "(70), section 5.3",
        "A_S (*) [L* G(L C)] q",
        "A_S (*) [L* G(L C)] qd",
        12.0,
        TORQUE,
    ),
    Erratum(
        "71",
        "",
        "(71), section 5.3",
        "g = A_S (*) [L* G(L W_BASE)], zero for a base at rest",
        "g = A_S (*) [L* G(L Wd_BASE)]",
        52.0,
        TORQUE,
    ),
    Erratum(
        "73",
        "",
        "(73), (74), section 5.4",
        "f_EF fed forward as the wrench the environment exerts on the end effector",
        "the wrench the end effector exerts on the environment, as in (63)",
        16.0,
        "rad/s^2, two-link arm",
    ),
    Erratum(
        "75",
        "",
        "(75), section 5.4",
        "a_c = -K_P q - K_D q + r",
        "a_c = -K_P q - K_D qd + r",
        0.20,
        "rad after 2 s, two-link arm",
    ),
)

IDS = frozenset(row.id for row in ERRATA)
