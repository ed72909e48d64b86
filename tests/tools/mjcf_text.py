"""MJCF files as text: arms, a hand, coupled joints, a walker, random trees and the models that come with gymnasium."""

from pathlib import Path

import mujoco
import numpy as np

ASSETS = Path(mujoco.__file__).parents[1] / "gymnasium" / "envs" / "mujoco" / "assets"

ARM = """
<mujoco model="arm">
  <compiler angle="degree" eulerseq="xyz"/>
  <option gravity="0.3 -1 -9"/>
  <default>
    <joint armature="0.02" damping="0.5"/>
    <geom density="700"/>
    <default class="finger"><joint type="slide" range="0 0.04" damping="2" frictionloss="0.1"/></default>
  </default>
  <worldbody>
    <body name="foot" pos="0.1 0.2 0.3" euler="10 20 30">
      <geom type="box" size="0.1 0.1 0.1"/>
      <body name="shoulder" pos="0 0 0.2" quat="0.9 0.1 -0.2 0.3">
        <joint name="turn" axis="0 0.1 1" pos="0.01 0.02 -0.1" range="-90 120"/>
        <joint name="tilt" axis="1 0 0.2" pos="0 0.05 0.1" ref="20" frictionloss="0.3"/>
        <geom type="capsule" size="0.04 0.2" pos="0.1 0 0.1" euler="20 30 0"/>
        <body name="plate" pos="0.1 -0.1 0.3" axisangle="1 1 0 40">
          <inertial pos="0.01 0.02 0.03" mass="0.7" fullinertia="0.01 0.012 0.015 0.001 -0.002 0.0005"/>
          <site name="mark" pos="0.01 0 0.2" euler="0 45 0"/>
          <site name="plate" pos="0.01 0 0.2"/>
          <body name="rail" pos="0.2 0 0">
            <joint name="slide" type="slide" axis="0.2 1 0" pos="0.3 0.1 0" ref="0.1" armature="0.4"/>
            <geom type="ellipsoid" size="0.05 0.1 0.07" mass="1.2"/>
            <body name="hand" pos="0 0.1 0.1" xyaxes="0 1 0 0 0 1">
              <joint axis="0 1 0" damping="0"/>
              <geom type="cylinder" size="0.05 0.1"/>
            </body>
          </body>
        </body>
      </body>
    </body>
    <body name="tower">
      <joint name="yaw" axis="0 0 -1"/>
      <inertial pos="0 0 0.4" mass="3" diaginertia="0.1 0.2 0.15" quat="1 1 0 0"/>
    </body>
  </worldbody>
  <actuator>
    <motor joint="turn" gear="3" ctrlrange="-2 1" armature="0.01" damping="0.1"/>
    <position joint="turn" gear="-2" kp="50" forcerange="-4 5"/>
    <motor joint="slide"/>
  </actuator>
</mujoco>
"""
COUPLED = """
<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <body name="lift" pos="0 0 1">
      <joint name="lift" type="slide" axis="0 0 1" ref="0.2"/><geom size="0.1"/>
      <body name="left" pos="0.1 0 0">
        <joint name="left" axis="0 1 0" ref="0.3" range="-1 2" damping="2" frictionloss="0.5" armature="0.1"/>
        <geom size="0.05"/>
        <body name="tip" pos="0.1 0 0"><joint name="tip" axis="0 1 0" range="0 1.5"/><geom size="0.02"/></body>
      </body>
      <body name="right" pos="-0.1 0 0">
        <joint name="right" axis="0 1 0" ref="-0.1" damping="3" frictionloss="0.25" armature="0.2"/>
        <geom size="0.05"/>
      </body>
    </body>
  </worldbody>
  <equality>
    <joint name="both" joint1="right" joint2="left" polycoef="0.05 -2 0 0 0"/>
    <joint name="follow" joint1="tip" joint2="right" polycoef="0 -0.5 0 0 0"/>
    <joint name="again" joint1="left" joint2="right" polycoef="0.025 -0.5 0 0 0"/>
    <joint name="off" joint1="lift" joint2="right" active="false"/>
  </equality>
  <actuator><motor joint="left" ctrlrange="-3 3"/><motor joint="right" ctrlrange="-1 1"/></actuator>
</mujoco>
"""
FREE = """
<mujoco model="walker">
  <option gravity="0 0 -3.7"/>
  <worldbody>
    <geom type="plane" size="1 1 1"/>
    <body name="torso" pos="0 0 1" quat="0.9 0.3 0.1 0.2">
      <freejoint name="root"/>
      <inertial pos="0.01 0 0.02" mass="5" diaginertia="0.1 0.2 0.15" quat="0.5 0.5 0.1 0.2"/>
      <body name="head" pos="0 0 0.4"><geom type="box" size="0.1 0.05 0.08" pos="0.05 0 0"/></body>
      <body name="leg" pos="0 0 -0.2"><joint name="hip" axis="0 1 0"/><geom type="capsule" size="0.03 0.2"/></body>
    </body>
  </worldbody>
</mujoco>
"""


