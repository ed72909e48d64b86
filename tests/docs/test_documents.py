"""The code in the documents runs, and their links lead somewhere."""

import doctest
import pkgutil
import posixpath
import re
from concurrent.futures import ThreadPoolExecutor
from importlib import import_module
from shutil import copy

import helpers
import pytest
import torch
from helpers import EVERYTHING
from places import ROOT

import torchdq
from torchdq import Scene, effects, envs

BACKEND = "auto"  # what a reader has, and quicker
DOCS = ROOT / "docs"
FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
README = [code for kind, code in FENCE.findall((ROOT / "README.md").read_text(encoding="utf-8")) if kind == "python"]
# a link of the reader's arm
BODY = """<link name="{0}"><inertial><mass value="2"/><origin xyz="0 0.02 0.15"/>
<inertia ixx="0.02" iyy="0.02" izz="0.004" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="{0}_joint" type="revolute"><parent link="{1}"/><child link="{0}"/><origin xyz="0 0 0.3"/><axis xyz="{2}"/>
<limit lower="-3" upper="3" effort="80" velocity="2"/><dynamics damping="0.5" friction="0.2"/></joint>"""
one_thread = helpers.one_thread


LONG = "aoti_compile_and_package"  # takes a minute, so that a page with it ends there but in `make test-all`
PAGES = sorted(DOCS.rglob("*.md"))
SHOWN = {"sh", "text", "xml", "c", "json", "csv", "yaml"}  # languages of blocks that a page only shows
PRINTED = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE


@pytest.fixture
def at_home(tmp_path, monkeypatch):
    """Folder of a reader who has the descriptions of the examples."""
    for file in (ROOT / "examples").glob("*.urdf"):
        copy(file, tmp_path)
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.relative_to(DOCS).as_posix())
def test_every_block_of_a_document_runs_after_the_ones_before_it(path, at_home):
    """Blocks of python run; those with prompts, pycon, print what stands below them."""
    text, known = path.read_text(encoding="utf-8"), {"__name__": "document"}
    printed = doctest.DocTestRunner(optionflags=PRINTED)
    for match in FENCE.finditer(text):
        language, code = match.groups()
        if LONG in code and not EVERYTHING:
            break
        if "onnxruntime" in code:
            pytest.importorskip("onnxruntime")
            pytest.importorskip("onnxscript")
        if "import casadi" in code:
            pytest.importorskip("casadi")
        first = text.count("\n", 0, match.start()) + 1
        if language == "python":
            exec(compile("\n" * first + code, str(path), "exec"), known)  # line numbers are those of the document
        elif language == "pycon":
            block = doctest.DocTestParser().get_doctest(code, known, path.name, str(path), first)
            assert block.examples, f"{path.name}, line {first}: a block without a prompt is no pycon"
            printed.run(block, clear_globs=False)
            known.update(block.globs)
        else:
            assert language in SHOWN, f"{path.name}, line {first}: a block of {language or 'no language'} cannot be run"
    assert not printed.failures, f"{path.name}: see above for what differs from what the page prints"


def has_example(name):
    """Whether a module of scenes has an example in a docstring."""
    return ">>> " in (ROOT / "envs" / f"{name}.py").read_text(encoding="utf-8")


@pytest.mark.parametrize("name", [x.name for x in pkgutil.iter_modules(envs.__path__) if has_example(x.name)])
def test_the_examples_in_docstrings_of_scenes_run(name):
    """Those of the rest of the package are found by pytest; the folder of these lies beside it."""
    module = import_module(f"torchdq.envs.{name}")
    assert not doctest.testmod(module, optionflags=PRINTED).failed


def described():
    """A URDF with an arm of three joints."""
    axes = enumerate(("0 0 1", "0 1 0", "1 0 0"), 1)
    links = [BODY.format(f"arm_{k}", f"arm_{k - 1}" if k > 1 else "base", axis) for k, axis in axes]
    return f'<robot name="arm"><link name="base"/>{"".join(links)}</robot>'


