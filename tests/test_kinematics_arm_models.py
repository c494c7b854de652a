"""Robot files as people have them: grippers, several limbs, odd limits, missing masses, meshes elsewhere, xacro."""

from __future__ import annotations

import pickle
import re
import struct

import mujoco
import numpy as np
import pytest

from imitarm import ArmModel, InputError, SimulatedRobot
from imitarm.errors import FileFormatError
from imitarm.evaluation.motion import ArmMotion
from imitarm.kinematics.arm_joints import DEFAULT_MAX_VELOCITY
from imitarm.kinematics.spheres import COLLISION_GROUP

INERTIAL = (
    "<inertial><origin xyz='0 0 .08'/><mass value='2'/>"
    "<inertia ixx='.02' iyy='.02' izz='.01' ixy='0' ixz='0' iyz='0'/></inertial>"
)
SHAPE = "<collision><origin xyz='0 0 .1'/><geometry><cylinder radius='.03' length='.12'/></geometry></collision>"
LIMIT = "<limit lower='-2.5' upper='2.5' effort='40' velocity='1.8'/>"
AXES = ("0 0 1", "0 1 0", "0 1 0", "0 0 1", "0 1 0", "0 0 1", "0 1 0")


def link(name, parts=INERTIAL + SHAPE):
    return f"<link name='{name}'>{parts}</link>\n"


def joint(name, parent, child, kind="revolute", axis="0 1 0", limit=LIMIT, xyz="0 0 .22", extra=""):
    return (
        f"<joint name='{name}' type='{kind}'><parent link='{parent}'/><child link='{child}'/>"
        f"<origin xyz='{xyz}'/><axis xyz='{axis}'/>{limit}{extra}</joint>\n"
    )


def limb(prefix, n, base="base"):
    """A chain of n hinges on ``base``; every element is on a line of its own."""
    text = ""
    for i in range(1, n + 1):
        parent = base if i == 1 else f"{prefix}link{i - 1}"
        text += link(f"{prefix}link{i}") + joint(f"{prefix}axis{i}", parent, f"{prefix}link{i}", axis=AXES[i - 1])
    return text


def robot(*parts):
    return "<robot name='r'>\n<link name='base'/>\n" + "".join(parts) + "</robot>\n"


def slide(name, parent, child, stroke, extra="", axis="1 0 0"):
    limit = f"<limit lower='0' upper='{stroke}' effort='9' velocity='.1'/>"
    return link(child) + joint(name, parent, child, kind="prismatic", axis=axis, limit=limit, xyz="0 0 .2", extra=extra)


def hinge(name, parent, child, extra="", limit=LIMIT):
    return link(child) + joint(name, parent, child, extra=extra, limit=limit)


def mimic(leader, factor=1.0):
    return f"<mimic joint='{leader}' multiplier='{factor}' offset='0.01'/>"


@pytest.fixture
def load(tmp_path):
    def loader(text, name="arm.urdf", **options):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
        return ArmModel.load(path, **options)

    return loader


SIX = limb("a_", 6)
SIX_NAMES = tuple(f"a_axis{i}" for i in range(1, 7))
GRIPPERS = {
    "one jaw named so": hinge("jaw", "a_link6", "moving"),
    "one finger whose link is named so": hinge("open", "a_link6", "left_finger"),
    "one short unnamed slide": slide("opener", "a_link6", "clamp", 0.05),
    "uneven chains with mimic joints": hinge("drive", "a_link6", "p")
    + hinge("inner", "p", "q", mimic("drive", -1))
    + hinge("other", "a_link6", "s", mimic("drive")),
    "two slides that mirror each other": slide("s1", "a_link6", "c1", 0.2)
    + slide("s2", "a_link6", "c2", 0.2, mimic("s1"), axis="-1 0 0"),
    "a hand on a fixed palm": link("palm")
    + joint("mount", "a_link6", "palm", kind="fixed", limit="")
    + hinge("gripper_left", "palm", "x")
    + hinge("gripper_right", "palm", "y"),
    "fingers of different length without names": hinge("p1", "a_link6", "f1")
    + hinge("p2", "f1", "f2")
    + hinge("p3", "f2", "f3")
    + hinge("t1", "a_link6", "t1")
    + hinge("t2", "t1", "t2"),
}


@pytest.mark.parametrize("gripper", GRIPPERS.values(), ids=GRIPPERS)
def test_the_arm_ends_before_jaws_and_fingers(load, gripper):
    arm = load(robot(SIX, gripper))
    assert arm.joint_names == SIX_NAMES
    assert arm.notes and all("not part of the arm" in note for note in arm.notes)


