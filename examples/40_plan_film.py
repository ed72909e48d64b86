"""Plans as films: a quadruped that jumps over a bar, and arms that swing around posts.

    python examples/40_plan_film.py [jump] [swing]

The jump is planned by iterative LQR through contact, as targets of the servos of its joints: first crouch and
take-off, then flight and landing from there. Asked for are the base's path and its velocity at take-off, legs that are
drawn in, and a bar that head and feet keep away from. The arms are rows of one problem; the orange one does not know of
its post.
"""

import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Literal, NamedTuple

import films
import numpy as np
import torch
import tyro
from films import CHOSEN, FAST, FOG, INK, QUIET
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from torch import Tensor

import torchdq
from torchdq import Scene, dq, effects, optimal
from torchdq.envs.render import Skeleton
from torchdq.objects import Cylinder
from torchdq.robot import ContactPoint
from torchdq.scene import State

arms, walk = (import_module(name) for name in ("00_a_thousand_arms", "25_walk_film"))
double = partial(torch.tensor, dtype=torch.float64)
WIDTH, HEIGHT = 960, 400  # of the films [pixels]
POSTS = "#43c59e"
METHOD = "ilqr"
UPRIGHT = double([1.0, 0.0, 0.0, 0.0])

# --- the jump --------------------------------------------------------------------------------------------------------

GO2 = torchdq.robots.load("go2")
SERVO = effects.Servo(torch.full((12,), 60.0).double(), torch.full((12,), 2.0).double(), GO2.limits.effort)
LEGS = Scene(GO2, (effects.Gravity(), effects.RotorInertia(0.01), SERVO, effects.Contact("*_foot")), dt=5e-3)
STAND, TUCK = (double([0.0, *leg] * 4) for leg in ([0.8, -1.6], [1.1, -2.2]))
CROUCH, PUSH, FLIGHT, LANDING = 60, 32, 82, 120  # steps
LOW, HIGH, FAR = 0.18, 0.32, 0.7  # heights before and at take-off, and length of the jump [m]
UP = 0.5 * 9.81 * FLIGHT * LEGS.dt  # velocity at take-off [m/s]
OFF, DOWN = slice(CROUCH + PUSH), slice(CROUCH + PUSH, None)
BAR = Cylinder("bar", mass=1.0, radius=0.012, length=0.5)
X_WB = dq.from_pose(double([0.5**0.5, 0.5**0.5, 0.0, 0.0]), double([0.4, 0.0, 0.1]))  # across the way
FEET = [ContactPoint(name, radius=0.022) for name in GO2.frame_names if name.endswith("_foot")]
HEAD_AND_FEET = (ContactPoint("Head_lower", radius=0.047), *FEET)

# --- the arms --------------------------------------------------------------------------------------------------------

PANDA = torchdq.robots.load("panda")
ARM = Scene(PANDA, (effects.Gravity(), effects.Viscous(1.0), effects.RotorInertia(0.1)), dt=0.02)
HOME, TURN, SWING = double([-1.57, 0.5, 0.0, -1.6, 0.0, 2.1, 0.8]), 0.9, 55  # posture and half a swing [rad]; steps
POST = Cylinder("post", mass=1.0, radius=0.05, length=0.55)
BALLS = (
    ContactPoint("tip", radius=0.06),
    ContactPoint("panda_link7", radius=0.09),
    ContactPoint("panda_link5", radius=0.09),
    ContactPoint("panda_link5", center=(0.0, 0.06, -0.15), radius=0.09),
)
ALONG, ACROSS = 1.7, 1.5  # distances between arms [m]


@dataclass
class Args:
    films: tyro.conf.Positional[tuple[Literal["jump", "swing"], ...]] = ("jump", "swing")
    """Films that are made."""
    arms: int = 8
    """Number of arms."""
    iterations: int = 60
    """Largest number of iterations of a plan."""
    frames: int | None = None
    """Images of a film; None: all of the motion."""
    quality: int = 40
    """Quality of the images, 1 to 100."""
    out: Path = Path("out")
    """Folder of the films."""


class Found(NamedTuple):
    """Film, the plan that it shows, and what is of interest."""

    path: Path
    plan: optimal.Plan
    seconds: float  # of planning, on one core
    nearest: Tensor  # distances of head and feet from the bar, or of arms that know from their posts [m]


