"""What the paper's operations and algorithms cost, counted by running them, beside what it prints: Tables 2, 3 and 4.

`python -m torchdq cost` prints the tables. A count is multiplications, additions, and the numbers an operation reads
(storage); the rules are those of `torchdq.numbers.count`.
"""

from __future__ import annotations

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
from torchdq.dynamics.joints import KINDS, Coordinate
from torchdq.dynamics.paper import kinematics, rnea
from torchdq.dynamics.tree import Tree, plant
from torchdq.numbers.count import Cost, Counted, cost, dense, executed
from torchdq.paper import homogeneous, printed
from torchdq.robot import Robot


class Entry(NamedTuple):
    """A row of a table."""

    operation: str
    printed: Cost | None  # None: the row is not in the paper
    formula: Callable[[], Any]
    remark: str = ""  # why it differs
    whole: bool = False  # what is computed and not used counts as well

    @property
    def counted(self) -> Cost:
        """What the formula costs."""
        return executed(self.formula) if self.whole else cost(self.formula())

    @property
    def verdict(self) -> str:
        """What to think of the printed entry."""
        if self.printed is None:
            return self.remark or "not in the paper"
        what = zip(("multiplications", "additions", "storage"), self.printed, self.counted, strict=True)
        wrong = [name for name, theirs, ours in what if theirs != ours]
        verb = "differs" if wrong == ["storage"] else "differ"
        found = f"{' and '.join(wrong)} {verb}" if wrong else "as printed"
        return f"{found}: {self.remark}" if self.remark else found


# --- operands --------------------------------------------------------------------------------------------------------


def number() -> Counted:
    """A number."""
    return Counted()


def vector(size: int = 3) -> Any:
    """A vector."""
    return tuple(Counted() for _ in range(size))


def quaternion() -> tuple[Counted, ...]:
    """A quaternion."""
    return vector(4)


def dual_quaternion() -> Any:
    """A dual quaternion."""
    return quaternion(), quaternion()


def motion() -> Any:
    """A screw."""
    return vector(), vector()


def operator() -> Any:
    """Columns A_P and A_D."""
    return tuple(tuple(vector() for _ in range(3)) for _ in range(2))


def tensor() -> Any:
    """A rotational inertia by its rows."""
    return tuple(vector() for _ in range(3))


def accelerated(a: Any, qd: Any, qdd: Any, x: Any, twist: Any, acceleration: Any) -> Any:
    """a qdd + Ad(x) wd + (w x a) qd (44)."""
    return screw.add(screw.add(screw.scale(qdd, a), screw.ad(x, acceleration)), screw.scale(qd, screw.cross(twist, a)))


def net_wrench(mass: Any, inertia: Any, twist: Any, acceleration: Any) -> Any:
    """w x G(w) + G(wd) (45)."""
    g = Inertia(mass, None, inertia).momentum
    return screw.add(screw.cross(twist, g(twist)), g(acceleration))


# --- tables ----------------------------------------------------------------------------------------------------------

TABLE_2 = (
    Entry("addition", Cost(0, 4, 8), lambda: quat.add(quaternion(), quaternion())),
    Entry("multiplication by scalar", Cost(4, 0, 5), lambda: quat.scale(number(), quaternion())),
    Entry("quaternion multiplication (1)", Cost(16, 12, 8), lambda: quat.mul(quaternion(), quaternion())),
    Entry(
        "quaternion cross product (4)",
        Cost(9, 5, 6),
        lambda: quat.cross(vector(), vector()),
        "6 and 3 by components; (ab - ba)/2 to the letter is the next row",
    ),
    Entry(
        "(ab - ba)/2 by two products",
        None,
        lambda: printed.cross(vector(), vector()),
        "neither form gives the printed 9 and 5",
        whole=True,
    ),
    Entry("quaternion inner product (3)", Cost(3, 2, 6), lambda: quat.dot(vector(), vector())),
    Entry(
        "matrix linear transformation T4 (20)",
        Cost(16, 12, 20),
        lambda: quat.t4(tuple(quaternion() for _ in range(4)), quaternion()),
    ),
    Entry(
        "Hamilton operator applied (23)",
        Cost(16, 12, 8),
        lambda: quat.t4(quat.hamilton_left(quaternion()), quaternion()),
    ),
    Entry(
        "quaternion adjoint transformation",
        Cost(20, 28, 7),
        lambda: quat.im(quat.mul(quat.mul(x := quaternion(), (0.0, *vector())), quat.conj(x))),
        "the printed columns are exchanged",
        whole=True,
    ),
    Entry(
        "the same by two cross products", None, lambda: quat.rotate(quaternion(), vector()), "what this package does"
    ),
)

