import numpy as np
import pytest

from imitarm.capture.motions import DRAWINGS, drawing
from imitarm.capture.person import Person
from imitarm.errors import InputError, UnknownNameError

STEADY = [
    Person(**{**p.__dict__, "tremor": 0.0 * p.tremor, "sway": 0.0 * p.sway}) for p in map(Person.from_seed, range(3))
]


@pytest.mark.parametrize("kind", DRAWINGS)
@pytest.mark.parametrize("person", STEADY)
def test_a_drawing_begins_and_ends_at_rest_and_never_jerks(person, kind):
    truth, dt = drawing(person, 1, duration=8.0, kind=kind), 0.02
    path = np.array([truth(t).arm().wrist for t in np.arange(0.0, 9.0, dt)])
    velocity = np.diff(path, axis=0) / dt
    speed = np.linalg.norm(velocity, axis=1)
    assert speed[:50].max() < 1e-9
    assert speed[401:].max() < 1e-9
    assert 0.1 < speed[120:320].mean() < 1.0
    assert speed.max() < 1.6
    assert np.abs(np.diff(velocity, axis=0)).max() / dt < 12.0
    reach = np.linalg.norm(path - person.shoulder("right"), axis=1)
    assert reach.max() < 0.97 * person.reach
    assert path[:, 2].max() < person.shoulder("right")[2] - 0.1  # before the body


def test_a_circle_is_round_and_an_eight_crosses_itself():
    person = STEADY[0]
    times = np.arange(2.0, 11.0, 0.02)
    circle = np.array([drawing(person, 0, kind="circle")(t).arm().wrist[:2] for t in times])
    middle = 0.5 * (circle.max(axis=0) + circle.min(axis=0))
    radius = np.linalg.norm(circle - middle, axis=1)
    assert radius.std() < 0.002
    assert 0.07 < radius.mean() < 0.13
    eight = np.array([drawing(person, 0, kind="eight")(t).arm().wrist[:2] for t in times])
    wide, high = np.ptp(eight, axis=0)
    assert high == pytest.approx(0.5 * wide, rel=0.01)


def test_one_seed_is_one_drawing():
    a, b, other = (drawing(STEADY[0], seed)(3.0).positions for seed in (4, 4, 5))
    np.testing.assert_array_equal(a, b)
    assert np.abs(a - other).max() > 0.005


def test_unknown_shapes_and_short_times_are_refused():
    with pytest.raises(UnknownNameError, match="circle, eight, wave"):
        drawing(STEADY[0], 0, kind="square")
    with pytest.raises(InputError, match="duration"):
        drawing(STEADY[0], 0, duration=1.0)
