from functools import cache

import numpy as np
import pytest

from imitarm import ArmModel
from imitarm.capture.camera_model import SkeletonCamera
from imitarm.capture.motions import reaching
from imitarm.capture.person import Person
from imitarm.capture.synthetic import SyntheticSource
from imitarm.errors import InputError
from imitarm.retarget import Correspondence, LimbLengths
from imitarm.retarget.baselines.demonstrated_motion import above
from imitarm.retarget.baselines.demonstration_modification import DemonstrationModification
from shown_arm import EASY, LENGTHS, shown, swing

SAWYER = ArmModel.load("sawyer", tool="gripper")
HAND = Correspondence(lengths=LENGTHS)
FIXED = Correspondence(lengths=LENGTHS, orientation="fixed")
M1 = DemonstrationModification


@cache
def edge():
    person = Person.from_seed(1)
    frames = SyntheticSource(reaching(person, 1, duration=8.0, kind="edge"), SkeletonCamera.from_seed(1), 8.0)
    return Correspondence(lengths=LimbLengths(person.upper_arm, person.forearm), orientation="fixed"), tuple(frames)


@pytest.mark.parametrize("joint", range(7))
def test_a_slow_motion_that_the_arm_can_do_is_the_persons_own(joint):
    """Absolute, on the Sawyer: its joints are the person's angles, its tool where forward kinematics puts them."""
    base = EASY - 0.25 * np.eye(7)[joint]
    run = M1(SAWYER, HAND, relative=False).run(shown(swing(joint, 0.3, base=base), 7.0), base)
    assert run.notes["infeasible_before"] == run.notes["segments"] == run.notes["teaching_time"] == 0.0
    np.testing.assert_allclose(run.joints[0], base, atol=1e-9)
    np.testing.assert_allclose(run.joints[-1], base + 0.3 * np.eye(7)[joint], atol=2e-3)
    angles = swing(joint, 0.3, base=base)
    late = np.array([angles(t - 0.06) for t in run.times])  # by the front end's filters
    assert np.abs(run.joints - late).max() < 0.04
    tool, wanted = SAWYER.tool_pose(run.joints[-1]), SAWYER.tool_pose(base + 0.3 * np.eye(7)[joint])
    assert np.linalg.norm(tool.position - wanted.position) < 3e-3


def test_what_is_feasible_is_the_same_offline_and_live():
    frames = shown(swing(0, 0.4), 6.0)
    offline = M1(SAWYER, FIXED).run(frames)
    method, joints = M1(SAWYER, FIXED), [SAWYER.home]
    todo = list(frames)
    for k in range(len(offline.times) - 1):
        newest = None
        while todo and todo[0].time <= k * 0.01 + 1e-9:
            newest = todo.pop(0)
        joints.append(method.step(newest, joints[-1]))
    assert np.abs(np.array(joints) - offline.joints).max() < 0.02  # live it is a frame later
    np.testing.assert_allclose(joints[-1], offline.joints[-1], atol=1e-3)


def test_too_fast_a_motion_is_slowed_and_that_costs_time():
    run = M1(SAWYER, FIXED).run(shown(swing(0, 1.2, over=0.6), 4.0))
    notes = run.notes
    assert notes["slowed"] == notes["segments"] == notes["rounds"] == 1.0
    assert notes["failures"] == notes["infeasible_after"] == notes["velocity_excess"] == 0.0
    assert (np.abs(run.velocities) <= SAWYER.max_velocity).all()
    assert notes["execution_time"] > notes["shown_time"] + 0.3
    assert run.joints[-1, 0] - run.joints[0, 0] == pytest.approx(1.2, abs=0.01)


def test_a_stretched_arm_is_pulled_in():
    run = M1(SAWYER, FIXED, relative=False).run(shown(swing(3, 0.22 - EASY[3], over=5.0), 8.0), EASY)
    assert run.notes["pulled_in"] >= 1.0
    assert run.notes["failures"] == 0.0
    assert run.joints[:, 3].min() > 0.317