TABLE_3 = (
    Entry("addition", Cost(0, 8, 16), lambda: dq.add(dual_quaternion(), dual_quaternion())),
    Entry("multiplication by scalar", Cost(8, 0, 9), lambda: dq.scale(number(), dual_quaternion())),
    Entry("dual quaternion multiplication", Cost(48, 40, 16), lambda: dq.mul(dual_quaternion(), dual_quaternion())),
    Entry("cross product (6)", Cost(18, 12, 12), lambda: screw.cross(motion(), motion())),
    Entry(
        "inner product (16)",
        Cost(6, 5, 12),
        lambda: screw.inner(motion(), motion()),
        "the printed numbers are those of the next row; (16) is a dual number",
    ),
    Entry("double geodesic product (7)", Cost(6, 5, 12), lambda: screw.double_geodesic(motion(), motion())),
    Entry(
        "linear transformation T8 (21)",
        Cost(64, 56, 72),
        lambda: dq.t8(tuple(dual_quaternion() for _ in range(8)), dual_quaternion()),
    ),
    Entry(
        "Hamilton operator applied (24)",
        Cost(48, 48, 28),
        lambda: printed.hamilton(dual_quaternion(), dual_quaternion()),
        "three T4 are 48 and 36, and joining them 4; it reads two dual quaternions",
    ),
    Entry(
        "construction of A_P and A_D (34), (35)",
        Cost(108, 72, 12),
        lambda: printed.columns(dual_quaternion()),
        "it reads one dual quaternion; what it makes is 24 numbers, of which 6 are never used",
        whole=True,
    ),
    Entry(
        "the same by p x A_P",
        None,
        lambda: screw.columns(dual_quaternion()),
        "what this package does: the rotation matrix, the position, and three cross products",
    ),
    Entry(
        "adjoint from them (36)",
        Cost(27, 30, 30),
        lambda: screw.ad(operator(), motion()),
        "three products of 3x3 matrices and vectors and one sum; 24 numbers if the columns are vectors",
    ),
    Entry("the same by x m x* (33)", None, lambda: printed.ad(dual_quaternion(), motion()), "two products"),
)

TABLE_4 = (
    Entry(
        "(39), D-H",
        Cost(144, 120, 24),
        lambda: printed.denavit_hartenberg(vector(2), vector(2), number(), number(), number(), number()),
        "three dense products make the local transform only; chaining it is a fourth",
        whole=True,
    ),
    Entry(
        "(39), D-H, zeros known",
        None,
        lambda: printed.denavit_hartenberg(vector(2), vector(2), number(), number()),
        "the local transform, without its chaining product",
    ),
    Entry(
        "(39), screws",
        Cost(48, 40, 8),
        lambda: dq.mul(dual_quaternion(), dual_quaternion()),
        "one product of two dual quaternions, which are 16 numbers",
    ),
    Entry(
        "(38), revolute",
        None,
        lambda: dq.mul(dual_quaternion(), screw.exp_revolute(motion(), number(), number())),
        "left out in the paper: the recursion needs (38), and (39) only for the pose of the end effector",
    ),
    Entry(
        "(34), (35)",
        Cost(108, 72, 12),
        lambda: printed.columns(dual_quaternion()),
        "as in Table 3",
        whole=True,
    ),
    Entry(
        "(40)",
        Cost(33, 36, 37),
        lambda: screw.add(screw.scale(number(), motion()), screw.ad(operator(), motion())),
        "inherits the additions of (36)",
    ),
    Entry(
        "(44)",
        Cost(57, 54, 44),
        lambda: accelerated(motion(), number(), number(), operator(), motion(), motion()),
        "inherits the additions of (36)",
    ),
    Entry("(45)", Cost(42, 30, 22), lambda: net_wrench(number(), tensor(), motion(), motion())),
    Entry(
        "(46)",
        Cost(27, 36, 36),
        lambda: screw.add(motion(), screw.ad(operator(), motion())),
        "inherits the additions of (36)",
    ),
    Entry("(48)", Cost(6, 5, 12), lambda: screw.power(motion(), motion())),
)
TABLES = {
    "Table 2, quaternions": TABLE_2,
    "Table 3, dual quaternions": TABLE_3,
    "Table 4, the algorithm per joint": TABLE_4,
}


