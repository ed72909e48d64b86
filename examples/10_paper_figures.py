"""The five figures of the paper, reproduced: torques, arm, closed loop, cost of kinematics and dynamics.

    python examples/10_paper_figures.py [--out out/paper]

The arm is the paper's, two links of 1 m and 1 kg. Costs are counted by running the formulas (`torchdq cost`),
twice: with dense products of whole matrices and dual quaternions, as the paper counts, and without structural zeros and
ones. A third count is that of this package's programs. A summary lists which of the paper's claims hold, and where.
"""

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import torch
import tyro
from closed_loop import simulated
from matplotlib import pyplot as plt
from pictures import BLUE, GREY, prepare, save
from torch import Tensor

import torchdq
from torchdq.algebra import screw
from torchdq.dynamics.general.posed import General
from torchdq.dynamics.joints import Coordinate
from torchdq.dynamics.tree import Tree
from torchdq.functions.catalogue import Function
from torchdq.paper import cost, homogeneous, printed, tables
from torchdq.paper.closed_form import closed_form as printed_closed_form
from torchdq.program.program import Argument
from torchdq.robot.robot import constants

double = partial(torch.tensor, dtype=torch.float64)
RED, BLACK = "#D0312D", "#111111"  # dual quaternions, this package; matrices are blue
DOTTED, DASHED, DASH_DOTTED = (0, (1, 1.5)), (0, (5, 2)), (0, (6, 2, 1, 2))


@dataclass
class Args:
    joints: int = 42
    """Costs are drawn for chains of one to this many joints."""
    step: float = 0.005
    """Step of the closed loop [s]."""
    dpi: int = 160
    """Resolution of the pictures."""
    out: Path = Path("out/paper")
    """Folder of the pictures."""


# --- the motion and its torques, four times --------------------------------------------------------------------------

START, END, DURATION = double([-1.2, 0.5]), double([1.1, 1.0]), 2.0  # [rad], [rad], [s]
KP, KD = 25.0, 10.0  # critical damping


