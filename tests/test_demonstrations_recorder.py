from __future__ import annotations

import os
import signal
import subprocess
import sys

import numpy as np
import pytest

from imitarm.demonstrations.recorder import DemonstrationRecorder
from imitarm.errors import InputError
from imitarm.kinematics.arm import ArmModel
from imitarm.trajectory import Demonstration

ARM = ArmModel.load("sawyer")
WAYS = ARM.home + 0.3 * np.sin(np.linspace(0, 3, 40))[:, None]


def record(path, **options):
    recorder = DemonstrationRecorder(path, ARM, task="reach  far", source="udp:7400", **options)
    for k, q in enumerate(WAYS):
        recorder.write(0.01 * k, q)
    return recorder


def test_it_becomes_a_demonstration(tmp_path):
    path = tmp_path / "reach.csv"
    with record(path):
        assert not path.exists()
    shown = Demonstration.load(path)
    assert shown.task == "reach far" and shown.joint_names == ARM.joint_names
    np.testing.assert_array_equal(shown.joints, WAYS)
    positions, quaternions = ARM.tool_path(WAYS)
    np.testing.assert_allclose(shown.trajectory.positions, positions, atol=1e-12)
    np.testing.assert_allclose(np.abs(np.sum(shown.trajectory.quaternions * quaternions, axis=1)), 1.0, atol=1e-12)
    assert "# source: udp:7400" in path.read_text() and [p.name for p in tmp_path.iterdir()] == ["reach.csv"]


def test_what_has_been_written_can_be_read_at_any_time(tmp_path):
    recorder = record(tmp_path / "reach.csv")
    assert len(Demonstration.load(tmp_path / "reach.csv.part")) == 40
    recorder.close()
    recorder.close()
    with pytest.raises(InputError, match="this recorder is closed"):
        recorder.write(9.0, ARM.home)


def test_times_that_stand_still_are_left_out(tmp_path):
    with DemonstrationRecorder(tmp_path / "a.csv", ARM) as recorder:
        for t in (0.0, 0.1, 0.1, 0.05, 0.2):
            recorder.write(t, ARM.home)
        assert recorder.n_samples == 3
    np.testing.assert_array_equal(Demonstration.load(tmp_path / "a.csv").trajectory.times, [0.0, 0.1, 0.2])


def test_less_than_two_samples_are_no_motion_and_leave_nothing(tmp_path):
    with DemonstrationRecorder(tmp_path / "a.csv", ARM) as recorder:
        recorder.write(0.0, ARM.home)
    assert list(tmp_path.iterdir()) == []


def test_nothing_is_overwritten_unasked(tmp_path):
    path = tmp_path / "reach.csv"
    path.write_text("precious")
    with pytest.raises(InputError, match="already exists"):
        DemonstrationRecorder(path, ARM)
    recorder = record(path, replace=True)
    assert path.read_text() == "precious"
    with pytest.raises(
        InputError, match="an earlier recording left this file unfinished, or another program is writing it"
    ):
        DemonstrationRecorder(path, ARM, replace=True)
    recorder.close()
    assert len(Demonstration.load(path)) == 40
    with pytest.raises(InputError, match="can't be written"):
        DemonstrationRecorder(tmp_path / "no" / "a.csv", ARM)


@pytest.mark.skipif(os.name == "nt", reason="needs signals")
def test_a_kill_loses_no_sample(tmp_path):
    code = """
import sys
from imitarm.demonstrations.recorder import DemonstrationRecorder
from imitarm.kinematics.arm import ArmModel
arm = ArmModel.load("sawyer")
recorder = DemonstrationRecorder(sys.argv[1], arm)
k = 0
while True:
    recorder.write(0.01 * k, arm.home)
    k += 1
    sys.stdout.write(f"{k}\\n")
    sys.stdout.flush()
"""
    path = tmp_path / "reach.csv"
    with subprocess.Popen([sys.executable, "-c", code, str(path)], stdout=subprocess.PIPE, text=True) as process:
        for _ in range(30):
            process.stdout.readline()
        process.send_signal(signal.SIGKILL)
        told = [int(line) for line in process.stdout.read().splitlines()]
    assert len(Demonstration.load(tmp_path / "reach.csv.part")) >= max(told, default=30)
