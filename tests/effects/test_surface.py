"""Maps of heights: heights and slopes are those of interpolation, and contact on a map is that on the same ground."""

import numpy as np
import pytest
import torch
from helpers import random, thinned
from messages import refused
from scipy.interpolate import RegularGridInterpolator
from urdf_text import also, link

import torchdq
from torchdq import ArgumentError, Robot, dq, effects
from torchdq.errors import DtypeError
from torchdq.robot import ContactPoint
from torchdq.scene import Scene

F64 = torch.float64
EPS = 2.0**-52

# --- looking up ------------------------------------------------------------------------------------------------------


def hills(*batch, rows=5, columns=7, **more):
    """A map of random heights."""
    return effects.HeightMap(random(*batch, rows, columns), 0.3, (-1.0, 0.5), **more)


def test_heights_are_those_of_bilinear_interpolation():
    land = hills()
    at = -1.0 + 0.3 * np.arange(7), 0.5 + 0.3 * np.arange(5)
    reference = RegularGridInterpolator(at[::-1], land.heights.numpy())
    x, y = (torch.linspace(axis[0], axis[-1], 60, dtype=F64)[1:-1] for axis in at)  # none on the lines of the grid
    height, slope_x, slope_y = land(*torch.meshgrid(x, y, indexing="xy"))
    for k, b in enumerate(y.tolist()):
        assert np.allclose(height[k], reference([(b, a) for a in x.tolist()]), rtol=0, atol=32 * EPS)
    d = 1e-6
    for slope, step in ((slope_x, (d, 0)), (slope_y, (0, d))):
        further = land(*torch.meshgrid(x + step[0], y + step[1], indexing="xy"))[0]
        assert torch.allclose((further - height) / d, slope, rtol=0, atol=1e-8)


def test_heights_continue_beyond_the_edge():
    land = hills()
    y = torch.full((2,), 0.8, dtype=F64)
    inside, outside = (land(torch.tensor(x, dtype=F64), y) for x in ((-1.0, 0.8 - 1e-12), (-7.0, 1e9)))
    assert torch.allclose(inside[0], outside[0], rtol=0, atol=1e-10)
    assert outside[1].tolist() == [0.0, 0.0] and torch.allclose(inside[2], outside[2], rtol=0, atol=1e-9)
    for far in (-1e300, 1e300):
        corner = land(torch.tensor([far], dtype=F64), torch.tensor([-far], dtype=F64))
        assert corner[0].item() in land.heights and [x.item() for x in corner[1:]] == [0.0, 0.0]


def test_gradients_flow_to_places_and_heights():
    heights, x, y = hills().heights.requires_grad_(), random(3, seed=1).requires_grad_(), random(3, seed=2) + 1.0

    def found(heights, x, y):
        return effects.HeightMap(heights, 0.3, (-1.0, 0.5))(x, y)

    assert torch.autograd.gradcheck(found, (heights, x, y.requires_grad_()))


def test_robots_have_a_map_each_or_share_one():
    land, x, y = hills(4), random(2, 4, 3, seed=3), 1.0 + random(2, 4, 3, seed=4)
    together, shared = land(x, y), hills()(x, y)
    for i in range(4):
        alone = effects.HeightMap(land.heights[i], 0.3, (-1.0, 0.5))
        assert all(map(torch.equal, alone(x[:, i], y[:, i]), (z[:, i] for z in together)))
        assert all(map(torch.equal, hills()(x[:, i], y[:, i]), (z[:, i] for z in shared)))
    assert torch.equal(land(x[0, 0], y[0, 0])[0], torch.stack([land(x[:1, :1], y[:1, :1])[0][0, i] for i in range(4)]))


def test_a_row_with_nan_touches_no_other():
    land, x, y = hills(3), random(3, 2, seed=5), 1.0 + random(3, 2, seed=6)
    lost = x.clone()
    lost[1] = torch.tensor([torch.nan, torch.inf])
    for good, bad in zip(land(x, y), land(lost, y), strict=True):
        assert torch.equal(good[[0, 2]], bad[[0, 2]])
    assert land(lost, y)[0][1].isnan().all()


HEIGHTS = [[[0.0, 0.0]] * 2, torch.zeros(2, 2, dtype=torch.int64), torch.zeros(3), torch.zeros(2, 1)]
WRONG = [
    *({"heights": x} for x in (*HEIGHTS, torch.tensor([[0.0, torch.nan], [0.0, 0.0]]))),
    *({"spacing": x} for x in (0.0, "1")),
    *({"origin": x} for x in (1.0, (1.0, 2.0, 3.0), (1.0, torch.inf))),
]


@pytest.mark.parametrize("wrong", WRONG, ids=str)
def test_a_map_that_is_none_is_refused(wrong):
    with refused((ArgumentError, DtypeError)):
        effects.HeightMap(**{"heights": torch.zeros(2, 2), "spacing": 0.1, **wrong})


def test_maps_of_another_number_than_the_robots_are_refused():
    with refused(ArgumentError):
        ground(hills(3)).start(torch.zeros(2, 0))


# --- contact ---------------------------------------------------------------------------------------------------------

BALL = '<collision><geometry><sphere radius="0.1"/></geometry></collision>'
SADDLE = 0.4  # of the height a x y, whose interpolation is exact


def ball():
    """A body that flies freely, with a sphere that touches."""
    return Robot.from_urdf(f'<robot name="one">{link("ball", xyz=(0, 0, 0), more=BALL)}</robot>', base="floating")


def saddle(scale=SADDLE, **more):
    """A map of the heights a x y."""
    at = torch.linspace(-2.0, 2.0, 9, dtype=F64)
    return effects.HeightMap(scale * at * at[:, None], 0.5, (-2.0, -2.0))


