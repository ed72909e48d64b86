"""Text of the page of each effect, and of the table of all of them."""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import json
import re
from pathlib import Path
from typing import Any

from pages import contact_tables
from pages.cases import CASES, START, built
from pages.characteristics import CHARACTERISTICS
from pages.docstrings import ArgumentText, documented
from pages.effect_facts import allowed, arm, facts, kinds, operations, required
from pages.formulas import tex
from pages.text import MADE, sentence, table, wrapped
from torchdq import effects
from torchdq.effects import Effect

ROOT = Path(__file__).resolve().parents[2]
PRICES = ROOT / "benchmarks" / "results" / "effects.json"
SLOTS = {
    "model": "It changes parameters of the robot, before all other computations.",
    "joint": "Its torque adds to those of all other joint effects, in any order.",
    "body": "Its wrench adds to those of all other body effects, in any order.",
    "actuator": "Actuators change the commanded torque one after the other, in the order of the list.",
    "sensor": "Sensors change the measurement one after the other, in the order of the list, before the controller.",
}
TITLES = {
    "model": "Model: gravity, payloads, rotors",
    "joint": "Joint: friction, springs, limits",
    "body": "Body: contact, drag, pushes",
    "actuator": "Actuator: torque limits, delays, motors",
    "sensor": "Sensor: noise, bias, delays",
}
LAST = "It acts after all other model effects, wherever it is in the list."
SYMBOLS = frozenset({"load", "target"})  # symbols of formulas that are not parameters


def address(name: str) -> str:
    """File of the page of an effect."""
    return re.sub(r"(?<=[a-z])(?=[A-Z])", "-", name).lower() + ".md"


def prices() -> dict[str, Any]:
    """Nanoseconds of every effect, as they were measured and stored."""
    return json.loads(PRICES.read_text(encoding="utf-8"))


def priced(stored: dict[str, Any], name: str) -> dict[str, Any]:
    """Stored prices of an effect, in numbers and in tensors."""
    if name not in stored["effects"]:
        raise SystemExit(f"{name} has no price yet: python benchmarks/effects.py --measure {name}")
    return stored["effects"][name]


def page(name: str) -> str:
    """Page of an effect."""
    kind, case, found = getattr(effects, name), CASES[name], facts(name)
    known = frozenset(entry.name for entry in dataclasses.fields(kind)) | SYMBOLS
    said = documented(kind, known)
    picture = Path(address(name)).with_suffix(".svg")
    inputs = _several([f"`{x}`" for x in found.inputs])
    parts = [
        f"# {name}",
        MADE.format(script="benchmarks/effects.py"),
        linked(said.summary, name),
        *[f"$$\n{tex(formula, known)}\n$$" for formula in said.formulas],
        *[linked(paragraph, name) for paragraph in said.text],
        f"![{shown(name)}]({picture})",
        "## Parameters",
        f"`{signature(kind)}`",
        parameters(kind),
        *([f"Every step takes {inputs}, by name."] if inputs else []),
        "## Cost",
        _price(name),
        _remembers(name),
        *contact_tables.sections(name),
        "## Absence",
        _absent(name),
        "## Combination with other effects",
        _together(kind),
        _where(name),
        "## Example",
        f"```python\n{START}{case.code}\n```",
        "## Source",
        " ".join([*said.sources, f"The code is in `{_file(kind)}`."]),
    ]
    return "\n\n".join(wrapped(part) for part in parts) + "\n"


def shown(name: str) -> str:
    """Alternative text of the picture of an effect: its axes, without units, and its curves."""
    drawn = CHARACTERISTICS[name]()
    x, y = (re.sub(r" \[.*\]", "", label) for label in (drawn.x, drawn.y))
    return f"{y[0].upper()}{y[1:]} against {x}, with {name}: {'; '.join(drawn.curves)}"


def signature(kind: type[Effect]) -> str:
    """Call that constructs the effect."""
    ordered = [entry for entry in dataclasses.fields(kind) if not entry.kw_only]
    named = [entry for entry in dataclasses.fields(kind) if entry.kw_only]

    def given(entry: Any) -> str:
        return entry.name if entry.default is dataclasses.MISSING else f"{entry.name}={entry.default!r}"

    words = [*map(given, ordered), *(["*"] if named else []), *map(given, named)]
    return f"effects.{kind.__name__}({', '.join(words)})"


