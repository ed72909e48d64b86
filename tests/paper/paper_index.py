"""The paper, equation by equation: what each says, where it is computed and which test holds it.

The tables below hold what nothing else knows. Errata come from `errata_table`, verdicts on the paper's costs from
`torchdq.paper.tables`, and `PAPER.md` is written from all three:

    python tests/paper/paper_index.py [--write]
"""

import argparse
import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NamedTuple

from errata_table import COMPONENT, ERRATA, IDS, Erratum

from torchdq.paper import cost, tables

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "PAPER.md"


class Row(NamedTuple):
    """An equation, a row of Table 1, a line of Algorithm 1, or a figure."""

    id: str
    says: str  # as corrected
    code: str  # places as `module:name`, module below torchdq, blanks between them; a file if there is no module
    test: str  # the tests that hold it, blanks between them
    instead: str = ""  # what stands for it, where no line computes it
    repeats: tuple[int, ...] = ()  # equations whose errata it shares

    @property
    def places(self) -> tuple[str, ...]:
        """Where it is computed, or what stands for it is."""
        return tuple(self.code.split())

    @property
    def tests(self) -> tuple[str, ...]:
        """The tests that hold it."""
        return tuple(self.test.split())


ALGEBRA, ERRORS, GOLDEN = (
    "algebra/test_algebra.py::test",
    "paper/test_paper_errata.py::test",
    "paper/test_paper_golden.py::test",
)
IDENTITIES, CONTROL = "claims/test_identities.py::test", "layers/test_computed_torque.py::test"
OURS = f"{ERRORS}_ours_agrees_with_an_independent_reference"
PRODUCTS = f"{ALGEBRA}_a_product_of_matrices_is_the_sum_over_rows_and_columns"
TRANSPOSED = f"{ALGEBRA}_transposing_moves_entries_and_conjugating_changes_them_in_place"
ELEMENTWISE = f"{ALGEBRA}_elementwise_products_are_products_of_the_entries"
PURE = f"{ALGEBRA}_pure_quaternions_have_the_inner_and_cross_product_of_their_products"
SCREWS = f"{ALGEBRA}_screws_have_the_inner_and_cross_product_of_their_products"
HAMILTON = f"{ALGEBRA}_hamilton_operators_multiply_from_the_left_and_from_the_right"
TORQUES = f"{GOLDEN}_two_link_torques"

