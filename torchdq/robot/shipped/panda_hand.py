"""Franka Emika Panda with its hand, a gripper: `torchdq.robots.load("panda_hand")`.

The last of its eight coordinates is the opening of each finger, 0 to 0.04 m, and its effort is the force of both. Each
finger has a pad of four spheres as its collision shape: `effects.Contact("*_finger", on="cube")`. The end effector is
the frame "tcp" between the fingertips; "link8" is the flange.

Numbers of hand, fingers, rotors and damping: `franka_emika_panda/panda.xml` of Google DeepMind's MuJoCo Menagerie
(Apache License 2.0, derived from franka_description of Franka Emika GmbH under the same licence), whose arm is that of
`panda`. The speed of the fingers and the place of "tcp" are franka_description's. The spheres lie in the largest pad of
panda.xml, and touch what its face would. The hand is drawn by the box around it, and the fingers by the boxes that they
have in franka_description.
"""

from math import cos, pi, sin

from torchdq.robot.arrays import double
from torchdq.robot.robot import Robot
from torchdq.robot.shipped import panda

ROTOR, DAMPING = 0.1, 1.0  # of each of the nine joints [kg m^2 or kg], [N m s/rad or N s/m]
TURN = -pi / 4  # of the hand about the axis of the flange [rad]

SPHERE = '<collision><origin xyz="{} 0.0055 {}"/><geometry><sphere radius="0.004"/></geometry></collision>'
PAD = "".join(SPHERE.format(x, z) for x in (-0.0065, 0.0065) for z in (0.038, 0.051))
BODY = (
    '<inertial><origin xyz="{} 0 {}"/><mass value="{}"/><inertia ixx="{}" iyy="{}" izz="{}" ixy="0" ixz="0" iyz="0"/>'
    "</inertial>"
)
BOX = '<visual><origin xyz="0 {}" rpy="{} 0 0"/><geometry><box size="{}"/></geometry></visual>'
PALM = BOX.format("-0.0018 0.02", 0, "0.0632 0.2044 0.0919")
FORM = [
    ("0.0185 0.011", 0, "0.022 0.015 0.02"),
    ("0.0068 0.0022", 0, "0.022 0.0088 0.0038"),
    ("0.0159 0.02835", pi / 6, "0.0175 0.007 0.0235"),
    ("0.00758 0.04525", 0, "0.0175 0.0152 0.0185"),
]
FINGER = BODY.format(0, 0, 0.015, 2.375e-6, 2.375e-6, 7.5e-7) + PAD + "".join(BOX.format(*row) for row in FORM)
SLIDE = '<limit lower="0" upper="0.04" effort="100" velocity="0.2"/>'
HAND = f"""<robot name="hand">
<link name="hand">{BODY.format(-0.01, 0.03, 0.73, 0.001, 0.0025, 0.0017)}{PALM}</link>
<link name="left_finger">{FINGER}</link><link name="right_finger">{FINGER}</link><link name="tcp"/>
<joint name="finger_joint1" type="prismatic"><parent link="hand"/><child link="left_finger"/>
<origin xyz="0 0 0.0584"/><axis xyz="0 1 0"/>{SLIDE}</joint>
<joint name="finger_joint2" type="prismatic"><parent link="hand"/><child link="right_finger"/>
<origin xyz="0 0 0.0584" quat_xyzw="0 0 1 0"/><axis xyz="0 1 0"/>{SLIDE}<mimic joint="finger_joint1"/></joint>
<joint name="tcp_joint" type="fixed"><parent link="hand"/><child link="tcp"/><origin xyz="0 0 0.1034"/></joint>
</robot>"""


def build() -> Robot:
    """Panda arm with its hand, rotor inertia included."""
    arm, hand = panda.arm("panda_hand", ""), Robot.from_urdf(HAND, base="floating", tip="tcp")
    names = {"base": "link0", "tip": "link8"}  # as the files call them
    arm = arm.replace(frames=tuple(x._replace(name=names.get(x.name, x.name)) for x in arm.frames), tip="link8")
    robot = arm.attach(hand, "link8", base_pose=[cos(TURN / 2), 0, 0, sin(TURN / 2), 0, 0, 0, 0])
    joints = double([1.0] * 7 + [2.0])  # that each coordinate moves
    return robot.replace(armature=ROTOR * joints, damping=DAMPING * joints).bake()
