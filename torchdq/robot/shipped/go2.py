"""Unitree Go2, a quadruped of twelve joints on a floating base, with spheres as feet.

Numbers: `go2_description.urdf` of Unitree's unitree_ros (BSD 3-Clause, Copyright (c) 2016-2022 HangZhou YuShu TECHNOLOGY
CO.,LTD. "Unitree Robotics"), whose legs are mirror images of each other but for the ranges of the thighs. Of its
collision elements, the trunk, the thighs and the feet are here; the sensors without mass are not.
"""

from collections.abc import Sequence

from torchdq.robot.robot import Robot

# mass [kg], centre of mass [m], xx xy xz yy yz zz about it [kg m^2]; of the front left leg
BASE = (6.921, (0.021112, 0, -0.005366), (0.02448, 0.00012166, 0.0014849, 0.098077, -3.12e-5, 0.107))
HEAD = (0.001, (0, 0, 0), (9.6e-6, 0, 0, 9.6e-6, 0, 9.6e-6))
HIP = (0.678, (-0.0054, 0.00194, -0.000105), (0.00048, -3.01e-6, 1.11e-6, 0.000884, -1.42e-6, 0.000596))
THIGH = (1.152, (-0.00374, -0.0223, -0.0327), (0.00584, 8.72e-5, -0.000289, 0.0058, 0.000808, 0.00103))
CALF = (0.154, (0.00548, -0.000975, -0.115), (0.00108, 3.4e-7, 1.72e-5, 0.0011, 8.28e-6, 3.29e-5))
FOOT = (0.04, (0, 0, 0), (9.6e-6, 0, 0, 9.6e-6, 0, 9.6e-6))
ROTOR_X = (0.089, (0, 0, 0), (0.000111842, 0, 0, 0.000059647, 0, 0.000059647))
ROTOR_Y = (0.089, (0, 0, 0), (0.000059647, 0, 0, 0.000111842, 0, 0.000059647))

TRUNK_SHAPE = '<box size="0.3762 0.0935 0.114"/>'
THIGH_SHAPE = '<box size="0.213 0.0245 0.034"/>'
FOOT_SHAPE = '<sphere radius="0.022"/>'


def _link(name: str, body: tuple, collision: str = "", f: int = 1, s: int = 1) -> str:
    """Link of a leg, mirrored to the rear (f = -1) and to the right (s = -1)."""
    mass, (x, y, z), (xx, xy, xz, yy, yz, zz) = body
    moments = {"ixx": xx, "ixy": f * s * xy, "ixz": f * xz, "iyy": yy, "iyz": s * yz, "izz": zz}
    inertia = " ".join(f'{key}="{value}"' for key, value in moments.items())
    return (
        f'<link name="{name}"><inertial><origin xyz="{f * x} {s * y} {z}"/><mass value="{mass}"/>'
        f"<inertia {inertia}/></inertial>{collision}</link>"
    )


def _collision(shape: str, xyz: str, rpy: str = "0 0 0") -> str:
    return f'<collision><origin xyz="{xyz}" rpy="{rpy}"/><geometry>{shape}</geometry></collision>'


def _joint(name: str, parent: str, at: Sequence[float], axis: str = "", limit: str = "") -> str:
    """Joint that carries the link of its name; without an axis a fixed one."""
    kind = "revolute" if axis else "fixed"
    moves = f'<axis xyz="{axis}"/><limit {limit}/>' if axis else ""
    xyz = " ".join(map(str, at))
    return (
        f'<joint name="{name}_joint" type="{kind}"><origin xyz="{xyz}"/><parent link="{parent}"/>'
        f'<child link="{name}"/>{moves}</joint>'
    )


def _leg(name: str, f: int, s: int) -> str:
    """Leg at the front (f = 1) or rear (f = -1), on the left (s = 1) or right (s = -1)."""
    hip, thigh, calf, foot = (f"{name}_{part}" for part in ("hip", "thigh", "calf", "foot"))
    motor, range_y = 'effort="23.7" velocity="30.1"', (-1.5708, 3.4907) if f > 0 else (-0.5236, 4.5379)
    return "".join(
        [
            _joint(hip, "base", (f * 0.1934, s * 0.0465, 0), "1 0 0", f'lower="-1.0472" upper="1.0472" {motor}'),
            _link(hip, HIP, f=f, s=s),
            _joint(f"{hip}_rotor", "base", (f * 0.11215, s * 0.04675, 0)),
            _link(f"{hip}_rotor", ROTOR_X),
            _joint(thigh, hip, (0, s * 0.0955, 0), "0 1 0", f'lower="{range_y[0]}" upper="{range_y[1]}" {motor}'),
            _link(thigh, THIGH, _collision(THIGH_SHAPE, "0 0 -0.1065", "0 1.5707963267948966 0"), s=s),
            _joint(f"{thigh}_rotor", hip, (0, s * -0.00015, 0)),
            _link(f"{thigh}_rotor", ROTOR_Y),
            _joint(
                calf, thigh, (0, 0, -0.213), "0 1 0", 'lower="-2.7227" upper="-0.83776" effort="45.43" velocity="15.70"'
            ),
            _link(calf, CALF, s=s),
            _joint(f"{calf}_rotor", thigh, (0, s * -0.03235, 0)),
            _link(f"{calf}_rotor", ROTOR_Y),
            _joint(foot, calf, (0, 0, -0.213)),
            _link(foot, FOOT, _collision(FOOT_SHAPE, "-0.002 0 0")),
        ]
    )


def urdf() -> str:
    """Text of the description."""
    parts = [
        _link("base", BASE, _collision(TRUNK_SHAPE, "0 0 0")),
        _joint("Head_upper", "base", (0.285, 0, 0.01)),
        _link("Head_upper", HEAD),
        _joint("Head_lower", "Head_upper", (0.008, 0, -0.07)),
        _link("Head_lower", HEAD),
        *[_leg(a + b, f, s) for a, f in (("F", 1), ("R", -1)) for b, s in (("L", 1), ("R", -1))],
    ]
    return f'<robot name="go2">{"".join(parts)}</robot>'


def build() -> Robot:
    """Go2 on a floating base."""
    return Robot.from_urdf(urdf(), base="floating")
