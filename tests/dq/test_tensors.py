"""Every function of `torchdq.dq` and `dq.paper` as tensor code: batches, layouts, dtypes, transforms, bad arguments.

`FUNCTIONS` holds them all, with their arguments; a function that is not in it fails the first test. What the functions
return is the business of the tests of the algebra, of poses, and of exp and log; rotations are compared with scipy.
"""

import inspect
import math

import numpy as np
import pytest
import torch
from helpers import all_in_one, thinned
from messages import refused
from scipy.spatial.transform import Rotation
from torch.func import jacfwd, jacrev, vmap

from torchdq import dq
from torchdq.errors import ArgumentError, DtypeError

F32, F64 = torch.float32, torch.float64
EPS = {F32: 2.0**-23, F64: 2.0**-52}


# --- arguments: name -> (trailing shape, random values of it) --------------------------------------------------------


def normal(*trailing):
    return trailing, lambda batch, g: torch.randn((*batch, *trailing), dtype=F64, generator=g)


def _unit(batch, g):
    return dq.normalize(torch.randn(*batch, 4, dtype=F64, generator=g))


def _pose(batch, g):
    # turns from 0.2 to 2 rad: far from the half turn, where the shortest way is not continuous
    v = torch.randn(*batch, 3, dtype=F64, generator=g)
    angle = 0.1 + 0.9 * torch.rand(*batch, 1, dtype=F64, generator=g)
    b = torch.randn(*batch, 3, dtype=F64, generator=g)
    return dq.exp(torch.cat([v / v.norm(dim=-1, keepdim=True) * angle, b], -1))


def _symmetric(batch, g):
    a = torch.randn(*batch, 3, 3, dtype=F64, generator=g)
    return a @ a.mT + torch.eye(3, dtype=F64)


QUATERNION, DUAL, VECTOR, SCREW, NUMBER = normal(4), normal(8), normal(3), normal(6), normal()
UNIT, POSE = ((4,), _unit), ((8,), _pose)
ROTATION = ((3, 3), lambda batch, g: dq.to_rotation_matrix(_unit(batch, g)))
TRANSFORM = ((4, 4), lambda batch, g: dq.to_matrix(_pose(batch, g)))
INERTIA = ((3, 3), _symmetric)
MASS = ((), lambda batch, g: 1 + torch.rand(batch, dtype=F64, generator=g))

OPERATORS = ("hamilton_left", "hamilton_right")
OF_BOTH_KINDS = (*OPERATORS, "conj", "norm", "normalize")
OF_POSES = ("columns", "ad_matrix", "log", "log_shortest", "log_jacobian", "screw_params", "to_matrix")
OF_POSES += ("rotation", "translation", "translation_body")
FUNCTIONS = {
    **{name: {"x": DUAL} for name in OF_BOTH_KINDS},
    **{f"{name}/quaternion": {"x": QUATERNION} for name in OF_BOTH_KINDS},
    **{name: {"x": POSE} for name in OF_POSES},
    "mul": {"x": DUAL, "y": DUAL},
    "mul/quaternion": {"x": QUATERNION, "y": QUATERNION},
    "dot": {"a": VECTOR, "b": VECTOR},
    "cross": {"a": SCREW, "b": SCREW},
    "cross/vector": {"a": VECTOR, "b": VECTOR},
    "inner": {"a": SCREW, "b": SCREW},
    "double_geodesic": {"a": SCREW, "b": SCREW},
    "swap": {"a": SCREW},
    "power": {"wrench": SCREW, "twist": SCREW},
    "ad": {"x": POSE, "m": SCREW},
    "inertia_transform": {"mass": MASS, "inertia": INERTIA, "a": SCREW, "com": VECTOR},
    "inertia_transform/centred": {"mass": MASS, "inertia": INERTIA, "a": SCREW},
    "exp": {"a": SCREW},
    "sclerp": {"x": POSE, "y": POSE, "t": NUMBER},
    "screw_path": {"x": POSE, "y": POSE, "s": NUMBER, "sd": NUMBER, "sdd": NUMBER},
    "from_pose": {"rotation": UNIT, "position": VECTOR},
    "rotate": {"r": UNIT, "v": VECTOR},
    "to_rotation_matrix": {"r": UNIT},
    "to_rotation_6d": {"r": UNIT},
    "from_rotation_6d": {"columns": SCREW},
    "from_rotation_matrix": {"matrix": ROTATION},
    "from_matrix": {"matrix": TRANSFORM},
}
ALONE = {"s": 0, "sd": 1, "sdd": 2}  # the only result that an argument is in
ALL = all_in_one(FUNCTIONS)
# the operators are linear: rows of units times their argument
DIFFERENTIATED = thinned(FUNCTIONS, [key for key in FUNCTIONS if key not in OPERATORS[1:]])


