"""The real-time benchmark: four processes, their end, the clock of the scenes, and the counted deadlines."""

from __future__ import annotations

import multiprocessing
from collections import deque
from dataclasses import replace

import numpy as np
import pytest

from imitarm import cli
from imitarm.benchmark import real_time
from imitarm.benchmark.real_time import Processes, Shared, run_real_time
from imitarm.benchmark.real_time_control import TimedLoop
from imitarm.benchmark.real_time_results import RealTimeResult
from imitarm.benchmark.real_time_world import RealTimeSetup, _reversed
from imitarm.demonstrations import read
from imitarm.errors import FileFormatError, InputError, TaskFailedError, UnknownNameError
from imitarm.scene import Sphere
from imitarm.tasks.sweep import DEMONSTRATIONS

SETUP = RealTimeSetup(duration=2.0, rate=100.0, rows=60)


# --- the whole benchmark


@pytest.fixture(scope="module")
def measured():
    """The result of a short run."""
    before = set(multiprocessing.active_children())  # the workers of other tests
    result = run_real_time(SETUP)
    assert set(multiprocessing.active_children()) <= before
    return result


@pytest.mark.slow
def test_every_period_is_counted_and_nothing_is_touched(measured):
    n = len(measured.late)
    assert n > 0
    assert measured.periods == n + measured.control["skipped"] >= 200
    assert len(measured.computed) == len(measured.control["worked"]) == len(measured.control["ages"]) == n
    assert (measured.late >= 0.0).all() and (measured.late < SETUP.dt).all()
    assert (measured.computed > 0.0).all()
    assert (1e-9 * np.array(measured.control["worked"]) >= measured.computed).all()
    assert min(measured.control["ages"]) >= 0.0
    assert measured.control["skipped"] <= measured.missed <= measured.periods
    assert measured.contacts == [] and measured.simulation["clearance"] > 0.0
    assert measured.simulation["accepted"] > 0
    assert 0 <= measured.simulation["missed"] < measured.simulation["periods"]
    assert len(measured.camera["seconds"]) == measured.camera["images"]
    assert len(measured.tracker["seconds"]) == measured.tracker["updates"]
    assert sum(motion["steps"] for motion in measured.control["motions"]) == n


@pytest.mark.slow
def test_a_result_is_saved_and_shown_again(measured, tmp_path, capsys):
    file, picture, page, document = (tmp_path / name for name in ("r.json", "r.png", "r.html", "d.md"))
    measured.write(file)
    again = RealTimeResult.read(file)
    assert again.setup == SETUP and again.control == measured.control and again.simulation == measured.simulation
    assert [table.markdown() for table in again.tables()] == [table.markdown() for table in measured.tables()]
    document.write_text("# Page\n<!-- imitarm benchmark real-time -->\n<!-- end -->\n")
    words = ["--figure", str(picture), "--report", str(page), "--fill", str(document)]
    assert cli.main(["benchmark", "real-time", "--saved", str(file), *words]) == 0
    assert "Deadlines of the control loop" in capsys.readouterr().out
    assert "Deadlines of the control loop" in document.read_text()
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert "deadlines were missed" in page.read_text() and "<svg" in page.read_text()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["d.md", "r.html", "r.json", "r.png"]


def test_wrong_options_are_named(tmp_path, capsys):
    for words, message in (
        (["--rate", "2000"], "rate must be"),
        (["--duration", "0"], "duration must be"),
        (["--saved", str(tmp_path / "none.json")], "is not a result of"),
        (["--saved", "a", "--out", str(tmp_path / "o.json")], "--out can't be used with --saved"),
    ):
        assert cli.main(["benchmark", "real-time", *words]) == 2
        assert message in capsys.readouterr().err
    with pytest.raises(UnknownNameError, match="policy"):
        RealTimeSetup(policy="none")


def test_a_file_of_another_kind_is_refused(tmp_path):
    file = tmp_path / "r.json"
    for text in ("", "[]", "{}", '{"format": "imitarm-real-time", "version": 2}'):
        file.write_text(text)
        with pytest.raises(FileFormatError, match="is not a result of"):
            RealTimeResult.read(file)


# --- processes


@pytest.fixture
def start(monkeypatch):
    """Return a function that starts processes, each with a function of real_time_roles."""

    before = set(multiprocessing.active_children())  # the workers of other tests

    def starter(processes, **functions):
        for name, function in functions.items():
            monkeypatch.setitem(real_time.ROLES, name, f"real_time_roles:{function}")
        connections = {}
        if "read" in functions.values():  # it loses its connection when the camera process ends
            connections["tracker"], connections["camera"] = processes.pipe()
        for name in functions:
            processes.start(name, "setup", *([connections[name]] if name in connections else []))

    yield starter
    assert set(multiprocessing.active_children()) <= before


def test_processes_return_their_results(start):
    with Processes() as processes:
        start(processes, camera="wait", tracker="wait")
        processes.shared.stop()
        assert processes.result("camera") == processes.result("tracker") == {"setup": "setup"}


