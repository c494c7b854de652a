"""What the baselines M1 to M3 have in common, tried on each of them."""

from functools import cache, partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from imitarm import ArmModel
from imitarm.capture.camera_model import SkeletonCamera
from imitarm.capture.motions import reaching
from imitarm.capture.person import Person
from imitarm.capture.skeleton import JOINT, Skeleton
from imitarm.capture.synthetic import SyntheticSource
from imitarm.retarget import RETARGETERS, Correspondence, LimbLengths, Retargeting
from imitarm.retarget.engagement import EngagementState
from shown_arm import EASY, LENGTHS, shown, skeleton, swing

DT = 0.01
ARMS = {name: ArmModel.load(name, tool="gripper") for name in ("sawyer", "panda")}
SAWYER = ARMS["sawyer"]
BASELINES = {name: RETARGETERS[name] for name in ("m1", "m2", "m3")}
FIXED = Correspondence(lengths=LENGTHS, orientation="fixed")
each = pytest.mark.parametrize("baseline", BASELINES.values(), ids=BASELINES)


@cache
def recording(kind="inside", seed=1, duration=6.0):
    person = Person.from_seed(seed)
    source = SyntheticSource(
        reaching(person, seed, duration=duration, kind=kind), SkeletonCamera.from_seed(seed), duration
    )
    return Correspondence(lengths=LimbLengths(person.upper_arm, person.forearm), orientation="fixed"), tuple(source)


def stepped(baseline, frames, arm=SAWYER, correspondence=FIXED, steps=None, **options):
    """Live, step by step, with a robot that does what it is told: joints (n, 7), states, commands."""
    method, joints, commands = baseline(arm, correspondence, **options), [arm.home], []
    todo = list(frames)
    for k in range(steps or int(todo[-1].time / DT) + 1):
        newest = None
        while todo and todo[0].time <= k * DT + 1e-9:
            newest = todo.pop(0)
        joints.append(method.step(newest, joints[-1]))
        commands.append(method.latest)
    return np.array(joints), np.array([c.state for c in commands]), commands, method


def within_positions(arm, joints):
    return bool(np.isfinite(joints).all() and (joints >= arm.lower).all() and (joints <= arm.upper).all())


@each
def test_it_stands_behind_the_same_front_end(baseline):
    correspondence, frames = recording()
    method = baseline(SAWYER, correspondence)
    run = method.run(frames)
    assert isinstance(run, Retargeting)
    assert run.method == baseline.name
    assert set(run.states) <= set(EngagementState)
    engaged = int(np.argmax(run.states == "following"))
    assert 0.5 <= run.times[engaged] <= 0.62  # the same half second for all
    assert np.ptp(run.joints[:engaged], axis=0).max() == 0.0
    np.testing.assert_allclose(run.targets[0][engaged], SAWYER.tool_pose(SAWYER.home).position, atol=5e-3)
    assert {"velocity_excess", "position_clips"} <= set(run.notes)
    assert all(isinstance(value, float) for value in run.notes.values())


@each
@pytest.mark.parametrize("arm", ARMS.values(), ids=ARMS)
@pytest.mark.parametrize("kind", ["inside", "edge"])
def test_no_joint_passes_a_limit_of_position(baseline, arm, kind):
    correspondence, frames = recording(kind)
    larger = Correspondence(lengths=correspondence.lengths, scale=1.43, orientation="hand")
    for method in (partial(baseline, velocity_scaling=True), baseline):
        assert within_positions(arm, method(arm, larger).run(frames).joints)


@each
@pytest.mark.parametrize("kind", ["inside", "edge"])
def test_scaled_as_a_whole_no_joint_is_too_fast_and_without_it_that_is_counted(baseline, kind):
    correspondence, frames = recording(kind)
    scaled = baseline(SAWYER, correspondence, velocity_scaling=True).run(frames)
    assert (np.abs(scaled.velocities) <= SAWYER.max_velocity * (1.0 + 1e-9)).all()
    plain = baseline(SAWYER, correspondence).run(frames)
    seen = int(np.count_nonzero(np.abs(np.diff(plain.joints, axis=0)) > DT * SAWYER.max_velocity * (1.0 + 1e-6)))
    assert seen <= plain.notes["velocity_excess"]  # cut at a limit of position it may be slower again
    assert seen >= plain.notes["velocity_excess"] - plain.notes["position_clips"] - 1


@each
def test_nobody_means_no_motion(baseline):
    lost = [Skeleton(k / 30, np.full((25, 3), np.nan)) for k in range(60)]
    run = baseline(SAWYER).run(lost)
    assert set(run.states) == {"waiting"}
    assert np.ptp(run.joints, axis=0).max() == 0.0


