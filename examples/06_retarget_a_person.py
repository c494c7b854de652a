"""Learn a skill from a person in front of a camera: convert five recordings to demonstrations, learn, and reproduce.

The person and the noisy camera are simulated, so you need no camera. To use your own recording, open it with
`open_source("take.csv")`. The true motion of a simulated person is known, so the example can print the errors of the
robot.
"""

from __future__ import annotations

import numpy as np

from imitarm import (
    ArmModel,
    Correspondence,
    Demonstration,
    Pose,
    SafetyFilter,
    Scene,
    SimulatedRobot,
    Skill,
    Sphere,
    Trajectory,
    align,
    find_posture,
    reproduce,
)
from imitarm.capture.camera_model import SkeletonCamera
from imitarm.capture.motions import minimum_jerk
from imitarm.capture.person import Person
from imitarm.capture.skeleton import Skeleton, SkeletonSource
from imitarm.capture.synthetic import SyntheticSource
from imitarm.policies import ACFRA
from imitarm.retarget import FACING, Retargeting
from imitarm.retarget.modern import ModernRetargeter

REST, DURATION = 1.0, 6.0  # [s] with the hand at rest, so that the robot can engage; duration of a recording


def take(number: int) -> SkeletonSource:
    """Record the simulated person, who moves an object over an edge from right to left, with small variations."""
    person = Person.from_seed(4)
    varied = np.random.default_rng(number).normal(0.0, 0.01, (3, 3))
    shoulder = person.shoulder("right", 0.0)
    # in the camera's axes: x is the person's right, y up, z away from the camera
    places = shoulder + np.array([[0.3, -0.2, -0.3], [0.05, -0.03, -0.45], [-0.22, -0.2, -0.38]]) + varied
    hand = minimum_jerk(places[[0, 0, 1, 2, 2]], [0.0, REST, 0.5 * (REST + DURATION - 1.0), DURATION - 1.0, DURATION])

    def truth(time: float) -> Skeleton:
        return person.skeleton(time, hand(np.clip(time, 0.0, DURATION)))

    return SyntheticSource(truth, SkeletonCamera(number, sigma=0.006, dropout=0.0), DURATION, name=f"take {number}")


def following(run: Retargeting) -> slice:
    """Return a demonstration from the part of a run in which the robot followed the person."""
    led = np.flatnonzero(run.states == "following")
    return slice(int(led[0]), int(led[-1]) + 1)


def main() -> None:
    arm = ArmModel.load("sawyer", tool="gripper")
    # The tool moves as far as the hand and stays upright; without a calibration, limb lengths are measured
    # during the run.
    correspondence = Correspondence(side="right", scale=1.0, orientation="fixed")
    begin = arm.tool_pose(arm.home)
    start = find_posture(arm, Pose(begin.position + np.array([0.02, -0.25, 0.0]), begin.quaternion))

    demonstrations = []
    for number in range(5):
        source = take(number)
        run = ModernRetargeter(arm, correspondence).run(source, start)
        part, whole = following(run), run.demonstration(task="put")
        times = whole.trajectory.times[part]
        positions = whole.trajectory.positions[part]
        demonstrations.append(
            Demonstration(
                Trajectory(times - times[0], positions, whole.trajectory.quaternions[part]),
                run.joints[part],
                task="put",
                source=source.name,
            )
        )
        hand = FACING.apply(np.array([source.truth(time).arm("right").wrist for time in times]))
        apart = np.linalg.norm((positions - positions[0]) - (hand - hand[0]), axis=1)
        velocity = np.diff(run.joints, axis=0) / 0.01
        acceleration = np.diff(velocity, axis=0) / 0.01
        print(
            f"{source.name}: {times[-1] - times[0]:.1f} s, {1e3 * apart.mean():.0f} mm from the true hand on average, "
            f"{100 * np.max(np.abs(velocity) / arm.max_velocity):.0f} % of the velocity limit and "
            f"{100 * np.max(np.abs(acceleration) / arm.max_acceleration):.0f} % of the acceleration limit"
        )

    skill = Skill().fit(align(demonstrations))
    print(f"learned {skill.gmr_.n_components_} components from {len(demonstrations)} recordings of a person")

    # The robot reproduces the motion alone, around a ball that was not there in the demonstrations.
    middle = skill.generate(Pose(skill.start_.position, begin.quaternion)).positions
    ball = Sphere(middle[len(middle) // 2] + np.array([0.0, 0.0, 0.02]), 0.03, name="ball")
    for name, scene in {"nothing in the way": Scene(), "a ball on the path": Scene(None, [ball])}.items():
        robot = SimulatedRobot(arm, scene=scene, q=find_posture(arm, skill.start_, q0=start))
        policy = ACFRA(skill, tool_spheres=arm.tool_spheres)
        rollout = reproduce(policy, robot, scene.at, timeout=20.0, safety=SafetyFilter(arm, clearance=0.02))
        ends = 1e3 * np.linalg.norm(rollout.trajectory.positions[-1] - skill.goal_.position)
        near = f", {1e3 * rollout.min_clearance:.0f} mm from the ball" if scene.obstacles else ""
        print(f"{name}: {rollout.reason}, {ends:.1f} mm from the person's end point{near}")


if __name__ == "__main__":
    main()
