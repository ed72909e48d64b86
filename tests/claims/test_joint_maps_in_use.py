"""Robots whose joints follow coordinates, in all that uses robots."""

import copy
import pickle

import oracles
import pytest
import torch
from helpers import all_in_one, exhaustive
from messages import refused
from oracles import random_tree
from precisions import eager_first

import torchdq
from torchdq import ArgumentError, Robot, Scene, UnknownNameError, dq, effects
from torchdq.envs import RobotVectorEnv
from torchdq.envs.render import Skeleton
from torchdq.learning import Model, Samples, identify
from torchdq.recommend.recommend import recommend_settings
from torchdq.robot.description import Limits
from torchdq.scene import integrators

F64 = torch.float64
GEARS = {"j2": {"j0": -1.5}, "j4": {"j3": 0.5}, "j5": {"j3": 2.0}}
RATIOS = torch.tensor([[1, 0, 0], [0, 1, 0], [-1.5, 0, 0], [0, 0, 1], [0, 0, 0.5], [0, 0, 2]], dtype=F64)


def double(x):
    return torch.as_tensor(x, dtype=F64)


def rows(n, count=3, seed=0):
    return torch.randn(count, 4, n, dtype=F64, generator=torch.Generator().manual_seed(seed))


def described(n=6, seed=3):
    """Random tree with damping, friction, limits and rotors."""
    k = torch.arange(1.0, n + 1, dtype=F64)
    bound = 2.0 + 0.1 * k
    return random_tree(n, seed).robot.replace(
        damping=0.1 * k, friction=0.05 * k, armature=0.02 * k, limits=Limits(-bound, 1.5 * bound, 4 + k, 30 + k)
    )


def geared():
    return described().couple(GEARS).bake()


# --- couplings -------------------------------------------------------------------------------------------------------


def test_coordinates_inherit_from_the_joints_that_follow_them():
    full, robot = described(), described().couple(GEARS, offset={"j2": 0.25})
    assert robot.joint_names == ("j0", "j1", "j3") and robot.every_joint == full.joint_names
    assert (robot.n, robot.sizes, robot.floating) == (3, {"n": 3, "links": 6, "closures": 0}, False)
    assert torch.allclose(robot.damping, full.damping @ RATIOS.square(), rtol=1e-15)
    assert torch.allclose(robot.armature, full.armature @ RATIOS.square(), rtol=1e-15)
    assert torch.allclose(robot.friction, full.friction @ RATIOS.abs(), rtol=1e-15)
    assert robot.limits.effort.tolist() == full.limits.effort[[0, 1, 3]].tolist()
    motors = full.couple({name: {"motor": 2.0 + i} for i, name in enumerate(full.joint_names)})
    assert motors.limits.effort.tolist() == pytest.approx([sum((2 + i) * (31 + i) for i in range(6))])
    lower, upper, velocity = (x.tolist() for x in full.limits[:3])
    # j2 is at -1.5 z + 0.25
    assert robot.limits.upper[0] == min(upper[0], (lower[2] - 0.25) / -1.5)
    assert robot.limits.lower[0] == max(lower[0], (upper[2] - 0.25) / -1.5)
    assert robot.limits.upper[2] == min(upper[3], upper[4] / 0.5, upper[5] / 2)
    assert robot.limits.velocity[2] == min(velocity[3], velocity[4] / 0.5, velocity[5] / 2)


def test_coordinates_of_coordinates_are_coordinates():
    full, robot = described(), described().couple(GEARS, offset={"j4": 0.1})
    twice = robot.couple({"j3": {"j1": 2.0}}, offset={"j3": -0.3})
    once = full.couple({"j2": {"j0": -1.5}, "j3": {"j1": 2.0}, "j4": {"j1": 1.0}, "j5": {"j1": 4.0}})
    assert twice.joint_names == once.joint_names and torch.equal(twice.joint_map.S, once.joint_map.S)
    assert torch.allclose(twice.damping, once.damping) and torch.allclose(twice.armature, once.armature)
    q = rows(2)[0]
    joints = [q[:, 0], q[:, 1], -1.5 * q[:, 0], 2 * q[:, 1] - 0.3, q[:, 1] - 0.05, 4 * q[:, 1] - 0.6]
    X = (torchdq.forward_kinematics(r, x) for r, x in ((twice, q), (full, torch.stack(joints, -1))))
    assert torch.allclose(*(dq.to_matrix(x) for x in X), rtol=0, atol=1e-13)