def test_a_joint_beyond_its_limit_is_cleared_by_another_elbow():
    """The upper arm's roll is beyond the Sawyer's limit; the elbow outwards by some degrees brings it back."""
    base = EASY + [0, 0, 0.2, 0, 0, 0, 0]
    run = M1(SAWYER, FIXED, relative=False).run(shown(swing(2, 3.12 - base[2], over=6.0, base=base), 8.0), base)
    assert run.notes["elbow_rotated"] >= 1.0
    assert run.notes["failures"] == run.notes["position_clips"] == 0.0


def test_what_no_operator_clears_is_repaired_at_key_frames():
    """A teacher's plane that the way dips under: no elbow helps where the wrist itself is too low."""
    frames = shown(swing(1, 0.25, over=5.0), 8.0)
    plain = SAWYER.tool_path(M1(SAWYER, FIXED).run(frames).joints)[0][:, 2].min()
    method = M1(SAWYER, FIXED, constraints={"table": above(plain + 0.03)})
    run = method.run(frames)
    assert run.notes["repaired"] + run.notes["elbow_rotated"] >= 1.0
    assert run.notes["infeasible_after"] < run.notes["infeasible_before"]


@pytest.mark.slow
def test_what_can_not_be_mended_is_counted_and_cut_at_the_limits():
    never = {"never": lambda positions, _: np.zeros(len(positions), dtype=bool)}
    run = M1(SAWYER, FIXED, constraints=never).run(shown(swing(0, 0.2), 3.0))
    notes = run.notes
    assert notes["rounds"] == 5.0
    assert notes["failures"] == 1.0
    assert notes["missed_keys"] > 0.0
    assert notes["infeasible_after"] == notes["infeasible_before"] > 0.0


def test_teaching_takes_each_segment_and_five_seconds():
    frames = shown(swing(0, 1.2, over=0.6), 4.0)
    short, long = (M1(SAWYER, FIXED, annotation_time=t).run(frames).notes for t in (5.0, 20.0))
    assert long["teaching_time"] - short["teaching_time"] == pytest.approx(15.0 * short["segments"])
    assert 5.4 < short["teaching_time"] < 7.0  # one segment, 0.2 s longer on both sides than what is too fast


def test_the_shown_times_say_when_the_person_did_it():
    frames = shown(swing(0, 1.2, over=0.6), 4.0)
    method = M1(SAWYER, FIXED)
    run = method.run(frames)
    assert run.shown_times.shape == run.times.shape
    assert run.shown_times[0] == 0.0
    assert run.shown_times[-1] == pytest.approx(4.0, abs=0.05)
    assert (np.diff(run.shown_times) >= -1e-9).all()
    assert (run.shown_times <= run.times + 0.02).all()


def test_absolute_it_goes_to_where_the_person_is_first():
    run = M1(SAWYER, HAND, relative=False).run(shown(lambda _: EASY, 3.0))
    assert (np.abs(run.velocities) <= 0.61 * SAWYER.max_velocity).all()
    np.testing.assert_allclose(run.joints[-1, :4], EASY[:4], atol=2e-3)
    assert run.notes["execution_time"] > run.notes["shown_time"] + 1.0


def test_at_the_edge_it_is_mended_as_far_as_it_goes_and_all_of_it_is_noted():
    correspondence, frames = edge()
    run = M1(SAWYER, correspondence).run(frames)
    notes = run.notes
    kinds = ("slowed", "pulled_in", "elbow_rotated", "repaired")
    assert notes["segments"] == sum(notes[kind] for kind in kinds) > 0.0
    assert notes["infeasible_after"] <= notes["infeasible_before"]
    assert notes["teaching_time"] > 5.0 * notes["segments"]


@pytest.mark.slow
def test_seeds_tell_repairs_apart():
    correspondence, frames = edge()
    never = {"never": lambda positions, _: positions[:, 0] > 0.6}
    runs = [M1(SAWYER, correspondence, constraints=never, seed=seed).run(frames).joints for seed in (0, 0, 1)]
    np.testing.assert_array_equal(runs[0], runs[1])
    assert runs[0].shape != runs[2].shape or np.abs(runs[0] - runs[2]).max() > 1e-3


def test_a_time_that_can_not_be_is_refused():
    with pytest.raises(InputError, match="annotation_time"):
        M1(SAWYER, annotation_time=-1.0)
