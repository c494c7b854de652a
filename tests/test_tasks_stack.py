from __future__ import annotations

import mujoco
import numpy as np
import pytest

from imitarm.errors import InputError
from imitarm.kinematics.ik import solve_ik
from imitarm.kinematics.tasks import TwistTask
from imitarm.tasks import TASKS, StackTask
from imitarm.tasks.stack import CLOSED, N_CUBES, OPEN, SIDE, CubeHistory
from stacking_script import DT, Script

UPRIGHT = (1.0, 0.0, 0.0, 0.0)
ON_ITS_SIDE = (np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0)


@pytest.fixture(scope="module")
def arm():
    return StackTask.arm()


@pytest.fixture(scope="module")
def shared(arm):
    return StackTask(0).robot(arm)


@pytest.fixture
def robot(shared):
    shared.reset()
    shared.grasp(OPEN)
    return shared


def lay(robot, i, position, quaternion=UPRIGHT):
    joint = robot.data.joint(f"cube/{i + 1}")
    joint.qpos[:] = [*position, *quaternion]
    joint.qvel[:] = 0.0
    mujoco.mj_forward(robot.model, robot.data)


def build(robot, n, away=0.0):
    """Put cubes 2 to n on cube 1."""
    bottom = StackTask.cubes(robot)[0]
    for i in range(1, n):
        lay(robot, i, bottom + [away * i, 0.0, i * SIDE])


def rest(robot, seconds=0.3):
    for _ in range(round(seconds / DT)):
        robot.move(np.zeros(7), DT)


@pytest.mark.slow
@pytest.mark.parametrize("seed, control", [(0, "torque"), (1, "torque"), (2, "position"), (3, "torque")])
def test_a_perfect_controller_stacks_all_four(arm, seed, control):
    task = StackTask(seed)
    script = Script(task, task.robot(arm, control=control))
    verdict = script.stack()
    assert verdict.success, verdict
    assert verdict.stacked == N_CUBES
    assert script.history.tallest == N_CUBES
    assert not script.history.lost


def test_a_held_cube_does_not_slip_in_five_seconds_of_motion(robot):
    task = StackTask(0)
    script = Script(task, robot)
    script.pick(2)
    held = robot.tool_to_base.inverse().apply(task.cubes(robot)[2])
    weight, farthest = 0.0, 0.0
    for k in range(500):
        t = k * DT
        twist = np.zeros(6)
        twist[:3] = 0.3 * np.sin(2.0 * np.pi * np.array([0.8, 1.1, 1.3]) * t)
        robot.move(solve_ik(robot.arm, robot.set_point, TwistTask(twist), dt=DT, velocity=robot.velocity), DT)
        now = robot.tool_to_base.inverse().apply(task.cubes(robot)[2])
        farthest = max(farthest, float(np.linalg.norm(now - held)))
        weight = max(weight, float(np.linalg.norm(robot.tool_to_base.position - task.start.position)))
    assert weight > 0.05  # it was moved about
    assert farthest < 1e-3
    assert robot.fault == ""


def test_cubes_left_alone_stay_where_they_lie(robot):
    before = StackTask.cubes(robot)
    rest(robot, 1.0)
    np.testing.assert_allclose(StackTask.cubes(robot), before, atol=2e-4)


def test_places_vary_a_little_by_seed(arm):
    places = np.array([StackTask(seed).places()[0] for seed in range(30)])
    assert np.ptp(places, axis=0).max() < 0.0081
    assert np.ptp(places, axis=0).min() > 0.004
    np.testing.assert_array_equal(StackTask(5).places()[0], StackTask(5).places()[0])
    np.testing.assert_allclose(StackTask.cubes(StackTask(7).robot(arm))[:, :2], StackTask(7).places()[0], atol=1e-9)


def test_cubes_wear_their_numbers(robot):
    names = [robot.model.geom(i).name for i in range(robot.model.ngeom)]
    for number in range(1, 5):
        assert sum(name.startswith(f"cube/{number}/pip0") for name in names) == number
    colors = {tuple(robot.model.geom(f"cube/{number}").rgba) for number in range(1, 5)}
    assert len(colors) == 4