def test_a_joint_of_several_coordinates_has_nothing_to_give():
    robot = torchdq.robots.load("two_link")
    S, names = [[0.5, 0.5], [0.5, -0.5]], ["left", "right"]
    assert robot.couple(S, names).damping.tolist() == [0.0, 0.0]
    for name in ("damping", "friction", "armature"):
        rough = robot.replace(**{name: double([0.0, 0.3])})
        with refused(ArgumentError):
            rough.couple(S, names)
        assert getattr(rough.couple(S, names, **{name: [0.1, 0.2]}), name).tolist() == [0.1, 0.2]
    bound = double([1.0, torch.inf])
    limited = robot.replace(limits=robot.limits._replace(upper=bound))
    with refused(ArgumentError):
        limited.couple(S, names)
    chosen = Limits(-bound, bound, bound, bound)
    assert torch.equal(limited.couple(S, names, limits=chosen).limits.upper, bound)
    rows = ([-1.0, -torch.inf], [1.0, torch.inf], [1.0, torch.inf], [1.0, torch.inf])  # four rows without a name
    given = limited.couple(S, names, limits=rows).limits
    assert isinstance(given, Limits) and all(map(torch.equal, given, chosen))
    for wrong in (rows[:3], 1.0, (rows[0][:1], *rows[1:]), ("low", *rows[1:]), (rows[1], rows[0], *rows[2:])):
        with refused(ValueError):
            limited.couple(S, names, limits=wrong)


TWO = torchdq.robots.load("two_link")
ABOVE = TWO.replace(limits=TWO.limits._replace(lower=double([0.1, 0.1]), upper=double([1.0, 1.0])))
REFUSED = [
    lambda: TWO.couple({"joint3": {"joint1": 1.0}}),
    lambda: TWO.couple({"joint2": {"joint1": 1.0}}, offset={"joint3": 1.0}),
    lambda: TWO.couple({"joint2": "joint1"}),
    lambda: TWO.couple({"joint2": {"joint1": torch.nan}}),
    lambda: TWO.couple({"joint2": {"a": 0.0}}),
    lambda: TWO.couple([[1.0, 2.0], [-0.5, -1.0]], ["a", "b"]),
    lambda: TWO.couple([[1e-9, 3e3], [1e-9, 3e3]], ["a", "b"]),
    lambda: torchdq.robots.load("panda").couple({"panda_joint2": {"b": 1.0, "c": 0.5}}, limits=torch.nan),
    *(lambda names=names: TWO.couple([[1.0], [2.0]], names) for names in (None, ["a", "b"], "a")),
    lambda: TWO.couple([[1.0, 0.0], [2.0, 1.0]], ["a", "a"]),
    lambda: TWO.couple([[1.0]], ["a"]),
    lambda: ABOVE.couple({"joint2": {"joint1": -1.0}}),
]


def test_couplings_that_cannot_be_are_refused():
    for k, call in enumerate(REFUSED):
        with refused(UnknownNameError if k < 2 else ArgumentError):
            call()
    assert TWO.couple([[1e-9, 0.0], [0.0, 1e9]], ["a", "b"]).joint_names == ("a", "b")


def test_a_coordinate_is_of_the_kind_of_its_own_joint():
    robot = described()
    slides = [joint.slides and not joint.turns for joint in robot.joint_types]
    turning, sliding = slides.index(False), slides.index(True)
    names = robot.joint_names
    led = robot.couple({names[turning]: {names[sliding]: 2.0}})
    assert not led.joint_types[led.joint_index(names[sliding])].turns
    free = robot.couple({name: {"z": 1.0} for name in names})
    assert free.joint_types == (robot.joint_types[0],)


def test_a_coordinate_that_moves_no_inertia_is_named():
    robot = torchdq.robots.load("two_link")
    light = robot.replace(mass=double([1.0, 0.0]), inertia=robot.inertia * double([[1.0], [0.0]])).bake()
    mapped = light.couple([[1.0, 0.0], [0.0, 1.0]], ["a", "b"])
    z = torch.zeros(2, dtype=F64)
    with refused(torchdq.SingularInertiaError):
        torchdq.forward_dynamics(mapped, z, z, z)
    base = {"base_mass": double(2.0), "base_com": torch.zeros(3, dtype=F64), "base_inertia": double([1, 0, 1, 0, 0, 1])}
    X = torch.eye(8, dtype=F64)[0]
    for inert in (light, mapped):
        learned = inert.replace(com=inert.com.clone())
        with refused(torchdq.SingularInertiaError):
            torchdq.forward_dynamics(learned, z, z, z)
        with refused(torchdq.SingularInertiaError):
            torchdq.floating.forward_dynamics(inert.replace(**base).bake().replace(com=inert.com), X, z, None, None, z)
    tied = robot.couple([[1.0], [1.0]], ["a"])
    assert torchdq.forward_dynamics(tied, z[:1], None, z[:1]).isfinite().all()


