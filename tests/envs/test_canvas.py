"""Images of points: what is nearer covers what is farther, with ink around it."""

import pytest

np = pytest.importorskip("numpy")

from torchdq.envs.canvas import Canvas, spread  # noqa: E402

RED, BLUE, INK = (200, 0, 0), (0, 0, 200), (10, 20, 30)


def square(canvas, middle, half, nearness, colour, light=1.0):
    u, v = spread(4000)
    pixels = np.array(middle) + half * (2.0 * np.stack([u, v], -1) - 1.0)
    canvas.add(pixels, np.full(len(u), nearness), np.full(len(u), light), colour)


def inked(image):
    """Where the colour is about that of the ink."""
    return (np.abs(image[..., :3].astype(int) - INK).sum(-1) < 120) & (image[..., 3] > 100)


def test_what_is_nearer_covers_what_is_farther_in_any_order():
    images = []
    for order in ((0, 1), (1, 0)):
        canvas = Canvas((40, 30))
        for k in order:
            square(canvas, (20, 15), (10, 5)[k], (0.0, 1.0)[k], (RED, BLUE)[k])
        images.append(canvas.image(0.5, -1e3, INK))
    image = images[0]
    assert (image == images[1]).all() and image.shape == (30, 40, 4)
    assert tuple(image[15, 20]) == (*BLUE, 255) and tuple(image[15, 12]) == (*RED, 255)
    assert (image[:, :8, 3] == 0).all() and (image[:3, :, 3] == 0).all()
    assert inked(image)[15, 13:17].any() and inked(image)[15, 7:11].any()  # around both squares
    assert not inked(image)[15, [12, 20]].any()


def test_what_is_below_all_has_no_ink_and_light_makes_bright():
    canvas = Canvas((40, 30))
    square(canvas, (10, 20), 4, -1e3, RED)
    square(canvas, (30, 20), 4, 0.0, RED, light=0.0)
    image = canvas.image(0.5, -10.0, INK)
    assert tuple(image[10, 10]) == (*RED, 255) and 0 < image[10, 30, 0] < 200
    assert not inked(image)[:, :20].any() and inked(image)[:, 20:].any()


def test_points_outside_or_nowhere_are_left_out():
    canvas = Canvas((40, 30))
    far = np.array([[-5.0, 3.0], [90.0, 3.0], [3.0, -5.0], [3.0, 90.0], [np.nan, 3.0], [np.inf, 3.0]])
    canvas.add(far, np.zeros(6), np.ones(6), RED)
    canvas.add(np.array([[20.0, 15.0]]), np.array([np.nan]), np.ones(1), RED)
    assert (canvas.image(0.5, -1e3, INK) == 0).all()