def reference(t: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Positions, velocities and accelerations [..., 2] from rest to rest, a polynomial of degree five in time."""
    s, move = t[..., None] / DURATION, END - START
    position = START + move * s**3 * (10 - 15 * s + 6 * s**2)
    velocity = move * s**2 * (30 - 60 * s + 30 * s**2) / DURATION
    return position, velocity, move * s * (60 - 180 * s + 120 * s**2) / DURATION**2


def closed_form(arm: torchdq.Robot, q: Tensor, qd: Tensor, qdd: Tensor) -> Tensor:
    """M qdd + c + g by matrices of dual quaternions."""
    halves = [None, *(Coordinate(x, (0.5 * x).cos(), (0.5 * x).sin()) for x in q.unbind(-1))]
    at = General.at(arm.tree(), (), halves)
    terms = printed_closed_form(at.tree, at.Ad, qd.unbind(-1))
    tau = []
    for row, *bias in zip(terms.M, terms.c, terms.g, strict=True):
        present = [m * a for m, a in zip(row, qdd.unbind(-1), strict=True) if m is not None]
        tau.append(sum((*present, *(b for b in bias if b is not None)), torch.zeros(())))  # (63)
    return torch.stack(torch.broadcast_tensors(*tau), -1)


def closed_equations(q: Tensor, qd: Tensor, qdd: Tensor) -> Tensor:
    """Torques written out for the arm, two uniform rods of mass m and length l, as textbooks have it."""
    m, l, gravity = 1.0, 1.0, 9.81
    a, b = m * l**2 / 3, m * l**2 / 2  # a rod about its end; a rod's mass, on the lever of the other
    (q1, q2), (v1, v2), (a1, a2) = q.unbind(-1), qd.unbind(-1), qdd.unbind(-1)
    M11, M12, M22 = 2 * a + m * l**2 + 2 * b * q2.cos(), a + b * q2.cos(), a  # (69)
    c1, c2 = -b * q2.sin() * (2 * v1 + v2) * v2, b * q2.sin() * v1**2  # (70)
    g2 = m * gravity * l / 2 * (q1 + q2).cos()  # (71)
    g1 = m * gravity * 3 * l / 2 * q1.cos() + g2
    return torch.stack([M11 * a1 + M12 * a2 + c1 + g1, M12 * a1 + M22 * a2 + c2 + g2], -1)  # and f_EF = 0 in (72)


def homogeneous_rnea(chain: Tree, q: Tensor, qd: Tensor, qdd: Tensor) -> Tensor:
    """Torques of a chain by homogeneous matrices, Lynch and Park's algorithm, which shares nothing with the others."""
    back = [homogeneous.Displacement(-x, -x.sin(), 1 - x.cos(), x.sin() - x) for x in q.unbind(-1)]
    bodies = homogeneous.bodies(chain)
    return torch.stack(homogeneous.rnea(bodies, chain.gravity, back, qd.unbind(-1), qdd.unbind(-1)), -1)


def torques(arm: torchdq.Robot, q: Tensor, qd: Tensor, qdd: Tensor) -> dict[str, Tensor]:
    """Torques of the two-link arm by four computations, the recursion last, to which the others are compared."""
    return {
        "closed form, DQ matrices": closed_form(arm, q, qd, qdd),
        "closed equations": closed_equations(q, qd, qdd),
        "HTM recursion": homogeneous_rnea(arm.tree(), q, qd, qdd),
        "DQ recursion": torchdq.inverse_dynamics(arm, q, qd, qdd),
    }


def differences(found: dict[str, Tensor]) -> dict[str, Tensor]:
    """Distances from the dual quaternion recursion."""
    *others, (_, recursion) = found.items()
    return {name: (tau - recursion).abs() for name, tau in others}


def closed_loop(arm: torchdq.Robot, step: float, behind: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Times, states (q, qd) and torques of the arm under computed torque, which starts behind its reference [rad]."""
    control = torchdq.ComputedTorque(arm, kp=KP, kd=KD)  # (73)-(78)

    def torque(t: Tensor, q: Tensor, qd: Tensor) -> Tensor:
        return control(q, qd, *reference(t))

    time = double(range(round(DURATION / step) + 1)) * step
    start = torch.stack([START - behind, torch.zeros(2, dtype=torch.float64)])
    states = simulated(arm, torque, start, time[:-1], step)
    return time, states, torque(time, *states.unbind(1))


def decay(time: Tensor, behind: Tensor) -> Tensor:
    """Solution of e'' + kd e' + kp e = 0 from e and e' = 0, critically damped."""
    rate = KP**0.5
    return behind * ((1 + rate * time) * torch.exp(-rate * time))[:, None]


# --- costs -----------------------------------------------------------------------------------------------------------


class Curve(NamedTuple):
    """Costs of one formulation."""

    name: str
    colour: str
    line: str | tuple
    joints: Sequence[int]
    costs: Sequence[cost.Cost]

    def of(self, quantity: str) -> list[int]:
        """Multiplications, additions, storage or, both together, operations."""
        if quantity == "operations":
            return [c.multiplications + c.additions for c in self.costs]
        return [getattr(c, quantity) for c in self.costs]


def curve(
    name: str, colour: str, line: str | tuple, joints: Sequence[int], at: Callable[[int], cost.Cost], storage: int = 0
) -> Curve:
    """Costs of a formulation, given for every number of joints, with what it stores for every joint."""
    found = [at(n) for n in joints]
    stored = [c._replace(storage=n * storage) if storage else c for n, c in zip(joints, found, strict=True)]
    return Curve(name, colour, line, joints, stored)


def executed(function: str, arguments: Sequence[str], options: tuple[str, ...], n: int) -> cost.Cost:
    """Operations of this package's program of a function for a general chain, and the numbers it reads."""
    robot = cost.robot(*cost.chain(n))
    taken = tuple(Argument(name, 6 if name == "f_tip" else n) for name in arguments)
    program = Function(constants(robot), function, options).program(taken)
    count, numbers = program.count(), sum(op.code == "const" for op in program.ops)
    return cost.Cost(count.multiplications, count.additions, numbers + count.sines)


def compiled(joints: int, function: str, arguments: Sequence[str], options: tuple[str, ...] = ()) -> Curve:
    """Costs of compiled programs, for fewer lengths, because recording takes a while."""
    lengths = [n for n in (1, 2, 4, 8, 16, 29, 42) if n <= joints]
    return curve("compiled program", BLACK, DASHED, lengths, partial(executed, function, arguments, options))


def numbers_read() -> dict[str, int]:
    """Numbers that the transform of a joint is made of by each formulation, zeros and ones left out."""
    v, w, Wv, W2v, (xx, yy, zz), (xy, xz, yz) = (tables.vector() for _ in range(6))
    W2 = ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))
    generator = homogeneous.Generator(True, (*w, *v), homogeneous.bracket(w), W2, Wv, W2v)
    angle, twist, length, offset = tables.several(2), tables.several(2), tables.number(), tables.number()
    transforms = {
        "HTM, D-H": homogeneous.denavit_hartenberg(*angle, twist, length, offset),
        "HTM, screws": homogeneous.exponential(generator, homogeneous.Displacement(*tables.several(4))),
        "UDQ, D-H": printed.denavit_hartenberg(angle, twist, length, offset),
        "UDQ, screws": screw.exp_revolute(tables.motion(), *angle),
    }
    return {name: cost.cost(transform).storage for name, transform in transforms.items()}