@pytest.mark.parametrize("n", [1, 2, 3, 4])
def test_counting_the_tower(robot, n):
    build(robot, n)
    assert StackTask(0).stacked(robot) == n


def test_a_cube_too_far_aside_or_on_its_side_does_not_count(robot):
    task = StackTask(0)
    bottom = task.cubes(robot)[0]
    lay(robot, 1, bottom + [0.013, 0.0, SIDE])
    assert task.stacked(robot) == 2
    lay(robot, 1, bottom + [0.0, 0.015, SIDE])
    assert task.stacked(robot) == 1
    lay(robot, 1, bottom + [0.0, 0.0, SIDE], ON_ITS_SIDE)
    assert task.stacked(robot) == 1
    lay(robot, 0, bottom, ON_ITS_SIDE)
    assert task.stacked(robot) == 0


def test_success_is_a_tower_that_stands_by_itself(robot):
    task = StackTask(0)
    build(robot, 4, away=0.003)
    rest(robot)
    verdict = task.evaluate(robot, CubeHistory())
    assert (verdict.success, verdict.failure, verdict.stacked) == (True, "", 4)


def test_a_cube_in_the_gripper_does_not_stand_by_itself(arm):
    task = StackTask(0)
    script = Script(task, task.robot(arm))
    script.pick(1)
    assert script.history.held == 1
    assert task.touched(script.robot) == (False, True, False, False)
    assert task.evaluate(script.robot, script.history).failure == "timeout"  # it is lifted and held: only time is up
    script.grasp(OPEN)
    script.hold(0.5)
    verdict = task.evaluate(script.robot, script.history)
    assert verdict.failure == "dropped"
    assert "cube 2" in verdict.reason


def test_verdict_tower_fell(robot):
    task, history = StackTask(0), CubeHistory()
    build(robot, 3)
    task.watch(robot, history)
    assert history.tallest == 3
    lay(robot, 2, [0.55, 0.0, 0.5 * SIDE])
    assert task.evaluate(robot, history).failure == "tower fell"


def test_verdict_misplaced(robot):
    task, history = StackTask(0), CubeHistory()
    lay(robot, 1, [0.62, 0.1, 0.1])
    task.watch(robot, history)
    lay(robot, 1, [0.62, 0.05, 0.5 * SIDE])
    verdict = task.evaluate(robot, history)
    assert verdict.failure == "misplaced"
    assert "cube 2" in verdict.reason


@pytest.mark.parametrize(
    "position, quaternion",
    [([0.62, -0.10, 0.5 * SIDE], ON_ITS_SIDE), ([0.62, -0.14, 0.5 * SIDE], UPRIGHT), ([0.1, 0.6, -0.7], UPRIGHT)],
)
def test_verdict_knocked_over(robot, position, quaternion):
    lay(robot, 2, position, quaternion)
    verdict = StackTask(0).evaluate(robot, CubeHistory())
    assert verdict.failure == "knocked over"
    assert "cube 3" in verdict.reason


def test_verdict_not_grasped(robot):
    verdict = StackTask(0).evaluate(robot, CubeHistory())
    assert verdict.failure == "not grasped"
    assert "cube 2" in verdict.reason
    assert verdict.stacked == 1


def test_verdict_protective_stop(robot):
    robot.fault = "protective stop: held"
    assert StackTask(0).evaluate(robot, CubeHistory()).failure == "protective stop"


def test_a_closed_gripper_presses_with_limited_force(robot):
    task = StackTask(0)
    script = Script(task, robot)
    script.pick(1)
    assert 0.03 < robot.opening < SIDE + 1e-3
    assert abs(robot.data.actuator("tool/opening").force[0]) <= 70.0
    assert CLOSED == 0.0


def test_a_tolerance_that_could_not_stand_is_refused():
    with pytest.raises(InputError, match=r"between 0 and 0\.016 m, got 0\.02"):
        StackTask(tolerance=0.02)


def test_the_registry_knows_it():
    assert TASKS["stack"] is StackTask
