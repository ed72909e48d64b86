"""The examples run, and what they return holds.

The recordings are not part of the package. Their tests look in the folder that TORCHDQ_DATA names, or beside the
checkout, and are skipped where there are none.
"""

import runpy
import shutil
import sys
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import torch
from places import DATA, ROOT

import torchdq
from torchdq.envs import Actions, RobotVectorEnv
from torchdq.learning import read_log

EXAMPLES = ROOT / "examples"

for needed in ("matplotlib", "pytorch_kinematics", "rich", "scipy", "tyro"):
    pytest.importorskip(needed, reason="the examples need the extra 'examples'")
from matplotlib.image import imread  # noqa: E402
from PIL import Image  # noqa: E402
from rich.console import Console  # noqa: E402

BACKEND = "auto"


def assert_drawn(path: Path) -> None:
    picture = imread(path)[..., :3]
    assert picture.shape[0] > 500 and picture.shape[1] > 900
    assert picture.std() > 0.03, f"{path.name} is blank"


# --- the examples ----------------------------------------------------------------------------------------------------


def test_inverse_dynamics(tmp_path, capsys):
    main = import_module("01_inverse_dynamics")
    checks = main.main(main.Args(batch=64, step=2.5e-3, timing=1e-3, out=tmp_path))
    assert len(checks) == 15
    failed = {name: check for name, check in checks.items() if not check.passed}
    assert not failed
    assert checks["torques, float64"].value < 1e-12
    assert checks["tracking error of the two-link arm against the analytic decay"].value < 1e-9
    assert_drawn(tmp_path / "torques.png")
    assert_drawn(tmp_path / "tracking.png")
    printed = capsys.readouterr().out
    assert "xarm7" in printed or "UF_ROBOT" in printed
    assert "FAIL" not in printed


