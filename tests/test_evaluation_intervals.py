from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from imitarm.evaluation.intervals import (
    bootstrap,
    compare,
    holm,
    interval,
    median_ratio,
    person_means,
    rate_interval,
    sign_flip_p,
    wilson_interval,
)


def test_an_interval_covers_the_truth_about_as_often_as_it_says():
    """Ten persons of four recordings; persons differ more than recordings do, as they do here."""
    rng = np.random.default_rng(0)
    covered = 0
    for trial in range(400):
        people = rng.normal(3.0, 1.0, 10)
        values = {(p, r): float(people[p] + rng.normal(0.0, 0.3)) for p in range(10) for r in range(4)}
        found = interval(values, seed=trial)
        covered += found.low <= 3.0 <= found.high
    assert 0.89 < covered / 400 < 0.98


def test_recordings_of_one_person_are_not_counted_as_if_they_were_of_many():
    rng = np.random.default_rng(1)
    people = rng.normal(0.0, 1.0, 8)
    few = {(p, 0): float(people[p]) for p in range(8)}
    many = {(p, r): float(people[p]) for p in range(8) for r in range(50)}
    assert interval(few).low == pytest.approx(interval(many).low)
    assert interval(many).used == 400


def test_what_has_no_number_is_left_out_and_counted():
    values = {(0, "a"): 1.0, (0, "b"): math.nan, (1, "a"): 3.0, (2, "a"): math.nan}
    np.testing.assert_array_equal(person_means(values), [1.0, 3.0])
    found = interval(values)
    assert (found.mean, found.persons, found.used, found.of) == (2.0, 2, 2, 4)
    nobody = interval({(0, "a"): math.nan})
    assert math.isnan(nobody.mean)
    assert (nobody.used, nobody.of) == (0, 1)
    alone = interval({(0, "a"): 1.0})
    assert alone.mean == 1.0
    assert math.isnan(alone.low)
    assert not alone.excludes_zero


def test_the_same_seed_gives_the_same_interval():
    x = np.random.default_rng(2).normal(size=9)
    assert bootstrap(x, seed=5) == bootstrap(x, seed=5)
    assert bootstrap(x, seed=5) != bootstrap(x, seed=6)
    low, high = bootstrap(x)
    assert low < x.mean() < high


@given(st.lists(st.floats(0.1, 10.0), min_size=1, max_size=12))
def test_differences_of_one_sign_have_the_least_probability(differences):
    assert sign_flip_p(differences) == pytest.approx(2.0 / 2 ** len(differences))
    assert sign_flip_p([-d for d in differences]) == sign_flip_p(differences)


def test_the_test_is_wrong_as_seldom_as_it_says():
    rng = np.random.default_rng(3)
    p = [sign_flip_p(rng.normal(size=8)) for _ in range(400)]
    assert 0.02 < np.mean(np.array(p) < 0.05) < 0.09
    assert sign_flip_p([]) == 1.0
    assert sign_flip_p(np.zeros(5)) == 1.0
    assert sign_flip_p(rng.normal(2.0, 1.0, 40)) < 0.01  # drawn, not all tried


def test_holm():
    assert holm([0.01, 0.04, 0.03]) == pytest.approx([0.03, 0.06, 0.06])
    assert holm([0.5]) == [0.5]
    assert holm([0.9, 0.8]) == [1.0, 1.0]
    assert holm([]) == []


def test_a_comparison_is_paired():
    """A small but steady difference is seen between persons who differ much."""
    rng = np.random.default_rng(4)
    people = rng.normal(10.0, 5.0, 10)
    theirs = {(p, r): float(people[p] + rng.normal(0.0, 0.05)) for p in range(10) for r in range(3)}
    ours = {key: value - 0.5 + float(rng.normal(0.0, 0.05)) for key, value in theirs.items()}
    found = compare(ours, theirs)
    assert found.difference.excludes_zero
    assert found.difference.mean == pytest.approx(-0.5, abs=0.05)
    assert found.relative == pytest.approx(-0.5 / people.mean(), abs=0.01)
    assert found.p == pytest.approx(2.0 / 2**10)
    ours[0, 0] = math.nan
    assert compare(ours, theirs).difference.used == 29
    below = {key: -value for key, value in theirs.items()}
    assert compare({key: -value for key, value in ours.items()}, below).relative > 0.0  # the sign is the difference's


def trials(rates, repeats=5):
    """Outcomes of persons who succeed in so many of their trials."""
    return {(p, r): float(r < k) for p, k in enumerate(rates) for r in range(repeats)}


COUNTS = st.lists(st.integers(0, 5), min_size=1, max_size=12)
"""Of persons who tried five times each: how often it went well."""


@pytest.mark.parametrize("each", [0, 2, 3, 4, 5])
def test_persons_who_are_all_alike_still_leave_room_for_others(each):
    """Drawing them again would give an interval without width; as many strangers' trials, one that is too narrow."""
    found = rate_interval(trials([each] * 10))
    by_trials, by_persons = wilson_interval(10 * each, 50), wilson_interval(2 * each, 10)
    assert found.mean == pytest.approx(each / 5)
    assert by_trials[1] - by_trials[0] + 0.02 < found.high - found.low < by_persons[1] - by_persons[0] - 0.02


@given(COUNTS)
def test_a_rates_interval_is_between_that_of_trials_and_that_of_persons(counts):
    """Of n persons' trials no fewer count than n and no more than there are."""
    found, rate = rate_interval(trials(counts)), sum(counts) / (5 * len(counts))
    low, high = wilson_interval(sum(counts), 5 * len(counts))
    least, most = wilson_interval(rate * len(counts), len(counts))
    assert least - 1e-12 <= found.low <= low + 1e-12 <= rate + 2e-12
    assert rate - 2e-12 <= high - 1e-12 <= found.high <= most + 1e-12


