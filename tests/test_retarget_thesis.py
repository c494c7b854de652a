from functools import cache

import numpy as np
import pytest

from imitarm import ArmModel
from imitarm.capture.camera_model import SkeletonCamera
from imitarm.capture.motions import reaching
from imitarm.capture.person import Person
from imitarm.capture.skeleton import Skeleton
from imitarm.capture.synthetic import SyntheticSource
from imitarm.errors import InputError, UnknownNameError
from imitarm.retarget.baselines.thesis import PRINTED, ThesisRetargeter
from imitarm.retarget.correspondence import Correspondence
from imitarm.retarget.limbs import LimbLengths
from imitarm.retarget.retargeter import Retargeting

SAWYER = ArmModel.load("sawyer", tool="gripper")
PERSON = Person.from_seed(1)
LENGTHS = LimbLengths(PERSON.upper_arm, PERSON.forearm)
FOLLOW = Correspondence(lengths=LENGTHS)
LAG = 0.08  # [s] of the live curve, and of the frames' coming


@cache
def recording(kind: str = "inside", camera: str = "ideal", duration: float = 6.0) -> tuple[Skeleton, ...]:
    seen = SkeletonCamera.ideal() if camera == "ideal" else SkeletonCamera(3)
    return tuple(SyntheticSource(reaching(PERSON, 1, duration=duration, kind=kind), seen, duration))


@cache
def followed(camera: str = "ideal") -> Retargeting:
    return ThesisRetargeter(SAWYER, FOLLOW).run(recording(camera=camera))


def still(duration: float = 2.0, *, away: tuple[float, float, float] = (0.0, 0.0, 0.0), moving: float = 0.0, **given):
    """A hand before the shoulder that goes ``away`` [m] in the sensor's frame, evenly from 1 s on for ``moving`` s."""
    for t in np.arange(0.0, duration, 1.0 / 30.0):
        share = min(max((t - 1.0) / moving, 0.0), 1.0) if moving else 0.0
        wrist = PERSON.shoulder("right", 0.0) + np.array([0.05, -0.2, -0.3]) + share * np.array(away)
        yield PERSON.skeleton(float(t), wrist, **given)


def wanted(run: Retargeting, correspondence: Correspondence, kind: str) -> np.ndarray:
    """Where the tool should be by the truth, relative to where the clutch engaged, as a function of the run's times."""
    truth = reaching(PERSON, 1, duration=6.0, kind=kind)
    turn = correspondence.sensor_to_base.rotation
    return correspondence.scale * np.array([turn @ truth(float(t)).arm("right").wrist for t in run.times])


def following(run: Retargeting, positions: np.ndarray, lag: float, kind: str = "inside") -> float:
    """RMS distance [m] of positions from the truth ``lag`` seconds before, both counted from their means."""
    on = np.flatnonzero(run.states != "waiting")[30:]
    truth = wanted(run, FOLLOW, kind)[on - round(lag / 0.01)]
    away = positions[on] - truth
    return float(np.sqrt(np.mean(np.sum((away - away.mean(axis=0)) ** 2, axis=1))))


def within_limits(run: Retargeting) -> bool:
    inside = (run.joints >= SAWYER.lower - 1e-9) & (run.joints <= SAWYER.upper + 1e-9)
    slow = np.abs(np.diff(run.joints, axis=0)) <= 0.01 * SAWYER.max_velocity + 1e-9
    return bool(inside.all() and slow.all() and np.isfinite(run.velocities).all())


def test_the_target_is_the_hand_as_it_was_a_lag_ago():
    run = followed()
    errors = {lag: following(run, run.targets[0], lag) for lag in (0.0, LAG, 0.16)}
    assert errors[LAG] < 0.003
    assert min(errors[0.0], errors[0.16]) > 3.0 * errors[LAG]


def test_the_tool_follows_the_hand():
    run = ThesisRetargeter(SAWYER, Correspondence(lengths=LENGTHS, scale=1.0, orientation="fixed")).run(recording())
    assert min(following(run, SAWYER.tool_path(run.joints)[0], lag) for lag in (0.1, 0.12, 0.15, 0.2)) < 0.02