@each
def test_a_lost_person_is_waited_for_and_must_take_hold_anew(baseline):
    frames = shown(swing(0, 0.8, start=1.0, over=6.0), 8.0)
    seen = [f for f in frames if not 3.0 < f.time < 4.5]
    joints, states, commands, _ = stepped(baseline, seen)
    at = {t: states[round(t / DT)] for t in (0.3, 2.9, 3.2, 3.6, 4.4, 4.8, 5.5)}
    assert list(at.values()) == ["waiting", "following", "holding", "stopped", "stopped", "waiting", "following"]
    assert np.ptp(joints[340:490], axis=0).max() == 0.0
    again = next(c for c in commands if c.time > 4.5 and c.state == "following")
    np.testing.assert_allclose(again.target.position, SAWYER.tool_pose(joints[480]).position, atol=0.01)


@each
def test_five_frames_a_second_are_too_few_to_take_hold(baseline):
    joints, states, _, _ = stepped(baseline, shown(swing(0, 0.5), 6.0, rate=5.0))
    assert set(states) == {"waiting"}
    assert np.ptp(joints, axis=0).max() == 0.0


@each
def test_the_hand_closes_the_gripper(baseline):
    frames = [skeleton(k / 30, EASY, closed=k > 45) for k in range(90)]
    _, _, commands, _ = stepped(baseline, frames)
    assert not [c for c in commands if c.time < 1.5 and c.closed]
    assert all(c.closed for c in commands if c.time > 1.8)


@each
def test_an_arm_that_was_pushed_while_waiting_starts_where_it_is(baseline):
    method, moved = baseline(SAWYER), SAWYER.home + 0.2
    np.testing.assert_allclose(method.step(None, moved), moved, atol=1e-12)


@each
def test_the_same_frames_give_the_same_motion(baseline):
    correspondence, frames = recording("edge")
    method = baseline(SAWYER, correspondence)
    first, second = method.run(frames), method.run(frames)
    np.testing.assert_array_equal(first.joints, second.joints)
    assert first.notes == second.notes


SPOILT = st.sampled_from(["none", "infinite", "nan", "swapped", "thrown", "backwards", "tiny", "far"])


@each
@settings(max_examples=12)
@given(st.lists(st.tuples(SPOILT, st.integers(1, 25)), min_size=3, max_size=12), st.integers(0, 1000))
def test_bad_input_moves_nothing_beyond_its_limits(baseline, stretches, seed):
    rng = np.random.default_rng(seed)
    angles, method = swing(0, 0.8, start=0.6, over=2.0), baseline(SAWYER, FIXED)
    q, k = SAWYER.home, 0
    for what, frames in [("none", 20), *stretches]:
        for _ in range(frames):
            frame = spoilt(skeleton(k / 30, angles(k / 30)), what, rng)
            for skeleton_or_none in (frame, None, None):
                q = method.step(skeleton_or_none, q)
                assert within_positions(SAWYER, q)
                assert np.isfinite(method.latest.velocity).all()
            k += 1
    assert method.latest.state in EngagementState


@each
@settings(max_examples=8)
@given(st.lists(st.tuples(SPOILT, st.integers(1, 25)), min_size=3, max_size=8), st.integers(0, 1000))
def test_a_bad_recording_as_a_whole_gives_a_motion_within_limits(baseline, stretches, seed):
    """Offline too; times that go back are refused before that."""
    rng, angles, frames = np.random.default_rng(seed), swing(0, 0.8, start=0.6, over=2.0), []
    for what, count in [("none", 25), *stretches]:
        for _ in range(count if what != "backwards" else 0):
            frames.append(spoilt(skeleton(len(frames) / 30, angles(len(frames) / 30)), what, rng))
    run = baseline(SAWYER, FIXED).run(frames)
    assert within_positions(SAWYER, run.joints)
    assert np.isfinite(run.velocities).all()
    assert np.isfinite(list(run.notes.values())).all()


def spoilt(frame, what, rng):
    positions, time = np.array(frame.positions), frame.time
    arm = [JOINT[f"{part}_right"] for part in ("shoulder", "elbow", "wrist", "hand", "hand_tip", "thumb")]
    left = [JOINT[f"{part}_left"] for part in ("shoulder", "elbow", "wrist", "hand", "hand_tip", "thumb")]
    if what == "infinite":
        positions[arm] = np.inf
    elif what == "nan":
        positions[rng.choice(arm)] = np.nan
    elif what == "swapped":
        positions[arm], positions[left] = positions[left], positions[arm].copy()
    elif what == "thrown":
        positions += 0.5 * rng.normal(size=positions.shape)
    elif what == "tiny":
        positions[arm] = positions[arm[0]]
    elif what == "far":
        positions += 15.0
    elif what == "backwards":
        time = rng.uniform(0.0, 10.0)
    return Skeleton(time, positions, hand_states=frame.hand_states)
