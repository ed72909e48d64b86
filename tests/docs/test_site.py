"""The documentation builds without a warning, fetches nothing, and has every public name once."""

import html
import importlib
import inspect
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from helpers import exhaustive
from places import ROOT

import torchdq
import torchdq.envs
import torchdq.learning
import torchdq.nn
from torchdq import effects
from torchdq.scene import controllers, integrators, policies

filelock = pytest.importorskip("filelock")
pytest.importorskip("mkdocs")
pytest.importorskip("mkdocstrings")

API = sorted((ROOT / "docs/api").glob("*.md"))
SHOWN = [name for page in API for name in re.findall(r"^::: (\S+)$", page.read_text(encoding="utf-8"), re.MULTILINE)]
PAGE_OF = {name: text for text in map(Path.read_text, API) for name in SHOWN if f"\n::: {name}\n" in f"{text}\n"}
# what a browser loads by itself, not what a reader follows
LOADED = re.compile(
    r"""<(?:script|img|iframe|source|video|audio|embed|object)\b[^>]*\b(?:src|srcset|data)=["']?(?:https?:)?//[^>]*>"""
    r"""|<link\b(?=[^>]*\brel=["']?(?:stylesheet|preconnect|preload|dns-prefetch|icon))[^>]*href=["']?(?:https?:)?//[^>]*>"""
    r"""|@import\s+["'](?:https?:)?//[^"']*|url\(\s*["']?(?:https?:)?//[^)]*\)"""
)
# the scripts of the theme fetch these if a page has a diagram, names a repository, or is read in a browser before 2020
UNUSED = {"unpkg.com/mermaid@11", "unpkg.com/resize-observer-polyfill", "api.github.com/repos", "api.github.com/users"}


@pytest.fixture(scope="session")
def site(tmp_path_factory):
    """Folder of the built pages, built once by all processes together."""
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "site"
    with filelock.FileLock(f"{folder}.lock"):
        if not (folder / "built").exists():
            order = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
            done = subprocess.run(order, cwd=ROOT, capture_output=True, text=True, timeout=300)
            assert not done.returncode, done.stderr + done.stdout
            (folder / "built").touch()
    return folder


def pages(site):
    return {path.relative_to(site).as_posix(): path.read_text(encoding="utf-8") for path in site.rglob("*.html")}


def test_the_site_builds_strictly(site):
    """A warning, such as a link that leads nowhere or a page that is not in the nav, is an error."""
    assert (site / "api/functions.html").exists()


def test_nothing_is_fetched_while_pages_are_read(site):
    texts = [*site.rglob("*.html"), *site.rglob("*.css"), *site.rglob("*.svg")]
    found = [(path.name, m[0]) for path in texts for m in LOADED.finditer(path.read_text(encoding="utf-8"))]
    assert not found
    for script in site.rglob("*.js"):
        if script.name == "search_index.js":
            continue
        fetched = re.findall(r"""["'`]https?://([\w.-]+/[\w@.-]+)""", script.read_text(encoding="utf-8"))
        assert set(fetched) <= UNUSED, script
    assert not any('class="mermaid"' in text or "data-md-source" in text for text in pages(site).values())


def test_addresses_are_relative(site):
    """Pages open from a folder, and from any place of a server."""
    assert not [name for name, text in pages(site).items() if re.search(r"""(?:href|src)=["']?/""", text)]


def test_what_a_browser_would_load_is_noticed():
    for text in (
        '<script async src="https://a.b/c.js">',
        '<link href="//fonts.com/x.css" rel="stylesheet">',
        '<link rel="stylesheet" href="https://a.b/x.css">',
        '@import "https://a.b"',
        "url(https://a.b/x.woff)",
        '<img alt="x" src=https://a.b/c.png>',
    ):
        assert LOADED.search(text), text
    assert not LOADED.search('<a href="https://a.b">text</a> <link rel="canonical" href="https://a.b">')


def test_bars_are_as_long_as_their_ratios(site):
    """The largest ratio of a table has the whole width."""
    tables = re.findall(r"<table>.*?</table>", (site / "prices.html").read_text(encoding="utf-8"), re.DOTALL)
    drawn = [re.findall(r'style="--share: ([\d.]+)">([\d.]+) x</td>', table) for table in tables]
    assert [bool(bars) for bars in drawn] == ["<th>ratio</th>" in table for table in tables]
    assert any(drawn)
    for bars in filter(None, drawn):
        longest = max(float(ratio) for _, ratio in bars)
        assert all(abs(float(share) - float(ratio) / longest) < 1e-3 for share, ratio in bars)


def test_formulas_are_drawn_by_the_browser(site):
    without_code = {
        name: re.sub(r"<(pre|code)\b.*?</\1>", "", text, flags=re.DOTALL) for name, text in pages(site).items()
    }
    assert not [
        name for name, text in without_code.items() if "$$" in text or re.search(r"\$\\?[a-zA-Z\\][^<$]*\$", text)
    ]


