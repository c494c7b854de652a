from __future__ import annotations

import argparse
import contextlib
import threading

import numpy as np
import pytest

from imitarm.capture.recording import SkeletonRecording
from imitarm.cli import main, teleoperate
from imitarm.cli.teleoperate import _correspondence, add_arguments
from imitarm.files.table import read_table
from imitarm.kinematics.arm import ArmModel
from imitarm.retarget import RETARGETERS, LimbLengths
from imitarm.retarget.calibration import Calibration
from imitarm.robots import RobotServer, SimulatedRobot, UdpRobot
from imitarm.trajectory import Demonstration
from recording_samples import skeletons


@pytest.fixture
def served():
    """A robot server that runs in a thread of its own."""
    halt = threading.Event()

    def until_halt(server):
        if halt.is_set():
            raise KeyboardInterrupt

    def run():
        with contextlib.suppress(KeyboardInterrupt):
            server.run(on_step=until_halt)

    with RobotServer(SimulatedRobot(ArmModel.load("sawyer", tool="gripper")), 0) as server:
        running = threading.Thread(target=run)
        running.start()
        yield server
        halt.set()
        running.join()


@pytest.fixture
def person(tmp_path):
    path = tmp_path / "person.csv"
    SkeletonRecording(skeletons(60)).save(path)
    return path


def until_it_succeeds(words, capfd, tries=10):
    """Run a command again when a busy machine held it up for so long that the person was lost or the robot stopped."""
    for _ in range(tries):
        status, text = main(words), capfd.readouterr().out
        if status == 0:
            break
    assert status == 0, text
    return text


def test_a_recording_leads_a_simulated_robot(person, tmp_path, capfd):
    shown, latency = tmp_path / "shown.csv", tmp_path / "latency.csv"
    words = [
        str(person),
        "--orientation",
        "fixed",
        "--record",
        str(shown),
        "--task",
        "reach",
        "--latency",
        str(latency),
    ]
    text = until_it_succeeds(["teleoperate", "--force", *words], capfd)
    for part in (
        "the source has ended",
        "following",
        "highest velocity and acceleration",
        "no safe motion was found",
        "median [ms]",
        "total",
        "wrote",
    ):
        assert part in text
    demonstration = Demonstration.load(shown)
    assert demonstration.task == "reach" and demonstration.joints.shape[1] == 7
    table = read_table(latency)
    assert len(table.values) > 20 and np.nanmax(table.values[:, table.names.index("retarget")]) > 0.0


def test_a_served_robot_is_led_with_enable(person, served, capfd):
    SkeletonRecording(skeletons(120)).save(person)
    to = f"127.0.0.1:{served.address[1]}"
    text = until_it_succeeds(["teleoperate", str(person), "--to", to, "--enable", "--rate", "100"], capfd)
    assert "interruptions" in text and "dropped states" in text and "to its receipt by the robot" in text
    assert served.supervisor.datagram_filter.accepted > 20


def test_a_stopped_robot_without_a_terminal_ends_it(person, served, capfd, monkeypatch):
    monkeypatch.setattr("imitarm.cli.teleoperate._standard_input", lambda: b"")
    assert main(["teleoperate", str(person), "--to", f"127.0.0.1:{served.address[1]}"]) == 1
    assert "the robot is stopped: the server has just started; it cannot be enabled" in capfd.readouterr().err
    assert not served.supervisor.datagram_filter.accepted


def test_nobody_in_the_picture_is_a_failure(capfd):
    assert main(["teleoperate", "udp:0", "--seconds", "0.2"]) == 1
    shown = capfd.readouterr()
    assert "never followed a person" in shown.err and "the time is up" in shown.out