# --- algorithms ------------------------------------------------------------------------------------------------------


def chain(n: int, kinds: str = "R") -> tuple[Tree, DualQuaternion]:
    """A chain with frames at the centres of mass, and its tip's pose; no constant but two of gravity's is zero or one.

    Args:
        n: number of joints.
        kinds: their kinds in order, repeated: R, P or H.
    """
    rng = random.Random(n)

    def unit(size: int) -> Any:
        x = [rng.gauss(0.0, 1.0) for _ in range(size)]
        length = math.sqrt(sum(v * v for v in x))
        return tuple(v / length for v in x)

    def pose() -> Any:
        r, p = unit(4), (0.0, *(rng.uniform(0.1, 0.5) for _ in range(3)))
        return r, quat.scale(0.5, quat.mul(p, r))

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
    return plant(range(-1, n - 1), joints, poses, inertias, None, (0.0, 0.0, -9.81)), pose()


def robot(tree: Tree, tip: DualQuaternion) -> Robot:
    """The robot of such a chain, whose tip has that pose in the last link."""
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
    return [None, *(Coordinate(*vector(3)) for _ in range(n))]


def turns(n: int) -> list[homogeneous.Turn]:
    """The same for Rodrigues' formula."""
    return [homogeneous.Turn(*vector(4)) for _ in range(n)]


def dqrnea_as_printed(n: int, full: bool = False) -> Cost:
    """Algorithm 1 with the operators (34) to (36) as printed; `full`: no zero is known as one."""
    robot, tip = chain(n)
    Ad_tip = screw.columns(tip)
    still: Any = ((0.0,) * 3, (0.0,) * 3)
    if full:
        robot, Ad_tip, still = _hidden(robot), dense(Ad_tip), dense(still)
    return _running(lambda: printed.rnea(robot, coordinates(n), vector(n), vector(n), Ad_tip, motion(), still), n)


def dqrnea(n: int) -> Cost:
    """Algorithm 1 as this package has it in the paper's frames."""
    robot, tip = chain(n)
    exerted = rnea.exerted_wrenches(n + 1, None, (n, screw.columns(tip)), motion())
    Ad = kinematics.adjoints(kinematics.joint_poses(robot, coordinates(n)))
    return cost(rnea.rnea(robot, Ad, vector(n), vector(n), exerted))


def htm_rnea(n: int, full: bool = False) -> Cost:
    """The algorithm of Lynch and Park by 4x4 and 6x6 matrices; `full`: no zero or one is known as such."""
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
        lambda: homogeneous.rnea(bodies, gravity or (), turns(n), vector(n), vector(n), T, vector(6), units), n
    )


def _hidden(tree: Tree) -> Tree:
    """The tree with counted numbers for all its constants."""
    links = tuple(
        link._replace(
            placement=dense(link.placement),
            joint=type(link.joint)(dense(link.joint.screw)),
            inertia=Inertia(number(), None, dense(link.inertia.rotational)),
        )
        for link in tree.links[1:]
    )
    return Tree((tree.links[0], *links), dense(tree.gravity))