SECTION_2_3 = (
    Row(
        "1",
        "quaternions w + x i + y j + z k, i^2 = j^2 = k^2 = ijk = -1",
        "algebra.quaternion:mul",
        f"{ALGEBRA}_the_units_multiply_as_hamilton_said",
    ),
    Row("2", "pure quaternions, without real part: vectors", "algebra.quaternion:pure", PURE),
    Row("3", "inner product a . b = -(ab + ba)/2", "algebra.quaternion:dot dq.tensors:dot", PURE),
    Row(
        "4", "cross product a x b = (ab - ba)/2", "algebra.quaternion:cross dq.tensors:cross paper.printed:cross", PURE
    ),
    Row(
        "5",
        "dual quaternions P + eps D, eps^2 = 0",
        "algebra.dual_quaternion:primary algebra.dual_quaternion:dual",
        f"{ALGEBRA}_the_dual_unit_squares_to_zero",
    ),
    Row("6", "cross product of screws, (ab - ba)/2", "algebra.screw:cross dq.tensors:cross", SCREWS),
    Row(
        "7",
        "double geodesic product a (.) b = P(a).P(b) + D(a).D(b); it depends on the frame",
        "algebra.screw:double_geodesic dq.tensors:double_geodesic",
        f"{ALGEBRA}_the_double_geodesic_product_depends_on_the_frame",
    ),
    Row("8", "columns of n dual quaternions", "algebra.matrix:Matrix", PRODUCTS, "definition"),
    Row(
        "9",
        "transpose, and entry-wise conjugate, of a column",
        "algebra.matrix:transpose algebra.matrix:conj",
        TRANSPOSED,
    ),
    Row("10", "sum of columns", "algebra.matrix:add", PRODUCTS),
    Row("11", "row times column, q_1 q'_1 + .. + q_n q'_n", "algebra.matrix:matmul dq.tensors:matmul", PRODUCTS),
    Row("12", "n x m matrices, which add and multiply alike", "algebra.matrix:matmul dq.tensors:matmul", PRODUCTS),
    Row(
        "13",
        "transpose and conjugate of a matrix; the conjugate is not transposed",
        "algebra.matrix:transpose algebra.matrix:conj dq.tensors:transpose",
        TRANSPOSED,
    ),
    Row("14", "columns and matrices of screws", "algebra.screw:Screw", ELEMENTWISE, "definition"),
    Row("15", "entry-wise cross product (x)", "algebra.matrix:elementwise", ELEMENTWISE),
    Row(
        "16",
        "entry-wise inner product, of dual numbers; the paper makes no use of it",
        "algebra.matrix:elementwise algebra.screw:inner dq.tensors:inner",
        ELEMENTWISE,
    ),
    Row(
        "17",
        "entry-wise double geodesic product (*), of numbers",
        "algebra.matrix:elementwise paper.closed_form:closed_form",
        ELEMENTWISE,
    ),
    Row(
        "18",
        "ab = H+(a) b = H-(b) a on components",
        "dq.tensors:hamilton_left dq.tensors:hamilton_right",
        HAMILTON,
        "by (19)",
    ),
    Row(
        "19",
        "the 4 x 4 matrices H+ and H-",
        "algebra.quaternion:hamilton_left_matrix algebra.quaternion:hamilton_right_matrix "
        "dq.tensors:hamilton_left dq.tensors:hamilton_right",
        HAMILTON,
    ),
    Row(
        "20",
        "T4: four quaternions combined by the components of a fifth",
        "algebra.quaternion:t4 dq.tensors:t4",
        f"{ALGEBRA}_t4_and_t8_combine_the_columns_of_a_matrix",
    ),
    Row(
        "21",
        "T8: the same with eight dual quaternions",
        "algebra.dual_quaternion:t8 dq.tensors:t8",
        f"{ALGEBRA}_t4_and_t8_combine_the_columns_of_a_matrix",
    ),
    Row(
        "22",
        "h+(x), h-(x): the products of x with the four units",
        "algebra.quaternion:hamilton_left algebra.quaternion:hamilton_right dq.tensors:h_left dq.tensors:h_right",
        f"{ALGEBRA}_hamilton_vectors_hold_the_products_with_the_units",
    ),
    Row("23", "ab = h+(a) b = h-(b) a by T4, without leaving the algebra", "paper.printed:hamilton", HAMILTON),
    Row(
        "24",
        "the same for dual quaternions",
        "algebra.dual_quaternion:hamilton_left algebra.dual_quaternion:hamilton_right algebra.dual_quaternion:apply "
        "dq.tensors:h_left dq.tensors:h_right paper.printed:hamilton",
        f"{ALGEBRA}_dual_hamilton_operators_multiply_from_the_left_and_from_the_right",
    ),
)

