"""URDF files with wounds of every kind: whatever a file holds, reading it ends in a robot or an error of the package.

    python tests/tools/fuzz_urdf.py [--cases 20000] [--first 0]

Each case takes at most a second and 256 MB. Cases are numbered, and a number makes the same file on every machine:
`outcome(case(1234))` does one again. `make test` takes 200 of them.
"""

import argparse
import copy
import random
import re
import sys
import time
import warnings
import xml.etree.ElementTree as ET
from collections import Counter
from pathlib import Path
from typing import NamedTuple

import torch
from urdf_text import LIMIT, joint, link, mimic, urdf

import torchdq
from torchdq import Robot, SingularInertiaError, TorchdqError

SECONDS = 1.0
MEGABYTES = 256.0

# --- files -----------------------------------------------------------------------------------------------------------

MESH = '<visual><origin xyz="0 0 1"/><geometry><mesh filename="package://a/b.stl"/></geometry></visual>'
DRY = '<dynamics damping="1" friction="0.5"/>'


def limb(name, parent, kind="revolute", more=""):
    """A link with a body and the joint that carries it."""
    more = more if kind in ("continuous", "fixed") else LIMIT + more
    placed = joint(name, parent, f"{name}_link", kind, (0.1, 0.2, 0.3), (0, 1.5, 0), (0, 1, 0), more)
    return link(f"{name}_link", more=MESH) + placed


def robot(*elements):
    """A file of a base and these."""
    return urdf(link("base"), *elements, name="r")


LEFT = limb("left", "driver_link", more=mimic("driver", -1, 0.1))
RIGHT = limb("right", "driver_link", "prismatic", more=mimic("left", 2))
ARMS = limb("l", "waist_link") + limb("r", "waist_link")
TOOLS = limb("tool", "r_link", "fixed") + limb("camera", "tool_link", "fixed")
WHEEL = '<drake:x value="1"/>' + limb("wheel", "base", "continuous")
FILES = (
    robot(limb("a", "base"), limb("b", "a_link", "prismatic"), limb("c", "b_link", "continuous")),
    robot(limb("driver", "base", more=DRY), LEFT, RIGHT),
    robot(limb("waist", "base"), ARMS, TOOLS, link("map", None)),
    robot(limb("drive", "base", "planar"), limb("arm", "drive_link"), '<gazebo reference="base"><x/></gazebo>'),
    robot(WHEEL, "<transmission name='t'><joint/></transmission>"),
    robot(),
)

# --- wounds ----------------------------------------------------------------------------------------------------------

NUMBERS = [
    *("nan", "inf", "-inf", "1e308", "-1e308", "1e-320", "-0", "0", "", " ", "x", "1_000", "0x10", "1,5", "1e9999"),
    *("1e50", "-2e-35", "1e-9", "-1", "3.14159", "0 0 0", "1 2 3 4", "9" * 999, "\u0661\u0662", "\uff11", "\u0967.5"),
    *("${x}", "$(arg y)", "1 ", "\n1\t", "+1", "1e", ".", "1d3", "\u2212" + "1", "\ufeff1", "1\u00a02 3"),
]
NAMES = [
    *("", " ", "base", "a_link", "driver", "universe", "world", "a'b", 'a"b', "a\nb", "a/b/../c", "C:\\x", "<x>"),
    *("&amp;", "é", "关节", "\u202e", "\U0001f916", "%s%n", "{0}", "${x}", "None", "tip", "a" * 1000, "a" * 1001),
]
TAGS = ["link", "joint", "robot", "inertial", "mass", "mimic", "origin", "limit"]
TAGS += ["x", "a:b", "xacro:macro", "Link", "é"]
KINDS = ["revolute", "continuous", "prismatic", "fixed", "planar", "floating", "ball", "", "REVOLUTE"]
WAYS = ["delete", "double", "rename", "move", "order", "attribute", "number", "name", "kind"]
HUGE = ["depth", "chain", "star", "circle", "name", "attributes", "numbers", "mimics", "text", "comments"]


def elements(root):
    """Pairs of an element and its parent."""
    return [(child, parent) for parent in root.iter() for child in parent]


