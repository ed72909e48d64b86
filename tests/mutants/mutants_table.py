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
FLOATING = "floating.py"
FREE_BODIES = "free_bodies.py"
CONVERT_FREE = "convert_free.py"
NUMBERS = "number_functions.py"
ROBOTS = "robots.py"
URDF = "urdf.py"
MJCF = "mjcf.py"
WRITERS = "writers.py"
EFFECTS = "effects.py"
INTEGRATORS = "integrators.py"
PARAMETERS = "parameters.py"
SCENE = "scene.py"
RECOMMEND = "recommend.py"
BACKENDS = "backends.py"
BUILD = "build.py"
FILES = "torch_files.py"
NVRTC = "nvrtc.py"
DRIVER = "cuda_driver.py"
CONTROL = "computed_torque.py"
SIGNS = "signs_and_turns.py::test_signs_are_those_of_plain_arithmetic"
MANY_TURNS = "signs_and_turns.py::test_a_rotation_by_many_turns_loses_nothing_to_the_rounding_of_its_angle"
LOGS = "logs.py"
MALFORMED = f"{LOGS}::test_a_malformed_log_is_refused_with_the_cure"
IDENTIFY = "identify.py"
TRAINING = "training.py"
UNTRUSTED = f"{TRAINING}::test_a_checkpoint_that_is_not_to_be_trusted_is_refused"
CALL = "call.py"
CALL_BATCH = f"{CALL}::test_results_go_by_name_and_have_the_batch_axes_of_all"
COUPLING = "coupling.py"
COMBINED, MAPS = "combined.py", "joint_maps_in_use.py"
STANDS_STILL = "reduced.py::test_a_locked_coordinate_is_one_that_stands_still"
GEARS = f"{COUPLING}::test_geared_joints_are_pinocchios_mimic_joints"
EXPORT = "export.py::test_results_are_those_of_the_program_in_pythons_arithmetic_bit_for_bit"
CASADI = "casadi.py"
EXPORT_FLAGS = "export.py::test_flags_that_break_sine_and_cosine_are_refused_or_harmless"
EXPORT_BATCH = "export.py::test_files_are_strict_c99_and_their_test_of_a_sample_and_of_a_batch_passes"
CALLS = "compiled_calls.py"
COUPLED_ROTORS = f"{COUPLING}::test_accelerations_undo_forces"
MOVING = "moving_base.py"
MOVING_FORCES = f"{MOVING}::test_forces_and_base_wrench_equal_pinocchios_with_a_free_flyer"
MOVING_MASSES = f"{MOVING}::test_the_mass_matrix_equals_pinocchios"
MOVING_CLOSED_FORM = f"{MOVING}::test_the_closed_form_with_a_moving_base_is_the_recursion"
MOVING_TERMS = f"{MOVING}::test_the_terms_of_the_form_that_runs_are_those_of_the_paper"
MOVING_SOLVED = f"{MOVING}::test_accelerations_undo_forces"
MOVING_ENERGIES = f"{MOVING}::test_energies_equal_pinocchios"
MOVING_JACOBIANS = f"{MOVING}::test_jacobians_and_poses_equal_pinocchios"
MOVING_TWISTS = f"{MOVING}::test_twists_and_points_are_those_of_the_world"
MOVED = f"{MOVING}::test_a_base_moves_on_the_group_or_not_at_all"
ALONG = f"{MOVING}::test_a_joint_moves_along_its_screw"
FROM_BASE = f"{MOVING}::test_poses_by_screws_in_the_base_frame_are_those_by_elementary_screws"
STEP_CHECKS = f"{SCENE}::test_what_does_not_fit_at_a_step_is_refused_by_name"
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
            "one sign of a quaternion from a matrix",
            "(zy - yz, 1.0 + xx",
            "(yz - zy, 1.0 + xx",
            f"{TENSORS}::test_rotation_matrices_there_and_back_at_every_branch_and_at_half_a_turn",
        ),
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
            "torch.cat([below, diagonal], -1)",
            "torch.cat([diagonal, below], -1)",
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
    # --- bodies and motions -------------------------------------------------------------------------------------------
    *within(
        "torchdq/algebra/elementary.py",
        (
            "a turn about an axis the other way",
            "c * v[i] - s * v[j], s * v[i] + c * v[j]",
            "c * v[i] + s * v[j], c * v[j] - s * v[i]",
            ALIGNED_TORQUES,
        ),
        ("a shift with the lever arm on the other side", "quat.cross(p, m[0])", "quat.cross(m[0], p)", ALIGNED_TORQUES),
        ("an elementary screw that only turns", "shift(unit(axis, angle.shift), turned)", "turned", ALIGNED_TORQUES),
        ("a shift twice as far", "0.5 * d", "d", MOVING_JACOBIANS),
        ("a shift the other way", "quat.add(e, quat.mul(p,", "quat.sub(e, quat.mul(p,", MOVING_JACOBIANS),
        (
            "an offset by quarter turns taken off",
            "turn(Z, a, (b[0], b[1], 0.0))",
            "turn(Z, back(a), (b[0], b[1], 0.0))",
            ALIGNED_MASSES,
        ),
    ),
    *within(
        "torchdq/algebra/inertia.py",
        ("30: I_z with I_yz twice", "quat.scale(w[2], i_z)", "quat.scale(w[2], (*i_z[:2], i_z[1]))", ours("30")),
        (
            "30: zz is yz, in the aligned frames",
            "yz, zz = about_com",
            "yz, zz = (*about_com[:5], about_com[4])",
            ALIGNED_TORQUES,
        ),
        (
            "the first moment with the other sign",
            "quat.sub(force, quat.cross(self.first",
            "quat.add(force, quat.cross(self.first",
            f"{ALGEBRA}::test_the_inertia_transform_is_mass_times_velocity_and_tensor_times_rate",
        ),
        (
            "a sliding body's angular momentum with the other sign",
            "quat.add(moment, quat.cross(self.first",
            "quat.sub(moment, quat.cross(self.first",
            f"{ALGEBRA}::test_the_inertia_transform_is_mass_times_velocity_and_tensor_times_rate",
        ),
        (
            "parallel axes with one sign",
            "shift = ((yy + zz, -xy, -xz)",
            "shift = ((yy + zz, xy, -xz)",
            f"{TENSORS}::test_inertia_about_the_centre_of_mass_is_carried_to_the_frame",
        ),
        (
            "parallel axes with a difference",
            "p[i] * h[j] + c[i] * p[j]",
            "p[i] * h[j] - c[i] * p[j]",
            f"{ALGEBRA}::test_carried_inertia_is_that_of_pinocchio_and_exactly_symmetric",
        ),
        (
            "xz and yz exchanged",
            "return ((xx, xy, xz), (xy, yy, yz)",
            "return ((xx, xy, yz), (xy, yy, xz)",
            MOVING_FORCES,
        ),
        (
            "a composite without the parent's first moment",
            "first = quat.add(self.first, other.first)",
            "first = other.first",
            ALIGNED_MASSES,
        ),
        ("products of inertia for second moments", "mass * (x * y) - xy", "mass * (x * y) + xy", ALIGNED_TORQUES),
        ("second moments by a hole", "(half - yy) + mass", "(half - yy) - mass", ALIGNED_TORQUES),
        (
            "products of inertia with the other sign",
            "return ((yy + zz, -xy, -xz), (-xy, xx + zz, -yz), (-xz, -yz, xx + yy))",
            "return ((yy + zz, -xy, xz), (-xy, xx + zz, yz), (xz, yz, xx + yy))",
            ALIGNED_MASSES,
        ),
        ("first moments that do not turn", "turn(axis, angle, self.first)", "self.first", ALIGNED_MASSES),
        (
            "parallel axes with the other sign",
            "f = quat.add(h, quat.scale(m, p))",
            "f = quat.sub(h, quat.scale(m, p))",
            ALIGNED_MASSES,
        ),
        ("second moments shifted by a difference", "f[i] * p[j] + p[i]", "f[i] * p[j] - p[i]", ALIGNED_MASSES),
        (
            "mass that moves to the parent and stays",
            "Moments(0.0, tuple(off_first)",
            "Moments(self.mass, tuple(off_first)",
            ALIGNED_TORQUES,
        ),
        (
            "second moments along an axis that are lost",
            "Moments(self.mass, tuple(first), tuple(second))",
            "Moments(self.mass, tuple(first), (0.0,) * 6)",
            ALIGNED_TORQUES,
        ),
        ("second moments turned half", "(xx - s * w, ", "(xx + s * w, ", ALIGNED_MASSES),
        ("second moments turned half, by quarter turns", "(c * a - s * b,", "(c * a + s * b,", ALIGNED_MASSES),
        (
            "a payload by its mass, not the reduced one",
            "m * share",
            "mass",
            f"{EFFECTS}::test_a_payload_is_a_body_more",
        ),
        (
            "a payload that draws the centre of mass by the link's share",
            "quat.scale(share, apart)",
            "quat.scale(1.0 - share, apart)",
            f"{EFFECTS}::test_a_payload_is_a_body_more",
        ),
    ),
    # --- joints and trees ---------------------------------------------------------------------------------------------
    *within(
        "torchdq/dynamics/joints.py",
        (
            "25 in (38): the printed exponential of a joint",
            "screw.exp_revolute(self.screw, q.cos, q.sin)",
            "dq.mul(screw.exp_prismatic(self.screw[1], q.value), "
            "screw.exp_revolute((self.screw[0], (0.0, 0.0, 0.0)), q.cos, q.sin))",
            ours("38"),
        ),
        (
            "A1: a wrench times a screw, not swapped",
            "screw.power(F, self.screw),",
            "screw.power(F, self.screw[::-1]),",
            ours("A1"),
        ),
        (
            "a prismatic joint along its moment's place",
            "self.screw[1], q.value)",
            "self.screw[0], q.value)",
            MOVING_FORCES,
        ),
        (
            "joints of unit rate",
            "v[0] is None else screw.scale(v[0], self.screw)",
            "v[0] is None else self.screw",
            MOVING_FORCES,
        ),
        (
            "an axis through the wrong point",
            "quat.cross(*self.screw)",
            "quat.cross(*self.screw[::-1])",
            f"{PROGRAMS}::test_aligned_frames_put_the_links_where_they_are_and_the_axes_along_z",
        ),
        ("a revolute joint that slides by its angle", "return x if self.slides else 0.0", "return x", ALIGNED_TORQUES),
        ("a prismatic joint that turns by its length", "return x if self.turns else 0.0", "return x", ALIGNED_TORQUES),
        ("a helical joint slides as a prismatic one", "return self.pitch * x", "return x", ALIGNED_TORQUES),
        (
            "the pitch of a turn for that of a radian",
            "return quat.dot(*self.screw)",
            "return 2.0 * quat.dot(*self.screw)",
            ALIGNED_TORQUES,
        ),
        ("a joint that moves against its velocity", "q[0] + h * v[0]", "q[0] - h * v[0]", ALONG),
        (
            "the base's velocities as (linear, angular)",
            "return None if v is None else (tuple(v[:3]), tuple(v[3:]))",
            "return None if v is None else (tuple(v[3:]), tuple(v[:3]))",
            MOVING_FORCES,
        ),
        ("the base's wrench as (force, moment)", "(*F[1], *F[0])", "(*F[0], *F[1])", MOVING_FORCES),
        ("a free base that moves twice as far", "screw.scale(0.5 * h,", "screw.scale(h,", MOVED),
        (
            "a free base that moves in the world's axes",
            "dq.mul((tuple(q[:4]), tuple(q[4:])), exp(half))",
            "dq.mul(exp(half), (tuple(q[:4]), tuple(q[4:])))",
            MOVED,
        ),
    ),
    *within(
        "torchdq/dynamics/tree.py",
        (
            "only the first degree of freedom of a base comes before the joints on it",
            "before = self.links[i].v.stop - 1",
            "before = self.links[i].v.start",
            MOVING_SOLVED,
        ),
        (
            "the degrees of freedom of a base side by side",
            "found.append(before)\n                before = len(found) - 1",
            "found.append(before)",
            MOVING_SOLVED,
        ),
        (
            "more rotors in the place of rotors",
            "return b if a is None else a + b",
            "return b",
            f"{INTEGRATORS}::test_the_error_falls_with_the_stated_order",
        ),
    ),
    *within(
        "torchdq/dynamics/coupling.py",
        (
            "a free base that moves the joints of a map",
            "*((None,) * count + tuple(row) for",
            "*(tuple(row) + (None,) * count for",
            "joint_maps.py::test_dynamics_on_a_free_base_are_those_of_the_reduced_system",
        ),
        (
            "torques through a gear by its ratio's inverse",
            "matrix.matvec(matrix.transpose(self.S), tau",
            "matrix.matvec(tuple(tuple(s and 1.0 / s for s in row) for row in matrix.transpose(self.S)), tau",
            GEARS,
        ),
        ("rotors behind a map with twice their energy", "energy + 0.5 * J", "energy + J", COUPLED_ROTORS),
        ("rotors behind a map that help", "t + J * a for", "t - J * a for", COUPLED_ROTORS),
        (
            "rotors behind a map taken off the mass matrix",
            "present(M[k][k]) + J",
            "present(M[k][k]) - J",
            COUPLED_ROTORS,
        ),
        ("more rotors behind a map in the place of rotors", "armature=[a + b for", "armature=[b for", COUPLED_ROTORS),
        (
            "a regressor that takes accelerations for velocities",
            "self.robot.regressor(v, a)",
            "self.robot.regressor(a, a)",
            f"{COUPLING}::test_forces_are_linear_in_the_inertial_parameters",
        ),
    ),
    # --- dynamics as the paper has it ---------------------------------------------------------------------------------
    *within(
        "torchdq/dynamics/paper/kinematics.py",
        (
            "38: delta of the parent in the link",
            "compose(link.placement, link.joint.motion(q_i))",
            "compose(link.placement and dq.conj(link.placement), link.joint.motion(q_i))",
            ours("38"),
        ),
        (
            "38 indices exchanged: poses of the parent in the link",
            "compose(link.placement, link.joint.motion(q_i)) for link, q_i in zip(tree.links, q, strict=True)",
            "x and dq.conj(x) for x in (compose(link.placement and dq.conj(link.placement), "
            "link.joint.motion(q_i)) for link, q_i in zip(tree.links, q, strict=True))",
            ours("40"),
        ),
        (
            "poses multiplied the other way round",
            "compose(X_WB[link.parent], x)",
            "compose(x, X_WB[link.parent])",
            ours("38"),
        ),
        (
            "a Jacobian in the link instead of the frame",
            "screw.inverse(screw.columns(X_BF))",
            "screw.columns(X_BF)",
            MOVING_JACOBIANS,
        ),
        (
            "screws carried in the wrong order",
            "screw.compose(to_i, screw.inverse(step))",
            "screw.compose(screw.inverse(step), to_i)",
            MOVING_JACOBIANS,
        ),
    ),
    *within(
        "torchdq/dynamics/paper/rnea.py",
        (
            "40: twists carried towards the base",
            "carried = to_link(Ad_PB, V_P)",
            "carried = to_parent(Ad_PB, V_P)",
            ours("40"),
        ),
        (
            "40: accelerations carried towards the base, (44)",
            "to_link(Ad_PB, A_P)",
            "to_parent(Ad_PB, A_P)",
            ours("40"),
        ),
        ("the order of the product in (44)", "cross(carried, rate)", "cross(rate, carried)", ours("40")),
        (
            "T1.2: accelerations in the place of velocities",
            "cross(carried, rate)",
            "cross(carried, change)",
            ours("T1.2"),
        ),
        (
            "47: wrenches of the children taken off",
            "f_link[i], *passed_on[i])",
            "f_link[i], *map(neg, passed_on[i]))",
            ours("47"),
        ),
        ("46 index: wrenches carried towards the tip", "to_parent(Ad[i], F[i])", "to_link(Ad[i], F[i])", ours("47")),
        ("67: the inertial term is missing", "add(momentum(link, A[i]), cross(V[i]", "add(cross(V[i]", ours("A1")),
        (
            "the order of the gyroscopic product",
            "cross(V[i], momentum(link, V[i]))",
            "cross(momentum(link, V[i]), V[i])",
            ours("47"),
        ),
        (
            "T1.4 wrench not carried: f_tip as if in the last link",
            "to_parent(Ad_BE, f_tip)",
            "f_tip",
            ours("63"),
        ),
        (
            "63: f_tip as the environment exerts it",
            "to_parent(Ad_BE, f_tip)",
            "neg(to_parent(Ad_BE, f_tip))",
            ours("63"),
        ),
        (
            "f_ext as the links exert it",
            "neg(f_ext[i])",
            "f_ext[i]",
            f"{IDENTITIES}::test_wrenches_on_links_take_their_transposed_jacobians_off_the_torques",
        ),
        ("gravity upwards, in the paper's recursion", "quat.neg(tree.gravity)", "tree.gravity", ours("A1")),
        ("rotors that help", "+ link.armature * qdd[k]", "- link.armature * qdd[k]", ALIGNED_TORQUES),
    ),
    *within(
        "torchdq/dynamics/paper/closed_form.py",
        (
            "57: the first row of A_S with the second screw",
            "A_S = [screw.swap(a) for _, a in freedoms]",
            "A_S = [(a[1], freedoms[k or (len(freedoms) > 1)][1][0]) for k, (_, a) in enumerate(freedoms)]",
            ours("57"),
        ),
        ("61: L carries towards the base", "else screw.inverse(step)", "else step", ours("61")),
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
            # the position of a revolute joint is the angle between a link and its home pose
            "turned = lambda i: zip(screw.quat.rotation_columns(links[i].placement[0]), Ad[i][0])\n"
            "    q = [(0.5 * sum(screw.quat.dot(*e) for e in turned(i)) - 0.5).acos() for i, _ in freedoms]\n"
            "    coriolis = matrix.combine(matrix.act_on_matrix(L_H, G_LC), q)",
            ours("70"),
        ),
        # the base is at rest
        ("71: g of the base's twist", "matrix.act(L, Wd_base)", "matrix.act(L, [None] * len(links))", ours("71")),
        (
            "T1.4 real transpose: primary and dual parts exchanged in (69)",
            "matrix.act_on_matrix(L_H, G_LA)",
            "matrix.matmul(L_H, G_LA, lambda h, m: screw.swap(screw.ad(h, screw.swap(m))), screw.add)",
            ours("T1.4"),
        ),
        ("T1.4 wrench not carried: J^T of the last link", "screw.compose(to_link, Ad_BE)", "to_link", ours("T1.4")),
        (
            "operators of L in the wrong order",
            "screw.compose(to_i, rows[link.parent][j])",
            "screw.compose(rows[link.parent][j], to_i)",
            ours("61"),
        ),
        (
            "rotors beside the diagonal",
            "if i == j and i in rotors else m",
            "if m is not None and i in rotors else m",
            MOVING_CLOSED_FORM,
        ),
    ),
    *within(
        "torchdq/dynamics/paper/posed.py",
        (
            "the child's position in its own axes",
            "body.carried(columns, dq.translation(x))",
            "body.carried(columns, dq.translation_body(x))",
            ALIGNED_MASSES,
        ),
        (
            "momentum carried towards the tip",
            "kinematics.to_parent(self.Ad[i], F)",
            "kinematics.to_link(self.Ad[i], F)",
            ALIGNED_MASSES,
        ),
        (
            "a Jacobian in the world's axes but for the frame's turn",
            "quat.mul(self.poses()[i][0], X_BF[0])",
            "self.poses()[i][0]",
            MOVING_JACOBIANS,
        ),
        (
            "the order of w x v",
            "quat.cross(w, v)",
            "quat.cross(v, w)",
            f"{COUPLING}::test_forces_are_linear_in_the_inertial_parameters",
        ),
        ("a position in the link's axes", "quat.rotate(X[0], r)", "r", MOVING_TWISTS),
    ),
    # --- dynamics as it runs ------------------------------------------------------------------------------------------
    *within(
        "torchdq/dynamics/aligned/placement.py",
        (
            "bodies shifted the other way",
            "quat.sub(r, self.p_BL)",
            "quat.add(r, self.p_BL)",
            ALIGNED_TORQUES,
        ),
        (
            "wrenches about the wrong point",
            "quat.sub(moment, quat.cross(self.p_BL, force))",
            "moment",
            f"{IDENTITIES}::test_torques_are_the_sum_of_their_causes",
        ),
        (
            "inertia in the axes of the description",
            "for v in half) for e in columns))",
            "for v in half) for e in self.R_BL))",
            ALIGNED_TORQUES,
        ),
        (
            "accelerations of the regressor in aligned axes",
            "tuple(quat.dot(row, v) for row in self.R_BL)",
            "v",
            f"{ROBOTS}::test_the_regressor_times_the_parameters_is_the_torque",
        ),
        (
            "a turn about x the other way",
            "turn(X, at.alpha, turn(Z, self.theta.turn, v))",
            "turn(X, back(at.alpha), turn(Z, self.theta.turn, v))",
            MOVING_TWISTS,
        ),
        ("a turn that is not turned back", "turn(X, back(at.alpha),", "turn(X, at.alpha,", ALIGNED_TORQUES),
        (
            "wrenches without the turn between the axes' normals",
            "m = elementary.ad(Z, DualAngle(at.gamma, 0.0), elementary.ad(X, DualAngle(at.alpha, 0.0), m))",
            "m = elementary.ad(X, DualAngle(at.alpha, 0.0), m)",
            ALIGNED_TORQUES,
        ),
        (
            "the lever arm with the other sign",
            "return elementary.shift(at.p, m)",
            "return elementary.shift(quat.neg(at.p), m)",
            ALIGNED_TORQUES,
        ),
        (
            "accelerations about the wrong point",
            "elementary.shift(quat.neg(self.placement.p), m)",
            "elementary.shift(self.placement.p, m)",
            ARTICULATED,
        ),
        (
            "twists shifted along the axis the other way",
            "elementary.unit(Z, -self.theta.shift), turned",
            "elementary.unit(Z, self.theta.shift), turned",
            MOVING_TWISTS,
        ),
        ("a point that does not slide with its joint", "z + self.theta.shift", "z", MOVING_TWISTS),
        (
            "a body that does not slide with its joint",
            "body.turned(Z, self.theta.turn).shifted(elementary.unit(Z, self.theta.shift))",
            "body.turned(Z, self.theta.turn)",
            ALIGNED_MASSES,
        ),
        (
            "a body turned in the wrong order",
            "body.turned(X, at.alpha).turned(Z, at.gamma)",
            "body.turned(Z, at.gamma).turned(X, at.alpha)",
            ALIGNED_MASSES,
        ),
    ),
    *within(
        "torchdq/dynamics/aligned/posed.py",
        (
            "the offset of a joint taken off",
            "whole = angle + at.offset",
            "whole = angle - at.offset",
            ALIGNED_TORQUES,
        ),
        (
            "the offset of a joint taken off its pose",
            "link.joint.angle(x) + at.offset",
            "link.joint.angle(x) - at.offset",
            MOVING_JACOBIANS,
        ),
        (
            "momentum carried without its lever arm",
            "lambda i, F: self.steps[i].to_parent(F)",
            "lambda i, F: tuple(map(self.steps[i].vector_to_parent, F))",
            ALIGNED_MASSES,
        ),
        (
            "centres of mass not turned",
            "quat.rotate(self.X_WB[0], whole.first)",
            "whole.first",
            MOVING_ENERGIES,
        ),
        ("a base that lifts no weight", "quat.scale(whole.mass,", "quat.scale(0.0 * whole.mass,", MOVING_ENERGIES),
        (
            "a Jacobian in the base's axes for the world's",
            "{k: (quat.rotate(r, w), quat.rotate(r, v)) for k, (w, v) in found.items()}",
            "found",
            MOVING_JACOBIANS,
        ),
        (
            "forces of the world in the base's axes",
            "quat.rotate(quat.conj(self.X_WB[0]), v)",
            "quat.rotate(self.X_WB[0], v)",
            MOVING_TWISTS,
        ),
    ),
    *within(
        "torchdq/dynamics/aligned/regroup.py",
        (
            "mass on the axis of a screw jack moved to its parent",
            "link.joint.slides or not",
            "not",
            ALIGNED_TORQUES,
        ),
    ),
    *within(
        "torchdq/dynamics/aligned/kinematics.py",
        (
            "the velocity of a frame by the wrong arm",
            "quat.cross(w, frame.position)",
            "quat.cross(frame.position, w)",
            MOVING_JACOBIANS,
        ),
        (
            "a frame that is turned towards the base and not moved",
            "Point(step.point_to_parent(frame.position), axes)",
            "Point(step.vector_to_parent(frame.position), axes)",
            MOVING_JACOBIANS,
        ),
        (
            "offsets in the axes of their parents",
            "tuple(quat.dot(e, step.placement.p) for e in axes[link.parent])",
            "step.placement.p",
            MOVING_JACOBIANS,
        ),
        ("origins that do not slide", "e[2] * step.theta.shift", "0.0 * e[2]", MOVING_JACOBIANS),
        (
            "the arm from the point to the joint",
            "quat.cross(w_W, arm)",
            "quat.cross(arm, w_W)",
            MOVING_JACOBIANS,
        ),
        ("poses of the aligned frames for those of the links", "dq.mul(X[-1], at.X_LB)", "X[-1]", MOVING_JACOBIANS),
        (
            "motions from home in the wrong order",
            "dq.mul(found[link.parent].motion, at.joint_W.motion(q_i))",
            "dq.mul(at.joint_W.motion(q_i), found[link.parent].motion)",
            FROM_BASE,
        ),
        (
            "vectors of the base turned as if of the link",
            "v if step is None else step.vector_to_link(v)",
            "v if step is None else step.vector_to_parent(v)",
            MOVING_TWISTS,
        ),
    ),
    *within(
        "torchdq/dynamics/aligned/rnea.py",
        (
            "46 sign: wrenches of the children taken off",
            "exerted[i], *passed_on[i])",
            "exerted[i], *[(quat.neg(f), quat.neg(n)) for f, n in passed_on[i]])",
            f"{GOLDEN}::test_two_link_torques",
        ),
        (
            "gravity upwards",
            "quat.sub(quat.add(vd, quat.cross(w, v)), g)",
            "quat.add(quat.add(vd, quat.cross(w, v)), g)",
            f"{GOLDEN}::test_two_link_torques",
        ),
        (
            "gravity turned the wrong way into a base",
            "quat.rotate(quat.conj(X_WB[0]), gravity)",
            "quat.rotate(X_WB[0], gravity)",
            MOVING_FORCES,
        ),
        ("a base that turns and moves, the wrong way round", "quat.cross(w, v)", "quat.cross(v, w)", MOVING_FORCES),
        (
            "a parent that does not turn",
            "apply(u, step.placement.p))",
            "apply(u, (0.0, 0.0, 0.0)))",
            ALIGNED_TORQUES,
        ),
        ("half the Coriolis acceleration on a slide", "quat.add(across, across)", "across", ALIGNED_TORQUES),
        ("one sign of w x z qd", "quat.cross(w, rate[0])", "quat.cross(rate[0], w)", ALIGNED_TORQUES),
        (
            "joints that do not add to the velocity",
            "w = quat.add(w, rate[0])",
            "w = quat.add(w, ZERO)",
            ALIGNED_TORQUES,
        ),
        ("joints that do not add to the angular acceleration", "quat.add(wd, change[0])", "wd", ALIGNED_TORQUES),
        ("slides without their acceleration", "quat.add(d, change[1])", "d", ALIGNED_TORQUES),
        (
            "an origin at the foot of its slide",
            "quat.add(d, apply(u, (0.0, 0.0, step.theta.shift)))",
            "d",
            ALIGNED_TORQUES,
        ),
        ("rotors that help, in aligned frames", "force + link.armature", "force - link.armature", ALIGNED_TORQUES),
        (
            "a screw jack without thrust",
            "link.joint.project(F)",
            "link.joint.project((ZERO, F[1]) if link.joint.turns else F)",
            ALIGNED_TORQUES,
        ),
        (
            "wrenches on the environment taken off",
            "None if exerted is None else exerted[i]",
            "None if exerted is None else exerted[i] and (quat.neg(exerted[i][0]), quat.neg(exerted[i][1]))",
            f"{IDENTITIES}::test_wrenches_on_links_take_their_transposed_jacobians_off_the_torques",
        ),
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
        ("a joint that adds inertia", "e - rv[i] * v[j]", "e + rv[i] * v[j]", ARTICULATED),
        (
            "a helical joint that feels no force",
            "net[k] - screw.power(F, a)",
            "net[k] - screw.power(((0.0, 0.0, 0.0) if link.joint.turns else F[0], F[1]), a)",
            ARTICULATED,
        ),
        (
            "a link that does not turn with its parent",
            "step.to_link(below)",
            "(step.vector_to_link(below[0]), step.vector_to_link(below[1]))",
            ARTICULATED,
        ),
        ("a rotor that moves with its link", "None if rotor else _axis(a)", "_axis(a)", ARTICULATED),
        (
            "a base whose degrees of freedom do not feel each other",
            "responses[k] = body.response(a)",
            "responses[k] = inertia[i].response(a)",
            MOVING_SOLVED,
        ),
        (
            "a base whose degrees of freedom do not drive each other",
            "if F is not None:\n                net[k] = net[k] - screw.power(F, a)",
            "if bias[i] is not None:\n                net[k] = net[k] - screw.power(bias[i], a)",
            MOVING_SOLVED,
        ),
        (
            "a base whose degrees of freedom do not carry each other",
            "r * (net[k] - screw.power(factors.responses[k], A))",
            "r * (net[k] - screw.power(factors.responses[k], A if link.joint.nv == 1 else ((0.0,) * 3,) * 2))",
            MOVING_SOLVED,
        ),
        (
            "an articulated body shifted the other way",
            "quat.add(b, c) for b, c in zip(self.B, pC",
            "quat.sub(b, c) for b, c in zip(self.B, pC",
            ARTICULATED,
        ),
    ),
    *within(
        "torchdq/dynamics/acceleration.py",
        ("one sign of U", "xy - dz, xz + dy)", "xy + dz, xz + dy)", ALIGNED_TORQUES),
        (
            "the moment of the frame's acceleration with the other sign",
            "quat.cross(body.first, d)",
            "quat.cross(d, body.first)",
            ALIGNED_TORQUES,
        ),
        ("one sign of the moment of the second moments", "ue(0, 2) - ue(2, 0)", "ue(2, 0) - ue(0, 2)", ALIGNED_TORQUES),
        (
            "a body that may be spun about its origin for nothing",
            "apply(u, body.first))",
            "apply(u, (0.0, 0.0, 0.0)))",
            ALIGNED_TORQUES,
        ),
    ),
    *within(
        "torchdq/dynamics/posed.py",
        (
            "c with gravity",
            "posed.without_gravity().torques(qd, None, None)",
            "posed.torques(qd, None, None)",
            MOVING_TERMS,
        ),
        ("g in motion", "c, posed.torques(None, None, None)", "c, posed.torques(qd, None, None)", MOVING_TERMS),
    ),
    *within(
        "torchdq/dynamics/crba.py",
        ("a composite of the last child alone", "else found[parent].plus(inertia)", "else inertia", MOVING_MASSES),
        ("a mass matrix without rotors", "else entry + link.armature", "else entry", MOVING_MASSES),
        ("momentum that is not carried", "momentum = to_parent(below, momentum)", "momentum = momentum", MOVING_MASSES),
        ("momentum carried from the same link again and again", "below = j", "below = i", MOVING_MASSES),
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
            "at_least(0.0, reduce(minimum, inverses))",
            "at_least(reduce(minimum, inverses), 0.0)",
            f"{GROWTH}::test_samples_that_float32_would_lose_are_those_of_float64_rounded",
        ),
        (
            "the smallest growth for the largest",
            "HUGE, reduce(maximum, factors)",
            "HUGE, reduce(minimum, factors)",
            f"{GROWTH}::test_growth_is_the_diagonal_over_the_pivots_of_the_mass_matrix",
        ),
    ),
    *within(
        "torchdq/dynamics/energy.py",
        ("twice the kinetic energy", "0.5 * twice", "twice", MOVING_ENERGIES),
        (
            "rotors at rest",
            "link.armature * (rate * rate)",
            "0.0 * (rate * rate)",
            f"{IDENTITIES}::test_kinetic_energy_is_half_the_mass_matrix_between_velocities",
        ),
        (
            "potential energy of the other sign",
            "else -quat.dot",
            "else quat.dot",
            f"{IDENTITIES}::test_gravity_torques_are_the_gradient_of_potential_energy",
        ),
    ),
    *within(
        "torchdq/dynamics/regressor.py",
        (
            "the moment of the frame's acceleration, per first moment",
            "quat.cross(d, s_w)",
            "quat.cross(s_w, d)",
            f"{ROBOTS}::test_the_regressor_times_the_parameters_is_the_torque",
        ),
        (
            "the force of the first moments by U transposed",
            "quat.dot(column, s_v) for column in columns",
            "quat.dot(row, s_v) for row in u",
            f"{ROBOTS}::test_the_regressor_times_the_parameters_is_the_torque",
        ),
        (
            "a term of a product of inertia",
            "u21 * y - u20 * x - (u11 - u00) * z",
            "u21 * y - u20 * x",
            f"{ROBOTS}::test_the_regressor_times_the_parameters_is_the_torque",
        ),
        (
            "a moment of inertia for a second moment",
            "half - yy",
            "yy",
            f"{ROBOTS}::test_the_regressor_times_the_parameters_is_the_torque",
        ),
    ),
    # --- running programs ---------------------------------------------------------------------------------------------
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
            "if readable and _within",
            "if readable or _within",
            f"{GROWTH}::test_samples_that_float32_would_lose_are_those_of_float64_rounded",
        ),
        (
            "the smallest growth of all samples asked for",
            "growth.amax()",
            "growth.amin()",
            f"{GROWTH}::test_samples_that_float32_would_lose_are_those_of_float64_rounded",
        ),
        (
            "float64 held to the limit of float32",
            "LARGEST_GROWTH.double if dtype",
            "LARGEST_GROWTH.single if dtype",
            f"{GROWTH}::test_samples_that_float32_would_lose_are_those_of_float64_rounded",
        ),
        (
            "samples that a transform hides asked all the same",
            "readable = not (backend.differentiable and without_values(inputs))",
            "readable = True",
            f"{GROWTH}::test_transforms_mend_the_same_samples",
        ),
        (
            "a growth that is NaN passed over",
            "over = ~(growth[:, 0].detach() <= largest_growth(dtype))",
            "over = growth[:, 0].detach() > largest_growth(dtype)",
            f"{GROWTH}::test_a_sample_whose_growth_is_no_number_is_recomputed_too",
        ),
    ),
    *within(
        "torchdq/backends/call.py",
        (
            "precision of the arguments not checked",
            "if x.dtype != like.dtype:",
            "if False:",
            f"{CALL}::test_what_does_not_fit_is_named",
        ),
        (
            "devices of the arguments not checked",
            "if x.device != like.device:",
            "if False:",
            "arguments.py::test_mixed_devices_are_named",
        ),
        (
            "integers taken for angles",
            "if x.dtype not in DTYPES:",
            "if False:",
            "arguments.py::test_a_dtype_that_dynamics_are_not_computed_in_is_named",
        ),
        (
            "batch axes that differ not broadcast in graphs",
            "if last != axes or not (uniform or own == batch):",
            "if last != axes:",
            "transforms.py::test_a_compiled_layer_broadcasts_batch_axes",
        ),
        (
            "no check of the arguments together",
            "what.check(given)",
            "given",
            f"{CALL}::test_what_does_not_fit_is_named",
        ),
        (
            "arguments too wide or too narrow",
            "tuple(x.shape[x.ndim - len(axes) :]) != axes",
            "False",
            f"{CALL}::test_what_does_not_fit_is_named",
        ),
        (
            "every argument without batch axes shared",
            "what.shared(name) and x.ndim == len(axes)",
            "x.ndim == len(axes)",
            f"{BACKENDS}::test_new_batch_sizes_need_no_new_kernel",
        ),
        (
            "shared arguments with batch axes in one row",
            "what.shared(name) and x.ndim == len(axes)",
            "what.shared(name)",
            CALL_BATCH,
        ),
        (
            "batch axes lost",
            "tuple([axes if summed else batch + axes for",
            "tuple([axes for",
            CALL_BATCH,
        ),
        (
            "batch axes in one row",
            "expanded, flat = (axes, (width,)) if uniform else (batch + axes, (samples, width))",
            "expanded, flat = (axes, (width,)) if uniform else (batch + axes, (1, samples * width))",
            CALL_BATCH,
        ),
        (
            "one layout for both precisions",
            "present(), double, *tensors",
            "present(), *tensors",
            f"{CALL}::test_double_precision_inside_is_float64_rounded",
        ),
        (
            "one layout for all backends",
            "key = (what, backend, present(), double",
            "key = (what, double",
            f"{BACKENDS}::test_a_block_chooses_the_backend_and_an_argument_overrides_it",
        ),
        (
            "results in the precision of the program",
            "found = [y.to(narrow) for y in found]",
            "pass",
            f"{CALL}::test_double_precision_inside_is_float64_rounded",
        ),
    ),
    *within(
        "torchdq/program/autograd.py",
        (
            "torch.jit.trace not noticed by calls without views",
            "transforming() or jit_tracing() or",
            "transforming() or",
            f"{BACKENDS}::test_torch_jit_trace_refuses_compiled_programs",
        ),
        (
            "tangents lost in compiled graphs",
            "if transforming():  # only torch's own operations carry tangents",
            "if False:",
            "transforms.py::test_a_transform_inside_a_compiled_function_has_the_values_of_the_transform_outside",
        ),
    ),
    *within(
        "torchdq/program/transforms.py",
        (
            "branches on values in traces",
            "        or jit_tracing()\n        or proxy_tracing()\n",
            "",
            f"{BACKENDS}::test_a_trace_recomputes_the_rows_of_other_values_in_float64",
        ),
        (
            "constants of ONNX files rounded to float32",
            "if not torch.compiler.is_exporting() or transforming():",
            "if True:",
            f"{FILES}::test_an_onnx_file_has_the_same_values_to_rounding",
        ),
    ),
    *within(
        "torchdq/backends/choice.py",
        (
            "transforms of torch.func by the compiled programs",
            'and (name or present()) == "auto"',
            "and False",
            f"{BACKENDS}::test_make_fx_records_what_a_function_computes_and_not_its_result",
        ),
        (
            "exported graphs of compiled programs",
            'if name not in ("auto", "eager"):',
            "if False:",
            f"{FILES}::test_programs_of_this_process_are_not_exported",
        ),
        (
            "reverse mode in exported graphs",
            "if reversing():",
            "if False:",
            f"{FILES}::test_reverse_mode_in_an_exported_function_is_refused",
        ),
    ),
    *within(
        "torchdq/backends/c_library.py",
        (
            "libraries kept before they were loaded",
            "        _opened(library)\n",
            "",
            f"{BUILD}::test_a_compiler_that_does_not_compile_is_an_error_and_nothing_is_kept",
        ),
        (
            "libraries that stay in memory",
            "weakref.finalize(function, _ctypes.dlclose, library)",
            "weakref.finalize(function, str, library)",
            f"{BUILD}::test_a_library_is_unloaded_with_its_kernel",
        ),
    ),
    *within(
        "torchdq/backends/cuda_driver.py",
        (
            "arguments of a kernel shared by threads",
            "class _Arguments(threading.local):",
            "class _Arguments:",
            f"{DRIVER}::test_threads_do_not_mix_their_arguments",
        ),
        (
            "a kernel launched on another device than its tensors'",
            "with torch.cuda.device(device.index):",
            "if True:",
            f"{DRIVER}::test_another_device_is_current_during_the_launch_only",
        ),
        (
            "kernels that stay loaded",
            'weakref.finalize(self, call["cuLibraryUnload"], self.handle)',
            "weakref.finalize(self, str, self.handle)",
            f"{DRIVER}::test_kernels_are_loaded_once_and_unloaded_with_the_last_reference",
        ),
        (
            "kernels of a CUDA graph unloaded",
            "_captured.add(self.module)",
            "pass",
            f"{DRIVER}::test_what_a_graph_captured_stays_loaded",
        ),
        (
            "shared memory that was not asked for",
            "if self.shared > SHARED and",
            "if False and",
            f"{DRIVER}::test_more_shared_memory_is_asked_for_once_on_every_device",
        ),
        (
            "threads without a context",
            "if status == NO_CONTEXT:",
            "if False:",
            f"{DRIVER}::test_a_thread_without_a_context_gets_that_of_torch",
        ),
    ),
    *within(
        "torchdq/backends/nvrtc.py",
        (
            "NVRTC without its second library",
            'raise BuildError(f"{path} lacks its second library: {error}") from error',
            "pass",
            f"{NVRTC}::test_one_that_cannot_be_used_is_passed_over",
        ),
        (
            "NVRTC of another version than torch's",
            "return [own, *(major for major in MAJORS if major != own)]",
            "return sorted({own, *MAJORS}, reverse=True)",
            f"{NVRTC}::test_the_version_of_torch_goes_before_newer_ones_wherever_they_are",
        ),
        (
            "kernels that keep all values in memory",
            "used.registers <= FEW and used.stack >= LARGE",
            "False",
            f"{NVRTC}::test_where_registers_are_not_allocated_less_optimisation_is_tried",
        ),
        (
            "machine code for a GPU that the compiler does not know",
            'return f"compute_{older[-1]}"',
            'return f"sm_{older[-1]}"',
            f"{NVRTC}::test_another_architecture_gets_text_of_the_newest_before_it",
        ),
        (
            "programs of NVRTC that stay in memory",
            "library.nvrtcDestroyProgram(program)",
            "pass",
            f"{NVRTC}::test_no_program_stays_in_memory",
        ),
        (
            "machine code of another architecture",
            "self.target(architecture), *FLAGS, CALMER",
            "*FLAGS, CALMER",
            f"{NVRTC}::test_code_is_kept_by_all_that_it_depends_on",
        ),
    ),
    *within(
        "torchdq/backends/cache.py",
        (
            "files used last removed first",
            "sorted(files, reverse=True)",
            "sorted(files)",
            f"{BUILD}::test_a_full_cache_loses_the_libraries_that_were_used_least_recently",
        ),
        (
            "machine code for GPUs never removed",
            'Literal[".so", ".cubin"]',
            'Literal[".so"]',
            f"{BUILD}::test_a_full_cache_loses_files_of_any_kind",
        ),
        (
            "a file taken for another program's",
            "hashlib.sha256(key.encode() + body)",
            "hashlib.sha256(body)",
            f"{BUILD}::test_a_broken_or_foreign_entry_is_built_again",
        ),
        (
            "one compilation per thread",
            "fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)",
            "pass",
            f"{BUILD}::test_sixteen_threads_and_four_processes_compile_a_program_once",
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
            "return self * (1.0 / _constant(other))",
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
            "a gradient to what is selected, wherever it is",
            "lambda g, y, mask, a, b: _select(mask, g, 0.0)",
            "lambda g, y, mask, a, b: g",
            f"{NUMBERS}::test_what_is_not_selected_touches_neither_value_nor_gradient",
        ),
        (
            "gradients of what is selected and what is not exchanged",
            "lambda g, y, mask, a, b: _select(mask, g, 0.0), lambda g, y, mask, a, b: _select(mask, 0.0, g)",
            "lambda g, y, mask, a, b: _select(mask, 0.0, g), lambda g, y, mask, a, b: _select(mask, g, 0.0)",
            f"{NUMBERS}::test_first_and_second_derivatives_are_those_of_finite_differences",
        ),
        (
            "what is not selected",
            "lambda mask, a, b: a if mask != 0 else b",
            "lambda mask, a, b: a if mask == 0 else b",
            f"{NUMBERS}::test_a_recorded_expression_is_the_expression_bitwise",
        ),
        (
            "a selection of negatives without its sign",
            'Mirror("select", negative=True)',
            'Mirror("select")',
            f"{NUMBERS}::test_a_recorded_expression_is_the_expression_bitwise",
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
        (
            "second derivatives from the wrong side of the diagonal",
            "second[min(p)][max(p) - min(p)]",
            "second[min(p)][min(p) - max(p)]",
            f"{CASADI}::test_second_derivatives_are_the_limits_of_differences[inverse dynamics]",
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
            'f"(T){{}}-({self.vector(index)})" if negative else self.vector(index)',
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
            f"{BACKENDS}::test_a_program_longer_than_a_function_may_be_is_right",
        ),
    ),
    *within(
        "torchdq/functions/posed.py",
        (
            "home added",
            "x - h for x, h",
            "x + h for x, h",
            f"{PROGRAMS}::test_torques_in_aligned_frames_equal_the_papers_recursion",
        ),
    ),
    *within(
        "torchdq/functions/formulas.py",
        (
            "a bias that helps",
            "f if b is None else f - b",
            "f if b is None else f + b",
            f"{GOLDEN}::test_two_link_accelerations_from_the_recorded_torques",
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
            "poses that are not unit normalised in silence",
            "if fault := not_unit(name, x.detach(), slack(value)):",
            'if fault := "":',
            f"{ROBOTS}::test_a_pose_that_is_not_unit_is_refused_not_normalised",
        ),
        (
            "xz and yy exchanged",
            "[0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]",
            "[0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]",
            f"{ROBOTS}::test_a_list_of_arrays_is_an_array",
        ),
        (
            "inertias in the order of the file",
            "[0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]",
            "[0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]",
            f"{URDF}::test_a_fixed_link_adds_its_inertia_by_the_parallel_axis_theorem",
        ),
        (
            "second moments for moments of inertia",
            "return torch.diag_embed(half.unsqueeze(-1).expand(*half.shape, 3)) - I",
            "return I",
            f"{PARAMETERS}::test_free_numbers_come_back",
        ),
    ),
    *within(
        "torchdq/robot/urdf/read.py",
        (
            "slides that turn",
            "(*ZERO, *joint.axis)",
            "(*joint.axis, *ZERO)",
            f"{URDF}::test_a_prismatic_joint_lifts_its_weight",
        ),
        (
            "damping for friction",
            "friction=double([joint.friction",
            "friction=double([joint.damping",
            f"{URDF}::test_damping_and_friction_are_read",
        ),
    ),
    *within(
        "torchdq/robot/urdf/tree.py",
        (
            "an inertial frame placed from the wrong side",
            "dual_quaternion.mul(X, pose(inertial.origin))",
            "dual_quaternion.mul(pose(inertial.origin), X)",
            f"{URDF}::test_a_body_described_on_a_fixed_link_is_the_body_on_its_carrier",
        ),
        (
            "an inertia turned the other way",
            "(inertial.mass, quat.ZERO, inertial.inertia)",
            "(inertial.mass, quat.ZERO, moved(dual_quaternion.conj(X), (0.0, quat.ZERO, inertial.inertia))[2])",
            f"{URDF}::test_a_body_described_on_a_fixed_link_is_the_body_on_its_carrier",
        ),
        (
            "roll, pitch and yaw about the moving axes",
            "r = quat.mul(_turn(axis, angle), r)",
            "r = quat.mul(r, _turn(axis, angle))",
            "urdf_tree.py::test_links_and_joints_are_placed_as_by_pinocchio",
        ),
        (
            "joints in the order of the file",
            "for name in sorted(document.joints, reverse=True):",
            "for name in reversed(document.joints):",
            "urdf_tree.py::test_links_and_joints_are_placed_as_by_pinocchio",
        ),
        (
            "a locked joint at zero",
            "_motion(joint, locked[name])",
            "_motion(joint, 0.0)",
            f"{URDF}::test_a_locked_joint_is_a_fixed_joint_at_that_position",
        ),
    ),
    *within(
        "torchdq/robot/urdf/elements.py",
        (
            "a default axis along z",
            "else (1.0, 0.0, 0.0)\n    length",
            "else (0.0, 0.0, 1.0)\n    length",
            f"{URDF}::test_an_axis_that_is_not_given_is_x",
        ),
    ),
    *within(
        "torchdq/robot/urdf/elements.py",
        (
            "a number read to its end before it is refused",
            "text.split(None, count + 1)[: count + 1]",
            "text.split()",
            f"{URDF}::test_millions_of_numbers_in_place_of_one_take_no_time_to_refuse",
        ),
        (
            "negative damping read",
            "elif not signed and min(values) < 0:",
            "elif False:",
            f"{URDF}::test_what_only_resists_is_not_negative",
        ),
    ),
    *within(
        "torchdq/robot/urdf/mimic.py",
        (
            "offsets of drivers forgotten",
            "multiplier * driver.offset + offset",
            "offset",
            "urdf_mimic.py::test_displacements_are_the_map_of_the_coordinates",
        ),
        (
            "homes of followers at their offsets",
            "tuple(0.0 - follows.offset for follows in rows)",
            "tuple(follows.offset for follows in rows)",
            "urdf_mimic.py::test_displacements_are_the_map_of_the_coordinates",
        ),
        (
            "damping of followers times their factor",
            "factor * factor * joint.damping",
            "abs(factor) * joint.damping",
            "urdf_mimic.py::test_friction_of_followers_is_that_of_the_coordinate",
        ),
        (
            "limits that leave no room",
            "if _room(own.limits) and not _room(limits):",
            "if False:",
            "urdf_mimic.py::test_limits_of_a_coordinate_keep_its_followers_within_theirs",
        ),
    ),
    *within(
        "torchdq/robot/urdf/read.py",
        (
            "the body of a free base not judged",
            "if inertial and (free or name in moving)",
            "if inertial and name in moving",
            "urdf_mimic.py::test_a_free_base_has_its_body",
        ),
        (
            "a free base without mass",
            "if free and not any((base_mass, *base_inertia)):",
            "if False:",
            "urdf_mimic.py::test_a_free_base_without_mass_is_told",
        ),
        (
            "inertia without mass is a fault",
            "[fault for fault in found if not isinstance(fault, consistency.Massless)]",
            "found",
            "urdf_tolerance.py::test_leftover_inertia_of_a_massless_link_counts_and_is_told",
        ),
    ),
    *within(
        "torchdq/robot/urdf/document.py",
        (
            "unreadable bodies of a free base excused",
            "set() if free or beyond else",
            "set() if beyond else",
            "urdf_tolerance.py::test_an_inertial_of_a_link_that_never_moves_may_be_unreadable",
        ),
        (
            "a second base with a body left out",
            "if link in children or _massive(links[link])",
            "if link in children",
            "urdf_tolerance.py::test_a_second_base_with_a_body_or_a_joint_is_refused",
        ),
    ),
    *within(
        "torchdq/robot/urdf/planar.py",
        (
            "slides that are not in the plane",
            "(b, s + y * y * a, -y)",
            "(b, s + y * y * a, y)",
            "urdf_tolerance.py::test_a_planar_joint_is_two_slides_and_a_turn",
        ),
    ),
    *within(
        "torchdq/robot/urdf/xml.py",
        (
            "xacro read as a description",
            'element.tag.startswith("xacro:")',
            "False",
            f"{URDF}::test_unexpanded_xacro_is_refused_with_the_command_that_expands_it",
        ),
    ),
    *within(
        "torchdq/robot/mjcf/links.py",
        (
            "the second joint of a body carried by the parent of the first",
            "link, X = len(links) - 1, dual_quaternion.ONE",
            "X = dual_quaternion.ONE",
            f"{MJCF}::test_dynamics_agree_with_mujoco",
        ),
        (
            "a locked joint of MJCF at home",
            "joint.displaced(moves[joint.row].offset)",
            "joint.displaced(0.0)",
            f"{MJCF}::test_a_locked_joint_stands_where_it_is_put",
        ),
    ),
    *within(
        "torchdq/robot/mjcf/joints.py",
        (
            "the hinge through the origin of its body",
            "(axis, quat.cross(point, axis)) if",
            "(axis, quat.ZERO) if",
            f"{MJCF}::test_dynamics_agree_with_mujoco",
        ),
        (
            "the rotor before its gear",
            "gear * gear * float(numbers[k])",
            "gear * float(numbers[k])",
            f"{MJCF}::test_dynamics_agree_with_mujoco",
        ),
    ),
    *within(
        "torchdq/robot/edit/couplings.py",
        (
            "the offset of a coupling forgotten",
            "factor * b.offset + offset - a.offset",
            "factor * b.offset - a.offset",
            f"{MJCF}::test_linear_couplings_of_joints_are_a_map_of_coordinates",
        ),
        (
            "couplings that contradict each other",
            "elif abs(rest) > SLACK:",
            "elif False:",
            f"{MJCF}::test_couplings_that_contradict_each_other_are_refused",
        ),
    ),
    *within(
        "torchdq/robot/edit/lumps.py",
        (
            "the centre of mass of the whole left to its part",
            "com = quat.add(whole[1], quat.scale(part[0] / mass, quat.sub(whole[1], part[1])))",
            "com = whole[1]",
            f"{WRITERS}::test_a_urdf_robot_is_read_back_as_it_was_written",
        ),
        (
            "no parallel axes for fixed links",
            "return merged(a, b, _share(b[0], a[0] + b[0]))",
            "return (*merged(a, b, _share(b[0], a[0] + b[0]))[:2], quat.add(a[2], b[2]))",
            f"{URDF}::test_a_fixed_link_adds_its_inertia_by_the_parallel_axis_theorem",
        ),
        (
            "gradients of a division by no mass",
            "part / torch.where(whole == 0, 1.0, whole)",
            "part / whole",
            "reduced.py::test_links_without_mass_have_gradients",
        ),
    ),
    *within(
        "torchdq/robot/edit/changed.py",
        (
            "links on fixed joints counted twice",
            "left = new if alone else without(new, carried)",
            "left = new",
            f"{WRITERS}::test_a_link_takes_on_what_changed_of_the_links_fixed_to_it",
        ),
    ),
    *within(
        "torchdq/robot/urdf/writer.py",
        (
            "an inertia in the axes of the link, not of its origin",
            "turned = new[2] if r == quat.ONE else",
            "turned = new[2] if True else",
            f"{WRITERS}::test_all_numbers_are_written_where_some_are_missing",
        ),
    ),
    *within(
        "torchdq/robot/edit/changed.py",
        (
            "a robot that was cut written into the file",
            "if name not in (*WRITTEN, *BESIDE) and not _equal(own, theirs[name]):",
            "if False:",
            f"{WRITERS}::test_a_robot_that_has_no_place_in_the_file_is_refused",
        ),
        (
            "a robot that reads back with other numbers",
            "if a is None or _close(a.detach(), b.to(a)):",
            "if True:",
            f"{WRITERS}::test_numbers_that_others_overrule_are_refused",
        ),
    ),
    *within(
        "torchdq/robot/urdf/xacro.py",
        (
            "arguments that the file does not have",
            "if name not in given.asked:",
            "if False:",
            "xacro.py::test_arguments_are_those_of_the_file",
        ),
        (
            "packages remembered for the next file",
            "        packages.get_path = before\n",
            "        pass\n",
            "xacro.py::test_packages_are_searched_where_they_are_said_to_be",
        ),
    ),
    *within(
        "torchdq/robot/edit/locking.py",
        (
            "locks beyond the limits only noted",
            "{name: limits[name] for name in asked}",
            "{}",
            "reduced.py::test_a_lock_beyond_the_limits_of_a_loaded_robot_is_told",
        ),
        (
            "a robot without joints when all are locked",
            "if movable and set(movable) <= set(locked):",
            "if False:",
            (f"{URDF}::test_locking_every_joint_is_refused", "reduced.py::test_locking_every_joint_is_refused"),
        ),
        (
            "no joint to keep",
            "if movable and not found:",
            "if False:",
            f"{URDF}::test_joints_to_keep_are_one_at_least",
        ),
    ),
    *within(
        "torchdq/robot/urdf/lock.py",
        (
            "the offset of a follower forgotten",
            "mimic.multiplier * at[driver] + mimic.offset",
            "mimic.multiplier * at[driver]",
            f"{URDF}::test_the_followers_of_a_locked_joint_are_locked_where_the_file_puts_them",
        ),
    ),
    *within(
        "torchdq/robot/edit/reduced.py",
        (
            "a joint locked from zero, not from home",
            "placed[i] if robot.home is None else placed[i] - robot.home[i]",
            "placed[i]",
            "reduced.py::test_a_locked_joint_is_one_that_stands_still",
        ),
        (
            "joints that follow a locked coordinate too, as if it were at zero",
            "if moved.any():",
            "if False:",
            f"{STANDS_STILL}[dense-False]",
        ),
        (
            "links fixed to a free base left out of it",
            "zip(BASE_BODY, whole(BASE), strict=True)",
            "zip(BASE_BODY, RigidBody.at(robot, BASE), strict=True)",
            f"{STANDS_STILL}[root-True]",
        ),
        (
            "a chain whose base moves with it",
            "        if ahead:",
            "        if False:",
            "reduced.py::test_a_chain_whose_coordinates_move_other_joints_is_refused",
        ),
    ),
    *within(
        "torchdq/export/c99.py",
        ("negated outputs with the sign of before", '- {self._at(index)}"', '+ {self._at(index)}"', EXPORT),
        (
            "sine and cosine exchanged in odd quadrants",
            "a = (q & 1) ? cr : sr, b = (q & 1) ? sr : cr",
            "a = (q & 1) ? sr : cr, b = (q & 1) ? cr : sr",
            "export.py::test_own_sine_and_cosine_are_within_an_ulp_and_undefined_far_away",
        ),
        (
            "a status that is always good",
            "({' && '.join(good)}) ? 0 : 1",
            "({' && '.join(good)}) ? 0 : 0",
            "export.py::test_a_mass_matrix_that_is_not_positive_is_told_by_the_status",
        ),
        (
            "a status that is good whatever the results are",
            '[f"{x} == {x}" for x in (angles, wrong) if x]',
            "[]",
            "export.py::test_own_sine_and_cosine_are_within_an_ulp_and_undefined_far_away",
        ),
        (
            "own sines in another order of sums with gcc",
            " || defined(__ASSOCIATIVE_MATH__)",
            "",
            EXPORT_FLAGS,
        ),
        (
            "own sines in another order of sums with clang",
            "reassociate(off)",
            "reassociate(on)",
            EXPORT_FLAGS,
        ),
        ("own sine and cosine in wider numbers", "FLT_EVAL_METHOD != 0", "FLT_EVAL_METHOD < 0", EXPORT_FLAGS),
    ),
    *within(
        "torchdq/export/roots.py",
        (
            "own roots without the last step",
            "2 * upper.number * lower) - lower * lower",
            "2 * upper.number * lower)",
            "export.py::test_own_roots_are_within_an_ulp_and_correctly_rounded_but_close_to_midpoints",
        ),
        (
            "own roots of subnormal numbers without scaling",
            "x * (tiny ? (S)0x1p+{scale} :",
            "x * (tiny ? 1 :",
            "export.py::test_own_roots_are_within_an_ulp_and_correctly_rounded_but_close_to_midpoints",
        ),
    ),
    *within(
        "torchdq/export/names.py",
        (
            "exported names of the standard library",
            "if name in _LIBRARY_NAMES:",
            "if name in ():",
            "export.py::test_names_that_the_exported_files_use_are_refused",
        ),
    ),
    *within(
        "torchdq/export/files.py",
        (
            "spans of a batch that are one row too short",
            "/ {a.size} < samples",
            "/ {a.size} + 1 < samples",
            "export.py::test_spans_of_a_batch_that_are_too_short_are_refused",
        ),
    ),
    *within(
        "torchdq/functions/arrays.py",
        (
            "read-only arrays as memory of results",
            "if not x.flags.writeable:",
            "if False:",
            "compiled_calls.py::test_arrays_that_torch_cannot_share_are_read_and_never_written_to",
            True,
        ),
    ),
    *within(
        "torchdq/export/casadi.py",
        (
            "matrices of CasADi row by row",
            "for j in range(columns) for i in range(rows)",
            "for i in range(rows) for j in range(columns)",
            f"{CASADI}::test_values_are_those_of_the_program_in_the_shape_of_the_function",
        ),
        (
            "Jacobians of CasADi argument by argument",
            "derived.results[read.index(j) * len(function.outputs) + i]",
            "derived.results[i * len(read) + read.index(j)]",
            f"{CASADI}::test_jacobians_are_the_limits_of_differences",
        ),
        (
            "Jacobians of CasADi with places that are always zero",
            "if v != 0.0]",
            "]",
            f"{CASADI}::test_jacobians_store_the_places_that_are_not_always_zero",
        ),
        (
            "a short work array in CasADi",
            "room = max(knots, 1) * (max(len(r.values)",
            "room = max(knots, 1) * (min(len(r.values)",
            f"{CASADI}::test_missing_arguments_are_zero_and_missing_results_are_left_out",
        ),
        (
            "blocks of Jacobians of CasADi in the rows of the first knot",
            "* rows + k * self.rows + i for k",
            "* rows + i for k",
            f"{CASADI}::test_functions_of_all_knots_are_maps[inverse dynamics]",
        ),
        (
            "a growth of errors in CasADi where results that are not wanted are written",
            '[f"w + {knots * widest}"]',
            '["w"]',
            f"{CASADI}::test_a_failure_is_told_whatever_is_wanted",
        ),
    ),
    *within(
        "torchdq/export/batch.py",
        (
            "exported batches whose last block reads on",
            "rows[(i < here ? i : here - 1) * width + j]",
            "rows[i * width + j]",
            "export.py::test_nothing_is_read_or_written_out_of_bounds[closed form]",
        ),
        (
            "exported sums that count the idle lanes",
            "for (i = 0; i < here; i++) sums",
            "for (i = 0; i < LANES; i++) sums",
            f"{EXPORT_BATCH}[gradient in parameters-float64-gcc]",
        ),
        (
            "exported batches whose block forgets its rows",
            "local = {a.name: a.lanes for a in (*several, *given)}",
            "local = {a.name: a.lanes for a in (*several, *(a for a in given if not a.shared))}",
            f"{EXPORT_BATCH}[gradient in parameters-float64-gcc]",
        ),
    ),
    *within(
        "torchdq/backends/one_sample.py",
        (
            "one sample whose errors grow as they like",
            "return found if growth.value <= self.limit else None",
            "return found",
            f"{CALLS}::test_rows_whose_errors_grow_too_much_are_recomputed_into_the_given_memory",
        ),
        (
            "one sample without a look at transforms",
            'not in ("auto", "c") or transforming()',
            'not in ("auto", "c")',
            f"{CALLS}::test_one_sample_takes_no_detour_unless_torch_or_the_user_asks_for_one",
        ),
        (
            "one sample into memory that is read",
            "if -ends[i] < pointers[i] - begin < size:",
            "if False:",
            f"{CALLS}::test_memory_that_cannot_be_written_to_is_refused_with_the_reason",
        ),
    ),
    *within(
        "torchdq/backends/memory.py",
        (
            "given memory that overlaps from behind",
            "return x.data_ptr() < _end(y) and y.data_ptr() < _end(x)",
            "return x.data_ptr() == y.data_ptr()",
            f"{CALLS}::test_memory_that_cannot_be_written_to_is_refused_with_the_reason",
        ),
    ),
    *within(
        "torchdq/effects/resistance.py",
        (
            "friction of layers that pushes",
            "result.append(D * qd[i] + f)",
            "result.append(f - D * qd[i])",
            "parameters.py::test_friction_is_its_formula",
        ),
        (
            "loads of layers with the friction of all of the torque",
            "free - g * load_size(free, g, v) * v",
            "free - g * absolute(free) * v",
            "friction_effects.py::test_inverse_and_forward_dynamics_of_a_layer_agree",
        ),
        (
            "memory along a log that forgets its bend",
            "memory.append(kept * memory[-1] + added)",
            "memory.append(added)",
            "friction_effects.py::test_bristles_along_a_log_are_those_of_the_simulation",
        ),
    ),
    *within(
        "torchdq/layers/layer_program.py",
        (
            "programs of forward dynamics whose friction drives",
            "[tau - t for tau",
            "[tau + t for tau",
            "layer_programs.py::test_the_program_of_a_layer_computes_what_the_layer_does[forward-constants]",
        ),
        (
            "programs of layers without offsets",
            "tau + (t + c) for tau",
            "tau + t for tau",
            "layer_programs.py::test_the_program_of_a_layer_computes_what_the_layer_does[inverse-constants]",
        ),
    ),
    *within(
        "torchdq/robot/edit/bodies.py",
        (
            "the inertia of a locked link not turned",
            "lumps.moved((x[:4], x[4:]), _numbers(other))",
            "(*lumps.moved((x[:4], x[4:]), _numbers(other))[:2], other.inertia.unbind(-1))",
            "reduced.py::test_locking_a_loaded_robot_is_locking_its_file",
        ),
    ),
    *within(
        "torchdq/robot/edit/coupled.py",
        (
            "limits of coordinates in another order",
            "return Limits(*found.values())",
            "return Limits(*reversed(found.values()))",
            f"{MAPS}::test_a_joint_of_several_coordinates_has_nothing_to_give",
        ),
        (
            "damping by the ratio, not by its square",
            'alone.abs() if name == "friction" else alone.square()',
            "alone.abs()",
            f"{MAPS}::test_coordinates_inherit_from_the_joints_that_follow_them",
        ),
        (
            "limits of a joint that runs backwards the wrong way round",
            "low, high = ends if s > 0 else ends[::-1]",
            "low, high = ends",
            f"{MAPS}::test_coordinates_inherit_from_the_joints_that_follow_them",
        ),
        (
            "damping of a joint of several coordinates lost in silence",
            "        if bool(there[..., robot.joint_index(name)].any()):",
            "        if False:",
            f"{MAPS}::test_a_joint_of_several_coordinates_has_nothing_to_give",
        ),
        (
            "a map of a map in the place of both",
            "JointMap(robot.every_joint, (before @ factors)",
            "JointMap(robot.every_joint, factors",
            f"{MAPS}::test_coordinates_of_coordinates_are_coordinates",
        ),
    ),
    *within(
        "torchdq/robot/edit/combined.py",
        (
            "a palm without mass attached in silence",
            "if not other.floating and (at.link != BASE or robot.floating):",
            "if False:",
            "combined.py::test_a_palm_whose_mass_is_missing_is_warned_of",
        ),
        (
            "a payload at the origin of its link",
            "whole = lumped(RigidBody.at(robot, link), [(X_BF, held)])",
            "whole = lumped(RigidBody.at(robot, link), [(torch.eye(1, 8).to(X_BF)[0], held)])",
            f"{COMBINED}::test_a_payload_is_pinocchios_body",
        ),
        (
            "an attached robot on the link, not on the frame",
            "        dq.mul(X, x) if p == BASE else x for x, p in",
            "        x for x, p in",
            f"{COMBINED}::test_an_attached_robot_is_pinocchios_joined_model",
        ),
        (
            "the free base of an attached robot left out",
            "        carrier |= changed",
            "        pass",
            f"{COMBINED}::test_the_free_base_of_an_attached_robot_becomes_part_of_its_carrier",
        ),
        (
            "two joints of one name",
            "        if both:",
            "        if False:",
            f"{COMBINED}::test_names_of_both_robots_differ",
        ),
    ),
    *within(
        "torchdq/robot/from_dh.py",
        (
            "angles in degrees believed",
            "if abs(angle) > TURN:",
            "if abs(angle) > 1e6 * TURN:",
            "robots.py::test_a_column_that_does_not_fit_is_named",
        ),
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
        "torchdq/functions/mdh.py",
        (
            "one sign of an Euler angle",
            "gamma - math.copysign(math.pi, gamma), -alpha",
            "gamma - math.copysign(math.pi, gamma), alpha",
            f"{PROGRAMS}::test_aligned_frames_put_the_links_where_they_are_and_the_axes_along_z",
        ),
        (
            "a common normal that is not perpendicular",
            "x = _across(x, z)",
            "x = _unit(x)",
            f"{PROGRAMS}::test_axes_that_are_nearly_one_line_lose_no_accuracy",
        ),
        (
            "an origin in the wrong axes",
            "clean(R), clean(origin, size)",
            "clean(R), clean(R @ origin, size)",
            f"{PROGRAMS}::test_aligned_frames_put_the_links_where_they_are_and_the_axes_along_z",
        ),
        (
            "a size that counts the distance of the robot from its base",
            "        if link.parent:\n",
            "        if link.parent >= 0:\n",
            "tests/claims/test_far_from_the_base.py::test_far_robots_move_as_near_ones",
        ),
        (
            "a shift along the axis the other way",
            "shift = -float(across) / s",
            "shift = float(across) / s",
            f"{PROGRAMS}::test_inverse_dynamics_of_a_general_chain_takes_84n_multiplications_and_70n_additions",
        ),
        (
            "a shift along the axis not taken off the position",
            "rest = p - shift *",
            "rest = p + 0.0 *",
            f"{PROGRAMS}::test_aligned_frames_put_the_links_where_they_are_and_the_axes_along_z",
        ),
        (
            "screws in the base frame carried from it",
            "screw.ad(screw.columns(X_WB), joint.screw)",
            "screw.ad(screw.inverse(screw.columns(X_WB)), joint.screw)",
            FROM_BASE,
        ),
    ),
    *within(
        "torchdq/dynamics/conditioning.py",
        (
            "negative entries over negative pivots are well",
            "reduce(minimum, inverses)",
            "reduce(minimum, factors)",
            f"{GROWTH}::test_a_mass_matrix_that_is_negative_has_no_accelerations",
        ),
    ),
    *within(
        "torchdq/robot/check/changes.py",
        (
            "units of replaced numbers undoubted",
            "if faults or not {*MEASURED} & {*changes}",
            "if True or not {*MEASURED} & {*changes}",
            "units.py::test_replaced_numbers_in_other_units_are_named_once",
        ),
        (
            "stacks of several dtypes",
            "(mine.dtype, mine.device) != (x.dtype, x.device)",
            "mine.device != x.device",
            f"{ROBOTS}::test_what_keeps_robots_from_one_stack_is_named",
        ),
    ),
    *within(
        "torchdq/robot/robot.py",
        (
            "changes of constants in place unseen",
            "if x._version or any_requires_grad(*robot._watched)",
            "if any_requires_grad(*robot._watched)",
            f"{ROBOTS}::test_a_constant_that_was_changed_in_place_is_told_at_the_next_use",
        ),
        (
            "constants that require grad unseen",
            "if x._version or any_requires_grad(*robot._watched)",
            "if x._version",
            f"{ROBOTS}::test_a_constant_that_requires_grad_is_told_at_the_next_use",
        ),
        (
            "a replaced tensor watched with the constants",
            "if any(hold(self._storages, x) for x in changes.values())",
            "if False",
            f"{ROBOTS}::test_a_replaced_tensor_may_be_changed_in_place",
        ),
    ),
    *within(
        "torchdq/robot/fields.py",
        (
            "screws of any kind of joint",
            "(pitch.abs() <= near * (1 + size))",
            "(pitch.abs() <= torch.inf)",
            f"{ROBOTS}::test_replace_checks_values_as_a_file_is_checked",
        ),
        (
            "learned values read",
            "and (everything or not x.requires_grad)",
            "",
            f"{ROBOTS}::test_learned_and_transformed_values_are_not_read",
        ),
    ),
    *within(
        "torchdq/robot/check/consistency.py",
        (
            "no triangle inequality",
            "moments[..., 2] > moments[..., 0] + moments[..., 1] + slack",
            "moments[..., 2] > 2 * (moments[..., 0] + moments[..., 1]) + slack",
            f"{URDF}::test_an_inertia_that_only_breaks_the_triangle_inequality_is_read_with_a_warning",
        ),
        (
            "rods and plates cannot exist",
            "moments[..., 0] + moments[..., 1] + slack",
            "moments[..., 0] + moments[..., 1] - slack",
            f"{URDF}::test_numbers_printed_with_six_digits_are_believed",
        ),
        (
            "moments of inertia repaired in place of second moments",
            "E = inertia[i].trace() / 2 * one - inertia[i]",
            "E = inertia[i]",
            "urdf_tolerance.py::test_a_repaired_inertia_is_the_nearest_that_a_body_has",
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
        "torchdq/dynamics/tracking.py",
        ("75: positions in the place of velocities", "kd * (qd_des - qd)", "kd * (qd_des - q)", ours("75")),
        (
            "the velocity gain on positions",
            "+ kp * (q_des - q)",
            "+ kd * (q_des - q)",
            f"{CONTROL}::test_the_robot_accelerates_as_commanded",
        ),
    ),
    *within(
        "torchdq/functions/formulas.py",
        (
            "73: the wrench left out of the feed-forward",
            'at.torques(given["qd"], a, x.exerted(at))',
            'at.torques(given["qd"], a, None)',
            ours("75"),
        ),
    ),
    *within(
        "torchdq/base/checks.py",
        (
            "devices in torch's own words",
            "torch.empty(0, device=device)",
            "pass",
            "envs.py::test_wrong_arguments_are_refused",
        ),
    ),
    *within(
        "torchdq/functional.py",
        (
            "many programs of single frames in silence",
            "number > FEW and seconds > FIRST",
            "False",
            "notice.py::test_frames_one_by_one_are_told_once_when_their_programs_took_long",
        ),
        (
            "seconds of calls that build nothing",
            "if recordings() != before:",
            "if True:",
            "notice.py::test_quick_programs_and_programs_that_are_there_are_no_reason_to_warn",
        ),
    ),
    *within(
        "torchdq/robot/check/units.py",
        (
            "payloads in mm believed",
            "found = [*_of_bodies(bodies, mass, com, inertia, _length(robot), False)]",
            "found: list[str] = []",
            "combined.py::test_a_payload_in_other_units_is_named_once",
        ),
        (
            "robots of hundreds of metres believed",
            "LONG = 50.0",
            "LONG = 5e9",
            "units.py::test_a_table_of_lengths_in_mm_is_named",
        ),
        (
            "limits in degrees believed",
            "TURNS[0] < abs(x) <= TURNS[1]",
            "abs(x) < 0",
            "units.py::test_limits_in_degrees_are_doubted",
        ),
        (
            "centres of mass in mm believed",
            "far > max(FAR * length, slender * radius)",
            "far > 1e9",
            "units.py::test_a_body_in_other_units_is_named_when_loaded_and_when_checked",
        ),
        (
            "inertias in kg mm^2 believed",
            "length > 0 and radius > large * reach",
            "False",
            "units.py::test_a_body_in_other_units_is_named_when_loaded_and_when_checked",
        ),
        (
            "inertias in g m^2 believed",
            "together > HEAVY * length > 0",
            "False",
            "units.py::test_inertias_a_thousand_times_too_large_are_doubted",
        ),
        (
            "lengths of joints forgotten",
            "ways[parent] + steps[i]",
            "steps[i]",
            "units.py::test_a_body_in_other_units_is_named_when_loaded_and_when_checked",
        ),
    ),
    *within(
        "torchdq/nn.py",
        (
            "described friction left to a model that has none",
            "model if isinstance(model, DQRNEA) else None",
            "None",
            f"{CONTROL}::test_a_model_that_learned_no_friction_is_compensated_as_its_robot",
        ),
        (
            "described friction on top of the learned one",
            "rigid is not None and not rigid._friction.effects",
            "rigid is not None",
            f"{CONTROL}::test_a_model_that_learned_no_friction_is_compensated_as_its_robot",
        ),
    ),
    *within(
        "torchdq/layers/robot_module.py",
        (
            "TorchScript that says nothing",
            "def __prepare_scriptable__(self)",
            "def _prepare_scriptable_(self)",
            f"{PARAMETERS}::test_a_layer_says_what_takes_the_place_of_torchscript",
        ),
    ),
    *within(
        "torchdq/layers/parametrizations.py",
        (
            "negative values become tiny ones",
            "if bool((value < 0).any())",
            "if False",
            f"{PARAMETERS}::test_negative_values_are_refused",
        ),
        (
            "a product of inertia with the other sign",
            "(0, 0, 0, 0, 0, 0, -1, 0, 0, 0)",
            "(0, 0, 0, 0, 0, 0, 1, 0, 0, 0)",
            f"{PARAMETERS}::test_any_free_numbers_are_a_body_that_exists",
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
    *within(
        "examples/recordings.py",
        (
            "a data set by its columns alone",
            "if fnmatch(path.name, layout.files)]",
            "if layout.files]",
            f"{LOGS}::test_a_log_of_any_seven_joints_is_no_data_set",
        ),
    ),
    *within(
        "torchdq/learning/logs/layouts.py",
        (
            "a column named twice",
            "in counts.items() if count > 1",
            "in counts.items() if count > 9",
            "logs.py::test_names_of_columns_are_checked",
        ),
        (
            "columns that are read for two signals",
            "< max(3, len(self.blocks))",
            "< min(2, len(self.blocks))",
            "logs.py::test_names_of_columns_are_checked",
        ),
        (
            "patterns that skip a joint's number",
            "str(int(x) + i)",
            "str(int(x) + i + 1)",
            f"{LOGS}::test_columns_have_names_by_a_mapping",
        ),
        ("numbers as Python writes them", '"_" not in cell and ', "", MALFORMED),
    ),
    *within(
        "torchdq/learning/logs/headers.py",
        (
            "a column read twice",
            "readers.items() if count > 1",
            "readers.items() if count > 9",
            "logs.py::test_a_column_is_read_for_one_signal",
        ),
    ),
    *within(
        "torchdq/learning/logs/headers.py",
        (
            "half a log without a word of what it is good for",
            "(way := still_possible(lost, heads))",
            "(way := None)",
            "partial_logs.py::test_half_a_log_says_which_model_is_still_possible",
        ),
        (
            "joints left out because their positions are missing",
            'if signal != "time" and more in counts:',
            "if False:",
            "partial_logs.py::test_a_column_that_is_missing_among_others_is_a_mistake_and_no_choice",
        ),
    ),
    *within(
        "torchdq/learning/logs/transmissions.py",
        (
            "torques of coupled motors by the matrix of their velocities",
            "x @ np.linalg.inv(S)",
            "x @ np.linalg.inv(S).T",
            "partial_logs.py::test_motors_are_taken_to_the_joints",
        ),
        (
            "positions of coupled motors exchanged",
            "x @ S.T",
            "x @ S",
            "partial_logs.py::test_motors_are_taken_to_the_joints",
        ),
    ),
    *within(
        "torchdq/learning/logs/checks.py",
        (
            "jumps explained by themselves",
            "np.maximum(rate[:-4], rate[4:])",
            "rate[2:-2]",
            "partial_logs.py::test_positions_that_jump_are_told_without_velocities",
        ),
    ),
    *within(
        "torchdq/learning/logs/filters.py",
        (
            "aliases",
            "PASSED = 0.4",
            "PASSED = 0.9",
            "filters.py::test_fewer_rows_keep_what_is_slow_and_nothing_of_what_is_fast",
        ),
        (
            "noise that grows between stamps that nearly agree",
            "PchipInterpolator",
            "CubicSpline",
            "filters.py::test_noise_at_stamps_that_nearly_agree_does_not_grow",
        ),
        ("derivatives of straight cubics", "k=5", "k=3", "filters.py::test_derivatives_of_sines"),
    ),
    *within(
        "torchdq/learning/logs/motions.py",
        (
            "currents taken for torques",
            "if not np.all(motion.known_gains):",
            "if False:",
            "partial_logs.py::test_efforts_of_unknown_gains_are_never_taken_for_torques",
        ),
        (
            "ends at rest left out",
            "if moves[at <= SETTLED / lowest].any() else 0.0",
            "",
            "filters.py::test_a_short_motion_between_rests_is_kept_whole",
        ),
        (
            "ends in motion kept",
            "reach if moves[at <= SETTLED / lowest].any() else 0.0",
            "0.0",
            "filters.py::test_ends_in_motion_are_left_out",
        ),
        (
            "a cutoff that the rate does not allow",
            "min(CUTOFF, 0.25 / step)",
            "CUTOFF",
            "filters.py::test_cutoffs_fit_the_rate_and_are_told",
        ),
    ),
    *within(
        "torchdq/learning/logs/tables.py",
        ("bombs unpacked", "if unpacked > (most", "if unpacked < 0 and unpacked > (most", MALFORMED),
    ),
    *within(
        "torchdq/learning/logs/texts.py",
        ("first lines without an end", "if len(head) > LONGEST:", "if False:", MALFORMED),
    ),
    *within(
        "torchdq/learning/training/checkpoint.py",
        ("checkpoints of infinite numbers", " and bool(x.isfinite().all())", "", UNTRUSTED),
        ("checkpoints of steps that never were", "_is_count(x) and 0 < x <= last", "_is_count(x)", UNTRUSTED),
        ("models with other weights", "x.keys() != model.keys()", "False", UNTRUSTED),
    ),
    *within(
        "torchdq/learning/training/run.py",
        (
            "an optimiser steered by a checkpoint",
            'self.optimiser.state_dict()["param_groups"]',
            'saved["optimiser"]["param_groups"]',
            f"{TRAINING}::test_settings_of_the_optimiser_are_those_of_the_call",
        ),
        (
            "a refused checkpoint that leaves its weights",
            "            self.model.load_state_dict(before)\n            raise",
            "            raise",
            UNTRUSTED,
        ),
    ),
    *within(
        "torchdq/learning/identification/identify.py",
        (
            "joints at rest that are said to be excited",
            " & torch.cat([inertial, *own])",
            "",
            f"{IDENTIFY}::test_joints_that_do_not_move_are_named",
        ),
        (
            "joints at rest without a word",
            "if v <= width]",
            "if v < 0]",
            f"{IDENTIFY}::test_joints_that_do_not_move_are_named",
        ),
        (
            "parameters excited by the prior",
            " & (left < 1 - EXCITED)",
            "",
            f"{IDENTIFY}::test_what_the_samples_decide_is_said_and_nothing_warned_when_all_joints_move",
        ),
    ),
    # --- scenes -------------------------------------------------------------------------------------------------------
    *within(
        "torchdq/effects/presliding.py",
        (
            "bristles that bend without end",
            "sliding = speed / (self.deflection * g)",
            "sliding = 0.5 * speed / (self.deflection * g)",
            "friction_effects.py::test_bristles_reach_the_stationary_deflection_at_any_stiffness",
        ),
        (
            "bristles that lose the start of a step",
            "one.level * (z - (h + T) * b * z)",
            "one.level * (z - T * b * z)",
            "friction_effects.py::test_bristles_reach_the_stationary_deflection_at_any_stiffness",
        ),
        (
            "constant damping of bristles",
            "one.settling / (1.0 + fast * fast)",
            "one.settling",
            "friction_effects.py::test_bristles_take_power_but_for_what_they_store",
        ),
    ),
    *within(
        "torchdq/effects/friction.py",
        (
            "levels of the other direction",
            "0.5 * (self.forward - self.backward)",
            "0.5 * (self.backward - self.forward)",
            "friction_effects.py::test_the_torque_of_a_joint_is_its_law",
        ),
        (
            "a ripple that is pushed to its peaks",
            "self.sine * c - self.cosine * s",
            "self.cosine * s - self.sine * c",
            "friction_effects.py::test_the_stiffness_of_a_ripple_is_its_slope_where_it_holds",
        ),
        (
            "temperature that counts twice",
            "factors = [maximum(1.0 + a * T, 0.0)",
            "factors = [maximum(1.0 + 2.0 * a * T, 0.0)",
            "friction_effects.py::test_coefficients_change_with_the_temperature",
        ),
        (
            "friction that pushes",
            "return Impedance(self.coefficient)",
            "return Impedance(-self.coefficient)",
            f"{EFFECTS}::test_an_effect_at_the_joints_adds_the_torques_of_its_formula",
        ),
        (
            "static friction of the speed's own sign",
            "1.0 + ratio * ratio",
            "1.0 + ratio",
            f"{EFFECTS}::test_an_effect_at_the_joints_adds_the_torques_of_its_formula",
        ),
    ),
    *within(
        "torchdq/effects/joint.py",
        (
            "load of the other direction",
            "absolute(torque) - m * torque",
            "absolute(torque) + m * torque",
            "friction_effects.py::test_a_simulated_motion_takes_the_torques_of_the_layer",
        ),
        (
            "stiffness that is not implicit",
            "z.damping_at_end(h) for z",
            "z.damping for z",
            f"{INTEGRATORS}::test_a_bounce_off_stiff_limits_gains_no_energy",
        ),
        (
            "springs about the other side",
            "spring(k, x - r) for",
            "spring(k, x + r) for",
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
        (
            "springs damped by the sum of the speeds",
            "+ d * (v[n + i] - v[i])",
            "+ d * (v[n + i] + v[i])",
            f"{EFFECTS}::test_elastic_joints_are_two_masses_with_a_spring_between",
        ),
        (
            "a transmission that pulls its joint with all of the step",
            "(s * b / a - s * J / a * v[i]) / h",
            "(s * b / a - s * J / a * v[i])",
            f"{EFFECTS}::test_the_implicit_integrator_takes_elastic_springs_at_the_end_of_the_step",
        ),
        (
            "rotors whose joints stand still over a step",
            "((b + s * e) / a - w) / h",
            "(b / a - w) / h",
            f"{EFFECTS}::test_the_implicit_integrator_takes_elastic_springs_at_the_end_of_the_step",
        ),
    ),
    *within(
        "torchdq/effects/actuator.py",
        (
            "a lag whose torque at the end of the step acts from its start",
            "mean.append(x + share * (before - x))",
            "mean.append(x + kept * (before - x))",
            f"{EFFECTS}::test_the_impulse_of_a_lag_is_exact_at_any_step",
        ),
        (
            "saturation on one side",
            "clip(x, -limit, limit)",
            "clip(x, -1e9 * limit, limit)",
            f"{EFFECTS}::test_saturation_is_exactly_its_limit_beyond_it",
        ),
        (
            "motors that gain torque with speed",
            "stall - maximum(lost, 0.0)",
            "stall + maximum(lost, 0.0)",
            f"{EFFECTS}::test_a_motor_loses_torque_with_speed",
        ),
        (
            "a lag of the inverse time",
            "exp(-(dt / T))",
            "exp(-(T / dt))",
            f"{EFFECTS}::test_a_lag_is_the_mean_of_the_exponential_of_its_time",
        ),
        ("rounded down", "x / step + 0.5", "x / step", f"{EFFECTS}::test_commands_are_rounded_to_steps"),
    ),
    *within(
        "torchdq/effects/body.py",
        (
            "pushes turned the wrong way",
            "bodies.posed.to_link(link, v) for v in",
            "bodies.posed.to_world(link, v) for v in",
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
            "payloads scaled with the links",
            "    LATE = True\n",
            "    LATE = False\n",
            f"{EFFECTS}::test_payloads_are_not_scaled_with_the_links_wherever_they_stand",
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
        "torchdq/scene/integrators.py",
        (
            "semi-implicit Euler, explicit",
            "return system.moved(x, h, v), v\n\n\n@dataclass(frozen=True)\nclass LinearlyImplicit",
            "return system.moved(x, h, v), _plus(v, -h, v)\n\n\n@dataclass(frozen=True)\nclass LinearlyImplicit",
            f"{INTEGRATORS}::test_the_error_falls_with_the_stated_order",
        ),
        (
            "a stage of Runge-Kutta from the wrong place",
            "a(system.moved(x, half, k2), v3)",
            "a(system.moved(x, half, v), v3)",
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
            "system.moved(system.moved(x, 0.5 * h, v1), 0.5 * h, v2)",
            "system.moved(x, h, v1)",
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
        "torchdq/scene/free_base.py",
        (
            "displacements of a free base that add up like vectors",
            "screw.add(screw.scale(0.5, once), more)",
            "screw.scale(0.0, once)",
            f"{FREE_BODIES}::test_momentum_and_energy_are_conserved_at_the_order_of_the_integrator",
        ),
        (
            "the series of rotations alone",
            "slope = dual * slope",
            "slope = 0.0 * slope",
            f"{FREE_BODIES}::test_the_rate_of_a_displacement_is_the_derivative_of_its_logarithm",
        ),
        (
            "a pose that keeps its rounding errors",
            "scale = 1.5 - 0.5 * quat.norm2(r)",
            "scale = 1.0",
            f"{FREE_BODIES}::test_poses_stay_unit_dual_quaternions",
        ),
    ),
    *within(
        "torchdq/functions/floating.py",
        (
            "a wrench on the base in the order of a twist",
            "[*row[3:BASE], *row[:3]]",
            "[*row[:BASE]]",
            f"{FLOATING}::test_inverse_dynamics",
        ),
        (
            "momentum about the origin of the base",
            "quat.sub(angular, quat.cross(c, linear))",
            "angular",
            f"{FLOATING}::test_centre_of_mass_and_momentum",
        ),
    ),
    *within(
        "torchdq/functions/recipe.py",
        (
            "no wrench on the base",
            "[None if f_base is None else as_screw(f_base)]",
            "[None]",
            f"{FLOATING}::test_inverse_dynamics_under_wrenches",
        ),
    ),
    *within(
        "torchdq/dq/components.py",
        (
            "quaternions of any length taken for rotations",
            "wrong = (r.detach().norm(dim=-1) - 1).abs() > _close(r)",
            "wrong = (r.detach().norm(dim=-1) - 1).abs() > 1e9",
            "convert_free.py::test_quaternions_that_are_not_unit_are_named",
        ),
        (
            "reflections taken for rotations",
            "* x[..., 2, :]).sum(-1) < 0",
            "* x[..., 2, :]).sum(-1) < -9",
            "misuse.py::test_what_is_no_pose_is_refused",
        ),
        (
            "matrices with the translation in the last row taken for poses",
            ".abs().amax(-1) > _close(row)",
            ".abs().amax(-1) > 1e9",
            "misuse.py::test_what_is_no_pose_is_refused",
        ),
    ),
    *within(
        "torchdq/convert/mujoco.py",
        (
            "an acceleration in world axes of a base that does not turn",
            "vd + cross(w, v)), wd, qdd)",
            "vd), wd, qdd)",
            f"{CONVERT_FREE}::test_mujoco_computes_our_forces_and_accelerations",
        ),
    ),
    *within(
        "torchdq/scene/system.py",
        (
            "a spring that sees the state at its beginning",
            "inertia]), self._net(at, forces.torques,",
            "inertia]), self._net(at, self._explicit(x, v).torques,",
            f"{EFFECTS}::test_the_implicit_integrator_takes_the_state_at_the_end_of_the_step",
        ),
        (
            "the Hamiltonian's gradient",
            "at.kinetic_energy(qd) - at.potential_energy()",
            "at.kinetic_energy(qd) + at.potential_energy()",
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
        "torchdq/scene/recording.py",
        (
            "motors that turn with the joints, behind springs",
            "actuator.driven(u, v[-n:]",
            "actuator.driven(u, v[:n]",
            f"{SCENE}::test_a_motor_behind_a_spring_runs_out_of_torque_at_its_own_speed",
        ),
        (
            "a state without what it remembers",
            "for name in spec.state:",
            "for name in ():",
            STEP_CHECKS,
        ),
        (
            "a step without what its effects ask for",
            "for effect in spec.effects for name in effect.needs(spec.robot.n)]",
            "for effect in () for name in effect.needs(spec.robot.n)]",
            STEP_CHECKS,
        ),
        (
            "a step without the reference of its controller",
            'needed += ["reference"] if',
            "needed += [] if",
            STEP_CHECKS,
        ),
        (
            "inputs that no scene has",
            "known = self.widths()\n        if name not in known:",
            "known = {name: self.spec.robot.n, **self.widths()}\n        if name not in known:",
            STEP_CHECKS,
        ),
        (
            "a column of numbers for the samples",
            "if column and batch and batch[-1] > 1:",
            "if False:",
            f"{SCENE}::test_a_column_of_numbers_for_the_samples_is_refused",
        ),
        (
            "every substep as long as the step",
            "spec.dt / spec.substeps",
            "spec.dt",
            f"{INTEGRATORS}::test_substeps_are_steps",
        ),
        (
            "every sensor with the first one's noise",
            "used += width",
            "used = used",
            f"{EFFECTS}::test_two_noises_of_a_reading_are_drawn_apart",
        ),
    ),
    *within(
        "envs/tasks.py",
        (
            "rows of a task of any width",
            "if len(row) != widths.get(name, len(row)):",
            "if False:",
            "envs.py::test_a_task_that_returns_other_rows_is_told_which",
        ),
        (
            "rows of a task in the place of the state's",
            "if name in RESERVED:",
            "if False:",
            "envs.py::test_a_task_that_returns_other_rows_is_told_which",
        ),
        (
            "programs that forget the attributes of their task's class",
            'object.__setattr__(self, "attributes", attributes_of(type(self.task)))',
            'object.__setattr__(self, "attributes", ())',
            "torch_task.py::test_a_class_attribute_that_changed_is_recorded_anew",
        ),
        (
            "a class that changes before it is recorded",
            "        if changed:\n",
            "        if False:\n",
            "torch_task.py::test_a_class_that_changes_before_the_first_reset_is_refused",
        ),
    ),
    *within(
        "envs/rng.py",
        (
            "seeds of any kind",
            "if not (whole and 0 <= int(x) <= most) and not (each and x is None):",
            "if False:",
            "envs.py::test_a_seed_that_is_none_is_refused_by_name",
        ),
    ),
    *within(
        "torchdq/robot/mjcf/notes.py",
        (
            "gravcomp warned of without gravity",
            "if falls and relieved and",
            "if relieved and",
            "mjcf.py::test_gravity_that_is_compensated_in_part_is_warned_of",
        ),
        (
            "armature of a free joint believed",
            "if m.dof_armature[(dof",
            "if not m.dof_armature[(dof",
            "mjcf.py::test_armature_of_a_free_joint_is_warned_of",
        ),
        (
            "springs only noted",
            'Unsimulated(f"{what}: {names}")',
            'str(f"{what}: {names}")',
            "scene.py::test_what_a_robot_has_no_field_for_is_listed",
        ),
    ),
    *within(
        "torchdq/robot/urdf/misspellings.py",
        (
            "misspelt attributes not told",
            "if meant or len(missing)",
            "if len(missing)",
            "urdf_tolerance.py::test_limits_that_are_misspelt_are_told_and_so_is_what_is_taken_instead",
        ),
        (
            "extensions told",
            "len(missing) == len(ATTRIBUTES[part.tag])",
            "True",
            "urdf_tolerance.py::test_attributes_beside_all_of_urdf_are_extensions_and_silent",
        ),
        (
            "elements given twice not told",
            "if count > 1",
            "if count > 2",
            "urdf_tolerance.py::test_elements_that_are_given_twice_are_told",
        ),
        (
            "misspelt tags only noted",
            '"tags that seem misspelt, not read", found, True)',
            '"tags that seem misspelt, not read", found, False)',
            "urdf_tolerance.py::test_a_slip_that_may_change_the_dynamics_is_one_warning",
        ),
        (
            "slips of fixed joints warned of",
            'element.tag == "joint" and element.get("type") == "fixed"',
            "False",
            "urdf_tolerance.py::test_what_changes_no_dynamics_is_no_warning",
        ),
        (
            "missing drivers only noted",
            '{reprlib.repr(driver)}{meant}", True)',
            '{reprlib.repr(driver)}{meant}", False)',
            "urdf_tolerance.py::test_robots_of_others_have_no_slips_but_one",
        ),
        (
            "placements in degrees believed",
            "abs(angle) > TURN",
            "abs(angle) > 1e9",
            "units.py::test_placements_in_degrees_are_doubted",
        ),
    ),
    *within(
        "torchdq/backends/compiler.py",
        (
            "compilers that outlive their process",
            "guards.append(subprocess.Popen([*GUARD, *groups]",
            'guards.append(subprocess.Popen(["/bin/cat"]',
            f"{BUILD}::test_a_compiler_ends_with_the_process_that_started_it",
        ),
    ),
    *within(
        "torchdq/control.py",
        (
            "complex gains cut",
            "x.dtype != torch.bool and not x.is_complex()",
            "True",
            "computed_torque.py::test_what_is_no_gain_is_refused_by_name_everywhere",
        ),
    ),
    *within(
        "torchdq/robot/mjcf/joints.py",
        (
            "disabled couplings used",
            "if linear and not off and",
            "if linear and",
            f"{MJCF}::test_couplings_that_a_flag_disables_are_noted_and_not_used",
        ),
    ),
    *within(
        "envs/arguments.py",
        (
            "memory of any effects restored",
            'f"{MEMORY} of {owners}" if name == MEMORY else name',
            "name",
            "envs.py::test_a_state_that_other_effects_remember_is_refused",
        ),
        (
            "saved states that are not finite",
            "else ~x.isfinite()",
            "else x.isnan() & ~x.isnan()",
            "envs.py::test_wrong_states_are_refused",
        ),
    ),
    *within(
        "envs/randomization.py",
        (
            "factors that may be negative",
            "span.lower > 0)",
            "True)",
            "env_random.py::test_wrong_ranges_are_refused",
        ),
        (
            "shifts that multiply",
            "base + value if self.shift else base * value",
            "base * value",
            "env_random.py::test_a_number_is_a_fraction_and_a_pair_is_a_range",
        ),
    ),
    *within(
        "envs/torch_task.py",
        (
            "decisions for all rows at once in torch's own words",
            'if "Boolean value of Tensor" not in str(error):',
            "if True:",
            "torch_task.py::test_a_function_that_decides_for_all_rows_at_once_is_told_of_where",
        ),
        (
            "unknown rows in the words of a dict",
            'Named("row in now.rows", rows)',
            "rows",
            "torch_task.py::test_an_unknown_row_is_refused_with_those_there_are",
        ),
        (
            "functions whose failures do not end an episode",
            'rows["valid"] * sound',
            'rows["valid"]',
            "torch_task.py::test_a_function_that_fails_ends_that_row_alone",
        ),
    ),
    *within(
        "torchdq/scene/controllers.py",
        (
            "75: positions in the place of velocities, in scenes",
            "commanded, q, qd, *desired",
            "commanded, q, q, *desired",
            f"{SCENE}::test_computed_torque_makes_any_arm_a_double_integrator",
        ),
        (
            "the model of a controller not copied",
            "return replace(self, model=recorded(constants(believed.bake())))",
            "return self",
            f"{SCENE}::test_a_model_is_copied_when_a_scene_is_made",
        ),
        (
            "the gradient of a controller's model dropped",
            "if getattr(believed, name).requires_grad:",
            "if False:",
            f"{SCENE}::test_a_model_that_requires_grad_is_refused",
        ),
    ),
    *within(
        "torchdq/recommend/reference.py",
        (
            "trajectories held however fast errors grow",
            "if growth > MOST_GROWTH:",
            "if False:",
            f"{RECOMMEND}::test_damping_lets_a_trajectory_be_held",
        ),
        (
            "references without end",
            "if not essential and not trial.allows(integrator, now.times, EXACT, SHARE):",
            "if False:",
            f"{RECOMMEND}::test_no_reference_in_time_is_an_error_that_asks_for_more",
        ),
    ),
    *within(
        "torchdq/recommend/search.py",
        (
            "one answer for every error",
            "trial.intervals, error)",
            "trial.intervals, 1.0)",
            f"{RECOMMEND}::test_an_answer_is_kept_until_the_caches_are_emptied",
        ),
        (
            "candidates tried after the time is up",
            "elif trial.allows(integrator, times, arithmetic):",
            "elif True:",
            f"{RECOMMEND}::test_a_short_time_gives_the_best_so_far_and_says_what_was_not_tried",
        ),
    ),
    *within(
        "torchdq/scene/describe.py",
        (
            "negative costs of effects",
            "return max(0.0, middle), (upper - lower) / 2",
            "return middle, (upper - lower) / 2",
            f"{SCENE}::test_costs_within_their_spread_are_bounds_and_none_is_negative",
        ),
        (
            "costs within their spread as if they were known",
            "if self.nanoseconds > self.spread:",
            "if True:",
            f"{SCENE}::test_costs_within_their_spread_are_bounds_and_none_is_negative",
        ),
        (
            "programs compiled after the time is up",
            "if start + longest >= end:",
            "if False:",
            f"{SCENE}::test_a_description_ends_in_time_and_says_what_it_did_not_measure",
        ),
    ),
    *within(
        "torchdq/effects/effect.py",
        (
            "tensors of parameters unchecked",
            "torch.stack(value.detach().aminmax()).tolist()",
            "[]",
            f"{EFFECTS}::test_a_parameter_that_is_a_tensor_is_checked_like_numbers",
        ),
    ),
    *within(
        "torchdq/scene/rollout.py",
        (
            "lost rows untold",
            'if lost == "warn" and read and bool(',
            'if lost == "never" and read and bool(',
            "stability.py::test_a_rollout_that_loses_rows_says_so",
        ),
        (
            "a start that is not finite untold",
            'if lost == "warn" and read and (unusable',
            'if lost == "never" and read and (unusable',
            "starts.py::test_rows_that_are_not_finite_at_the_start_are_named",
        ),
        (
            "a policy that remembers recomputed with another memory",
            "if changed or other:",
            "if changed:",
            "stability.py::test_a_policy_that_remembers_is_refused_where_it_is_called_again",
        ),
        (
            "a policy that counts called twice for every step",
            "if changed or other:",
            "if other:",
            "stability.py::test_a_policy_that_counts_is_refused_where_it_is_called_again",
        ),
    ),
    *within(
        "torchdq/scene/stability.py",
        (
            "damping left out of a frozen system",
            "self.K @ x.mT + D @ v.mT",
            "self.K @ x.mT",
            "stability.py::test_the_bound_of_damping_is_that_of_the_textbook",
        ),
    ),
    *within(
        "torchdq/scene/effect_order.py",
        (
            "effects that take nothing untold",
            "if not sources or",
            "if True or",
            f"{SCENE}::test_a_description_that_has_nothing_to_take_is_told_once",
        ),
    ),
    *within(
        "torchdq/scene/initial_state.py",
        (
            "starts below a limit untold",
            "torch.maximum(low - q, q - high)",
            "q - high",
            "starts.py::test_a_start_far_outside_the_limits_is_named_once",
        ),
    ),
    *within(
        "torchdq/learning/evaluation/diagnostics.py",
        (
            "dry friction of another shape untold",
            "after < SHAPED * before",
            "after < 0 * before",
            "friction_of_logs.py::test_dry_friction_of_filtered_torques_is_told_without_directions",
        ),
        (
            "torques of the opposite sign undoubted",
            "torch.where(flipped, -plain, plain)",
            "plain",
            "plausibility.py::test_a_fit_of_a_model_that_holds_a_robot_says_it_too",
        ),
        (
            "torques in another unit undoubted",
            "sure = (alone - left > SHARE)",
            "sure = (alone - left > 2)",
            "plausibility.py::test_torques_in_another_unit_are_named",
        ),
        (
            "torques in hundredths undoubted",
            "FACTOR = 45.0",
            "FACTOR = 450.0",
            "plausibility.py::test_torques_in_hundredths_are_named_with_all_joints_that_share_the_factor",
        ),
        (
            "torques without gravity undoubted",
            "left * size < WEIGHTLESS * weight",
            "left * size < 0 * weight",
            "plausibility.py::test_torques_without_gravity_are_named",
        ),
        (
            "dead torques undoubted",
            "<= STILL * tau",
            "< -STILL * tau",
            "plausibility.py::test_a_torque_that_never_changes_is_named",
        ),
    ),
    *within(
        "torchdq/learning/identification/feasible.py",
        (
            "the slope of the barrier below one reversed",
            "+ 2 * t / (1 - t * x) - 2",
            "- 2 * t / (1 - t * x) - 2",
            "ladder_of_models.py::test_slopes_of_the_distance_to_the_description_are_those_of_differences",
        ),
        (
            "friction by load without a bound",
            "self.fraction = (self.start * below_one)",
            "self.fraction = (0 * self.start * below_one)",
            "ladder_of_models.py::test_friction_by_load_stays_below_one",
        ),
    ),
    *within(
        "torchdq/learning/identification/terms.py",
        (
            "waves chosen where joints hardly move",
            "least >= WAVE**2 / 2",
            "least >= 0.0",
            "ladder_of_models.py::test_a_wave_is_told_from_a_quarter_of_its_period_on",
        ),
        (
            "sharp signs of velocity beside filtered torques",
            "if recording.direction is None else recording.direction",
            "if True else recording.direction",
            "friction_of_logs.py::test_friction_is_found_within_the_stated_errors",
        ),
        (
            "bristles that never slide",
            "step.sign() * (1 - keep)",
            "step / distance",
            "ladder_of_models.py::test_friction_of_each_shape_is_found_with_its_size",
        ),
    ),
    *within(
        "torchdq/learning/identification/simple.py",
        (
            "files with what other friction leaves of the simple one",
            "torch.where((own[others] != 0).any(0), nearest.T, known)",
            "known",
            "identified_files.py::test_the_friction_of_a_file_comes_nearest_to_all_friction_found",
        ),
        (
            "friction of files that is cut off at zero",
            "cost.argmin(0)",
            "2",
            "identified_files.py::test_no_friction_of_a_file_is_negative",
        ),
    ),
    *within(
        "torchdq/learning/evaluate.py",
        (
            "a verdict about what is in no file",
            "else (self.file,",
            "else (self.found,",
            "identified_files.py::test_a_verdict_is_not_good_where_one_joint_of_the_file_is_far_off",
        ),
    ),
    *within(
        "torchdq/base/files.py",
        (
            "parts of files that stay after a fault",
            "for part in beside.values():\n                part.unlink(missing_ok=True)",
            "pass",
            "files.py::test_a_file_is_whole_after_a_write_that_failed",
        ),
    ),
    *within(
        "torchdq/learning/identification/evidence.py",
        (
            "rows beside a block that is left out",
            "folds[k] -= sums[first",
            "folds[k] -= 0 * sums[first",
            "ladder_of_models.py::test_a_fold_holds_nothing_of_its_block",
        ),
    ),
    *within(
        "torchdq/learning/evaluation/blocks.py",
        (
            "gaps without times",
            "after = int((time[last : motion.stop] < time[last - 1] + ENDS).sum())",
            "after = 0",
            "ladder_of_models.py::test_blocks_are_whole_motions_or_parts_with_gaps",
        ),
    ),
    *within(
        "torchdq/learning/evaluation/correlation.py",
        (
            "correlation counted on one side",
            "1 + 2 * (correlation * clear)",
            "1 + (correlation * clear)",
            "ladder_of_models.py::test_correlation_times_are_those_of_the_process",
        ),
    ),
    *within(
        "torchdq/learning/identification/model_selection.py",
        (
            "the best rung instead of the simplest as good",
            "if float(off.mean()) <= float(off.std() / len(off) ** 0.5):",
            "if i == best:",
            "ladder_of_models.py::test_the_simplest_as_good_as_the_best_is_chosen",
        ),
    ),
    *within(
        "torchdq/learning/identification/shapes.py",
        (
            "residuals without the friction of the joint",
            "e[:, self.own] = -self.coefficients(y)",
            "e[:, self.own] = 0.0",
            "ladder_of_models.py::test_friction_of_each_shape_is_found_with_its_size",
        ),
    ),
    *within(
        "torchdq/learning/identification/lags.py",
        (
            "a lag of the opposite sign",
            "at = fit.rows.repeat(3) - all_late",
            "at = fit.rows.repeat(3) + all_late",
            "missing_terms.py::test_a_lag_of_the_torques_is_told_with_its_size_and_its_cure",
        ),
        (
            "a model that is not moved with the lag",
            "late = late + x",
            "late = x",
            "torque_lags.py::test_a_lag_of_many_rows_is_found_in_rows",
        ),
    ),
    *within(
        "torchdq/learning/identification/augmented.py",
        (
            "constant torques that the fit hides",
            "A, t = r, torch.cat([Z, E], -1), Z.shape[-1]",
            "A, t = r, torch.cat([0 * Z, E], -1), Z.shape[-1]",
            "missing_terms.py::test_an_offset_is_sought_only_where_it_may_be",
        ),
    ),
    *within(
        "torchdq/learning/logs/outliers.py",
        (
            "steps taken for spikes",
            "np.where(before * after > 0, np.minimum(abs(before), abs(after)), 0.0)",
            "np.maximum(abs(before), abs(after))",
            "outliers.py::test_steps_short_motions_and_rest_are_no_spikes",
        ),
    ),
    *within(
        "torchdq/learning/evaluation/nominal_range.py",
        (
            "motions beyond the limits undoubted",
            "past > torch.where(turns, TURNS, PAST * reach)",
            "past > torch.where(turns, TURNS, 1e3 * PAST * reach)",
            "plausibility.py::test_motions_beyond_the_limits_of_the_description_are_named",
        ),
    ),
    *within(
        "torchdq/learning/bodies/payload.py",
        (
            "torques that no payload explains undoubted",
            "told = (rms > WORSE * usual)",
            "told = (rms > 1e6 * WORSE * usual)",
            "payload.py::test_torques_that_no_payload_explains_are_named_with_their_joints",
        ),
    ),
    *within(
        "torchdq/learning/evaluation/coverage.py",
        (
            "intervals for motions that are alike",
            "beyond.quantile(COVERED, 0).clamp_min(1.0)",
            "beyond.quantile(COVERED, 0).clamp(1.0, 1.0)",
            "intervals.py::test_blocks_that_differ_leave_room_for_another_one",
        ),
    ),
    *within(
        "torchdq/learning/identification/calibration.py",
        (
            "intervals of normal errors whatever the errors are like",
            "return interval_factors(ratios).cpu()",
            "return torch.full_like(noise, NORMAL)",
            "intervals.py::test_intervals_of_an_identified_robot_hold_their_share_whatever_the_noise_is_like",
        ),
    ),
    *within(
        "torchdq/learning/identification/gains.py",
        (
            "gains about one alone",
            "(1 - h)[:, None] * start + (h - centre)[:, None] * phi",
            "(1 - h)[:, None] * start",
            "ladder_of_models.py::test_gains_of_drives_are_found_within_their_errors",
        ),
        (
            "errors of gains that do not reach parameters",
            "(facts.e + prior)[:, None]) @ spread",
            "(facts.e + prior)[:, None]) @ (0 * spread)",
            "ladder_of_models.py::test_errors_hold_those_of_the_gains",
        ),
    ),
    *within(
        "torchdq/effects/residual.py",
        (
            "a learned torque at the acceleration without it",
            "r = r + _solution(factors, found - r)",
            "r = found",
            "residual_effect.py::test_a_network_that_learned_rotors_is_those_rotors_however_heavy",
        ),
        (
            "gradients of learned torques as if they did not change the acceleration",
            "return r + _solution(factors, change - change.detach())",
            "return r + (change - change.detach())",
            "residual_effect.py::test_gradients_are_those_of_finite_differences",
        ),
    ),
    *within(
        "torchdq/layers/residual/smooth.py",
        (
            "a limit whose slope jumps at its end",
            "2.5 * ROOM + ROOM * t * (t - 3)",
            "2.0 * ROOM + ROOM * t * (t - 2.5)",
            "residual_domain.py::test_slopes_are_those_of_finite_differences_and_have_no_jump",
        ),
    ),
    *within(
        "torchdq/layers/residual/dynamics.py",
        (
            "a residual that acts outside of the trained states",
            "return self.domain(self.of_state(x)) * (1",
            "return (1",
            "residual_domain.py::test_a_joint_that_is_far_away_leaves_the_others_their_residual",
        ),
        (
            "sines of metres",
            "q.sin().where(self.turns, q)",
            "q.sin()",
            "residual.py::test_a_joint_that_slides_is_seen_where_it_is_and_metres_are_no_angles",
        ),
        (
            "a gate that falls faster with the torque than the torque rises",
            "SLOWLY = 4.0",
            "SLOWLY = 1.0",
            "residual_domain.py::test_the_whole_torque_rises_with_the_models_where_the_gate_falls",
        ),
        (
            "a residual without a bound",
            "return limited(self.raw(self.within_range(x), network), self.largest.to(x))",
            "return self.raw(self.within_range(x), network)",
            "residual_domain.py::test_no_weights_take_a_residual_beyond_its_bound",
        ),
    ),
    *within(
        "torchdq/learning/with_residual.py",
        (
            "a network that learns what the identified robot remembers",
            "measured - (known - self._steady(rows))",
            "measured",
            "with_residual.py::test_samples_are_what_the_layer_explains_as_well_as_the_robot_that_remembers",
        ),
        (
            "predictions without the memory",
            "PredictedTorques(tau + added, both.error",
            "PredictedTorques(both.tau, both.error",
            "with_residual.py::test_a_scene_moves_as_it_predicts",
        ),
        (
            "an offset that was learned and is not predicted",
            "PredictedTorques(tau + added, torch.hypot",
            "PredictedTorques(tau, torch.hypot",
            "with_residual.py::test_an_offset_that_was_learned_is_predicted_where_the_network_has_no_weight",
        ),
    ),
    *within(
        "torchdq/layers/residual/posterior.py",
        (
            "errors that do not grow outside of the trained states",
            "of_weights + outside",
            "of_weights + 0 * outside",
            "residual_fit.py::test_intervals_widen_away_from_what_was_trained",
        ),
    ),
    *within(
        "torchdq/learning/training/validation_gain.py",
        (
            "a residual that is kept where it helps no more than by chance",
            "((means > errors).all(0) & (independent >= LEAST * len(blocks)))",
            "(independent >= LEAST * len(blocks))",
            "residual_fit.py::test_a_joint_that_does_not_gain_by_more_than_chance_has_no_weight",
        ),
        (
            "a residual that is kept whatever little its rows say",
            "((means > errors).all(0) & (independent >= LEAST * len(blocks)))",
            "(means > errors).all(0)",
            "residual_fit.py::test_three_seconds_are_too_few_independent_samples_for_a_network",
        ),
        (
            "a residual that loses in regions and gains in blocks of a motion that repeats itself",
            "(means > errors).all(0)",
            "(means > errors)[0]",
            "residual_fit.py::test_regions_are_judged_by_themselves",
        ),
    ),
    *within(
        "torchdq/learning/training/cross_validation.py",
        (
            "a residual that was tested on other passes of the motion only",
            "for pair in regions(recording) for half in pair] if found else []",
            "for pair in regions(recording) for half in pair][:0]",
            "residual_fit.py::test_a_motion_that_repeats_itself_does_not_pass_for_others",
        ),
    ),
    *within(
        "torchdq/layers/residual/recorded.py",
        (
            "derivative of the perceptrons by the wrong features",
            "self.first, self.weights, self.biases = self._last(weights[0])",
            "self.first, self.weights, self.biases = -self._last(weights[0])",
            "residual_effect.py::test_the_closed_form_is_what_forward_mode_finds_of_any_network",
        ),
    ),
    *within(
        "torchdq/backends/c_constants.py",
        (
            "in C, a digit of the sine's polynomial",
            "SIN(z) (-0x1.5555555555549p-3",
            "SIN(z) (-0x1.5555555455549p-3",
            f"{BACKENDS}::test_compiled_functions_equal_torch_operations",
        ),
    ),
    *within(
        "torchdq/backends/cuda_source.py",
        (
            "sums of a GPU with recomputed rows twice",
            'value = f"over?(S)0:{value}"',
            "value = value",
            "cuda_host.py::test_sums_contain_the_recomputed_rows",
        ),
        (
            "rows of a GPU that nothing recomputes",
            "literal(LARGEST_GROWTH.single)",
            "literal(LARGEST_GROWTH.double)",
            "cuda_host.py::test_rows_over_the_limit_are_recomputed_in_float64",
        ),
        (
            "singular rows of a GPU as numbers",
            'value = f"over?real(NAN_BITS):{value}"',
            "value = value",
            "cuda_host.py::test_singular_rows_are_nan_and_alone",
        ),
        (
            "rows of the last block left out",
            "i<here*{width};i+=BLOCK",
            "i<here*{width}-1;i+=BLOCK",
            "cuda_host.py::test_a_row_of_a_batch_is_bitwise_the_row_alone",
        ),
        (
            "rows of even width moved into each other",
            'f"i/{width}*{width + 1}+i%{width}"',
            '"i"',
            "cuda_host.py::test_kernels_write_only_into_their_results",
        ),
        (
            "sums of whole blocks where the last is shorter",
            "for(int i=0;i<here;i++)a+=",
            "for(int i=0;i<BLOCK;i++)a+=",
            "cuda_host.py::test_gradients_equal_those_of_the_c_backend",
        ),
        (
            "rows wider than shared memory",
            "if width <= room:",
            "if True:",
            "cuda_host.py::test_rows_too_wide_for_shared_memory_are_read_and_written_where_they_are",
        ),
    ),
    *within(
        "torchdq/backends/cuda_kernel.py",
        (
            "sums without the recomputed rows",
            "(sums[k].sum((0, 1)) if k in sums",
            "(sums[k][0].sum(0) if k in sums",
            "cuda_host.py::test_sums_contain_the_recomputed_rows",
        ),
    ),
    *within(
        "torchdq/program/uniform.py",
        (
            "values that all samples share, taken for each other",
            "payload=(len(program.arguments), j)",
            "payload=(len(program.arguments), 0)",
            "cuda_host.py::test_values_that_all_samples_share_are_computed_once_in_a_block",
        ),
    ),
    *within(
        "torchdq/program/order.py",
        (
            "values before their operands",
            "ready = [rank(i) for i in range(len(ops)) if not given[i] and not missing[i]]",
            "ready = [rank(i) for i in range(len(ops)) if not given[i]]",
            "cuda_compile.py::test_orders_hold_every_value_once_after_its_operands",
        ),
        (
            "the order that keeps most values alive",
            "return min(recorded(program), listed(program)",
            "return max(recorded(program), listed(program)",
            "cuda_compile.py::test_the_narrowest_order_keeps_the_fewest_values_alive",
        ),
    ),
    *within(
        "envs/row_selection.py",
        (
            "new episodes in the rows that go on",
            "return torch.where(column(self.mask, x), fresh, x)",
            "return torch.where(column(self.mask, x), x, fresh)",
            "envs.py::test_rows_are_the_same_where_the_host_does_not_look",
        ),
    ),
    *within(
        "envs/vector_env.py",
        (
            "a step that waits for flags of a GPU",
            "return not self._looks or bool(",
            "return bool(",
            "cuda_host.py::test_a_step_of_environments_asks_the_device_nothing",
        ),
        (
            "a step of a GPU that a graph cannot repeat",
            "x.copy_(buffers[name])",
            "self._buffers = {**self._buffers, name: buffers[name]}",
            "far_device.py::test_on_a_far_device[a_step_is_repeated_by_a_graph]",
        ),
        (
            "parameters that every step copies to the GPU",
            "scene.to(self.device)",
            "scene",
            "far_device.py::test_on_a_far_device[steps_with_tensors_that_were_given_on_the_cpu]",
        ),
    ),
    *within(
        "torchdq/backends/memory.py",
        (
            "views read without their sign",
            "if x.is_neg() or not x.is_contiguous()",
            "if not x.is_contiguous()",
            f"{BACKENDS}::test_views_with_a_sign_of_their_own_are_read_with_it",
        ),
    ),
    *within(
        "torchdq/backends/call.py",
        (
            "memory of tensors without values read",
            "torch.compiler.is_compiling() or dispatching()",
            "torch.compiler.is_compiling()",
            f"{BACKENDS}::test_tensors_without_values_give_tensors_without_values",
            True,
        ),
    ),
    *within(
        "torchdq/effects/effect.py",
        (
            "one number for all components of a vector",
            "if single and axes and not per_joint:",
            "if False:",
            f"{EFFECTS}::test_parameters_that_make_no_sense_are_refused",
        ),
    ),
    *within(
        "torchdq/effects/effect.py",
        (
            "words and truth values as parameters",
            "if not all(map(is_number, given)):",
            "if False:",
            f"{EFFECTS}::test_parameters_that_are_no_numbers_are_refused",
        ),
    ),
    *within(
        "torchdq/learning/identification/identify.py",
        (
            "numbers too large for least squares without a name",
            "except torch.linalg.LinAlgError as error:",
            "except KeyboardInterrupt as error:",
            f"{IDENTIFY}::test_numbers_too_large_for_least_squares_are_named",
        ),
    ),
    *within(
        "torchdq/robot/check/changes.py",
        (
            "a stack of equal robots that is one robot",
            "if not {*SHAPES} & {*changes}:",
            "if False:",
            f"{ROBOTS}::test_a_stack_has_an_axis_of_its_robots_even_if_they_are_equal",
        ),
    ),
    *within(
        "torchdq/backends/call.py",
        (
            "parameters without values that have to be moved",
            "elif x.is_meta and not given[first].is_meta:",
            "elif False:",
            f"{ROBOTS}::test_tensors_without_values_make_results_without_values_or_are_named",
        ),
    ),
    *within(
        "torchdq/scene/defaults.py",
        (
            "the sum of several robots",
            ".mean(0)",
            ".sum(0)",
            "envs.py::test_robots_of_a_stack_are_each_simulated",
        ),
    ),
    *within(
        "torchdq/learning/logs/checks.py",
        (
            "positions that follow another joint believed",
            "if abs(correlation) < UNLIKE:",
            "if False:",
            "logs.py::test_positions_that_follow_the_velocity_of_another_joint_are_refused",
        ),
    ),
    *within(
        "torchdq/scene/recording.py",
        (
            "substeps recorded without end",
            "> MOST_OPERATIONS:",
            "> 1e99:",
            "notice.py::test_substeps_that_no_program_can_hold_are_refused_after_the_first",
        ),
    ),
    *within(
        "torchdq/program/program.py",
        (
            "programs recorded in silence",
            'notice.at(lambda: f"{len(tape.ops)} operations")',
            "pass",
            "notice.py::test_programs_that_take_long_to_record_and_to_write_are_told_with_their_operations",
        ),
    ),
    *within(
        "torchdq/learning/training/checkpoint.py",
        (
            "attributes of a model left out of its identity",
            '"the model": text, **own}',
            '"the model": text}',
            f"{TRAINING}::test_a_checkpoint_of_a_model_with_other_attributes_is_refused",
        ),
        (
            "attributes that a run changes kept in its identity",
            "CHANGES if now.get(name, x) != x else x for",
            "x for",
            f"{TRAINING}::test_attributes_that_a_run_changes_and_backends_do_not_stop_it_from_going_on",
        ),
        (
            "small torques of a checkpoint not compared",
            "largest = now.abs().amax(0)",
            "largest = now.abs().max()",
            f"{TRAINING}::test_a_checkpoint_of_a_model_that_computes_otherwise_is_refused",
        ),
    ),
    *within(
        "torchdq/base/checks.py",
        (
            "tensors that are not dense accepted",
            "return x.layout == torch.strided and not x.is_nested",
            "return True",
            "arguments.py::test_tensors_that_are_not_dense_are_named",
        ),
    ),
    *within(
        "torchdq/backends/call.py",
        (
            "sparse tensors in a layout of dense ones",
            "if not all(map(is_dense, given)):",
            "if False:",
            "arguments.py::test_tensors_that_are_not_dense_are_named",
        ),
    ),
    *within(
        "torchdq/robot/arrays.py",
        (
            "robots on torch's default device",
            'torch.tensor(values, dtype=torch.float64, device="cpu")',
            "torch.tensor(values, dtype=torch.float64)",
            "arguments.py::test_robots_effects_and_layers_are_made_on_the_cpu_whatever_the_default_device_is",
        ),
    ),
    *within(
        "torchdq/functions/compile.py",
        (
            "programs without their arguments",
            "if name not in present:",
            "if False:",
            "backends.py::test_a_compiled_program_needs_its_arguments",
        ),
    ),
    *within(
        "torchdq/learning/logs/read.py",
        (
            "rows of a log that are no whole numbers",
            "isinstance(x, Integral) and not isinstance(x, bool)",
            "True",
            "logs.py::test_a_layout_must_be_one",
        ),
    ),
    *within(
        "torchdq/learning/logs/checks.py",
        (
            "positions that jump believed",
            "if not jumps.any():",
            "if True:",
            "logs.py::test_positions_that_jump_farther_than_their_velocities_explain_are_told",
        ),
    ),
    *within(
        "torchdq/learning/logs/texts.py",
        (
            "files cut within a number believed",
            "if last >= min(before):",
            "if True:",
            "logs.py::test_a_file_that_ends_within_its_last_number_is_told",
        ),
    ),
    *within(
        "torchdq/learning/rollout/shooting.py",
        (
            "gaps between steps forgotten",
            "inner[1:, ..., s:-1], inner[1:, ..., -1] = by_block(B), by_block(moved.gaps)",
            "inner[1:, ..., s:-1], inner[1:, ..., -1] = by_block(B), 0.0",
            "rollout_fit.py::test_exact_logs_give_the_exact_parameters",
        ),
        (
            "slopes of constants in the place of those of lines",
            "u ** np.maximum(degrees - 1, 0)",
            "u ** np.maximum(degrees - 2, 0)",
            "rollout_fit.py::test_slopes_at_the_first_nodes_are_those_of_savitzky_and_golay",
        ),
    ),
    *within(
        "torchdq/learning/rollout/recordings.py",
        (
            "commands not delayed within a step",
            "return np.where((last > first)[..., None], (early + between + late) / span, u[first])",
            "return u[first]",
            "rollout_fit.py::test_means_and_slopes_of_commands_are_those_of_a_fine_sum",
        ),
    ),
    *within(
        "envs/actions.py",
        (
            "imaginary parts of actions lost",
            "if actions.is_complex() if isinstance(actions, Tensor) else np.iscomplexobj(actions):",
            "if False:",
            "envs.py::test_actions_that_are_no_numbers_are_refused",
        ),
    ),
    *within(
        "torchdq/learning/excitation/fourier.py",
        (
            "peaks between the points of a motion missed",
            "missed = math.cos(math.pi * H / len(self.phases))",
            "missed = 1.0",
            "excitation.py::test_series_keep_their_limits_between_the_points_and_rest_at_their_ends",
        ),
        (
            "motions that do not start at rest",
            "self._sines, self._cosines = _orthogonal(k), _orthogonal(k * k)",
            "self._sines, self._cosines = _orthogonal(k * k), _orthogonal(k * k)",
            "excitation.py::test_series_keep_their_limits_between_the_points_and_rest_at_their_ends",
        ),
    ),
    *within(
        "torchdq/learning/excitation/excite.py",
        (
            "torques of a motion that may exceed their limits",
            "return (used <= 1).all(-1) & (clearance >= 0).all(-1)",
            "return (clearance >= 0).all(-1)",
            "excitation.py::test_limits_that_are_missing_or_cannot_be_kept_are_named",
        ),
        (
            "described dry friction left out of the torques of a motion",
            "most = torque.abs().amax(-2) + between(torque) + robot.friction",
            "most = torque.abs().amax(-2) + between(torque) - 5 * robot.friction",
            "excitation.py::test_torques_that_bind_are_kept_between_the_rows",
        ),
    ),
    *within(
        "torchdq/learning/identification/base.py",
        (
            "errors of base parameters without the noise",
            "return Z.index_select(-1, self.leading) / self.noise[:, None]",
            "return Z.index_select(-1, self.leading)",
            "excitation.py::test_errors_are_those_of_least_squares_on_pinocchios_regressor",
        ),
    ),
    *within(
        "torchdq/learning/bodies/pseudo_inertia.py",
        (
            "bodies moved without turning",
            "T[1:, 0], T[1:, 1:] = matrix[:3, 3], matrix[:3, :3]",
            "T[1:, 0] = matrix[:3, 3]",
            "payload.py::test_moved_parameters_are_those_of_a_body_held_in_a_frame",
        ),
    ),
    *within(
        "torchdq/learning/bodies/nearest.py",
        (
            "curvature of the distance between bodies halved",
            "blocks = 2 * torch.einsum",
            "blocks = torch.einsum",
            "posterior.py::test_slopes_of_the_distance_are_those_of_autograd",
        ),
        (
            "bodies nearest to others that cannot exist",
            "inside = (info == 0).all(1) & (x > 0).all(1)",
            "inside = torch.ones(len(y), dtype=torch.bool)",
            "posterior.py::test_the_nearest_robot_is_a_minimum_where_bodies_can_exist",
        ),
    ),
    *within(
        "torchdq/learning/bodies/posterior.py",
        (
            "drawn robots whose base parameters do not spread",
            "offset = (phi - self.phi - gaussian) @ self.white.T",
            "offset = (phi - self.phi) @ self.white.T",
            "posterior.py::test_base_parameters_have_the_mean_and_the_covariance_found",
        ),
        (
            "drawn bodies twice as wide as the prior",
            "torch.linalg.matrix_exp((s + s.mT) / 2)",
            "torch.linalg.matrix_exp(s + s.mT)",
            "posterior.py::test_bodies_that_torques_do_not_tell_have_the_width_of_the_prior",
        ),
    ),
    *within(
        "torchdq/learning/bodies/payload.py",
        (
            "the expected payload taken for none",
            "off = own @ inertial_parameters(J) - residual",
            "off = -residual",
            "payload.py::test_exact_torques_give_the_exact_payload",
        ),
        (
            "correlation of what an arm's model has wrong left out",
            "_correlation(left).maximum(correlation)",
            "torch.ones_like(correlation)",
            "payload.py::test_correlated_faults_of_the_empty_arm_widen_the_errors",
        ),
    ),
)