SECTION_4 = (
    Row(
        "25",
        "exponential of a pure dual quaternion, a pose",
        "algebra.screw:exp dq.poses:exp",
        "dq/test_explog.py::test_exp_is_within_4_ulp",
    ),
    Row(
        "26",
        "its primary part, cos and sin of the length; 1 for a translation",
        "algebra.screw:exp dq.poses:exp",
        "dq/test_explog.py::test_pure_translations_are_exact",
    ),
    Row(
        "27",
        "motion by the dual angle t^ about a unit line s: cos(t^/2) + s sin(t^/2)",
        "algebra.elementary:times algebra.screw:exp_revolute algebra.screw:exp_prismatic algebra.screw:exp_helical "
        "dynamics.joints:Revolute.motion dq.poses:exp",
        f"{ALGEBRA}_joint_exponentials_are_power_series_to_40_digits",
    ),
    Row(
        "28",
        "pose r + (eps/2) r p^b, which is r + (eps/2) p r",
        "algebra.elementary:times algebra.dual_quaternion:from_pose algebra.dual_quaternion:translation_body "
        "dq.poses:from_pose dq.poses:translation_body",
        f"{ALGEBRA}_a_pose_holds_rotation_and_position_in_both_frames",
    ),
    Row(
        "29",
        "rate of a pose, x' = 1/2 x w with the body's twist w",
        "dq.poses:exp",
        "dq/test_explog.py::test_sclerp_moves_with_a_constant_twist_also_outside_the_ends",
        "by (25), x exp(w dt/2)",
    ),
    Row(
        "30",
        "dual quaternion inertia G: twist to momentum, m v + eps I w",
        "algebra.inertia:Inertia.momentum dq.tensors:inertia_transform",
        f"{ALGEBRA}_the_inertia_transform_is_mass_times_velocity_and_tensor_times_rate",
    ),
    Row(
        "31",
        "motion of a free body, G(wd) + w x G(w) = f",
        "dynamics.general.rnea:inward",
        f"{GOLDEN}_two_link_wrenches",
        "as (45), link by link",
    ),
    Row(
        "32",
        "G of a column entry by entry, and of a matrix with the body of the row; G is linear",
        "dynamics.general.kinematics:momentum paper.closed_form:closed_form",
        f"{OURS}[T1.4]",
    ),
    Row(
        "33",
        "change of frame of a screw, Ad(x) m = x m x*",
        "algebra.elementary:ad dq.tensors:ad paper.printed:ad",
        f"{ALGEBRA}_the_adjoint_is_the_conjugation",
    ),
    Row(
        "34",
        "A_P, whose columns are x_P e x_P* for e = i, j, k: the rotation matrix",
        "algebra.screw:columns dq.tensors:columns dynamics.general.kinematics:adjoints paper.printed:columns",
        f"{ALGEBRA}_the_columns_are_products_with_the_units",
    ),
    Row(
        "35",
        "A_D, whose columns are 2 Im(x_P e x_D*), computed as p x A_P e",
        "algebra.screw:columns dq.tensors:columns dynamics.general.kinematics:adjoints paper.printed:columns",
        f"{ALGEBRA}_the_columns_are_products_with_the_units",
    ),
    Row(
        "36",
        "Ad(x) m = A_P P(m) + eps (A_P D(m) + A_D P(m))",
        "algebra.screw:ad dq.tensors:ad",
        f"{ALGEBRA}_adjoint_and_composition_are_those_of_pinocchio",
    ),
)

SECTION_5_1_2 = (
    Row(
        "37",
        "end effector at home: the product of the home poses delta",
        "robot.from_screws:read",
        "robot/test_from_screws.py::test_home_is_where_the_poses_hold",
        "(39) at home",
    ),
    Row(
        "38",
        "pose of a link in the one before, delta_i^{i-1} exp(a_i dq_i/2)",
        "dynamics.general.kinematics:joint_poses paper.printed:rnea",
        f"{OURS}[38]",
    ),
    Row(
        "39",
        "end effector: the product of those poses",
        "dynamics.aligned.kinematics:poses dynamics.general.kinematics:link_poses functional:forward_kinematics "
        "paper.cost:udq_screw_kinematics",
        "robot/test_shipped.py::test_puma_has_the_toolbox_kinematics",
    ),
    Row(
        "40",
        "twist w_i = a_i qd_i + Ad(x_{i-1}^i) w_{i-1}",
        "paper.ladder:aligned_frames dynamics.aligned.rnea:carried dynamics.general.rnea:outward paper.printed:rnea",
        f"{GOLDEN}_two_link_twists",
    ),
    Row(
        "41",
        "its rate, by the product rule",
        "dynamics.general.rnea:outward",
        f"{OURS}[40]",
        "a step to (44)",
        repeats=(40,),
    ),
    Row(
        "42",
        "rate of (38), 1/2 x_i^{i-1} a_i qd_i",
        "dynamics.general.kinematics:joint_poses",
        f"{OURS}[42]",
        "left to autograd",
    ),
    Row("43", "(42) put into (41)", "dynamics.general.rnea:outward", f"{OURS}[40]", "a step to (44)", repeats=(40, 42)),
    Row(
        "44",
        "acceleration wd_i = a_i qdd_i + Ad(x_{i-1}^i) wd_{i-1} + (w_i x a_i) qd_i",
        "paper.ladder:aligned_frames dynamics.aligned.rnea:carried dynamics.general.rnea:outward paper.printed:rnea "
        "paper.printed:accelerated",
        f"{GOLDEN}_two_link_accelerations",
    ),
    Row(
        "45",
        "net wrench of a link, w_i x G_i(w_i) + G_i(wd_i)",
        "paper.ladder:aligned_frames dynamics.aligned.rnea:inverse_dynamics dynamics.general.rnea:inward "
        "paper.printed:rnea paper.printed:net_wrench",
        f"{GOLDEN}_two_link_wrenches",
    ),
    Row(
        "46",
        "it is the wrench on the link less the one it passes on",
        "dynamics.aligned.rnea:inverse_dynamics dynamics.general.rnea:inward",
        f"{OURS}[46]",
        "solved for f_i, (47)",
    ),
    Row(
        "47",
        "wrench on a link, f_i = f_R,i + Ad(x_{i+1}^i) f_{i+1}",
        "dynamics.aligned.rnea:inverse_dynamics dynamics.general.rnea:inward paper.printed:rnea",
        f"{OURS}[47]",
    ),
    Row(
        "48",
        "torque tau_i = f_i (.) (D(a_i) + eps P(a_i)), the power on the joint's screw",
        "dynamics.joints:Along.project dynamics.aligned.rnea:inverse_dynamics algebra.screw:power "
        "dq.tensors:power dynamics.general.rnea:rnea paper.printed:rnea",
        f"{ALGEBRA}_power_is_the_dual_part_of_the_inner_product {OURS}[A1]",
    ),
)

