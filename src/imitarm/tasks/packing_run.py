"""run_packing: one run of the packing task with the policy RCAMO, a sensor, and a tracker for box and bottle."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.control_loop.camera_observer import CameraObserver
from imitarm.control_loop.observer import SensorModel, TrackedScene
from imitarm.control_loop.reproduce import Step, reproduce
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.pose import Pose
from imitarm.perception import (
    DepthFrame,
    Detection,
    ObstacleDetector,
    ObstacleTracker,
    PointCloud,
    Target,
)
from imitarm.policies import Stage, StagedPolicy
from imitarm.policies.rcamo import RCAMO
from imitarm.robots.simulated import SimulatedRobot
from imitarm.safety import SafetyFilter
from imitarm.scene import Scene
from imitarm.tasks.packing import (
    BOTTLE,
    BOTTLE_COLOR,
    BOX,
    BOX_COLOR,
    CLOSED,
    CUBE,
    CUBE_COLOR,
    OPEN,
    PackingTask,
    packing_fixtures,
    packing_skills,
)
from imitarm.tasks.watching import PERIOD, WATCHES, camera_in_front, watch
from imitarm.trajectory import Rollout

Array = NDArray[np.float64]
Observer = Callable[[PackingTask, SimulatedRobot], Callable[[float], Scene]]
_NEAR_CUBE, _NEAR_BOX = 0.004, 0.015  # [m] from the goal: the gripper closes on the cube, opens above the box
_FINGERS = 1.0  # [s] in which the fingers close or open
_EYE, _MIDDLE = (
    np.array([1.45, -0.05, 0.95]),
    np.array([0.56, -0.02, 0.05]),
)  # [m] place of the camera, what it looks at
_WORKSPACE = ((0.30, -0.60, 0.0), (1.0, 0.60, 0.6))  # [m]
_RIM, _FEWEST, _WRONG = 0.03, 30, 0.06  # [m] height of points of the rim, their least number, [m] error of its size
_BOX_SIGMA = 0.006  # [m] standard deviation of the middle of the rim
_ON_TABLE = 0.03  # [m] height of the underside of a cube that is not in the gripper
_LINKS = 0.005  # [m] clearance that the safety filter keeps; the gripper itself works near the box


def packing_policy(task: PackingTask, arm: ArmModel, grasp: Callable[[], Pose]) -> StagedPolicy:
    """Return the policy of the task: reach the cube, close the gripper, follow the box with the cube, and release it.

    Args:
        task: the task.
        arm: the arm with the gripper.
        grasp: function that returns the pose of the tool in which the fingers close on the cube. The function uses the
            last known position of the cube.
    """
    reach, carry = packing_skills()
    spheres = arm.tool_spheres
    return StagedPolicy(
        [
            Stage(
                "reach",
                RCAMO(reach, tool_spheres=spheres, clearance=task.clearance, arrival=_NEAR_CUBE),
                goal=lambda scene: grasp(),
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
        arm: the Sawyer with the gripper; None: loaded here.
        observer: function of the task and its simulated robot, one of :data:`OBSERVERS`. It returns the argument
            ``observe`` of :func:`~imitarm.control_loop.reproduce`. None: :func:`sensed`.
        on_step: function called after each control step.

    Returns:
        The measured motion, evaluated by :meth:`PackingTask.evaluate`.
    """
    robot = task.robot(arm=arm)
    observe = (sensed if observer is None else observer)(task, robot)
    safety = SafetyFilter(robot.arm, dt=PERIOD, clearance=_LINKS)
    grasp = observe.grasp if isinstance(observe, Watched) else lambda: task.grasp
    policy = packing_policy(task, robot.arm, grasp)
    done = reproduce(policy, robot, observe, dt=PERIOD, timeout=task.timeout, safety=safety, on_step=on_step)
    return task.evaluate(robot, done)