# for a joint by dense products: Table 4; a matrix without its last row is 12 numbers, and D-H makes three of them
PRINTED_STORAGE = {"HTM, D-H": 36, "HTM, screws": 12, "UDQ, D-H": 24, "UDQ, screws": 8}


def kinematics_costs(joints: int) -> tuple[list[Curve], list[Curve]]:
    """Costs of the tip's pose, as the paper counts and with known zeros, for chains of up to so many joints."""

    def curves(lines: Sequence[cost.Line], storage: dict[str, int]) -> list[Curve]:
        return [
            curve(
                line.name.replace(", ", " by "),
                BLUE if "HTM" in line.name else RED,
                DOTTED if "D-H" in line.name else "solid",
                range(1, joints + 1),
                line.at,
                storage[line.name],
            )
            for line in lines
        ]

    ours = compiled(joints, "forward_kinematics", ("q",), ("tip",))
    return curves(cost.FKM, PRINTED_STORAGE), [*curves(cost.FKM_FOLDED, numbers_read()), ours]


def dynamics_costs(joints: int) -> tuple[list[Curve], list[Curve]]:
    """Costs of torques with a wrench at the tip, in the same two ways."""
    line, lengths = {line.name: line.at for line in cost.RNEA}, range(1, joints + 1)
    dense = [
        curve("HTM", BLUE, "solid", lengths, line["HTM, no zero known"]),
        curve("DQ as printed in Table 4", RED, DOTTED, lengths, line["dqRNEA as printed in Table 4"]),
        curve("DQ", RED, "solid", lengths, line["dqRNEA, no zero known"]),
    ]
    folded = [
        curve("HTM", BLUE, "solid", lengths, line["HTM, zeros and ones known"]),
        curve("DQ with the printed operators", RED, "solid", lengths, line["dqRNEA, operators as printed"]),
        curve("DQ as this package has it", RED, DASH_DOTTED, lengths, line["dqRNEA, as this package has it"]),
        compiled(joints, "inverse_dynamics", ("q", "qd", "qdd", "f_tip")),
    ]
    return dense, folded


# --- what of the paper's claims holds --------------------------------------------------------------------------------


def where(first: Curve, second: Curve, quantity: str) -> str:
    """Numbers of joints for which the first costs less than the second, in words."""
    holds = [a < b for a, b in zip(first.of(quantity), second.of(quantity), strict=True)]
    if all(holds) or not any(holds):
        return "for every n" if all(holds) else "for no n"
    change = next(k for k, (a, b) in enumerate(pairwise(holds), 1) if a != b)
    return f"up to n = {change}" if holds[0] else f"from n = {change + 1}"


