"""The tracking benchmark: errors, consistency and margins on real and on synthetic motion."""

from __future__ import annotations

import re

import numpy as np
import pytest

from imitarm import cli
from imitarm.benchmark import tracking, tracking_margins
from imitarm.benchmark.tracked_motions import captured_arm, captured_trolley, recorded_motions
from imitarm.benchmark.tracking import SENSOR, TrackLog, follow
from imitarm.benchmark.tracking_margins import TIMES, margin_table, recorded_windows, synthetic_windows
from imitarm.benchmark.tracking_report import tracking_report_html
from imitarm.errors import FileFormatError
from imitarm.evaluation.intervals import block_bootstrap
from imitarm.perception import CoverageMargin, ObstacleTracker


def rms(errors):
    return float(np.sqrt((errors**2).sum(axis=1).mean()))


@pytest.fixture(scope="module")
def motions(real_data):
    return recorded_motions(real_data)


def test_the_recordings_are_at_the_stated_scale(motions):
    arm, trolley = motions
    upper, fore = arm.scene.scene.obstacles
    lengths = [np.linalg.norm(o.end - o.start) for o in (upper, fore)]
    assert 0.2 < min(lengths) < max(lengths) < 0.4
    assert arm.duration == pytest.approx(60.0, abs=0.1)
    speed = np.linalg.norm(trolley.velocities[0], axis=1)
    assert np.median(speed) == pytest.approx(0.22, abs=0.05)
    for motion in motions:
        for i in range(len(motion.names)):
            times = np.linspace(1.0, motion.duration - 1.0, 50)
            position, velocity = motion.at(i, times)
            earlier, later = motion.at(i, times - 0.02)[0], motion.at(i, times + 0.02)[0]
            np.testing.assert_allclose((later - earlier) / 0.04, velocity, atol=0.03)
            np.testing.assert_allclose(motion.scene.poses(times[3])[0][i], position[3], atol=1e-9)


@pytest.mark.parametrize("model", ["constant-velocity", "imm"])
def test_real_motion_is_followed_with_the_stated_uncertainty(motions, model):
    """The estimate is nearer to the truth and lags less than the detections; NIS and NEES are near their values."""
    noises = {"imm": ((0.005, 1.0), (0.002, 0.3)), "constant-velocity": (0.015, 0.002)}[
        model
    ]  # as docs/tracking.md has
    for motion, noise in zip(motions, noises, strict=True):
        found = follow(motion, ObstacleTracker(model, process_noise=noise), part=(0.5, 0.8))
        for log in found.logs:
            used = log.settled
            assert used.mean() > 0.9
            assert rms((log.predicted - log.truth)[used]) < 0.85 * rms((log.raw - log.truth)[used])
            assert rms((log.estimated_velocity - log.velocity)[used]) < 0.12
            assert abs(log.lag(log.predicted)) < 0.02 < log.lag(log.raw)
        assert found.nis.mean() == pytest.approx(found.expected_nis, abs=0.45)
        assert 3.0 < found.nees.mean() < 8.0


def test_the_lag_of_a_delayed_copy_is_its_delay():
    times = np.arange(0.0, 10.0, 0.02)
    truth = np.stack([np.sin(times), np.cos(times), 0.0 * times], axis=1)
    velocity = np.stack([np.cos(times), -np.sin(times), 0.0 * times], axis=1)
    late = np.stack([np.sin(times - 0.03), np.cos(times - 0.03), 0.0 * times], axis=1)
    nothing = np.zeros((len(times), 3))
    log = TrackLog(times, truth, velocity, late, late, late, nothing, times, np.zeros(len(times), dtype=np.int64))
    assert log.lag(late) == pytest.approx(0.03, abs=1e-4)