def test_a_wrist_that_turns_the_gripper_is_part_of_the_arm(load):
    arm = load(robot(limb("a_", 5), hinge("gripper_roll", "a_link5", "gripper"), hinge("gripper", "gripper", "jaw")))
    assert arm.joint_names == (*SIX_NAMES[:5], "gripper_roll")


def test_a_robot_whose_joints_are_all_named_gripper_is_an_arm(load):
    arm = load(robot(limb("gripperbot_", 6)))
    assert arm.n_joints == 6 and not arm.notes


def test_a_long_slide_at_the_end_is_part_of_the_arm(load):
    assert load(robot(limb("a_", 4), slide("quill", "a_link4", "quill", 0.18))).n_joints == 5


def test_fingers_that_mimic_stand_where_their_leader_says(load):
    arm = load(robot(SIX, slide("s1", "a_link6", "c1", 0.2), slide("s2", "a_link6", "c2", 0.2, mimic("s1", 0.5))))
    model = arm.spec().compile()
    qpos = arm.posture(model)
    first, second = (qpos[model.jnt_qposadr[model.joint(name).id]] for name in ("s1", "s2"))
    assert second == pytest.approx(0.01 + 0.5 * first)


SEVERAL = {
    "a longer leg": (limb("arm_", 4) + limb("leg_", 5), {"arm_link4": 4, "leg_link5": 5}),
    "two arms on a lift": (
        slide("lift", "base", "torso", 0.4, axis="0 0 1") + limb("l_", 6, "torso") + limb("r_", 6, "torso"),
        {"l_link6": 7, "r_link6": 7},
    ),
    "four legs and an arm": (
        "".join(limb(f"leg{i}_", 3) for i in range(4)) + limb("arm_", 5),
        {"arm_link5": 5} | {f"leg{i}_link3": 3 for i in range(4)},
    ),
    "an arm with a camera on its forearm": (
        SIX + link("camera") + joint("look", "a_link4", "camera"),
        {"a_link6": 6, "camera": 5},
    ),
    "arms with a gripper each": (
        limb("l_", 5) + hinge("l_gripper", "l_link5", "l_jaw") + limb("r_", 6) + hinge("r_gripper", "r_link6", "r_jaw"),
        {"l_link5": 5, "r_link6": 6},
    ),
}


@pytest.mark.parametrize(("text", "candidates"), SEVERAL.values(), ids=SEVERAL)
def test_of_several_limbs_the_candidates_are_listed_and_each_can_be_chosen(load, text, candidates):
    with pytest.raises(InputError, match="several limbs") as caught:
        load(robot(text))
    for name, joints in candidates.items():
        assert f"'{name}' ({joints} joints: " in str(caught.value)
        assert load(robot(text), flange=name).n_joints == joints
    assert str(caught.value).count(" joints: ") == len(candidates)


def test_a_short_side_branch_is_left_out_with_a_note(load):
    arm = load(robot(hinge("pan", "base", "neck"), SIX, hinge("wheel", "base", "rim")))
    assert arm.joint_names == SIX_NAMES
    assert any("pan" in note and "wheel" in note for note in arm.notes)


def test_the_flange_is_tool0_among_several_fixed_links(load):
    ends = "".join(
        link(name, "") + joint(f"to_{name}", "a_link6", name, kind="fixed", limit="", xyz=f"0 0 {z}")
        for name, z in (("sensor", 0.1), ("r_tool0", 0.3))
    )
    arm = load(robot(SIX, ends))
    assert arm.spec().site("flange").parent.name == "r_tool0"


MIMIC = {
    "in a row": (
        limb("a_", 2) + hinge("follower", "a_link2", "x", mimic("a_axis2", -1)) + limb("b_", 3, "x"),
        "a_axis2",
    ),
    "at the end": (SIX + hinge("follower", "a_link6", "x", mimic("a_axis3", -1)), "a_axis3"),
    "on a side link": (SIX + hinge("follower", "a_link1", "rod", mimic("a_axis2")), "a_axis2"),
}


@pytest.mark.parametrize(("text", "leader"), MIMIC.values(), ids=MIMIC)
def test_a_mimic_joint_of_the_arm_is_refused_with_its_line(load, text, leader):
    text = robot(text)
    line = 1 + text[: text.index("<joint name='follower'")].count("\n")
    with pytest.raises(InputError, match=rf"joint 'follower' \(line {line}\) mimics joint '{leader}'"):
        load(text)


def test_an_mjcf_equality_is_a_mimic_joint_too(load):
    body = "<body name='b{0}' pos='0 0 .3'><joint name='{1}' axis='{2}'/><geom size='.05'/>{3}</body>"
    inner = body.format(2, "two", "0 1 0", body.format(3, "three", "0 1 0", ""))
    text = f"<mujoco><worldbody>{body.format(1, 'one', '0 0 1', inner)}</worldbody><equality>{{}}</equality></mujoco>"
    assert load(text.format(""), "free.xml").n_joints == 3
    with pytest.raises(InputError, match="joint 'three' \\(line 1\\) mimics joint 'two'"):
        load(text.format("<joint joint1='three' joint2='two' polycoef='0 -1 0 0 0'/>"), "arm.xml")


