"""Scene files: what is written is read back, and what is wrong is said."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from imitarm.errors import FileFormatError, ImitarmError, InputError
from imitarm.kinematics.pose import Pose, quaternion_exp, rotate
from imitarm.scene import (
    OBSTACLES,
    Box,
    ConvexHull,
    HalfSpace,
    MovingScene,
    Obstacle,
    Scene,
    Sphere,
    Track,
    load_moving_scene,
    load_scene,
    save_scene,
)
from scene_shapes import KINDS, random_obstacle, random_pose

PAGE = Path(__file__).parents[1] / "docs" / "scene.md"
HEAD = "format: imitarm-scene\nversion: 1\n"


def page_example():
    return re.search(r"```yaml\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL).group(1)


def read(tmp_path, text):
    path = tmp_path / "scene.yaml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return load_scene(path)


def message_of(tmp_path, text):
    with pytest.raises(FileFormatError) as caught:
        read(tmp_path, text)
    message = str(caught.value)
    assert message.startswith(f"{tmp_path / 'scene.yaml'}: ")
    return message


@pytest.mark.parametrize("kind", KINDS)
@settings(deadline=None, max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**32 - 1), name=st.text(max_size=12).filter(str.isprintable), moves=st.booleans())
def test_every_shape_is_read_back_as_written(kind, seed, name, moves, tmp_path):
    rng = np.random.default_rng(seed)
    velocity = rng.normal(size=3) if moves else np.zeros(3)
    obstacle = random_obstacle(kind, rng, name=name, velocity=velocity)
    goal = random_pose(rng)
    save_scene(Scene(goal, (obstacle,)), tmp_path / "scene.yaml")
    back = load_scene(tmp_path / "scene.yaml")
    assert type(back.obstacles[0]) is type(obstacle)
    assert back.obstacles[0].name == name
    np.testing.assert_array_equal(back.obstacles[0].velocity, velocity)
    np.testing.assert_array_equal(back.goal.position, goal.position)
    np.testing.assert_allclose(back.goal.quaternion, goal.quaternion, atol=1e-15)
    points = rng.normal(size=(50, 3))
    np.testing.assert_allclose(back.clearance(points), obstacle.signed_distance(points), atol=1e-14)


def test_saving_what_was_read_gives_the_same_file(tmp_path):
    rng = np.random.default_rng(0)
    scene = Scene(None, [random_obstacle(kind, rng) for kind in KINDS])
    save_scene(scene, tmp_path / "a.yaml")
    save_scene(load_scene(tmp_path / "a.yaml"), str(tmp_path / "b.yaml"))
    first, second = (load_scene(tmp_path / name) for name in ("a.yaml", "b.yaml"))
    points = rng.normal(size=(50, 3))
    np.testing.assert_allclose(first.distances(points), second.distances(points), atol=1e-15)
    assert first.goal is None
    save_scene(Scene(), tmp_path / "empty.yaml")
    assert load_scene(tmp_path / "empty.yaml").obstacles == ()


def test_the_example_of_the_page(tmp_path):
    scene = read(tmp_path, page_example())
    assert sorted(obstacle.kind for obstacle in scene.obstacles) == sorted(KINDS)
    np.testing.assert_allclose(scene.goal.position, [0.6, 0.1, 0.25])
    np.testing.assert_allclose(rotate(scene.goal.quaternion, [0, 0, 1]), [0, 0, -1], atol=1e-12)  # tool down
    box, ball, capsule, cylinder, cone, _, wedge = scene.obstacles
    np.testing.assert_allclose(box.size, [0.08, 0.08, 0.2])
    np.testing.assert_allclose(box.pose.quaternion, quaternion_exp([0, 0, np.pi / 6]))
    assert scene.name_of(0) == 'box "tin"'
    assert scene.name_of(2) == "capsule 1"
    np.testing.assert_allclose(ball.velocity, [0, -0.1, 0])
    for standing in (box, cylinder, cone, wedge):
        assert standing.bounds()[0, 2] == pytest.approx(0.0, abs=1e-12)
    np.testing.assert_allclose(capsule.bounds()[1], [0.33, -0.17, 0.43])
    scene.check()


def test_the_error_of_the_page_is_the_one_that_is_raised(tmp_path):
    message = message_of(tmp_path, page_example().replace("size:", "sise:", 1))
    shown = re.search(r"```text\n(.*?)\n```", PAGE.read_text(encoding="utf-8"), re.DOTALL).group(1)
    assert message.removeprefix(f"{tmp_path}/").replace("scene.yaml", "table.yaml") == shown


@pytest.mark.parametrize(("units", "metres"), [("m", 1.0), ("cm", 0.01), ("mm", 0.001)])
def test_units(tmp_path, units, metres):
    scene = read(
        tmp_path,
        HEAD + f"units: {units}\n"
        "goal: {position: [100, 20, 30], quaternion: [1, 0, 0, 0]}\n"
        "obstacles:\n- {type: sphere, center: [4, 5, 6], radius: 7e-1, velocity: [1, 0, 0]}\n"
        "- {type: convex_hull, points: [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]}\n",
    )
    np.testing.assert_allclose(scene.goal.position, np.array([100, 20, 30]) * metres)
    np.testing.assert_allclose(scene.obstacles[0].center, np.array([4, 5, 6]) * metres)
    assert scene.obstacles[0].radius == pytest.approx(0.7 * metres)
    np.testing.assert_allclose(scene.obstacles[0].velocity, [metres, 0, 0])
    np.testing.assert_allclose(scene.obstacles[1].bounds()[1], np.full(3, metres))


def test_rotations_are_about_fixed_axes_in_order(tmp_path):
    entry = "- {type: box, position: [0, 0, 0], size: [1, 1, 1], "
    scene = read(
        tmp_path,
        HEAD + f"obstacles:\n{entry}rpy_degrees: [90, 0, 90]}}\n{entry}yaw_degrees: -90}}\n"
        f"{entry}quaternion: [0.7071, 0, 0.7071, 0]}}\n{entry[:-2]}}}\n{entry}rpy_degrees: [90, 90, 0]}}\n",
    )
    turned, yawed, given_, straight, pitched = (obstacle.pose.rotation for obstacle in scene.obstacles)
    np.testing.assert_allclose(turned @ [0, 1, 0], [0, 0, 1], atol=1e-12)  # y rolls up to z, and yaw leaves it there
    np.testing.assert_allclose(turned @ [1, 0, 0], [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(yawed @ [1, 0, 0], [0, -1, 0], atol=1e-12)
    np.testing.assert_allclose(given_ @ [0, 0, 1], [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(straight, np.eye(3))
    np.testing.assert_allclose(pitched @ [0, 1, 0], [1, 0, 0], atol=1e-12)  # rolls up to z, and pitch takes z to x


@pytest.mark.parametrize(
    "name", ["0E0", "1e-3", "12", "yes", "null", "~", "- a", "a: b", "#1", "2024-01-01", "{", "\u00e4\U0001f4e6", " "]
)
def test_names_that_look_like_something_else(tmp_path, name):
    save_scene(Scene(None, [Sphere([0, 0, 0], 0.1, name=name)]), tmp_path / "scene.yaml")
    assert load_scene(tmp_path / "scene.yaml").obstacles[0].name == name


def test_numbers_as_people_write_them(tmp_path):
    scene = read(tmp_path, "\ufeff" + HEAD + "obstacles:\n- {type: sphere, center: [1e-1, +2E-1, .3], radius: 5.e-2}\n")
    np.testing.assert_allclose(scene.obstacles[0].center, [0.1, 0.2, 0.3])
    assert scene.obstacles[0].radius == 0.05


ODD = [
    "0500",
    "040",
    "-07",
    "00",
    "010.5",
    "1:30",
    "1:30:00",
    "190:20.5",
    "0x1F",
    "0o17",
    "0b11",
    "1_000",
    "1.2.3",
    "2e",
]


@pytest.mark.parametrize("number", ODD)
@pytest.mark.parametrize(
    "entry",
    [
        "type: sphere, center: [0.5, 0, 0], radius: {}",
        "type: sphere, center: [{}, 0, 0], radius: 0.1",
        "type: box, position: [0, {}, 0], size: [1, 1, 1]",
        "type: box, position: [0, 0, 0], size: [1, 1, {}]",
        "type: box, position: [0, 0, 0], size: [1, 1, 1], yaw_degrees: {}",
    ],
)
def test_numbers_that_can_be_read_in_two_ways_are_refused(tmp_path, number, entry):
    message = message_of(tmp_path, HEAD + f"obstacles:\n- {{{entry.format(number)}}}\n")
    assert f"'{number}' can be read as several numbers; write a plain decimal number" in message


@pytest.mark.parametrize("number", ["0500", "1:30", "0x1F", "1_000"])
def test_an_explicit_tag_does_not_let_them_in(tmp_path, number):
    for tag in ("!!int", "!!float"):
        text = HEAD + f"obstacles:\n- {{type: sphere, center: [0.5, 0, 0], radius: {tag} {number}}}\n"
        assert f"'{number}' is not a plain decimal number" in message_of(tmp_path, text)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("500", 500.0),
        ("0", 0.0),
        ("-0.5", -0.5),
        ("+.5", 0.5),
        ("5.", 5.0),
        ("1e-1", 0.1),
        ("1E+1", 10.0),
        ("!!int 7", 7),
    ],
)
def test_plain_decimal_numbers_are_read(tmp_path, text, value):
    scene = read(tmp_path, HEAD + f"units: cm\nobstacles:\n- {{type: sphere, center: [{text}, 90, 0], radius: 5}}\n")
    assert scene.obstacles[0].center[0] == pytest.approx(0.01 * value)


@pytest.mark.parametrize("name", ["0500", "1:30", "0x1F", "007", "+.5", "5.", "1_000"])
def test_a_name_may_look_like_such_a_number(tmp_path, name):
    save_scene(Scene(None, [Sphere([0, 0, 0], 0.1, name=name)]), tmp_path / "scene.yaml")
    assert load_scene(tmp_path / "scene.yaml").obstacles[0].name == name


@pytest.mark.parametrize(
    "entry",
    [
        "type: box, position: [0.57, 0, 0.33], size: [0.1, 0.1, 0.1]",
        "type: box, position: [570, 0, 330], size: [100, 100, 0.9]",
        "type: sphere, center: [570, 0, 330], radius: 0.08",
        "type: capsule, start: [500, 0, 0], end: [500, 0, 400], radius: 0.05",
        "type: cylinder, position: [500, 0, 0], radius: 40, length: 0.3",
        "type: cone, position: [500, 0, 0], radius: 0.1, height: 100",
        "type: ellipsoid, position: [500, 0, 0], semi_axes: [30, 20, 0.1]",
        "type: convex_hull, points: [[500, 0, 0], [500.1, 0, 0], [500, 0.1, 0], [500, 0, 0.1]]",
    ],
)
def test_obstacles_below_a_millimetre_are_in_another_unit(tmp_path, entry):
    message = message_of(tmp_path, HEAD + f"units: mm\nobstacles:\n- {{{entry}}}\n")
    assert "mm thick, less than 1 mm; check units" in message
    thin = HEAD + "units: mm\nobstacles:\n- {type: box, position: [570, 0, 330], size: [100, 100, 1]}\n"
    assert len(read(tmp_path, thin).obstacles) == 1


@pytest.mark.parametrize(
    "text",
    [
        "units: cm\nobstacles:\n- {type: box, position: [0.57, 0, 0.33], size: [0.1, 0.1, 0.1]}\n",
        "units: cm\nobstacles:\n- {type: sphere, center: [1.2, 0.3, 0.2], radius: 0.2}\n",
        "units: mm\ngoal: {position: [0.5, 0.1, 0.3], yaw_degrees: 0}\n",
    ],
)
def test_a_scene_within_the_base_is_in_another_unit(tmp_path, text):
    message = message_of(tmp_path, HEAD + text)
    assert "mm of the robot's base; check units: are the numbers in metres?" in message


BOX = "type: box, name: tin, position: [0, 0, 0], size: [1, 1, 1]"
SPHERE = "type: sphere, center: [0, 0, 0], radius: 0.1"
KNOWN_TYPES = "known types: sphere, box, capsule, cylinder, cone, ellipsoid, convex_hull"


def one(entry):
    return f"{HEAD}obstacles:\n- {{{SPHERE}}}\n- {{{entry}}}\n"


BAD = {
    "empty": ("", 'the file is empty; a scene file begins with "format: imitarm-scene"'),
    "only comments": ("# nothing\n", "the file is empty"),
    "a list at the top": ("- 1\n- 2\n", "not a scene file: the top must be keys and values"),
    "text": ("hello", "not a scene file: the top must be keys and values"),
    "another file": ("name: x\n", '"format: imitarm-scene" is missing (format is None)'),
    "another format": ("format: urdf\n", "(format is 'urdf')"),
    "not UTF-8": (b"format: imitarm-scene\nname: \xff\xfe", "not a text file in UTF-8 (byte 28)"),
    "binary": (b"\x00\x01\x02", "not readable as YAML"),
    "broken YAML": (HEAD + "obstacles: [1, 2\n", "line 4, column 1: not readable as YAML"),
    "cut off": (page_example()[:-30] + "\n      - [", "not readable as YAML"),
    "tabs": (HEAD + "obstacles:\n\t- a\n", "line 4, column 1: not readable as YAML"),
    "code": (HEAD + "goal: !!python/object/apply:os.getcwd []\n", "not readable as YAML: could not determine a constr"),
    "a month that isn't": (HEAD + "goal: 2024-13-01\n", "not readable as YAML: month"),
    "a tag that does not fit": (HEAD + "goal: !!int x\n", "not readable as YAML"),
    "nested without end": (HEAD + "goal: " + "[" * 500 + "]" * 500, "not readable as YAML"),
    "key twice": (HEAD + "obstacles:\n- type: box\n  size: [1, 1, 1]\n  size: [2, 2, 2]\n", "line 6, column 3"),
    "key twice, named": (HEAD + "version: 1\n", 'key "version" is given twice; remove one'),
    "no version": ("format: imitarm-scene\n", "version is None, but this imitarm reads version 1"),
    "future version": ("format: imitarm-scene\nversion: 2\n", "version is 2, but this imitarm reads version 1; update"),
    "version as yes": ("format: imitarm-scene\nversion: yes\n", "version is True"),
    "unknown top key": (HEAD + "obstacle: []\n", 'the top level: unknown key "obstacle" (did you mean "obstacles"?)'),
    "top keys listed": (HEAD + "walls: []\n", '"walls"; known keys: format, version, units, stamp, goal, obstacles'),
    "key that is no text": (HEAD + "1: 2\n", 'unknown key "1"'),
    "unknown unit": (HEAD + "units: inch\n", "units: unknown unit 'inch'; known: m, cm, mm"),
    "unit near miss": (HEAD + "units: CM\n", '(did you mean "cm"?)'),
    "unit a number": (HEAD + "units: 1\n", "units: unknown unit 1"),
    "obstacles a mapping": (HEAD + "obstacles: {type: box}\n", "obstacles: must be a list; begin each entry with"),
    "entry a number": (
        HEAD + "obstacles: [3]\n",
        "obstacles[0]: must have the key type and the shape's own keys, got 3",
    ),
    "entry empty": (
        HEAD + "obstacles:\n-\n",
        "obstacles[0]: must have the key type and the shape's own keys, got None",
    ),
    "goal a list": (HEAD + "goal: [1, 2, 3]\n", "goal: must have the keys position and quaternion, got [1, 2, 3]"),
    "goal without position": (HEAD + "goal: {quaternion: [1, 0, 0, 0]}\n", 'goal: key "position" is missing'),
    "goal without rotation": (
        HEAD + "goal: {position: [0, 0, 0]}\n",
        "goal: the rotation of the tool is missing; give",
    ),
    "goal unknown key": (
        HEAD + "goal: {position: [0, 0, 0], quat: [1, 0, 0, 0]}\n",
        '"quat" (did you mean "quaternion',
    ),
    "goal not unit": (
        HEAD + "goal: {position: [0, 0, 0], quaternion: [1, 1, 0, 0]}\n",
        "goal: Pose: quaternion [1.0, 1.0, 0.0, 0.0] has length",
    ),
    "goal in words": (
        HEAD + "goal: {position: here, yaw_degrees: 0}\n",
        "goal: position must be a number or a list of n",
    ),
    "no type": (one("size: [1, 1, 1]"), f'obstacles[1]: key "type" is missing; {KNOWN_TYPES}'),
    "unknown type": (one("type: pyramid"), f"obstacles[1]: unknown type 'pyramid'; {KNOWN_TYPES}"),
    "type near miss": (one("type: Boxx"), "unknown type 'Boxx' (did you mean \"box\"?)"),
    "type a number": (one("type: 4"), "unknown type 4"),
    "name a number": (one("type: sphere, name: 12"), 'obstacles[1] (sphere "12"): name must be text; put it in quotes'),
    "name a list": (one(BOX.replace("tin", "[a]")), "name must be text"),
    "unknown key": (
        one(BOX + ", colour: red"),
        'obstacles[1] (box "tin"): unknown key "colour"; known keys: type, name',
    ),
    "key of another shape": (one(SPHERE + ", position: [0, 0, 0]"), 'obstacles[1] (sphere): unknown key "position"'),
    "key missing": (one("type: sphere, radius: 1"), 'obstacles[1] (sphere): key "center" is missing'),
    "key empty": (one("type: sphere, center: , radius: 1"), 'key "center" is missing'),
    "not a number": (
        one("type: sphere, center: [0, 0, x], radius: 1"),
        "obstacles[1] (sphere): center[2] must be a numb",
    ),
    "a truth value": (
        one("type: sphere, center: [0, 0, yes], radius: 1"),
        "center[2] must be a number or a list of num",
    ),
    "too deep a list": (
        one("type: sphere, center: [[[0]]], radius: 1"),
        "center[0][0] must be a number or a list of numb",
    ),
    "nan": (
        one("type: sphere, center: [0, 0, .nan], radius: 1"),
        "obstacles[1] (sphere): center must be finite [m], but center[2] is nan",
    ),
    "infinite": (
        one("type: sphere, center: [0, 0, 0], radius: .inf"),
        "radius must be a finite number above 0 [m], got inf",
    ),
    "a very long number": (
        one(f"type: sphere, center: [0, 0, 0], radius: 1{'0' * 400}"),
        "radius is too large for a nu",
    ),
    "negative": (
        one("type: sphere, center: [0, 0, 0], radius: -1"),
        "(sphere): radius must be a finite number above 0",
    ),
    "two numbers": (
        one("type: sphere, center: [0, 0], radius: 1"),
        "center must be 3 numbers [m], got shape (2,)",
    ),
    "wrong unit": (
        one("type: box, position: [0, 0, 0], size: [80, 80, 200]"),
        "(box): size [80.0, 80.0, 200.0] is beyond",
    ),
    "far away": (
        one("type: box, position: [450, 0, 0], size: [1, 1, 1]"),
        "(box): position [450.0, 0.0, 0.0] is beyond",
    ),
    "velocity": (one(SPHERE + ", velocity: 3"), "obstacles[1] (sphere): velocity must be 3 numbers [m/s]"),
    "two rotations": (
        one(BOX + ", yaw_degrees: 3, quaternion: [1, 0, 0, 0]"),
        "quaternion and yaw_degrees both give the",
    ),
    "rpy of two": (
        one(BOX + ", rpy_degrees: [1, 2]"),
        'obstacles[1] (box "tin"): rpy_degrees must be 3 finite numbers',
    ),
    "rpy of lists": (one(BOX + ", rpy_degrees: [[1], [2, 3], 4]"), "rpy_degrees must be 3 finite numbers"),
    "yaw a list": (one(BOX + ", yaw_degrees: [1]"), "yaw_degrees must be one finite number, got [1.0]"),
    "yaw of three": (one(BOX + ", yaw_degrees: [1, 2, 3]"), "yaw_degrees must be one finite number"),
    "yaw nan": (one(BOX + ", yaw_degrees: .nan"), "yaw_degrees must be one finite number"),
    "quaternion of three": (one(BOX + ", quaternion: [1, 0, 0]"), '(box "tin"): Pose: quaternion must be 4 numbers'),
    "quaternion ragged": (one(BOX + ", quaternion: [1, [0, 2], 0, 0]"), 'obstacles[1] (box "tin"): '),
    "position ragged": (one("type: box, position: [1, [0, 2], 0], size: [1, 1, 1]"), "obstacles[1] (box): "),
    "flat hull": (
        one("type: convex_hull, points: [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]"),
        "points lie in one pl",
    ),
    "ragged hull": (
        one("type: convex_hull, points: [[0, 0, 0], [1, 0]]"),
        "points must be numbers [m], got",
    ),
}


@pytest.mark.parametrize(("text", "expected"), BAD.values(), ids=BAD.keys())
def test_what_is_wrong_is_said(tmp_path, text, expected):
    message = message_of(tmp_path, text)
    assert expected in message
    assert len(message) < 600


def test_a_name_may_hold_what_messages_are_split_at(tmp_path):
    message = message_of(tmp_path, one('type: sphere, name: "a: b", center: [0, 0, 0], radius: 0'))
    assert message.endswith('obstacles[1] (sphere "a: b"): radius must be a finite number above 0 [m], got 0.0')


def test_a_file_that_repeats_itself_is_refused_at_once(tmp_path):
    bomb = "a0: &a0 [1, 1]\n" + "".join(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 40))
    assert 'unknown key "a0"' in message_of(tmp_path, HEAD + bomb)
    inside = "goal: &a0 [1, 1]\nobstacles:\n" + "".join(
        f"- &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 40)
    )
    assert "goal: must have" in message_of(tmp_path, HEAD + inside)
    itself = "obstacles:\n- {type: sphere, radius: 1, center: &c [*c, *c]}\n"
    assert "must be a number" in message_of(tmp_path, HEAD + itself)


@settings(deadline=None, max_examples=200, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(text=st.binary(max_size=60), where=st.integers(0, 1500), cut=st.integers(0, 40))
def test_no_damage_gives_anything_but_a_scene_or_a_clear_error(text, where, cut, tmp_path):
    whole = page_example().encode()
    try:
        read(tmp_path, whole[:where] + text + whole[where + cut :])
    except ImitarmError as error:
        assert "scene.yaml" in str(error)


def test_files_that_are_not_there(tmp_path):
    with pytest.raises(InputError, match=r"scene file .*none\.yaml can't be read: No such file"):
        load_scene(tmp_path / "none.yaml")
    with pytest.raises(InputError, match="can't be read: Is a directory"):
        load_scene(tmp_path)
    with pytest.raises(InputError, match="can't be written: No such file or directory"):
        save_scene(Scene(), tmp_path / "no" / "scene.yaml")


def test_a_failed_save_keeps_the_file_that_was_there(tmp_path, monkeypatch):
    path = tmp_path / "scene.yaml"
    save_scene(Scene(None, [Sphere([0, 0, 0], 0.1)]), path)
    before = path.read_bytes()

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "replace", full)
    with pytest.raises(InputError, match="can't be written: No space left on device"):
        save_scene(Scene(), path)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["scene.yaml"]
    (tmp_path / "folder").mkdir()
    monkeypatch.undo()
    with pytest.raises(InputError, match="can't be written"):
        save_scene(Scene(), tmp_path / "folder")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["folder", "scene.yaml"]


def test_a_shape_that_is_in_no_registry_is_not_written(tmp_path):
    class Plate(Box):
        pass

    with pytest.raises(InputError, match="a scene file can't hold a Plate; known types: sphere, box"):
        save_scene(Scene(None, [Plate(Pose.identity(), [1, 1, 0.01])]), tmp_path / "scene.yaml")
    assert list(tmp_path.iterdir()) == []


def test_a_shape_that_is_added_to_the_registry_is_read_and_written(tmp_path, monkeypatch):
    class Ball(Sphere):
        kind = "ball"

    monkeypatch.setitem(OBSTACLES, "ball", Ball)
    save_scene(Scene(None, [Ball([0, 0, 1], 0.2)]), tmp_path / "scene.yaml")
    back: Obstacle = load_scene(tmp_path / "scene.yaml").obstacles[0]
    assert type(back) is Ball
    assert back.radius == 0.2


def test_hull_keeps_all_its_points(tmp_path):
    points = np.vstack([np.eye(3), np.zeros(3), [0.1, 0.1, 0.1]])
    save_scene(Scene(None, [ConvexHull(points)]), tmp_path / "scene.yaml")
    np.testing.assert_array_equal(load_scene(tmp_path / "scene.yaml").obstacles[0].points, points)


def test_stamp_fixtures_and_half_spaces_are_read_back(tmp_path):
    floor, pedestal = HalfSpace([0, 0, -0.75], name="floor"), Box(Pose.identity(), [0.2, 0.2, 0.7])
    wall = HalfSpace([1, 0, 0], [-1, 0.5, 0], angular_velocity=[0, 0, 0.1])
    save_scene(Scene(None, [wall], stamp=12.5, fixtures=[floor, pedestal]), tmp_path / "scene.yaml")
    back = load_scene(tmp_path / "scene.yaml")
    assert back.stamp == 12.5
    assert [fixture.name for fixture in back.fixtures] == ["floor", ""]
    np.testing.assert_array_equal(back.obstacles[0].angular_velocity, [0, 0, 0.1])
    points = np.random.default_rng(0).normal(size=(20, 3))
    np.testing.assert_allclose(back.distances(points)[0], wall.signed_distance(points), atol=1e-12)


def test_a_half_space_in_other_units(tmp_path):
    text = HEAD + "units: mm\nobstacles:\n- {type: half_space, point: [0, 0, -50], normal: [0, 0, 1]}\n"
    floor = read(tmp_path, text + "fixtures:\n- {type: sphere, center: [0, 0, 100], radius: 20}\n").obstacles[0]
    np.testing.assert_allclose(floor.signed_distance([0, 0, 1.0]), 1.05)


def test_wrong_stamps_and_fixtures_are_refused(tmp_path):
    for line, expected in (
        ("stamp: soon", "stamp must be"),
        ("stamp: .nan", "stamp must be a finite number"),
        ("stamp: [1, 2]", "stamp must be"),
        ("fixtures: floor", "fixtures: must be a list"),
        ("fixtures:\n- {type: sphere, radius: 1}", 'fixtures[0] (sphere): key "center" is missing'),
    ):
        assert expected in message_of(tmp_path, HEAD + line + "\n")


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        ("{type: sphere, center: [40, -30, 25], radius: 5}", ("from the robot's base", "units")),
        ("{type: box, position: [0, 60, 10], yaw_degrees: 0, size: [8, 8, 8]}", ("from the robot's base", "units")),
        ("{type: sphere, center: [.4, 0, .3], radius: .05, velocity: [0, -50, 0]}", ("velocity of 50 m/s", "unit")),
        (
            "{type: box, position: [.5, 0, 0], size: [.1, .1, .1], angular_velocity: [0, 0, 45]}",
            ("angular_velocity of 45 rad/s", "unit"),
        ),
    ],
)
def test_numbers_in_another_unit_are_refused(tmp_path, entry, words):
    message = message_of(tmp_path, f"{HEAD}obstacles:\n  - {entry}\n")
    assert "obstacles[0]" in message
    assert all(word in message for word in words)


@pytest.mark.parametrize("key", ["obstacles", "fixtures"])
def test_two_entries_with_one_name_are_refused(tmp_path, key):
    entry = "  - {type: sphere, name: %s, center: [0.5, 0, %g], radius: 0.1}\n"
    head = f"format: imitarm-scene\nversion: 1\n{key}:\n"
    file = tmp_path / "scene.yaml"
    file.write_text(head + entry % ("ball", 0.1) + entry % ("crate", 0.2) + entry % ("ball", 0.3), encoding="utf-8")
    with pytest.raises(FileFormatError, match=rf'{key}\[0\] and {key}\[2\] are both named "ball"; give each'):
        load_scene(file)
    file.write_text(head + (entry % ('""', 0.1)) * 2, encoding="utf-8")
    assert len(getattr(load_scene(file), key)) == 2


def test_a_scene_that_could_not_be_read_back_is_not_written(tmp_path):
    scene = Scene(None, [Sphere([0.5, 0, z], 0.1, name="ball") for z in (0.1, 0.3)])
    with pytest.raises(InputError, match="are both named"):
        save_scene(scene, tmp_path / "scene.yaml")
    assert not list(tmp_path.iterdir())


TRACKED = "obstacles:\n- {type: box, name: tin, position: [0.5, 0, 0], size: [0.1, 0.1, 0.2], track: %s}\n"


@settings(deadline=None, max_examples=20, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**32 - 1), n=st.integers(1, 5), turns=st.booleans())
def test_tracks_are_read_back_as_written(seed, n, turns, tmp_path):
    rng = np.random.default_rng(seed)
    times = np.cumsum(rng.uniform(0.5, 1.0, n))
    quaternions = quaternion_exp(rng.normal(size=(n, 3))) if turns else None
    track = Track(times, rng.uniform(-1.0, 1.0, (n, 3)), quaternions)
    scene = Scene(None, [Sphere([0, 0, 1], 0.1, name="ball"), Box(Pose.identity(), [0.1, 0.2, 0.3])], stamp=0.7)
    save_scene(MovingScene(scene, {1: track}), tmp_path / "scene.yaml")
    back = load_moving_scene(tmp_path / "scene.yaml")
    assert list(back.motions) == [1]
    for time in rng.uniform(0.0, 6.0, 5):
        for one, other in zip(back.at(time).obstacles, MovingScene(scene, {1: track}).at(time).obstacles, strict=True):
            np.testing.assert_allclose(one.bounds(), other.bounds(), atol=1e-9)
    at_stamp = load_scene(tmp_path / "scene.yaml")
    assert at_stamp.stamp == 0.7
    np.testing.assert_allclose(at_stamp.packed.positions, back.at(0.7).packed.positions)


def test_a_track_is_in_the_units_of_the_file_and_gives_the_velocity_at_the_stamp(tmp_path):
    text = HEAD + "units: cm\nstamp: 1\n" + TRACKED % "[[0, 50, 0, 10], [2, 50, 40, 10]]"
    text = text.replace("[0.5, 0, 0], size: [0.1, 0.1, 0.2]", "[50, 0, 0], size: [10, 10, 20]")
    tin = read(tmp_path, text).obstacles[0]
    np.testing.assert_allclose(tin.pose.position, [0.5, 0.2, 0.1], atol=1e-12)
    np.testing.assert_allclose(tin.velocity, [0.0, 0.2, 0.0], atol=1e-9)


@pytest.mark.parametrize(
    ("track", "words"),
    [
        ("[]", "rows [time, x, y, z]"),
        ("5", "rows [time, x, y, z]"),
        ("[1, 2, 3, 4]", "rows [time, x, y, z]"),
        ("[[0, 1, 2]]", "rows [time, x, y, z]"),
        ("[[0, 1, 2, 3], [1, 1, 2, 3, 1, 0, 0, 0]]", "all of one kind"),
        ("[[0, 1, 2, soon]]", "must be a number"),
        ("[[1, 0, 0, 0], [1, 0, 0, 1]]", "times must"),
        ("[[0, 0, 0, .nan]]", "finite"),
        ("[[0, 0, 0, 0, 2, 0, 0, 0]]", "quaternion"),
        ("[[0, 0, 0, 0], [1, 0, 100, 0]]", "speed of 100 m/s"),
        ("[[0, 0, 40, 0], [9, 0, 41, 0]]", "from the robot's base"),
        ("[[0, 0, 0, 0]], velocity: [0, 0, 1]", "both velocity and track"),
    ],
)
def test_wrong_tracks_are_refused(tmp_path, track, words):
    message = message_of(tmp_path, HEAD + TRACKED % track)
    assert 'obstacles[0] (box "tin")' in message and words in message


def test_only_obstacles_have_tracks_and_only_tracks_are_written(tmp_path):
    fixture = (HEAD + TRACKED % "[[0, 1, 2, 3]]").replace("obstacles", "fixtures")
    assert 'unknown key "track"' in message_of(tmp_path, fixture)
    ball = Scene(None, [Sphere([0, 0, 1], 0.1, name="ball")])
    with pytest.raises(InputError, match="motion of obstacle 'ball'"):
        save_scene(MovingScene(ball, {"ball": lambda time: [0.0, 0.0, time]}), tmp_path / "scene.yaml")
