from __future__ import annotations

import re
import shutil
import zipfile
from importlib import resources

import mujoco
import numpy as np
import pytest

from imitarm.errors import FileFormatError, InputError, UnknownNameError
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.arm_file import ARMS, TOOLS
from imitarm.kinematics.arm_joints import DEFAULT_MAX_ACCELERATION, DEFAULT_MAX_VELOCITY

MODELS = resources.files("imitarm") / "robots" / "models"
INERTIA = (
    "<inertial><origin xyz='0 0 0.1'/><mass value='1'/>"
    "<inertia ixx='.01' iyy='.01' izz='.01' ixy='0' ixz='0' iyz='0'/></inertial>"
)


def link(name, extra=""):
    return f"<link name='{name}'>{INERTIA}{extra}</link>"


def joint(
    name,
    parent,
    child,
    kind="revolute",
    xyz="0 0 0.2",
    axis="0 1 0",
    limit="lower='-2' upper='1' effort='30' velocity='1.5'",
):
    limits = f"<limit {limit}/>" if limit else ""
    return (
        f"<joint name='{name}' type='{kind}'><parent link='{parent}'/><child link='{child}'/>"
        f"<origin xyz='{xyz}'/><axis xyz='{axis}'/>{limits}</joint>"
    )


def urdf(*parts):
    return "<robot name='two'>" + "".join(parts) + "</robot>"


TWO_LINKS = urdf(
    "<link name='base'/>", link("upper"), link("lower"), "<link name='plate'/>",
    joint("shoulder", "base", "upper"), joint("elbow", "upper", "lower", limit="lower='-1' upper='3'"),
    joint("mount", "lower", "plate", kind="fixed", limit=""),
)  # fmt: skip
FINGERED = urdf(
    "<link name='base'/>", link("upper"), link("lower"), link("palm"), link("left"), link("right"),
    joint("shoulder", "base", "upper"), joint("elbow", "upper", "lower"),
    joint("mount", "lower", "palm", kind="fixed", limit=""),
    joint("finger1", "palm", "left", kind="prismatic"), joint("finger2", "palm", "right", kind="prismatic"),
)  # fmt: skip
FLOATING = "<mujoco><worldbody><body><freejoint/><geom size='.1'/></body></worldbody></mujoco>"
MJCF = """
<mujoco model="planar"><compiler angle="radian"/>
  <custom>{custom}</custom>
  <worldbody>
    <body name="first"><joint name="a" axis="0 0 1" range="-1 2"/>
      <geom type="capsule" size=".03" fromto="0 0 0 .4 0 0"/>
      <body name="second" pos=".4 0 0"><joint name="b" axis="0 0 1"/>
        <geom type="capsule" size=".03" fromto="0 0 0 .3 0 0"/>{inside}
      </body>
    </body>
  </worldbody>
  {outside}
</mujoco>"""


@pytest.fixture
def write(tmp_path):
    def writer(text, name="arm.urdf"):
        path = tmp_path / name
        path.write_text(text)
        return path

    return writer


def mjcf(custom="", inside="", outside=""):
    return MJCF.format(custom=custom, inside=inside, outside=outside)


def test_every_packaged_file_is_named_and_every_name_has_its_file():
    assert {*ARMS.values(), *TOOLS.values()} == {file.name for file in MODELS.iterdir()}


def test_a_urdf_keeps_its_limits_and_its_fixed_flange(write):
    arm = ArmModel.load(write(TWO_LINKS))
    assert arm.name == "arm"
    assert arm.joint_names == ("shoulder", "elbow")
    assert arm.lower.tolist() == [-2, -1] and arm.upper.tolist() == [1, 3]
    assert arm.max_velocity.tolist() == [1.5, DEFAULT_MAX_VELOCITY]
    assert arm.max_torque[0] == 30.0 and arm.max_torque[1] == np.inf
    assert arm.max_acceleration.tolist() == [DEFAULT_MAX_ACCELERATION] * 2
    assert np.allclose(arm.home, [-0.5, 1.0])  # the middle of the ranges
    assert np.allclose(arm.forward_kinematics([0, 0]).position, [0, 0, 0.6])
    assert np.allclose(arm.forward_kinematics([np.pi / 2 - 2, 0]).position[1], 0.0)


def test_a_chain_ends_where_fingers_part(write):
    arm = ArmModel.load(write(FINGERED))
    assert arm.joint_names == ("shoulder", "elbow")
    assert np.allclose(arm.forward_kinematics([0, 0]).position, [0, 0, 0.6])
    other = ArmModel.load(write(FINGERED), flange="left")
    assert other.joint_names == ("shoulder", "elbow", "finger1")
    assert other.max_velocity[2] == 1.5


