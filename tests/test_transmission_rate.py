from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from imitarm.errors import InputError
from imitarm.transmission.rate import RateLimiter
from wire_samples import MS, Clock


class Time(Clock):
    """A clock that sleeping sets on, a little too far as systems do."""

    def __init__(self, late=0):
        super().__init__()
        self.late = late

    def sleep(self, seconds):
        self.ns += round(1e9 * seconds) + self.late


def test_it_does_not_drift():
    time = Time(late=300_000)
    limiter = RateLimiter(0.01, clock_ns=time, sleep=time.sleep)
    begin = time.ns
    for _ in range(1001):
        limiter.wait()
        time.ns += 2 * MS
    assert limiter.ticks == 1001 and limiter.overruns == 0
    assert abs(time.ns - begin - 1000 * 10 * MS) <= 3 * MS


@given(work=st.lists(st.integers(0, 80), min_size=1, max_size=40))
def test_missed_ticks_are_left_out_and_counted_and_the_rhythm_stays(work):
    time = Time()
    limiter = RateLimiter(0.01, clock_ns=time, sleep=time.sleep)
    begin = time.ns
    for made, busy in enumerate(work, start=1):
        missed = limiter.wait()
        assert limiter.ticks == made + limiter.overruns
        late = (time.ns - begin) - (limiter.ticks - 1) * 10 * MS
        assert 0 <= late < 10 * MS
        assert missed == 0 or late + missed * 10 * MS >= 10 * MS
        time.ns += busy * MS


def test_the_first_tick_is_now():
    time = Time()
    limiter = RateLimiter(0.5, clock_ns=time, sleep=time.sleep)
    assert limiter.remaining == 0.0 and limiter.wait() == 0
    assert abs(limiter.remaining - 0.5) < 1e-9


@pytest.mark.parametrize("period", [0.0, -0.01, float("nan"), float("inf"), 1e-10, "10 ms", None])
def test_a_period_that_is_none_is_refused(period):
    with pytest.raises(InputError, match="RateLimiter: period"):
        RateLimiter(period)


def test_the_delay_of_a_period_is_reported():
    time = Time(late=300_000)
    limiter = RateLimiter(0.01, clock_ns=time, sleep=time.sleep)
    limiter.wait()
    assert limiter.late == 0.0
    limiter.wait()
    assert limiter.late == pytest.approx(0.0003)
    time.ns += 24 * MS
    assert limiter.wait() == 1
    assert limiter.late == pytest.approx(0.0043)
