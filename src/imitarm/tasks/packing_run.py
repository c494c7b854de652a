"""run_packing: one run of the packing task with RCAMO, from what a sensor and a tracker know of box and bottle."""

from __future__ import annotations

from collections.abc import Callable

from imitarm.control_loop.observer import SensorModel, TrackedScene
from imitarm.control_loop.reproduce import Step, reproduce
from imitarm.kinematics.arm import ArmModel
from imitarm.perception import ObstacleTracker
from imitarm.policies import Stage, StagedPolicy
from imitarm.policies.rcamo import RCAMO
from imitarm.robots.simulated import SimulatedRobot
from imitarm.safety import SafetyFilter
from imitarm.scene import Scene
from imitarm.tasks.packing import CLOSED, OPEN, PackingTask, packing_skills
from imitarm.trajectory import Rollout

Observer = Callable[[PackingTask, SimulatedRobot], Callable[[float], Scene]]
DT = 0.01  # [s] control period
_NEAR_CUBE, _NEAR_BOX = 0.004, 0.015  # [m] from the goal: the gripper closes on the cube, opens above the box
_FINGERS = 1.0  # [s] in which the fingers close or open
_LINKS = 0.005  # [m] clearance that the safety filter keeps; the gripper itself works near the box


def packing_policy(task: PackingTask, arm: ArmModel) -> StagedPolicy:
    """Return the policy of the task: reach the cube, close the gripper, follow the box with the cube, and release it.

    Args:
        task: the task.
        arm: the arm with the gripper.
    """
    reach, carry = packing_skills()
    spheres = arm.tool_spheres
    return StagedPolicy(
        [
            Stage(
                "reach",
                RCAMO(reach, tool_spheres=spheres, clearance=task.clearance, arrival=_NEAR_CUBE),
                goal=lambda scene: task.grasp,
                opening=CLOSED,
                hold=_FINGERS,
            ),
            Stage(
                "carry",
                RCAMO(carry, tool_spheres=spheres, clearance=task.clearance, arrival=_NEAR_BOX),
                goal=task.release,
                opening=OPEN,
                hold=_FINGERS,
            ),
        ]
    )


def run_packing(
    task: PackingTask,
    *,
    arm: ArmModel | None = None,
    observer: Observer | None = None,
    on_step: Callable[[Step], None] | None = None,
) -> Rollout:
    """Run the task once.

    Args:
        task: the task.
        arm: the arm, if it has been loaded already.
        observer: function that returns the ``observe`` of :func:`~imitarm.control_loop.reproduce` for the task and its
            simulated robot, see :data:`OBSERVERS`; None: :func:`sensed`.
        on_step: called after each step.

    Returns:
        The measured motion, evaluated by :meth:`PackingTask.evaluate`.
    """
    robot = task.robot(arm=arm)
    observe = (sensed if observer is None else observer)(task, robot)
    safety = SafetyFilter(robot.arm, dt=DT, clearance=_LINKS)
    policy = packing_policy(task, robot.arm)
    done = reproduce(policy, robot, observe, dt=DT, timeout=task.timeout, safety=safety, on_step=on_step)
    return task.evaluate(robot, done)


def sensed(task: PackingTask, robot: SimulatedRobot) -> TrackedScene:
    """Observe box and bottle with a simulated sensor (5 mm noise, 30 Hz, 33 ms) and a tracker."""
    del robot
    return TrackedScene(task.truth(), SensorModel(seed=task.seed), ObstacleTracker())


def exact(task: PackingTask, robot: SimulatedRobot) -> Callable[[float], Scene]:
    """Observe the true box and bottle, with their true velocities and without delay."""
    del robot
    return task.truth().at


OBSERVERS: dict[str, Observer] = {"exact": exact, "sensor": sensed}
"""Ways to observe box and bottle, by name."""