def test_a_report_tells_what_joints_follow():
    text = str(geared().report())
    assert "follows -1.5 j0" in text and "follows 0.5 j3" in text and "3 joints that move 6 links" in text
    left = torchdq.robots.load("two_link").couple([[0.5, 0.5], [0.5, -0.5]], ["joint1", "joint2"])
    assert "follows 0.5 joint1 + -0.5 joint2" in str(left.report())


def test_copies_and_batches_are_the_robot():
    robot, (q, qd, qdd) = geared(), rows(3)
    tau = torchdq.inverse_dynamics(robot, q, qd, qdd)
    for same in (pickle.loads(pickle.dumps(robot)), copy.deepcopy(robot), robot.to("cpu"), robot.replace(name="b")):
        assert torch.equal(torchdq.inverse_dynamics(same, q, qd, qdd), tau)
    single = [x.float() for x in (q, qd, qdd)]
    near = torchdq.inverse_dynamics(robot.to(torch.float32), *single)
    assert near.dtype == torch.float32 and torch.allclose(near.double(), tau, rtol=1e-3, atol=1e-3)
    heavy = robot.replace(mass=2 * robot.mass)
    both = Robot.stack([robot, heavy])
    found = torchdq.inverse_dynamics(both, *(x[:, None] for x in (q, qd, qdd)))
    assert torch.allclose(found[:, 0], tau, rtol=1e-12, atol=1e-12)
    assert torch.allclose(found[:, 1], torchdq.inverse_dynamics(heavy, q, qd, qdd), rtol=1e-12, atol=1e-12)
    other = described().couple({**GEARS, "j2": {"j0": -1.0}}).bake()
    assert not torch.allclose(torchdq.inverse_dynamics(other, q, qd, qdd), tau)
    with refused(ArgumentError):
        Robot.stack([robot, other])


@all_in_one(["X_PB_home", "home", "inertia", "gravity", "armature"])
def test_tensors_that_are_replaced_are_those_of_the_robot(name):
    robot, (q, qd, qdd) = geared(), rows(3)
    same = robot.replace(**{name: getattr(robot, name).clone()})
    for function in (torchdq.inverse_dynamics, torchdq.forward_dynamics):
        found, expected = (function(x, q, qd, qdd) for x in (same, robot))
        assert torch.allclose(found, expected, rtol=1e-10, atol=1e-10 * float(expected.abs().max()))


@eager_first
def test_a_batch_of_robots_is_each_of_them(backend):
    robot, (q, qd, qdd) = geared(), rows(3)
    scale = double([[1.0], [0.5], [2.0], [3.0]])
    changes = {"mass": scale * robot.mass, "armature": scale * robot.armature}
    changes["inertia"] = scale[..., None] * robot.inertia
    batch = robot.replace(**changes)
    for function in (torchdq.inverse_dynamics, torchdq.forward_dynamics):
        found = function(batch, q, qd, qdd, backend=backend)
        for i in range(4):
            alone = robot.replace(**{name: x[i] for name, x in changes.items()}).bake()
            expected = function(alone, q[i], qd[i], qdd[i], backend="eager")
            assert torch.allclose(found[i], expected, rtol=1e-9, atol=1e-10 * float(expected.abs().max()))


# --- scenes ----------------------------------------------------------------------------------------------------------

STEP = 1e-3
SHARED = {
    "model": (effects.Gravity(), effects.RotorInertia(), effects.Payload(0.7, (0.1, 0.0, 0.2))),
    "bodies": (effects.MassScale(torch.linspace(0.5, 2, 6, dtype=F64)), effects.Drag(0.5, 0.2, 0.1)),
    "touch": (effects.Gravity(), effects.Contact(height=5.0, stiffness=10.0), effects.Push()),
    "friction": (effects.Viscous(),),
}


def accelerations(scene, q, qd, torque, inputs):
    state = scene.step(scene.start(q, qd), torque, **inputs)
    return (state.qd - qd) / STEP