def wound(rng, root):
    """Change an element, an attribute, a number or a name."""
    pairs = elements(root)
    child, parent = rng.choice(pairs) if pairs else (root, root)
    names = list(child.attrib)
    how = rng.choice([*WAYS, *["attribute"] * 2, *["number"] * 3])
    if how == "delete" and child in parent:
        parent.remove(child)
    elif how == "double":
        parent.append(copy.deepcopy(child))
    elif how == "rename":
        child.tag = rng.choice(TAGS)
    elif how == "move" and pairs:
        into = rng.choice(pairs)[0]
        into.append(copy.deepcopy(child))
    elif how == "order":
        parent[:] = rng.sample(list(parent), len(parent))
    elif how == "attribute" and names:
        value = child.attrib.pop(rng.choice(names))
        if rng.random() < 0.5:
            child.set(rng.choice(["xyz", "value", "name", "link", "joint", "é", "a:b", "xmlns"]), value)
    elif how == "number":
        numbers = [(x, key) for x, _ in pairs for key in x.attrib if key not in ("name", "link", "joint", "type")]
        if numbers:
            x, key = rng.choice(numbers)
            words = x.get(key).split(" ")
            words[rng.randrange(len(words))] = rng.choice(NUMBERS)
            x.set(key, " ".join(words))
    elif how == "name" and names:
        known = [value for x, _ in pairs for key, value in x.attrib.items() if key in ("name", "link", "joint")]
        child.set(rng.choice(names), rng.choice([*NAMES, *known]))
    elif how == "kind":
        for x in rng.sample(root.findall("joint"), min(1, len(root.findall("joint")))):
            x.set("type", rng.choice(KINDS))


def huge(rng, kind):
    """A file that is large or deep: of elements, links, names, attributes or numbers."""
    n = rng.choice([1_000, 100_000])
    if kind == "depth":
        inside = rng.choice(["", "robot", "link", "x"])
        deep = f"<{inside or 'a'}>" * n + f"</{inside or 'a'}>" * n
        return rng.choice([deep, robot(deep), robot(f'<link name="l">{deep}</link>')])
    if kind in ("chain", "star", "circle"):
        n = rng.choice([200, 1999, 3000])
        links = "".join(f'<link name="l{i}"/>' for i in range(n))
        kinds = rng.choice([["fixed"], ["continuous"], ["fixed", "continuous"]])
        joints = ""
        for i in range(kind == "chain", n):
            ends = f'<parent link="{"base" if kind == "star" else f"l{(i - 1) % n}"}"/><child link="l{i}"/>'
            joints += f'<joint name="j{i}" type="{rng.choice(kinds)}">{ends}</joint>'
        base = '<joint name="b" type="fixed"><parent link="base"/><child link="l0"/></joint>' if kind == "chain" else ""
        return robot(links, base, joints)
    if kind == "name":
        return FILES[0].replace(rng.choice(['"r"', '"base"', '"a"', '"b_link"']), '"' + "é" * 10 * n + '"')
    if kind == "attributes":
        return FILES[0].replace("<axis", "<axis " + " ".join(f'a{i}="1"' for i in range(n)), 1)
    if kind == "numbers":
        return FILES[0].replace('xyz="0 1 0"', f'xyz="{"1 " * 10 * n}"', 1)
    if kind == "mimics":
        follow = [limb(f"f{i}", "base", more=mimic(f"f{i + 1}")) for i in range(rng.choice([50, 1000]))]
        return robot(*follow)
    if kind == "text":
        return FILES[1].replace("</joint>", "x" * 10 * n + "</joint>")
    return FILES[1].replace("<joint", "<!--" + "-x" * 5 * n + "--><joint", 1)


TOKEN = re.compile(r"<[/!?]?[\w:]*|/?>|[\w.:+-]+|[\"'= ]")
DOCTYPES = (
    "<!DOCTYPE robot>",
    '<!DOCTYPE robot [<!ENTITY a "b">]>',
    '<!DOCTYPE r [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;&a;"><!ENTITY c "&b;&b;&b;&b;&b;&b;">]>',
    '<!DOCTYPE r SYSTEM "file:///etc/passwd">',
    '<?xml version="1.0" encoding="utf-16"?>',
    '<?xml version="9.9"?>',
    "<?php x ?>",
    "\ufeff",
    "garbage",
)


class Case(NamedTuple):
    """A file and the options that it is read with."""

    source: str | bytes
    options: dict[str, str]


