"""Three real processes on loopback: capture, retargeting, robot; each is killed and started again; nothing jumps."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time

import numpy as np
import pytest

from imitarm.capture.recording import SkeletonRecording
from imitarm.files.part_file import PART
from imitarm.kinematics.arm import ArmModel
from imitarm.trajectory import Demonstration
from imitarm.transmission.messages import RobotStatus
from recording_samples import skeletons
from wire_samples import assert_within_limits

pytestmark = [pytest.mark.skipif(os.name == "nt", reason="needs signals"), pytest.mark.slow]

ARM = ArmModel.load("sawyer", tool="gripper")
N = ARM.n_joints
PATIENCE = 300.0  # [s] a busy machine may be slow; nothing here depends on how fast it is


def free_port():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


class Stage:
    """The three processes."""

    def __init__(self, folder):
        self.folder = folder
        self.robot_port, self.person_port = free_port(), free_port()
        self.running = {}
        self.traces = []
        self.records = []
        self.answered = 0

    def start(self, name, *words):
        code = (
            "import signal, sys; from imitarm.cli import main; "
            "signal.signal(signal.SIGINT, signal.default_int_handler); "  # what runs in the background may ignore it
            f"sys.exit(main({list(map(str, words))!r}))"
        )
        log = (self.folder / f"{name}.log").open("ab")
        environment = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        command = [sys.executable, "-c", code]
        if name in self.running:
            self.running[name].communicate()
        self.running[name] = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=log, stderr=log, env=environment, cwd=self.folder
        )
        log.close()

    def start_capture(self):
        self.start("capture", "capture", "person.csv", "--send", f"127.0.0.1:{self.person_port}")

    def start_retargeting(self, *options):
        self.records.append(self.folder / f"shown_{len(self.records)}.csv")
        to = f"127.0.0.1:{self.robot_port}"
        words = (
            f"udp:{self.person_port}",
            "--to",
            to,
            "--orientation",
            "fixed",
            "--record",
            self.records[-1],
            *options,
        )
        self.start("retargeting", "teleoperate", *words)

    def start_robot(self):
        self.traces.append(self.folder / f"trace_{len(self.traces)}.csv")
        self.start("robot", "serve", "--robot", "sawyer", "--port", self.robot_port, "--trace", self.traces[-1])

    def kill(self, name):
        process = self.running.pop(name)
        process.kill()
        process.communicate()

    def questions(self):
        """How often the retargeting process has asked whether the robot may move."""
        return self.log("retargeting").count("press Enter")

    def press_enter(self):
        self.answered = self.questions()
        self.running["retargeting"].stdin.write(b"\n")
        self.running["retargeting"].stdin.flush()

    def log(self, name):
        return (self.folder / f"{name}.log").read_text(encoding="utf-8", errors="replace")

    def steps(self, trace=-1):
        """Return time, status, set-points and velocities of all whole lines of a trace."""
        path = self.traces[trace]
        lines = path.read_text().split("\n")[2:-1] if path.exists() else []
        rows = np.array([[float(field) for field in line.split(",")] for line in lines]).reshape(-1, 2 + 3 * N)
        return rows[:, 0], rows[:, 1].astype(int), rows[:, 2 : 2 + N], rows[:, 2 + N : 2 + 2 * N]

    def wait(self, what, condition):
        until = time.monotonic() + PATIENCE
        while not condition():
            if "capture" in self.running and self.running["capture"].poll() == 0:
                self.start_capture()  # the recording is over before a busy machine has got so far
            for name, process in self.running.items():
                assert process.poll() is None, f"{name} ended while waiting for {what}:\n{self.log(name)}"
            assert time.monotonic() < until, (
                f"no {what}; robot: {self.log('robot')} retargeting: {self.log('retargeting')}"
            )
            time.sleep(0.03)

    def wait_for_motion(self):
        """Wait until the arm is led, goes faster than 0.1 rad/s, and has moved away from where it was."""
        begun = len(self.steps()[0])

        def moving():
            _, status, q, velocity = self.steps()
            self.answer()
            return (
                len(q) > begun
                and status[-1] == RobotStatus.FOLLOWING
                and np.abs(velocity[-1]).max() > 0.1
                and np.abs(q[-1] - q[begun]).max() > 0.02
            )

        self.wait("motion", moving)

    def answer(self):
        """Let the robot move again when it asks: on a busy machine it may have heard nothing for half a second."""
        if self.questions() > self.answered:
            self.press_enter()

    def wait_for_status(self, wanted):
        self.wait(f"status {wanted.name}", lambda: wanted in self.steps()[1][-1:])

    def assert_still(self, seconds):
        """Stopped, and not moving by a hair, for some time of the robot's."""
        begun = len(self.steps()[0])
        self.wait("time", lambda: (t := self.steps()[0])[-1] - t[begun - 1] > seconds)
        _, status, q, velocity = (column[begun:] for column in self.steps())
        assert (status == RobotStatus.STOPPED).all() and not velocity.any() and (q == q[0]).all()

    def close(self):
        for process in self.running.values():
            process.kill()
            process.communicate()


@pytest.fixture
def stage(tmp_path):
    SkeletonRecording(skeletons(900)).save(tmp_path / "person.csv")
    stage = Stage(tmp_path)
    yield stage
    stage.close()


def test_each_process_may_be_killed_and_started_again_and_the_arm_never_jumps(stage):
    stage.start_robot()
    stage.start_retargeting("--enable")
    stage.start_capture()
    stage.wait_for_motion()

    stage.kill("capture")

    def held():  # by the retargeter, which lives: at rest, and not because the robot has stopped itself
        _, status, _, velocity = stage.steps()
        stage.answer()
        return np.abs(velocity[-1]).max() < 1e-3 and status[-1] == RobotStatus.FOLLOWING

    stage.wait("rest", held)
    stage.start_capture()
    stage.wait_for_motion()

    stage.kill("retargeting")
    stage.wait_for_status(RobotStatus.STOPPED)
    assert not stage.steps()[3][-1].any()
    stage.start_retargeting()  # nobody has said that the robot may move
    stage.wait(
        "question", lambda: "If the workspace is clear, press Enter to enable the robot" in stage.log("retargeting")
    )
    stage.assert_still(0.3)
    stage.press_enter()
    stage.wait_for_motion()

    stage.kill("robot")
    stage.wait("complaint", lambda: "the robot does not answer" in stage.log("retargeting"))
    stage.start_robot()  # which stands at home, far from where the other one was
    stage.wait("question", lambda: "just started. If the workspace is clear" in stage.log("retargeting"))
    stage.assert_still(0.3)
    np.testing.assert_array_equal(stage.steps()[2][-1], ARM.home)
    stage.press_enter()
    stage.wait_for_motion()

    retargeting = stage.running.pop("retargeting")
    retargeting.send_signal(signal.SIGINT)
    retargeting.communicate(timeout=PATIENCE)
    assert retargeting.returncode == 0, stage.log("retargeting")
    stage.wait_for_status(RobotStatus.STOPPED)
    robot = stage.running.pop("robot")
    robot.send_signal(signal.SIGTERM)
    robot.communicate(timeout=PATIENCE)
    assert robot.returncode == 0, stage.log("robot")

    for i in range(len(stage.traces)):
        t, _, q, velocity = stage.steps(i)
        assert_within_limits([(ARM.home, np.zeros(N), 0.0), *zip(q, velocity, np.diff(t, prepend=0.0), strict=True)])
    assert len(Demonstration.load(stage.records[0].with_name(stage.records[0].name + PART))) > 10  # of the killed one
    assert len(Demonstration.load(stage.records[1])) > 10