@pytest.mark.parametrize("group", SHARED)
def test_a_scene_moves_as_the_full_robot_that_is_held_to_the_map(group):
    """The joints' torques that hold the full robot to the map do no work on the coordinates (d'Alembert)."""
    euler = integrators.LinearlyImplicit() if group == "touch" else integrators.ExplicitEuler()
    parts, euler = SHARED[group], {"integrator": euler, "dt": STEP}
    full, robot = Scene(described(), parts, **euler), Scene(geared(), parts, **euler)
    z, zd, torque = rows(3)
    inputs = {"push": rows(6)[0]} if group == "touch" else {}
    found = accelerations(robot, z, zd, torque, inputs)
    q, qd = z @ RATIOS.T, zd @ RATIOS.T
    free = accelerations(full, q, qd, torch.zeros(6, dtype=F64), inputs)
    W = torch.stack([accelerations(full, q, qd, unit, inputs) - free for unit in torch.eye(6, dtype=F64)], -1)
    holding = torch.linalg.solve(W, found @ RATIOS.T - free)
    assert torch.allclose(holding @ RATIOS, torque, rtol=0, atol=1e-8 * float(holding.abs().max()))
    plain = accelerations(Scene(geared(), (), **euler), z, zd, torque, {})
    assert not torch.allclose(found, plain, rtol=1e-2)


ORDER = [2, 0, 1]
PER_JOINT = {
    "friction": lambda p: (effects.Gravity(), effects.Coulomb(), effects.Viscous(), effects.RotorInertia()),
    "limits": lambda p: (effects.Gravity(), effects.JointLimits(), effects.Saturation(), effects.TorqueSpeed()),
    "servo": lambda p: (
        effects.Servo(double([50.0, 40.0, 30.0])[p], double([5.0, 4.0, 3.0])[p]),
        effects.FirstOrderLag(0.02),
    ),
    "elastic": lambda p: (effects.Elastic(double([9e3, 8e3, 7e3])[p], double([0.1, 0.2, 0.3])[p]),),
    "residual": lambda p: (effects.Residual(lambda q, qd: 0.3 * q - 0.2 * qd), effects.Spring(2.0)),
}


@pytest.mark.parametrize("group", PER_JOINT)
def test_a_map_that_renumbers_the_joints_changes_nothing(group):
    full = described(3)
    P = torch.eye(3, dtype=F64)[:, ORDER]  # joint j follows the coordinate whose place in ORDER is that of j
    robot = full.couple(P.tolist(), [f"z{i}" for i in ORDER])
    parts = PER_JOINT[group]
    plain, mapped = (Scene(r, parts(p), dt=0.005) for r, p in ((full, [0, 1, 2]), (robot, ORDER)))
    z, zd, torque = rows(3)
    extra = {"target": rows(3, 1, 5)[0]} if group == "servo" else {}
    a, b = plain.start(z, zd), mapped.start(z[..., ORDER], zd[..., ORDER])
    for _ in range(5):
        a = plain.step(a, torque, **extra)
        b = mapped.step(b, torque[..., ORDER], **{name: x[..., ORDER] for name, x in extra.items()})
    assert torch.allclose(a.q[..., ORDER], b.q, rtol=1e-10, atol=1e-11)
    assert torch.allclose(a.qd[..., ORDER], b.qd, rtol=1e-9, atol=1e-10)
    assert torch.allclose(plain.energy(a), mapped.energy(b), rtol=1e-9, atol=1e-9)


def test_a_held_payload_is_one_of_the_scene():
    held, (z, zd, torque) = geared().with_payload(0.7, [0.1, 0.0, 0.2], [0.02, 0, 0.02, 0, 0, 0.02]), rows(3)
    payload = effects.Payload(0.7, (0.1, 0.0, 0.2), (0.02, 0, 0.02, 0, 0, 0.02))
    scenes = Scene(held, (effects.Gravity(),)), Scene(geared(), (effects.Gravity(), payload))
    ours, theirs = (scene.step(scene.start(z, zd), torque) for scene in scenes)
    assert torch.allclose(ours.qd, theirs.qd, rtol=1e-10, atol=1e-12)