def limits(kind="revolute", **values):
    text = "<limit " + " ".join(f"{key}='{value}'" for key, value in values.items()) + "/>" if values else ""
    return robot(limb("a_", 2), link("x"), joint("odd", "a_link2", "x", kind=kind, limit=text))


BAD_LIMITS = {
    "exchanged": (limits(lower=1, upper=-1, effort=5, velocity=1), "lower limit 1 is above upper limit -1"),
    "exchanged slide": (limits("prismatic", lower=0.3, upper=0.1, effort=5, velocity=1), "exchange them"),
    "only lower": (limits(lower=-1, effort=5, velocity=1), "has the limit lower, but not upper; add upper="),
    "only upper": (limits("prismatic", upper=0.2, effort=5, velocity=1), "has the limit upper, but not lower"),
    "no range": (limits(lower=1, upper=1 + 1e-8, effort=5, velocity=1), "can't move"),
    "equal": (limits(lower=0, upper=0, effort=5, velocity=1), "can't move"),
    "not given": (limits(effort=5, velocity=1), "has no limits"),
    "no element": (limits(), "or make it continuous"),
    "no element of a slide": (limits("prismatic"), "is prismatic but has no limits"),
    "infinite": (limits(lower="-inf", upper="inf", effort=5, velocity=1), "lower='-inf'"),
    "infinite speed": (limits(lower=-1, upper=1, effort=5, velocity="Infinity"), "velocity='Infinity'"),
    "nan": (limits(lower=-1, upper="nan", effort=5, velocity=1), "upper='nan'"),
    "empty": (limits(lower=-1, upper=1, effort=5, velocity=""), "velocity=''"),
    "text": (limits(lower=-1, upper=1, effort="5 Nm", velocity=1), "effort='5 Nm'"),
    "negative": (limits(lower=-1, upper=1, effort=5, velocity=-1), "velocity limit -1 is negative"),
    "unexpanded": (limits(lower=-1, upper=1, effort=5, velocity="${v}"), "xacro"),
}


@pytest.mark.parametrize(("text", "said"), BAD_LIMITS.values(), ids=BAD_LIMITS)
def test_odd_limits_are_refused_with_joint_and_line(load, text, said):
    line = 1 + text[: text.index("<joint name='odd'")].count("\n")
    with pytest.raises(InputError) as caught:
        load(text)
    message = str(caught.value)
    assert said in message and f"line {line}" in message
    assert "'odd'" in message or "xacro" in message


def test_reading_a_file_writes_nothing_into_the_current_folder(load, tmp_path, monkeypatch):
    """MuJoCo logs its warnings there."""
    here = tmp_path / "here"
    here.mkdir()
    monkeypatch.chdir(here)
    with pytest.raises(InputError):
        load(limits(lower=0, upper=0, effort=5, velocity=1))
    assert not list(here.iterdir())


@pytest.mark.parametrize("values", [{"effort": 0, "velocity": 0}, {}])
def test_a_speed_or_torque_that_was_not_filled_in_is_assumed_and_named(load, values):
    arm = load(limits(lower=-1, upper=1, **values))
    assert arm.max_velocity[2] == DEFAULT_MAX_VELOCITY and arm.max_torque[2] == np.inf
    assert [note for note in arm.notes if "velocity" in note and "odd (line" in note]
    assert [note for note in arm.notes if "torque" in note and "odd (line" in note]


def test_limits_of_a_gripper_do_not_matter(load):
    arm = load(robot(SIX, hinge("jaw", "a_link6", "x", limit="<limit effort='0' velocity='0'/>")))
    assert arm.n_joints == 6


MJCF = """<mujoco><compiler angle="radian"/><default><geom type="capsule" size=".03"/></default><worldbody>
<body name="b1" pos="0 0 .2"><joint name="j1" axis="0 0 1" range="-2 2"/><geom fromto="0 0 0 0 0 .2"/>
<body name="b2" pos="0 0 .2"><joint name="j2" axis="0 1 0" range="0.4 2"/><geom fromto="0 0 0 0 0 .2"/>
<body name="b3" pos="0 0 .2"><joint name="j3" axis="0 1 0" range="-2 2"/><geom fromto="0 0 0 0 0 .2"/>
</body></body></body></worldbody>
{}
</mujoco>"""