ALGORITHM_1 = (
    Row(
        "start 1",
        "frames: F_0 base, F_1 .. F_n at the centres of mass, F_{n+1} tip; here anywhere on the links",
        "robot.from_screws:read",
        f"{IDENTITIES}_frames_on_the_joints_give_the_torques_of_frames_at_the_centres_of_mass",
    ),
    Row(
        "start 2",
        "constants: home poses delta_i^{i-1}, where the print sets their inverses, and screws a_i in F_i",
        "robot.from_screws:read dynamics.tree:Link",
        f"{GOLDEN}_two_link_constants",
    ),
    Row(
        "start 3",
        "the base does not move, w_0 = 0",
        "dynamics.general.rnea:world_acceleration",
        f"{GOLDEN}_two_link_twists",
    ),
    Row(
        "start 4",
        "gravity is an acceleration of the base, wd_0 = -eps g",
        "dynamics.general.rnea:world_acceleration",
        f"{GOLDEN}_two_link_accelerations",
    ),
    Row(
        "start 5",
        "wrench f_EF of the end effector, on the environment",
        "dynamics.general.rnea:exerted_wrenches",
        f"{IDENTITIES}_what_the_tip_exerts_is_the_negative_of_what_its_link_feels",
    ),
    Row("forward 1", "pose of the link, (38)", "dynamics.general.kinematics:joint_poses", f"{OURS}[38]", repeats=(38,)),
    Row(
        "forward 2",
        "A_P and A_D of it, (34), (35); once for both directions",
        "dynamics.general.kinematics:adjoints",
        f"{OURS}[34]",
        repeats=(34, 35),
    ),
    Row("forward 3", "twist, (40)", "dynamics.general.rnea:outward", f"{OURS}[40]", repeats=(40,)),
    Row("forward 4", "acceleration, (44)", "dynamics.general.rnea:outward", f"{OURS}[40]", repeats=(44,)),
    Row("backward 1", "net wrench, (45)", "dynamics.general.rnea:inward", f"{OURS}[46]", repeats=(45,)),
    Row("backward 2", "wrench, (47)", "dynamics.general.rnea:inward", f"{OURS}[47]", repeats=(47,)),
    Row("backward 3", "torque, (48)", "dynamics.general.rnea:rnea", f"{OURS}[A1]", repeats=(48,)),
)

