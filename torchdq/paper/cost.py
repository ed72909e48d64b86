"""Costs of the paper's algorithms, counted by running them on chains of joints, compared with the printed costs.

`torchdq cost` prints it.
"""

import math
import random
from collections.abc import Callable, Sequence
from functools import partial, reduce
from typing import Any, NamedTuple

from torchdq.algebra import dual_quaternion as dq
from torchdq.algebra import quaternion as quat
from torchdq.algebra import screw
from torchdq.algebra.dual_quaternion import DualQuaternion
from torchdq.algebra.inertia import Inertia
from torchdq.dynamics.general import kinematics, rnea
from torchdq.dynamics.joints import KINDS, Coordinate
from torchdq.dynamics.tree import Tree, on_base
from torchdq.numbers.count import Cost, cost, dense, executed
from torchdq.paper import homogeneous, printed
from torchdq.paper.tables import PER_JOINT, TABLE_4, TABLES, Entry, markdown, motion, number, several
from torchdq.robot import Robot


def chain(n: int, kinds: str = "R") -> tuple[Tree, DualQuaternion]:
    """Chain with frames at the centres of mass, and its tip's pose; no constant but two of gravity's is zero or one.

    Args:
        n: number of joints.
        kinds: their kinds in order, repeated: R, P or H.
    """
    rng = random.Random(n)

    def unit(size: int) -> Any:
        x = [rng.gauss(0.0, 1.0) for _ in range(size)]
        length = math.sqrt(sum(v * v for v in x))
        return tuple(v / length for v in x)

    def pose() -> DualQuaternion:
        return dq.from_pose(unit(4), tuple(rng.uniform(0.1, 0.5) for _ in range(3)))

    joints, poses, inertias = [], [], []
    for i in range(n):
        axis, point = unit(3), tuple(rng.uniform(0.1, 0.5) for _ in range(3))
        kind = {"R": "revolute", "P": "prismatic", "H": "helical"}[kinds[i % len(kinds)]]
        moment = quat.cross(point, axis)
        line = {
            "revolute": (axis, moment),
            "prismatic": ((0.0,) * 3, axis),
            "helical": (axis, quat.add(moment, quat.scale(0.2, axis))),
        }
        a, b, c = (rng.uniform(0.1, 0.2) for _ in range(3))
        off = [rng.uniform(0.005, 0.01) for _ in range(3)]
        inertia = ((a, off[0], off[1]), (off[0], b, off[2]), (off[1], off[2], c))
        joints.append(KINDS[kind](line[kind]))
        poses.append(pose())
        inertias.append(Inertia(rng.uniform(1.0, 2.0), None, inertia))
    return on_base(range(-1, n - 1), joints, poses, inertias, None, (0.0, 0.0, -9.81)), pose()


def robot(tree: Tree, tip: DualQuaternion) -> Robot:
    """Robot of a `chain` whose tip has that pose in the last link."""
    links = tree.links[1:]
    poses = kinematics.link_poses(tree, [link.placement for link in tree.links])[1:]
    axes = [screw.ad(screw.columns(X), link.joint.screw) for X, link in zip(poses, links, strict=True)]
    end = dq.mul(poses[-1], tip)
    return Robot.from_screws(
        [[*a[0], *a[1]] for a in axes],
        [link.inertia.mass for link in links],
        [[0.0] * 3] * len(poses),
        [link.inertia.rotational for link in links],
        link_poses=[[*X[0], *X[1]] for X in poses],
        tip_pose=[*end[0], *end[1]],
        gravity=tree.gravity,
    )


def coordinates(n: int) -> list[Coordinate | None]:
    """Joint displacements as inputs, behind the base, which has none."""
    return [None, *(Coordinate(*several(3)) for _ in range(n))]


def displacements(n: int) -> list[homogeneous.Displacement]:
    """Joint displacements as inputs of Rodrigues' formula."""
    return [homogeneous.Displacement(*several(4)) for _ in range(n)]


def dqrnea_as_printed(n: int, full: bool = False) -> Cost:
    """Cost of Algorithm 1 with the operators (34) to (36) as printed; `full`: no zero is known as one."""
    robot, tip = chain(n)
    Ad_tip = screw.columns(tip)
    still = screw.ZERO
    if full:
        robot, Ad_tip, still = _all_counted(robot), dense(Ad_tip), dense(still)
    return _running(lambda: printed.rnea(robot, coordinates(n), several(n), several(n), Ad_tip, motion(), still))


def dqrnea(n: int) -> Cost:
    """Cost of Algorithm 1 as this package has it in the paper's frames."""
    robot, tip = chain(n)
    exerted = rnea.exerted_wrenches(n + 1, None, (n, screw.columns(tip)), motion())
    Ad = kinematics.adjoints(kinematics.joint_poses(robot, coordinates(n)))
    return cost(rnea.rnea(robot, Ad, several(n), several(n), exerted))


def htm_rnea(n: int, full: bool = False) -> Cost:
    """Cost of the algorithm of Lynch and Park by 4x4 and 6x6 matrices; `full`: no zero or one is known as such."""
    robot, tip = chain(n)
    bodies, T, gravity = homogeneous.bodies(robot), homogeneous.matrix(dq.conj(tip)), robot.gravity
    units = homogeneous.KNOWN
    if full:
        bodies = tuple(
            homogeneous.Body(dense(b.home), homogeneous.Generator(True, *dense(tuple(b.joint)[1:])), dense(b.G))
            for b in bodies
        )
        T, gravity, units = dense(T), dense(gravity), homogeneous.Units(number(), number())
    return _running(
        lambda: homogeneous.rnea(bodies, gravity or (), displacements(n), several(n), several(n), T, several(6), units)
    )