def claims(fkm: tuple[list[Curve], list[Curve]], rnea: tuple[list[Curve], list[Curve]]) -> list[str]:
    """A sentence for each comparison of section 7."""

    def sentence(subject: str, curves: Sequence[Curve], less: str, more: str) -> str:
        by_name = {curve.name: curve for curve in curves}
        found = [where(by_name[less], by_name[more], what) for what in ("multiplications", "additions")]
        said = found[0] if found[0] == found[1] else f"{found[0]} (multiplications) and {found[1]} (additions)"
        a, b = by_name[less].of("operations")[-1], by_name[more].of("operations")[-1]
        share = f"{a / b:.2f} times as many operations at n = {by_name[less].joints[-1]}"
        return f"{subject}: {less} costs less than {more} {said}; {share}."

    said = []
    for (poses, torque), how in zip(zip(fkm, rnea, strict=True), ("dense products", "zeros known"), strict=True):
        pairs = [(f"UDQ by {way}", f"HTM by {way}") for way in ("D-H", "screws")]
        pairs += [(f"{kind} by screws", f"{kind} by D-H") for kind in ("UDQ", "HTM")]
        said += [sentence(f"Pose, {how}", poses, *pair) for pair in pairs]
        said += [sentence(f"Torques, {how}", torque, c.name, "HTM") for c in torque if c.colour == RED]
    return said


# --- pictures --------------------------------------------------------------------------------------------------------


def draw_torques(found: dict[str, Tensor], time: Tensor) -> plt.Figure:
    """Fig. 1: the torques lie on each other, so their differences stand below, but for those that are zero."""
    figure, axes = plt.subplots(2, 2, figsize=(9, 5), sharex=True, height_ratios=(3, 2), layout="constrained")
    looks = {  # the paper's lines, each narrower than the one below it
        "closed form, DQ matrices": {"color": "#F2B8B5", "linewidth": 8},
        "HTM recursion": {"color": BLUE, "linewidth": 4.5, "linestyle": (0, (3, 1.5))},
        "closed equations": {"color": "#F0C000", "linewidth": 2.6, "linestyle": (0, (8, 2, 1, 2))},
        "DQ recursion": {"color": BLACK, "linewidth": 1.6, "linestyle": DOTTED},
    }
    for joint, (above, below) in enumerate(axes.T):
        for name, look in looks.items():
            above.plot(time, found[name][:, joint], label=name, **look)
        for name, difference in differences(found).items():
            positive = difference[:, joint].where(difference[:, joint] > 0, torch.nan)
            below.semilogy(time, positive, ".", markersize=3, color=looks[name]["color"])
        above.set(title=f"joint {joint + 1}", ylabel="torque [N m]")
        below.set(ylim=(1e-17, 1e-13), xlabel="time [s]", ylabel="difference from\nDQ recursion [N m]")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=4, handlelength=4.5)
    figure.suptitle("Fig. 1: four computations of the torques are one curve; where they differ, rounding does")
    return figure


