import numpy as np
import pytest

from imitarm.capture.formats import MotionCapture
from imitarm.capture.motions import minimum_jerk, reaching
from imitarm.capture.person import Person
from imitarm.errors import FileFormatError, InputError, UnknownNameError

PERSON = Person.from_seed(1)


def wrists(truth, duration, dt=0.01):
    return np.array([truth(t).arm().wrist for t in np.arange(0.0, duration, dt)])


def test_minimum_jerk_passes_its_points_and_rests_at_the_ends():
    points = np.array([[0.0, 0.0], [0.1, 0.3], [0.4, 0.1]])
    path = minimum_jerk(points, [0.0, 1.0, 2.5])
    np.testing.assert_allclose(path([0.0, 1.0, 2.5]), points, atol=1e-12)
    np.testing.assert_allclose(path([0.0, 2.5], 1), 0.0, atol=1e-9)
    straight = minimum_jerk(points[:2], [0.0, 1.0])(0.25)
    np.testing.assert_allclose(straight, points[1] * (10 * 0.25**3 - 15 * 0.25**4 + 6 * 0.25**5))


@pytest.mark.parametrize("kind", ["inside", "edge"])
def test_a_reach_begins_at_rest_and_moves_as_people_do(kind):
    for seed in range(3):
        path = wrists(reaching(PERSON, seed, duration=10.0, kind=kind), 10.0)
        speed = np.linalg.norm(np.diff(path, axis=0), axis=1) / 0.01
        assert speed[:80].max() < 0.05  # tremor and sway only
        assert 0.1 < speed[120:].mean() < 0.7
        assert speed.max() < 2.5


def test_edge_reaches_stretch_the_arm_and_inside_ones_do_not():
    for seed in range(5):
        for kind, stretched in (("inside", False), ("edge", True)):
            truth = reaching(PERSON, seed, duration=10.0, kind=kind)
            away = [np.linalg.norm(a.wrist - a.shoulder) for a in (truth(t).arm() for t in np.arange(0.0, 10.0, 0.05))]
            assert (max(away) > 0.999 * PERSON.reach) == stretched


def test_unknown_kinds_and_short_times_are_refused():
    with pytest.raises(UnknownNameError, match="inside"):
        reaching(PERSON, 0, kind="outside")
    with pytest.raises(InputError, match="duration"):
        reaching(PERSON, 0, duration=1.0)


def test_motion_capture_of_a_real_arm(real_data):
    capture = MotionCapture.load(real_data / "mocap_arm" / "recording.tsv")
    assert capture.duration == pytest.approx(59.99, abs=0.02)
    truth = capture.truth(PERSON)
    arms = [truth(t).arm() for t in np.arange(0.0, 60.0, 0.1)]
    assert all(np.isfinite(truth(t).positions).all() for t in np.arange(0.0, 60.0, 2.0))
    upper = np.array([np.linalg.norm(a.elbow - a.shoulder) for a in arms])
    fore = np.array([np.linalg.norm(a.wrist - a.elbow) for a in arms])
    assert upper.std() / upper.mean() < 0.06  # markers slide on the skin
    assert fore.std() / fore.mean() < 0.03
    assert all(a.wrist[2] < a.shoulder[2] for a in arms)  # the hand is before the body, towards the sensor
    speed = np.linalg.norm(np.diff(wrists(truth, 20.0), axis=0), axis=1) / 0.01
    assert 0.05 < speed.mean() < 0.4


def exported(tmp_path, rows, scale=1.0):
    """A file with the least that is needed: an arm that points forward and down."""
    arm = scale * np.array(
        [[0, 0, 0], [0, 0, -300], [240, 20, -300], [240, -20, -300], [340, 0, -300], [300, 50, -290]]
    )
    names = ("right_shoulder", "right_elbow", "hand_left", "hand_right", "middle_middle", "thumb_middle")
    lines = ["MARKER_NAMES\t" + "\t".join(names), "Frame\tTime"]
    lines += [f"{i}\t{t}\t" + "\t".join(str(x + 10.0 * scale * t) for x in arm.ravel()) for i, t in enumerate(rows)]
    path = tmp_path / "arm.tsv"
    path.write_text("\n".join(lines) + "\n")
    return path


def test_a_capture_is_placed_before_the_sensor_and_interpolated(tmp_path):
    capture = MotionCapture.load(exported(tmp_path, [5.0, 6.0, 8.0]))
    assert capture.duration == 3.0
    truth = capture.truth(PERSON)
    arm = truth(0.0).arm()
    np.testing.assert_allclose(arm.elbow - arm.shoulder, [0.0, -0.3, 0.0], atol=1e-12)  # down
    np.testing.assert_allclose(arm.wrist - arm.elbow, [0.0, 0.0, -0.24], atol=1e-12)  # towards the sensor
    assert arm.points[5, 0] < arm.wrist[0]  # the marker to the person's left is at smaller x
    np.testing.assert_allclose(truth(2.0).arm().wrist - arm.wrist, [-0.02, 0.02, -0.02], atol=1e-12)
    for outside, inside in ((-1.0, 0.0), (99.0, 3.0)):
        np.testing.assert_allclose(truth(outside).arm().points, truth(inside).arm().points)


def test_axes_of_a_capture_can_be_turned(tmp_path):
    path = exported(tmp_path, [0.0, 1.0])
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    np.testing.assert_allclose(MotionCapture.load(path, to_body=turn).points, MotionCapture.load(path).points @ turn.T)
    for wrong in (np.eye(2), np.diag([1.0, 1.0, -1.0]), 2.0 * np.eye(3)):
        with pytest.raises(InputError, match="rotation"):
            MotionCapture.load(path, to_body=wrong)


def test_a_capture_in_other_units_or_out_of_order_is_refused(tmp_path):
    with pytest.raises(FileFormatError, match="in millimetres"):
        MotionCapture.load(exported(tmp_path, [0.0, 1.0], scale=1e-3))
    with pytest.raises(FileFormatError, match="line 5: the time"):
        MotionCapture.load(exported(tmp_path, [0.0, 1.0, 1.0]))
    with pytest.raises(FileFormatError, match="0 frames"):
        MotionCapture.load(exported(tmp_path, []))
    with pytest.raises(FileFormatError, match=r"read"):
        MotionCapture.load(tmp_path / "absent.tsv")


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("a,b\n1,2\n", "MARKER_NAMES"),
        ("MARKER_NAMES\tright_shoulder\nFrame\tTime\n1\t0.0\t1\t2\t3\n", "right_elbow"),
        (
            "MARKER_NAMES\tright_shoulder\tright_elbow\thand_left\thand_right\tmiddle_middle\tthumb_middle\n"
            "Frame\tTime\n1\t0.0\t" + "\t".join(["1"] * 18) + "\n2\t0.01\t1\t2\n",
            "line 4",
        ),
        (
            "MARKER_NAMES\tright_shoulder\tright_elbow\thand_left\thand_right\tmiddle_middle\tthumb_middle\n"
            "Frame\tTime\n1\t0.0\t" + "\t".join(["1"] * 18) + "\n2\t0.01\tnan\t" + "\t".join(["1"] * 17) + "\n",
            "gap",
        ),
    ],
)
def test_what_is_no_motion_capture_is_named(tmp_path, text, says):
    path = tmp_path / "file.tsv"
    path.write_text(text)
    with pytest.raises(FileFormatError, match=says):
        MotionCapture.load(path)
