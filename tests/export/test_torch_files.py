"""Graphs and files that torch makes of layers and scenes: torch.compile, torch.export, ONNX, AOTInductor.

Expected values are those of the compiled programs, which other tests hold against Pinocchio and MuJoCo. The C++ program
that loads a file is part of docs/export.md, which test_documents.py runs.
"""

import io
import shutil
import subprocess
import sys
from functools import cache

import pytest
import torch
from helpers import EVERYTHING, exhaustive, fresh, random, thinned  # noqa: F401
from messages import refused
from torch import library as operators
from torch import nn

import torchdq
from torchdq import Scene, effects
from torchdq.backends import c_library as build
from torchdq.envs import Actions, RobotVectorEnv
from torchdq.errors import ArgumentError
from torchdq.program import autograd
from torchdq.scene import State, controllers, integrators

F32, F64 = torch.float32, torch.float64
BACKEND = "auto"  # see conftest.py

pytestmark = [
    pytest.mark.usefixtures("fresh"),
    pytest.mark.skipif(build.compiler() is None, reason="there is no C compiler"),
]

TWO = torchdq.robots.load("two_link")


def distance(found, expected):
    """Largest difference, relative to the largest number of each result."""
    found, expected = ([x] if isinstance(x, torch.Tensor) else list(x) for x in (found, expected))
    assert [x.shape for x in found] == [x.shape for x in expected]
    return max(
        float((x - e).detach().abs().max() / (1 + e.detach().abs().max())) for x, e in zip(found, expected, strict=True)
    )


class Traced(nn.Module):
    """A function as a module, with the modules that it calls."""

    def __init__(self, function, *parts):
        super().__init__()
        self.function, self.parts = function, nn.ModuleList(parts)

    def forward(self, *x):
        return self.function(*x)


def stepped(scene):
    """A step of a scene, from positions and velocities to both."""
    return Traced(lambda q, qd, torque: tuple(scene.step(State(q, qd), torque))[:2])


def rolled(scene, steps=2):
    """Steps of a scene under a policy."""
    policy = nn.Sequential(nn.Linear(2 * scene.n, 8), nn.Tanh(), nn.Linear(8, scene.n)).double()
    return Traced(
        lambda q, qd: scene.rollout(
            State(q, qd), steps=steps, policy=lambda s, k: policy(torch.cat([s.q, s.qd], -1)), nonfinite="ignore"
        ).q[-1],
        policy,
    )


def with_network(robot, **options):
    """A residual network that is not zero, on top of learned physics."""
    layer = torchdq.ResidualDynamics(torchdq.DQRNEA(robot, learn=("mass", "com", "inertia", "friction")), **options)
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for x in layer.network.double().parameters():
            x.normal_(std=0.3, generator=generator)
    return layer


LEARNED = ("mass", "com", "inertia", "armature", "friction", "offset")
FELT = (effects.Gravity(), effects.Viscous(0.1), effects.Coulomb(0.2), effects.Saturation(5.0))
SUBJECTS = {  # module of a robot, and how many inputs [..., n] it takes
    "inverse dynamics": (lambda robot: torchdq.DQRNEA(robot), 3),
    "learned inverse dynamics": (lambda robot: torchdq.DQRNEA(robot, learn=LEARNED), 3),
    "learned forward dynamics": (lambda robot: torchdq.ForwardDynamics(robot, learn=("mass", "friction")), 3),
    "residual network": (with_network, 3),
    "computed torque": (lambda robot: torchdq.ComputedTorque(robot, 25.0, 10.0), 5),
    "computed torque of a network": (lambda robot: torchdq.ComputedTorque(with_network(robot), 25.0, 10.0), 5),
    "closed form": (lambda robot: Traced(lambda q, qd: tuple(torchdq.closed_form(robot, q, qd))), 2),
    "step": (lambda robot: stepped(Scene(robot, FELT)), 3),
    "rollout": (lambda robot: rolled(Scene(robot, FELT)), 2),
}


@cache
def subject(name, robot=TWO):
    make, count = SUBJECTS[name]
    return make(robot).eval(), lambda batch, seed=0: tuple(random(count, batch, robot.n, seed=seed))


@cache
def exported(name, strict=False, robot=TWO):
    """Graph of a module for any batch."""
    module, inputs = subject(name, robot)
    given = inputs(3)
    batch = torch.export.Dim("batch")
    shapes = ((({0: batch},) * len(given)),) if isinstance(module, Traced) else ({0: batch},) * len(given)
    with torch.no_grad():
        return torch.export.export(module, given, dynamic_shapes=shapes, strict=strict)


# --- torch.compile ---------------------------------------------------------------------------------------------------


