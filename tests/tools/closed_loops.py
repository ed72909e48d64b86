"""Robots with loops: a four-bar linkage, whose motion one equation has, a gripper of linkages, and a delta robot."""

import math

import torchdq
from torchdq import Closure

LINK = """<link name="{0}"><inertial><origin xyz="{4}"/><mass value="{5}"/>
  <inertia ixx="{6}" ixy="0" ixz="0" iyy="{7}" iyz="0" izz="{8}"/></inertial></link>
  <joint name="j{0}" type="continuous"><parent link="{1}"/><child link="{0}"/><origin xyz="{2}"/>
  <axis xyz="{3}"/></joint>"""
FRAME = """<link name="{0}"/><joint name="to_{0}" type="fixed"><parent link="{1}"/><child link="{0}"/>
  <origin xyz="{2}" rpy="{3}"/></joint>"""


def link(name, parent, at, axis, centre=(0, 0, 0), mass=0.0, moments=(0, 0, 0)):
    """Link on a hinge at a place of its parent."""
    triples = [" ".join(map(str, x)) for x in (at, axis, centre)]
    return LINK.format(name, parent, *triples, mass, *moments)


def frame(name, parent, at, turned=(0, 0, 0)):
    return FRAME.format(name, parent, *(" ".join(map(str, x)) for x in (at, turned)))


def text(*parts):
    """URDF of links on a base without mass."""
    return '<robot name="bars"><link name="ground"/>' + "".join(parts) + "</robot>"


def four_bar():
    """Three uniform bars of 1 kg/m in the x-z plane, hinged in a row, of which the last ends at a pivot 0.4 m away."""
    parts, parent, at = [], "ground", 0.0
    for name, length in (("a", 0.2), ("b", 0.4), ("c", 0.4)):
        moment = length**3 / 12
        parts.append(link(name, parent, (at, 0, 0), (0, -1, 0), (length / 2, 0, 0), length, (1e-5, moment, moment)))
        parent, at = name, length
    ends = frame("end", "c", (0.4, 0, 0)), frame("pivot", "ground", (0.4, 0, 0))
    return torchdq.Robot.from_urdf(text(*parts, *ends), tip="end").with_closures(Closure("pivot", "end"))


def gripper():
    """URDF and closures of two fingers on four bars each, in a plane that no axis lies in; a row of each is implied."""
    parts = [frame("palm", "ground", (0.1, -0.2, 0.3), (0.3, 0.5, -0.7))]
    for s, side in ((1, "left"), (-1, "right")):
        axis, light = (0.0, s, 0.0), (2e-6, 3e-6, 2e-6)
        parts += [
            link(f"{side}_driver", "palm", (0.03 * s, 0, 0.05), axis, (0.01 * s, 0.001, 0.004), 0.009, light),
            link(f"{side}_coupler", f"{side}_driver", (0.03 * s, 0, -0.004), axis, (0, 0, 0.02), 0.014, light),
            link(f"{side}_spring", "palm", (0.013 * s, 0, 0.06), axis, (0.01 * s, 0, 0.02), 0.022, light),
            link(f"{side}_pad", f"{side}_spring", (0.03 * s, 0, 0.04), axis, (0, 0.002, 0.02), 0.012, light),
            frame(f"{side}_end", f"{side}_coupler", (0.006 * s, 0, 0.03)),
            frame(f"{side}_pin", f"{side}_pad", (-0.018 * s, 0, 0.006)),
        ]
    return text(*parts), [Closure(f"{side}_end", f"{side}_pin") for side in ("left", "right")]


def delta():
    """URDF and closures of three arms with two rods each that carry a platform, hung from the first rod.

    Rods do not spin about themselves, so that three degrees of freedom are left of 18 joints and 15 rows.
    """
    parts, closures, rod = [], [], (2e-3, 2e-3, 1e-5)
    for k in range(3):
        arm, turn = f"arm{k}", 2 * math.pi * k / 3
        parts += [
            frame(f"pivot{k}", "ground", (0.2 * math.cos(turn), 0.2 * math.sin(turn), 0), (0, 0, turn)),
            link(arm, f"pivot{k}", (0, 0, 0), (0, 1, 0), (0.15, 0, 0.01), 0.4, (1e-4, 3e-3, 3e-3)),
        ]
        for side, y in enumerate((-0.05, 0.05)):
            name, first = f"rod{k}{side}", k == side == 0
            parts += [
                link(f"{name}_x", arm, (0.3, y, 0), (1, 0, 0)),
                link(name, f"{name}_x", (0, 0, 0), (0, 1, 0), (0, 0, -0.3), 0.06, rod),
            ]
            if first:
                parts += [
                    link("ball_x", name, (0, 0, -0.6), (1, 0, 0)),
                    link("ball_y", "ball_x", (0, 0, 0), (0, 1, 0)),
                    link("platform", "ball_y", (0, 0, 0), (0, 0, 1), (-0.08, 0.05, 0), 0.3, (4e-4, 5e-4, 7e-4)),
                ]
            else:
                x, y = 0.08 * math.cos(turn) - y * math.sin(turn), 0.08 * math.sin(turn) + y * math.cos(turn)
                parts += [
                    frame(f"{name}_end", name, (0, 0, -0.6)),
                    frame(f"{name}_hole", "platform", (x - 0.08, y + 0.05, 0)),
                ]
                closures.append(Closure(f"{name}_end", f"{name}_hole"))
    return text(*parts), closures