def function(key):
    """Function of `dq` or of `dq.paper`."""
    name = key.split("/")[0]
    return getattr(dq, name) if name in dq.__all__ else getattr(dq.paper, name)


def call(key, arguments):
    """Results of a function as a tuple."""
    found = function(key)(**arguments)
    return tuple(found) if isinstance(found, tuple) else (found,)


def arguments(key, *batches, dtype=F64, seed=0):
    """Random arguments, in turn with the given batch shapes."""
    g = torch.Generator().manual_seed(seed)
    parameters = FUNCTIONS[key].items()
    return {name: make(batches[i % len(batches)], g).to(dtype) for i, (name, (_, make)) in enumerate(parameters)}


def near(found, expected, tolerance=16):
    """Same to rounding: as many eps of the largest result."""
    dtype, size = found.dtype, max(1.0, expected.detach().abs().max().item())
    torch.testing.assert_close(found, expected.to(dtype), rtol=0, atol=tolerance * EPS[dtype] * size)


def each_near(found, expected):
    for one, other in zip(found, expected, strict=True):
        near(one, other)


def test_every_function_is_listed_with_its_parameters():
    public = set(dq.__all__) - {"Pose"}
    public |= {name for name, f in vars(dq.paper).items() if name[0] != "_" and documented_here(name, f)}
    assert public == {key.split("/")[0] for key in FUNCTIONS}
    for name in public:
        listed = set().union(*(FUNCTIONS[key] for key in FUNCTIONS if key.split("/")[0] == name))
        assert listed == set(inspect.signature(function(name)).parameters)


def documented_here(name, f):
    """Whether `dq.paper` makes this function, itself or by `on_tensors`."""
    made = inspect.isfunction(f) and f.__module__.startswith(("torchdq.dq.paper", "torchdq.algebra"))
    return made and name not in ("on_tensors", "six")


# --- batches, layouts and dtypes -------------------------------------------------------------------------------------


@ALL
def test_leading_axes_broadcast(key):
    given = arguments(key, (2, 1), (3,))
    trailing = [len(shape) for shape, _ in FUNCTIONS[key].values()]
    batch = torch.broadcast_shapes(*[v.shape[: v.ndim - n] for v, n in zip(given.values(), trailing, strict=True)])
    full = {
        name: v.expand(*batch, *v.shape[v.ndim - n :]) for (name, v), n in zip(given.items(), trailing, strict=True)
    }
    together = call(key, given)
    for index in np.ndindex(*batch):
        alone = call(key, {name: v[index].clone() for name, v in full.items()})
        for one, all_ in zip(alone, together, strict=True):
            assert all_.shape == batch + one.shape
            near(all_[index], one)
    for empty in ((0,), (3, 0)):
        assert [x.shape for x in call(key, arguments(key, empty))] == [empty + x.shape for x in alone]


@ALL
def test_the_layout_in_memory_does_not_matter(key):
    given = arguments(key, (5, 7))
    strided = {}
    for name, v in given.items():
        # every second element of a larger array, with the axes stored in reverse order
        store = torch.full([2 * n for n in reversed(v.shape)], math.nan, dtype=v.dtype)
        view = store[(slice(None, None, 2),) * v.ndim].permute(*reversed(range(v.ndim)))
        strided[name] = view.copy_(v)
        assert not strided[name].is_contiguous()
    each_near(call(key, strided), call(key, given))


@ALL
def test_float32_stays_float32_and_is_as_accurate(key):
    given = arguments(key, (20,), dtype=F32)
    exact = call(key, {name: v.to(F64) for name, v in given.items()})
    for found, expected in zip(call(key, given), exact, strict=True):
        assert found.dtype == F32 and expected.dtype == F64
        near(found, expected)


@ALL
def test_a_row_of_nan_leaves_the_other_rows_bitwise_alone(key):
    given = arguments(key, (6,))
    before = call(key, given)
    for name in given:
        spoilt = {**given, name: given[name].clone()}
        spoilt[name][2] = math.nan
        for k, (found, expected) in enumerate(zip(call(key, spoilt), before, strict=True)):
            assert found[[0, 1, 3, 4, 5]].equal(expected[[0, 1, 3, 4, 5]])
            assert bool(found[2].isnan().any()) == (ALONE.get(name, k) == k)


# --- derivatives and transforms --------------------------------------------------------------------------------------


