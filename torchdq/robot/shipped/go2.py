"""Unitree Go2, a quadruped of twelve joints on a floating base, with spheres as feet.

Numbers: `go2_description.urdf` of Unitree's unitree_ros (BSD 3-Clause, Copyright (c) 2016-2022 HangZhou YuShu
TECHNOLOGY CO.,LTD. "Unitree Robotics"), whose legs are mirror images but for the ranges of the thighs. Of its collision
elements, those of trunk, thighs and feet are here, and the others as visual ones; the sensors, which have no mass, are
not.
"""

from collections.abc import Sequence
from math import pi
from typing import NamedTuple

from torchdq.robot.robot import Robot

__all__ = ["build", "urdf"]


class Part(NamedTuple):
    """A link and its joint."""

    name: str
    parent: str
    at: tuple[float, float, float]  # of the joint in the parent [m]
    mass: float  # [kg]
    com: tuple[float, float, float] = (0, 0, 0)  # [m]
    inertia: tuple[float, ...] = (9.6e-6, 0, 0, 9.6e-6, 0, 9.6e-6)  # xx xy xz yy yz zz about it [kg m^2]
    axis: str = ""  # "": a fixed joint
    limits: tuple[float, ...] = ()  # lower and upper [rad], effort [N m], velocity [rad/s]
    collision: str = ""
    visual: tuple[str, ...] = ()

    def text(self) -> str:
        """Elements of a URDF file."""
        names = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
        body = f'<origin xyz="{_row(self.com)}"/><mass value="{self.mass}"/><inertia {_named(names, self.inertia)}/>'
        collision = f"<collision>{self.collision}</collision>" if self.collision else ""
        visual = "".join(f"<visual>{shape}</visual>" for shape in self.visual)
        link = f'<link name="{self.name}"><inertial>{body}</inertial>{visual}{collision}</link>'
        if not self.parent:
            return link
        ends = f'<origin xyz="{_row(self.at)}"/><parent link="{self.parent}"/><child link="{self.name}"/>'
        if not self.axis:
            return f'{link}<joint name="{self.name}_joint" type="fixed">{ends}</joint>'
        limits = _named(("lower", "upper", "effort", "velocity"), self.limits)
        moves = f'<axis xyz="{self.axis}"/><limit {limits}/>'
        return f'{link}<joint name="{self.name}_joint" type="revolute">{ends}{moves}</joint>'


X, Y = "1 0 0", "0 1 0"
MOTOR = (23.7, 30.1)
ROTOR_X, ROTOR_Y = (0.000111842, 0, 0, 5.9647e-5, 0, 5.9647e-5), (5.9647e-5, 0, 0, 0.000111842, 0, 5.9647e-5)
TRUNK = '<geometry><box size="0.3762 0.0935 0.114"/></geometry>'
UPPER = '<origin xyz="0 0 -0.1065" rpy="0 1.5707963267948966 0"/><geometry><box size="0.213 0.0245 0.034"/></geometry>'
SPHERE = '<origin xyz="-0.002 0 0"/><geometry><sphere radius="0.022"/></geometry>'
ROUND = '<origin xyz="{} {} {}" rpy="{} {} 0"/><geometry><cylinder radius="{}" length="{}"/></geometry>'
SHIN = (
    ROUND.format(0.008, 0, -0.06, 0, -0.21, 0.012, 0.12),
    ROUND.format(0.02, 0, -0.148, 0, 0.05, 0.011, 0.065),
    ROUND.format(0.008, 0, -0.1875, 0, 0.53, 0.0155, 0.03),
)
NOSE = '<geometry><sphere radius="0.047"/></geometry>'
BODY = [
    Part(
        *("base", "", (0, 0, 0), 6.921, (0.021112, 0, -0.005366)),
        (0.02448, 0.00012166, 0.0014849, 0.098077, -3.12e-5, 0.107),
        collision=TRUNK,
    ),
    Part("Head_upper", "base", (0.285, 0, 0.01), 0.001, visual=(ROUND.format(0, 0, 0, 0, 0, 0.05, 0.09),)),
    Part("Head_lower", "Head_upper", (0.008, 0, -0.07), 0.001, visual=(NOSE,)),
]


def _leg(name: str, f: int, s: int) -> list[Part]:
    """Leg at the front (f = 1) or rear (f = -1), on the left (s = 1) or right (s = -1)."""
    hip, thigh, calf, foot = (f"{name}_{part}" for part in ("hip", "thigh", "calf", "foot"))
    hip_moments = (0.00048, f * s * -3.01e-6, f * 1.11e-6, 0.000884, s * -1.42e-6, 0.000596)
    thigh_moments = (0.00584, s * 8.72e-5, -0.000289, 0.0058, s * 0.000808, 0.00103)
    calf_moments = (0.00108, s * 3.4e-7, 1.72e-5, 0.0011, s * 8.28e-6, 3.29e-5)
    com, at, ahead = (f * -0.0054, s * 0.00194, -0.000105), (f * 0.1934, s * 0.0465, 0), (-1.5708, 3.4907)
    thighs = (*(ahead if f > 0 else (-0.5236, 4.5379)), *MOTOR)
    middle, below = (-0.00374, s * -0.0223, -0.0327), (0.00548, s * -0.000975, -0.115)
    motor, calf_limits = ROUND.format(0, s * 0.08, 0, pi / 2, 0, 0.046, 0.04), (-2.7227, -0.83776, 45.43, 15.7)
    return [
        Part(hip, "base", at, 0.678, com, hip_moments, X, (-1.0472, 1.0472, *MOTOR), visual=(motor,)),
        Part(f"{hip}_rotor", "base", (f * 0.11215, s * 0.04675, 0), 0.089, inertia=ROTOR_X),
        Part(thigh, hip, (0, s * 0.0955, 0), 1.152, middle, thigh_moments, Y, thighs, UPPER),
        Part(f"{thigh}_rotor", hip, (0, s * -0.00015, 0), 0.089, inertia=ROTOR_Y),
        Part(calf, thigh, (0, 0, -0.213), 0.154, below, calf_moments, Y, calf_limits, visual=SHIN),
        Part(f"{calf}_rotor", thigh, (0, s * -0.03235, 0), 0.089, inertia=ROTOR_Y),
        Part(foot, calf, (0, 0, -0.213), 0.04, collision=SPHERE),
    ]


def urdf() -> str:
    """Text of the description."""
    legs = [part for a, f in (("F", 1), ("R", -1)) for b, s in (("L", 1), ("R", -1)) for part in _leg(a + b, f, s)]
    return f'<robot name="go2">{"".join(part.text() for part in (*BODY, *legs))}</robot>'


def build() -> Robot:
    """Go2 on a floating base."""
    return Robot.from_urdf(urdf(), base="floating")


def _row(numbers: Sequence[float]) -> str:
    return " ".join(map(str, numbers))


def _named(names: Sequence[str], numbers: Sequence[float]) -> str:
    return " ".join(f'{name}="{x}"' for name, x in zip(names, numbers, strict=True))