def _running(formula: Callable[[], Any], n: int) -> Cost:
    """What a formula executes; its storage is not that of a running machine, so it is left out."""
    return executed(formula)._replace(storage=0)


class Line(NamedTuple):
    """How the cost of an algorithm grows with the number of joints."""

    name: str
    at: Callable[[int], Cost]
    stated: str = ""  # in `multiplications, additions`, where the literature or the paper says

    def law(self) -> str:
        """The cost as multiples of n, exact from two joints on."""
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
    """Pose of a chain's tip by D-H matrices, zeros and ones known."""
    return cost(
        homogeneous.chained(
            [homogeneous.denavit_hartenberg(number(), number(), (0.6, 0.8), 0.3, 0.4) for _ in range(n)]
        )[-1]
    )


def htm_screw_kinematics(n: int) -> Cost:
    """Pose of a chain's tip by exponentials of screws in the base frame, zeros and ones known."""
    robot, tip = chain(n)
    steps = [
        homogeneous.exponential(homogeneous.generator(link.joint.screw), turn)
        for link, turn in zip(robot.links[1:], turns(n), strict=True)
    ]
    return cost(homogeneous.chained([*steps, homogeneous.matrix(tip)])[-1])


def udq_dh_kinematics(n: int) -> Cost:
    """Pose of a chain's tip by D-H dual quaternions, zeros and ones known."""
    pose: DualQuaternion | None = None
    for _ in range(n):
        step = printed.denavit_hartenberg(vector(2), (0.6, 0.8), 0.3, 0.4)
        pose = step if pose is None else dq.mul(pose, step)
    return cost(pose)


def udq_screw_kinematics(n: int) -> Cost:
    """Pose of a chain's tip by dual quaternion exponentials of screws in the base frame, zeros and ones known."""
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
    Line("dqRNEA as printed in Table 4", lambda n: Cost(321 * n, 273 * n, 0), "321n, 273n"),
    Line("dqRNEA, operators as printed", dqrnea_as_printed),
    Line("dqRNEA, no zero known", partial(dqrnea_as_printed, full=True)),
    Line("dqRNEA, as this package has it", dqrnea),
    Line("HTM, no zero known", partial(htm_rnea, full=True)),
    Line("HTM, zeros and ones known", htm_rnea),
)


# --- text ------------------------------------------------------------------------------------------------------------


def table(entries: Sequence[Entry]) -> str:
    """A table of printed and counted costs, with verdicts, in Markdown."""

    def shown(c: Cost | None) -> str:
        return "" if c is None else f"{c.storage}f {c.multiplications}x {c.additions}+"

    rows = [f"| {e.operation} | {shown(e.printed)} | {shown(e.counted)} | {e.verdict} |" for e in entries]
    return "\n".join(["| operation | printed | counted | verdict |", "|---|---|---|---|", *rows])


def report() -> str:
    """All tables, and the laws of the algorithms."""
    parts = [f"## {title}\n\n{table(entries)}" for title, entries in TABLES.items()]
    total = [sum(values) for values in zip(*(e.counted for e in TABLE_4 if e.operation in PER_JOINT), strict=True)]
    parts.append(
        f"Sum of the rows of Table 4 with screws: printed 321n multiplications, 273n additions; counted {total[0]}n, "
        f"{total[1]}n."
    )
    for title, lines in (("Forward kinematics, zeros known", FKM_FOLDED), ("Inverse dynamics with f_EF", RNEA)):
        rows = "\n".join(f"| {line.name} | {line.law()} |" for line in lines)
        parts.append(f"## {title}\n\n| algorithm | multiplications, additions |\n|---|---|\n{rows}")
    return "\n\n".join(parts)


PER_JOINT = ("(39), screws", "(34), (35)", "(40)", "(44)", "(45)", "(46)", "(48)")
