"""Franka Emika Panda, seven joints, without hand.

Kinematics: the manufacturer's modified Denavit-Hartenberg table (Franka Control Interface documentation, "Denavit-
Hartenberg parameters"), the flange 0.107 m beyond the last frame. Inertial parameters: C. Gaz, M. Cognetti,
A. Oliva, P. Robuffo Giordano, A. De Luca, "Dynamic Identification of the Franka Emika Panda Robot With Retrieval of
Feasible Parameters Using Penalty-Based Optimization", IEEE RA-L 4(4), 2019; link 7 includes the flange.
Limits: the manufacturer's data sheet. It is drawn by the capsules of franka_description (Apache License 2.0, Copyright
Franka Emika GmbH), of which that of link 1 is cut at the ground.
"""

from math import pi, sqrt

from torchdq.algebra import dual_quaternion, quaternion
from torchdq.robot.arrays import double
from torchdq.robot.description import Drawing, Limits, Shape
from torchdq.robot.robot import Robot

# mass [kg] | centre of mass [m] | xx xy yy xz yz zz about it [kg m^2], in the DH frames
LINKS = [
    (4.970684, (0.003875, 0.002081, -0.04762), (0.70337, -0.000139, 0.70661, 0.006772, 0.019169, 0.009117)),
    (0.646926, (-0.003141, -0.02872, 0.003495), (0.007962, -0.003925, 0.02811, 0.010254, 0.000704, 0.025995)),
    (3.228604, (0.027518, 0.039252, -0.066502), (0.037242, -0.004761, 0.036155, -0.011396, -0.012805, 0.01083)),
    (3.587895, (-0.05317, 0.104419, 0.027454), (0.025853, 0.007796, 0.019552, -0.001332, 0.008641, 0.028323)),
    (1.225946, (-0.011953, 0.041065, -0.038437), (0.035549, -0.002117, 0.029474, -0.004037, 0.000229, 0.008627)),
    (1.666555, (0.060149, -0.014117, -0.010517), (0.001964, 0.000109, 0.004354, -0.001158, 0.000341, 0.005433)),
    (0.735522, (0.010517, -0.004252, 0.061597), (0.012516, -0.000428, 0.010027, -0.001196, -0.000741, 0.004815)),
]

ALONG = {  # orientations of a capsule, by its axis
    "x": (sqrt(0.5), 0.0, sqrt(0.5), 0.0),
    "z": quaternion.ONE,
}
# link | middle of a capsule in its DH frame [m] | axis | radius and half length [m]
CAPSULES = [
    (0, (-0.075, 0.0, 0.06), "x", (0.06, 0.015)),
    (1, (0.0, 0.0, -0.1615), "z", (0.06, 0.1115)),
    (2, (0.0, 0.0, 0.0), "z", (0.06, 0.06)),
    (3, (0.0, 0.0, -0.145), "z", (0.06, 0.075)),
    (4, (0.0, 0.0, 0.0), "z", (0.06, 0.06)),
    (5, (0.0, 0.0, -0.26), "z", (0.06, 0.05)),
    (5, (0.0, 0.08, -0.13), "z", (0.025, 0.07)),
    (6, (0.0, 0.0, -0.03), "z", (0.05, 0.04)),
    (7, (0.0, 0.0, 0.01), "z", (0.04, 0.07)),
    (7, (0.06, 0.0, 0.082), "x", (0.03, 0.005)),
]


def build() -> Robot:
    """Panda arm."""
    return arm("panda", "panda_")


def arm(name: str, prefix: str) -> Robot:
    """Panda arm whose joints and links have names with a prefix."""
    mass, com, inertia = zip(*LINKS, strict=True)
    robot = Robot.from_dh(
        name=name,
        convention="modified",
        a=[0, 0, 0, 0.0825, -0.0825, 0, 0.088],
        alpha=[0, -pi / 2, pi / 2, pi / 2, -pi / 2, pi / 2, pi / 2],
        d=[0.333, 0, 0.316, 0, 0.384, 0, 0],
        theta=[0] * 7,
        mass=mass,
        com=com,
        inertia=inertia,
        tip_pose=[1, 0, 0, 0, 0, 0, 0, 0.107 / 2],
        joint_names=[f"{prefix}joint{i}" for i in range(1, 8)],
        link_names=[f"{prefix}link{i}" for i in range(1, 8)],
    )
    lower = [-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973]
    upper = [2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973]
    velocity, effort = [2.175] * 4 + [2.61] * 3, [87.0] * 4 + [12.0] * 3
    drawn: list[list[Shape]] = [[] for _ in robot.frames]
    for link, p, axis, size in CAPSULES:
        drawn[link].append(Shape("capsule", size, dual_quaternion.from_pose(ALONG[axis], p)))
    frames = tuple(x._replace(drawing=Drawing(tuple(own))) for x, own in zip(robot.frames, drawn, strict=True))
    return robot.replace(limits=Limits(*map(double, (lower, upper, velocity, effort))), frames=frames).bake()