WIDEST = 88  # columns of code that a page shows between its two menus, in a window of 1280 pixels


def test_no_line_of_code_is_cut(site):
    """Sources that a page links to are shown without menus, and have more room."""
    shown = {name: text for name, text in pages(site).items() if not name.startswith("source/")}
    blocks = [(name, x) for name, text in shown.items() for x in re.findall(r"<pre\b.*?</pre>", text, re.DOTALL)]
    assert len(blocks) > 500
    lines = [(name, html.unescape(x)) for name, block in blocks for x in re.sub("<[^>]+>", "", block).split("\n")]
    wide = [f"{name}: {line}" for name, line in lines if len(line) > WIDEST]
    assert not wide, "write these lines in 88 columns:\n" + "\n".join(wide)


def test_search_needs_no_server(site):
    assert (site / "search/search_index.js").read_text(encoding="utf-8").startswith("var __index = ")
    assert "iframe-worker.js" in (site / "api/functions.html").read_text(encoding="utf-8")


SEARCHED = {  # what people type, and the page that answers it
    "mass matrix": "api/functions.html#torchdq.mass_matrix",
    "inverse dynamics": "api/functions.html#torchdq.inverse_dynamics",
    "forward kinematics": "api/functions.html#torchdq.forward_kinematics",
    "jacobian": "api/functions.html#torchdq.jacobian",
    "hessian": "api/functions.html#torchdq.dynamics_hessian",
    "inverse kinematics": "task-space.html#inverse-kinematics",
    "MPC": "recipes.html",
    "gravity compensation": "recipes.html#gravity-compensation",
    "impedance control": "task-space.html#impedance-control",
    "friction": "effects/index.html",
    "payload": "effects/payload.html",
    "contact force": "effects/contact.html",
    "closed loop": "guides/loops.html",
    "real robot": "guides/controller.html",
    "pick and place": "guides/hands.html",
    "walk": "guides/legs.html",
    "system identification": "learning.html",
    "ROS": "guides/log.html",
    "stable baselines": "guides/million.html",
    "quaternion order": "conventions.html",
    "GPU": "gpu.html",
    "pip install": "index.html#install",
    "install windows": "index.html#install",
    "URDF not loading": "troubleshooting.html#urdf-not-loading",
    "slow": "troubleshooting.html",
    "nan": "troubleshooting.html#nan-in-a-simulation",
    "hand guiding": "guides/controller.html#gravity-compensation-and-hand-guiding-in-c",
    "ros2_control": "guides/controller.html",
    "brax": "guides/million.html#coming-from-isaac-lab-mjx-or-brax",
    "terrain": "guides/legs.html#slopes-waves-maps",
    "humanoid": "guides/legs.html#humanoids-and-other-robots-with-fewer-than-four-feet",
}


def test_the_search_finds_what_people_type(site):
    """The page is the first or the second of the answer, of which a reader sees three without scrolling."""
    node = shutil.which("node")
    if node is None:
        pytest.skip("needs node, which runs the search as a browser does")
    order = [node, str(ROOT / "tests/tools/searched.cjs"), str(site), *SEARCHED]
    answers = json.loads(subprocess.run(order, capture_output=True, text=True, check=True, timeout=60).stdout)
    for (query, page), found in zip(SEARCHED.items(), answers, strict=True):
        assert any(page in (place, place.partition("#")[0]) for near in found[:2] for place in near), (
            f"{query!r} must find {page}, found {[near[0] for near in found[:4]]}; "
            "give a heading its words, or the page a weight in docs/hooks/search.py"
        )


def test_tables_and_registers_are_not_searched(site):
    text = (site / "search/search_index.js").read_text(encoding="utf-8")
    places = {entry["location"].partition("#")[0] for entry in json.loads(text.partition("=")[2])["docs"]}
    assert "api/functions.html" in places
    assert not places & {"tested-robots.html", "equations.html", "CHANGELOG.html"}


def public():
    """Public names: those of `__all__`, and functions and classes of the modules that are public as a whole."""
    modules = {
        "torchdq.effects": effects,
        "torchdq.convert": torchdq.convert,
        "torchdq.dq": torchdq.dq,
        "torchdq.learning": torchdq.learning,
        "torchdq.objects": torchdq.objects,
        "torchdq.nn": torchdq.nn,
        "torchdq.functional": torchdq.functional,
        "torchdq.floating": torchdq.floating,
        "torchdq.task_space": torchdq.task_space,
        "torchdq.pose_solver": torchdq.pose_solver,
        "torchdq.envs": torchdq.envs,
        "torchdq.scene.policies": policies,
    }
    names = [f"{module}.{name}" for module, of in modules.items() for name in of.__all__]
    names += [f"torchdq.{name}" for name in dir(torchdq)]
    whole = {
        "torchdq.robots": torchdq.robots,
        "torchdq.scene.controllers": controllers,
        "torchdq.scene.integrators": integrators,
    }
    for module, of in whole.items():
        own = [name for name, x in vars(of).items() if getattr(x, "__module__", None) == of.__name__]
        names += [f"{module}.{name}" for name in own if not name.startswith("_") and callable(getattr(of, name))]
    return [name for name in names if not inspect.ismodule(resolved(name)) and not name.endswith("__")]


