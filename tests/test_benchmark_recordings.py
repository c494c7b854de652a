from __future__ import annotations

import numpy as np
import pytest

from imitarm.benchmark.mapping_tables import TEST
from imitarm.benchmark.recordings import CAPTURED, KINDS, MappingRecording, Plan, beyond_reach, make_recording
from imitarm.capture.person import Person
from imitarm.errors import InputError, UnknownNameError
from imitarm.kinematics.arm import ArmModel

ARM = ArmModel.load("sawyer", tool="gripper")
SHORT = 5.0


def points(recording):
    return np.array([s.positions for s in recording.skeletons])


@pytest.mark.parametrize("kind", ["inside", "edge", "drawing"])
def test_the_same_plan_gives_the_same_recording_and_another_another(kind):
    first, again = (make_recording(Plan(kind, 3, seconds=SHORT), ARM) for _ in range(2))
    np.testing.assert_array_equal(points(first), points(again))
    np.testing.assert_array_equal(first.start, again.start)
    other = make_recording(Plan(kind, 3, 1, seconds=SHORT), ARM)
    assert np.abs(first.true_points[300] - other.true_points[300]).max() > 1e-3


def test_a_recording_is_the_same_after_it_was_kept(tmp_path):
    made = make_recording(Plan("inside", 2, seconds=SHORT), ARM)
    made.save(tmp_path / "r.npz")
    assert [p.name for p in tmp_path.iterdir()] == ["r.npz"]
    read = MappingRecording.load(tmp_path / "r.npz", made.plan)
    np.testing.assert_array_equal(points(read), points(made))
    np.testing.assert_array_equal(read.true_points, made.true_points)
    np.testing.assert_array_equal(read.start, made.start)
    assert [s.hand_states for s in read.skeletons] == [s.hand_states for s in made.skeletons]
    assert [s.time for s in read.skeletons] == [s.time for s in made.skeletons]
    for name in ("lengths", "scale", "orientation", "side"):
        assert getattr(read.correspondence, name) == getattr(made.correspondence, name)


def test_the_truth_is_where_the_camera_looked():
    made = make_recording(Plan("drawing", 1, seconds=SHORT, sigma=0.0), ARM)
    first = made.skeletons[0].time
    for skeleton in made.skeletons[::20]:
        at = np.array([skeleton.time - first])
        true = made.true_arm(at)
        seen = made.correspondence.sensor_to_base.apply(skeleton.arm().wrist)
        if skeleton.arm().confidence[2] == 1.0:
            np.testing.assert_allclose(true.wrist[0], seen, atol=2e-4)  # straight between hundredths of a second


def test_only_at_the_edge_the_arm_would_have_to_be_longer_than_it_is():
    for person in range(3):
        inside, edge = (make_recording(Plan(kind, person, seconds=8.0), ARM) for kind in ("inside", "edge"))
        assert beyond_reach(inside, ARM) == 0.0
        assert 0.05 < beyond_reach(edge, ARM) < 0.6


def test_the_robot_is_still_led_when_the_person_rests_at_the_end():
    made = make_recording(Plan("edge", 0, seconds=SHORT), ARM)
    last = made.true_points[-100:, 2]
    assert np.linalg.norm(last - last[0], axis=1).max() < 0.01
    ARM.check_limits(made.start)
    person = Person.from_seed(0)
    assert made.correspondence.lengths.upper_arm == pytest.approx(person.upper_arm, rel=0.2)


def test_a_captured_arm_needs_its_data(real_data, tmp_path):
    with pytest.raises(InputError, match="--data"):
        make_recording(Plan(CAPTURED, 0, data=str(tmp_path)), ARM)
    made = make_recording(Plan(CAPTURED, 0, seconds=SHORT, data=str(real_data)), ARM)
    assert made.true_times[-1] == pytest.approx(SHORT + 1.0 + 2.0, abs=0.2)
    assert np.ptp(made.true_points[:, 2], axis=0).max() > 0.05
    upper = np.linalg.norm(made.true_points[:, 1] - made.true_points[:, 0], axis=1)
    assert made.correspondence.lengths.upper_arm == pytest.approx(np.median(upper))  # its own bones, not the person's
    assert beyond_reach(made, ARM) == 0.0


@pytest.mark.slow
@pytest.mark.parametrize("person", range(TEST, TEST + 10))
def test_every_test_person_makes_every_recording(person):
    for kind in KINDS:
        made = make_recording(Plan(kind, person), ARM)
        assert made.true_times[-1] > 8.0
        assert len(made.skeletons) > 200
    # the last is stacking
    closed = np.array([s.hand_states[1].name == "CLOSED" for s in made.skeletons])
    assert np.sum(np.diff(closed.astype(int)) == 1) >= 3  # three cubes were gripped
    assert made.correspondence.scale == 1.0
    assert made.correspondence.orientation == "fixed"


@pytest.mark.parametrize("bad", [{"kind": "dance"}, {"person": -1}, {"repeat": 100}, {"seconds": 1.0}, {"sigma": 0.5}])
def test_what_is_no_plan_is_refused(bad):
    with pytest.raises((InputError, UnknownNameError)):
        Plan(**{"kind": "inside", "person": 0, **bad})


def test_no_two_recordings_have_the_same_seeds_whoever_the_persons_are():
    plans = [
        Plan(kind, person, repeat)
        for kind in (*KINDS, CAPTURED)
        for person in (0, 1, 30, 99, 100, 101, 200, 209, 1000)
        for repeat in (0, 1, 99)
    ]
    cameras = [2 * plan.number + k for plan in plans for k in (0, 1)]
    assert len(set(cameras)) == len(cameras) == 2 * len(plans)
