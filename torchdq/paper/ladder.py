"""From the printed Algorithm 1 to the program that runs, one step at a time.

Every step computes the same torques of the same robot. What changes from one to the next is named, counted on the
recorded program, and derived in docs/how-it-works.md.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import torch

from torchdq.algebra import quaternion as quat
from torchdq.algebra import screw
from torchdq.algebra.inertia import Inertia
from torchdq.algebra.quaternion import Number, Pure
from torchdq.algebra.screw import Screw
from torchdq.algebra.structural import add
from torchdq.backends.choice import choose
from torchdq.backends.precision import run
from torchdq.base.timing import digits, medians
from torchdq.dynamics.aligned import rnea
from torchdq.dynamics.aligned.placement import Steps
from torchdq.dynamics.tree import Tree
from torchdq.functions import posed
from torchdq.paper import cost, printed
from torchdq.paper.tables import markdown
from torchdq.program.program import Argument, Program, record
from torchdq.robot.robot import Robot

Row = Sequence[Number]


class LadderForm(NamedTuple):
    """Step of the ladder: its change, and the torques after it."""

    name: str
    torques: Callable[[Robot, Row, Row, Row], Sequence[Number]]

    def program(self, robot: Robot) -> Program:
        """Program of the torques of a robot."""
        arguments = [Argument(name, robot.n) for name in ("q", "qd", "qdd")]
        return record("torques", arguments, lambda *x: {"tau": self.torques(robot, *x)})


def as_printed(robot: Robot, q: Row, qd: Row, qdd: Row) -> Sequence[Number]:
    """Algorithm 1 line by line: (34)-(36), (38), (40), (44)-(48), corrected; frames at the centres of mass."""
    return printed.rnea(posed.tree(robot, {}), posed.coordinates(robot, q, {}, None), qd, qdd)


def zeros_known(robot: Robot, q: Row, qd: Row, qdd: Row) -> Sequence[Number]:
    """Columns A_D as p x A_P, the base at rest, and each operator built once for both directions."""
    return posed.general(robot, q, {}).torques(qd, qdd, None)


def aligned_frames(robot: Robot, q: Row, qd: Row, qdd: Row) -> list[Number]:
    """Recursion of Algorithm 1 in frames whose z axes are the joint axes: Ad by elementary screws."""
    at = posed.aligned(robot, q, {}, group=False)
    tree, steps = at.tree, at.steps
    V: list[Any] = [screw.ZERO]
    A: list[Any] = [rnea.base_motion(None, tree.gravity, None, None).A]
    for i, (rate, change) in enumerate(zip(tree.rates(qd)[1:], tree.rates(qdd)[1:], strict=True), 1):
        step, parent = steps[i], tree.links[i].parent
        V.append(add(rate, step.to_link(V[parent])))  # (40)
        A.append(add(change, step.to_link(A[parent]), screw.cross(V[i], rate)))  # (44)
    bodies = [link.inertia and link.inertia.inertia for link in tree.links]
    net = [b and printed.net_wrench(b, v, a) for b, v, a in zip(bodies, V, A, strict=True)]  # (45)
    return inward(tree, steps, net)


def without_dual_part(robot: Robot, q: Row, qd: Row, qdd: Row, group: bool = False) -> list[Number]:
    """Recursion without the dual part of the twists; that of the accelerations becomes the origin's acceleration d."""
    at = posed.aligned(robot, q, {}, group)
    tree, steps = at.tree, at.steps
    still = rnea.base_motion(None, tree.gravity, None, None)
    motion: list[tuple[Pure, Pure, Pure]] = [(still.w, *still.A)]
    net: list[Screw | None] = [None]
    for i, (rate, change) in enumerate(zip(tree.rates(qd)[1:], tree.rates(qdd)[1:], strict=True), 1):
        step, link = steps[i], tree.links[i]
        w, wd, d = motion[link.parent]
        d = quat.add(d, accelerated(w, wd, step.placement.p))
        w, wd, d = (step.vector_to_link(x) for x in (w, wd, d))
        twice = quat.cross(quat.add(w, w), rate[1])
        wd, d = quat.add(quat.add(wd, quat.cross(w, rate[0])), change[0]), quat.add(quat.add(d, twice), change[1])
        w = quat.add(w, rate[0])
        d = quat.add(d, accelerated(w, wd, (0.0, 0.0, step.theta.shift)))
        motion.append((w, wd, d))
        mass, h, _ = link.inertia
        about = Inertia(mass, None, link.inertia.rotational)
        (force, turning), (_, gyroscopic) = about.momentum((wd, d)), about.momentum((w, d))
        force = quat.add(force, accelerated(w, wd, h))
        net.append((force, quat.add(quat.add(turning, quat.cross(w, gyroscopic)), quat.cross(h, d))))
    return inward(tree, steps, net)