@pytest.mark.parametrize(
    ("key", "joint"),
    [
        ('<key qpos="0 0 0"/>', "'j2' (line 3) is at 0 in"),
        ('<key name="a" qpos="0 1 0"/><key name="home" qpos="0 1 2.1"/>', "'j3' (line 4) is at 2.1 in"),
        ('<key name="home" qpos="-7 1 0"/>', "'j1' (line 2) is at -7 in"),
    ],
)
def test_a_keyframe_outside_the_limits_is_refused_with_joint_and_line(load, key, joint):
    with pytest.raises(FileFormatError) as caught:
        load(MJCF.format(f"<keyframe>{key}</keyframe>"), "arm.xml")
    assert joint in str(caught.value) and "(line 6)" in str(caught.value)


@pytest.mark.parametrize("inside", ['mass="nan"', 'mass="1" rgba="0 nan 0 1"', 'density="inf"', 'mass="-nan"'])
def test_numbers_that_are_not_finite_are_refused_with_their_line(load, inside):
    text = MJCF.format("").replace("<geom from", f"<geom {inside} from", 1)
    with pytest.raises(FileFormatError, match=r"line 2.*not finite"):
        load(text, "arm.xml")


def test_nan_in_an_included_file_is_refused(load, tmp_path):
    (tmp_path / "part.xml").write_text('<mujocoinclude><geom size=".1" mass="nan"/></mujocoinclude>')
    text = MJCF.format("").replace("<geom f", '<include file="part.xml"/><geom f', 1)
    with pytest.raises(FileFormatError):
        load(text, "arm.xml")
    with pytest.raises(FileFormatError, match="a part that other MJCF files include"):
        ArmModel.load(tmp_path / "part.xml")


MASSES = {
    "no inertial": ("", "no mass"),
    "no mass": (INERTIAL.replace("value='2'", "value='0'"), "no mass"),
    "a negative mass": (INERTIAL.replace("value='2'", "value='-2'"), "a negative mass"),
    "no inertia": (INERTIAL.replace(".02", "0").replace(".01", "0"), "no inertia"),
    "a negative inertia": (INERTIAL.replace("ixx='.02'", "ixx='-.02'"), "no rigid body"),
    "an impossible inertia": (INERTIAL.replace("ixx='.02'", "ixx='.9'"), "no rigid body"),
}


@pytest.mark.parametrize(("inertial", "said"), MASSES.values(), ids=MASSES)
def test_kinematics_needs_no_mass_but_torques_and_simulation_do(load, inertial, said):
    good = load(robot(SIX), "good.urdf")
    text = robot(SIX.replace(link("a_link2"), link("a_link2", inertial + SHAPE)))
    line = 1 + text[: text.index("<link name='a_link2'")].count("\n")
    arm = load(text)
    q = np.linspace(-1.0, 1.0, 6)
    assert np.array_equal(arm.forward_kinematics(q).matrix, good.forward_kinematics(q).matrix)
    assert np.allclose(arm.jacobian(q), good.jacobian(q), atol=1e-12)
    named = rf"link 'a_link2' \(line {line}\) has .*{said}"
    assert [note for note in arm.notes if "a_link2" in note]
    still = np.zeros(6)
    for refused in (
        lambda: arm.gravity_torque(q),
        lambda: arm.mass_matrix(q),
        lambda: arm.inverse_dynamics(q, still, still),
        lambda: SimulatedRobot(arm),
    ):
        with pytest.raises(InputError, match=named):
            refused()


def test_a_urdf_link_without_a_mass_adds_none(load):
    """A fixed link with a shape but no <inertial>, such as a camera, weighs nothing in a URDF."""
    camera = link("camera", SHAPE) + joint("m", "a_link6", "camera", kind="fixed", limit="")
    q = np.full(6, 0.4)
    assert np.allclose(load(robot(SIX, camera)).gravity_torque(q), load(robot(SIX), "b.urdf").gravity_torque(q))


def test_several_links_without_masses_are_all_named(load):
    arm = load(robot(SIX.replace(INERTIAL, "", 3)))
    with pytest.raises(InputError, match=r"a_link1.*a_link2.*a_link3"):
        arm.gravity_torque(arm.home)


# meshes


def stl(path):
    """Write a tetrahedron with edges of 0.1 m."""
    corners = 0.1 * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    faces = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]
    path.parent.mkdir(parents=True, exist_ok=True)
    body = b"".join(struct.pack("<12fH", 0, 0, 0, *corners[list(face)].ravel(), 0) for face in faces)
    path.write_bytes(bytes(80) + struct.pack("<I", len(faces)) + body)


def meshed(file, head=""):
    mesh = f"<collision><geometry><mesh filename='{file}'/></geometry></collision>"
    return robot(head, SIX.replace(SHAPE, mesh, 1))