def draw_arm(time: Tensor, q: Tensor, q_des: Tensor) -> plt.Figure:
    """Fig. 2: the arm at its start and end, and what it passed through."""

    def joints(angles: Tensor) -> Tensor:  # [..., 3 points, 2]
        turned = angles.cumsum(-1)
        links = torch.stack([turned.cos(), turned.sin()], -1)
        return torch.cat([torch.zeros_like(links[..., :1, :]), links.cumsum(-2)], -2)

    figure, axes = plt.subplots(figsize=(6.6, 4.8), layout="constrained")
    for k in range(0, len(q), max(1, len(q) // 12)):
        axes.plot(*joints(q[k]).T, color="#DADADA", linewidth=2)
    axes.plot(*joints(q_des)[:, 2].T, color=GREY, linestyle=DASHED, label="path of the tip, desired")
    axes.plot(*joints(q)[:, 2].T, color=RED, linewidth=1.8, label="path of the tip")
    for k, colour, name in ((0, BLUE, "start"), (-1, BLACK, "end")):
        axes.plot(*joints(q[k]).T, "o-", color=colour, linewidth=4, markersize=8, label=f"{name}, {time[k]:g} s")
    axes.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    figure.suptitle("Fig. 2: under computed torque the tip joins its desired path")
    return figure


def draw_loop(time: Tensor, states: Tensor, tau: Tensor, behind: Tensor) -> plt.Figure:
    """Fig. 3: positions, errors and torques of the closed loop."""
    figure, (left, middle, right) = plt.subplots(1, 3, figsize=(12, 3.6), layout="constrained")
    q, q_des = states[:, 0], reference(time)[0]
    for joint, colour in enumerate((BLUE, RED)):
        left.plot(time, q_des[:, joint], color=colour, linewidth=1, linestyle=DASHED)
        left.plot(time, q[:, joint], color=colour, label=f"joint {joint + 1}")
        middle.plot(time, (q_des - q)[:, joint], color=colour)
        middle.plot(time, decay(time, behind)[:, joint], color=BLACK, linestyle=DOTTED)
        right.plot(time, tau[:, joint], color=colour)
    left.plot([], [], color=GREY, linewidth=1, linestyle=DASHED, label="desired")
    middle.plot([], [], color=BLACK, linestyle=DOTTED, label="e'' + kd e' + kp e = 0")
    left.set(title="positions", xlabel="time [s]", ylabel="[rad]")
    middle.set(title="errors", xlabel="time [s]", ylabel="[rad]")
    right.set(title="torques", xlabel="time [s]", ylabel="[N m]")
    left.legend()
    middle.legend()
    figure.suptitle("Fig. 3: computed torque makes the arm a linear system, whose error dies out as it must")
    return figure


def draw_costs(rows: Sequence[Sequence[Curve]], title: str, quantities: Sequence[str]) -> plt.Figure:
    """Figs. 4 and 5: costs over the number of joints, as the paper counts, and with zeros known."""
    shape = len(rows), len(quantities)
    figure, axes = plt.subplots(*shape, sharex=True, figsize=(4 * shape[1], 6.4), squeeze=False, layout="constrained")
    how = ("dense products, as the paper counts", "known zeros and ones left out")
    for curves, row, title_of_row in zip(rows, axes, how, strict=True):
        for quantity, panel in zip(quantities, row, strict=True):
            for c in curves:
                marker = "o" if c.colour == BLACK else None
                look = {"color": c.colour, "linestyle": c.line, "marker": marker, "markersize": 3}
                panel.plot(c.joints, c.of(quantity), linewidth=2, label=c.name, **look)
            panel.set(ylabel=quantity, ylim=(0, None))
        row[0].set_title(title_of_row)
        row[0].legend()
    for panel in axes[-1]:
        panel.set_xlabel("joints n")
    figure.suptitle(title)
    return figure


def main(args: Args) -> tuple[dict[str, float], float]:
    """Largest differences of the torques [N m] by computation, and of the closed loop's error from its decay [rad]."""
    prepare({"font.size": 10, "axes.titlesize": 10, "legend.fontsize": 9, "savefig.dpi": args.dpi})
    torch.set_num_threads(1)
    arm, time = torchdq.robots.load("two_link"), torch.linspace(0, DURATION, 201, dtype=torch.float64)
    behind = double([0.4, -0.6])
    with torch.inference_mode():
        found = torques(arm, *reference(time))
        instants, states, tau = closed_loop(arm, args.step, behind)
    fkm, rnea = kinematics_costs(args.joints), dynamics_costs(args.joints)

    q, q_des = states[:, 0], reference(instants)[0]
    of_joints = f"n = 1 to {args.joints}"
    figures = {
        "torques": draw_torques(found, time),
        "arm": draw_arm(instants, q, q_des),
        "loop": draw_loop(instants, states, tau, behind),
        "kinematics": draw_costs(
            fkm,
            f"Fig. 4: pose of the tip, {of_joints}: dual quaternions win by dense products; with zeros known, "
            "D-H matrices do",
            ("multiplications", "additions", "storage"),
        ),
        "dynamics": draw_costs(
            rnea,
            f"Fig. 5: torques, {of_joints}: what formulation costs less depends on its zeros;\n"
            "aligned frames and shared terms save more than either",
            ("multiplications", "additions"),
        ),
    }
    for name, figure in figures.items():
        save(figure, args.out / f"paper_{name}.png")

    worst = {name: float(x.max()) for name, x in differences(found).items()}
    off = float((q_des - q - decay(instants, behind)).abs().max())
    print(f"{'largest difference from the DQ recursion':44}{'joint 1':>12}{'joint 2':>12}   [N m]")
    for name, x in differences(found).items():
        print(f"  {name:42}{x[:, 0].max():12.1e}{x[:, 1].max():12.1e}")
    print(f"\nThe closed loop's error is within {off:.0e} rad of e'' + kd e' + kp e = 0.\n")
    print("\n".join(claims(fkm, rnea)))
    print(f"\npictures in {args.out}/")
    return worst, off


if __name__ == "__main__":
    worst, off = main(tyro.cli(Args))
    sys.exit(0 if max(worst.values()) < 1e-12 and off < 1e-6 else 1)