@all_in_one(DIFFERENTIATED)
def test_vmap_is_the_batch_and_derivatives_are_right_in_both_directions_under_it(key):
    given = arguments(key, (2,))

    def one(*values):
        return call(key, dict(zip(given, values, strict=True)))

    each_near(vmap(one)(*given.values()), call(key, given))
    which = tuple(range(len(given)))
    backward, forward = (vmap(jacobian(one, which))(*given.values()) for jacobian in (jacrev, jacfwd))
    for output_backward, output_forward in zip(backward, forward, strict=True):
        each_near(output_backward, output_forward)
    first = [v[0].clone().requires_grad_() for v in given.values()]
    assert torch.autograd.gradcheck(one, first, eps=1e-6, atol=1e-7, rtol=1e-6, fast_mode=True)


@pytest.mark.parametrize("key", thinned(["mul", "cross/vector", "log"], ["mul"]))
def test_one_graph_of_unknown_sizes_takes_rows_of_which_some_are_shared(key):
    torch._dynamo.reset()
    traced = torch.compile(
        lambda *x: call(key, dict(zip(FUNCTIONS[key], x, strict=True))), fullgraph=True, dynamic=True, backend="eager"
    )
    given = arguments(key, (5,), ())
    each_near(traced(*given.values()), call(key, given))


# --- errors ----------------------------------------------------------------------------------------------------------

NUMBERS = {"mass", "t", "s", "sd", "sdd"}  # may be Python numbers, and have no trailing axis


@all_in_one([(key, name) for key in FUNCTIONS for name in FUNCTIONS[key] if name not in NUMBERS])
def test_a_wrong_shape_dtype_or_type_is_named(of_what):
    key, name = of_what
    given = arguments(key, (2,))
    shapes = [(2, 5), (), (2, 5, 5)] if given[name].ndim == 2 else [(2, 5), (4,), (2, 5, 5), (), (8,)]
    for shape in shapes:
        with refused(ArgumentError, name=name, found=shape):
            call(key, {**given, name: torch.ones(shape, dtype=F64)})
    for dtype in (torch.int64, torch.bool, torch.complex128):
        with refused(DtypeError, name=name, found=dtype):
            call(key, {**given, name: given[name].to(dtype)})
    for wrong in (given[name].tolist(), given[name].numpy(), None):
        if wrong is None and name == "com":
            continue  # None is allowed there: the centre of mass is the origin
        with refused(ArgumentError, name=name, found=type(wrong).__name__):
            call(key, {**given, name: wrong})


def test_products_of_different_kinds_are_refused():
    for product, a, b in ((dq.mul, 4, 8), (dq.mul, 8, 4), (dq.paper.cross, 3, 6)):
        with refused(ArgumentError):
            product(torch.ones(a), torch.ones(b))


# --- the few that are more than their algebra ------------------------------------------------------------------------


@pytest.mark.case("G9")
def test_matrices_and_columns_are_those_of_the_products():
    x, y = arguments("mul", (5,)).values()
    for parts in ((x, y), (x[:, :4], y[:, :4])):
        a, b = parts
        near((dq.paper.hamilton_left(a) @ b[..., None])[..., 0], dq.mul(a, b))
        near((dq.paper.hamilton_right(b) @ a[..., None])[..., 0], dq.mul(a, b))
    x, m = arguments("ad", (5,)).values()
    near((dq.ad_matrix(x) @ m[..., None])[..., 0], dq.ad(x, m))
    assert dq.ad(-x, m).equal(dq.ad(x, m))
    near(torch.cat(dq.paper.columns(x), -2), dq.ad_matrix(x)[..., :3])


def test_the_norm_is_a_dual_number_whose_square_is_x_times_its_conjugate():
    x = arguments("norm", (5,))["x"]
    n, square = dq.paper.norm(x), dq.mul(x, dq.conj(x))
    near(torch.stack([n[:, 0] ** 2, 2 * n[:, 0] * n[:, 1]], -1), square[:, ::4])
    near(dq.paper.norm(x[:, :4]), n[:, 0])


def test_inertia_about_the_centre_of_mass_is_carried_to_the_frame():
    mass, inertia, a, com = arguments("inertia_transform", (5,)).values()
    at_com = dq.from_pose(torch.tensor([1.0, 0, 0, 0], dtype=F64).expand(5, 4), com)
    found = dq.paper.inertia_transform(mass, inertia, a, com)
    near(found, dq.ad(at_com, dq.paper.inertia_transform(mass, inertia, dq.ad(dq.conj(at_com), a))))
    assert (dq.paper.power(found, a) > 0).all()  # twice the kinetic energy
    assert dq.paper.inertia_transform(2.0, inertia, a).equal(dq.paper.inertia_transform(mass / mass * 2, inertia, a))


