"""The examples of scenes and environments run, and what they return holds."""

from importlib import import_module

import oracles
import pytest
from helpers import thinned

for needed in ("matplotlib", "rich", "tyro"):
    pytest.importorskip(needed, reason="the examples need the extra 'examples'")
from matplotlib.image import imread  # noqa: E402
from PIL import Image  # noqa: E402

from torchdq.backends import c_library as build  # noqa: E402

# thousands of steps, which take minutes as torch operations
pytestmark = pytest.mark.skipif(build.compiler() is None, reason="there is no C compiler")
BACKEND = "auto"


SOME = ("Gravity", "Viscous", "Coulomb", "Contact", "Noise")  # those in the picture, and a sensor
ALL = (*SOME, "RotorInertia", "Payload", "JointLimits", "Drag", "Saturation", "FirstOrderLag")


@pytest.mark.parametrize("kept", thinned([SOME, ALL], [SOME]), ids=len)
def test_a_scene_is_built_effect_by_effect(kept, tmp_path, capsys, monkeypatch):
    """Every scene on the way is a program of its own, which takes seconds to compile."""
    main = import_module("04_scene")
    monkeypatch.setattr(main, "PARTS", tuple(part for part in main.PARTS if type(part).__name__ in kept))
    assert len(main.PARTS) == len(kept)
    moved, off = main.main(main.Args(duration=0.3, seconds=0.01, out=tmp_path))
    assert list(moved)[1:] == [type(effect).__name__ for effect in main.PARTS]
    assert moved["Gravity"] > 0.1 and moved["Viscous"] > 1e-3
    assert moved["Noise"] < 1e-12  # nobody acts on the readings
    assert off < 0.05
    assert imread(tmp_path / "scene.png")[..., :3].std() > 0.03
    assert "left out" in capsys.readouterr().out


def test_many_arms_reach_and_are_filmed(tmp_path):
    main = import_module("05_environment")
    distance, _ = main.main(main.Args(arms=64, steps=90, out=tmp_path / "new"))
    assert distance.shape == (64,) and float(distance.quantile(0.25)) < 0.01  # some limits and goals stop others
    with Image.open(tmp_path / "new" / "reach.gif") as film:
        assert film.n_frames == 30
    assert imread(tmp_path / "new" / "reach.png")[..., :3].std() > 0.03


def test_arms_wipe_with_the_force_that_is_commanded_and_the_friction_of_the_table(tmp_path, capsys):
    main = import_module("26_wipe")
    found = main.main(main.Args(arms=96, steps=300, out=tmp_path))
    assert found.error.max() < 0.1 and (found.friction - 1).abs().max() < 0.01
    assert found.distance.median() < 1e-3 and found.distance.max() < 5e-3
    assert imread(tmp_path / "wipe.png")[..., :3].std() > 0.03


def test_rollouts_of_which_the_cheap_ones_count_bring_a_tip_to_its_goal(capsys):
    found = import_module("27_mppi").main(import_module("27_mppi").Args(samples=1024, ticks=60))
    assert found.distance < 0.03 and found.tick > 0
    assert "1024 rollouts of 30 steps" in capsys.readouterr().out


def test_a_satellite_moves_the_other_way(tmp_path, capsys):
    main = import_module("12_satellite")
    turn, linear, angular = main.main(main.Args(duration=2.0, step=1e-2, out=tmp_path))
    assert 5 < turn < 15
    assert linear < 1e-5 and angular < 1e-5
    assert imread(tmp_path / "satellite.png")[..., :3].std() > 0.03
    assert "ends 0.0" in capsys.readouterr().out


def test_a_quadruped_stands_on_its_feet(tmp_path, capsys, monkeypatch):
    main = import_module("24_on_feet")
    monkeypatch.setattr(main, "STEPS", {5e-3: main.STEPS[5e-3]})
    found = main.main(main.Args(robot=str(oracles.urdf_paths()["a1"]), out=tmp_path))
    landing, jump, creep = found[5e-3]
    assert 4.0 < landing < 7.0 and 0.3 < jump < 0.8 and creep < 1e-6
    assert imread(tmp_path / "on_feet.png")[..., :3].std() > 0.03
    assert "are stable" in (said := capsys.readouterr().out) and "forces of the feet" in said


def test_a_cat_lands_on_its_feet(tmp_path):
    main = import_module("13_falling_cat")
    turn, momentum = main.main(main.Args(out=tmp_path))
    assert turn > 175 and momentum < 1e-6
    assert imread(tmp_path / "cat.png")[..., :3].std() > 0.03


def test_a_hand_lifts_a_cube(tmp_path, monkeypatch):
    main = import_module("33_hand")
    monkeypatch.setattr(main, "STEPS", {5e-3: main.STEPS[5e-3]})
    force, creep, turn = main.main(main.Args(out=tmp_path))[5e-3]
    spring, weight = 0.5 * 1000.0 * 0.015, 9.81 * 0.1  # of the servo, of which a finger has half
    assert weight / 2 < force < spring and creep < 1e-6 and turn < 0.05
    assert imread(tmp_path / "hand.png")[..., :3].std() > 0.03


def test_a_linkage_swings_with_its_loop_closed(tmp_path):
    main = import_module("37_linkage")
    found = main.main(main.Args(out=tmp_path))
    assert abs(found["RungeKutta4"][0]) < 1e-6 and 0 < found["LinearlyImplicit"][0] < 0.03
    assert all(gap < 1e-6 for _, gap in found.values())
    assert imread(tmp_path / "linkage.png")[..., :3].std() > 0.03