@given(COUNTS, st.integers(0, 11))
def test_a_failure_more_never_makes_a_claim_firmer(counts, who):
    """Whoever has it; and a success more never makes it likelier that little is possible."""
    before = rate_interval(trials(counts))
    who %= len(counts)
    for more in (-1, 1):
        changed = [count + more * (person == who) for person, count in enumerate(counts)]
        if 0 <= changed[who] <= 5:
            found = rate_interval(trials(changed))
            assert more * (found.low - before.low) >= -1e-9
            assert more * (found.high - before.high) >= -1e-9


@given(st.lists(st.tuples(st.integers(1, 6), st.integers(0, 6)), min_size=1, max_size=8), st.integers(0, 7))
def test_nor_where_persons_have_tried_unequally_often(persons, who):
    persons = [(of, min(of, well)) for of, well in persons]

    def found(failed):
        done = {p: well - (p == failed) for p, (_, well) in enumerate(persons)}
        return rate_interval({(p, r): float(r < done[p]) for p, (of, _) in enumerate(persons) for r in range(of)})

    before, after = found(None), found(who % len(persons))
    assert after.low <= before.low + 1e-9
    assert after.high <= before.high + 1e-9


@pytest.mark.parametrize(
    ("better", "worse"),
    [
        ([5] * 10, [4, *[5] * 9]),  # by the correlation alone, 86 % would become 88 %
        ([4] * 10, [3, *[4] * 9]),
        ([0, *[5] * 9], [0, 4, *[5] * 8]),
        ([1, *[0] * 9], [0] * 10),
    ],
)
def test_results_that_differ_by_one_trial_have_much_the_same_interval(better, worse):
    first, second = rate_interval(trials(better)), rate_interval(trials(worse))
    assert 0.0 <= first.low - second.low < 0.05
    assert 0.0 <= first.high - second.high < 0.05


def test_which_trial_of_whom_it_was_and_what_was_not_tried_make_no_difference():
    found, turned = rate_interval(trials([5, 3, 0, 4])), rate_interval(trials([0, 4, 5, 3]))
    assert (turned.low, turned.high) == pytest.approx((found.low, found.high))
    missing = {(9, r): math.nan for r in range(3)}
    assert rate_interval({**trials([5, 3, 0, 4]), **missing}).low == found.low
    assert rate_interval({**trials([5, 3, 0, 4]), **missing}).of == found.of + 3
    assert math.isnan(rate_interval(missing).mean)


def test_the_more_persons_differ_the_less_their_trials_tell():
    ends = [rate_interval(trials(counts * 2)) for counts in ([3] * 5, [1, 1, 3, 5, 5], [0, 0, 5, 5, 5])]
    alike, different, opposite = (found.high - found.low for found in ends)
    assert alike < 0.9 * different < 0.81 * opposite


def test_trials_of_one_person_count_for_one_person():
    few = rate_interval(trials([1, 0, 1, 1, 0, 1, 0, 1], repeats=1))
    many = rate_interval(trials([20, 0, 20, 20, 0, 20, 0, 20], repeats=20))
    assert many.high - many.low > 0.9 * (few.high - few.low)
    assert math.isnan(rate_interval({}).mean)


@pytest.mark.parametrize(
    ("rate", "alike"), [(0.94, 0.1), (0.86, 0.4), (0.5, 0.4), (0.06, 0.1), (0.5, 0.02), (0.9, 0.8), (0.2, 0.7)]
)
def test_a_rates_interval_covers_the_truth_where_persons_differ(rate, alike):
    """Rates of persons are drawn from a beta distribution; ``alike`` is the correlation of one person's trials."""
    rng = np.random.default_rng(5)
    spread = (1.0 - alike) / alike
    covered, by_trials = 0, 0
    for _ in range(400):
        done = rng.binomial(5, rng.beta(rate * spread, (1.0 - rate) * spread, 10))
        found = rate_interval(trials(done))
        covered += found.low <= rate <= found.high
        low, high = wilson_interval(int(done.sum()), 50)
        by_trials += low <= rate <= high
    assert covered / 400 > 0.86
    assert covered >= by_trials


def test_a_ratio_of_medians_is_resampled_in_pairs():
    theirs = np.exp(np.random.default_rng(0).normal(size=200))
    assert median_ratio(1.1 * theirs, theirs) == pytest.approx((1.1, 1.1, 1.1))
    ratio, low, high = median_ratio(np.random.default_rng(1).permutation(1.1 * theirs), theirs)
    assert ratio == pytest.approx(1.1)
    assert low < 1.05 < 1.15 < high  # values of different cases vary independently
    assert median_ratio([2.0], [4.0])[0] == 0.5
    assert math.isnan(median_ratio([2.0], [4.0])[1])
    assert all(map(math.isnan, median_ratio([], [])))


def test_the_interval_of_a_ratio_of_medians_covers_the_truth_about_as_often_as_it_says():
    rng, covered = np.random.default_rng(3), 0
    for seed in range(100):
        scale = np.exp(rng.normal(size=60))
        ours, theirs = (scale * np.exp(0.3 * rng.normal(size=60)) for _ in range(2))
        _, low, high = median_ratio(ours, theirs, seed=seed)
        covered += low <= 1.0 <= high
    assert 88 <= covered <= 100
