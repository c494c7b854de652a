"""The world of the real-time benchmark: an arm that sweeps back and forth, moving obstacles, and a depth camera."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from imitarm.benchmark.moving_arm import ROBOTS, prepared
from imitarm.demonstrations import align, read
from imitarm.errors import UnknownNameError
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.pose import Pose
from imitarm.perception import DepthNoise, Intrinsics, ObstacleDetector
from imitarm.policies import POLICIES, Policy
from imitarm.robots.depth_camera import DepthCamera
from imitarm.robots.simulated import SimulatedRobot
from imitarm.scene import Box, Cylinder, MovingScene, Scene, Sphere, standard_fixtures
from imitarm.scene.motion import Motion
from imitarm.skills import Skill
from imitarm.tasks.sweep import DEMONSTRATIONS
from imitarm.tasks.watching import looking_at
from imitarm.trajectory import Demonstration, Trajectory
from imitarm.validation import choice, finite_number, whole_number

Array = NDArray[np.float64]

CAMERA_RATE = 30.0  # [Hz]
CLEARANCE = 0.02  # [m] of the safety filter and of the policy
_LONGEST_STEP = 0.002  # [s] of the physics
_EYE, _MIDDLE = (1.65, 0.0, 1.0), (0.62, 0.0, 0.05)  # [m] place of the camera, and the point at which it looks
_FIELD_OF_VIEW, _ASPECT = 0.9, 4.0 / 3.0  # vertical [rad], width over height of an image
_RANGE = (0.5, 5.0)  # [m] depths that a Kinect v2 measures
_WORKSPACE = ((0.3, -0.75, -0.3), (1.15, 0.75, 0.5))  # [m] lowest and highest corner
_PLACES = (-0.24, 0.0, 0.24)  # [m] y of the lines on which the obstacles move
_MIDDLE_X, _REACH = 0.73, 0.17  # [m] middle and half length of these lines; the path crosses them at x = 0.6
_HEIGHT = 0.05  # [m] of the centres of the obstacles; the brush moves 3 mm above height 0
_SPEEDS = (0.10, 0.22)  # [m/s] largest speed of an obstacle


@dataclass(frozen=True)
class RealTimeSetup:
    """What is measured. All values are plain, so another process can build the same world.

    Attributes:
        duration: duration of the measurement [s].
        rate: rate of the control loop, of the robot server and of the simulation [Hz]; 100 to 1000.
        policy: name of the policy in :data:`~imitarm.policies.POLICIES`.
        robot: name of the arm, one of :data:`~imitarm.benchmark.moving_arm.ROBOTS`.
        seed: seed of the obstacles' motion and of the camera's noise.
        rows: rows of the camera's images; an image has 4 columns for 3 rows.

    Raises:
        InputError: when a number is out of its range.
        UnknownNameError: when the policy does not exist.
    """

    duration: float = 60.0
    rate: float = 1000.0
    policy: str = "rcamo"
    robot: str = "sawyer"
    seed: int = 0
    rows: int = 150

    def __post_init__(self) -> None:
        finite_number(self.duration, "RealTimeSetup: duration", "s", at_least=1.0, at_most=3600.0)
        finite_number(self.rate, "RealTimeSetup: rate", "Hz", at_least=100.0, at_most=1000.0)
        choice(self.robot, tuple(ROBOTS), "RealTimeSetup: robot")
        whole_number(self.seed, "RealTimeSetup: seed", at_least=0)
        whole_number(self.rows, "RealTimeSetup: rows", at_least=60, at_most=480)
        if self.policy not in POLICIES:
            raise UnknownNameError.among("policy", self.policy, POLICIES)

    @property
    def dt(self) -> float:
        """The control period [s]."""
        return 1.0 / self.rate

    def arm(self) -> ArmModel:
        """Return the arm with its tool."""
        return ArmModel.load(self.robot, tool=ROBOTS[self.robot])

    def truth(self) -> MovingScene:
        """Return the obstacles: a ball, a box and a cylinder, which move across the learned path again and again.

        Each obstacle moves on a straight line at a right angle to the path, as a sine of the time. Seeds determine the
        phases and the periods.
        """
        rng = np.random.default_rng([90, self.seed])
        upright = np.array([1.0, 0.0, 0.0, 0.0])
        begin = [np.array([_MIDDLE_X, y, _HEIGHT]) for y in _PLACES]
        obstacles = (
            Sphere(begin[0], 0.05, name="ball"),
            Box(Pose(begin[1], upright), np.array([0.08, 0.08, 0.1]), name="box"),
            Cylinder(Pose(begin[2], upright), 0.04, 0.1, name="cylinder"),
        )
        motions: dict[str | int, Motion] = {}
        for obstacle, place in zip(obstacles, begin, strict=True):
            motions[obstacle.name] = _back_and_forth(place, rng.uniform(*_SPEEDS) / _REACH, rng.uniform(0.0, math.tau))
        return MovingScene(Scene(None, obstacles, fixtures=standard_fixtures()), motions)

    def simulated(self, arm: ArmModel, q: Array) -> SimulatedRobot:
        """Return the simulated arm among the obstacles, at the joint angles ``q`` (n_joints,) [rad]."""
        truth = self.truth()
        step = self.dt / math.ceil(self.dt / _LONGEST_STEP - 1e-9)
        return SimulatedRobot(arm, scene=truth.scene, motion=truth.motions, q=q, timestep=step)

    def camera(self, robot: SimulatedRobot) -> DepthCamera:
        """Return a depth camera with the noise of a Kinect v2, opposite the arm, which looks down at the path."""
        return DepthCamera(
            robot,
            Intrinsics.from_field_of_view(round(_ASPECT * self.rows), self.rows, _FIELD_OF_VIEW),
            looking_at(_EYE, _MIDDLE),
            nearest=_RANGE[0],
            farthest=_RANGE[1],
            noise=DepthNoise(),
            seed=self.seed,
        )

    def detector(self, robot: SimulatedRobot) -> ObstacleDetector:
        """Return the detector, which removes the arm, the floor and the pedestal from the images."""
        fixtures = robot.scene_at_start.fixtures
        return ObstacleDetector(robot.arm, surfaces=fixtures, workspace=_WORKSPACE, depth_range=_RANGE)

    def motions(self) -> tuple[ArmModel, Array, tuple[Policy, Policy]]:
        """Return the arm, its start posture (n_joints,) [rad], and policies for the sweep and for the motion back.

        The skill of the motion back is learned from the reversed demonstrations of the sweep.
        """
        skill, arm, start = prepared(self.robot)
        back = Skill().fit(align([_reversed(demonstration) for demonstration in read(DEMONSTRATIONS)]))
        sweep, return_ = (
            POLICIES[self.policy].build(s, tool_spheres=arm.tool_spheres, clearance=CLEARANCE, arm=arm)
            for s in (skill, back)
        )
        return arm, start, (sweep, return_)


def _back_and_forth(middle: Array, frequency: float, phase: float) -> Motion:
    """Return a motion along x, as a sine of this frequency [rad/s], which begins at a phase [rad]."""
    return lambda time: middle + np.array([_REACH * math.sin(frequency * time + phase), 0.0, 0.0])


def _reversed(demonstration: Demonstration) -> Demonstration:
    """Return a demonstration of the same motion from its end to its start."""
    path, joints = demonstration.trajectory, demonstration.joints
    quaternions = None if path.quaternions is None else path.quaternions[::-1]
    back = Trajectory(path.times[-1] - path.times[::-1], path.positions[::-1], quaternions)
    return replace(demonstration, trajectory=back, joints=None if joints is None else joints[::-1])
