"""Faults that the suite must notice, and the tests that are expected to: what `mutants.py` plants one at a time.

A name that begins with an erratum's key and a colon puts that row of `errata_table` back: the code as the print has it.
The tests are chosen to be quick; that others would notice too is of no account here.
"""

from typing import NamedTuple


class Mutant(NamedTuple):
    """A fault in one place of one file."""

    name: str
    file: str
    old: str  # occurs once in the file
    new: str
    tests: tuple[str, ...]  # pytest's arguments
    fatal: bool = False  # the tests may end by a crash or never, which counts as well

    @property
    def erratum(self) -> str:
        """Key of the erratum that it puts back, if it is one."""
        key, colon, _ = self.name.partition(":")
        return key if colon else ""


WITHOUT_COUNTERPART = {
    "11": "the package multiplies matrices of any shapes; which of two columns is transposed is the caller's to say",
    "30 two-link arm": "the same form as 30, measured on another robot",
    "42": "no rate of a pose is written down: it is what autograd makes of (38); (44), which follows, is put back",
    "A1 every line as printed": "several lines at once; each is put back alone",
}


def within(file: str, *rows: tuple) -> tuple[Mutant, ...]:
    """Mutants of a file, from rows of name, old, new, test or tests."""
    mutants = []
    for name, old, new, tests, *fatal in rows:
        found = (tests,) if isinstance(tests, str) else tuple(tests)
        mutants.append(Mutant(name, file, old, new, tuple(f"tests/test_{test}" for test in found), *fatal))
    return tuple(mutants)


ALGEBRA = "algebra.py"
GROWTH = "error_growth.py"
TENSORS = "dq_tensors.py"
EXP_LOG = "exp_log.py"
GOLDEN = "paper_golden.py"
PROGRAMS = "programs.py"
IDENTITIES = "identities.py"
NUMBERS = "number_functions.py"
ROBOTS = "robots.py"
URDF = "urdf.py"
EFFECTS = "effects.py"
INTEGRATORS = "integrators.py"
PARAMETERS = "parameters.py"
SCENE = "scene.py"
BACKENDS = "backends.py"
CONTROL = "computed_torque.py"
SIGNS = "signs_and_turns.py::test_signs_are_those_of_plain_arithmetic"
MANY_TURNS = "signs_and_turns.py::test_a_rotation_by_many_turns_loses_nothing_to_the_rounding_of_its_angle"
ALIGNED_TORQUES = f"{PROGRAMS}::test_torques_in_aligned_frames_equal_the_papers_recursion"
ALIGNED_MASSES = f"{PROGRAMS}::test_the_mass_matrix_by_composite_bodies_equals_the_papers"
ARTICULATED = f"{PROGRAMS}::test_articulated_bodies_solve_the_mass_matrix"


def ours(id: str) -> str:
    """The test that compares the package with an independent reference where an equation is wrong."""
    return f"paper_errata.py::test_ours_agrees_with_an_independent_reference[{id}]"


