"""Robots as others describe them: an MJCF as a page shows it, and one as models of MuJoCo Menagerie are."""

import re
from pathlib import Path

import trimesh

PAGE = Path(__file__).parent.parent / "docs" / "add_a_robot.md"

# As models of MuJoCo Menagerie are: classes, an included file, meshes for looks, position actuators, a keyframe. The
# neck is one joint too many, the feet are on bodies of their own, and hip and thigh of a leg move one body. Springs and
# dampers are not linear, and what turns with a motor is said at its actuator.
MULE = """
<mujoco model="mule">
  <compiler angle="radian" meshdir="assets"/>
  <default>
    <default class="mule">
      <joint damping="0.1 0.02 0.01" stiffness="0.3 0.2 0.1" armature="0.01" frictionloss="0.05"/>
      <position kp="15" kv="0.375" gear="2" forcerange="-20 20" armature="0.002" damping="0.03 0.02 0.01"/>
      <default class="looks"><geom type="mesh" contype="0" conaffinity="0" mass="0" rgba="0.2 0.3 0.4 1"/></default>
      <default class="hit"><geom group="3" mass="0"/></default>
    </default>
  </default>
  <asset><mesh name="bone" file="bone.stl" scale="0.001 0.001 0.001"/></asset>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 1"/>
    <body name="body" pos="0 0 0.5" childclass="mule">
      <freejoint name="root"/>
      <inertial mass="9" pos="0.01 0 0.02" quat="0.9 0.1 0.2 0.3" diaginertia="0.05 0.2 0.22"/>
      <geom class="looks" mesh="bone"/>
      <geom class="hit" name="barrel" type="ellipsoid" size="0.25 0.12 0.1"/>
      <geom class="hit" name="saddle" type="mesh" mesh="bone" pos="0.05 0 0.1"/>
      <body name="neck" pos="0.3 0 0.05">
        <joint name="nod" axis="0 1 0" range="-1 1"/><geom size="0.05" mass="0.4"/>
      </body>
      <include file="legs.xml"/>
    </body>
  </worldbody>
  <actuator>{actuators}<position class="mule" joint="nod"/></actuator>
  <sensor><jointpos joint="nod"/><touch site="hoof_hl"/></sensor>
  <keyframe><key name="home" qpos="0 0 0.5 1 0 0 0 0 {pose}"/></keyframe>
</mujoco>
"""
MULE_LEG = """
<body name="thigh_{leg}" pos="{x} {y} 0" quat="0.99 0.01 0.02 0.1">
  <inertial mass="1.1" pos="0 0.01 -0.08" diaginertia="0.006 0.005 0.002"/>
  <joint name="{leg}1" axis="1 0 0" range="-0.6 0.6"/><joint name="{leg}2" axis="0 -1 0" range="-2.4 1.0"/>
  <geom class="looks" mesh="bone"/><geom class="hit" type="box" size="0.02 0.03 0.1" pos="0 0 -0.11"/>
  <body name="shank_{leg}" pos="0 0 -0.23">
    <inertial mass="0.3" pos="0.01 0 -0.1" diaginertia="0.001 0.001 0.0001"/>
    <joint name="{leg}3" axis="0 -1 0" range="0.5 2.6"/>
    <geom class="hit" type="cylinder" size="0.012 0.08" pos="0 0 -0.1"/>
    <body name="hoof_{leg}" pos="0 0 -0.22">
      <geom class="hit" size="0.025" mass="0.05"/><site name="hoof_{leg}" size="0.03"/>
    </body>
  </body>
</body>
"""
MULE_LEGS = {"hl": (-0.22, 0.11), "fr": (0.22, -0.11), "fl": (0.22, 0.11), "hr": (-0.22, -0.11)}


def write_scout(folder):
    """The model of the page."""
    text = re.search(r"```xml\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)[1]
    (folder / "scout.xml").write_text(text)
    return folder / "scout.xml"


def write_mule(folder):
    """The other model, its legs in another order in the file, its actuators in a third."""
    (folder / "assets").mkdir()
    trimesh.creation.box((50, 60, 200)).export(folder / "assets" / "bone.stl")
    legs = [MULE_LEG.format(leg=leg, x=x, y=y) for leg, (x, y) in MULE_LEGS.items()]
    (folder / "legs.xml").write_text(f"<mujoco>{''.join(legs)}</mujoco>")
    actuators = [f'<position class="mule" joint="{leg}{i}"/>' for i in (3, 1, 2) for leg in ("fr", "hl", "hr", "fl")]
    pose = " ".join(["0.05 -0.8 1.5"] * 4)
    (folder / "mule.xml").write_text(MULE.format(actuators="".join(actuators), pose=pose))
    return folder / "mule.xml"