SECTION_5_3 = (
    Row("49", "column of the positions q", "functional:inverse_dynamics", TORQUES, "definition, a tensor [..., n]"),
    Row("50", "column of the torques tau", "functional:inverse_dynamics", TORQUES, "definition, a tensor [..., n]"),
    Row(
        "51",
        "column F_R of the net wrenches",
        "dynamics.general.rnea:inward",
        f"{OURS}[46]",
        "definition, one after another",
    ),
    Row("52", "column F of the wrenches", "dynamics.general.rnea:inward", f"{OURS}[47]", "definition, a list"),
    Row("53", "column W of the twists", "dynamics.general.rnea:outward", f"{OURS}[40]", "definition, a list"),
    Row("54", "column of the velocities qd", "functional:inverse_dynamics", TORQUES, "definition, a tensor [..., n]"),
    Row(
        "55", "column of the accelerations qdd", "functional:inverse_dynamics", TORQUES, "definition, a tensor [..., n]"
    ),
    Row(
        "56",
        "column Wd of the links' accelerations",
        "dynamics.general.rnea:outward",
        f"{OURS}[T1.2]",
        "definition, a list",
    ),
    Row(
        "57",
        "A = diag(a_i), and A_S, the column of D(a_i) + eps P(a_i)",
        "paper.closed_form:closed_form",
        f"{OURS}[57]",
    ),
    Row("58", "C = diag(w_i x a_i)", "paper.closed_form:closed_form", f"{OURS}[70]"),
    Row("59", "the adjoint once more", "algebra.screw:ad", f"{OURS}[34]", "(33), as (36)"),
    Row(
        "60",
        "the adjoint as an operator, A_H(x) = h+(x) h-(x*)",
        "algebra.screw:columns",
        f"{ALGEBRA}_matrices_of_operators_act_as_block_matrices",
        "A_P and A_D, (34), (35)",
    ),
    Row(
        "61",
        "Q: A_H(x_{i-1}^i) below the diagonal",
        "paper.closed_form:propagation",
        f"{OURS}[61]",
        "never formed; its entries make L",
    ),
    Row(
        "62",
        "L = (I - Q)^-1: A_H(x_j^i) on and below the diagonal; on a tree, along the path to the base",
        "paper.closed_form:propagation paper.closed_form:closed_form",
        f"{OURS}[61]",
    ),
    Row(
        "63",
        "tau = M qdd + c + g + J^T F_EF",
        "paper.closed_form:closed_form functional:closed_form functions.formulas:accelerations",
        f"{IDENTITIES}_torques_are_the_sum_of_their_causes",
    ),
    Row("64", "tau = A_S (*) F", "paper.closed_form:closed_form", f"{OURS}[57]"),
    Row(
        "65",
        "torques of the links and of the tip apart",
        "paper.closed_form:closed_form",
        f"{OURS}[T1.4]",
        "a step to (69)-(72)",
    ),
    Row("66", "F_R written out", "paper.closed_form:closed_form", f"{OURS}[67]", "a step to (69)-(72)"),
    Row("67", "W written out", "paper.closed_form:closed_form", f"{OURS}[67]", "a step to (69)-(72)"),
    Row(
        "68",
        "G taken apart by its linearity",
        "paper.closed_form:closed_form",
        f"{OURS}[68]",
        "its terms are (69)-(72)",
    ),
    Row(
        "69",
        "mass matrix M = A_S (*) [L^H G(L A)]",
        "paper.closed_form:closed_form functional:mass_matrix",
        f"{IDENTITIES}_composite_bodies_give_the_mass_matrix_of_the_closed_form",
    ),
    Row(
        "70",
        "c = A_S (*) [L^H (W (x) (G(L A) qd + G(L W_BASE)))] + A_S (*) [L^H G(L C)] qd",
        "paper.closed_form:closed_form",
        f"{IDENTITIES}_coriolis_torques_are_the_christoffel_symbols_of_the_mass_matrix",
    ),
    Row(
        "71",
        "g = A_S (*) [L^H G(L Wd_BASE)]",
        "paper.closed_form:closed_form",
        f"{IDENTITIES}_gravity_torques_are_the_gradient_of_potential_energy",
    ),
    Row(
        "72",
        "J^T = A_S (*) L^H, on the wrench of the tip carried to link n",
        "functions.formulas:closed_form paper.closed_form:tip_jacobian_transpose",
        f"{IDENTITIES}_the_transposed_jacobian_is_the_transpose_of_the_jacobian",
    ),
)

TABLE_1 = (
    Row("1.1", "W = L (A qd + W_BASE)", "paper.closed_form:closed_form", f"{OURS}[68]"),
    Row(
        "1.2",
        "Wd = L (A qdd + C qd + Wd_BASE)",
        "paper.closed_form:closed_form",
        f"{OURS}[T1.2]",
        "its three terms are in (69)-(71)",
    ),
    Row(
        "1.3",
        "F_R = W (x) G(W) + G(Wd)",
        "paper.closed_form:closed_form",
        f"{OURS}[46]",
        "its terms are in (69)-(71)",
    ),
    Row(
        "1.4",
        "F = L^H (F_R + F_EF)",
        "algebra.matrix:hermitian paper.closed_form:closed_form",
        f"{OURS}[T1.4]",
        "L^H, applied term by term",
    ),
    Row("1.5", "tau = F (*) A_S", "paper.closed_form:closed_form", f"{OURS}[57]", "(64)"),
)