def has_mesh(arm):
    model = arm.spec().compile()
    meshes = (model.geom_type == mujoco.mjtGeom.mjGEOM_MESH) & (model.geom_group == COLLISION_GROUP)
    return int(meshes.sum()) == 1


PLACES = {
    "beside the file": ("p.stl", "r/a.urdf", "r/p.stl", ""),
    "in a folder below": ("meshes/p.stl", "r/a.urdf", "r/meshes/p.stl", ""),
    "in a folder beside": ("../m/p.stl", "r/urdf/a.urdf", "r/m/p.stl", ""),
    "in meshdir": ("p.stl", "r/a.urdf", "r/meshes/p.stl", "meshes"),
    "meshdir written twice": ("meshes/p.stl", "r/a.urdf", "r/meshes/p.stl", "meshes"),
    "backslashes": ("meshes\\p.stl", "r/a.urdf", "r/meshes/p.stl", ""),
    "capitals": ("meshes/P.STL", "r/a.urdf", "r/meshes/P.STL", ""),
    "package around the file": ("package://my_arm/m/p.stl", "my_arm/urdf/a.urdf", "my_arm/m/p.stl", ""),
    "package beside": ("package://my_arm/m/p.stl", "bringup/urdf/a.urdf", "my_arm/m/p.stl", ""),
    "model URI": ("model://my_arm/m/p.stl", "bringup/urdf/a.urdf", "my_arm/m/p.stl", ""),
    "package with another folder": ("package://other/m/p.stl", "Clone/urdf/a.urdf", "Clone/m/p.stl", ""),
    "package beside with another folder": ("package://other/m/p.stl", "bringup/urdf/a.urdf", "Clone/m/p.stl", ""),
}


@pytest.mark.parametrize(("file", "place", "mesh", "meshdir"), PLACES.values(), ids=PLACES)
def test_meshes_are_found_near_the_file(load, tmp_path, file, place, mesh, meshdir):
    stl(tmp_path / mesh)
    if "Clone" in mesh:
        (tmp_path / "Clone" / "package.xml").write_text("<package><name>other</name></package>")
    head = f"<mujoco><compiler meshdir='{meshdir}' discardvisual='false'/></mujoco>" if meshdir else ""
    arm = load(meshed(file, head), place)
    assert has_mesh(arm)
    assert has_mesh(pickle.loads(pickle.dumps(arm)))


@pytest.mark.parametrize("where", ["ws", "ws/src", "ws/src/Clone"])
@pytest.mark.parametrize("way", ["package_path", "ROS_PACKAGE_PATH"])
def test_meshes_are_found_by_the_name_of_their_package(load, tmp_path, monkeypatch, where, way):
    stl(tmp_path / "ws/src/Clone/m/p.stl")
    (tmp_path / "ws/src/Clone/package.xml").write_text("<package><name>other</name></package>")
    text, place = meshed("package://other/m/p.stl"), "elsewhere/deep/down/here/now/a.urdf"
    monkeypatch.delenv("ROS_PACKAGE_PATH", raising=False)
    with pytest.raises(FileFormatError, match=r"p\.stl.*--package-path"):
        load(text, place)
    if way == "package_path":
        assert has_mesh(load(text, place, package_path=tmp_path / where))
        assert has_mesh(load(text, place, package_path=[tmp_path / "elsewhere", str(tmp_path / where)]))
    else:
        monkeypatch.setenv("ROS_PACKAGE_PATH", f"/nowhere:{tmp_path / where}")
        assert has_mesh(load(text, place))


def test_meshes_of_an_installed_ros_2_package_are_found(load, tmp_path, monkeypatch):
    stl(tmp_path / "install/share/other/m/p.stl")
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path / "install"))
    assert has_mesh(load(meshed("package://other/m/p.stl"), "elsewhere/a.urdf"))


UNREADABLE = {
    "p.dae": (b"<COLLADA/>", "COLLADA"),
    "p.glb": (b"glTF", "glTF"),
    "p.step": (b"ISO-10303-21;", "STEP"),
    "p.xyz": (b"1 2 3", "'.xyz'"),
    "p.stl": (b"solid p\n facet normal 0 0 1\n", "text form"),
    "q.stl": (b"version https://git-lfs.github.com/spec/v1\noid", "git lfs pull"),
}


@pytest.mark.parametrize(("name", "content"), UNREADABLE.items(), ids=UNREADABLE)
def test_a_mesh_that_cannot_be_read_is_named_with_its_format_and_line(load, tmp_path, name, content):
    (tmp_path / name).write_bytes(content[0])
    text = meshed(name)
    line = 1 + text[: text.index("<mesh")].count("\n")
    with pytest.raises(FileFormatError) as caught:
        load(text)
    assert content[1] in str(caught.value) and f"mesh '{name}' (line {line})" in str(caught.value)
    assert load(text, discard_meshes=True).n_joints == 6


