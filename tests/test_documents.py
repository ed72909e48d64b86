"""The code in the documents runs."""

import re
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import helpers
import pytest
import torch

import torchdq
from torchdq.envs import Scene, effects

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
README = [code for language, code in FENCE.findall((ROOT / "README.md").read_text(encoding="utf-8")) if language]
# files of the reader: an arm, and a humanoid whose arm is one
LINK = """<link name="{0}"><inertial><mass value="2"/><origin xyz="0 0.02 0.15"/>
<inertia ixx="0.02" iyy="0.02" izz="0.004" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="{0}_joint" type="revolute"><parent link="{1}"/><child link="{0}"/><origin xyz="0 0 0.3"/><axis xyz="{2}"/>
<limit lower="-3" upper="3" effort="80" velocity="2"/><dynamics damping="0.5" friction="0.2"/></joint>"""
one_thread = helpers.one_thread


LONG = "aoti_compile_and_package"  # takes a minute, so that a page with it ends there unless the test is exhaustive
PAGES = sorted(DOCS.glob("*.md"))


@pytest.mark.parametrize(
    ("path", "whole"),
    [
        *(pytest.param(path, False, id=path.name) for path in PAGES),
        *(
            pytest.param(path, True, marks=pytest.mark.exhaustive, id=f"all of {path.name}")
            for path in PAGES
            if LONG in path.read_text(encoding="utf-8")
        ),
    ],
)
def test_every_block_of_a_document_runs_after_the_ones_before_it(path, whole):
    text, known = path.read_text(encoding="utf-8"), {"__name__": "document"}
    for match in FENCE.finditer(text):
        language, code = match.groups()
        if LONG in code and not whole:
            break
        if "onnxruntime" in code:
            pytest.importorskip("onnxruntime")
            pytest.importorskip("onnxscript")
        if "import casadi" in code:
            pytest.importorskip("casadi")
        assert language == "python", f"{path.name}: a block of {language or 'no language'} cannot be run"
        first = text.count("\n", 0, match.start()) + 1
        exec(compile("\n" * first + code, str(path), "exec"), known)  # line numbers are those of the document


def described(name, *arms):
    """A URDF with arms of three joints."""
    links = [
        LINK.format(f"{arm}_{k}", f"{arm}_{k - 1}" if k else "base", axis)
        for arm in arms
        for k, axis in enumerate(("0 0 1", "0 1 0", "1 0 0"))
    ]
    return f'<robot name="{name}"><link name="base"/>{"".join(links)}</robot>'


def logged(robot, seconds=20.0, rate=100.0):
    """A log of a robot with friction that follows sums of sines."""
    t = torch.arange(0.0, seconds, 1 / rate, dtype=torch.float64)[:, None]
    joints = torch.arange(1.0, robot.n + 1, dtype=torch.float64)
    q, qd, qdd = 0.0, 0.0, 0.0
    for a, w in ((0.5, 1 + 0.3 * joints), (0.3, 2.1 + 0.4 * joints), (0.1, 4 + 0.2 * joints)):
        q, qd, qdd = q + a * (w * t).sin(), qd + a * w * (w * t).cos(), qdd - a * w * w * (w * t).sin()
    tau = torchdq.inverse_dynamics(robot, q, qd, qdd) + 0.5 * qd + 0.2 * (qd / 0.05).tanh()
    heads = ["time", *(f"{name}{k}" for name in ("q", "qd", "tau") for k in range(1, robot.n + 1))]
    rows = torch.cat([t, q, qd, tau], 1).tolist()
    return "\n".join([",".join(heads), *(",".join(map(repr, row)) for row in rows)])


@pytest.fixture
def reader(tmp_path, monkeypatch):
    """Names that a reader has when he comes to a block, in a folder with his files."""
    (tmp_path / "arm.urdf").write_text(described("arm", "arm"), encoding="utf-8")
    (tmp_path / "humanoid.urdf").write_text(described("humanoid", "left_arm", "right_arm"), encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    robot = torchdq.Robot.from_urdf("arm.urdf")
    (tmp_path / "log.csv").write_text(logged(robot), encoding="utf-8")
    return {"__name__": "readme", "torch": torch, "torchdq": torchdq, "robot": robot}


@pytest.mark.parametrize(
    "code",
    [pytest.param(code, marks=pytest.mark.exhaustive) if "recommend(" in code else code for code in README],
    ids=[f"block {k}" for k in range(1, len(README) + 1)],
)
def test_every_block_of_the_readme_runs(code, reader):
    """Each by itself, but for `import torch, torchdq` and the robot of the first."""
    if "read(" in code:
        pytest.importorskip("scipy", reason="smoothing needs scipy")
    exec(compile(code, "README.md", "exec"), reader)


def test_the_readme_has_blocks_to_run():
    assert len(README) >= 6
    assert all("torchdq" in code or "scene" in code for code in README)


def test_the_page_on_extending_has_what_it_promises():
    code = "".join(code for _, code in FENCE.findall((DOCS / "extending.md").read_text(encoding="utf-8")))
    for name in ("Gentle(Reach)", "TorchTask(", "(JointEffect)", "Integrator)", "Painter", ".memory", ".source()"):
        assert name in code, name


def test_a_scene_gives_several_threads_what_it_gives_one():
    def end(seed):
        scene = Scene(torchdq.robots.load("two_link"), (effects.Viscous(0.1 + 0.01 * (seed % 3)),), backend="eager")
        return scene.rollout(scene.start(helpers.random(5, 2, seed=seed)), steps=10).q

    with ThreadPoolExecutor(8) as pool:
        found = list(pool.map(end, range(16)))
    assert all(torch.equal(x, end(seed)) for seed, x in enumerate(found))