def parameters(kind: type[Effect]) -> str:
    """Table of the parameters."""
    said, effect = _arguments(kind), built(CASES[kind.__name__].made)
    rows = []
    for entry in sorted(dataclasses.fields(kind), key=lambda found: found.kw_only):
        text = said[entry.name]
        values = allowed(effect, entry.name, arm(type(effect).__name__))
        rows.append(
            (
                f"`{entry.name}`",
                linked(text.meaning or entry.name, kind.__name__),
                text.unit or ("1" if entry.name in kind.PARAMETERS else ""),
                f"`{text.shape}`" if text.shape else "one number" if entry.name in kind.PARAMETERS else "",
                _default(effect, entry),
                values,
            )
        )
    return table(("parameter", "meaning", "unit", "shape", "default", "values"), rows)


def _arguments(kind: type[Effect]) -> dict[str, ArgumentText]:
    """Arguments of a class and of those that it is made from, whose words stand for "as in"."""
    found: dict[str, ArgumentText] = {}
    for base in reversed(kind.__mro__):
        for name, text in documented(base).arguments.items() if "__doc__" in vars(base) else ():
            if not text.meaning.startswith("as in"):
                found[name] = text
    return found


def _default(effect: Effect, entry: Any) -> str:
    if entry.name in effect.DESCRIBED:
        return f"`robot.{effect.DESCRIBED[entry.name]}`"
    if entry.default is dataclasses.MISSING or (
        entry.default is None and required(effect, entry.name, arm(type(effect).__name__))
    ):
        return "must be given"
    return f"`{entry.default!r}`"


def linked(text: str, name: str) -> str:
    """Text in which other effects are links."""

    def link(match: re.Match[str]) -> str:
        other = match.group(1)
        return f"[`{other}`]({address(other)})" if other in CASES and other != name else match.group()

    return sentence(re.sub(r"`(\w+)`", link, text))


# --- sections -----------------------------------------------------------------------------------------------------


def _price(name: str) -> str:
    found, stored, bare = facts(name), prices(), operations()
    price = priced(stored, name)
    rows = [
        ("a step without it", f"{bare}", f"{stored['bare']:.0f}"),
        (f"`{CASES[name].made}`", f"+ {found.operations}", _time(price["numbers"])),
    ]
    if found.with_tensors is not None:
        rows.append(
            ("the same as tensors, different in every sample", f"+ {found.with_tensors}", _time(price["tensors"]))
        )
    head = (f"step of a seven-joint arm (`{stored['robot']}`)", "operations", "ns")
    return f"{table(head, rows)}\n\nMeasured as [all prices of effects](index.md#all-effects)."


def _measured(stored: dict[str, Any]) -> str:
    machine = ", ".join(f"{key} {value}" for key, value in stored["machine"].items())
    return f"Measured in {stored['dtype']}, {stored['batch']} samples at once, one thread: {machine}."


def _time(price: list[float]) -> str:
    """Nanoseconds that an effect adds; a bound where they are within the spread."""
    nanoseconds, spread = price
    return f"+ {nanoseconds:.1f}" if nanoseconds > spread else f"< {max(nanoseconds + spread, 0.1):.1f}"


def _remembers(name: str) -> str:
    found, words = facts(name), []
    if found.states:
        words.append(f"It has {found.states:g} states per {_owner(found.slot)}, in `state.memory`")
        words[-1] = words[-1].replace(" 1 states", " one state")
    if found.noises:
        words.append(f"It uses {found.noises:g} random numbers per joint and step")
    outside = built(CASES[name].made).outside()
    if outside:
        words.append(f"Outside the program, {outside}")
    return ". ".join(words or ["It has no states, and uses no random numbers"]) + "."


def _owner(slot: str) -> str:
    """Owner of states, in words."""
    return "point" if slot == "body" else "joint"


def _absent(name: str) -> str:
    bare, off = operations(), CASES[name].off
    text = (
        f"In a scene without it, nothing of it is recorded: a step has the {bare} operations of the rigid bodies, with "
        "bitwise the same result."
    )
    if not off:
        return text
    left = operations(built(off)) - bare
    if left:
        return f"{text} `{off}` has no effect, but {left} operations; omit it instead."
    return f"{text} With zero size, `{off}`, it folds away, and {bare} operations remain."


def _together(kind: type[Effect]) -> str:
    words = [LAST if getattr(kind, "LATE", False) else SLOTS[kind.SLOT]]
    words.append(f"A scene has it at most once: {kind.ONCE}." if kind.ONCE else "A scene may have several of them.")
    words += [f"No other effect may take {reason}." for reason in kind.SOLE.values()]
    words += [f"The input `{name}`, if used, is shared by all effects." for name in sorted(kind.SHARED)]
    return " ".join(words)


