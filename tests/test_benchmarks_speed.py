"""The speed rows of `make bench`, in the folder benchmarks; no test looks at how fast anything is."""

from __future__ import annotations

import itertools
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

import arm_rows
import checkouts
import ik_rows
import retarget_rows
import safety_rows
import speed
import speed_rows
import timing
import tracking_rows
import transmission_rows
from imitarm.transmission.latency import LatencyLog
from speed import run, show, show_changes
from timing import LEAST_PAIRS, Measurement, Ratio, Row, duration, measure, number


def given(*seconds: float) -> Callable[[], float]:
    """A call that reports these durations in turn."""
    durations: Iterator[float] = itertools.cycle(seconds)
    return lambda: next(durations)


def row(ours: Callable[[], float], reference: Callable[[], float], **options: object) -> Row:
    options = {"repeats": 9, "self_timed": True} | options
    return Row("a row", ours, reference, "peer 1.0", **options)  # type: ignore[arg-type]


def test_a_target_is_met_when_the_whole_interval_of_the_ratio_meets_it() -> None:
    faster = measure(row(given(1.0), given(4.0), faster=3.0))
    assert faster.passed and faster.target == "at least 3 times as fast"
    assert faster.ratio == Ratio(4.0, 4.0, 4.0)
    assert measure(row(given(1.0), given(2.0), faster=3.0)).passed is False
    cost = measure(row(given(1.0), given(2.0), cost=0.6))
    assert cost.passed and cost.target == "at most 0.6 times as long"
    assert measure(row(given(1.0), given(1.0), cost=0.6)).passed is False
    unsure = measure(row(given(1.0), given(4.0, 4.0, 2.0), faster=3.0))  # fast in most pairs, not surely in the median
    assert unsure.ratio is not None and unsure.ratio.median == 4.0 and unsure.ratio.low == 2.0
    assert unsure.passed is False


def test_what_slows_both_sides_changes_no_ratio() -> None:
    load = (1.0, 7.0, 2.0, 30.0)
    m = measure(row(given(*load), given(*(3.0 * x for x in load)), faster=2.9, repeats=41))
    assert m.passed and m.ratio is not None
    np.testing.assert_allclose((m.ratio.low, m.ratio.median, m.ratio.high), 3.0)


def test_the_interval_of_the_median_covers_it_about_as_often_as_it_says() -> None:
    rng, covered = np.random.default_rng(0), 0
    for _ in range(300):
        ratio = Ratio.of(np.exp(rng.normal(size=21)).tolist(), [1.0] * 21)
        assert ratio.low <= ratio.median <= ratio.high
        covered += ratio.low <= 1.0 <= ratio.high
    assert covered >= 274  # at least 95 %, less three standard deviations


def test_with_too_few_pairs_there_is_no_interval_and_no_row() -> None:
    times = list(range(1, LEAST_PAIRS + 1))
    enough = Ratio.of(times, [1.0] * LEAST_PAIRS)
    assert (enough.low, enough.high) == (1.0, LEAST_PAIRS)
    with pytest.raises(ValueError, match="pairs"):
        row(given(1.0), given(1.0), faster=1.0, repeats=LEAST_PAIRS - 1)
    for targets in ({}, {"faster": 1.0, "cost": 1.0}):
        with pytest.raises(ValueError, match="one target"):
            row(given(1.0), given(1.0), **targets)


def test_speed_at_the_expense_of_accuracy_does_not_count() -> None:
    m = measure(row(given(1.0), given(2.0), faster=1.5, check=lambda: (False, "off by 1 m")))
    assert m.passed is False
    assert m.note == "off by 1 m"


def test_both_sides_are_timed_in_turns() -> None:
    order: list[str] = []
    measure(row(lambda: order.append("A") or 1.0, lambda: order.append("B") or 1.0, faster=1.0))  # type: ignore[func-returns-value]
    assert order == ["A", "B"] * 9