class View(NamedTuple):
    """Camera that is nearer by a zoom, and its picture moved."""

    zoom: float
    middle: tuple[float, float, float] = (0.0, 0.0, 0.0)  # in the middle of the picture [m]
    by: tuple[float, float] = (0.0, 0.0)  # of the picture [pixels]

    def project(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pixels [..., 2] and distances of places [m]."""
        pixels, depth = walk.project(x - np.array(self.middle), self.zoom)
        return pixels + np.array(self.by), depth

    def bodies(self, figure: Figure, spacing: float) -> films.Bodies:
        """Bodies of a figure, above lines on the ground."""
        panel = figure.add_axes((0, 0, 1, 1), xlim=(0, WIDTH), ylim=(0, HEIGHT))
        panel.set_axis_off()
        grid = np.array([[(spacing * x, -1.5, 0.0), (spacing * x, 9.0, 0.0)] for x in range(-60, 61)])
        panel.add_collection(LineCollection(self.project(grid)[0], linewidths=0.8, colors=FOG))
        eye = arms.EYE / self.zoom + np.array(self.middle)
        return films.Bodies(figure, (WIDTH, HEIGHT), self.project, eye, self.zoom * arms.FOCUS)


def timed(plan: Callable[[], optimal.Plan]) -> tuple[optimal.Plan, float]:
    """Plan, and the time that it takes once its programs are compiled [s]."""
    plan()
    begin = time.thread_time()
    return plan(), time.thread_time() - begin


def standing() -> State:
    """State of the quadruped after a second on its feet."""
    start = LEGS.start(STAND, X_WB=dq.from_pose(UPRIGHT, double([0.0, 0.0, 0.3])))
    return LEGS.rollout(start, steps=200, target=STAND.expand(200, 12)).last


def path_of(state: State) -> tuple[Tensor, Tensor]:
    """Poses [steps, 8] of the base that are asked for, and its velocity [6] at take-off."""
    x, _, z = dq.translation(state.X_WB).tolist()
    down, push = (torch.arange(1.0, k + 1, dtype=torch.float64)[:, None] / k for k in (CROUCH, PUSH))
    t = LEGS.dt * torch.arange(1.0, FLIGHT + 1, dtype=torch.float64)[:, None]
    ahead = FAR / (LEGS.dt * (FLIGHT + PUSH / 2))
    way = 0.5 * ahead * LEGS.dt * PUSH  # of the push
    parts = [
        (x + 0.0 * down, z + (LOW - z) * down),
        (x + way * push**2, LOW + (HIGH - LOW) * push**2),
        (x + way + ahead * t, HIGH + UP * t - 0.5 * 9.81 * t**2),
        (torch.full((LANDING, 1), x + FAR).double(), torch.full((LANDING, 1), z).double()),
    ]
    places = torch.cat([torch.cat([along, 0.0 * along, height], -1) for along, height in parts])
    return dq.from_pose(UPRIGHT.expand(len(places), 4), places), double([0.0, 0.0, 0.0, ahead, 0.0, UP])


def jumping(standing: State, of: slice) -> optimal.Problem:
    """Problem of some of the steps of a jump."""
    path, leaving = path_of(standing)
    phase = torch.arange(4).repeat_interleave(torch.tensor([CROUCH, PUSH, FLIGHT, LANDING]))
    off = (torch.arange(len(path)) == CROUCH + PUSH - 1).double()[:, None]
    pose = double([[5, 5, 5, 1, 5, 5], [5, 5, 5, 20, 20, 50], [20, 20, 20, 20, 20, 100], [5, 5, 5, 2, 5, 5]])
    legs = double([[0.02] * 12, [0.02] * 12, [4.0, 0.5, 0.5] * 4, [0.1] * 12])
    calm = double([[0.01], [0.01], [0.01], [0.04]])[phase[of]]
    costs = [
        optimal.BasePose(path[of], pose[phase[of]]),
        optimal.BaseVelocity(0.1 + off[of] * double([10, 10, 10, 100, 10, 100]), off[of] * leaving),
        optimal.Posture(torch.stack([STAND, STAND, TUCK, STAND])[phase[of]], legs[phase[of]]),
        optimal.Speeds(0.1 * calm),
        optimal.Torques(calm, STAND),  # which are targets here
        optimal.Spheres(1e3, HEAD_AND_FEET, (BAR,), X_WB[None], margin=0.03),
    ]
    end = float(of != OFF)  # whether it is rest that the last step leads to
    rest = [
        optimal.BasePose(path[-1], end * double([100.0] * 6)),
        optimal.Posture(STAND, 10.0 * end),
        optimal.BaseVelocity(10.0 * end),
    ]
    return optimal.Problem(LEGS, len(calm), costs, rest, control="target")


def jump(iterations: int) -> tuple[optimal.Plan, float]:
    """Plan of the jump, and the time that it takes [s]."""
    start = standing()
    hold, rest = (STAND.expand(k, 12) for k in (CROUCH + PUSH, FLIGHT // 2 + LANDING))

    def plan() -> optimal.Plan:
        off = optimal.solve(jumping(start, OFF), start, hold, method=METHOD, iterations=iterations)
        above = torch.cat([TUCK.expand(FLIGHT - FLIGHT // 2, 12), rest])
        down = optimal.solve(jumping(start, DOWN), off.states.last, above, method=METHOD, iterations=iterations)
        states = {name: torch.cat([x, down.states.rows()[name][1:]]) for name, x in off.states.rows().items()}
        return down._replace(torque=torch.cat([off.torque, down.torque]), states=State(**states))

    return timed(plan)


def curves(figure: Figure, duration: float, rows: dict[str, Tensor]) -> Iterator[float]:
    """Draw rows [steps] over the motion; dots move to the share of it that is sent."""
    dots = []
    for k, (name, row) in enumerate(rows.items()):
        panel = figure.add_axes((0.755, 0.66 - 0.29 * k, 0.215, 0.2), facecolor="none")
        room = 0.15 * float(row.max() - row.min())
        panel.set(xlim=(0, duration), ylim=(float(row.min()) - room, float(row.max()) + room), xticks=[])
        panel.tick_params(length=0, labelsize=7.5, labelcolor=QUIET, pad=3)
        panel.spines[:].set_visible(False)
        panel.axhline(panel.get_ylim()[0], color=FOG, linewidth=1)
        panel.text(0.0, 1.08, name, transform=panel.transAxes, size=9, color=INK)
        panel.plot(np.linspace(0, duration, len(row)), row, color=CHOSEN, linewidth=1.4)
        dots.append((panel.plot([], [], "o", color="white", markersize=4.5)[0], row))
    share = 0.0
    while True:
        share = yield share
        for dot, row in dots:
            dot.set_data([share * duration], [row[round(share * (len(row) - 1))]])


def jump_moves(figure: Figure, plan: optimal.Plan, shown: list[int]) -> Iterator[None]:
    """Draw the quadruped, the bar, and what is of interest; every time it is asked, they move on."""
    states, view = plan.states, View(4.6, (0.5 * FAR, 0.0, 0.0), (-135.0, 60.0))
    drawn, skeleton = view.bodies(figure, 0.2), Skeleton(GO2)
    force = LEGS.contacts(states).normal_force.sum(-1) / (9.81 * float(GO2.mass.sum() + GO2.base_mass))
    torque = SERVO.kp * (plan.torque - states.q[:-1]) - SERVO.kd * states.qd[:-1]
    knee = torque.clamp(-GO2.limits.effort, GO2.limits.effort)[:, 2]
    rows = {
        "height of the base [m]": dq.translation(states.X_WB)[:, 2],
        "force on the ground [weights]": force,
        "torque of a knee [N m]": knee,
    }
    panels = curves(figure, LEGS.dt * len(knee), rows)
    next(panels)
    robot, bar = (np.array([to_rgb(colour)]) for colour in (FAST, CHOSEN))
    bodies, surface, still = [body for _, body in skeleton.bodies], [films.surface_of(BAR)], np.zeros((1, 3))
    for k in shown:
        drawn.add(surface, X_WB[None, None], still, bar)
        drawn.add(bodies, skeleton.placed(states.q[k], X_WB=states.X_WB[k])[1], still, robot)
        drawn.show(0.1)
        panels.send(k / len(knee))
        yield


def swing(count: int, iterations: int) -> tuple[optimal.Plan, float, Tensor, Tensor]:
    """Plan of two swings of all arms, the time that it takes [s], distances from posts [m], and their poses."""
    generator = torch.Generator().manual_seed(0)
    start = HOME.repeat(2, count, 1)
    start[:, :, 0] += TURN * double([-1.0, 1.0])[:, None]
    draw = torch.rand(count, 2, generator=generator, dtype=torch.float64)
    radius, angle = 0.52 + 0.12 * draw[:, 0], HOME[0] + 0.8 * (draw[:, 1] - 0.5)
    place = torch.stack([radius * angle.cos(), radius * angle.sin(), 0.0 * radius + 0.5 * POST.length], -1)
    X_WO = dq.from_pose(UPRIGHT.expand(count, 4), place)[:, None]
    weight = torch.full((count, 1), 1e3).double()
    weight[-1] = 0.0  # which does not know of its post
    costs = [
        optimal.Torques(1e-6),
        optimal.Speeds(1e-3),
        optimal.JointLimits(100.0),
        optimal.Posture(HOME, double([0.0] + 6 * [0.1])),
        optimal.Spheres(weight, BALLS, (POST,), X_WO, margin=0.04),
    ]
    goal = torchdq.forward_kinematics(PANDA, start.flip(0), "tip")
    final = [optimal.Point("tip", dq.translation(goal), 1e3), optimal.Posture(start.flip(0), 1.0), optimal.Speeds(10.0)]
    problem = optimal.Problem(ARM, SWING, costs, final)
    plan, seconds = timed(lambda: optimal.solve(problem, ARM.start(start), method=METHOD, iterations=iterations))
    near = torchdq.distances(PANDA, plan.states.q, BALLS, (POST,), X_WO).distance.amin((0, 1, 3))
    return plan, seconds, near, X_WO


def swing_moves(figure: Figure, q: Tensor, X_WO: Tensor) -> Iterator[None]:
    """Draw arms at joint positions [frame, arm, 7] and their posts; every time it is asked, they move on."""
    view = View(2.2, by=(0.0, 20.0))
    drawn, skeleton, count = view.bodies(figure, 0.5 * ALONG), Skeleton(PANDA), len(X_WO)
    x, y = np.meshgrid(np.arange(-8, 9.0), np.arange(9.0))
    lattice = np.stack([ALONG * (x + y % 2 / 2), ACROSS * y + 0.5, 0 * x], -1).reshape(-1, 3)
    across = view.project(lattice)[0][:, 0]
    inside = lattice[(across > 100) & (across < WIDTH - 100)]
    at = inside[np.argsort(inside[:, 1] + 0.01 * np.abs(inside[:, 0]), kind="stable")[:count]][::-1].copy()
    near = view.project(at)[1][:, None]
    fog = 0.8 * (near - near.min()) / max(np.ptp(near), 1e-9)
    arm, post = (np.array(to_rgb(x)) * (1.0 - fog) + np.array(to_rgb(FOG)) * fog for x in (FAST, POSTS))
    arm[-1] = to_rgb(CHOSEN)
    bodies, surface = [body for _, body in skeleton.bodies], [films.surface_of(POST)]
    for each in q:
        drawn.add(surface, X_WO, at, post)
        drawn.add(bodies, skeleton.placed(each)[1], at, arm)
        drawn.show(0.1)
        yield


def main(args: Args) -> list[Found]:
    """Films, their plans, and how far these keep away."""
    torch.set_num_threads(1)
    found = []
    if "jump" in args.films:
        plan, seconds = jump(args.iterations)
        at = plan.states
        near = torchdq.floating.distances(GO2, at.X_WB, at.q, HEAD_AND_FEET, (BAR,), X_WB[None]).distance
        text = f"crouch, take-off, flight and landing by iterative LQR in {seconds:.0f} s on one core; half as fast"
        figure = films.card(WIDTH, HEIGHT, "A jump over a bar, planned through contact", text)
        shown = list(range(0, len(at.q), 5))[: args.frames]
        path = args.out / "jump.webp"
        films.save(figure, jump_moves(figure, plan, shown), path, 50, args.quality)
        found.append(Found(path, plan, seconds, near.amin(0)))
    if "swing" in args.films:
        plan, seconds, near, X_WO = swing(args.arms, args.iterations)
        text = f"planned at once, there and back, in {seconds:.2f} s on one core; the orange one does not know its post"
        figure = films.card(WIDTH, HEIGHT, f"{args.arms} arms swing past posts", text)
        q = plan.states.q[::2].movedim(1, 0)
        q = torch.cat([x for way in q for x in (way, way[-1:].expand(4, -1, -1))])[: args.frames]
        path = args.out / "swing.webp"
        films.save(figure, swing_moves(figure, q, X_WO), path, 40, args.quality)
        found.append(Found(path, plan, seconds, near[:-1]))
    return found


if __name__ == "__main__":
    found = main(tyro.cli(Args))
    for film in found:
        print(f"{film.path}, {film.path.stat().st_size / 1e6:.2f} MB; planned in {film.seconds:.2f} s")
        print(f"{film.plan.why()}\nnearest [m]: {film.nearest.tolist()}")
    sys.exit(any([bool((film.nearest <= 0.0).any()) for film in found]))
