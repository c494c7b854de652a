from __future__ import annotations

import signal
import socket
import threading

import numpy as np
import pytest

from imitarm.cli import main
from imitarm.cli.serve import _show_summary, sigterm_as_interrupt
from imitarm.files.table import read_table
from imitarm.kinematics.arm import ArmModel
from imitarm.robots import RobotServer, SimulatedRobot
from imitarm.transmission.messages import RobotStatus


def test_it_serves_for_a_time_and_says_how_it_went(tmp_path, capfd):
    trace = tmp_path / "trace.csv"
    assert main(["serve", "--robot", "sawyer", "--port", "0", "--seconds", "0.3", "--trace", str(trace)]) == 0
    shown = capfd.readouterr()
    assert "sawyer" in shown.out and "listens on 127.0.0.1:" in shown.out
    assert "stopped: the server has just started" in shown.err
    assert "commands accepted" in shown.out and "stopped: the server has just started" in shown.out
    table = read_table(trace)
    assert table.names[:3] == ("t", "status", "set_right_j0") and len(table.names) == 2 + 3 * 7
    assert (table.values[:, 1] == RobotStatus.STOPPED).all() and (np.diff(table.values[:, 0]) > 0).all()
    assert (table.values[:, 2:9] == table.values[0, 2:9]).all()


def test_an_address_that_others_reach_is_warned_of(capfd):
    assert main(["serve", "--robot", "panda", "--port", "0", "--host", "0.0.0.0", "--seconds", "0.05"]) == 0
    shown = capfd.readouterr()
    assert "anyone who can reach this address can move the robot" in shown.err and "panda" in shown.out


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--robot", "nosuch"], "unknown"),
        (["--tool", "spoon"], "spoon"),
        (["--port", "70000"], "--port must be from 0 to 65535"),
        (["--seconds", "-1"], "--seconds must be above 0"),
        (
            ["--robot", "sawyer", "--seconds", "1", "--port", "0", "--rate", "30"],
            "rate must be a finite number of at least 100",
        ),
        (["--seconds", "1", "--port", "0", "--rate", "200"], "multiple of the timestep"),
        (["--scene", "{}/no.yaml"], "no.yaml"),
        (["--port", "0", "--trace", "{}/there.csv"], "already exists; name another file"),
        (["--port", "0", "--trace", "{}/no/there.csv"], "there is no folder"),
        (["--port", "0", "--trace", "{}", "--force"], "is a folder; name a file in it"),
        (
            ["--robot", "sawyer", "--scene", "{}/there.csv", "--trace", "{}/there.csv", "--force"],
            "is also the file of --scene",
        ),
        (["--port", "0", "--host", "no.such.host.invalid"], "there is no such host"),
    ],
)
def test_a_wrong_option_is_one_message(tmp_path, capsys, options, message):
    (tmp_path / "there.csv").write_text("precious")
    assert main(["serve", *(option.format(tmp_path) for option in options)]) == 2
    text = capsys.readouterr().err
    assert message in text and "imitarm: error: " in text and "bug" not in text
    assert (tmp_path / "there.csv").read_text() == "precious"


def test_a_port_that_is_taken_is_said_and_no_more(tmp_path, capsys):
    trace = tmp_path / "trace.csv"
    trace.write_text("an older one")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        assert (
            main(
                ["serve", "--robot", "sawyer", "--port", str(taken.getsockname()[1]), "--trace", str(trace), "--force"]
            )
            == 2
        )
    shown = capsys.readouterr()
    assert "cannot listen at this address" in shown.err and shown.err.startswith("imitarm: error: ") and not shown.out
    assert trace.read_text() == "an older one"


@pytest.mark.parametrize(
    ("status", "reason", "said"),
    [
        (RobotStatus.STOPPED, "the server has just started", "stopped: the server has just started"),
        (RobotStatus.STOPPED, "a client has stopped it", "stopped: a client has stopped it"),
        (RobotStatus.FOLLOWING, "", "following"),
    ],
)
def test_how_it_ended_is_said_once(capsys, status, reason, said):
    with RobotServer(SimulatedRobot(ArmModel.load("sawyer")), 0) as server:
        server.supervisor.status, server.supervisor.reason = status, reason
        _show_summary(server)
    (line,) = [line for line in capsys.readouterr().out.splitlines() if "at the end" in line]
    assert line.split("│")[2].strip() == said


def test_the_usual_kill_ends_it_as_ctrl_c_does():
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(KeyboardInterrupt), sigterm_as_interrupt():
        signal.raise_signal(signal.SIGTERM)
    assert signal.getsignal(signal.SIGTERM) is before
    outside = []

    def elsewhere():
        with sigterm_as_interrupt():
            outside.append(signal.getsignal(signal.SIGTERM))

    thread = threading.Thread(target=elsewhere)
    thread.start()
    thread.join()
    assert outside == [before]