@pytest.mark.parametrize(
    ("function", "message"),
    [
        ("die", r"the camera process ended unexpectedly \(signal SIGKILL\)"),
        ("fail", "the camera process failed: the lens is dirty"),
        ("crash", "the camera process failed: ZeroDivisionError: one over nothing"),
    ],
)
def test_the_process_that_failed_is_named_and_all_others_end(start, function, message):
    with pytest.raises(TaskFailedError, match=message), Processes() as processes:
        start(processes, camera=function, tracker="read", control="wait")
        processes.result("control")


def test_an_interruption_ends_all_processes(start):
    with pytest.raises(KeyboardInterrupt), Processes() as processes:
        start(processes, camera="hang", tracker="wait")
        raise KeyboardInterrupt


# --- the clock of the scenes, and deadlines


class Connection(deque):
    """The receiving end of a pipe."""

    def recv(self):
        """Return the oldest message."""
        return self.popleft()


class Robot:
    """A robot to which nothing is sent."""

    sent = 0


def test_a_shared_state_is_read_as_it_was_written():
    shared = Shared(multiprocessing.get_context("spawn"))
    q = np.linspace(-1.0, 1.0, 7)
    shared.publish(1.25, q)
    time, read_q = shared.state(7)
    assert time == shared.time == 1.25
    np.testing.assert_array_equal(read_q, q)
    assert not shared.started and not shared.stopping
    shared.start()
    assert shared.started and not shared.measuring
    shared.measure()
    assert shared.started and shared.measuring and not shared.stopping
    shared.stop()
    shared.measure()
    shared.start()
    assert shared.stopping


def test_scenes_are_on_the_clock_of_the_loop_also_after_missed_periods():
    shared, scenes, robot = Shared(multiprocessing.get_context("spawn")), Connection(), Robot()
    loop = TimedLoop(shared, scenes, robot, 0.001)
    ball = Sphere([0.0, 0.0, 0.0], 0.1, velocity=[0.1, 0.0, 0.0])

    def track(now, stamp):
        shared.publish(now, np.zeros(7))
        scenes.append((stamp, (ball,)))
        shared.scenes += 1

    track(5.00, 4.96)
    assert loop.observe(0.0).stamp == pytest.approx(-0.04)  # of the reset
    assert loop.observe(0.0).stamp == pytest.approx(-0.04)
    track(5.40, 5.35)  # 0.3 s of periods were missed: the loop is only at 0.1 s
    track(5.40, 5.37)
    assert loop.observe(0.1).stamp == pytest.approx(0.07)
    shared.publish(5.41, np.zeros(7))
    assert loop.observe(0.101).stamp == pytest.approx(0.07)  # no new scene: the stamp stays, so a watchdog notices
    loop.begin()
    shared.publish(5.50, np.zeros(7))
    assert loop.observe(0.0).stamp == pytest.approx(-0.13)
    assert loop.late == [] and loop.periods == loop.skipped  # no command was sent


def test_deadlines_are_missed_by_late_commands_and_by_periods_without_a_step():
    ms = 1_000_000
    control = {"late": [0, ms // 2, 0, 0], "computed": [ms // 2, ms // 2 + 1, ms // 2, 3 * ms], "skipped": 2}
    result = RealTimeResult(SETUP, "", "", {}, {}, {}, control)
    result = replace(result, setup=replace(SETUP, rate=1000.0))
    assert (result.periods, result.missed) == (6, 4)
    np.testing.assert_allclose(result.sent, [0.5e-3, 1.000001e-3, 0.5e-3, 3e-3])


# --- the world


def test_the_obstacles_cross_the_path_and_depend_on_the_seed():
    truth = SETUP.truth()
    places = np.array([truth.poses(time)[0] for time in np.linspace(0.0, 20.0, 400)])
    assert (places[:, :, 0].min(axis=0) < 0.6).all() and (places[:, :, 0].max(axis=0) > 0.85).all()
    assert np.ptp(places[:, :, 1:], axis=0).max() < 1e-12
    assert not np.allclose(places[0], replace(SETUP, seed=1).truth().poses(0.0)[0])


def test_a_reversed_demonstration_goes_back():
    one = read(DEMONSTRATIONS)[0]
    back = _reversed(one)
    np.testing.assert_array_equal(back.trajectory.positions, one.trajectory.positions[::-1])
    np.testing.assert_array_equal(back.joints, one.joints[::-1])
    np.testing.assert_allclose(np.diff(back.trajectory.times), np.diff(one.trajectory.times)[::-1])
    np.testing.assert_allclose(_reversed(back).trajectory.times, one.trajectory.times - one.trajectory.times[0])


def test_the_setup_is_checked():
    with pytest.raises(InputError, match="rows"):
        RealTimeSetup(rows=10)
    assert RealTimeSetup(rate=1000.0).dt == 0.001