SECTION_5_4 = (
    Row(
        "73",
        "feedback linearisation, tau = M a_c + c + g + J^T F_EF: one recursion",
        "functions.formulas:computed_torque scene.controllers:ComputedTorqueController.torques",
        f"{CONTROL}_it_is_the_closed_form_with_the_commanded_acceleration",
    ),
    Row(
        "74",
        "which leaves qdd = a_c",
        "functions.formulas:computed_torque scene.controllers:ComputedTorqueController.torques",
        f"{CONTROL}_the_robot_accelerates_as_commanded",
    ),
    Row(
        "75",
        "a_c = -K_P q - K_D qd + r",
        "dynamics.tracking:commanded",
        f"{CONTROL}_without_its_dot_75_leaves_a_fifth_of_a_radian",
    ),
    Row(
        "76",
        "r = qdd_des + K_P q_des + K_D qd_des",
        "dynamics.tracking:commanded",
        f"{CONTROL}_a_robot_where_it_should_be_is_only_held",
    ),
    Row(
        "77",
        "a_c = K_P (q_des - q) + K_D (qd_des - qd) + qdd_des",
        "dynamics.tracking:commanded",
        f"{OURS}[75]",
    ),
    Row(
        "78",
        "the same with the errors named: e'' + K_D e' + K_P e = 0",
        "dynamics.tracking:commanded",
        f"{CONTROL}_the_error_follows_its_equation_all_the_way",
    ),
)

SECTION_6 = (
    Row(
        "79",
        "a cost is storage, multiplications and additions",
        "numbers.count:Cost",
        "paper/test_cost.py::test_counting_is_of_what_was_asked_for",
        "counted by running the formula",
    ),
)

DRAWN, DRAWN_TEST = "examples/10_paper_figures.py", "paper/test_paper_figures.py"
FIGURES = (
    Row(
        "1",
        "torques of the two-link arm (1 m, 1 kg), by three forms of the algorithm and by matrices",
        DRAWN,
        DRAWN_TEST,
    ),
    Row("2", "the controlled arm where it starts and where it ends", DRAWN, DRAWN_TEST),
    Row("3", "the closed loop of the controlled arm over time", DRAWN, DRAWN_TEST),
    Row(
        "4",
        "cost of the forward kinematics of 1 to 42 joints: matrices or dual quaternions, D-H or screws",
        DRAWN,
        DRAWN_TEST,
    ),
    Row("5", "cost of the inverse dynamics of 1 to 42 joints: matrices or dual quaternions", DRAWN, DRAWN_TEST),
)

EQUATIONS = (*SECTION_2_3, *SECTION_4, *SECTION_5_1_2, *SECTION_5_3, *SECTION_5_4, *SECTION_6)
ROWS = (*EQUATIONS, *TABLE_1, *ALGORITHM_1, *FIGURES)


# --- what follows from them ------------------------------------------------------------------------------------------


def numbers(text: str) -> set[int]:
    """Equations that a text names, as (40), and as (57)-(72) with those between."""
    found: set[int] = set()
    for first, last in re.findall(r"(?<![\w)\]])\((\d{1,2})\)(?:-\((\d{1,2})\))?", text):
        found |= set(range(int(first), int(last or first) + 1))
    return found


def path_of(place: str) -> Path:
    """File of a place."""
    module, colon, _ = place.partition(":")
    if not colon:
        return ROOT / module
    folder = ROOT if module.startswith("envs.") else ROOT / "torchdq"
    return (folder / module.replace(".", "/")).with_suffix(".py")


def errata_of_equation(row: Row) -> list[Erratum]:
    """Errata whose place in the paper is the equation, or one that it repeats."""
    return [erratum for erratum in ERRATA if numbers(erratum.where) & {int(row.id), *row.repeats}]


def errata_of_table(row: Row) -> list[Erratum]:
    """Errata of a row of Table 1."""
    return [erratum for erratum in ERRATA if erratum.id == f"T{row.id}"]


def errata_of_line(row: Row) -> list[Erratum]:
    """Errata of a line of Algorithm 1: those of its equations that it shares, and those of its own."""
    named = [erratum for erratum in ERRATA if "Algorithm 1" in erratum.where]
    own = [erratum for erratum in named if "last line" in erratum.where and row is ALGORITHM_1[-1]]
    return own + [erratum for erratum in named if numbers(erratum.where) & set(row.repeats)]