def _where(name: str) -> str:
    found = facts(name)
    yes = ["a scene"]
    if found.layer:
        yes.append("layers (`torchdq.DQRNEA(robot, friction=...)`)")
    if found.identify:
        yes.append("identification (`torchdq.learning.identify`)")
    if found.c:
        yes.append("exported C (`torchdq.compile(scene.program()).export(folder)`)")
    text = f"It may be used in {_several(yes)}."
    return text if found.c else text + " It cannot be exported to C, because part of it runs in torch."


def _several(words: list[str]) -> str:
    return (
        ", ".join(words[:-1]) + (", and " if len(words) > 2 else " and ") + words[-1] if words[1:] else "".join(words)
    )


def _file(kind: type[Effect]) -> str:
    source = importlib.import_module(kind.__module__)
    return f"torchdq/effects/{Path(inspect.getfile(source)).name}"


# --- the table of all -----------------------------------------------------------------------------------------------

INTRODUCTION = """\
A scene simulates the effects that it lists, and no others. A bare `Scene(robot)` has rigid bodies only: no gravity, no
friction, no limits. Each effect below is a small object that belongs to one slot, and every slot has its place in a
step:

1. **actuator**: changes the commanded torque.
2. **joint** and **body**: torques at the joints and wrenches on the links add to it.
3. **model**: the robot's parameters, with which the accelerations are computed.
4. **sensor**: changes the measurements of the new state.

All of them are recorded into one program. Parameters that are numbers are constants, and are folded. Parameters that
are tensors are arguments: they may require gradients, or differ from sample to sample, without recompilation. So each
effect has two costs.

```python
import torch

import torchdq
from torchdq import Scene, effects

robot = torchdq.robots.load("panda")
parts = (effects.Gravity(), effects.Viscous(0.5), effects.Saturation())
scene = Scene(robot, parts, dt=0.002)
state = scene.step(scene.start(torch.zeros(4096, 7)), torque=torch.zeros(4096, 7))
# operations of every effect; with more seconds, nanoseconds too
print(scene.describe(seconds=0))
```

Omitted parameters are taken from the robot's description, if it has them. `scene.describe()` also lists the effects of
the description that the scene does not simulate."""

FOOT = """\
*Operations* are those that the effect adds to one step of a seven-joint arm, first with numbers as parameters, then
with tensors that differ from sample to sample; *ns* is the time of the first. *States* are the states of the effect
per joint, or per point of a contact. Every effect can be used in a scene; *also in* lists other uses: *layer* is
`torchdq.DQRNEA(robot, friction=...)` and the other layers, *identify* is `torchdq.learning.identify`, and *C* is
`torchdq.compile(scene.program()).export(folder)`.

Your own effect is a small class, see [Contributing](../contributing.md#an-effect)."""


def index() -> str:
    """Table of all effects."""
    stored, sections = prices(), []
    for slot in SLOTS:
        rows = [_row(kind.__name__, stored) for kind in kinds() if slot == kind.SLOT]
        head = (slot, "effect", "states", "operations", "ns", "also in")
        sections.append(f"### {TITLES[slot]}\n\n{table(head, rows)}")
    bare = f"A step without effects has {operations()} operations and takes {stored['bare']:.0f} ns."
    inner = "\n\n".join([*sections, f"{bare} {_measured(stored)}"])
    made = MADE.format(script="benchmarks/effects.py")
    parts = ["# Effects", made, INTRODUCTION, "## All effects", f"{inner}", FOOT]
    return "\n\n".join(parts) + "\n"


def _row(name: str, stored: dict[str, Any]) -> tuple[str, ...]:
    found, price = facts(name), priced(stored, name)["numbers"]
    kind = getattr(effects, name)
    summary = documented(kind, frozenset(entry.name for entry in dataclasses.fields(kind)) | SYMBOLS).summary
    also = [word for word, x in (("layer", found.layer), ("identify", found.identify), ("C", found.c)) if x]
    both = f"{found.operations}" + ("" if found.with_tensors is None else f" / {found.with_tensors}")
    link, what = f"[{name}]({address(name)})", re.split(r"[:;,.]", summary)[0]
    return link, what, f"{found.states:g}", both, _time(price).lstrip("+ "), ", ".join(also)
