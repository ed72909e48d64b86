"""Planar two-link arm of the paper: unit links of unit mass, hanging in gravity along -y.

The paper does not print its inertia. The uniform thin rod, m L^2/12 about the two transverse axes, is taken: with
no inertia at all, as in the toolbox model the paper's figure resembles, errors in the inertia would not show.
"""

from torchdq.robot.robot import Robot

LENGTH = 1.0  # [m]
MASS = 1.0  # [kg]
TRANSVERSE = MASS * LENGTH**2 / 12.0  # [kg m^2]


def build() -> Robot:
    """Two-link arm; link frames sit at the centres of mass, as in the paper."""
    return Robot.from_screws(
        name="two_link",
        joint_screws=[[0, 0, 1, 0, 0, 0], [0, 0, 1, 0, -LENGTH, 0]],  # about z at x = 0 and x = L: p x l
        link_poses=[[1, 0, 0, 0, 0, 0.25 * LENGTH, 0, 0], [1, 0, 0, 0, 0, 0.75 * LENGTH, 0, 0]],
        tip_pose=[1, 0, 0, 0, 0, LENGTH, 0, 0],
        mass=[MASS, MASS],
        com=[[0, 0, 0], [0, 0, 0]],
        inertia=[[0, 0, TRANSVERSE, 0, 0, TRANSVERSE]] * 2,
        gravity=(0.0, -9.81, 0.0),
    )