def none_of(row: Row) -> list[Erratum]:
    """No errata."""
    return []


def plain(text: str) -> str:
    """Text that Markdown leaves as it is, within a table."""
    return re.sub(r"([*|<])", r"\\\1", text)


def size(erratum: Erratum) -> str:
    """Error of the printed form."""
    if erratum.error is None:
        return f"its {erratum.unit} does not fit"
    unit = f"in the {COMPONENT}" if erratum.unit == COMPONENT else erratum.unit
    return f"{erratum.error:g} {unit}"


def link_to_code(place: str) -> str:
    """Link to a place."""
    module, colon, name = place.partition(":")
    text = f"{module.rpartition('.')[2]}.{name}" if colon else Path(module).name
    return f"[{text}]({path_of(place).relative_to(ROOT)})"


def link_to_test(test: str) -> str:
    """Link to a test's file, by the test's id."""
    return f"[{test}](tests/{test.partition('::')[0]})"


def table(rows: Iterable[Row], name: Callable[[str], str], errata: Callable[[Row], list[Erratum]]) -> str:
    """Rows as a table."""
    lines = ["| | equation | code | test | erratum |", "|---|---|---|---|---|"]
    for row in rows:
        code = ", ".join(map(link_to_code, row.places))
        code = f"{plain(row.instead)}: {code}" if row.instead else code
        ids = ", ".join(dict.fromkeys(erratum.id for erratum in errata(row)))
        cells = (name(row.id), plain(row.says), code, ", ".join(map(link_to_test, row.tests)), ids)
        lines.append(f"| {' | '.join(cells)} |".replace("  |", " |"))
    return "\n".join(lines)


def corrected(ids: Iterable[str]) -> str:
    """Errata as a table, printed form beside correct form and the error of the former."""
    wanted = set(ids)
    lines = ["| erratum | where | printed | correct | error as printed |", "|---|---|---|---|---|"]
    for erratum in ERRATA:
        if erratum.id in wanted:
            cells = (erratum.key, erratum.where, erratum.printed, erratum.correct, size(erratum))
            lines.append(f"| {' | '.join(map(plain, cells))} |")
    return "\n".join(lines)


def equation(id: str) -> str:
    """Name of an equation."""
    return f"({id})"


def section(title: str, rows: tuple[Row, ...], *more: str) -> list[str]:
    """A section of equations with the errata of their numbers."""
    ids = [row.id for row in rows if row.id in IDS]
    return [f"## {title}", table(rows, equation, errata_of_equation), *more, *([corrected(ids)] if ids else [])]


def verdicts() -> str:
    """Tables 2 to 4: how many of the printed costs are those that are counted."""
    lines = ["| | printed rows | as counted | operations differ | only storage differs | whose operations differ |"]
    lines.append("|---|---|---|---|---|---|")
    for title, entries in tables.TABLES.items():
        printed = [entry for entry in entries if entry.printed is not None]
        wrong = [entry for entry in printed if entry.printed[:2] != entry.counted[:2]]
        stored = [entry for entry in printed if entry not in wrong and entry.printed != entry.counted]
        counts = (len(printed), len(printed) - len(wrong) - len(stored), len(wrong), len(stored))
        names = ", ".join(entry.operation for entry in wrong)
        lines.append(f"| {title} | {' | '.join(map(str, counts))} | {names} |")
    return "\n".join(lines)


def laws() -> str:
    """What the algorithms cost."""
    rows = [f"| {line.name} | {line.law()} |" for line in cost.RNEA]
    return "\n".join(["| inverse dynamics of n revolute joints | multiplications, additions |", "|---|---|", *rows])


