from __future__ import annotations

import numpy as np
import pytest

from imitarm.benchmark.experiment import LIVE, Experiment
from imitarm.benchmark.mapping_tables import Results, success_table
from imitarm.benchmark.stacking import StackingTrial, run_trial
from imitarm.kinematics.arm import ArmModel
from imitarm.tasks.stack import FAILURES


@pytest.mark.slow
def test_a_trial_is_the_same_every_time_and_gives_its_row():
    trial = StackingTrial("modern", 0, 0, 0.005)
    first, second = (run_trial(trial) for _ in range(2))
    assert first == second
    assert first.success or first.failure in FAILURES
    assert all(mean <= root + 1e-12 for mean, root in zip(first.mean_torque, first.rms_torque, strict=True))
    rated = ArmModel.load("sawyer", tool="gripper").max_torque
    assert first.peak_torque_ratio <= 1.0 + 1e-9  # the drives give no more
    assert np.all(np.array(first.rms_torque) <= rated)
    result = Experiment(LIVE, "modern", sigma=0.005).run()
    assert result.values["time"] == first.time
    (row,) = success_table(Results([result])).rows
    assert row[1] == f"{int(first.success)} of 1"


def test_the_cameras_noise_is_1_to_2_cm_unless_it_is_given():
    usual = [StackingTrial("modern", 0, 0).camera(seed).sigma for seed in range(20)]
    assert 0.01 <= min(usual) < max(usual) <= 0.02
    assert StackingTrial("modern", 0, 0, 0.003).camera(5).sigma == 0.003