def accelerated(w: Pure, wd: Pure, r: Pure) -> Pure:
    """Acceleration wd x r + w x (w x r) of a point r relative to the origin."""
    return quat.add(quat.cross(wd, r), quat.cross(w, quat.cross(w, r)))


def base_parameters(robot: Robot, q: Row, qd: Row, qdd: Row) -> list[Number]:
    """Inertial parameters on the axes of revolute joints given to the parents."""
    return without_dual_part(robot, q, qd, qdd, group=True)


def shared_terms(robot: Robot, q: Row, qd: Row, qdd: Row) -> Sequence[Number]:
    """U = [wd] + [w]^2 formed once a link, for its own wrench and for the origins beyond it."""
    return posed.aligned(robot, q, {}, group=True).torques(qd, qdd, None)


def inward(tree: Tree, steps: Steps, net: Sequence[Screw | None]) -> list[Number]:
    """Torques from the net wrenches: (46)-(48)."""
    F = list(net)
    tau: list[Number] = [0.0] * tree.nv
    for i in reversed(range(1, len(F))):
        link = tree.links[i]
        (tau[link.v.start],) = link.joint.project(F[i])
        F[link.parent] = add(F[link.parent], steps[i].to_parent(F[i]))
    return tau


COUNTED = (
    "The first row counts the formulas as they are written, with a wrench at the tip, as the paper does. The others "
    "count recorded programs, in which equal operations are kept once, without that wrench."
)
FORMS = (
    LadderForm("operators as printed", as_printed),
    LadderForm("zeros known, operators shared", zeros_known),
    LadderForm("aligned frames: elementary screws", aligned_frames),
    LadderForm("dual part of the twists absent", without_dual_part),
    LadderForm("base parameters", base_parameters),
    LadderForm("shared terms: the program that runs", shared_terms),
)


def example(n: int) -> Robot:
    """General chain of n revolute joints with frames at the centres of mass, as printed Algorithm 1 requires."""
    return cost.robot(*cost.chain(n))


def times(n: int, batch: int = 4096, seconds: float = 0.3) -> list[float]:
    """Time of every step per sample [ns], in float64 on torch's threads, by the backend that runs programs here."""
    robot, on = example(n), torch.device("cpu")
    generator = torch.Generator().manual_seed(0)
    rows = [2 * torch.rand(batch, n, generator=generator, dtype=torch.float64) - 1 for _ in range(3)]
    calls = [partial(run, form.program(robot), rows, choose(None, on)) for form in FORMS]
    return medians(calls, batch, seconds)


def rows(n: int = 7, taken: Sequence[float] | None = None) -> list[tuple[str, ...]]:
    """Operations of every step for a general chain, headings first; sines and cosines are the same for all.

    Args:
        n: number of joints.
        taken: times of the steps [ns], for one more column; None: without it.
    """
    robot = example(n)
    whole = cost.dqrnea_as_printed(n, full=True)
    found: list[tuple[str, ...]] = [
        (f"step, {n} general revolute joints", "multiplications", "additions"),
        ("nothing known, every product of the print", str(whole.multiplications), str(whole.additions)),
    ]
    for form in FORMS:
        count = form.program(robot).count()
        found.append((form.name, str(count.multiplications), str(count.additions)))
    if taken is not None:
        column = ["time per sample", "", *(f"{digits(t)} ns" for t in taken)]
        found = [(*row, cell) for row, cell in zip(found, column, strict=True)]
    return found


def table(n: int = 7) -> str:
    """Table of `rows` in Markdown."""
    return markdown(rows(n))
