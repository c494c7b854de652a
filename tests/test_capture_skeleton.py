import numpy as np
import pytest

from imitarm.capture.skeleton import JOINT, JOINTS, HandState, Skeleton, SkeletonSource, Tracking
from imitarm.errors import InputError, UnknownNameError


def test_joints_are_those_of_the_kinect_in_its_order():
    assert len(JOINTS) == len(set(JOINTS)) == 25
    assert (JOINT["shoulder_right"], JOINT["wrist_right"], JOINT["thumb_right"]) == (8, 10, 24)


def test_what_can_not_have_been_measured_is_lost():
    positions = np.ones((25, 3))
    positions[3], positions[10, 2], positions[5, 0] = np.nan, np.inf, 1e6
    skeleton = Skeleton(0.0, positions)
    assert [JOINTS[i] for i in np.flatnonzero(skeleton.tracking == Tracking.LOST)] == [
        "head",
        "elbow_left",
        "wrist_right",
    ]
    assert np.isnan(skeleton.positions[10]).all()
    assert not skeleton.arm("right").seen
    assert skeleton.arm("right").confidence[2] == 0.0


def test_a_lost_joint_has_no_position_and_inferred_ones_count_less():
    tracking = np.full(25, 2)
    tracking[[9, 10]] = 0, 1
    arm = Skeleton(0.0, np.ones((25, 3)), tracking, (HandState.OPEN, HandState.CLOSED)).arm("right")
    assert np.isnan(arm.elbow).all()
    assert arm.confidence[2] == pytest.approx(0.2)
    assert arm.hand_state is HandState.CLOSED


def test_it_never_changes():
    skeleton = Skeleton(0.0, np.ones((25, 3)))
    with pytest.raises(ValueError, match="read-only"):
        skeleton.positions[0] = 0.0


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ((0.0, np.ones((24, 3))), r"positions must be an array of shape \(25, 3\)"),
        (("soon", np.ones((25, 3))), "time must be a finite number"),
        ((None, np.ones((25, 3))), "time"),
        ((0.0, "here"), "positions must be numbers"),
        ((0.0, [[1.0, 2.0], [3.0]]), "positions"),
        ((0.0, np.ones((25, 3)) * 1j), "positions"),
        ((0.0, np.ones((25, 3)), ["seen"] * 25), "tracking"),
        ((0.0, np.ones((25, 3)), np.full(25, 2), None), "hand_states"),
        ((0.0, np.ones((25, 3)), np.full(25, 2), (0, 0), "Ann"), "person must be a whole number"),
        ((0.0, np.ones((25, 3)), np.full(25, 2), (0, 0), np.nan), "person"),
        ((np.nan, np.ones((25, 3))), "time"),
        ((0.0, np.ones((25, 3)), np.full(25, 7)), "tracking"),
        ((0.0, np.ones((25, 3)), np.full(25, 2), (9, 2)), "hand_states"),
    ],
)
def test_what_is_no_skeleton_is_named(arguments, says):
    with pytest.raises(InputError, match=says):
        Skeleton(*arguments)


def test_unknown_names_list_the_known_ones():
    skeleton = Skeleton(0.0, np.ones((25, 3)))
    with pytest.raises(UnknownNameError, match="wrist_right"):
        skeleton.joint("wrist_rihgt")
    with pytest.raises(UnknownNameError, match="left"):
        skeleton.arm("both")


def test_a_source_is_read_until_it_is_over_and_empty_reads_are_left_out():
    class Three(SkeletonSource):
        left, closed = 3, False

        @property
        def over(self):
            return self.left == 0

        def read(self, timeout=1.0):
            self.left -= 1
            return None if self.left == 1 else Skeleton(-self.left, np.ones((25, 3)))

        def close(self):
            self.closed = True

    with Three() as source:
        assert [s.time for s in source] == [-2.0, 0.0]
    assert source.closed