# --- conversions -----------------------------------------------------------------------------------------------------


def branches():
    """Unit quaternions with w >= 0 around each of the four largest components, and on the borders between them."""
    g = torch.Generator().manual_seed(0)
    around = [torch.eye(4, dtype=F64)[k] + 0.3 * torch.randn(20, 4, dtype=F64, generator=g) for k in range(4)]
    border = torch.tensor(list(np.ndindex(3, 3, 3, 3)), dtype=F64)[1:] - 1  # all of -1, 0, 1: components as large
    border = border[border.norm(dim=-1) > 0]
    half_turns = torch.cat([torch.zeros(20, 1, dtype=F64), torch.randn(20, 3, dtype=F64, generator=g)], -1)
    q = dq.normalize(torch.cat([*around, border, half_turns]))
    return torch.where(q[:, :1] < 0, -q, q)


def same_rotation(found, expected, tolerance):
    """The same quaternions, whatever the signs."""
    distance = torch.minimum((found - expected).norm(dim=-1), (found + expected).norm(dim=-1))
    assert distance.max() <= tolerance


@pytest.mark.parametrize("dtype", [F32, F64])
def test_rotation_matrices_there_and_back_at_every_branch_and_at_half_a_turn(dtype):
    q = branches()
    assert {int(k) for k in q.abs().argmax(-1)} == {0, 1, 2, 3}
    found = dq.from_rotation_matrix(dq.to_rotation_matrix(q.to(dtype)))
    same_rotation(found.double(), q, 8 * EPS[dtype])
    assert (found[:, 0] >= 0).all()
    assert ((found.norm(dim=-1) - 1).abs() <= 8 * EPS[dtype]).all()
    clear = q[:, 0] > 1e-3
    torch.testing.assert_close(found[clear].double(), q[clear], rtol=0, atol=8 * EPS[dtype])  # the sign with w > 0


def test_rotations_and_their_matrices_are_those_of_scipy():
    q = branches()
    reference = Rotation.from_quat(q.numpy(), scalar_first=True)
    matrices = torch.tensor(reference.as_matrix())
    torch.testing.assert_close(dq.to_rotation_matrix(q), matrices, rtol=0, atol=8 * EPS[F64])
    same_rotation(dq.from_rotation_matrix(matrices), q, 8 * EPS[F64])
    v = torch.randn(len(q), 3, dtype=F64, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(dq.rotate(q, v), torch.tensor(reference.apply(v.numpy())), rtol=0, atol=32 * EPS[F64])
    vectors = 2 * dq.log_shortest(torch.cat([q, torch.zeros_like(q)], -1))[:, :3]
    away = q[:, 0] > 1e-9  # at half a turn both directions are right
    near(vectors[away], torch.tensor(reference.as_rotvec())[away])
    product = (reference[:60] * reference[40:100]).as_quat(scalar_first=True)
    same_rotation(dq.mul(q[:60], q[40:100]), torch.tensor(product), 8 * EPS[F64])


def test_a_quaternion_from_a_rotation_matrix_has_its_derivatives():
    q = branches()
    for branch in range(4):
        matrix = dq.to_rotation_matrix(q[q.abs().argmax(-1) == branch][3]).requires_grad_()
        assert torch.autograd.gradcheck(dq.from_rotation_matrix, matrix, eps=1e-6, atol=1e-8, rtol=1e-6)
        assert torch.autograd.gradgradcheck(dq.from_rotation_matrix, matrix, eps=1e-6, atol=1e-7, rtol=1e-5)


def test_derivatives_of_a_rotation_there_and_back_are_those_of_standing_still():
    # at half a turn too, where a formula that divides by w has none
    for q in (branches()[5], branches()[30], torch.tensor([1e-9, 0.6, 0.0, 0.8], dtype=F64)):

        def round_trip(v, q=q):
            turned = dq.mul(q, dq.exp(torch.cat([v, torch.zeros(3, dtype=F64)]))[:4])
            back = dq.from_rotation_matrix(dq.to_rotation_matrix(turned))
            return dq.log_shortest(torch.cat([dq.mul(dq.conj(q), back), torch.zeros(4, dtype=F64)]))[:3]

        jacobian = torch.autograd.functional.jacobian(round_trip, torch.zeros(3, dtype=F64))
        torch.testing.assert_close(jacobian, torch.eye(3, dtype=F64), rtol=0, atol=64 * EPS[F64])