def test_gears_do_not_push_a_free_body():
    """The torques that make joints follow act within the robot, and so do those of its friction: momenta stay."""
    base = {"base_mass": 3.0, "base_com": [0.1, 0, 0.2], "base_inertia": [0.3, 0, 0.4, 0, 0, 0.5]}
    robot = geared().replace(**{name: double(x) for name, x in base.items()}, armature=None).bake()
    scene = Scene(robot, (effects.Viscous(), effects.JointLimits()), integrator=integrators.RungeKutta4(), dt=0.002)
    z, zd, torque = 0.3 * rows(3)
    state = scene.start(z, zd, X_WB=dq.exp(rows(6)[0]), V_WB_B=rows(6)[1])
    before = torchdq.floating.momentum(robot, state.X_WB, state.q, state.V_WB_B, state.qd)
    for _ in range(8):
        state = scene.step(state, torque)
    after = torchdq.floating.momentum(robot, state.X_WB, state.q, state.V_WB_B, state.qd)
    for a, b in zip(before, after, strict=True):
        assert torch.allclose(a, b, rtol=1e-6, atol=1e-6)
    assert not torch.allclose(state.q, z, atol=5e-3)


@pytest.mark.parametrize(
    "integrator, drift",
    [
        (integrators.RungeKutta4(), 1e-8),
        pytest.param(integrators.StoermerVerlet(), 1e-3, marks=exhaustive),
        pytest.param(integrators.DormandPrince(), 1e-8, marks=exhaustive),
        (integrators.SemiImplicitEuler(), 0.1),
    ],
    ids=lambda x: type(x).__name__,
)
def test_energy_is_kept(integrator, drift):
    scene = Scene(geared(), (effects.Gravity(), effects.RotorInertia()), integrator=integrator, dt=0.002)
    state = scene.start(0.3 * rows(3)[0])
    before = scene.energy(state).sum(-1)
    after = scene.energy(scene.rollout(state, steps=20)).sum(-1)[-1]
    assert float((after - before).abs().max()) < drift


def test_scenes_are_linearized_checked_and_described():
    scene = Scene(geared(), (effects.Gravity(), effects.Viscous(), effects.JointLimits()), dt=0.005)
    state = scene.start(0.1 * rows(3)[0])
    A, B = scene.linearize(state)
    assert A.shape == (4, 6, 6) and B.shape == (4, 6, 3)
    assert scene.check(state, 0.05).stable
    assert "dry friction of j0, j1, j3" in str(scene.describe(seconds=0))
    step = torch.zeros(3, dtype=F64)
    step[1] = 1e-6
    slope = (scene.step(state, step).qd - scene.step(state, -step).qd) / 2e-6
    assert torch.allclose(slope, B[:, 3:, 1], rtol=1e-5, atol=1e-8)


# --- layers and learning ---------------------------------------------------------------------------------------------


def test_layers_learn_what_a_robot_has():
    robot, (q, qd, qdd) = geared(), rows(3)
    bare = robot.replace(armature=None, friction=0 * robot.friction, damping=0 * robot.damping)
    layer = torchdq.DQRNEA(bare, learn=("mass", "com", "inertia"))
    assert torch.allclose(layer(q, qd, qdd), torchdq.inverse_dynamics(bare, q, qd, qdd), rtol=1e-10, atol=1e-9)
    heavy = torchdq.inverse_dynamics(bare.replace(mass=1.5 * bare.mass, inertia=1.5 * bare.inertia), q, qd, qdd)
    optimiser, losses = torch.optim.LBFGS(layer.parameters(), max_iter=10, line_search_fn="strong_wolfe"), []

    def loss():
        optimiser.zero_grad()
        losses.append((layer(q, qd, qdd) - heavy).square().mean())
        losses[-1].backward()
        return losses[-1]

    optimiser.step(loss)
    assert losses[-1] < 1e-2 * losses[0]
    for learn in (("armature", "friction", "offset"), ("X_PB_home", "screw", "home")):
        layer = torchdq.DQRNEA(robot, learn=learn)
        layer(q, qd, qdd).square().sum().backward()
        assert all(p.grad is not None and bool(p.grad.isfinite().all()) for p in layer.parameters())


def test_layers_of_accelerations_and_of_control():
    robot, (q, qd, qdd) = geared(), rows(3)
    forward = torchdq.ForwardDynamics(robot, learn=("mass", "armature"))
    tau = torchdq.DQRNEA(robot)(q, qd, qdd)
    assert torch.allclose(torchdq.ForwardDynamics(robot)(q, qd, tau), qdd, rtol=1e-8, atol=1e-8)
    forward(q, qd, tau).square().sum().backward()
    assert all(p.grad is not None for p in forward.parameters())
    kp, kd = double([10.0, 20.0, 30.0]), double([1.0, 2.0, 3.0])
    control = torchdq.ComputedTorque(robot, kp, kd, friction=False)
    wanted = rows(3, 3, 7)
    a = wanted[2] + kp * (wanted[0] - q) + kd * (wanted[1] - qd)
    found = control(q, qd, *wanted)
    assert torch.allclose(found, torchdq.inverse_dynamics(robot, q, qd, a), rtol=1e-10, atol=1e-9)


