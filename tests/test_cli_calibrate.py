from __future__ import annotations

import builtins
import itertools
import time

import numpy as np
import pytest

from imitarm.capture.person import Person
from imitarm.capture.recording import SkeletonRecording
from imitarm.capture.skeleton import JOINT, JOINTS, Skeleton, SkeletonSource, Tracking
from imitarm.cli import main
from imitarm.kinematics.pose import Pose
from imitarm.retarget.calibration import Calibration
from imitarm.retarget.correspondence import FACING
from recording_samples import Listed, skeletons

POINTS = [[0.5, -0.3, 0.2], [0.7, 0.0, 0.4], [0.5, 0.3, 0.2], [0.4, 0.1, 0.6], [0.6, -0.2, 0.5]]
SENSOR = Pose([2.5, 0.1, 0.9], FACING.quaternion)


@pytest.fixture
def inside(tmp_path, monkeypatch):
    """Work in an empty folder."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def answers(monkeypatch, *given):
    """Answer what is asked; then the input ends. Returns what is left."""
    left = list(given)

    def answer():
        if not left:
            raise EOFError
        return left.pop(0)

    monkeypatch.setattr(builtins, "input", answer)
    return left


class Touching(SkeletonSource):
    """A live source that sees a hand at one place after the other, as often as Enter was pressed."""

    name = "webcam:0"
    over = False

    def __init__(self, left, places):
        self.left, self.places, self.n = left, places, len(left)
        self.count = itertools.count()
        self.body = skeletons(1)[0].positions

    def read(self, timeout=1.0):
        if timeout == 0.0:
            return None
        tick = next(self.count)
        if tick % 40 == 0:  # so that time passes
            return None
        place, shake, tracking = self.places[min(self.n - len(self.left), len(self.places)) - 1]
        time.sleep(0.001)
        positions = self.body.copy()
        positions[JOINT["hand_right"]] = SENSOR.inverse().apply(place) + [shake * (-1) ** tick, 0, 0]
        states = np.full(len(JOINTS), Tracking.TRACKED)
        states[JOINT["hand_right"]] = tracking
        return Skeleton(tick / 30, positions, states)


def touching(monkeypatch, given, places):
    """Let the user press keys, and a hand be in places."""
    places = [place if isinstance(place, tuple) else (place, 0.0, Tracking.TRACKED) for place in places]
    left = answers(monkeypatch, *given)
    monkeypatch.setattr("imitarm.cli.calibrate.open_source", lambda word, realtime=False: Touching(left, places))
    np.savetxt("points.csv", POINTS, delimiter=",")
    return main(["calibrate", "sensor", "--source", "webcam:0", "--points", "points.csv", "--seconds", "0.08"])


# --- limbs


def test_limbs_of_a_recording(inside, capsys):
    SkeletonRecording(skeletons(90, seed=5)).save("a.csv")
    assert main(["calibrate", "limbs", "a.csv"]) == 0
    found, person = Calibration.load("calibration.json"), Person.from_seed(5)
    assert found.lengths.upper_arm == pytest.approx(person.upper_arm, abs=1e-3)
    assert found.lengths.forearm == pytest.approx(person.forearm, abs=1e-3)
    assert f"{100 * person.upper_arm:.1f} cm" in capsys.readouterr().out


def test_real_gestures_give_the_same_person_every_time(inside, real_data):
    lengths = []
    for path in sorted((real_data / "kinect_gestures").glob("*.csv")):
        assert main(["calibrate", "limbs", str(path)]) == 0
        lengths.append(Calibration.load("calibration.json").lengths)
    assert np.ptp([one.upper_arm for one in lengths]) < 0.04 and np.ptp([one.forearm for one in lengths]) < 0.04


def test_limbs_that_are_not_known_well_enough_are_not_written(inside, capsys):
    rng = np.random.default_rng(0)
    shaken = []
    for s in skeletons(20):
        positions = s.positions + rng.normal(0.0, 0.03, (25, 3))
        shaken.append(Skeleton(s.time, positions))
    SkeletonRecording(shaken).save("a.csv")
    assert main(["calibrate", "limbs", "a.csv"]) == 1
    assert "mm, but at most 5 mm are accepted" in capsys.readouterr().err
    SkeletonRecording(shaken[:3]).save("b.csv")
    assert main(["calibrate", "limbs", "b.csv"]) == 1
    assert "fully tracked in 3 of 3 frames" in capsys.readouterr().err
    assert not (inside / "calibration.json").exists()


def test_a_live_person_is_told_what_to_do_and_tried_again(inside, monkeypatch, capsys):
    good = skeletons(60)
    tries = iter([good[:3], good])
    source = Listed([])

    def gather(*args, **options):
        return next(tries), False

    monkeypatch.setattr("imitarm.cli.calibrate.gather", gather)
    monkeypatch.setattr("imitarm.cli.calibrate.open_source", lambda word: source)
    left = answers(monkeypatch, "", "")
    assert main(["calibrate", "limbs", "webcam:0", "--seconds", "1"]) == 0
    text = capsys.readouterr().err
    assert "face it" in text and "Try again" in text and text.count("Press Enter to measure for 1 s") == 2
    assert not left and source.closed


# --- sensor


def pairs(points=POINTS, sigma=0.0):
    base = np.array(points, dtype=float)
    return np.hstack([SENSOR.inverse().apply(base) + sigma * np.random.default_rng(0).normal(size=base.shape), base])


@pytest.mark.parametrize("header", ["", "sensor_x,sensor_y,sensor_z,base_x,base_y,base_z"])
def test_a_table_of_pairs(inside, capsys, header):
    np.savetxt("pairs.csv", pairs(), delimiter=",", header=header, comments="")
    assert main(["calibrate", "sensor", "pairs.csv"]) == 0
    found = Calibration.load("calibration.json")
    np.testing.assert_allclose(found.sensor_to_base.position, SENSOR.position, atol=1e-6)
    assert found.sensor_rms < 1e-6 and "250.0 10.0 90.0 cm" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("rows", "status", "message"),
    [
        (pairs(np.linspace([0.3, 0, 0], [0.8, 0.3, 0.2], 5)), 2, "lie on a line"),
        (pairs()[:3], 2, "at least 4"),
        (pairs() * [1, 1, 1, 100, 100, 100], 2, "times as far apart"),
        (pairs(sigma=0.05), 1, "Nothing was written"),
        (pairs()[:, :5], 2, "5 columns; needed: sensor_x"),
    ],
)
def test_points_that_will_not_do_are_refused_and_nothing_is_lost(inside, capsys, rows, status, message):
    Calibration(scale=1.2).save("calibration.json")
    before = (inside / "calibration.json").read_bytes()
    np.savetxt("pairs.csv", rows, delimiter=",")
    assert main(["calibrate", "sensor", "pairs.csv"]) == status
    assert message in capsys.readouterr().err and (inside / "calibration.json").read_bytes() == before


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["limbs", "a.csv", "--out", "a.csv"], "--out a.csv: is also the file of SOURCE"),
        (["sensor", "a.csv", "--out", "a.csv"], "--out a.csv: is also the file of PAIRS"),
        (["sensor", "--source", "webcam:0", "--points", "a.csv", "--out", "a.csv"], "is also the file of --points"),
        (["clutch", "--out", "folder"], "--out folder: is a folder; name a file in it"),
        (["clutch", "--out", "no/a.json"], "there is no folder no"),
    ],
)
def test_what_is_measured_from_is_not_written_over(inside, capsys, words, message):
    (inside / "a.csv").write_text("precious")
    (inside / "folder").mkdir()
    assert main(["calibrate", *words]) == 2
    assert message in capsys.readouterr().err
    assert (inside / "a.csv").read_text() == "precious" and not list((inside / "folder").iterdir())


def test_a_column_that_is_missing_is_named(inside, capsys):
    (inside / "pairs.csv").write_text("sensor_x,sensor_y,sensor_z,base_x,base_y,z\n" + "1,2,3,4,5,6\n" * 4)
    assert main(["calibrate", "sensor", "pairs.csv"]) == 2
    assert "has no column 'base_z'" in capsys.readouterr().err
    assert main(["calibrate", "sensor"]) == main(["calibrate", "sensor", "--points", "pairs.csv"]) == 2
    assert "guided calibration" in capsys.readouterr().err


def test_the_guided_way(inside, monkeypatch, capsys):
    assert touching(monkeypatch, [""] * 5, POINTS) == 0
    np.testing.assert_allclose(Calibration.load("calibration.json").sensor_to_base.position, SENSOR.position, atol=1e-9)
    text = capsys.readouterr().err
    assert (
        "Point 1 of 5: tool at 50.0 -30.0 20.0 cm; put your hand on the tool and press Enter" in text
        and "palm of your right hand" in text
    )


def test_a_hand_that_moves_or_is_not_seen_is_measured_again(inside, monkeypatch, capsys):
    places = [(POINTS[0], 0.05, Tracking.TRACKED), (POINTS[0], 0.0, Tracking.INFERRED), *POINTS]
    assert touching(monkeypatch, [""] * 7, places) == 0
    text = capsys.readouterr().err
    assert "the hand moved by 5.0 cm; hold the hand still. Try again" in text
    assert "the right hand was seen in only 0 of" in text


def test_the_point_that_does_not_fit_is_touched_again(inside, monkeypatch, capsys):
    wrong = [POINTS[0], [0.7, 0.15, 0.4], *POINTS[2:], POINTS[1]]
    assert touching(monkeypatch, [""] * 6, wrong) == 0
    assert "point 2 is" in capsys.readouterr().err
    assert Calibration.load("calibration.json").sensor_rms < 1e-9


def test_a_point_may_be_skipped_but_not_too_many(inside, monkeypatch, capsys):
    assert touching(monkeypatch, ["", "s", "", "", ""], [POINTS[0], *POINTS[1:]]) == 0
    assert touching(monkeypatch, ["s", "s", "", "", ""], POINTS) == 2
    assert "3 points were measured, at least 4" in capsys.readouterr().err
    assert touching(monkeypatch, ["", "q"], POINTS) == 2
    assert "stopped by the user" in capsys.readouterr().err
    assert touching(monkeypatch, [""], POINTS) == 2
    assert "input ended" in capsys.readouterr().err


# --- clutch, and the file


def test_the_clutch_by_options_and_by_answers(inside, monkeypatch, capsys):
    Calibration(lengths=None).save("calibration.json")
    assert main(["calibrate", "clutch", "--anchor", "shoulder", "--orientation", "fixed"]) == 2
    assert "needs the lengths of your arm; run 'imitarm calibrate limbs" in capsys.readouterr().err
    assert main(["calibrate", "clutch", "--scale", "0.5", "--orientation", "fixed"]) == 0
    assert (Calibration.load("calibration.json").scale, Calibration.load("calibration.json").orientation) == (
        0.5,
        "fixed",
    )
    left = answers(monkeypatch, "neither", "2", "u")
    assert main(["calibrate", "clutch"]) == 0 and not left
    assert (Calibration.load("calibration.json").scale, Calibration.load("calibration.json").orientation) == (
        1.0,
        "upright",
    )
    assert "'neither' is not a choice" in capsys.readouterr().err
    assert main(["calibrate", "clutch", "--scale", "1", "--anchor", "object"]) == 2
    assert main(["calibrate", "clutch", "--scale", "70", "--orientation", "hand"]) == 2
    assert "scale must be a finite number" in capsys.readouterr().err


def test_each_step_adds_to_one_file(inside, capsys):
    SkeletonRecording(skeletons(90)).save("a.csv")
    np.savetxt("pairs.csv", pairs(), delimiter=",")
    for words in (
        ["limbs", "a.csv"],
        ["sensor", "pairs.csv"],
        ["clutch", "--anchor", "shoulder", "--orientation", "hand"],
    ):
        assert main(["calibrate", *words, "--out", "mine.json"]) == 0
    found = Calibration.load("mine.json")
    assert found.lengths is not None and found.sensor_to_base is not None and found.orientation == "hand"
    assert found.scale == pytest.approx(0.869 / found.lengths.reach, rel=0.02)
    assert main(["calibrate", "limbs", "a.csv", "--side", "left", "--out", "mine.json"]) in {0, 1}
    (inside / "other.json").write_text("{}")
    assert main(["calibrate", "sensor", "pairs.csv", "--out", "other.json"]) == 2
    assert "not a calibration" in capsys.readouterr().err and (inside / "other.json").read_text() == "{}"
    assert main(["calibrate", "sensor", "pairs.csv", "--out", "no/c.json"]) == 2