@pytest.fixture
def reader(tmp_path, monkeypatch):
    """Names of a reader before the first block, in a folder with the file of an arm."""
    (tmp_path / "arm.urdf").write_text(described(), encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    return {"__name__": "readme"}


def test_the_blocks_of_the_readme_run(reader):
    for code in README:
        exec(compile(code, "README.md", "exec"), reader)


def test_the_readme_has_blocks_to_run():
    assert README and all("torchdq" in code for code in README)


def test_the_page_on_contributing_has_what_it_promises():
    code = "".join(code for _, code in FENCE.findall((DOCS / "contributing.md").read_text(encoding="utf-8")))
    for name in (
        "(Along)",
        "(JointEffect)",
        "(Friction)",
        "record(",
        "(Backend)",
        "Integrator)",
        "(Reach)",
        "TorchTask(",
    ):
        assert name in code, name


LINK = re.compile(r"""\]\((?:<([^>]+)>|([^)\s]+))[^)]*\)|\b(?:src|href|srcset)=["']([^"']+)["']""")
CODE = re.compile(r"^(```|~~~)[^\n]*\n.*?^\1|`[^`\n]+`", re.MULTILINE | re.DOTALL)
HEADING = re.compile(r"^#{1,6} +(.+?) *#*$", re.MULTILINE)
DOCUMENTS = [*sorted(ROOT.glob("*.md")), *PAGES]


def anchors(text):
    """Anchors of a page's headings, as a reader of the repository finds them, and those that it states."""
    found = set(re.findall(r"""\b(?:id|name)=["']([^"']+)["']|\{#([\w-]+)\}""", text))
    known = {x for pair in found for x in pair if x}
    for heading in HEADING.findall(re.sub(r"^(```|~~~).*?^\1", "", text, flags=re.MULTILINE | re.DOTALL)):
        words = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).replace("`", "").lower()
        slug = re.sub(r"[^\w\- ]", "", words).replace(" ", "-")
        known.add(slug if slug not in known else f"{slug}-1")
    return known


@pytest.mark.parametrize("path", DOCUMENTS, ids=[path.relative_to(ROOT).as_posix() for path in DOCUMENTS])
def test_every_link_of_a_document_leads_somewhere(path):
    """Links to other places of the network are not tried."""
    text = path.read_text(encoding="utf-8")
    for match in LINK.finditer(CODE.sub("", text)):
        target, _, anchor = next(filter(None, match.groups())).partition("#")
        if re.match(r"[a-z]+:", target):
            continue
        file = path if not target else ROOT / posixpath.normpath((path.parent / target).relative_to(ROOT).as_posix())
        assert file.exists(), f"{path.name} links to {target}, which is not there"
        if anchor and file.suffix == ".md" and file.parent.name != "api":
            assert anchor in anchors(file.read_text(encoding="utf-8")), f"{path.name} links to {target}#{anchor}"


def test_a_picture_has_an_alternative_text_that_says_what_is_drawn():
    texts = {path.relative_to(ROOT): CODE.sub("", path.read_text(encoding="utf-8")) for path in DOCUMENTS}
    found = [(path, words) for path, text in texts.items() for words in re.findall(r"!\[([^\]]*)\]\(", text)]
    assert len(found) > 60
    short = [f"{path}: {words!r}" for path, words in found if len(words.split()) < 6]
    assert not short, "say what a reader would see: " + "; ".join(short)


def test_a_heading_has_the_anchor_of_its_words():
    text = '# What `read` takes\n\n## C, and [C++](x.md)\n\n```sh\n# no heading\n```\n<a id="own"></a>\n## Done {#end}'
    assert {"what-read-takes", "c-and-c", "own", "end"} <= anchors(text)
    assert "no-heading" not in anchors(text)


def test_a_scene_gives_several_threads_what_it_gives_one():
    def end(seed):
        scene = Scene(torchdq.robots.load("two_link"), (effects.Viscous(0.1 + 0.01 * (seed % 3)),), backend="eager")
        return scene.rollout(scene.start(helpers.random(5, 2, seed=seed)), steps=10).q

    with ThreadPoolExecutor(8) as pool:
        found = list(pool.map(end, range(16)))
    assert all(torch.equal(x, end(seed)) for seed, x in enumerate(found))