def test_a_residual_learns_beside_a_robot_with_a_map():
    robot, (q, qd, qdd) = geared(), rows(3)
    model = torchdq.ResidualDynamics(torchdq.DQRNEA(robot))
    model(q, qd, qdd).square().sum().backward()
    scene = Scene(robot, model.effects(), dt=0.005)
    assert scene.step(scene.start(q, qd), qdd).q.isfinite().all()


def test_a_log_of_a_geared_robot_identifies_it():
    robot, model = geared(), Model((effects.Viscous(), effects.Coulomb()), armature=True)
    real = robot.replace(mass=1.2 * robot.mass, armature=1.5 * robot.armature).bake()
    q, qd, qdd, more = torch.randn(4, 300, 3, dtype=F64, generator=torch.Generator().manual_seed(0))
    tau = torchdq.inverse_dynamics(real, q, qd, qdd) + 0.3 * qd
    found = identify(robot, Samples(q, qd, qdd, tau), model, prior=1.0)
    assert len(found.parameters) == 60 + 9 and found.names[0] == "b0 m" and found.names[-1] == "j3 coulomb"
    assert torch.allclose(found.viscous, double([0.3] * 3), rtol=1e-2)
    predicted, expected = found.predict(more, q, qd).tau, torchdq.inverse_dynamics(real, more, q, qd) + 0.3 * q
    assert float((predicted - expected).abs().max()) < 1e-3 * float(expected.abs().max())
    assert found.robot.joint_map is not None and found.robot.joint_names == robot.joint_names


# --- environments ----------------------------------------------------------------------------------------------------


def gripper() -> Robot:
    """Panda whose second finger follows the first."""
    hand = Robot.from_urdf(oracles.urdf_paths()["panda"], tip="panda_rightfinger")
    if hand.joint_map is None:
        hand = hand.couple({"panda_finger_joint2": {"panda_finger_joint1": 1.0}})
    assert hand.n == 8 and len(hand.link_names) == 9
    return hand.bake()


def test_an_environment_of_a_mimic_gripper():
    robot = gripper()
    envs = RobotVectorEnv(3, "reach", robot, randomise={"mass": (0.8, 1.2)}, render_mode="rgb_array", dtype=F64)
    envs.reset(seed=0)
    for _ in range(3):
        seen, reward, *_ = envs.step(torch.zeros(3, 8, dtype=F64))
    assert seen.isfinite().all() and reward.isfinite().all()
    state = envs.get_state()
    tip = dq.translation(torchdq.forward_kinematics(robot, state["q"], robot.tip))
    assert torch.allclose(seen[..., -3:], tip, rtol=1e-9, atol=1e-9)
    assert [picture.shape for picture in envs.render()] == [(400, 400, 3)] * 3
    tracking = RobotVectorEnv(2, "track", robot)
    tracking.reset(seed=0)
    assert tracking.step(torch.zeros(2, 8))[1].isfinite().all()


def test_fingers_are_drawn_where_they_are():
    robot, q = gripper(), torch.zeros(8, dtype=F64)
    q[7] = 0.03
    points = Skeleton(robot).points(q)
    for finger in ("panda_leftfinger", "panda_rightfinger"):
        at = dq.translation(torchdq.forward_kinematics(robot, q, finger)).numpy()
        assert abs(points - at).sum(-1).min() < 1e-9


@exhaustive
def test_recommendations_are_made():
    assert recommend_settings(described(3).couple({"j2": {"j0": -1.5}}).bake(), 1e-2, 0.1).error <= 1e-2


def test_a_coupling_by_hand_is_that_of_the_file():
    path = oracles.urdf_paths()["panda"]
    read = Robot.from_urdf(path)
    made = Robot.from_urdf(path, mimic="independent").couple({"panda_finger_joint2": {"panda_finger_joint1": 1.0}})
    assert made.joint_names == read.joint_names and made.every_joint == read.every_joint
    pairs = [(made.joint_map.S, read.joint_map.S), *zip(made.limits, read.limits, strict=True)]
    assert all(torch.equal(a, b) for a, b in [*pairs, (made.damping, read.damping), (made.friction, read.friction)])