@pytest.mark.slow
def test_margins_cover_synthetic_windows():
    """The command tests 5000 windows; these are fewer, with three standard deviations of both samples."""
    n = 600
    calibration, test = (synthetic_windows(n, stream) for stream in (0, 1))
    assert calibration.shape == test.shape == (n, len(TIMES))
    assert not (calibration[:, :1] == test[:, :1].T).any()
    margin = CoverageMargin.calibrate(calibration, 0.95, times=TIMES)
    assert margin.covered(test, TIMES).mean() == pytest.approx(0.95, abs=3.0 * np.sqrt(0.95 * 0.05 * (1 / n + 1.4 / n)))
    np.testing.assert_array_equal(synthetic_windows(40, 1), test[:40])


def test_margins_cover_real_motion(motions):
    arm = motions[0]
    before, after = (recorded_windows(arm, part) for part in ((0.0, 0.5), (0.5, 1.0)))
    margin = CoverageMargin.calibrate(before.errors, 0.95, times=TIMES)
    covered = margin.covered(after.errors, TIMES).astype(float)
    low, high = block_bootstrap(covered, after.starts, 2.0)
    assert low < 0.95 < high


def test_block_bootstrap_is_wider_for_correlated_values():
    rng = np.random.default_rng(0)
    times = np.arange(2000) / 30.0
    white = rng.normal(size=2000)
    slow = np.repeat(rng.normal(size=67), 30)[:2000]
    widths = [np.diff(block_bootstrap(x, times, 2.0))[0] for x in (white, slow)]
    assert widths[0] == pytest.approx(4 * 1.96 / 2 / np.sqrt(2000) * 1.0, rel=0.3)
    assert widths[1] > 3.0 * widths[0]
    assert np.isnan(block_bootstrap([], [], 1.0)).all()
    assert np.isnan(block_bootstrap([1.0, 2.0], [0.0, 0.1], 1.0)).all()


def test_files_that_are_not_recordings_are_named(tmp_path):
    with pytest.raises(FileFormatError, match=r"recording\.tsv"):
        captured_arm(tmp_path)
    (tmp_path / "mocap_trolley").mkdir()
    (tmp_path / "mocap_trolley" / "mid.csv").write_text("time,x\nnow,1\n")
    with pytest.raises(FileFormatError, match=r"mid\.csv"):
        captured_trolley(tmp_path)


@pytest.mark.slow
def test_the_command_prints_and_fills_tables(tmp_path, capsys, monkeypatch, motions):
    page = tmp_path / "page.md"
    page.write_text("# Page\n<!-- imitarm benchmark tracking -->\n<!-- end -->\n")
    assert cli.main(["benchmark", "tracking", "--windows", "200", "--fill", str(page)]) == 0
    assert "Coverage of margins" in page.read_text()
    assert "real motion is left out" in re.sub(r"\s+", " ", "".join(capsys.readouterr()))
    assert cli.main(["benchmark", "tracking", "--windows", "3"]) == 2
    monkeypatch.setattr(tracking, "NOISE_GRID", {name: values[:1] for name, values in tracking.NOISE_GRID.items()})
    monkeypatch.setattr(tracking, "MOTIONS", {"constant-velocity": (1,)})
    tables = tracking.tracking_tables(motions[1:])
    assert [row[1] for row in tables[0].rows][-1] == "constant-velocity"
    assert len(tables[1].rows) == 1
    html = tracking_report_html(motions[1:], tables, sensor=SENSOR, provenance={"code": "x"})
    assert "for 1 of 1 obstacles, the estimate is nearer to the true position" in html
    assert "Fig 5.9: position of the trolley" in html
    assert "margin of synthetic windows" in html
    assert "<svg" in html


@pytest.mark.slow
def test_the_table_of_margins_names_what_it_was_tested_on(motions):
    table = margin_table(200, motions[1:], SENSOR)
    assert table.rows[0][0] == "200 synthetic windows"
    assert table.rows[-1][0] == "trolley, second half"
    assert tracking_margins.COVERAGE == 0.95