def test_calls_are_timed_in_blocks_that_the_clock_can_resolve(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 0.0

    def call(seconds: float) -> None:
        nonlocal now
        now += seconds

    monkeypatch.setattr(timing.time, "perf_counter", lambda: now)
    m = measure(Row("clock", lambda: call(1e-4), lambda: call(5e-4), "peer", faster=4.0, repeats=9))
    assert m.ours == pytest.approx(1e-4) and m.reference == pytest.approx(5e-4)
    assert timing.block_size(lambda: call(1e-4)) == 32 and timing.block_size(lambda: call(1.0)) == 1


def test_a_missing_peer_says_how_to_install_it() -> None:
    def needs_a_peer() -> Row:
        """Something against a peer."""
        raise ModuleNotFoundError("No module named 'nowhere'")

    (m,) = run([needs_a_peer])
    assert m.passed is None
    assert m.name == "Something against a peer."
    assert "nowhere" in m.note
    assert "pip install 'imitarm[bench]'" in m.note


@pytest.mark.parametrize(("verdicts", "status"), [([True], 0), ([True, None], 2), ([None, False, True], 1)])
def test_exit_status(monkeypatch: pytest.MonkeyPatch, verdicts: list[bool | None], status: int) -> None:
    ratio = Ratio(3.0, 2.0, 4.0)
    rows = [Measurement("a row", 1e-3, 1e-2, "peer 1", ratio, "at least 3 times", v, "a note") for v in verdicts]
    monkeypatch.setattr(speed, "run", lambda _: rows)
    assert speed.main([]) == status


def test_an_unknown_row_or_checkout_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for words, said in ((["no_such_row"], "rollout"), (["--against", str(tmp_path)], "no src/imitarm")):
        with pytest.raises(SystemExit) as stop:
            speed.main(words)
        assert stop.value.code == 2 and said in capsys.readouterr().err


def test_the_table_shows_everything() -> None:
    console = Console(width=200, record=True)
    show(
        [
            Measurement("fit", 2e-3, 9e-3, "peer 1.2", Ratio(4.5, 4.2, 4.8), "at least 3", True, "better"),
            Measurement("step", 5e-6, 1e-6, "peer", Ratio(5.0, 4.0, 6.0), "at most 1", False, ""),
            Measurement("other", float("nan"), float("nan"), "", None, "", None, "pip install it"),
        ],
        console,
    )
    text = console.export_text()
    for word in ("fit", "2 ms", "9 ms", "peer 1.2", "4.5 (4.2 to 4.8)", "met", "5 us", "MISSED", "not measured", "pip"):
        assert word in text


def test_numbers_are_written_to_be_read() -> None:
    assert [number(x) for x in (0.0301, 0.97, 2.31, 25.4, 2398.0)] == ["0.030", "0.97", "2.3", "25", "2398"]
    assert [duration(x) for x in (2.0, 3e-3, 4e-6)] == ["2 s", "3 ms", "4 us"]


ROW = """
import time
class Row:
    name, self_timed = "a row", True
    def ours(self):
        return {seconds}
def one():
    return Row()
def broken():
    raise ImportError("no such thing")
ROWS = (one, broken)
"""


def fake_checkout(folder: Path, seconds: str) -> Path:
    (folder / "benchmarks").mkdir(parents=True)
    (folder / "benchmarks" / "speed_rows.py").write_text(ROW.format(seconds=seconds))
    return folder


def test_two_checkouts_are_compared_each_with_its_own_rows(tmp_path: Path) -> None:
    before, after = fake_checkout(tmp_path / "before", "2.0"), fake_checkout(tmp_path / "after", "3.0")
    slower, broken = checkouts.compare_checkouts(["one", "broken"], before, this=after, pairs=6)
    assert (slower.before, slower.after, slower.passed) == (2.0, 3.0, False)
    assert slower.ratio == Ratio(1.5, 1.5, 1.5)
    assert broken.passed is None and "this checkout: ImportError: no such thing" in broken.note
    (quicker,) = checkouts.compare_checkouts(["one"], after, this=before, pairs=6)
    assert quicker.passed
    (missing,) = checkouts.compare_checkouts(["one"], fake_checkout(tmp_path / "x", "y"), this=after, pairs=6)
    assert missing.passed is None and "other checkout" in missing.note
    console = Console(width=200, record=True)
    show_changes([slower, broken], console)
    text = console.export_text()
    assert "1.500 (1.500 to 1.500)" in text and "SLOWER" in text and "not measured" in text


def test_a_checkout_that_can_not_be_loaded_is_reported(tmp_path: Path) -> None:
    folder = fake_checkout(tmp_path / "a", "1.0")
    shutil.copytree(folder, tmp_path / "b")
    (folder / "benchmarks" / "speed_rows.py").write_text("raise SystemExit(3)")
    (change,) = checkouts.compare_checkouts(["one"], folder, this=tmp_path / "b", pairs=6)
    assert change.passed is None and "has ended" in change.note


def test_every_row_is_run_says_what_it_does_and_has_a_name_of_its_own() -> None:
    rows = speed_rows.ROWS
    modules = (arm_rows, ik_rows, retarget_rows, safety_rows, tracking_rows, transmission_rows)
    assert {row for module in modules for row in module.ROWS} <= set(rows)
    assert all(make.__doc__ for make in rows)
    assert len({make.__name__ for make in rows}) == len(rows)


def test_a_fresh_interpreter_reports_a_number() -> None:
    made = speed_rows.importing()
    assert made.ours() > 0.0 and made.reference() > 0.0


def test_the_synthetic_motions_are_the_same_every_time() -> None:
    a, b = speed_rows.synthetic_demonstrations(3), speed_rows.synthetic_demonstrations(3)
    assert len(a) == 8
    for x, y in zip(a, b, strict=True):
        np.testing.assert_array_equal(x.positions, y.positions)


SLOW = {"importing", "regression_threads_as_installed", "capture_to_command"}  # fresh interpreters and processes


@pytest.mark.parametrize("make", [make for make in speed_rows.ROWS if make.__name__ not in SLOW])
def test_rows_run_and_their_results_are_good(make: Callable[[], Row]) -> None:
    try:
        made = make()
    except ImportError as error:
        pytest.skip(f"peer not installed: {error}")
    made.ours()
    made.reference()
    good, note = made.check()
    assert (good and note) or not note, note


def test_the_peer_is_asked_for_the_same_motion() -> None:
    made = ik_rows.steps_against_mink()
    assert made.ours().shape == (7,) and made.reference().shape == (9,)  # theirs moves the fingers too
    good, note = made.check()
    assert good, note


def test_only_skeletons_whose_whole_latency_is_known_count() -> None:
    log = LatencyLog()
    stages = dict.fromkeys(("expose", "arrive", "wait", "retarget", "send", "robot"), 0.001)
    log.record(log.add(), **stages, apply=5.0, total=9.0)
    log.record(log.add(), **{name: value for name, value in stages.items() if name != "robot"})
    log.record(log.add(), **(stages | {"wait": 0.004}))
    np.testing.assert_allclose(transmission_rows.complete(log), [0.006, 0.009])


def test_a_latency_counts_only_when_enough_arrived_and_the_arm_followed(monkeypatch: pytest.MonkeyPatch) -> None:
    found = [(np.linspace(0.0, 0.01, 501), 0.9), (np.full(3, 0.001), 0.9), (np.full(999, 0.001), 0.01)]
    monkeypatch.setattr(transmission_rows, "three_processes", lambda: found.pop(0))
    made = transmission_rows.capture_to_command()
    assert made.ours() == pytest.approx(0.009)
    good, note = made.check()
    assert good and "90 %" in note
    made.ours()
    assert not made.check()[0]  # too few came through
    made.ours()
    assert not made.check()[0]  # the arm hardly followed


@pytest.mark.slow
def test_three_processes_pass_skeletons_on_and_the_bare_sockets_do() -> None:
    latencies, fraction = transmission_rows.three_processes()
    assert len(latencies) >= 200 and np.all(latencies > 0.0) and fraction > 0.0
    assert len(transmission_rows.bare_sockets()) == 200
