"""MJCF files as text: an arm, coupled joints, a walker, random trees and the models that come with gymnasium."""

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