def test_one_curve_for_the_whole_recording_has_no_lag():
    run = ThesisRetargeter(SAWYER, FOLLOW, smoothing="global").run(recording())
    assert following(run, run.targets[0], 0.0) < 0.004
    live = followed("noisy")
    whole = ThesisRetargeter(SAWYER, FOLLOW, smoothing="global").run(recording(camera="noisy"))
    roughness = [np.sqrt(np.mean(np.diff(r.velocities, axis=0) ** 2)) for r in (whole, live)]
    assert roughness[0] < 0.5 * roughness[1]


def test_after_a_global_run_it_steps_live_again():
    method = ThesisRetargeter(SAWYER, FOLLOW, smoothing="global")
    method.run(recording())
    first = ThesisRetargeter(SAWYER, FOLLOW)
    method.start(SAWYER.home)
    for k, skeleton in enumerate(recording()[:60]):
        np.testing.assert_array_equal(method.step(skeleton, SAWYER.home), first.step(skeleton, SAWYER.home), str(k))


def test_without_a_curve_noise_goes_straight_to_the_joints():
    raw = ThesisRetargeter(SAWYER, FOLLOW, smoothing=None).run(recording(camera="noisy"))
    rough, calm = (np.sqrt(np.mean(np.diff(r.velocities, axis=0) ** 2)) for r in (raw, followed("noisy")))
    assert calm < 0.9 * rough


@pytest.mark.parametrize("printed", [False, *PRINTED, True])
def test_the_joints_keep_position_and_velocity_whatever_is_printed(printed):
    names = printed if isinstance(printed, bool) else (printed,)
    run = ThesisRetargeter(SAWYER, as_printed=names).run(recording("edge", "noisy", 4.0))
    assert within_limits(run)
    assert "following" in run.states
    assert np.isfinite(run.targets[0][run.states == "following"]).all()


def test_it_waits_half_a_second_and_takes_hold_without_a_jump():
    run = ThesisRetargeter(SAWYER, FOLLOW).run(still())
    engaged = int(np.argmax(run.states != "waiting"))
    assert 0.5 <= run.times[engaged] <= 0.62
    assert not run.velocities[:engaged].any()
    np.testing.assert_allclose(run.targets[0][engaged], SAWYER.tool_pose(SAWYER.home).position, atol=1e-9)
    assert np.abs(run.velocities).max() < 0.2  # the person breathes and trembles


def test_a_lost_person_leaves_the_target_where_it_was_and_may_come_back():
    frames = list(still(4.0, away=(0.0, 0.15, 0.0), moving=1.0))
    lost = [f if not 1.5 < f.time < 2.5 else Skeleton(f.time, np.full((25, 3), np.nan)) for f in frames]
    run = ThesisRetargeter(SAWYER, FOLLOW).run(lost)
    held = (run.times > 1.7) & (run.times < 2.45)
    assert set(run.states[held]) == {"holding"}
    assert np.ptp(run.targets[0][held], axis=0).max() == 0.0
    assert np.abs(run.velocities[(run.times > 2.3) & held]).max() < 0.02
    rise = run.targets[0][-1] - run.targets[0][np.argmax(run.states != "waiting")]
    assert rise[2] == pytest.approx(0.15, abs=0.02)  # the same hold as before: the thesis has no other


def test_the_printed_order_moves_the_tool_along_the_sensor():
    frames = list(still(3.0, away=(0.0, 0.0, -0.12), moving=1.0))  # towards the sensor
    moved = {}
    for printed in ((), ("order",)):
        run = ThesisRetargeter(SAWYER, FOLLOW, as_printed=printed).run(frames)
        moved[printed] = run.targets[0][-1] - run.targets[0][np.argmax(run.states != "waiting")]
    np.testing.assert_allclose(moved[()], [0.12, 0.0, 0.0], atol=0.03)  # forwards
    np.testing.assert_allclose(moved["order",], [0.0, 0.0, -0.12], atol=0.03)  # down into the table


