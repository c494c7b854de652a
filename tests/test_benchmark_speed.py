from __future__ import annotations

import sys
import time
from collections.abc import Callable

import numpy as np
import pytest
from rich.console import Console

from imitarm.benchmark import speed, speed_rows
from imitarm.benchmark.speed import run, show
from imitarm.benchmark.timing import Measurement, Row, measure


def sleeper(seconds: float) -> Callable[[], None]:
    return lambda: time.sleep(seconds)


def test_a_ratio_is_ours_against_the_peer() -> None:
    m = measure(Row("sleep", sleeper(0.003), sleeper(0.03), "slow 1.0", least_ratio=2.0, repeats=3))
    assert m.passed
    assert m.ratio > 2.0
    assert m.target == "at least 2 x"


def test_a_missed_ratio_is_missed() -> None:
    m = measure(Row("sleep", sleeper(0.01), sleeper(0.003), "quick", least_ratio=1.0, repeats=3))
    assert m.passed is False


def test_an_absolute_limit_needs_no_peer() -> None:
    assert measure(Row("quick", sleeper(0.0), most_seconds=1.0, repeats=3)).passed
    slow = measure(Row("slow", sleeper(0.02), most_seconds=0.001, repeats=3))
    assert slow.passed is False
    assert slow.target == "at most 1 ms"
    assert np.isnan(slow.peer)


def test_speed_bought_with_accuracy_does_not_count() -> None:
    m = measure(Row("wrong", sleeper(0.0), most_seconds=1.0, repeats=3, check=lambda: (False, "off by 1 m")))
    assert m.passed is False
    assert m.note == "off by 1 m"


def test_calls_may_time_themselves() -> None:
    m = measure(Row("self", lambda: 2.0, lambda: 8.0, "peer", least_ratio=4.0, repeats=3, self_timed=True))
    assert (m.ours, m.peer, m.ratio, m.passed) == (2.0, 8.0, 4.0, True)


def test_both_sides_are_timed_in_turns() -> None:
    order: list[str] = []

    def ours() -> float:
        order.append("ours")
        return 1.0

    def peer() -> float:
        order.append("peer")
        return 1.0

    measure(Row("turns", ours, peer, repeats=3, self_timed=True))
    assert order == ["ours", "peer"] * 3


def test_a_missing_peer_says_how_to_install_it() -> None:
    def row() -> Row:
        """Something against a peer."""
        raise ModuleNotFoundError("No module named 'nowhere'")

    (m,) = run([row])
    assert m.passed is None
    assert m.name == "Something against a peer."
    assert "nowhere" in m.note
    assert "pip install 'imitarm[bench]'" in m.note


@pytest.mark.parametrize(("verdicts", "status"), [([True], 0), ([True, None], 2), ([None, False, True], 1)])
def test_exit_status(monkeypatch: pytest.MonkeyPatch, verdicts: list[bool | None], status: int) -> None:
    rows = [Measurement("a row", 1e-3, 1e-2, "peer 1", "at least 3 x", v, "a note") for v in verdicts]
    monkeypatch.setattr(speed, "run", lambda: rows)
    assert speed.main() == status


def test_the_table_tells_everything() -> None:
    console = Console(width=200, record=True)
    show(
        [
            Measurement("fit", 2e-3, 9e-3, "peer 1.2", "at least 3 x", True, "better"),
            Measurement("step", 5e-6, float("nan"), "", "at most 1 us", False, ""),
            Measurement("other", float("nan"), float("nan"), "", "", None, "pip install it"),
        ],
        console,
    )
    text = console.export_text()
    for word in ("fit", "2 ms", "9 ms", "peer 1.2", "4.5 x", "met", "5 us", "MISSED", "not measured", "pip install it"):
        assert word in text


def test_every_row_says_what_it_does() -> None:
    assert all(row.__doc__ for row in speed_rows.ROWS)


def test_importing_imitarm_is_measured_in_a_fresh_interpreter() -> None:
    seconds = speed_rows.importing().ours()
    assert 0.0 < seconds < 30.0
    code = f"import sys; print(float({sys.version_info.major}))"
    assert speed_rows._in_fresh_interpreter(code) == sys.version_info.major


def test_the_made_up_motions_are_the_same_every_time() -> None:
    a, b = speed_rows.made_up_demonstrations(3), speed_rows.made_up_demonstrations(3)
    assert len(a) == 8
    for x, y in zip(a, b, strict=True):
        np.testing.assert_array_equal(x.positions, y.positions)


@pytest.mark.parametrize(
    "row", [r for r in speed_rows.ROWS if r.__name__ not in {"importing", "regression_threads_as_installed"}]
)
def test_rows_run_and_their_results_are_good(row: Callable[[], Row]) -> None:
    try:
        made = row()
    except ImportError as error:
        pytest.skip(f"peer not installed: {error}")
    made.ours()
    good, note = made.check()
    assert good, note