def test_the_flange_can_be_named_as_body_or_site(write):
    path = write(mjcf(inside='<site name="end" pos=".3 0 0"/><site name="flange" pos=".1 0 0"/>'), "arm.xml")
    positions = [ArmModel.load(path, flange=f).forward_kinematics([0, 0]).position[0] for f in (None, "end", "second")]
    assert np.allclose(positions, [0.5, 0.7, 0.4])
    first = ArmModel.load(path, flange="first")
    assert first.joint_names == ("a",)
    with pytest.raises(UnknownNameError, match="'hand'; known: end, first, flange, second"):
        ArmModel.load(path, flange="hand")


def test_an_mjcf_says_its_limits_in_custom_numerics_and_actuators(write):
    numbers = '<numeric name="max_velocity" data="3 4"/><numeric name="max_acceleration" data="5 6"/>'
    motors = '<actuator><motor joint="a" gear="2" ctrlrange="-7 7"/><position joint="b" forcerange="-9 9"/></actuator>'
    arm = ArmModel.load(write(mjcf(numbers, outside=motors), "arm.xml"))
    assert arm.max_velocity.tolist() == [3, 4] and arm.max_acceleration.tolist() == [5, 6]
    assert arm.max_torque.tolist() == [14, 9]
    assert arm.upper.tolist() == [2, np.inf]
    wrong = mjcf('<numeric name="max_velocity" data="3 4 5"/>')
    with pytest.raises(FileFormatError, match="'max_velocity'> needs 2 positive values"):
        ArmModel.load(write(wrong, "wrong.xml"))


def test_home_is_the_keyframe_of_that_name_else_the_first(write):
    keys = '<keyframe><key name="park" qpos="0.1 0.2"/>{}</keyframe>'
    assert ArmModel.load(write(mjcf(outside=keys.format("")), "a.xml")).home.tolist() == [0.1, 0.2]
    both = keys.format('<key name="home" qpos="0.3 0.4"/>')
    assert ArmModel.load(write(mjcf(outside=both), "b.xml")).home.tolist() == [0.3, 0.4]


def test_any_arm_takes_the_packaged_tools(write):
    for tool, length in (("brush", 0.2), ("gripper", 0.1034)):
        arm = ArmModel.load(write(TWO_LINKS), tool=tool)
        assert np.allclose(arm.tool_pose([0, 0]).position, [0, 0, 0.6 + length])
        assert arm.tool_radius > 0.0
        assert arm.n_joints == 2


def test_a_tool_of_ones_own(write):
    body = '<body name="pen"><geom type="capsule" size=".01" fromto="0 0 0 0 0 .1"/>{}</body>'
    tool = "<mujoco><worldbody>" + body + "</worldbody></mujoco>"
    arm = ArmModel.load("sawyer", tool=write(tool.format('<site name="tool" pos="0 0 .11"/>'), "pen.xml"))
    assert np.allclose(arm.tool_to_flange.position, [0, 0, 0.11])
    assert "tool/pen" in arm.sphere_bodies
    with pytest.raises(InputError, match="needs a site named 'tool'"):
        ArmModel.load("sawyer", tool=write(tool.format(""), "blunt.xml"))


def test_names_of_a_composed_arm():
    spec = ArmModel.load("panda", tool="gripper").spec()
    model = spec.compile()
    names = [model.site(i).name for i in range(model.nsite)]
    assert names == ["shoulder", "elbow", "wrist", "flange", "tool_mount", "tool"]
    assert model.actuator(0).name == "tool/opening" and model.nu == 1
    assert {model.body(i).name for i in range(model.nbody)} >= {"panda_link8", "tool/left_finger"}


MESH = "<visual><geometry><mesh filename='package://nowhere/part.stl'/></geometry></visual><collision><geometry><mesh filename='package://nowhere/part.stl'/></geometry></collision>"


def test_missing_meshes_are_named_and_can_be_left_out(write):
    path = write(TWO_LINKS.replace(link("upper"), link("upper", MESH)))
    with pytest.raises(FileFormatError, match=r"part\.stl.*discard_meshes=True"):
        ArmModel.load(path)
    arm = ArmModel.load(path, discard_meshes=True)
    assert arm.n_joints == 2 and not arm.sphere_bodies
    centers, radii = arm.collision_spheres(arm.home)
    assert centers.shape == (0, 3) and radii.shape == (0,)
    assert arm.sphere_jacobians(arm.home).shape == (0, 3, 2)


