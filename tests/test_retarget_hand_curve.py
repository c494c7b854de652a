import numpy as np
import pytest

from imitarm.errors import InputError
from imitarm.kinematics.pose import quaternion_exp
from imitarm.retarget.baselines.hand_curve import DelayedCurve, HandCurve, HandSample

LAG, DT = 0.07, 0.01


def wrist(t):
    return np.stack([0.3 * np.sin(2.0 * t), 0.2 * np.cos(1.5 * t), 0.1 * t], axis=-1)


def hand(t):
    return quaternion_exp(np.stack([0.0 * t, 0.5 * np.sin(t), 0.3 * t], axis=-1))


def sample(t: float, noise: np.ndarray | float = 0.0) -> HandSample:
    return HandSample(t, wrist(np.asarray(t)) + noise, hand(np.asarray(t)), (1.0, 1.0))


def played(playback: DelayedCurve, frames: list[HandSample], duration: float, first: float) -> tuple[np.ndarray, ...]:
    """Run a playback at its steps; return when it was read, on the frames' clock, and the wrists and hands."""
    times, wrists, hands, k = [], [], [], 0
    for i in range(round(duration / DT)):
        now = first + i * DT
        playback.step(DT)
        while k < len(frames) and frames[k].time <= now + 1e-9:
            playback.add(frames[k])
            k += 1
        read = playback.now()
        if read is not None:
            times.append(now)
            wrists.append(read[0])
            hands.append(read[1])
    return np.array(times), np.array(wrists), np.array(hands)


def test_the_curve_is_read_with_the_lag_that_was_asked():
    frames = [sample(100.0 + k / 30.0) for k in range(150)]
    t, wrists, hands = played(DelayedCurve(lag=LAG), frames, 5.0, 100.0)
    late = t > 101.0
    np.testing.assert_allclose(wrists[late], wrist(t[late] - LAG), atol=2e-3)
    assert np.abs(np.sum(hands[late] * hand(t[late] - LAG), axis=1)).min() > 0.9999
    off = [np.abs(wrists[late] - wrist(t[late] - lag)).max() for lag in (LAG - 0.03, LAG, LAG + 0.03)]
    assert np.argmin(off) == 1


def test_noise_is_calmed_where_the_newest_frame_is_not():
    rng = np.random.default_rng(0)
    frames = [sample(k / 30.0, rng.normal(0.0, 0.01, 3)) for k in range(200)]
    jerk = {}
    for smooth in (False, True):
        t, wrists, _ = played(DelayedCurve(lag=LAG, smooth=smooth), frames, 6.0, 0.0)
        jerk[smooth] = np.sqrt(np.mean(np.diff(wrists[t > 1.0], 2, axis=0) ** 2))
        lag = LAG if smooth else 0.015
        error = np.sqrt(np.mean((wrists[t > 1.0] - wrist(t[t > 1.0] - lag)) ** 2))
        assert error < (0.0065 if smooth else 0.02)
    assert jerk[True] < 0.25 * jerk[False]


def test_frames_that_come_with_jitter_do_not_make_it_stutter():
    rng = np.random.default_rng(1)
    times = np.cumsum(rng.uniform(0.02, 0.05, 150))
    t, wrists, _ = played(DelayedCurve(lag=LAG), [sample(float(k)) for k in times], 4.0, 0.0)
    speed = np.linalg.norm(np.diff(wrists[t > 1.0], axis=0), axis=1) / DT
    wanted = np.linalg.norm(np.diff(wrist(t[t > 1.0] - LAG), axis=0), axis=1) / DT
    assert np.abs(speed - wanted).max() < 0.5 * wanted.max()


def test_without_new_frames_it_stands_at_the_last_one():
    frames = [sample(k / 30.0) for k in range(60)]
    t, wrists, _ = played(DelayedCurve(lag=LAG), frames, 4.0, 0.0)
    assert np.ptp(wrists[t > 2.2], axis=0).max() == 0.0
    np.testing.assert_allclose(wrists[-1], frames[-1].wrist, atol=4e-3)


def test_before_the_first_frame_there_is_nothing_and_after_it_the_frame():
    playback = DelayedCurve()
    assert playback.now() is None
    playback.add(sample(3.0))
    np.testing.assert_array_equal(playback.now()[0], wrist(np.asarray(3.0)))


def test_a_source_that_begins_anew_is_followed():
    playback = DelayedCurve(lag=LAG)
    played(playback, [sample(50.0 + k / 30.0) for k in range(60)], 2.0, 50.0)
    later = [sample(k / 30.0) for k in range(60)]  # its clock is back at zero
    with pytest.raises(InputError, match="strictly increasing"):
        playback.add(later[0])  # the estimator never lets such a frame through


def test_a_whole_motion_is_read_without_lag():
    frames = [sample(k / 30.0) for k in range(120)]
    playback = DelayedCurve(whole=HandCurve.through(frames))
    t, wrists, _ = played(playback, frames, 3.5, 0.0)
    np.testing.assert_allclose(wrists[50:], wrist(t[50:]), atol=1e-3)


def test_too_few_frames_and_an_impossible_lag_are_refused():
    with pytest.raises(InputError, match="at least 4 frames"):
        HandCurve.through([sample(0.0), sample(0.1)])
    with pytest.raises(InputError, match="lag"):
        DelayedCurve(lag=0.5)