MUTANTS = (
    # --- algebra ------------------------------------------------------------------------------------------------------
    *within(
        "torchdq/algebra/quaternion.py",
        (
            "j is i k",
            "aw * by - ax * bz + ay",
            "aw * by + ax * bz + ay",
            f"{ALGEBRA}::test_dual_quaternions_are_an_associative_algebra",
        ),
        ("k is not conjugated", "(w, -x, -y, -z)", "(w, -x, -y, z)", f"{ALGEBRA}::test_conjugation_reverses_products"),
        (
            "a left-handed cross product",
            "a[2] * b[0] - a[0] * b[2]",
            "a[0] * b[2] - a[2] * b[0]",
            f"{ALGEBRA}::test_pure_quaternions_have_the_inner_and_cross_product_of_their_products",
        ),
        (
            "a vector turned the other way",
            "cross(u, t)",
            "cross(t, u)",
            f"{ALGEBRA}::test_a_unit_quaternion_turns_a_vector_by_conjugation",
        ),
        ("one sign in the rotation matrix", "yz + wx)", "yz - wx)", f"{ALGEBRA}::test_the_adjoint_is_the_conjugation"),
        (
            "i y in the place of y i",
            "(-j, k, w, -i)",
            "(-j, -k, w, i)",
            f"{ALGEBRA}::test_hamilton_operators_multiply_from_the_left_and_from_the_right",
        ),
    ),
    *within(
        "torchdq/algebra/dual_quaternion.py",
        (
            "factors exchanged in the dual part",
            "quat.mul(xd, yp)",
            "quat.mul(yp, xd)",
            f"{ALGEBRA}::test_dual_quaternions_are_an_associative_algebra",
        ),
        (
            "a position in the body's axes",
            "quat.mul(quat.pure(p), r)",
            "quat.mul(r, quat.pure(p))",
            f"{ALGEBRA}::test_a_pose_holds_rotation_and_position_in_both_frames",
        ),
        (
            "the position read in the body's axes",
            "quat.im(quat.mul(x[1], quat.conj(x[0])))",
            "quat.im(quat.mul(quat.conj(x[0]), x[1]))",
            f"{ALGEBRA}::test_a_pose_holds_rotation_and_position_in_both_frames",
        ),
        (
            "half the dual part of the norm",
            "pd + pd",
            "pd",
            f"{ALGEBRA}::test_the_squared_norm_is_multiplicative_and_is_x_times_its_conjugate",
        ),
    ),
    *within(
        "torchdq/algebra/screw.py",
        (
            "25 alone: the exponential as a retraction",
            "(-(s * pd), *quat.add(quat.scale(s, d), quat.scale(k * pd, p)))",
            "quat.mul((0.0, *d), (c, *quat.scale(s, p)))",
            ours("25"),
        ),
        ("30: I_z with I_yz twice", "quat.scale(w[2], i_z)", "quat.scale(w[2], (*i_z[:2], i_z[1]))", ours("30")),
        ("34: A_Pi three times", "quat.rotation_columns(xp)", "(quat.rotation_columns(xp)[0],) * 3", ours("34")),
        ("35: A_Dj twice", "quat.cross(p, e) for e in a_p", "quat.cross(p, a_p[k]) for k in (0, 1, 1)", ours("35")),
        (
            "factors of the dual cross product exchanged",
            "quat.cross(ad_, bp)",
            "quat.cross(bp, ad_)",
            f"{ALGEBRA}::test_screws_have_the_inner_and_cross_product_of_their_products",
        ),
        (
            "a difference in the inner product",
            "+ quat.dot(ad_, bp)",
            "- quat.dot(ad_, bp)",
            f"{ALGEBRA}::test_screws_have_the_inner_and_cross_product_of_their_products",
        ),
        (
            "adjoints composed without exchanging parts",
            "_times(a[1], e)",
            "_times(a[1], f)",
            f"{ALGEBRA}::test_the_adjoint_respects_products_of_poses_and_of_screws",
        ),
        (
            "an inverse adjoint with A_D as it was",
            "_transpose(a[1]))",
            "a[1])",
            f"{ALGEBRA}::test_the_adjoint_is_the_conjugation",
        ),
        (
            "the first moment with the other sign",
            "quat.sub(force, quat.cross(first",
            "quat.add(force, quat.cross(first",
            f"{ALGEBRA}::test_the_inertia_transform_is_mass_times_velocity_and_tensor_times_rate",
        ),
        (
            "parallel axes with one sign",
            "((yy + zz, -xy, -xz)",
            "((yy + zz, xy, -xz)",
            f"{TENSORS}::test_inertia_about_the_centre_of_mass_is_carried_to_the_frame",
        ),
        (
            "parallel axes with a difference",
            "p[i] * h[j] + c[i] * p[j]",
            "p[i] * h[j] - c[i] * p[j]",
            f"{ALGEBRA}::test_carried_inertia_is_that_of_pinocchio_and_exactly_symmetric",
        ),
        (
            "a helical joint of twice the pitch",
            "slide = 0.5 * angle",
            "slide = angle",
            f"{ALGEBRA}::test_joint_exponentials_are_power_series_to_40_digits",
        ),
        (
            "the moment of a helical joint with its pitch",
            "quat.sub(moment, quat.scale(pitch, axis))",
            "moment",
            f"{ALGEBRA}::test_joint_exponentials_are_power_series_to_40_digits",
        ),
        (
            "the slide of a logarithm with the other sign",
            "- dw / (w * w + n2)",
            "+ dw / (w * w + n2)",
            f"{EXP_LOG}::test_log_is_within_8_ulp_up_to_half_a_turn",
        ),
    ),
    *within(
        "torchdq/algebra/matrix.py",
        ("T1.4 not transposed: L* by (13)", "for row in transpose(operators)", "for row in operators", ours("T1.4")),
        (
            "T1.4 not conjugated: L* transposed only",
            "tuple(elementwise(screw.inverse, row) for row in transpose(operators))",
            "transpose(operators)",
            ours("T1.4"),
        ),
        (
            "columns times rows",
            "elementwise(times, row, column)",
            "elementwise(times, column, row)",
            f"{ALGEBRA}::test_a_product_of_matrices_is_the_sum_over_rows_and_columns",
        ),
    ),
    *within(
        "torchdq/dq/tensors.py",
        ("22: h+ with vec is H+", "return hamilton_left(x).mT", "return hamilton_left(x)", ours("22")),
        (
            "matrices multiplied the other way round",
            "mul(a.unsqueeze(-2), b.unsqueeze(-4))",
            "mul(b.unsqueeze(-4), a.unsqueeze(-2))",
            f"{TENSORS}::test_matrices_of_dual_quaternions_multiply_by_rows_and_columns",
        ),
        (
            "A_D beside A_P",
            "torch.cat([a_d, a_p], -1)",
            "torch.cat([a_p, a_d], -1)",
            f"{TENSORS}::test_adjoint_matrix_and_columns_are_those_of_the_adjoint",
        ),
        (
            "normalised without making P and D orthogonal",
            "d - (p * d).sum(-1, keepdim=True) * p",
            "d",
            f"{EXP_LOG}::test_normalising_now_and_then_keeps_a_long_product_a_pose",
        ),
    ),
    *within(
        "torchdq/dq/poses.py",
        (
            "the longer way",
            "return log(torch.where(x[..., :1] < 0, -x, x))",
            "return log(x)",
            f"{EXP_LOG}::test_pure_translations_are_exact",
        ),
        (
            "interpolation by the twist in the world",
            "log_shortest(mul(conj(x), y))",
            "log_shortest(mul(y, conj(x)))",
            f"{EXP_LOG}::test_sclerp_meets_both_ends",
        ),
        (
            "one sign of a quaternion from a matrix",
            "[zy - yz, sx,",
            "[yz - zy, sx,",
            f"{TENSORS}::test_rotation_matrices_there_and_back_at_every_branch_and_at_half_a_turn",
        ),
        (
            "half the slide",
            "2.0 * slide.squeeze(-1)",
            "slide.squeeze(-1)",
            f"{EXP_LOG}::test_screw_parameters_are_those_the_motion_was_made_of",
        ),
    ),
    *within(
        "torchdq/dq/explog.py",
        (
            "one coefficient of a series",
            "_SINC = [(-1) ** k / math.factorial(2 * k + 1)",
            "_SINC = [(-1) ** k / math.factorial(2 * k + 1 + k // 6)",
            f"{EXP_LOG}::test_exp_is_within_4_ulp",
        ),
        ("the rounding of an angle not made good", "c, s = cos - defect * sin,", "c, s = cos,", MANY_TURNS),
        (
            "the longer half of a turn for the shorter",
            "f = arctangent(n, w, single) / n",
            "f = arctangent(n, absolute(w), single) / n",
            f"{EXP_LOG}::test_log_beyond_half_a_turn_loses_only_what_its_condition_takes",
        ),
        (
            "a full turn about nothing",
            "select(turned, math.pi * e, y)",
            "select(turned, 0.0 * e, y)",
            f"{EXP_LOG}::test_a_full_turn_has_the_documented_logarithm",
        ),
    ),
    *within(
        "torchdq/numbers/functions.py",
        (
            "an arc tangent without the eighth of a turn it was reduced by",
            "0.25 * high * steep +",
            "0.0 * steep +",
            f"{EXP_LOG}::test_log_is_within_8_ulp_up_to_half_a_turn",
        ),
    ),
    # --- dynamics -----------------------------------------------------------------------------------------------------
    *within(
        "torchdq/dynamics/paper/kinematics.py",
        (
            "25 in (38): the printed exponential of a joint",
            "screw.exp_revolute(link.screw, q.cos, q.sin)",
            "dq.mul(screw.exp_prismatic(link.screw[1], q.value), "
            "screw.exp_revolute((link.screw[0], (0.0, 0.0, 0.0)), q.cos, q.sin))",
            ours("38"),
        ),
        (
            "38: delta of the parent in the link",
            "dq.mul(link.X_PB_home,",
            "dq.mul(dq.conj(link.X_PB_home),",
            ours("38"),
        ),
        (
            "38 indices exchanged: poses of the parent in the link",
            "dq.mul(link.X_PB_home, joint_motion(link, q_i))",
            "dq.conj(dq.mul(dq.conj(link.X_PB_home), joint_motion(link, q_i)))",
            ours("40"),
        ),
        (
            "poses multiplied the other way round",
            "dq.mul(X_WB[link.parent], x)",
            "dq.mul(x, X_WB[link.parent])",
            ours("38"),
        ),
        (
            "a Jacobian in the link instead of the frame",
            "screw.inverse(screw.columns(X_BF))",
            "screw.columns(X_BF)",
            f"{IDENTITIES}::test_the_transposed_jacobian_is_the_transpose_of_the_jacobian",
        ),
        (
            "screws carried in the wrong order",
            "screw.compose(to_i, step)",
            "screw.compose(step, to_i)",
            f"{IDENTITIES}::test_the_transposed_jacobian_is_the_transpose_of_the_jacobian",
        ),
        (
            "a prismatic joint along its moment's place",
            "link.screw[1], q.value)",
            "link.screw[0], q.value)",
            f"{GOLDEN}::test_spatial_torques",
        ),
    ),
    *within(
        "torchdq/dynamics/paper/rnea.py",
        (
            "40: twists carried towards the base",
            "carried = ad_inverse(Ad_PB, V_P)",
            "carried = ad(Ad_PB, V_P)",
            ours("40"),
        ),
        ("40: accelerations carried towards the base, (44)", "ad_inverse(Ad_PB, A_P)", "ad(Ad_PB, A_P)", ours("40")),
        ("the order of the product in (44)", "cross(carried, rate)", "cross(rate, carried)", ours("40")),
        (
            "T1.2: accelerations in the place of velocities",
            "cross(carried, rate)",
            "cross(carried, scale(qdd_i, link.screw))",
            ours("T1.2"),
        ),
        (
            "47: wrenches of the children taken off",
            "f_link[i], *passed_on[i])",
            "f_link[i], *map(neg, passed_on[i]))",
            ours("47"),
        ),
        ("46 index: wrenches carried towards the tip", "ad(Ad[i], F[i])", "ad_inverse(Ad[i], F[i])", ours("47")),
        ("67: the inertial term is missing", "total(momentum(link, A[i]), cross(V[i]", "total(cross(V[i]", ours("A1")),
        (
            "the order of the gyroscopic product",
            "cross(V[i], momentum(link, V[i]))",
            "cross(momentum(link, V[i]), V[i])",
            ours("47"),
        ),
        (
            "A1: a wrench times a screw, not swapped",
            "power(F_i, link.screw)",
            "power(F_i, link.screw[::-1])",
            ours("A1"),
        ),
        ("T1.4 wrench not carried: f_tip as if in the last link", "ad(Ad_BE, f_tip)", "f_tip", ours("63")),
        ("63: f_tip as the environment exerts it", "ad(Ad_BE, f_tip)", "neg(ad(Ad_BE, f_tip))", ours("63")),
        (
            "f_ext as the links exert it",
            "neg(f_ext[i])",
            "f_ext[i]",
            f"{IDENTITIES}::test_wrenches_on_links_take_their_transposed_jacobians_off_the_torques",
        ),
        ("gravity upwards, in the paper's recursion", "(-gx, -gy, -gz)", "(gx, gy, gz)", ours("A1")),
        (
            "rotors that help",
            "+ link.armature * a",
            "- link.armature * a",
            f"{PROGRAMS}::test_torques_in_aligned_frames_equal_the_papers_recursion",
        ),
    ),
    *within(
        "torchdq/dynamics/paper/closed_form.py",
        (
            "57: the first row of A_S with the second screw",
            "A_S = [screw.swap(link.screw) for link in links]",
            "A_S = [(link.screw[1], links[i or (len(links) > 1)].screw[0]) for i, link in enumerate(links)]",
            ours("57"),
        ),
        ("61: L carries towards the base", "step = screw.inverse(Ad[i])", "step = Ad[i]", ours("61")),
        (
            "68 bracket: a product with L* W",
            "matrix.act(L_H, gyroscopic)",
            "matrix.elementwise(screw.cross, matrix.act(L_H, W), matrix.combine(G_LA, qd))",
            ours("70"),
        ),
        ("68 L W: velocities in the place of accelerations", "matrix.act(L, Wd_base)", "W", ours("68")),
        (
            "70: positions in the place of velocities",
            "coriolis = matrix.combine(matrix.act_on_matrix(L_H, G_LC), qd)",
            # the positions are the first argument of the program that the velocities are recorded in
            "coriolis = matrix.combine(matrix.act_on_matrix(L_H, G_LC), "
            "[x.tape.input(0, i) for i, x in enumerate(qd)])",
            ours("70"),
        ),
        ("71: g of the base's twist", "matrix.act(L, Wd_base)", "matrix.act(L, W_base)", ours("71")),
        (
            "T1.4 real transpose: primary and dual parts exchanged in (69)",
            "matrix.act_on_matrix(L_H, G_LA)",
            "matrix.matmul(L_H, G_LA, lambda h, m: screw.swap(screw.ad(h, screw.swap(m))), screw.add)",
            ours("T1.4"),
        ),
        ("T1.4 wrench not carried: J^T of the last link", "screw.compose(to_link, Ad_BE)", "to_link", ours("T1.4")),
        (
            "operators of L in the wrong order",
            "screw.compose(step, rows[link.parent][j])",
            "screw.compose(rows[link.parent][j], step)",
            ours("61"),
        ),
        (
            "rotors beside the diagonal",
            "i != j or link.armature",
            "i == j or link.armature",
            f"{IDENTITIES}::test_torques_are_the_sum_of_their_causes",
        ),
    ),
    *within(
        "torchdq/dynamics/aligned/rnea.py",
        (
            "46 sign: wrenches of the children taken off",
            "*passed_on[i]], _add)",
            "*[tuple(map(quat.neg, wrench)) for wrench in passed_on[i]]], _add)",
            f"{GOLDEN}::test_two_link_torques",
        ),
        ("gravity upwards", "quat.neg(aligned.gravity)", "aligned.gravity", f"{GOLDEN}::test_two_link_torques"),
        ("one sign of U", "xy - dz, xz + dy)", "xy + dz, xz + dy)", ALIGNED_TORQUES),
        (
            "the moment of the frame's acceleration with the other sign",
            "quat.cross(h, d)",
            "quat.cross(d, h)",
            ALIGNED_TORQUES,
        ),
        ("half the Coriolis acceleration on a slide", "-((w[0] + w[0]) * rate)", "-(w[0] * rate)", ALIGNED_TORQUES),
        ("one sign of w x z qd", "wd[0] + w[1] * qd", "wd[0] - w[1] * qd", ALIGNED_TORQUES),
        ("a screw jack without thrust", "along + link.pitch * force", "along", ALIGNED_TORQUES),
        ("a parent that does not turn", "quat.add(d_P, apply(u_P, step.p))", "d_P", ALIGNED_TORQUES),
        ("the lever arm with the other sign", "quat.cross(step.p, f)", "quat.cross(f, step.p)", ALIGNED_TORQUES),
    ),
    *within(
        "torchdq/dynamics/aligned/tree.py",
        (
            "a turn about x the other way",
            "c * y - s * z, s * y + c * z",
            "c * y + s * z, c * z - s * y",
            ALIGNED_TORQUES,
        ),
        ("a turn that is not turned back", "turn_x(back(link.alpha)", "turn_x(link.alpha", ALIGNED_TORQUES),
        ("a helical joint slides as a prismatic one", "else link.pitch * q_i", "else q_i", ALIGNED_TORQUES),
        ("second moments turned half", "top = c * a - s * b", "top = c * a + s * b", ALIGNED_MASSES),
        (
            "parallel axes with the other sign",
            "f = quat.add(h, quat.scale(m, p))",
            "f = quat.sub(h, quat.scale(m, p))",
            ALIGNED_MASSES,
        ),
        (
            "mass that moves to the parent and stays",
            "Body(0.0, (hx, hy, 0.0)",
            "Body(m, (hx, hy, 0.0)",
            ALIGNED_TORQUES,
        ),
        ("products of inertia for second moments", "mass * (x * y) - xy", "mass * (x * y) + xy", ALIGNED_TORQUES),
        ("30: zz is yz, in the aligned frames", "(_, _, zz) = inertia", "(_, zz, _) = inertia", ALIGNED_TORQUES),
    ),
    *within(
        "torchdq/dynamics/aligned/crba.py",
        ("products of inertia with the other sign", "(-xz, -yz, xx + yy)", "(xz, yz, xx + yy)", ALIGNED_MASSES),
        ("a sliding body's angular momentum with the other sign", "(hy, -hx, 0.0)", "(-hy, hx, 0.0)", ALIGNED_MASSES),
        (
            "momentum carried without its lever arm",
            "quat.add(to_parent(links[j], steps[j], angular), quat.cross(steps[j].p, linear))",
            "to_parent(links[j], steps[j], angular)",
            ALIGNED_MASSES,
        ),
    ),
    *within(
        "torchdq/dynamics/paper/crba.py",
        (
            "the child's position in its own axes",
            "dq.translation(X_PB[i])",
            "dq.translation_body(X_PB[i])",
            ALIGNED_MASSES,
        ),
        (
            "momentum carried towards the tip",
            "screw.ad(Ad[j], momentum)",
            "screw.ad(screw.inverse(Ad[j]), momentum)",
            ALIGNED_MASSES,
        ),
        ("a composite without the parent's first moment", "else quat.add(h, first)", "else first", ALIGNED_MASSES),
    ),
    *within(
        "torchdq/dynamics/aligned/aba.py",
        (
            "a product of inertia with the other sign, articulated",
            "(yy + zz, -xy, xx + zz",
            "(yy + zz, xy, xx + zz",
            ARTICULATED,
        ),
        (
            "first moments transposed",
            "((0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0))",
            "((0.0, z, -y), (-z, 0.0, x), (y, -x, 0.0))",
            ARTICULATED,
        ),
        ("a joint that adds inertia", "xy - rv[0] * v[1]", "xy + rv[0] * v[1]", ARTICULATED),
        ("a helical joint that feels no force", "n[2] + link.pitch * f[2]", "n[2]", ARTICULATED),
        ("a link that does not turn with its parent", "quat.add(d_P, quat.cross(wd_P, step.p))", "d_P", ARTICULATED),
    ),
    *within(
        "torchdq/dynamics/ltdl.py",
        ("an elimination that adds", "H[i, j] - ratio * H[k, j]", "H[i, j] + ratio * H[k, j]", ARTICULATED),
        (
            "a substitution that adds",
            "x[j] - factors.lower[i, j] * x[i]",
            "x[j] + factors.lower[i, j] * x[i]",
            ARTICULATED,
        ),
    ),
    *within(
        "torchdq/dynamics/conditioning.py",
        (
            "a pivot that may be negative",
            "-HUGE * reduce",
            "HUGE * reduce",
            f"{GROWTH}::test_samples_that_float32_would_lose_are_those_of_float64_rounded",
        ),
        (
            "the smallest growth for the largest",
            "maximum(reduce(maximum, factors), ",
            "maximum(reduce(minimum, factors), ",
            f"{GROWTH}::test_growth_is_the_diagonal_over_the_pivots_of_the_mass_matrix",
        ),
    ),
    *within(
        "torchdq/backends/precision.py",
        (
            "rows of float64 put back in the wrong places",
            "index_copy(0, at, w)",
            "index_copy(0, at.flip(0), w)",
            f"{GROWTH}::test_samples_that_float32_would_lose_are_those_of_float64_rounded",
        ),
        (
            "rows over the limit that stay in a sum",
            "if any(r.summed for r in program.results) or",
            "if",
            f"{GROWTH}::test_gradients_that_are_summed_hold_every_sample_once",
        ),
        (
            "singular rows that keep their numbers",
            "torch.where(over, torch.nan, 1.0)",
            "torch.where(over, 1.0, 1.0)",
            f"{GROWTH}::test_a_mass_matrix_that_is_rounding_gives_nan_and_never_a_huge_number",
        ),
        (
            "errors that grow without a limit",
            "if asked and (growth",
            "if asked or (growth",
            f"{GROWTH}::test_samples_that_float32_would_lose_are_those_of_float64_rounded",
        ),
    ),
    *within(
        "torchdq/dynamics/paper/energy.py",
        (
            "rotors at rest",
            "twice + link.armature * (qd_i * qd_i)",
            "twice",
            f"{IDENTITIES}::test_kinetic_energy_is_half_the_mass_matrix_between_velocities",
        ),
        (
            "potential energy of the other sign",
            "else -quat.dot",
            "else quat.dot",
            f"{IDENTITIES}::test_gravity_torques_are_the_gradient_of_potential_energy",
        ),
        (
            "centres of mass not turned",
            "quat.rotate(x[0], link.first)",
            "link.first",
            f"{IDENTITIES}::test_gravity_torques_are_the_gradient_of_potential_energy",
        ),
    ),
    *within(
        "torchdq/dynamics/paper/regressor.py",
        (
            "the moment of the frame's acceleration, per first moment",
            "quat.cross(d, s_w)",
            "quat.cross(s_w, d)",
            f"{ROBOTS}::test_the_regressor_times_the_parameters_is_the_torque",
        ),
        (
            "a term of a product of inertia",
            "+ s_w[j] * wd[i] + u[j] * w[i]",
            "+ s_w[j] * wd[i]",
            f"{ROBOTS}::test_the_regressor_times_the_parameters_is_the_torque",
        ),
        (
            "the order of w x v",
            "quat.cross(w, v)",
            "quat.cross(v, w)",
            f"{ROBOTS}::test_the_regressor_times_the_parameters_is_the_torque",
        ),
    ),
    *within(
        "torchdq/dynamics/tree.py",
        (
            "xz and yz exchanged",
            "((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))",
            "((xx, xy, yz), (xy, yy, xz), (yz, xz, zz))",
            f"{IDENTITIES}::test_torques_are_the_sum_of_their_causes",
        ),
    ),
    # --- numbers and programs -----------------------------------------------------------------------------------------
    *within(
        "torchdq/numbers/record.py",
        (
            "a difference exchanged without its sign",
            "a, b, negative = b, a, not negative",
            "a, b, negative = b, a, negative",
            f"{PROGRAMS}::test_a_difference_and_its_opposite_are_one_value_with_two_signs",
        ),
        ("minus one folded as one", "return self if other > 0 else -self", "return self", SIGNS),
        (
            "a division by a constant folded as a product",
            "return self * (1.0 / other)",
            "return self * other",
            f"{PROGRAMS}::test_replay_in_exact_arithmetic_is_the_function_itself",
        ),
        (
            "the sign of a divisor lost",
            "quotient, self.negative != other.negative",
            "quotient, self.negative",
            SIGNS,
        ),
        (
            "a comparison of negatives",
            "operands = operands[::-1] if row.mirror.reverse else operands",
            "operands = operands[:]",
            f"{NUMBERS}::test_equal_operations_are_recorded_once_and_signs_are_worked_in",
        ),
        (
            "a constant compared with a negative without its sign",
            "0.0 + (-x if negative else x)",
            "0.0 + x",
            f"{NUMBERS}::test_a_recorded_expression_is_the_expression_bitwise",
        ),
    ),
    *within(
        "torchdq/numbers/ops.py",
        ("an even sine", 'Mirror("sin", negative=True)', 'Mirror("sin")', SIGNS),
        (
            "an odd cosine",
            """        c_single="LIBRARY_COS({0})",
        even=(0,),""",
            """        c_single="LIBRARY_COS({0})",
        mirror=Mirror("cos", negative=True),""",
            f"{PROGRAMS}::test_replay_in_exact_arithmetic_is_the_function_itself",
        ),
        (
            "the larger of two negatives",
            'Mirror("min", negative=True)',
            'Mirror("max", negative=True)',
            f"{NUMBERS}::test_equal_operations_are_recorded_once_and_signs_are_worked_in",
        ),
        (
            "a comparison of negatives the other way round",
            'Mirror("ge", reverse=True)',
            'Mirror("ge")',
            f"{NUMBERS}::test_comparisons_of_awkward_numbers",
        ),
        (
            "NaN is smaller",
            "a if a <= b or a != a else b",
            "a if a <= b else b",
            f"{NUMBERS}::test_comparisons_of_awkward_numbers",
        ),
        (
            "a difference replayed the other way round",
            "value=operator.sub",
            "value=lambda a, b: b - a",
            f"{PROGRAMS}::test_replay_in_exact_arithmetic_is_the_function_itself",
        ),
        (
            "the derivative of a difference",
            "partials=(lambda g, y, a, b: g, lambda g, y, a, b: -g)",
            "partials=(lambda g, y, a, b: g, lambda g, y, a, b: g)",
            f"{PROGRAMS}::test_reverse_mode_equals_autograd",
        ),
        (
            "half a product rule",
            "partials=(lambda g, y, a, b: g * b, lambda g, y, a, b: a * g)",
            "partials=(lambda g, y, a, b: g * b, None)",
            f"{PROGRAMS}::test_forward_mode_equals_autograd",
        ),
        (
            "the derivative by a divisor",
            "lambda g, y, a, b: -(g * y)",
            "lambda g, y, a, b: g * y",
            f"{PROGRAMS}::test_reverse_mode_equals_autograd",
        ),
        (
            "the derivative of a cosine",
            '-(g * apply("sin", x))',
            'g * apply("sin", x)',
            f"{PROGRAMS}::test_reverse_mode_equals_autograd",
        ),
        (
            "the derivative of a square root",
            "divisor=lambda y, x: 2.0 * y",
            "divisor=lambda y, x: y",
            f"{NUMBERS}::test_first_and_second_derivatives_are_those_of_finite_differences",
        ),
        (
            "the derivative of a logarithm",
            "divisor=lambda y, x: x,",
            "divisor=lambda y, x: 1.0 / x,",
            f"{NUMBERS}::test_first_and_second_derivatives_are_those_of_finite_differences",
        ),
        (
            "the smaller of two passes the gradient",
            'apply("ge", x, z) if larger else apply("ge", z, x)',
            'apply("ge", z, x) if larger else apply("ge", x, z)',
            f"{NUMBERS}::test_first_and_second_derivatives_are_those_of_finite_differences",
        ),
        (
            "a gradient to what is not selected",
            "_select(mask, 0.0, g))",
            "g)",
            f"{NUMBERS}::test_what_is_not_selected_touches_neither_value_nor_gradient",
        ),
        (
            "in C, the larger of shared numbers",
            '"{0}>={1}||{0}!={0}?{0}:{1}"',
            '"{0}<={1}||{0}!={0}?{0}:{1}"',
            f"{NUMBERS}::test_numbers_that_all_samples_share_give_what_those_of_each_sample_give",
        ),
    ),
    *within(
        "torchdq/program/program.py",
        (
            "a result without its sign",
            "-values[v[0]] if v[1] else values[v[0]]",
            "values[v[0]]",
            f"{PROGRAMS}::test_forward_mode_equals_autograd",
        ),
    ),
    *within(
        "torchdq/program/autodiff.py",
        (
            "cotangents of negatives",
            "(-seed if v[1] else seed)",
            "seed",
            f"{PROGRAMS}::test_reverse_mode_equals_autograd",
        ),
        (
            "gradients of one row for all not summed",
            "for k in wrt if program.arguments[k].uniform]",
            "for k in wrt if not program.arguments[k].uniform]",
            f"{PROGRAMS}::test_reverse_mode_equals_autograd",
        ),
        (
            "forward mode without the divisor",
            "t.append(total if row.divisor is None else",
            "t.append(total if True else",
            f"{PROGRAMS}::test_forward_mode_equals_autograd",
        ),
    ),
    *within(
        "torchdq/backends/c_prelude.py",
        (
            "in C, the smaller for the larger",
            "choose((a>=b)|(a!=a),a,b)",
            "choose((a<=b)|(a!=a),a,b)",
            f"{NUMBERS}::test_comparisons_of_awkward_numbers",
        ),
        (
            "in C, NaN is larger",
            "choose((a<=b)|(a!=a),a,b)",
            "choose((a<=b),a,b)",
            f"{NUMBERS}::test_comparisons_of_awkward_numbers",
        ),
        ("in C, greater for at least", "(T)((a>=b)&", "(T)((a>b)&", f"{NUMBERS}::test_comparisons_of_awkward_numbers"),
        (
            "in C, the quadrant of the cosine",
            "((q+1)>>1&1)",
            "(q>>1&1)",
            f"{BACKENDS}::test_compiled_functions_equal_torch_operations",
        ),
        (
            "in C, angles reduced by two parts of pi / 2",
            "r=((x-k*HALF_PI_1)-k*HALF_PI_2)-k*HALF_PI_3",
            "r=(x-k*HALF_PI_1)-k*HALF_PI_2",
            f"{BACKENDS}::test_sine_and_cosine_are_within_two_units_in_the_last_place",
        ),
        (
            "in C, a digit of the sine's polynomial",
            "SIN(z) (-0x1.5555555555549p-3",
            "SIN(z) (-0x1.5555555455549p-3",
            f"{BACKENDS}::test_compiled_functions_equal_torch_operations",
        ),
        ("in C, whole numbers rounded down by one", "(y>x)&(M)", "(y>=x)&(M)", f"{NUMBERS}::test_special_values"),
        (
            "in C, an infinite logarithm",
            "choose(x==(T){},(T){}-(S)__builtin_inf(),x)",
            "choose(x==(T){},(T){}+(S)__builtin_inf(),x)",
            f"{NUMBERS}::test_special_values",
        ),
        (
            "in C, narrow rows written beyond the last",
            "l*width+at+TILE<=LANES*width",
            "1",
            f"{BACKENDS}::test_rows_of_any_width_are_read_and_written_and_nothing_else",
            True,
        ),
    ),
    *within(
        "torchdq/backends/c_source.py",
        (
            "in C, the last samples are copies of the first",
            "(l<here?l:here-1)",
            "(l<here?0:here-1)",
            f"{BACKENDS}::test_compiled_functions_equal_torch_operations",
        ),
        (
            "in C, idle lanes count in sums",
            "for(int l=0;l<here;l++)A{k}[j][l]+=",
            "for(int l=0;l<LANES;l++)A{k}[j][l]+=",
            f"{BACKENDS}::test_rows_of_any_width_are_read_and_written_and_nothing_else",
        ),
        (
            "in C, idle lanes are written",
            "else{{for(int l=0;l<here;l++)for(int j=0;j<{w};j++)out{k}",
            "else{{for(int l=0;l<LANES;l++)for(int j=0;j<{w};j++)out{k}",
            f"{BACKENDS}::test_rows_of_any_width_are_read_and_written_and_nothing_else",
            True,
        ),
        (
            "in C, results without their sign",
            'f"-({self.vector(index)})" if negative else self.vector(index)',
            "self.vector(index)",
            f"{BACKENDS}::test_compiled_functions_equal_torch_operations",
        ),
    ),
    *within(
        "torchdq/program/schedule.py",
        (
            "a slot given away too early",
            "expiring.setdefault(last[i], [])",
            "expiring.setdefault(last[i] - 1, [])",
            f"{BACKENDS}::test_compiled_functions_equal_torch_operations",
        ),
    ),
    *within(
        "torchdq/robot/posed.py",
        (
            "home added",
            "x - h for x, h",
            "x + h for x, h",
            f"{PROGRAMS}::test_torques_in_aligned_frames_equal_the_papers_recursion",
        ),
        (
            "the offset of a joint taken off",
            "angle = x + at.offset",
            "angle = x - at.offset",
            f"{PROGRAMS}::test_torques_in_aligned_frames_equal_the_papers_recursion",
        ),
        (
            "bodies shifted the other way",
            "quat.sub(com, at.p_BL)",
            "quat.add(com, at.p_BL)",
            f"{PROGRAMS}::test_torques_in_aligned_frames_equal_the_papers_recursion",
        ),
        (
            "wrenches about the wrong point",
            "quat.sub(moment, quat.cross(at.p_BL, force))",
            "moment",
            f"{IDENTITIES}::test_torques_are_the_sum_of_their_causes",
        ),
        (
            "more rotors in the place of rotors",
            "else link.armature + x",
            "else x",
            f"{INTEGRATORS}::test_the_error_falls_with_the_stated_order",
        ),
    ),
    *within(
        "torchdq/functions/catalogue.py",
        (
            "a bias that helps",
            "t if b is None else t - b",
            "t if b is None else t + b",
            f"{GOLDEN}::test_two_link_accelerations_from_the_recorded_torques",
        ),
        (
            "a Jacobian in the world's axes but for the frame's turn",
            "quaternion.mul(m.poses()[frame.link][0], X_BF[0])",
            "m.poses()[frame.link][0]",
            "pytorch_kinematics.py::test_jacobian",
        ),
    ),
    # --- robots -------------------------------------------------------------------------------------------------------
    *within(
        "torchdq/robot/from_screws.py",
        (
            "screws left in the base frame",
            "dq.ad(dq.conj(X_WB), s)",
            "s",
            f"{ROBOTS}::test_torques_do_not_depend_on_the_link_frames",
        ),
        (
            "home poses the other way round",
            "dq.mul(dq.conj(X_WP), X_WB)",
            "dq.mul(X_WB, dq.conj(X_WP))",
            f"{ROBOTS}::test_torques_do_not_depend_on_the_link_frames",
        ),
    ),
    *within(
        "torchdq/robot/arrays.py",
        (
            "xz and yy exchanged",
            "x[:, 1, 1], x[:, 0, 2]",
            "x[:, 0, 2], x[:, 1, 1]",
            f"{ROBOTS}::test_a_list_of_arrays_is_an_array",
        ),
    ),
    *within(
        "torchdq/robot/urdf.py",
        (
            "an inertial frame placed from the wrong side",
            "at * pin.SE3(pin.rpy.rpyToMatrix(*rpy), xyz)",
            "pin.SE3(pin.rpy.rpyToMatrix(*rpy), xyz) * at",
            f"{URDF}::test_a_body_described_on_a_fixed_link_is_the_body_on_its_carrier",
        ),
        (
            "an inertia turned the other way",
            "placement.rotation @ inertial.inertia.numpy() @ placement.rotation.T",
            "placement.rotation.T @ inertial.inertia.numpy() @ placement.rotation",
            f"{URDF}::test_a_body_described_on_a_fixed_link_is_the_body_on_its_carrier",
        ),
        (
            "inertias in the order of the file",
            "[0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]",
            "[0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]",
            f"{URDF}::test_a_fixed_link_adds_its_inertia_by_the_parallel_axis_theorem",
        ),
        (
            "no parallel axes for fixed links",
            "rotated + mass[i] * share *",
            "rotated + 0 * share *",
            f"{URDF}::test_a_fixed_link_adds_its_inertia_by_the_parallel_axis_theorem",
        ),
        (
            "slides that turn",
            "turns, torch.cat([axes, 0 * axes], -1), torch.cat([0 * axes, axes], -1)",
            "turns, torch.cat([axes, 0 * axes], -1), torch.cat([axes, 0 * axes], -1)",
            f"{URDF}::test_a_prismatic_joint_lifts_its_weight",
        ),
        (
            "damping for friction",
            "[joint.friction for joint in joints]",
            "[joint.damping for joint in joints]",
            f"{URDF}::test_damping_and_friction_are_read",
        ),
    ),
    *within(
        "torchdq/robot/urdf_document.py",
        (
            "a default axis along z",
            '"xyz", "1 0 0", 3',
            '"xyz", "0 0 1", 3',
            f"{URDF}::test_an_axis_that_is_not_given_is_x",
        ),
    ),
    *within(
        "torchdq/robot/from_dh.py",
        (
            "a shift of the other sign",
            "-0.5 * shift * s",
            "0.5 * shift * s",
            f"{ROBOTS}::test_link_frames_are_the_frames_of_the_convention",
        ),
        (
            "joints about the z axis of their own frame",
            "dq.ad(dq.conj(link), z)",
            "z",
            f"{ROBOTS}::test_link_frames_are_the_frames_of_the_convention",
        ),
        (
            "the modified convention in the standard order",
            "dq.mul(link, joint)",
            "dq.mul(joint, link)",
            f"{ROBOTS}::test_link_frames_are_the_frames_of_the_convention",
        ),
    ),
    *within(
        "torchdq/robot/mdh.py",
        (
            "one sign of an Euler angle",
            "gamma - math.copysign(math.pi, gamma), -alpha",
            "gamma - math.copysign(math.pi, gamma), alpha",
            f"{PROGRAMS}::test_aligned_frames_put_the_links_where_they_are_and_the_axes_along_z",
        ),
        (
            "an origin in the wrong axes",
            "R_WB[i].T @ (origin - p_WB[i])",
            "R_WB[i] @ (origin - p_WB[i])",
            f"{PROGRAMS}::test_aligned_frames_put_the_links_where_they_are_and_the_axes_along_z",
        ),
        (
            "an axis through the wrong point",
            "p + R @ np.cross(s[:3], s[3:])",
            "p - R @ np.cross(s[:3], s[3:])",
            f"{PROGRAMS}::test_operations_of_shipped_robots_do_not_grow",
        ),
    ),
    *within(
        "torchdq/robot/consistency.py",
        (
            "no triangle inequality",
            "moments[2] > moments[0] + moments[1] + slack",
            "moments[2] > 2 * (moments[0] + moments[1]) + slack",
            f"{URDF}::test_a_body_that_cannot_exist_is_refused_by_name_and_number",
        ),
        (
            "rods and plates cannot exist",
            "moments[0] + moments[1] + slack",
            "moments[0] + moments[1] - slack",
            f"{URDF}::test_numbers_printed_with_six_digits_are_believed",
        ),
        (
            "rounding is inertia",
            "inertia > max(1e-14 * size, square)",
            "inertia > 0",
            f"{URDF}::test_an_inertia_that_is_only_rounding_is_none",
        ),
    ),
    # --- control and learning -----------------------------------------------------------------------------------------
    *within(
        "torchdq/control.py",
        ("75: positions in the place of velocities", "kd * (qd_des - qd)", "kd * (qd_des - q)", ours("75")),
        (
            "73: the wrench fed forward with the other sign",
            "acceleration, f_tip=f_tip",
            "acceleration, f_tip=None if f_tip is None else -f_tip",
            ours("75"),
        ),
        (
            "the velocity gain on positions",
            "+ kp * (q_des - q)",
            "+ kd * (q_des - q)",
            f"{CONTROL}::test_the_robot_accelerates_as_commanded",
        ),
    ),
    *within(
        "torchdq/parametrizations.py",
        (
            "a product of inertia with the other sign",
            "(0, 0, 0, 0, 0, 0, -1, 0, 0, 0)",
            "(0, 0, 0, 0, 0, 0, 1, 0, 0, 0)",
            f"{PARAMETERS}::test_any_free_numbers_are_a_body_that_exists",
        ),
        (
            "second moments for moments of inertia",
            "half - xx, -xy, -xz",
            "xx, -xy, -xz",
            f"{PARAMETERS}::test_free_numbers_come_back",
        ),
        (
            "unconstrained numbers with a unit",
            "self.diagonal, pivots, x * size",
            "self.diagonal, pivots, x",
            f"{PARAMETERS}::test_free_numbers_come_back",
        ),
        (
            "pivots without a bound",
            "x.clamp(-LARGEST_LOGARITHM, LARGEST_LOGARITHM).exp()",
            "x.exp()",
            f"{PARAMETERS}::test_any_free_numbers_are_a_body_that_exists",
        ),
    ),
    # --- scenes -------------------------------------------------------------------------------------------------------
    *within(
        "torchdq/effects/joint.py",
        (
            "friction that pushes",
            "return [Impedance(d) for d in self.coefficient]",
            "return [Impedance(-d) for d in self.coefficient]",
            f"{EFFECTS}::test_an_effect_at_the_joints_adds_the_torques_of_its_formula",
        ),
        (
            "springs about the other side",
            "spring(k, x - r) for",
            "spring(k, x + r) for",
            f"{EFFECTS}::test_an_effect_at_the_joints_adds_the_torques_of_its_formula",
        ),
        (
            "static friction of the speed's own sign",
            "1.0 + ratio * ratio",
            "1.0 + ratio",
            f"{EFFECTS}::test_an_effect_at_the_joints_adds_the_torques_of_its_formula",
        ),
        (
            "limits that dissipate on the way back",
            "at_least(force * v, 0.0)",
            "at_least(0.0, force * v)",
            f"{EFFECTS}::test_an_effect_at_the_joints_adds_the_torques_of_its_formula",
        ),
    ),
    *within(
        "torchdq/effects/transmission.py",
        (
            "rotors that their springs drive away",
            "(u_i - t) / J",
            "(u_i + t) / J",
            f"{EFFECTS}::test_elastic_joints_are_two_masses_with_a_spring_between",
        ),
        (
            "rotors left out of an implicit step",
            "inertia.append(s * J / a)",
            "inertia.append(0.0)",
            f"{EFFECTS}::test_the_implicit_integrator_takes_elastic_springs_at_the_end_of_the_step",
        ),
    ),
    *within(
        "torchdq/effects/actuator.py",
        (
            "saturation on one side",
            "clip(x, -limit, limit)",
            "minimum(x, limit)",
            f"{EFFECTS}::test_what_is_not_given_is_as_the_description_says",
        ),
        (
            "motors that gain torque with speed",
            "stall - maximum(lost, 0.0)",
            "stall + maximum(lost, 0.0)",
            f"{EFFECTS}::test_a_motor_loses_torque_with_speed",
        ),
        ("a lag of the inverse time", "dt / T", "T / dt", f"{EFFECTS}::test_a_lag_is_the_exponential_of_its_time"),
        ("rounded down", "x / step + 0.5", "x / step", f"{EFFECTS}::test_commands_are_rounded_to_steps"),
    ),
    *within(
        "torchdq/effects/body.py",
        (
            "pushes turned the wrong way",
            "back = quat.conj(X_WF[0])",
            "back = X_WF[0]",
            f"{EFFECTS}::test_a_push_is_the_torque_of_its_jacobian",
        ),
        (
            "drag about the centre of mass",
            "quat.add(moment, quat.cross(c, force))",
            "moment",
            f"{EFFECTS}::test_drag_resists_the_motion_of_every_link",
        ),
        (
            "ground that pulls on what leaves",
            "1.0 - self.dissipation * approach",
            "1.0 + self.dissipation * approach",
            f"{EFFECTS}::test_contact_pushes_along_the_normal_and_rubs_across_it",
        ),
        (
            "friction along the sliding",
            "quat.sub(force, quat.scale(self.friction",
            "quat.add(force, quat.scale(self.friction",
            f"{EFFECTS}::test_contact_pushes_along_the_normal_and_rubs_across_it",
        ),
    ),
    *within(
        "torchdq/effects/model.py",
        (
            "a payload by its mass, not the reduced one",
            "m * self.mass / total",
            "self.mass",
            f"{EFFECTS}::test_a_payload_is_a_body_more",
        ),
        (
            "denser links of the same inertia",
            "[k * x for k, row",
            "[x for k, row",
            f"{EFFECTS}::test_denser_links_have_more_mass_and_inertia_about_the_same_centres",
        ),
    ),
    *within(
        "torchdq/effects/sensor.py",
        (
            "noise of half the variance",
            "-2.0 * log",
            "-1.0 * log",
            f"{EFFECTS}::test_noise_is_normal_with_its_standard_deviation_and_without_correlation",
        ),
        (
            "velocities as noisy as positions",
            "x + s * z[1]",
            "x + s * z[0]",
            f"{EFFECTS}::test_noise_is_normal_with_its_standard_deviation_and_without_correlation",
        ),
    ),
    *within(
        "envs/integrators.py",
        (
            "semi-implicit Euler, explicit",
            "return _plus(x, h, v), v\n\n\n@dataclass(frozen=True)\nclass LinearlyImplicit",
            "return _plus(x, h, v), _plus(v, -h, v)\n\n\n@dataclass(frozen=True)\nclass LinearlyImplicit",
            f"{INTEGRATORS}::test_the_error_falls_with_the_stated_order",
        ),
        (
            "a stage of Runge-Kutta from the wrong place",
            "a(_plus(x, 0.5 * h, v2), v3)",
            "a(_plus(x, 0.5 * h, v), v3)",
            f"{INTEGRATORS}::test_the_error_falls_with_the_stated_order",
        ),
        (
            "weights of Runge-Kutta",
            "2.0 * (q + r)",
            "(3.0 * q + r)",
            f"{INTEGRATORS}::test_the_error_falls_with_the_stated_order",
        ),
        (
            "Verlet without its symmetry",
            "_plus(_plus(x, 0.5 * h, v1), 0.5 * h, v2)",
            "_plus(x, h, v1)",
            f"{INTEGRATORS}::test_the_error_falls_with_the_stated_order",
        ),
        (
            "steps of any error",
            "good = going & (error <= 1)",
            "good = going",
            INTEGRATORS + "::test_dormand_prince_meets_its_tolerance_with_steps_of_its_order",
        ),
    ),
    *within(
        "envs/system.py",
        (
            "stiffness that is not implicit",
            "z.damping_at_end(h) for z",
            "z.damping for z",
            f"{INTEGRATORS}::test_a_bounce_off_stiff_limits_gains_no_energy",
        ),
        (
            "a spring that sees the state at its beginning",
            "self._forces(joints.torques, impedances, damping, qd)",
            "self._explicit(x, v)[1]",
            f"{EFFECTS}::test_the_implicit_integrator_takes_the_state_at_the_end_of_the_step",
        ),
        (
            "the Hamiltonian's gradient",
            "[T - U]",
            "[T + U]",
            f"{INTEGRATORS}::test_the_error_falls_with_the_stated_order",
        ),
        (
            "wrenches on the environment",
            "[neg(f) for f in wrenches]",
            "wrenches",
            f"{EFFECTS}::test_a_push_is_the_torque_of_its_jacobian",
        ),
    ),
    *within(
        "envs/controllers.py",
        (
            "75: positions in the place of velocities, in scenes",
            "(reference[n + i] - qd[i])",
            "(reference[n + i] - q[i])",
            f"{SCENE}::test_computed_torque_makes_any_arm_a_double_integrator",
        ),
    ),
)