@pytest.mark.parametrize(
    ("options", "status", "message"),
    [
        (["--to", "127.0.0.1:0"], 2, "is not an address; write HOST:PORT"),
        (["--seconds", "0"], 2, "--seconds must be above 0"),
        (["--rate", "5"], 2, "--rate must be from 50 to 1000 Hz"),
        (["--rate", "49.9"], 2, "--rate must be from 50 to 1000 Hz"),
        (["--enable"], 2, "--enable applies to a robot of 'imitarm serve'"),
        (["--record", "{}/no/a.csv"], 2, "there is no folder"),
        (["--record", "{}/there.csv"], 2, "already exists; name another file, or replace it with --force"),
        (["--latency", "{}/there.csv"], 2, "already exists"),
        (["--record", "{}/person.csv"], 2, "is also the file of SOURCE"),
        (["--record", "{}/person.csv", "--force"], 2, "is also the file of SOURCE"),
        (["--latency", "{}/person.csv", "--force"], 2, "is also the file of SOURCE"),
        (["--record", "{}/z.csv", "--latency", "{}/z.csv"], 2, "is also the file of --record"),
        (
            ["--calibration", "{}/there.csv", "--record", "{}/there.csv", "--force"],
            2,
            "is also the file of --calibration",
        ),
        (["--record", "{}", "--force"], 2, "is a folder; name a file in it"),
        (["--latency", "{}"], 2, "is a folder; name a file in it"),
        (["--calibration", "{}/person.csv"], 2, "person.csv"),
        (["--calibration", "{}/no.json"], 2, "no.json"),
        (["--robot", "tractor"], 2, "tractor"),
        (["--scale", "0"], 2, "scale must be a finite number"),
    ],
)
def test_a_wrong_option_is_one_message(person, tmp_path, capsys, options, status, message):
    before = person.read_bytes()
    (tmp_path / "there.csv").write_text("precious")
    assert main(["teleoperate", str(person), *(option.format(tmp_path) for option in options)]) == status
    text = capsys.readouterr().err
    assert message in text and text.startswith("imitarm: error: ") and "bug" not in text
    assert person.read_bytes() == before and (tmp_path / "there.csv").read_text() == "precious"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["person.csv", "there.csv"]


@pytest.mark.parametrize("method", sorted(RETARGETERS))
def test_the_slowest_rate_is_one_that_every_method_can_do(person, capfd, method):
    words = ["--rate", "50", "--method", method, "--seconds", "0.1"]
    assert main(["teleoperate", str(person), *words]) == 1  # nobody takes hold within 0.1 s
    assert "never followed a person" in capfd.readouterr().err


def test_a_robot_that_does_not_answer_is_said(person, capsys, monkeypatch):
    monkeypatch.setattr(teleoperate, "_connected", lambda arm, address: UdpRobot(arm, ("127.0.0.1", 9), timeout=0.1))
    assert main(["teleoperate", str(person), "--to", "127.0.0.1:9"]) == 1
    assert "no robot server answers; start one with 'imitarm serve'" in capsys.readouterr().err


def test_what_was_calibrated_holds_unless_it_is_said_otherwise(tmp_path, capsys):
    path = tmp_path / "mine.json"
    Calibration("left", LimbLengths(0.3, 0.25), scale=1.4, orientation="upright").save(path)

    def of(*words):
        parser = argparse.ArgumentParser()
        add_arguments(parser)
        return _correspondence(parser.parse_args(["x.csv", *words]))

    found = of("--calibration", str(path))
    assert (found.side, found.scale, found.orientation, found.lengths.upper_arm) == ("left", 1.4, "upright", 0.3)
    found = of("--calibration", str(path), "--scale", "1", "--orientation", "fixed", "--side", "left")
    assert (found.side, found.scale, found.orientation, found.lengths.upper_arm) == ("left", 1.0, "fixed", 0.3)
    assert of("--calibration", str(path), "--side", "right").lengths is None
    assert "the right arm is measured during the run" in capsys.readouterr().err
    assert (of().side, of().scale, of().orientation) == ("right", 1.0, "upright")