def test_meshes_of_a_ros_package_are_found_beside_the_file(tmp_path):
    package = tmp_path / "two_description"
    (package / "urdf").mkdir(parents=True)
    (package / "meshes").mkdir()
    corners = ["0 0 0", "0.1 0 0", "0 0.1 0", "0 0 0.1"]
    faces = ["1 3 2", "1 2 4", "1 4 3", "2 3 4"]
    (package / "meshes" / "part.obj").write_text(
        "".join(f"v {c}\n" for c in corners) + "".join(f"f {f}\n" for f in faces)
    )
    mesh = MESH.replace("package://nowhere/part.stl", "package://two_description/meshes/part.obj")
    path = package / "urdf" / "two.urdf"
    path.write_text(TWO_LINKS.replace(link("upper"), link("upper", mesh)))
    arm = ArmModel.load(path)
    assert set(arm.sphere_bodies) == {"upper"}
    centers, radii = arm.collision_spheres([0, 0])
    for corner in np.array([c.split() for c in corners], dtype=float):
        assert np.min(np.linalg.norm(centers - corner - [0, 0, 0.2], axis=1) - radii) <= 1e-9


@pytest.mark.parametrize(
    ("text", "error", "said"),
    [
        ("", FileFormatError, "not an XML file"),
        ("joint,limit\n1,2\n", FileFormatError, "not an XML file"),
        (TWO_LINKS[:200], FileFormatError, "not an XML file"),
        ("<html><body/></html>", FileFormatError, "root element is <html>"),
        ("<robot name='r'><link name='base'/></robot>", InputError, "no joint"),
        ("<mujoco><worldbody/></mujoco>", InputError, "flange|no joint"),
        (FLOATING, InputError, "floats on a free joint"),
        ("<mujoco><worldbody><bodie/></worldbody></mujoco>", FileFormatError, "bodie"),
    ],
)  # fmt: skip
def test_what_is_no_arm_is_refused(write, text, error, said):
    path = write(text)
    with pytest.raises(error, match=said) as caught:
        ArmModel.load(path)
    assert str(path) in str(caught.value)


def test_binary_files_are_refused(tmp_path):
    path = tmp_path / "arm.xml"
    path.write_bytes(bytes(range(256)))
    with pytest.raises(FileFormatError, match="not an XML file"):
        ArmModel.load(path)


def test_a_name_that_is_not_known_is_answered_with_the_known_ones(tmp_path):
    with pytest.raises(
        UnknownNameError, match=r"unknown robot 'baxter'; known: panda, sawyer; or give the path of an MJCF or URDF"
    ):
        ArmModel.load("baxter")
    with pytest.raises(UnknownNameError, match="unknown tool 'saw'; known: brush, gripper"):
        ArmModel.load("sawyer", tool="saw")
    with pytest.raises(InputError, match=r"no such file: .*nothing\.urdf"):
        ArmModel.load(tmp_path / "nothing.urdf")
    with pytest.raises(InputError, match="is a folder"):
        ArmModel.load(tmp_path)


@pytest.mark.parametrize("name", list(ARMS))
def test_a_packaged_file_loads_from_anywhere(name, tmp_path):
    copy = tmp_path / "mine.xml"
    shutil.copy(str(MODELS / ARMS[name]), copy)
    mine, packaged = ArmModel.load(copy), ArmModel.load(name)
    assert mine.name == "mine"
    assert np.array_equal(mine.home, packaged.home)
    assert np.array_equal(mine.max_velocity, packaged.max_velocity)


@pytest.mark.parametrize("name", list(ARMS))
def test_what_is_written_out_is_the_same_arm(name, tmp_path):
    arm = ArmModel.load(name, tool="gripper")
    path = tmp_path / "composed.xml"
    path.write_text(arm.spec().to_xml())
    again = ArmModel.load(path)
    assert again.n_joints == 7
    assert np.allclose(again.tool_pose(arm.home).matrix, arm.tool_pose(arm.home).matrix, atol=1e-5)


def test_models_are_ours_and_of_primitive_shapes_only():
    for file in MODELS.iterdir():
        if file.name.endswith(".xml"):
            text = file.read_text()
            assert not re.search(r"<mesh|<texture|<hfield|file=", text), file.name
            spec = mujoco.MjSpec.from_string(text)
            assert {g.group for g in spec.geoms} == {2, 3}


def test_the_wheel_would_hold_the_models():
    """They are inside the package's folder, from where the build takes every file."""
    package = resources.files("imitarm")
    assert not isinstance(package, zipfile.Path)
    assert (package / "robots" / "models" / "sawyer.xml").is_file()