def resolved(path):
    """What is at a dotted path."""
    names = path.split(".")
    for k in range(len(names), 0, -1):
        try:
            found = importlib.import_module(".".join(names[:k]))
        except ImportError:
            continue
        for name in names[k:]:
            found = getattr(found, name)
        return found
    raise AssertionError(path)


def test_every_public_name_is_on_one_page():
    there = [resolved(name) for name in SHOWN]
    assert len(set(SHOWN)) == len(SHOWN)
    missing = [name for name in public() if not any(resolved(name) is x for x in there)]
    assert not missing, f"add them to a page of docs/api: {missing}"
    twice = [name for k, name in enumerate(SHOWN) if any(there[k] is x for x in there[:k])]
    assert twice == []


def test_every_page_of_the_api_is_shown_in_its_index():
    index = (ROOT / "docs/api/index.md").read_text(encoding="utf-8")
    assert all(f"({page.name})" in index for page in API if page.stem != "index")


FUNCTIONS = [name for name in SHOWN if inspect.isfunction(resolved(name))]


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_public_function_has_an_example_that_runs(name):
    """The suite runs them as doctests."""
    document = inspect.getdoc(resolved(name))
    assert document.count(">>> ") > document.count(">>> import"), f"add an example to the docstring of {name}"


# layouts of arguments and results are one table, at the top of their page
IN_A_TABLE = ("torchdq.convert.", "torchdq.dq.")


@pytest.mark.parametrize("name", [name for name in FUNCTIONS if not name.startswith(IN_A_TABLE)])
def test_a_public_function_says_what_it_takes(name):
    """Every argument but a backend is described, or is part of the summary."""
    function = resolved(name)
    document = inspect.getdoc(function)
    arguments = [x for x in inspect.signature(function).parameters if x not in ("backend", "robot", "dtype", "device")]
    missing = [x for x in arguments if not re.search(rf"(?<!\w){re.escape(x)}(?!\w)", document.split(">>>")[0])]
    assert not missing, f"{name} does not say what these are: {missing}"


PURE = {  # take no quantity of physics
    *("train_test_split", "plot_torques", "posterior_samples", "compile", "backend", "load", "names", "clear_caches"),
    *("require_finite", "from_mjcf", "from_urdf"),
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_public_function_says_units_shapes_and_errors(name):
    """Units and shapes stand in brackets; errors in the docstring, or above all functions of its page."""
    function = resolved(name)
    said = inspect.getdoc(function).split(">>>")[0]
    bare = name.rpartition(".")[2] in PURE or name.startswith(IN_A_TABLE)
    assert "[" in said or bare, f"{name} has no unit and no shape"
    common = "Error`" in PAGE_OF[name].partition("\n::: ")[0]
    assert common or re.search(r"^Raises?\b", said, re.MULTILINE) or not inspect.signature(function).parameters, (
        f"{name} says nothing of errors"
    )


OVERFLOW = """<body><script>
(async () => {
  const found = [];
  for (const [page, width] of %s) {
    const frame = document.createElement("iframe");
    frame.style.width = width + "px";
    frame.src = page;
    await new Promise((loaded) => { frame.onload = loaded; document.body.append(frame); });
    await new Promise((drawn) => setTimeout(drawn, 50));
    const root = frame.contentDocument.documentElement;
    if (root.scrollWidth > root.clientWidth) found.push(page + " at " + width);
    frame.remove();
  }
  document.body.textContent = "FOUND " + JSON.stringify(found) + " END";
})();
</script></body>"""


@exhaustive
def test_no_page_is_wider_than_the_screen(site, tmp_path):
    """Wide tables, code and formulas scroll by themselves, on a desk and on a telephone."""
    browser = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if browser is None:
        pytest.skip("needs Chromium")
    wide = tmp_path / "wide.html"
    wide.write_text("<!doctype html><p style='width: 2000px'>wide</p>")
    asked = [[path.as_uri(), width] for path in (*site.rglob("*.html"), wide) for width in (1280, 390)]
    harness = tmp_path / "all.html"
    harness.write_text(OVERFLOW % json.dumps(asked), encoding="utf-8")
    order = [browser, "--headless=new", "--no-sandbox", "--disable-gpu", "--allow-file-access-from-files"]
    order += [f"--user-data-dir={tmp_path / 'profile'}", "--virtual-time-budget=600000", "--dump-dom", harness.as_uri()]
    said = subprocess.run(order, capture_output=True, text=True, timeout=500).stdout
    found = json.loads(re.search(r"FOUND (\[.*\]) END", said)[1])
    assert found == [f"{wide.as_uri()} at {width}" for width in (1280, 390)]