def case(number: int) -> Case:
    """File with a number."""
    rng = random.Random(number)
    options = {
        "base": rng.choice(["fixed", "fixed", "floating"]),
        "mimic": rng.choice(["independent", "coupled"]),
        "on_unphysical": rng.choice(["error", "warn", "repair", "ignore"]),
    }
    if rng.random() < 0.02:
        return Case(huge(rng, rng.choice(HUGE)), options)
    text = rng.choice(FILES)
    if rng.random() < 0.9:
        root = ET.fromstring(text.replace("drake:x", "drake"))
        for _ in range(rng.choice([1, 1, 1, 2, 3, 8])):
            wound(rng, root)
        text = ET.tostring(root, encoding="unicode")
    how = rng.random()
    if how < 0.05:
        text = text[: rng.randrange(len(text) + 1)]
    elif how < 0.1:
        text = rng.choice(DOCTYPES) + text.replace('"r"', rng.choice(['"&a;"', '"&c;"', '"r"', '"&#0;"', '"&lt;"']), 1)
    elif how < 0.15:
        tokens = TOKEN.findall(text)
        for _ in range(rng.choice([1, 2, 4])):
            tokens[rng.randrange(len(tokens))] = rng.choice(tokens)
        text = "".join(tokens)
    elif how < 0.2:
        at = rng.randrange(len(text) + 1)
        text = text[:at] + rng.choice(["\0", "<", ">", "&", '"', "\ud800", "\x1b", "é", "]]>", "<!--"]) + text[at:]
    if how < 0.75:
        return Case(text, options)
    encoding = rng.choice(["utf-8", "utf-8", "utf-8-sig", "utf-16", "utf-16-le", "latin-1", "utf-32", "cp500"])
    data = text.encode(encoding, errors="replace")
    if rng.random() < 0.1:
        at = rng.randrange(len(data) + 1)
        data = data[:at] + bytes(rng.randrange(256) for _ in range(3)) + data[at:]
    return Case(data, options)


# --- outcomes --------------------------------------------------------------------------------------------------------


class Outcome(NamedTuple):
    """Outcome of reading a file."""

    kind: str  # "Robot" or the name of an error
    seconds: float  # processor time that the thread spent
    megabytes: float  # more than before, at most; zero where it cannot be known


def outcome(file: Case) -> Outcome:
    """Outcome of a file; anything but a robot or an error of the package is let through."""
    memory = Path("/proc/self/clear_refs")
    before = 0.0
    if memory.exists():
        memory.write_text("5")  # forgets the largest size so far
        before = _memory()
    begin = time.thread_time()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = Robot.from_urdf(file.source, **file.options)
    except TorchdqError as error:
        kind = type(error).__name__
        str(error).encode("utf-8", errors="strict" if "\ud800" not in str(file.source) else "replace")
    else:
        kind = "Robot"
    seconds = time.thread_time() - begin
    if kind == "Robot":
        assert found.name and str(found.report())
        require_finite(found)
        if file.options.get("on_unphysical", "error") == "error":
            require_numbers(found, torchdq.forward_dynamics, "joint.inert", "robot.massless")
    return Outcome(kind, seconds, _memory() - before if memory.exists() else 0.0)


def require_finite(robot: Robot) -> None:
    """Numbers of a robot, and the torques of a small one."""
    tensors = [robot.X_PB_home, robot.screw, robot.mass, robot.com, robot.inertia, robot.damping, robot.friction]
    assert all(bool(x.isfinite().all()) for x in (*tensors, *(frame.X_BF for frame in robot.frames)))
    assert not any(bool(x.isnan().any()) for x in robot.limits)
    require_numbers(robot, torchdq.inverse_dynamics, "robot.massless")


def require_numbers(robot: Robot, function, *unless: str) -> None:
    """Results of a small robot are numbers, unless a note says that a joint or all of them move nothing."""
    if robot.n > 8 or robot.floating:
        return
    q = torch.full((robot.n,), 0.3, dtype=torch.float64)
    try:
        assert bool(function(robot, q, q, q, backend="eager").isfinite().all())
    except SingularInertiaError:
        assert any(note.code in unless for note in robot.notes)


def _memory():
    """Largest size of this process since it was last forgotten [MB]."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(float(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM"))


def main():
    """Run cases and tell of those that end in anything else."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--cases", type=int, default=20_000)
    parser.add_argument("--first", type=int, default=0)
    arguments = parser.parse_args()
    fates, worst, bad = Counter(), [0.0, 0.0], []
    outcome(Case(FILES[0], {}))  # the first has to import things
    for number in range(arguments.first, arguments.first + arguments.cases):
        try:
            found = outcome(case(number))
        except Exception as error:  # the very thing that is looked for
            bad.append(f"case {number}: {type(error).__name__}: {str(error)[:200]}")
            continue
        fates[found.kind] += 1
        worst = [max(worst[0], found.seconds), max(worst[1], found.megabytes)]
        if found.seconds > SECONDS or found.megabytes > MEGABYTES:
            bad.append(f"case {number}: {found.seconds:.2f} s, {found.megabytes:.0f} MB")
    print("\n".join(bad))
    named = ", ".join(f"{kind} {count}" for kind, count in fates.most_common())
    print(f"{arguments.cases} cases: {named}; at most {worst[0]:.2f} s and {worst[1]:.0f} MB; {len(bad)} bad")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