def test_visual_meshes_of_any_format_do_not_matter(load):
    visual = "<visual><geometry><mesh filename='nowhere/p.dae'/></geometry></visual>"
    assert load(robot(SIX.replace(SHAPE, SHAPE + visual))).n_joints == 6


def test_a_package_path_that_is_no_folder_is_refused(load, tmp_path):
    with pytest.raises(InputError, match="is not a folder"):
        load(robot(SIX), package_path=tmp_path / "nothing")


# what is no URDF, and bases that move

XACRO = {
    "a macro file": ("<robot xmlns:xacro='x'><xacro:macro name='m'/></robot>", "arm.urdf.xacro"),
    "inside a .urdf": (robot("<xacro:property name='v' value='2'/>\n", SIX), "arm.urdf"),
    "only an expression": (robot(SIX.replace("1.8", "${v}", 1)), "arm.urdf"),
    "only a find": (meshed("$(find my_arm)/m/p.stl"), "arm.urdf"),
    "an include": ("<robot>\n<xacro:include filename='a.xacro'/></robot>", "arm.xacro"),
}


@pytest.mark.parametrize(("text", "name"), XACRO.values(), ids=XACRO)
def test_xacro_is_recognised_and_how_to_expand_it_is_said(load, text, name):
    with pytest.raises(FileFormatError, match=rf"is a xacro file.*line \d+.*'xacro {name} > arm_expanded\.urdf'"):
        load(text, name)


def test_a_trace_of_xacro_in_an_expanded_file_does_no_harm(load):
    assert load(robot(SIX).replace("<robot", "<robot xmlns:xacro='http://www.ros.org/wiki/xacro'")).n_joints == 6


@pytest.mark.parametrize("kind", ["floating", "planar"])
def test_a_base_that_moves_is_refused_with_its_line(load, kind):
    text = robot(link("cart"), joint("drive", "base", "cart", kind=kind, limit=""), limb("a_", 4, "cart"))
    with pytest.raises(InputError, match=rf"joint 'drive' \(line 4\) is {kind}: the base moves"):
        load(text)


@pytest.mark.parametrize(
    ("joint", "said"),
    [
        ("<freejoint/>", r"body 'b1' \(line 2\) floats on a free joint"),
        ('<joint type="free"/>', r"body 'b1' \(line 2\) floats"),
        ('<joint name="b" type="ball"/>', r"joint 'b' \(line 2\) is a ball joint"),
    ],
)
def test_mjcf_joints_that_no_arm_has_are_refused(load, joint, said):
    text = MJCF.format("").replace('<joint name="j1" axis="0 0 1" range="-2 2"/>', joint)
    with pytest.raises(InputError, match=said):
        load(text, "arm.xml")


def test_joints_without_names_get_names_that_are_free(load):
    text = MJCF.format("").replace('name="j1" ', "").replace('name="j3" ', "").replace("j2", "joint1")
    arm = load(text, "arm.xml")
    assert arm.joint_names == ("joint2", "joint1", "joint3")
    assert arm.jacobian(arm.home).shape == (6, 3)


@pytest.mark.parametrize("name", ["arm.mjcf", "arm"])
def test_the_ending_of_the_name_does_not_matter(load, name):
    assert load(MJCF.format(""), name).n_joints == 3
    assert load(robot(SIX), name).n_joints == 6


# home


def shapes_apart(arm, q):
    """Smallest distance [m] of two shapes with at least two joints between their links, by the exact geometries."""
    model = arm.spec().compile()
    data = mujoco.MjData(model)
    data.qpos[:] = arm.posture(model, q)
    mujoco.mj_kinematics(model, data)
    depth = [0] * model.nbody
    for body in range(1, model.nbody):
        depth[body] = depth[model.body_parentid[body]] + int(model.body_jntnum[body] > 0)
    geoms = [(g, depth[model.geom_bodyid[g]]) for g in np.flatnonzero(model.geom_group == COLLISION_GROUP)]
    pairs = [(a, b) for a, i in geoms for b, j in geoms if j - i >= 2]
    return min(mujoco.mj_geomDistance(model, data, a, b, 1.0, None) for a, b in pairs)