def test_torch_approves_of_every_operator_of_the_package():
    names = [name for name in torch._C._dispatch_get_all_op_names() if name.startswith("torchdq::")]
    assert sorted(names) == ["torchdq::evaluate", "torchdq::run"]
    layer, x = torchdq.DQRNEA(TWO, learn=("mass",), backend="c"), random(2, 3, 2).requires_grad_()
    before = set(autograd._named)
    torch.compile(layer, backend="eager", fullgraph=True)(*x).sum().backward()
    programs = {name: autograd._found(name)[1] for name in autograd._named if name not in before}
    assert any(":" in name for name in programs)  # gradients, those of the masses summed over the samples
    for name, program in programs.items():
        given = [random(*(() if a.uniform else (3,)), a.width, seed=k) for k, a in enumerate(program.arguments)]
        operators.opcheck(torch.ops.torchdq.run.default, (name, given))
        for requires_grad in thinned((False, True), (True,)):
            operators.opcheck(
                torch.ops.torchdq.evaluate.default, (name, [y.clone().requires_grad_(requires_grad) for y in given])
            )


@pytest.mark.parametrize("name", thinned(SUBJECTS, ("rollout",)))
def test_a_module_compiles_without_a_graph_break(name):
    module, inputs = subject(name)
    compiled = torch.compile(module, fullgraph=True, backend="aot_eager")
    for batch in (3, 5):
        assert distance(compiled(*inputs(batch)), module(*inputs(batch))) < 1e-12


SCENES = {
    "bare": lambda: Scene(TWO),
    "integrators": lambda: Scene(TWO, FELT, integrator=integrators.RungeKutta4()),
    "conserving": lambda: Scene(TWO, FELT[:1], integrator=integrators.StoermerVerlet()),
    "substeps in a loop": lambda: Scene(TWO, FELT, substeps=3, unroll=False),
    "sensors": lambda: Scene(TWO, (*FELT, effects.Bias(0.01), effects.QuantisedReading(0.01))),
    "learned": lambda: Scene(TWO, (effects.Gravity(), effects.Viscous(torch.tensor([0.1, 0.2], dtype=F64)))),
    "controlled with memory": lambda: Scene(
        TWO, (*FELT, effects.FirstOrderLag(0.05), effects.Elastic(100.0, inertia=0.1)), controllers.PD(20.0, 2.0)
    ),
    "residual": lambda: (lambda layer: Scene(layer.robot, layer.effects()))(with_network(TWO)),
}


@pytest.mark.parametrize("name", thinned(SCENES, ("controlled with memory",)))
def test_steps_of_a_scene_compile_without_a_graph_break(name):
    scene = SCENES[name]()
    given = {"reference": 3} if scene.controller is not None else {}

    def two_steps(q, qd, more):
        state = scene.start(q, qd)
        for _ in range(2):
            state = scene.step(state, q, **{name: more for name in given})
        return state.q, state.qd

    compiled, x = torch.compile(two_steps, fullgraph=True, backend="aot_eager"), (*0.3 * random(2, 3, 2), random(3, 6))
    assert distance(compiled(*x), two_steps(*x)) < 1e-12


# --- torch.export ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", thinned(SUBJECTS, ("learned inverse dynamics",)))
def test_an_exported_module_consists_of_torch_operations_for_any_batch(name):
    module, inputs = subject(name)
    graph = exported(name)
    calls = [str(node.target) for node in graph.graph.nodes if node.op == "call_function"]
    assert calls and not [call for call in calls if "torchdq" in call]
    file = io.BytesIO()
    torch.export.save(graph, file)
    for one in (graph, torch.export.load(file)):
        assert distance(one.module()(*inputs(7, seed=1)), module(*inputs(7, seed=1))) < 1e-12