def _all_counted(tree: Tree) -> Tree:
    """Tree with counted numbers for all its constants."""
    links = tuple(
        link._replace(
            placement=dense(link.placement),
            joint=type(link.joint)(dense(link.joint.screw)),
            inertia=Inertia(number(), None, dense(link.inertia.rotational)),
        )
        for link in tree.links[1:]
    )
    return Tree((tree.links[0], *links), dense(tree.gravity))


def _running(formula: Callable[[], Any]) -> Cost:
    """Cost of executing a whole algorithm, without the storage, which is counted for single operations only."""
    return executed(formula)._replace(storage=0)


class Line(NamedTuple):
    """Growth of an algorithm's cost with the number of joints."""

    name: str
    at: Callable[[int], Cost]

    def law(self) -> str:
        """Cost as multiples of n, exact from two joints on."""
        a, b = self.at(6), self.at(7)
        slopes = [y - x for x, y in zip(a, b, strict=True)]
        rest = [x - 6 * k for k, x in zip(slopes, a, strict=True)]
        text = [f"{k}n{r:+d}" if r else f"{k}n" for k, r in zip(slopes, rest, strict=True)]
        return f"{text[0]}, {text[1]}"


FKM = (
    Line("HTM, D-H", lambda n: _dense_products(n, 3, 64, 48)),
    Line("HTM, screws", lambda n: _dense_products(n, 1, 64, 48)),
    Line("UDQ, D-H", lambda n: _dense_products(n, 3, 48, 40)),
    Line("UDQ, screws", lambda n: _dense_products(n, 1, 48, 40)),
)


def _dense_products(n: int, products: int, multiplications: int, additions: int) -> Cost:
    return Cost(n * products * multiplications, n * products * additions, 0)


def htm_dh_kinematics(n: int) -> Cost:
    """Cost of the pose of a chain's tip by D-H matrices, zeros and ones known."""
    steps = [homogeneous.denavit_hartenberg(number(), number(), (0.6, 0.8), 0.3, 0.4) for _ in range(n)]
    return cost(reduce(homogeneous.product, steps))


def htm_screw_kinematics(n: int) -> Cost:
    """Cost of the pose of a chain's tip by exponentials of screws in the base frame, zeros and ones known."""
    robot, tip = chain(n)
    steps = [
        homogeneous.exponential(homogeneous.generator(link.joint.screw), displacement)
        for link, displacement in zip(robot.links[1:], displacements(n), strict=True)
    ]
    return cost(reduce(homogeneous.product, [*steps, homogeneous.matrix(tip)]))


def udq_dh_kinematics(n: int) -> Cost:
    """Cost of the pose of a chain's tip by D-H dual quaternions, zeros and ones known."""
    return cost(reduce(dq.mul, [printed.denavit_hartenberg(several(2), (0.6, 0.8), 0.3, 0.4) for _ in range(n)]))


def udq_screw_kinematics(n: int) -> Cost:
    """Cost of the pose of a chain's tip by exponentials as dual quaternions, screws in the base frame, zeros known."""
    robot, tip = chain(n)
    steps = [link.joint.motion(q) for link, q in zip(robot.links[1:], coordinates(n)[1:], strict=True)]
    return cost(reduce(dq.mul, [*steps, tip]))  # (39) with x = exp(s_1) ... exp(s_n) delta


FKM_FOLDED = (
    Line("HTM, D-H", htm_dh_kinematics),
    Line("HTM, screws", htm_screw_kinematics),
    Line("UDQ, D-H", udq_dh_kinematics),
    Line("UDQ, screws", udq_screw_kinematics),
)
RNEA = (
    Line("dqRNEA as printed in Table 4", lambda n: Cost(321 * n, 273 * n, 0)),
    Line("dqRNEA, operators as printed", dqrnea_as_printed),
    Line("dqRNEA, no zero known", partial(dqrnea_as_printed, full=True)),
    Line("dqRNEA, as this package has it", dqrnea),
    Line("HTM, no zero known", partial(htm_rnea, full=True)),
    Line("HTM, zeros and ones known", htm_rnea),
)


# --- text ------------------------------------------------------------------------------------------------------------


def rows(entries: Sequence[Entry]) -> list[tuple[str, ...]]:
    """Table of printed and counted costs, with verdicts; headings first."""

    def shown(c: Cost | None) -> str:
        return "" if c is None else f"{c.storage}f {c.multiplications}x {c.additions}+"

    found = [(e.operation, shown(e.printed), shown(e.counted), e.verdict) for e in entries]
    return [("operation", "printed", "counted", "verdict"), *found]


def sections() -> dict[str, list[tuple[str, ...]]]:
    """All tables, and the laws of the algorithms; headings first."""
    found = {title: rows(entries) for title, entries in TABLES.items()}
    total = [sum(values) for values in zip(*(e.counted for e in TABLE_4 if e.operation in PER_JOINT), strict=True)]
    sums = ("321n 273n+", f"{total[0]}n {total[1]}n+")
    found["Table 4, the algorithm per joint"].append(("sum with screws", *sums, ""))
    for title, lines in (("Forward kinematics, zeros known", FKM_FOLDED), ("Inverse dynamics with f_EF", RNEA)):
        found[title] = [("algorithm", "multiplications, additions"), *((line.name, line.law()) for line in lines)]
    return found


def report() -> str:
    """All tables in Markdown."""
    return "\n\n".join(f"## {title}\n\n{markdown(table)}" for title, table in sections().items())
