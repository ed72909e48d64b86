"""Every public effect has a page that says what the package says: its formula, parameters, price, and where it is used.

Pages are held to the sources, so that a change of either is seen; what the pages claim is held to the effects.
"""

import dataclasses
import math
import re

import effects as benchmark
import pytest
import torch
from helpers import thinned
from pages import contact_tables, formulas
from pages.cases import CASES, START, built
from pages.characteristics import CHARACTERISTICS
from pages.docstrings import documented, taken_apart
from pages.effect_facts import allowed, arm, facts, operations, tensors_of
from pages.effect_page import address, prices, signature
from pages.pictures import Curve, Picture, curves_of, svg

import torchdq
from torchdq import Scene, effects
from torchdq.effects.friction import Friction
from torchdq.functions.compile import CompiledProgram

REMEDY = "write it again with `python benchmarks/effects.py --write`"
FOLDER = benchmark.FOLDER
NAMES = [name for name in effects.__all__ if name not in ("Effect", "HeightMap")]
EVERY = pytest.mark.parametrize("name", NAMES)
ARM = torchdq.robots.load("two_link")
DRAWN = ("Coulomb", "JointLimits", "Noise")  # quick ones of each kind


def text(name):
    """Page of an effect, as it is in the folder."""
    return (FOLDER / address(name)).read_text(encoding="utf-8")


# --- the folder ------------------------------------------------------------------------------------------------------


def test_every_effect_has_a_case_a_picture_and_a_price():
    """A new effect needs all of them: see `benchmarks/effects.py`."""
    assert sorted(CASES) == sorted(CHARACTERISTICS) == sorted(prices()["effects"]) == sorted(NAMES)


def test_the_pages_are_what_the_sources_say():
    for name, page in benchmark.pages().items():
        assert (FOLDER / name).read_text(encoding="utf-8") == page, f"docs/effects/{name} is old; {REMEDY}"


def test_the_folder_holds_a_page_and_a_picture_of_every_effect_and_nothing_else():
    pages = {"index.md", *map(address, NAMES)}
    pictures = {name.replace(".md", ".svg") for name in pages - {"index.md"}}
    assert {path.name for path in FOLDER.iterdir()} == pages | pictures


@EVERY
def test_a_page_has_all_of_its_parts(name):
    page = text(name)
    heads = re.findall(r"^## (.*)$", page, re.MULTILINE)
    further = [*(["Objects"] if name == "Contact" else []), *contact_tables.SECTIONS.get(name, ())]
    assert heads[: 2 + len(further)] == ["Parameters", "Cost", *further]
    assert heads[2 + len(further) :] == ["Absence", "Combination with other effects", "Example", "Source"]
    assert page.count("$$") >= 2 and page.count("$$") % 2 == 0
    assert f"]({address(name).replace('.md', '.svg')})" in page
    assert all(f"| `{entry.name}` |" in page for entry in dataclasses.fields(getattr(effects, name)))


@EVERY
def test_the_table_of_all_effects_links_to_it(name):
    assert f"[{name}]({address(name)})" in (FOLDER / "index.md").read_text(encoding="utf-8")


# --- pictures --------------------------------------------------------------------------------------------------------


@EVERY
def test_a_picture_is_small_and_fetches_nothing(name):
    picture = (FOLDER / address(name).replace(".md", ".svg")).read_text(encoding="utf-8")
    assert len(picture) < 60_000 and curves_of(picture)
    assert "prefers-color-scheme: dark" in picture
    addresses = re.findall(r'(?:href|src)="([^"]*)"', picture) + re.findall(r"url\(([^)]*)\)", picture)
    assert all(x.startswith("#") for x in addresses)


@pytest.mark.parametrize("name", thinned(CHARACTERISTICS, DRAWN))
def test_a_picture_shows_what_the_effect_does(name):
    """Its data are compared, up to how processors round."""
    kept = curves_of((FOLDER / address(name).replace(".md", ".svg")).read_text(encoding="utf-8"))
    drawn = curves_of(svg(CHARACTERISTICS[name]()))
    assert [x.shape for x in kept] == [x.shape for x in drawn]
    assert all(abs(a - b).max() < 1e-3 * abs(a).max() for a, b in zip(kept, drawn, strict=True)), REMEDY


def test_curves_are_read_back_from_a_picture():
    (curve, flat) = curves_of(svg(Picture("x", "y", {"a": Curve([0, 1, 2], [0, 1, 0]), "b": Curve([0, 2], [0, 0])})))
    assert curve.tolist() == [[0, 0], [1, 1], [2, 0]] and flat.tolist() == [[0, 0], [2, 0]]


# --- what pages claim ------------------------------------------------------------------------------------------------


@EVERY
def test_values_that_a_parameter_may_have_are_those_that_the_effect_states(name):
    effect = built(CASES[name].made)
    for parameter, axes in effect.SHAPES.items():
        words = allowed(effect, parameter, arm(name))
        if axes and not any(isinstance(axis, str) for axis in axes):
            assert words == f"{axes[0]} numbers"
            continue
        assert words.startswith("any") == effect.PARAMETERS[parameter].check.signed, parameter
        assert words.startswith("> 0") == effect.PARAMETERS[parameter].check.open, parameter
        assert words.endswith("infinite") == effect.PARAMETERS[parameter].check.infinite, parameter
        assert ("< 1" in words) == (effect.PARAMETERS[parameter].check.below == 1), parameter