def in_another_process(code, folder):
    """Run code where torchdq is not imported."""
    code = f"import sys, torch; {code}; assert 'torchdq' not in sys.modules"
    done = subprocess.run([sys.executable, "-c", code], cwd=folder, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr


@exhaustive
def test_saved_graphs_run_in_a_process_without_the_package(tmp_path):
    expected = []
    for k, (name, strict) in enumerate((("residual network", False), ("inverse dynamics", True))):
        module, inputs = subject(name)
        torch.export.save(exported(name, strict), tmp_path / f"graph{k}.pt2")
        torch.save(inputs(7, seed=1), tmp_path / f"given{k}.pt")
        expected.append(module(*inputs(7, seed=1)))
    load = "torch.export.load(f'graph{k}.pt2').module()(*torch.load(f'given{k}.pt'))"
    in_another_process(f"torch.save([{load} for k in (0, 1)], 'found.pt')", tmp_path)
    assert distance(torch.load(tmp_path / "found.pt"), expected) < 1e-12


@exhaustive
@pytest.mark.skipif(shutil.which("g++") is None, reason="AOTInductor needs a C++ compiler")
@pytest.mark.parametrize("name", ["learned inverse dynamics", "residual network", "step"])
def test_a_package_of_machine_code_runs_in_a_process_without_the_package(name, tmp_path):
    module, inputs = subject(name)
    options = {"cpp.enable_tiling_heuristics": False}
    path = str(tmp_path / "layer.pt2")
    torch._inductor.aoti_compile_and_package(exported(name), package_path=path, inductor_configs=options)
    for batch in (7, 64):
        torch.save(inputs(batch, seed=1), tmp_path / "given.pt")
        in_another_process(
            "layer = torch._inductor.aoti_load_package('layer.pt2'); "
            "torch.save(layer(*torch.load('given.pt')), 'found.pt')",
            tmp_path,
        )
        assert distance(torch.load(tmp_path / "found.pt"), module(*inputs(batch, seed=1))) < 1e-12


# --- ONNX ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "robot"),
    [
        *thinned([(name, "two_link") for name in SUBJECTS], [("learned inverse dynamics", "two_link")]),
        *thinned([(name, "panda") for name in SUBJECTS if name != "rollout"], ()),
    ],
)
def test_an_onnx_file_has_the_same_values_to_rounding(name, robot, tmp_path):
    """Also in float64: torch's exporter would round constants that are no tensors to float32."""
    runtime = pytest.importorskip("onnxruntime")
    pytest.importorskip("onnxscript")
    robot = TWO if robot == TWO.name else torchdq.robots.load(robot)
    module, inputs = subject(name, robot)
    torch.onnx.export(exported(name, robot=robot), dynamo=True, verbose=False).save(tmp_path / "layer.onnx")
    session = runtime.InferenceSession(tmp_path / "layer.onnx")
    given, names = inputs(7, seed=1), [x.name for x in session.get_inputs()]
    found = session.run(None, {k: x.numpy() for k, x in zip(names, given, strict=True)})
    with torch.no_grad():
        expected = module(*given)
    expected = [expected] if isinstance(expected, torch.Tensor) else expected
    assert distance(map(torch.from_numpy, found), expected) < 1e-12


# --- what cannot be done ---------------------------------------------------------------------------------------------


NOT_EXPORTED = {  # by the backend of a block
    "a layer of this process": ("auto", lambda *x: torchdq.DQRNEA(TWO, backend="c")(*x)),
    "programs of this process": ("c", lambda *x: torchdq.DQRNEA(TWO)(*x)),
    "grad": ("auto", torch.func.grad(lambda q: torchdq.potential_energy(TWO, q).sum())),
    "jacrev": ("auto", torch.func.jacrev(lambda q: torchdq.potential_energy(TWO, q).sum())),
}


@pytest.mark.parametrize("name", NOT_EXPORTED)
def test_programs_of_this_process_and_reverse_mode_are_not_exported(name):
    block, function = NOT_EXPORTED[name]
    for strict in thinned((False, True), (False,)):
        with refused(ArgumentError), torchdq.backend(block):
            torch.export.export(Traced(function), (random(3, 2),), strict=strict)


@pytest.mark.parametrize(
    "transform, strict",
    thinned([(name, strict) for name in ("vmap", "jvp") for strict in (False, True)], [("vmap", True)]),
)
def test_other_transforms_are_exported(transform, strict):
    def torques(q):
        return torchdq.inverse_dynamics(TWO, q, q, q)

    function = {
        "vmap": torch.func.vmap(torques),
        "jvp": lambda q: torch.func.jvp(torques, (q,), (torch.ones_like(q),))[1],
    }[transform]
    graph = torch.export.export(Traced(function), (random(3, 2),), strict=strict)
    assert distance(graph.module()(random(3, 2, seed=1)), function(random(3, 2, seed=1))) < 1e-12


def refusals():
    """Functions that depend on values, their input, and words of the error."""
    scene = Scene(TWO, FELT[:1], integrator=integrators.DormandPrince())
    envs = RobotVectorEnv(3, "reach", TWO, action=Actions(scale=20.0))
    envs.reset(seed=0)
    return {
        "DormandPrince": (lambda q: scene.step(State(q, q)).q, random(3, 2), "RungeKutta4 has steps of one size"),
        "environment": (lambda action: envs.step(action)[0], torch.zeros(3, 2), "trace the policy, or scene.step"),
    }


@pytest.mark.parametrize("name", ["DormandPrince", "environment"])
def test_what_depends_on_values_is_in_no_graph(name):
    function, x, words = refusals()[name]
    with refused(ArgumentError):
        torch.export.export(Traced(function), (x,))
    with pytest.raises(torch._dynamo.exc.Unsupported, match=words):
        torch.compile(function, fullgraph=True, backend="eager")(x)
    if EVERYTHING:  # without fullgraph, torch breaks the graph there
        assert torch.compile(function, backend="eager")(x).isfinite().all()
