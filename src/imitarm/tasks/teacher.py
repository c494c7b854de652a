"""Teacher: a simulated person who guides the compliant simulated arm through the sweep by hand.

``python -m imitarm.tasks.teacher --out DIR`` writes the packaged demonstrations again.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline, make_interp_spline

from imitarm.errors import TaskFailedError
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.pose import Pose, quaternion_exp, quaternion_multiply
from imitarm.robots.simulated import SimulatedRobot
from imitarm.tasks.sweep import SweepTask
from imitarm.trajectory import Demonstration, Trajectory

Array = NDArray[np.float64]

SEEDS = tuple(range(8))  # seeds of the packaged demonstrations
RECORDED_EVERY = 0.03  # [s]
_HAND_EVERY = 0.006  # [s] between two updates of the hand's force
_DIGITS = 5  # recorded decimals: 0.01 mm and 0.01 mrad, finer than the resolution of an encoder

# Spring and damper of the hand that holds the tool: along x, y, z, then about them. The height is stiffest.
_STIFFNESS = np.array([1200.0, 1200.0, 4000.0, 150.0, 150.0, 150.0])  # [N/m], [N m/rad]
_DAMPING = np.array([90.0, 90.0, 150.0, 5.0, 5.0, 5.0])  # [N s/m], [N m s/rad]
_TREMOR_BAND = (4.0, 9.0)  # [Hz] physiological tremor of a hand


@dataclass(frozen=True, eq=False)
class Teacher:
    """The sweeping motion of one simulated person: the path of the hand, its speed and its tremor.

    The hand moves from the start S over the dirt T to the goal G (see :class:`~imitarm.tasks.sweep.SweepTask`). Its
    path is the minimum-jerk path through S, T, G and two points between them: the quintic spline that starts and ends
    at rest (Flash and Hogan 1985). Persons differ in the timing of the motion, the sideways displacement of the path,
    and the accuracy at T and G. They also differ in the height of the brush, the rotation of the wrist, and the tremor.

    Attributes:
        seed: seed from which these differences are drawn.
        duration: duration of the motion [s].
        rest: time at rest before and after the motion, shape (2,) [s].
    """

    seed: int
    duration: float
    rest: Array
    _path: BSpline
    _wrist: BSpline
    _tremor: Array  # (3, n) amplitude [m], frequency [rad/s] and phase for each of n waves and axes

    @classmethod
    def from_seed(cls, seed: int) -> Teacher:
        """Return the person with this seed."""
        rng = np.random.default_rng([20240, seed])
        start, dirt, goal = (pose.position for pose in (SweepTask.start, SweepTask.dirt, SweepTask.goal))
        duration = rng.uniform(9.0, 12.0)
        fraction = rng.uniform(0.44, 0.50)
        aside = rng.normal(0.0, [0.012, 0.009])  # [m] halfway to the dirt and halfway to the pan
        halfway = [0.5 * (start + dirt) + [aside[0], 0.0, 0.0], 0.5 * (dirt + goal) + [aside[1], 0.0, 0.0]]
        points = np.array([start, halfway[0], dirt, halfway[1], goal])
        points += rng.normal(0.0, 1.0, (5, 3)) * np.array([0.002, 0.004, 0.0])
        points[:, 2] += rng.normal(0.0, 0.0006, 5)
        times = duration * np.array([0.0, 0.53 * fraction, fraction, fraction + 0.47 * (1.0 - fraction), 1.0])
        rotations = rng.normal(0.0, 0.015, (5, 3))  # [rad]
        n = 6
        waves = np.stack(
            [
                rng.uniform(0.1e-3, 0.5e-3, (n, 3)) * [1.0, 1.0, 0.3],
                2.0 * np.pi * rng.uniform(*_TREMOR_BAND, (n, 3)),
                rng.uniform(0.0, 2.0 * np.pi, (n, 3)),
            ]
        )
        return cls(
            seed,
            duration,
            rng.uniform(0.3, 0.7, 2),
            _minimum_jerk(times, points),
            _minimum_jerk(times, rotations),
            waves,
        )

    def hand(self, time: float) -> tuple[Pose, Array]:
        """Return the pose to which the hand pulls the tool at ``time`` [s], and the pose's twist (6,) [m/s, rad/s]."""
        t = float(np.clip(time - self.rest[0], 0.0, self.duration))
        amplitude, frequency, phase = self._tremor
        position = self._path(t) + (amplitude * np.sin(frequency * time + phase)).sum(axis=0)
        quaternion = quaternion_multiply(quaternion_exp(self._wrist(t)), SweepTask.dirt.quaternion)
        return Pose(position, quaternion), np.concatenate([self._path(t, 1), self._wrist(t, 1)])

    def demonstrate(self, arm: ArmModel | None = None) -> tuple[Demonstration, SimulatedRobot]:
        """Guide the arm through the sweep; return the demonstration and the simulated robot at the end.

        The hand pulls the tool like a spring and a damper, ``f = K (x_hand - x) + D (v_hand - v)``. The hand turns the
        tool in the same way. The arm compensates its own weight and follows the hand. The demonstration contains the
        joint positions every 30 ms, and the corresponding poses of the tool.

        Args:
            arm: the Sawyer with the brush; None: loaded here.

        Raises:
            TaskFailedError: when the dirt is not in the pan at the end.
        """
        task = SweepTask(seed=self.seed)
        robot = task.robot(arm=arm)
        n = int((self.duration + self.rest.sum()) / RECORDED_EVERY)
        joints = np.empty((n, robot.arm.n_joints))
        for k in range(n):
            joints[k] = robot.state().q
            for i in range(round(RECORDED_EVERY / _HAND_EVERY)):
                robot.guide(self._wrench(robot, k * RECORDED_EVERY + i * _HAND_EVERY), _HAND_EVERY)
        if not task.swept(robot).all():
            raise TaskFailedError(
                f"teacher {self.seed} lost {int((~task.swept(robot)).sum())} crumbs; choose another seed"
            )
        positions, quaternions = robot.arm.tool_path(joints)
        times = np.round(np.arange(n) * RECORDED_EVERY, _DIGITS)
        trajectory = Trajectory(times, np.round(positions, _DIGITS), np.round(quaternions, _DIGITS))
        source, names = f"synthetic teacher, seed {self.seed}", robot.arm.joint_names
        return Demonstration(
            trajectory, np.round(joints, _DIGITS), task="sweep", source=source, joint_names=names
        ), robot

    def _wrench(self, robot: SimulatedRobot, time: float) -> Array:
        """Return the wrench that the hand exerts on the tool, shape (6,) [N, N m]."""
        target, twist = self.hand(time)
        state = robot.state()
        error = robot.tool_to_base.error_to(target)
        rate = twist - robot.arm.tool_jacobian(state.q) @ state.velocity
        return np.asarray(_STIFFNESS * error + _DAMPING * rate)


def _minimum_jerk(times: Array, points: Array) -> BSpline:
    """Return the minimum-jerk quintic spline through ``points`` (n, d) at ``times`` (n,), at rest at both ends."""
    still = [(1, np.zeros(points.shape[1])), (2, np.zeros(points.shape[1]))]
    return make_interp_spline(times, points, k=5, bc_type=(still, still))


def main(arguments: list[str] | None = None) -> None:
    """Write one demonstration for each packaged seed into a folder."""
    parser = argparse.ArgumentParser(prog="python -m imitarm.tasks.teacher", description=main.__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder for the files; created if missing")
    folder = parser.parse_args(arguments).out
    folder.mkdir(parents=True, exist_ok=True)
    arm = SweepTask.arm()
    for seed in SEEDS:
        demonstration, _ = Teacher.from_seed(seed).demonstrate(arm)
        demonstration.save(folder / f"sweep_{seed}.csv")


if __name__ == "__main__":
    main()