def test_the_printed_limbs_mirror_the_upper_arm():
    """The shoulder and hand are there, the elbow moves alone: with the print's signs the hand goes elsewhere."""
    frames = list(still(3.0, away=(0.0, 0.12, 0.0), moving=1.0))
    rise = {}
    for printed in ((), ("limbs",)):
        run = ThesisRetargeter(SAWYER, FOLLOW, as_printed=printed).run(frames)
        rise[printed] = run.targets[0][-1] - run.targets[0][np.argmax(run.states != "waiting")]
    np.testing.assert_allclose(rise[()], [0.0, 0.0, 0.12], atol=0.03)
    assert np.linalg.norm(rise["limbs",] - rise[()]) > 0.1


def test_an_error_that_is_not_clamped_slows_the_arm_the_farther_it_has_to_go():
    frames = list(still(2.2, away=(0.0, -0.35, 0.0), moving=0.4))
    larger = Correspondence(lengths=LENGTHS, scale=1.5, orientation="fixed")
    left = {}
    for printed in ((), ("damping",)):
        run = ThesisRetargeter(SAWYER, larger, as_printed=printed).run(frames)
        away = np.linalg.norm(run.targets[0] - SAWYER.tool_path(run.joints)[0], axis=1)
        left[printed] = away[run.times > 1.8].max()
    assert left["damping",] > 3.0 * left[()]


def test_the_small_angle_is_an_option_of_its_own():
    frames = recording("edge", "noisy", 4.0)
    option = ThesisRetargeter(SAWYER, small_angle="thesis").run(frames)
    printed = ThesisRetargeter(SAWYER, as_printed=("small_angle",)).run(frames)
    plain = ThesisRetargeter(SAWYER).run(frames)
    np.testing.assert_array_equal(option.joints, printed.joints)
    assert np.abs(option.joints - plain.joints).max() > 1e-3


def test_the_hand_closes_the_gripper():
    run = ThesisRetargeter(SAWYER, FOLLOW).run([*still(1.5), *(f for f in still(3.0, closed=True) if f.time >= 1.5)])
    assert not run.closed[run.times < 1.5].any()
    assert run.closed[run.times > 1.7].all()


def test_the_elbow_is_reported_and_the_same_frames_give_the_same_motion():
    first, second = followed(), ThesisRetargeter(SAWYER, FOLLOW).run(recording())
    np.testing.assert_array_equal(first.joints, second.joints)
    elbows = first.elbows[first.states == "following"]
    np.testing.assert_allclose(np.linalg.norm(elbows, axis=1), 1.0)
    assert elbows[:, 2].max() < 0.5  # arms are carried with the elbow below the shoulder, mostly


def test_a_recording_becomes_a_demonstration():
    demonstration = ThesisRetargeter(SAWYER, FOLLOW).run(recording()).demonstration("reach")
    assert demonstration.joints.shape == (len(demonstration.trajectory.times), 7)
    assert demonstration.trajectory.path_length > 0.3


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"as_printed": ["limbs", "everything"]}, "everything"),
        ({"as_printed": "limb"}, "limbs"),
        ({"smoothing": "cubic"}, "cubic"),
        ({"small_angle": "small"}, "thesis"),
    ],
)
def test_names_that_are_none_are_refused(options, match):
    with pytest.raises(UnknownNameError, match=match):
        ThesisRetargeter(SAWYER, **options)


@pytest.mark.parametrize(
    "options", [{"gain": 0.0}, {"gain": 200.0}, {"max_speed": 0.0}, {"iterations": 0}, {"lag": 1.0}]
)
def test_numbers_out_of_range_are_refused(options):
    with pytest.raises(InputError, match="ThesisRetargeter"):
        ThesisRetargeter(SAWYER, **options)


def test_a_recording_without_an_arm_has_no_curve():
    nobody = [Skeleton(0.1 * k, np.full((25, 3), np.nan)) for k in range(9)]
    with pytest.raises(InputError, match="at least 4 frames"):
        ThesisRetargeter(SAWYER, smoothing="global").run(nobody)
    assert set(ThesisRetargeter(SAWYER).run(nobody).states) == {"waiting"}