def random_mjcf(seed: int) -> str:
    """Tree of bodies with no, one or two joints at random places, in a frame, with inertias of any kind."""
    rng = np.random.default_rng(seed)
    word = lambda n, scale=1.0: " ".join(f"{x:.17g}" for x in rng.normal(scale=scale, size=n))  # noqa: E731

    def body(i: int, depth: int) -> str:
        joints = "".join(
            f'<joint name="j{i}_{k}" type="{rng.choice(["hinge", "slide"])}" axis="{word(3)}" pos="{word(3, 0.2)}" '
            f'ref="{word(1)}" armature="{rng.uniform()}"/>'
            for k in range(rng.choice([0, 1, 2], p=[0.2, 0.5, 0.3]))
        )
        shape = f'<geom type="box" size="0.1 0.2 0.3" pos="{word(3, 0.1)}" quat="{word(4)}"/>'
        below = "".join(body(10 * i + k, depth - 1) for k in range(rng.integers(1, 3))) if depth else ""
        return f'<body name="b{i}" pos="{word(3, 0.5)}" quat="{word(4)}">{joints}{shape}{below}</body>'

    trees = body(1, 3) + body(2, 1)
    return f'<mujoco><compiler angle="radian"/><worldbody><frame pos="{word(3)}">{trees}</frame></worldbody></mujoco>'


def fixed_assets() -> list[Path]:
    """Models that come with gymnasium and have a fixed base and single joints."""
    found = []
    for path in sorted(ASSETS.glob("*.xml")):
        m = mujoco.MjModel.from_xml_path(str(path))
        if m.njnt == m.nv and m.nv:
            found.append(path)
    return found


def model_of(source) -> mujoco.MjModel:
    """MuJoCo's model."""
    if isinstance(source, Path):
        return mujoco.MjModel.from_xml_path(str(source))
    return mujoco.MjModel.from_xml_string(source)


PANDA_LINKS = """
0 0 0.333 | 1 0 0 0 | 4.970684 | 0.003875 0.002081 -0.04762
0 0 0 | 1 -1 0 0 | 0.646926 | -0.003141 -0.02872 0.003495
0 -0.316 0 | 1 1 0 0 | 3.228604 | 2.7518e-2 3.9252e-2 -6.6502e-2
0.0825 0 0 | 1 1 0 0 | 3.587895 | -5.317e-2 1.04419e-1 2.7454e-2
-0.0825 0.384 0 | 1 -1 0 0 | 1.225946 | -1.1953e-2 4.1065e-2 -3.8437e-2
0 0 0 | 1 1 0 0 | 1.666555 | 6.0149e-2 -1.4117e-2 -1.0517e-2
0.088 0 0 | 1 1 0 0 | 7.35522e-01 | 1.0517e-2 -4.252e-3 6.1597e-2
"""  # at | turned by | mass | centre
PANDA_INERTIAS = """
0.70337 0.70661 0.0091170 -0.00013900 0.0067720 0.019169
0.0079620 2.8110e-2 2.5995e-2 -3.925e-3 1.0254e-2 7.04e-4
3.7242e-2 3.6155e-2 1.083e-2 -4.761e-3 -1.1396e-2 -1.2805e-2
2.5853e-2 1.9552e-2 2.8323e-2 7.796e-3 -1.332e-3 8.641e-3
3.5549e-2 2.9474e-2 8.627e-3 -2.117e-3 -4.037e-3 2.29e-4
1.964e-3 4.354e-3 5.433e-3 1.09e-4 -1.158e-3 3.41e-4
1.2516e-2 1.0027e-2 4.815e-3 -4.28e-4 -1.196e-3 -7.41e-4
"""  # xx yy zz xy xz yz
PANDA_PADS = """
0.0085 0.004 0.0085 | 0 0.0055 0.0445
0.003 0.002 0.003 | 0.0055 0.002 0.05
0.003 0.002 0.003 | -0.0055 0.002 0.05
0.003 0.002 0.0035 | 0.0055 0.002 0.0395
0.003 0.002 0.0035 | -0.0055 0.002 0.0395
"""  # half edges | at
PAD = "".join(
    '<geom type="box" size="{}" pos="{}"/>'.format(*row.split("|")) for row in PANDA_PADS.strip().splitlines()
)
FINGER = """<body name="{}_finger" pos="0 0 0.0584" quat="{}">
<joint name="finger_joint{}" type="slide" axis="0 1 0" armature="0.1"/>
<inertial mass="0.015" pos="0 0 0" diaginertia="2.375e-6 2.375e-6 7.5e-7"/>{}</body>"""


def panda_hand_mjcf(pad=PAD):
    """Panda with its hand: the numbers of franka_emika_panda/panda.xml of Google DeepMind's MuJoCo Menagerie."""
    text = '<body name="hand" pos="0 0 0.107" euler="0 0 -45">'
    text += '<inertial mass="0.73" pos="-0.01 0 0.03" diaginertia="0.001 0.0025 0.0017"/>'
    text += FINGER.format("left", "1 0 0 0", 1, pad) + FINGER.format("right", "0 0 0 1", 2, pad) + "</body>"
    links, inertias = (table.strip().splitlines() for table in (PANDA_LINKS, PANDA_INERTIAS))
    for i in range(7, 0, -1):
        at, turned, mass, com = links[i - 1].split(" | ")
        body = f'<inertial mass="{mass}" pos="{com}" fullinertia="{inertias[i - 1]}"/>'
        body += f'<joint name="joint{i}" axis="0 0 1" armature="0.1"/>'
        text = f'<body name="link{i}" pos="{at}" quat="{turned}">{body}{text}</body>'
    return f"<mujoco><worldbody>{text}</worldbody></mujoco>"