@pytest.mark.parametrize("n", [3, 4, 5, 6, 7])
@pytest.mark.parametrize("stretch", [0.5, 1.0, 3.0])
def test_home_is_within_limits_clear_of_itself_and_not_singular(load, n, stretch):
    text = (
        robot(limb("a_", n), link("tip", ""), joint("end", f"a_link{n}", "tip", kind="fixed", axis="0 0 1", limit=""))
        .replace("0 0 .22", f"0 0 {0.22 * stretch}")
        .replace("length='.12'", f"length='{0.12 * stretch}'")
    )
    text = text.replace("xyz='0 0 .1'", f"xyz='0 0 {0.1 * stretch}'")
    arm = load(text)
    arm.check_limits(arm.home)
    rows = 3 if n < 6 else 6  # an arm with fewer joints can't do without a direction of rotation
    straight = np.linalg.svd(arm.jacobian(np.zeros(n))[:rows], compute_uv=False)
    home = np.linalg.svd(arm.jacobian(arm.home)[:rows], compute_uv=False)
    assert straight[-1] < 1e-9
    assert home[-1] > 0.05 * min(1.0, stretch * n * 0.22 / 0.8)
    assert shapes_apart(arm, arm.home) >= 0.02
    assert np.array_equal(arm.home, load(text).home)


@pytest.mark.parametrize(("low", "high"), [(6.0, 6.2), (-9.0, -4.0), (3.3, 9.0), (-0.2, 6.0)])
def test_home_is_within_limits_that_are_far_from_zero(load, low, high):
    text = robot(SIX)
    head, separator, tail = text.partition("<joint name='a_axis2'")
    arm = load(head + separator + tail.replace("lower='-2.5' upper='2.5'", f"lower='{low}' upper='{high}'", 1))
    arm.check_limits(arm.home)
    assert low <= arm.home[1] <= high


@pytest.mark.parametrize("axis", ["0 0 0", "0 1e-12 0"])
def test_an_axis_without_a_direction_is_refused_with_its_line(load, axis):
    text = robot(limb("a_", 2)).replace("<axis xyz='0 1 0'/>", f"<axis xyz='{axis}'/>")
    with pytest.raises(FileFormatError, match=r"joint 'a_axis2', line \d+: xyz='.*' of <axis> has no direction"):
        load(text)


def test_the_middle_of_the_ranges_is_kept_where_it_is_usable(load):
    text = robot(limb("a_", 3))
    for i, (low, high) in enumerate([(-2, 1), (0.5, 1.5), (0.6, 2.0)]):
        head, separator, tail = text.partition(f"<joint name='a_axis{i + 1}'")
        text = head + separator + tail.replace("lower='-2.5' upper='2.5'", f"lower='{low}' upper='{high}'", 1)
    assert np.allclose(load(text).home, [-0.5, 1.0, 1.3])


# sizes, and files that are damaged anywhere


@pytest.mark.parametrize(
    ("old", "new"),
    [("value='2'", "value='1e300'"), ("radius='.03'", "radius='1e9'"), ("xyz='0 0 .22'", "xyz='0 0 3e7'")],
)
def test_sizes_that_no_robot_has_are_refused_with_their_line(load, old, new):
    text = robot(SIX).replace(old, new, 1)
    with pytest.raises(FileFormatError, match=r"'a_link1' \(line 3\) is .*not plausible for a robot"):
        load(text)


def test_a_wire_is_covered_by_few_spheres(load):
    arm = load(robot(SIX.replace("radius='.03' length='.12'", "radius='1e-6' length='1.2'", 1)))
    centers, radii = arm.collision_spheres(np.zeros(6))
    wire = np.array(arm.sphere_bodies) == "a_link1"
    assert wire.sum() <= 50
    along = np.linspace([0, 0, -0.28], [0, 0, 0.92], 200)  # the wire's middle is 0.1 m above the link's frame at 0.22 m
    gaps = np.linalg.norm(along[:, None] - centers[wire], axis=2) - radii[wire]
    assert gaps.min(axis=1).max() <= 0.0


VALUES = ("", "nan", "inf", "-1", "0", "1e308", "1e-308", "abc", "0 0 0", "base", "world", "1e400", "1,0,0", "1e9")


def damaged(text, random):
    """Change, remove or double something in a file."""
    attributes = list(re.finditer(r"(\w+)=(['\"])(.*?)\2", text))
    chosen, kind = attributes[random.integers(len(attributes))], random.random()
    if kind < 0.6:
        return text[: chosen.start(3)] + str(random.choice(VALUES)) + text[chosen.end(3) :]
    if kind < 0.8:
        return text[: chosen.start()] + text[chosen.end() :]
    lines = text.split("\n")
    lines.insert(random.integers(len(lines)), lines[random.integers(len(lines))])
    return "\n".join(lines)