INTRODUCTION = f"""
*A Novel Dual Quaternion Based Cost Efficient Recursive Newton-Euler Inverse Dynamics Algorithm*
([CITATION.cff](CITATION.cff)): every equation, table, line of Algorithm 1 and figure, its place in this package, and
the test that checks it.

**Unchanged**, down to the symbols: the algebra, the screws and home poses that describe a robot, the two passes of the
recursion, the closed form and the controller. **Corrected**: {len(IDS)} places, in {len(ERRATA)} readings, listed
below the equations of each section with the printed form, the correct one, and the error of the printed one. Equations
without an erratum are correct up to obvious misprints, some of which may be artefacts of a copy. **Added**: prismatic
and helical joints, trees, frames anywhere on a link, and the most efficient forms of the algorithms
([rnea](torchdq/dynamics/aligned/rnea.py), [crba](torchdq/dynamics/crba.py), [aba](torchdq/dynamics/aligned/aba.py)),
which agree with these to rounding.

* q, qd, qdd are the paper's theta and its derivatives; dq_i is q_i minus its value at home.
* **x_i^j and delta_i^j are the pose of F_i in F_j**, as in section 5.1, and Ad(x_i^j) maps screws from F_i to
  F_j; the inverse is x_j^i = (x_i^j)\\*. From (40) on the paper uses the opposite reading: errata 38, 40, 46 and 61.
  In the code X_AB is the pose of B in A, so that x_i^{{i-1}} is X_PB of link B and its parent P.
* **A twist is angular + eps linear, a wrench force + eps moment**, both about the origin of their frame. Power is
  therefore f (.) (D(w) + eps P(w)), with the parts of one exchanged.
* wd is the rate of a twist's components in the body, the spatial acceleration; gravity is the acceleration -eps g of
  the base. f_EF is what the end effector exerts on the environment.
* (.) is the double geodesic product, (x) and (\\*) are the entry-wise cross and double geodesic products, L^H is the
  conjugate transpose.

Errors are medians over twenty random chains of six joints, with torques of about 58 N m, or over twenty random draws;
if an arm is named, they are those of the paper's arm.
[paper/test_paper_errata.py](tests/paper/test_paper_errata.py) measures all of them, and
compares this package in the same place with Pinocchio or the definition. Words before the code mean that the code does
not compute the equation itself, but an alternative.
""".strip()

IN_USE = f"""
Line by line it is [printed.rnea](torchdq/paper/printed.py). The code below is its form on trees, used if the
geometry of a robot is learned or differs from sample to sample; otherwise it is
[newton_euler](torchdq/dynamics/aligned/rnea.py), the same recursion in the most efficient frames
({link_to_test("program/test_program.py::test_torques_in_aligned_frames_equal_the_papers_recursion")}).
""".strip()

FOOT = """
`python tests/paper/paper_index.py --write` writes this page; `tests/paper/test_paper_index.py` checks it against the
sources.
""".strip()


def page() -> str:
    """PAPER.md."""
    of_algorithm = {erratum.id for erratum in ERRATA if erratum.id.startswith("A")}
    of_tables = {erratum.id for erratum in ERRATA if erratum.id.startswith("T")}
    parts = [
        "# The paper, equation by equation",
        INTRODUCTION,
        *section("Algebra: sections 2 and 3", SECTION_2_3),
        *section("Rigid bodies: section 4", SECTION_4),
        *section("Recursion: sections 5.1 and 5.2", SECTION_5_1_2),
        "## Algorithm 1",
        IN_USE,
        table(ALGORITHM_1, str, errata_of_line),
        corrected(of_algorithm),
        *section("Closed form: section 5.3", SECTION_5_3),
        "### Table 1",
        table(TABLE_1, lambda id: f"row {id[2:]}", errata_of_table),
        corrected(of_tables),
        *section("Control: section 5.4", SECTION_5_4),
        *section("Costs: section 6", SECTION_6),
        "`torchdq cost` prints Tables 2, 3 and 4 row by row, with the counts of running each formula, "
        "and reasons for differences ([tables](torchdq/paper/tables.py), checked by "
        "[test_cost.py](tests/paper/test_cost.py)):",
        verdicts(),
        "Dual quaternions cost less than homogeneous matrices, as the paper finds, if every product is one of dense "
        "matrices; with structural zeros and ones removed, the matrices cost less than the algorithm as printed.",
        laws(),
        "## Figures",
        table(FIGURES, lambda id: f"Fig. {id}", none_of),
        FOOT,
    ]
    return "\n\n".join(parts) + "\n"


def main() -> None:
    """Page of the paper, printed or written to its file."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--write", action="store_true", help="write PAPER.md instead of printing it")
    if parser.parse_args().write:
        PAGE.write_text(page(), encoding="utf-8")
    else:
        print(page(), end="")


if __name__ == "__main__":
    main()
