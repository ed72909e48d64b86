"""Universal Robots UR10e, six joints.

Numbers: `ur_e_description/urdf/ur10e.urdf` of ROS-Industrial's universal_robot (BSD), whose zero position is the
controller's zero position; links are modelled there as cylinders. Limits: the same file. Masses and velocity limits are
not those of the manufacturer's later description, which is the one to load for a real arm.
"""

from math import pi, sqrt

import torch

from torchdq import dq
from torchdq.backends.choice import backend
from torchdq.robot.arrays import double
from torchdq.robot.description import Limits
from torchdq.robot.robot import Robot

# joint | axis in the base frame | link | position [m] and orientation in the base frame, all at home
IDENTITY, QUARTER, HALF = (1.0, 0.0, 0.0, 0.0), (sqrt(0.5), 0.0, sqrt(0.5), 0.0), (0.0, 0.0, 1.0, 0.0)  # about y
CHAIN = [
    ("shoulder_pan_joint", (0, 0, 1), "shoulder_link", (0.0, 0.0, 0.181), IDENTITY),
    ("shoulder_lift_joint", (0, 1, 0), "upper_arm_link", (0.0, 0.176, 0.181), QUARTER),
    ("elbow_joint", (0, 1, 0), "forearm_link", (0.613, 0.039, 0.181), QUARTER),
    ("wrist_1_joint", (0, 1, 0), "wrist_1_link", (1.184, 0.039, 0.181), HALF),
    ("wrist_2_joint", (0, 0, -1), "wrist_2_link", (1.184, 0.174, 0.181), HALF),
    ("wrist_3_joint", (0, 1, 0), "wrist_3_link", (1.184, 0.174, 0.061), HALF),
]

# mass [kg] | centre of mass [m] | xx xy yy xz yz zz about it [kg m^2], in the link frames
BODIES = [
    (7.778, (0.0, 0.0, 0.0), (0.0314743125769, 0, 0.0314743125769, 0, 0, 0.021875625)),
    (12.93, (0.0, 0.0, 0.3065), (0.42307374077, 0, 0.42307374077, 0, 0, 0.036365625)),
    (3.87, (0.0, 0.0, 0.2855), (0.110590365764, 0, 0.110590365764, 0, 0, 0.010884375)),
    (1.96, (0.0, 0.135, 0.0), (0.0051082479567, 0, 0.0051082479567, 0, 0, 0.0055125)),
    (1.96, (0.0, 0.0, 0.12), (0.0051082479567, 0, 0.0051082479567, 0, 0, 0.0055125)),
    (0.202, (0.0, 0.092, 0.0), (0.000144345775595, 0, 0.000204525, 0, 0, 0.000144345775595)),
]


@backend("eager")  # a few poses need no compilation
def build() -> Robot:
    """UR10e arm; its tip is the controller's tool frame."""
    joints, axes, links, positions, orientations = zip(*CHAIN, strict=True)
    mass, com, inertia = zip(*BODIES, strict=True)
    l, p = double(axes), double(positions)
    # the tool's z axis leaves the flange: a quarter turn back about x from the last link
    tool = dq.mul(double(HALF), double((sqrt(0.5), -sqrt(0.5), 0.0, 0.0)))
    robot = Robot.from_screws(
        name="ur10e",
        joint_screws=torch.cat([l, torch.linalg.cross(p, l)], -1),
        link_poses=dq.from_pose(double(orientations), p),
        tip_pose=dq.from_pose(tool, double((1.184, 0.291, 0.061))),
        mass=mass,
        com=com,
        inertia=inertia,
        joint_names=joints,
        link_names=links,
    )
    reach = double([2 * pi, 2 * pi, pi, 2 * pi, 2 * pi, 2 * pi])
    return robot.replace(
        limits=Limits(
            -reach,
            reach,
            velocity=double([3.14, 3.14, 3.14, 6.28, 6.28, 6.28]),
            effort=double([330, 330, 150, 54, 54, 54]),
        )
    ).bake()