@pytest.mark.parametrize(
    "text", [robot(limb("a_", 4), GRIPPERS["one jaw named so"].replace("a_link6", "a_link4")), MJCF]
)
def test_a_damaged_file_is_refused_or_its_arm_has_finite_figures(load, text):
    random = np.random.default_rng(0)
    outcomes = {"refused": 0, "loaded": 0}
    for _ in range(150):
        try:
            arm = load(damaged(text.replace("{}", ""), random), "arm.xml")
        except InputError as error:
            assert "arm.xml" in str(error)
            outcomes["refused"] += 1
            continue
        outcomes["loaded"] += 1
        arm.check_limits(arm.home)
        assert np.isfinite(arm.forward_kinematics(arm.home).matrix).all()
        assert np.isfinite(arm.jacobian(arm.home)).all()
        assert np.isfinite(arm.max_velocity).all() and (arm.max_velocity > 0.0).all() and (arm.max_torque > 0.0).all()
    assert min(outcomes.values()) > 10


def test_a_motion_without_masses_is_measured_without_torques(load):
    times, joints = np.linspace(0.0, 1.0, 11), np.linspace(np.full(6, 0.2), np.full(6, 0.4), 11)
    with_masses = ArmMotion.of(load(robot(SIX)), times, joints)
    without = ArmMotion.of(load(robot(SIX.replace(INERTIAL, "", 1)), "b.urdf"), times, joints)
    assert np.array_equal(without.tool, with_masses.tool)
    assert np.isnan(without.torques).all() and np.isnan(without.gravity).all()
    assert np.isfinite(with_masses.torques).all()


def test_home_is_bent_even_if_the_last_joint_does_not_move_the_flange(load):
    arm = load(robot(limb("a_", 3)))
    assert np.linalg.svd(arm.jacobian(arm.home)[:3], compute_uv=False)[1] > 0.03


def six_hinges(limit=LIMIT, xyz="0 0 .22"):
    return robot(limb("", 6)).replace(LIMIT, limit).replace("xyz='0 0 .22'", f"xyz='{xyz}'")


def mjcf_chain(attributes="", compiler="<compiler angle='radian'/>", after=""):
    bodies = "".join(
        f"<body name='b{i}' pos='0 0 .2'>\n<joint name='j{i}' axis='{axis}' {attributes}/><geom size='.03' mass='1'/>\n"
        for i, axis in enumerate(AXES[:4])
    )
    return f"<mujoco>{compiler}<worldbody>{bodies}{'</body>' * 4}</worldbody>{after}</mujoco>"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (six_hinges(LIMIT.replace("2.5", "165")), ("axis1", "line", "degrees", "radians", "continuous")),
        (six_hinges(xyz="0 0 220"), ("metres", "millimetres")),
        (robot(limb("", 3)).replace("name='axis3'", "name='axis2'"), ("both define joint 'axis2'", "lines")),
        (robot(limb("", 3)).replace("name='link3'", "name='link2'", 1), ("both define link 'link2'", "lines")),
        (
            robot(limb("", 3), link("e"), joint("g", "link3", "e", extra="<mimic joint='axes1'/>")),
            ("'g'", "'axes1'", "not in the file"),
        ),
    ],
)
def test_a_urdf_whose_entries_can_not_be_meant_is_refused(tmp_path, text, words):
    path = tmp_path / "r.urdf"
    path.write_text(text)
    with pytest.raises(FileFormatError) as caught:
        ArmModel.load(path)
    assert all(word in str(caught.value) for word in (str(path), *words)), caught.value


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (mjcf_chain("range='2 -2'"), ("line 2", "'2 -2'", "exchange")),
        (mjcf_chain("range='-2 2' actuatorfrcrange='9 -9'"), ("actuatorfrcrange", "exchange")),
        (mjcf_chain("range='-150 150'"), ("j0", "rotations", "degree")),
        (mjcf_chain("range='-2.6 2.6'", compiler=""), ("j0", "5.2 degrees", "radian")),
        (mjcf_chain(after="<keyframe><key name='home' qpos='0 .4'/></keyframe>"), ("home", "2 positions", "has 4")),
    ],
)
def test_an_mjcf_whose_entries_can_not_be_meant_is_refused(tmp_path, text, words):
    path = tmp_path / "r.xml"
    path.write_text(text)
    with pytest.raises(FileFormatError) as caught:
        ArmModel.load(path)
    assert all(word in str(caught.value) for word in (str(path), *words)), caught.value


def test_limits_of_several_rotations_and_placeholders_for_none_are_accepted(tmp_path):
    for name, limit in (("cable", "6.5"), ("many", "12.6"), ("placeholder", "1e16")):
        path = tmp_path / f"{name}.urdf"
        path.write_text(six_hinges(LIMIT.replace("2.5", limit)))
        assert ArmModel.load(path).n_joints == 6


def test_a_velocity_limit_in_degrees_is_noted(tmp_path):
    path = tmp_path / "r.urdf"
    path.write_text(six_hinges(LIMIT.replace("1.8", "180")))
    assert any("degrees" in note for note in ArmModel.load(path).notes)