@pytest.mark.parametrize("name", [name for name in NAMES if CASES[name].off])
def test_an_effect_that_is_off_changes_no_bit_and_costs_what_its_page_says(name):
    off = built(CASES[name].off)
    bare, made = Scene(ARM, backend="eager"), Scene(ARM, (off,), backend="eager")
    q, qd, torque = torch.randn(3, 16, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    inputs = {x: q for x in off.inputs(2)}
    a, b = (scene.step(scene.start(q, qd), torque, **given) for scene, given in ((bare, {}), (made, inputs)))
    assert torch.equal(a.q, b.q) and torch.equal(a.qd, b.qd)
    left = operations(off) - operations()
    assert (f"has no effect, but {left} operations" in " ".join(text(name).split())) == (left > 0)


@EVERY
def test_operations_are_those_that_describe_counts(name):
    described = Scene(arm(name), (built(CASES[name].made),)).describe(seconds=0)
    assert described.total.operations == operations() + facts(name).operations


@EVERY
def test_states_are_those_that_a_scene_remembers(name):
    state = Scene(arm(name), (built(CASES[name].made),), backend="eager").start(torch.zeros(3, 7))
    owners = 1 if facts(name).slot == "body" else 7  # a point, or the joints
    assert facts(name).states == (0 if state.memory is None else state.memory.shape[1] / owners)


@EVERY
def test_the_step_of_a_scene_is_exported_to_c_where_its_page_says_so(name, tmp_path):
    scene = Scene(arm(name), (built(CASES[name].made),))
    assert facts(name).c == (name != "Residual")
    if facts(name).c:
        program = scene.program()
        axes = tuple((len(result.values),) for result in program.results)
        exported = CompiledProgram(program, torch.float64, axes).export(tmp_path)
        assert exported.source.stat().st_size > 1000


def test_layers_take_friction_that_remembers_nothing():
    friction = {name for name in NAMES if issubclass(getattr(effects, name), Friction)}
    assert {name for name in NAMES if facts(name).layer} == friction - {"LuGre"}
    assert {name for name in NAMES if facts(name).layer} < {name for name in NAMES if facts(name).identify}


def test_tensors_stand_where_numbers_were_given():
    made = tensors_of(effects.Coulomb(0.5), arm(), 3)
    assert made.coulomb.shape == (3, 7) and made.sign_width == 0.01
    limits = tensors_of(effects.JointLimits(), arm(), 2)
    assert limits.lower.shape == (2, 7) and torch.equal(limits.lower[0], arm().limits.lower)


def test_prices_are_numbers_of_a_named_machine():
    stored = prices()
    assert stored["machine"]["processor"] and stored["bare"] > 0
    for found in stored["effects"].values():
        assert all(math.isfinite(x) and x >= 0 for price in found.values() for x in price)


# --- how pages are made ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("formula", "expected"),
    [
        ("tau = -level qd", r"\tau = -\mathrm{level}\,\dot q"),
        ("J thd' = u - t", r"J\,\dot \theta' = u - t"),
        ("c = |v_t| v_t / sqrt(w^2 + 1)", r"c = \lvert v_{t}\rvert \,v_{t} / \sqrt{w^{2} + 1}"),
        ("tau(t) = u(t - 2 dt)", r"\tau(t) = u(t - 2\,\mathrm{dt})"),
        ("-a <= x <= a (1 - b)", r"-a\le x\le a\,(1 - b)"),
        ("x = 1,   d the distance [m]", r"x = 1,\qquad d\;\text{the distance [m]}"),
        ("max(k d, 0)", r"\max(k\,d,\; 0)"),
    ],
)
def test_a_formula_is_set(formula, expected):
    assert formulas.tex(formula, {"level"}) == expected


@EVERY
def test_formulas_of_a_page_become_mathml(name):
    converter = pytest.importorskip("latex2mathml.converter")
    for formula in re.findall(r"\$\$(.*?)\$\$", text(name), re.DOTALL):
        assert "<math" in converter.convert(formula.strip())
        assert formula.count("{") == formula.count("}")


@pytest.mark.parametrize(
    ("line", "found"),
    [
        ("Viscous friction: tau = -d qd.", ("Viscous friction.", "tau = -d qd", "")),
        (
            "Limits: tau = -k p beyond a limit, with p growing.",
            ("Limits.", "tau = -k p", "beyond a limit, with p growing."),
        ),
        ("Commands lose up to a width, x = u - width.", ("Commands lose up to a width.", "x = u - width", "")),
        ("Uniform noise, of no formula.", ("Uniform noise, of no formula.", "", "")),
    ],
)
def test_a_sentence_is_taken_apart(line, found):
    assert taken_apart(line, frozenset({"width"})) == found


def test_an_argument_is_taken_apart():
    class Sample:
        """A thing.

        Args:
            a, b: sizes of it [N m or N], shape [..., n]; None: those
                of the description.
            width: of a band [m/s], a number or [...].
            name: one of "x".

        >>> Sample()
        """

    said = documented(Sample).arguments
    assert list(said) == ["a", "b", "width", "name"]
    assert said["b"] == ("sizes of it; None: those of the description", "N m or N", "[..., n]")
    assert said["width"] == ("of a band", "m/s", "[...]")
    assert said["name"] == ('one of "x"', "", "")


def test_a_signature_shows_defaults():
    assert signature(effects.Coulomb) == "effects.Coulomb(coulomb=None, sign_width=0.01, *, warming=0.0)"
    assert signature(effects.Spring) == "effects.Spring(stiffness, rest=0.0)"


def test_examples_begin_alike():
    assert START.startswith("import torch\n") and all(f"```python\n{START}" in text(name) for name in NAMES)
