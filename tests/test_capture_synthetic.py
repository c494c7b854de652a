import time

import numpy as np
import pytest

from imitarm.capture.camera_model import SkeletonCamera
from imitarm.capture.motions import reaching
from imitarm.capture.person import Person
from imitarm.capture.synthetic import MOTIONS, SyntheticSource
from imitarm.errors import InputError, UnknownNameError


def test_one_seed_is_one_recording_in_order_of_time():
    first, second = (list(SyntheticSource.from_seed(5, duration=4.0)) for _ in range(2))
    assert len(first) == len(second) > 100
    assert all(np.array_equal(a.positions, b.positions, equal_nan=True) for a, b in zip(first, second, strict=True))
    assert (np.diff([s.time for s in first]) > 0.0).all()
    assert first[-1].time <= 4.0


def test_people_differ():
    a, b = (next(iter(SyntheticSource.from_seed(seed))) for seed in (1, 2))
    assert np.nanmax(np.abs(a.positions - b.positions)) > 0.02


@pytest.mark.parametrize("kind", MOTIONS)
def test_every_motion_is_seen_and_compared_with_the_truth(kind):
    source = SyntheticSource.from_seed(2, duration=5.0, kind=kind)
    assert source.name == ("synthetic:2" if kind == "inside" else f"synthetic:2:{kind}")
    error = np.array([seen.positions - source.truth(seen.time).positions for seen in source])
    assert 0.005 < np.sqrt(np.nanmean(np.square(error))) < 0.05
    wrist = np.array([source.truth(t).arm().wrist for t in (0.0, 0.9, 2.0, 3.0, 4.0)])
    assert np.linalg.norm(wrist[1] - wrist[0]) < 0.02
    assert np.ptp(wrist, axis=0).max() > 0.05


def test_an_unknown_motion_is_refused():
    with pytest.raises(UnknownNameError, match="circle, edge, eight, inside, wave"):
        SyntheticSource.from_seed(0, kind="dance")


def test_in_real_time_a_frame_waits_for_its_time():
    person = Person.from_seed(0)
    source = SyntheticSource(reaching(person, 0), SkeletonCamera.ideal(), 0.3, realtime=True)
    started = time.monotonic()
    n = len(list(source))
    assert n == 10
    assert time.monotonic() - started > 0.25
    late = SyntheticSource(reaching(person, 0), SkeletonCamera.ideal(rate=1.0), 5.0, realtime=True)
    late.read()
    assert late.read(timeout=0.01) is None
    assert late.read(timeout=-1.0) is None
    assert not late.over


def test_a_duration_of_nothing_is_refused():
    with pytest.raises(InputError, match="duration"):
        SyntheticSource(reaching(Person.from_seed(0), 0), SkeletonCamera.ideal(), 0.0)
