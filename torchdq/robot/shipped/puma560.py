"""Unimation Puma 560, six joints, with the classical published parameters.

Kinematics and limits: P. I. Corke and B. Armstrong-Helouvry, "A Search for Consensus Among Model Parameters Reported
for the PUMA 560 Robot", ICRA 1994, in the standard Denavit-Hartenberg convention of Corke's Robotics Toolbox. Inertial
parameters: B. Armstrong, O. Khatib, J. Burdick, "The Explicit Dynamic Model and Inertial Parameters of the PUMA 560
Arm", ICRA 1986. Rotor inertia and viscous friction are the motors', seen through the gears (times the ratio squared).

The numbers are as published, and two links are not possible bodies: link 1 has a moment about its joint but no mass
(the 1986 paper gives no more, since it only turns about that axis), and link 3's largest moment exceeds the sum of
its others. Torques and accelerations do not suffer; `report()` lists both.
"""

from math import inf, pi, radians

from torchdq.robot.arrays import double
from torchdq.robot.description import Limits
from torchdq.robot.robot import Robot

# mass [kg] | centre of mass [m] | principal moments xx yy zz about it [kg m^2], in the DH frames
LINKS = [
    (0.0, (0.0, 0.0, 0.0), (0.0, 0.35, 0.0)),
    (17.4, (-0.3638, 0.006, 0.2275), (0.13, 0.524, 0.539)),
    (4.8, (-0.0203, -0.0141, 0.07), (0.066, 0.086, 0.0125)),
    (0.82, (0.0, 0.019, 0.0), (1.8e-3, 1.3e-3, 1.8e-3)),
    (0.34, (0.0, 0.0, 0.0), (0.3e-3, 0.4e-3, 0.3e-3)),
    (0.09, (0.0, 0.0, 0.032), (0.15e-3, 0.15e-3, 0.04e-3)),
]
ROTOR = [200e-6, 200e-6, 200e-6, 33e-6, 33e-6, 33e-6]  # [kg m^2]
GEAR = [-62.6111, 107.815, -53.7063, 76.0364, 71.923, 76.686]
VISCOUS = [1.48e-3, 0.817e-3, 1.38e-3, 71.2e-6, 82.6e-6, 36.7e-6]  # at the motor [N m s/rad]
LOWER, UPPER = [-160, -45, -225, -110, -100, -266], [160, 225, 45, 170, 100, 266]  # [deg]


def build() -> Robot:
    """Puma 560 arm, rotor inertia included."""
    mass, com, moments = zip(*LINKS, strict=True)
    robot = Robot.from_dh(
        name="puma560",
        convention="standard",
        a=[0, 0.4318, 0.0203, 0, 0, 0],
        alpha=[pi / 2, 0, -pi / 2, pi / 2, -pi / 2, 0],
        d=[0.67183, 0, 0.15005, 0.4318, 0, 0],
        theta=[0] * 6,
        mass=mass,
        com=com,
        inertia=[(xx, 0, yy, 0, 0, zz) for xx, yy, zz in moments],
        on_unphysical="ignore",
    )
    ratio = double(GEAR) ** 2
    infinite = double([inf] * 6)
    return robot.replace(
        armature=double(ROTOR) * ratio,
        damping=double(VISCOUS) * ratio,
        limits=Limits(double([radians(x) for x in LOWER]), double([radians(x) for x in UPPER]), infinite, infinite),
    ).bake()