def test_a_failed_check_is_the_exit_status(tmp_path, capsys, monkeypatch):
    script = EXAMPLES / "01_inverse_dynamics.py"
    options = ["--batch", "8", "--timing", "0", "--step", "0.1", "--out", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", [str(script), *options])
    with pytest.raises(SystemExit) as stop:
        runpy.run_path(str(script), run_name="__main__")
    assert stop.value.code == 1
    assert "FAIL  tracking error of the two-link arm" in capsys.readouterr().out


def test_a_bad_log_ends_the_program_before_the_work(tmp_path, capsys, monkeypatch):
    script = EXAMPLES / "01_inverse_dynamics.py"
    monkeypatch.setattr(sys, "argv", [str(script), "--log", str(tmp_path / "missing.csv"), "--out", str(tmp_path)])
    with pytest.raises(SystemExit, match=r"missing\.csv"):
        runpy.run_path(str(script), run_name="__main__")
    assert not capsys.readouterr().out


def test_an_own_urdf(tmp_path, capsys):
    module = import_module("20_own_urdf")
    found = module.main(module.Args(batch=100, out=tmp_path))
    assert len(found) == 4 and max(found.values()) < 1e-13
    assert "a kilogram more in 'wrist_3' adds most" in capsys.readouterr().out
    assert_drawn(tmp_path / "own_urdf.png")


def test_an_own_urdf_with_wrong_torques_is_noticed(tmp_path, monkeypatch):
    module = import_module("20_own_urdf")
    right = torchdq.inverse_dynamics
    monkeypatch.setattr(torchdq, "inverse_dynamics", lambda *x: right(*x) + 1e-3)
    found = module.checks(torchdq.Robot.from_urdf(module.ARM), module.ARM, 10)
    assert sum(error > 1e-6 for error in found.values()) == 3  # all but the mass matrix


def test_closed_form(capsys):
    assert import_module("02_closed_form").main() < 1e-13
    assert "Jt2 tz" in capsys.readouterr().out


def test_computed_torque(tmp_path):
    module = import_module("03_computed_torque")
    right, wrong = module.main(module.Args(duration=0.5, out=tmp_path))
    analytic = 0.1 * (1 + 10 * 0.5) * np.exp(-10 * 0.5)
    assert abs(right - analytic) < 1e-6
    assert wrong > 5 * right
    assert_drawn(tmp_path / "computed_torque.png")


def test_a_circle_through_a_singular_wrist(tmp_path):
    module = import_module("28_circle")
    found = module.main(module.Args(seconds=2.0, out=tmp_path))
    for name, singular in (("panda", False), ("ur10e", True)):
        x, late = found[name], found[name]["time"] > 0.5
        assert x["position"][late].square().mean().sqrt() < 5e-5
        assert (x["manipulability"].min() < 1e-4 * x["manipulability"].max()) == singular
        assert x["torque"].abs().max() < 330.0  # that of the shoulder
    assert_drawn(tmp_path / "circle.png")


def test_an_arm_yields_to_a_hand_and_tells_its_force(tmp_path):
    module = import_module("29_hand_guided")
    _, moved, found = module.main(module.Args(stiffness=400.0, out=tmp_path))
    assert moved[1900].tolist() == pytest.approx([0.0, module.FORCE / 400.0, 0.0], abs=2e-4)
    assert found[1900].tolist() == pytest.approx([0.0, module.FORCE, 0.0], abs=0.05)
    assert moved[-1].norm() < 1e-4 and found[-1].norm() < 1e-3
    assert_drawn(tmp_path / "hand_guided.png")


def test_two_arms_hold_one_object(tmp_path):
    module = import_module("30_two_arms")
    relative, absolute = module.main(module.Args(seconds=4.0, out=tmp_path))
    assert relative.norm(dim=-1).max() < 0.01 and absolute.norm(dim=-1).max() < 0.02
    assert_drawn(tmp_path / "two_arms.png")


def test_a_plan_leads_around_a_post(tmp_path):
    module = import_module("38_plan")
    found = module.main(module.Args(out=tmp_path))
    assert found.plan.converged and found.distance.min() > 0.015 > found.struck.min()
    assert (found.plan.torque.abs() <= module.ROBOT.limits.effort).all()
    gains, blind = found.missed
    assert gains < 0.04 < 0.2 < blind
    assert_drawn(tmp_path / "plan.png")


def test_an_arm_with_delays_and_a_load_is_controlled_by_plans_and_their_gains(tmp_path):
    module = import_module("39_receding")
    found = module.main(module.Args(seconds=1.0, out=tmp_path))
    near = {name: x.distance.chunk(2)[0][-100:].mean() for name, x in found.items()}
    assert near["gains"] < 0.025 < near["torques held"] < 0.05
    assert_drawn(tmp_path / "receding.png")


def test_real_time(tmp_path, capsys):
    module = import_module("15_real_time")
    if shutil.which("cc") is None:
        pytest.skip("no C compiler cc")
    found = module.main(module.Args(seconds=0.5, out=tmp_path))
    assert found.deviation < 1e-7
    assert found.error < found.error_described / 30
    assert len(found.late) == len(found.computed) == 500 and (found.late >= 0).all() and (found.computed > 0).all()
    assert "computation time [us]: median" in capsys.readouterr().out
    assert_drawn(tmp_path / "real_time.png")


def test_what_to_record(tmp_path, capsys):
    module = import_module("19_what_to_record")
    found = module.main(module.Args(seconds=10.0, quick=True, out=tmp_path))
    assert 0.3 < found.chi_square < 1.6  # a prior at the description makes it less than one
    assert found.gain > 1.5
    assert len(found.drawn.parameters) == 10 and float(found.spread[-1].max()) > 1e-3
    assert read_log(tmp_path / "motion.csv").q.shape == (10_001, 7)
    assert "panda_joint7 coulomb" in capsys.readouterr().out
    assert_drawn(tmp_path / "motion.png")
    assert_drawn(tmp_path / "possible_arms.png")


def test_positions_only(tmp_path, capsys):
    module = import_module("16_positions_only")
    module.prepare()
    found, true, before, after = module.main(module.Args(quick=True, out=tmp_path))
    z = (found.estimate - true) / found.covariance.diagonal().sqrt()
    assert float(z.abs().max()) < 4 and float(z.square().mean()) < 2
    assert not found.unidentifiable and not found.warning
    assert float(after.max()) < 5 * module.NOISE < 1e-3 < float(before.mean())
    assert "Payload.mass" in capsys.readouterr().out
    assert_drawn(tmp_path / "positions_only.png")


def test_a_thousand_arms(tmp_path):
    module = import_module("00_a_thousand_arms")
    path, error = module.main(module.Args(arms=30, frames=3, step=4e-3, out=tmp_path))
    with Image.open(path) as film:
        assert film.n_frames == 3 and film.size == (960, 440)
        picture = np.asarray(film.convert("RGBA"))
    assert not picture[0, 0, 3] and picture[220, 480, 3] == 255  # round corners, on pages of any colour
    assert picture[..., :3].std() > 10
    assert error < 0.3


def test_walk_ppo(tmp_path, capsys):
    """A second is enough to learn something; that a policy walks is held by envs/test_walk.py."""
    module = import_module("21_walk_ppo")
    assert module.main(module.Args(seconds=1.0, robots=32, turning=1.0, out=tmp_path)) is None
    policy = import_module("23_policy_in_mujoco").policy_of(tmp_path / "walk.pt")
    assert policy(torch.zeros(5, 48)).shape == (5, 12)
    assert "at the end: " in capsys.readouterr().out


def test_ppo_learns_in_any_vector_environment():
    module = import_module("21_walk_ppo")
    learner = module.PPO(RobotVectorEnv(128, "reach", "two_link", action=Actions(scale=0.5)), seed=0)
    reward = []
    for _ in range(60):
        samples, means = learner.rollout()
        learner.update(samples)
        reward.append(means["reward"])
    assert sum(reward[-10:]) > sum(reward[10:20]) + 4.0  # a policy that does not learn stays within 2


def test_hands_learn_and_act_in_mujoco(tmp_path, capsys):
    """A second is enough to learn something; that policies do their task is held by envs/test_manipulation.py."""
    module, play = import_module("31_hands_ppo"), import_module("32_hands_in_mujoco")
    assert module.main(module.Args(task="push", seconds=1.0, robots=32, out=tmp_path)) is None
    shares = play.main(play.Args(task="push", policy=EXAMPLES / "hands_push.pt", runs=4))
    assert set(shares) == {"here", *play.CONES} and min(shares.values()) > 0.5
    assert "not learned yet" in capsys.readouterr().out
    ball = {"task": "lift", "object": "ball", "size": (0.02,)}
    assert module.main(module.Args(**ball, seconds=1.0, robots=32, out=tmp_path)) is None
    assert set(play.main(play.Args(**ball, policy=tmp_path / "lift.pt", runs=2))) == {"here", *play.CONES}


def test_a_hand_learns_to_turn_a_cube(tmp_path, capsys):
    """A second is enough to learn something; that a policy turns the cube is held by envs/test_turn.py."""
    main = import_module("34_turn")
    shares = main.main(main.Args(seconds=1.0, robots=32, runs=2, out=tmp_path))
    assert set(shares) == {"here", *main.play.CONES}
    again = main.main(main.Args(policy=tmp_path / "turn.pt", runs=1))
    assert again["here"] == shares["here"]
    assert "not learned yet" in capsys.readouterr().out


def test_hands_learn_from_gradients(tmp_path, capsys):
    """Gradients reach the policy through the grasp and change it; a second is too short to learn more."""
    module = import_module("35_hands_shac")
    policy, best = module.main(module.Args(task="lift", seconds=1.0, robots=32, out=tmp_path))
    assert best < 0.5 and "succeed" in capsys.readouterr().out
    new = import_module("21_walk_ppo").network(46, 8, 0.1, torch.nn.ELU())
    new.load_state_dict(torch.load(tmp_path / "lift.pt"))
    assert all(x.isfinite().all() for x in policy.actor.parameters())
    assert policy.actor[0].bias.grad.norm() > 0


def test_a_long_or_broken_gradient_is_bounded():
    module = import_module("35_hands_shac")
    found = module.bounded(torch.tensor([[3.0, 4.0], [float("nan"), 1.0], [1e-5, 0.0]]))
    torch.testing.assert_close(
        found, torch.tensor([[0.6, 0.8], [0.0, 0.0], [1e-5 / module.STEEPEST, 0.0]]) * module.STEEPEST
    )


def test_a_film_of_walking_robots(tmp_path):
    module = import_module("25_walk_film")
    path, fell = module.main(module.Args(policy=EXAMPLES / "go2_walk.pt", robots=12, frames=2, out=tmp_path))
    with Image.open(path) as film:
        assert film.n_frames == 2 and film.size == (960, 400)
        assert np.asarray(film.convert("RGB")).std() > 8
    assert fell == 0


def test_a_film_of_arms_that_pick(tmp_path):
    module = import_module("36_hands_film")
    path, success = module.main(module.Args(policy=EXAMPLES / "hands_pick.pt", arms=5, frames=2, out=tmp_path))
    with Image.open(path) as film:
        assert film.n_frames == 2 and film.size == (960, 400)
        assert np.asarray(film.convert("RGB")).std() > 8
    assert success == 0  # after a tenth of a second


def test_films_of_plans(tmp_path, monkeypatch):
    """Drawn without derivatives, which compile for a minute; plans through contact are tested in tests/optimal."""
    module = import_module("40_plan_film")
    monkeypatch.setattr(module, "METHOD", module.optimal.MPPI(2))
    found = module.main(module.Args(arms=2, iterations=1, frames=2, out=tmp_path))
    assert [film.path.name for film in found] == ["jump.webp", "swing.webp"]
    for film in found:
        with Image.open(film.path) as images:
            assert images.n_frames == 2 and images.size == (960, 400)
            assert np.asarray(images.convert("RGB")).std() > 8
    (jump, swing) = (film.plan for film in found)
    assert len(jump.states.q) == 1 + len(jump.torque) == 295  # both parts
    assert swing.torque.shape == (module.SWING, 2, 2, 7)


def test_walk_shac(tmp_path):
    module = import_module("22_walk_shac")
    walkers = module.Walkers(8, 5e3, module.ppo.Walker())
    policy = module.ppo.Policy(48, 12)
    before = [x.clone() for x in policy.actor.parameters()]
    optimizer = torch.optim.Adam(policy.actor.parameters(), lr=1e-3)
    observation, reward, value, done = module.improve(walkers, policy, policy, optimizer)
    assert observation.shape == (module.Settings.horizon, 8, 48) and reward.shape == value.shape == done.shape
    assert reward.isfinite().all() and all(
        (a != b).any() for a, b in zip(before, policy.actor.parameters(), strict=True)
    )


# --- recordings of real arms -----------------------------------------------------------------------------------------


def explained(tmp_path: Path, sources: tuple[str, ...], test_last: bool) -> tuple[np.ndarray, np.ndarray]:
    for source in sources:
        file = DATA / source.split(":")[0]
        if not file.exists():
            pytest.skip(f"no recording {file}; TORCHDQ_DATA names the folder that holds it")
    main = import_module("01_inverse_dynamics")
    main.prepare()
    read = [main.read_log(str(DATA / source), "auto") for source in sources]
    alone, full, checks = main.explain_logs(Console(), read, test_last, None, tmp_path / "measured.png")
    assert all(check.passed for check in checks.values())
    assert_drawn(tmp_path / "measured.png")
    return alone, full


def test_panda_recording(tmp_path):
    alone, full = explained(tmp_path, ("panda_gaz2019/panda_exciting_traj1.csv",), test_last=False)
    np.testing.assert_allclose(alone, [0.98, 0.998, 0.998, 0.98, 0.90, 0.96, -0.02], atol=0.01)
    np.testing.assert_allclose(full, [0.995, 0.999, 0.999, 0.996, 0.986, 0.991, 0.948], atol=0.01)


def test_ur10e_recordings(tmp_path):
    folder = "ur10e_innopolis/"
    names = (
        "ur-20_02_10-30sec_12harm.csv:635:3510",
        "ur-20_02_12-40sec_12harm.csv:500:4460",
        "ur-20_02_19_14harm50sec.csv",
    )
    alone, full = explained(tmp_path, tuple(folder + name for name in names), test_last=True)
    # the rows behind the stated figures of the model alone are not stated; other halves of the file move them by 0.1
    np.testing.assert_allclose(alone, [0.02, 0.89, 0.86, 0.29, 0.0, -0.01], atol=0.07)
    np.testing.assert_allclose(full, [0.996, 0.990, 0.997, 0.987, 0.984, 0.996], atol=0.01)


def test_a_single_ur10e_recording(tmp_path):
    _, full = explained(tmp_path, ("ur10e_innopolis/ur-20_02_19_14harm50sec.csv",), test_last=False)
    assert (full > 0.97).all()


def test_a_log_with_torques(tmp_path):
    module = import_module("17_log_with_torques")
    result = module.main(module.Args(quick=True, out=tmp_path))
    assert result.after.mean() < 0.1 * result.before.mean() and (result.after < 0.3 * result.before).all()
    assert_drawn(tmp_path / "log_with_torques.png")
    made = sorted(tmp_path.glob("torques_*.csv"))
    again = module.main(module.Args(logs=made[:1], test=made[1], out=tmp_path / "again", columns=module.NAMES))
    np.testing.assert_allclose(again.after, result.after)


def test_a_log_with_currents(tmp_path, capsys):
    module = import_module("18_log_with_currents")
    result = module.main(module.Args(quick=True, out=tmp_path))
    assert result.after.mean() < 0.1 * result.before.mean() and (result.after < 0.3 * result.before).all()
    np.testing.assert_allclose(result.gains[:4], 1, atol=0.02)  # the wrist carries too little to tell its own
    np.testing.assert_allclose(result.gains, 1, atol=0.2)
    assert_drawn(tmp_path / "log_with_currents.png")
    printed = " ".join(capsys.readouterr().out.split())
    assert "if 'current_0' is a motor current" in printed and "ur10e, identified" in printed
