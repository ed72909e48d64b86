"""A four-bar linkage, whose motion one equation has."""

import torchdq
from torchdq import Closure

LOOP = """
<robot name="bars"><link name="ground"/>{}<link name="end"/><link name="pivot"/>
  <joint name="to_end" type="fixed"><parent link="c"/><child link="end"/><origin xyz=".4 0 0"/></joint>
  <joint name="to_pivot" type="fixed"><parent link="ground"/><child link="pivot"/><origin xyz=".4 0 0"/></joint></robot>
"""


def four_bar():
    """Three uniform bars of 1 kg/m in the x-z plane, hinged in a row, of which the last ends at a pivot 0.4 m away."""
    parts, parent, at = "", "ground", 0.0
    for name, length in (("a", 0.2), ("b", 0.4), ("c", 0.4)):
        moment = length**3 / 12
        parts += f"""<link name="{name}"><inertial><origin xyz="{length / 2} 0 0"/><mass value="{length}"/>
          <inertia ixx="1e-5" ixy="0" ixz="0" iyy="{moment}" iyz="0" izz="{moment}"/></inertial></link>
          <joint name="j{name}" type="continuous"><parent link="{parent}"/><child link="{name}"/>
          <origin xyz="{at} 0 0"/><axis xyz="0 -1 0"/></joint>"""
        parent, at = name, length
    return torchdq.Robot.from_urdf(LOOP.format(parts), tip="end").with_closures(Closure("pivot", "end"))