def sensed(task: PackingTask, robot: SimulatedRobot) -> TrackedScene:
    """Observe box and bottle with a simulated sensor (noise 5 mm, 30 Hz, latency 33 ms) and a tracker."""
    del robot
    return TrackedScene(task.truth(), SensorModel(seed=task.seed), ObstacleTracker())


def exact(task: PackingTask, robot: SimulatedRobot) -> Callable[[float], Scene]:
    """Observe the true box and bottle, with their true velocities and without delay."""
    del robot
    return task.truth().at


class PackingDetector(ObstacleDetector):
    """Finds cube, bottle and box by their colours, and computes the box's position from its rim.

    An open box is not convex, so the usual fit of convex shapes fails. The camera sees all four sides of the rim from
    above. The middle of the rim is the middle of the box. The size of the box is known.

    Args:
        task: the task.
        options: arguments of :class:`~imitarm.perception.ObstacleDetector`.
    """

    def __init__(self, task: PackingTask, arm: ArmModel, **options: Any) -> None:
        colors = {CUBE: CUBE_COLOR, BOX: BOX_COLOR, BOTTLE: BOTTLE_COLOR}
        targets = {name: Target(name, np.array(color)) for name, color in colors.items()}
        super().__init__(arm, targets=list(targets.values()), **options)
        self._task, self._box = task, targets[BOX]

    def detect(self, frame: DepthFrame | PointCloud, q: ArrayLike | None = None) -> list[Detection]:
        """Return the detections of cube, bottle and box in one image."""
        found = [detection for detection in super().detect(frame, q) if detection.label != BOX]
        if isinstance(frame, DepthFrame) and frame.color is not None:
            points = frame.points()
            points = points[self._box.has_color(frame.color[~np.isnan(frame.depth)])]
            rim = points[np.abs(points[:, 2] - self._task.rim) < _RIM]
            if len(rim) >= _FEWEST:
                low, high = np.percentile(rim[:, :2], [2.0, 98.0], axis=0)
                size = self._task.outer[:2] - (high - low)
                if np.abs(size).max() < _WRONG:  # otherwise, a part of the rim is hidden
                    box = self._task.box_around(0.5 * (low + high))
                    found.append(Detection(box, _BOX_SIGMA**2 * np.eye(3), BOX))
        return found


class Watched:
    """Observes box and bottle with a depth camera that also measures colours; call it as ``observe(t)``.

    The camera stands in front of the table. The camera observes the scene for one second before the robot starts to
    move. The cube is recognised by its colour. The cube is not an obstacle, because the gripper must reach it. While
    the gripper hides the cube, its last measured position is used.

    Args:
        task: the task.
        robot: the simulated robot, at rest.
    """

    def __init__(self, task: PackingTask, robot: SimulatedRobot) -> None:
        camera = camera_in_front(robot, _EYE, _MIDDLE, seed=task.seed, color=True)
        detector = PackingDetector(
            task,
            robot.arm,
            surfaces=packing_fixtures(),
            workspace=_WORKSPACE,
            split=False,
        )
        self._task, self._cube = task, task.grasp_at(np.array([*_MIDDLE[:2], 0.0]))
        self._observe = CameraObserver(
            camera.frame, detector, ObstacleTracker(), joints=lambda: robot.state().q, clock=robot.time + WATCHES
        )
        watch(robot, self)

    def __call__(self, time: float) -> Scene:
        """Return the scene with box and bottle, as estimated by the tracker from the camera's images."""
        scene = self._observe(time)
        others = []
        for obstacle in scene.obstacles:
            if obstacle.name != CUBE:
                others.append(obstacle)
            elif (low := obstacle.bounds()[0])[2] < _ON_TABLE:  # not in the gripper
                self._cube = self._task.grasp_at(0.5 * (low + obstacle.bounds()[1]))
        return replace(scene, obstacles=tuple(others))

    def grasp(self) -> Pose:
        """Return the pose of the tool in which the fingers close on the cube at its last measured position."""
        return self._cube


OBSERVERS: dict[str, Observer] = {"exact": exact, "sensor": sensed, "camera": Watched}
"""Ways to observe box and bottle, by name."""