def recorded_saddle(x, y):
    """Ground of `saddle` as a recorded function."""
    return SADDLE * x * y


def thrown(scene, steps=60, rows=4, **more):
    """Ball that was thrown onto the ground."""
    at = random(rows, 3, seed=7) * torch.tensor([0.5, 0.5, 0.02]) + torch.tensor([0.0, 0.0, 0.2])
    X = dq.from_pose(torch.tensor([1.0, 0, 0, 0], dtype=F64).expand(rows, 4), at)
    V = random(rows, 6, seed=8)
    start = scene.start(torch.zeros(rows, 0, dtype=F64), X_WB=X, V_WB_B=V)
    return scene.replace(backend="auto").rollout(start, steps=steps, **more)


def ground(surface, robot=None, **more):
    """Scene of the ball on a ground."""
    contact = effects.Contact("ball", **{"surface": surface, "stiffness": 2e3, **more})
    return Scene(robot or ball(), (effects.Gravity(), contact), dt=0.005)


@pytest.mark.parametrize("stiction", thinned([True, False], [True]))
def test_a_ball_rolls_on_a_map_as_on_the_same_ground(stiction):
    on_map, on_ground = (ground(surface, stiction=stiction) for surface in (saddle(), recorded_saddle))
    found, expected = thrown(on_map), thrown(on_ground)
    contacts = on_map.contacts(found)
    assert contacts.touching[-1].any()
    for a, b in zip((*found, *contacts), (*expected, *on_ground.contacts(expected)), strict=True):
        assert a is b is None or torch.allclose(a.double(), b.double(), rtol=0, atol=1e-9)


def test_rough_ground_gives_no_energy():
    """A ball that bounces over edges of the ground never flies with more energy than in a flight before."""
    heights = 0.2 * torch.rand(30, 30, dtype=F64, generator=torch.Generator().manual_seed(0))
    scene = ground(effects.HeightMap(heights, 0.1, (-1.5, -1.5)), stiffness=3e4)
    path = thrown(scene, steps=300, rows=24)
    flies = scene.contacts(path).depth[..., 0] <= 0
    energy = scene.energy(path).sum(-1)
    least = energy.where(flies, torch.inf).cummin(0).values
    assert flies.any() and (energy - least)[flies].max() < 1e-3


def test_gradients_of_a_rollout_flow_to_the_heights():
    land, direction = saddle(), random(9, 9, seed=9)

    def far(scale):
        heights = land.heights + scale * direction
        scene = ground(effects.HeightMap(heights, 0.5, (-2.0, -2.0)))
        return dq.translation(thrown(scene, steps=40, checkpoint=10).X_WB[-1]).square().sum()

    x, h = torch.zeros((), dtype=F64, requires_grad=True), 1e-6
    (slope,) = torch.autograd.grad(far(x), x)
    assert torch.isclose(slope, (far(h) - far(-h)) / (2 * h), rtol=1e-6)
    assert slope.abs() > 1e-3


def test_robots_on_maps_of_their_own_are_those_alone():
    scales = torch.tensor([0.2, 0.4, -0.3, 0.0], dtype=F64)
    many = ground(effects.HeightMap(scales[:, None, None] * saddle(1.0).heights, 0.5, (-2.0, -2.0)))
    found = thrown(many)
    for i, scale in enumerate(scales.tolist()):
        alone = ground(saddle(scale))
        assert alone.spec is many.spec  # one program for all maps
        assert torch.equal(thrown(alone).X_WB[:, i], found.X_WB[:, i])


def test_maps_serve_several_contacts_substeps_and_repeated_steps():
    """Planes are held over a step, whatever takes it."""
    slide = '<joint name="j" type="prismatic"><parent link="lower"/><child link="other"/></joint>'
    robot = Robot.from_urdf(also(link("other", 0.1) + slide))
    slope = effects.HeightMap(torch.tensor([[0.0, 0.5], [1.0, 1.5]], dtype=F64) + 0.55, 1.0)  # a plane
    normal = torch.tensor([-0.5, -1.0, 1.0], dtype=F64) / 1.5
    on_map, on_plane = (
        [effects.Contact("lower", **ground), effects.Contact(ContactPoint("other"), friction=0.1, **ground)]
        for ground in ({"surface": slope}, {"height": 0.55 / 1.5, "normal": normal})
    )
    q = torch.tensor([0.3, -0.2, 0.1], dtype=F64).expand(2, 3)

    def after(contacts, **how):
        scene = Scene(robot, (effects.Gravity(), effects.Viscous(1.0), *contacts), dt=0.02, **how)
        return scene.rollout(scene.start(q), steps=4, ends=True)

    for how in ({"substeps": 2}, {"substeps": 2, "unroll": False}):
        a, b = after(on_map, **how), after(on_plane, **how)
        assert a.memory[:, :8].any() and a.memory[:, 8:].any()  # both touch
        assert torch.allclose(a.q, b.q, rtol=0, atol=1e-10) and torch.allclose(a.memory, b.memory, rtol=1e-7, atol=1e-9)


def test_a_residual_sees_the_map():
    """Rows of both are computed before a step, the planes first, in any order of the effects."""
    robot = torchdq.robots.load("two_link")
    land = effects.HeightMap(torch.full((2, 2), 0.1, dtype=F64), 1.0)
    pushed, touched = effects.Residual(lambda q, qd: 0.1 * q), effects.Contact(surface=land, stiffness=100.0)
    q, found = torch.ones(3, 2, dtype=F64), []
    for pair in ((pushed, touched), (touched, pushed)):
        scene = Scene(robot, pair, dt=0.01)
        found.append(scene.step(scene.start(q)).q)
        assert "map of 2 x 2 heights" in str(scene.describe(seconds=0))
    assert torch.allclose(*found, rtol=0, atol=16 * EPS)
