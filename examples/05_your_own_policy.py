"""Write your own policy and register it. Then compare it with a built-in policy under the same conditions.

In every control step, a policy receives an `Observation` (time, state of the arm, pose of the tool, scene) and returns
a `Command`. The robot, the safety filter, the inverse kinematics and the measured clearance are the same for all
policies.
"""

from __future__ import annotations

import numpy as np

from imitarm import (
    POLICIES,
    ArmModel,
    Command,
    Demonstration,
    Observation,
    Policy,
    Pose,
    SafetyFilter,
    Scene,
    SimulatedRobot,
    Skill,
    Sphere,
    Trajectory,
    find_posture,
    reproduce,
)


class Repelled(Policy):
    """Follow the learned path. Near an obstacle, a repulsive force pushes the tool away (thesis Eq 2.19)."""

    influence, gain = 0.06, 4.0  # [m], [1/s]

    def reset(self, observation: Observation) -> None:
        """Start the learned path at the measured pose of the tool."""
        self.path = self.skill.generate(observation.tool_to_base, observation.scene.goal)

    def step(self, observation: Observation, dt: float) -> Command:
        """Return a velocity that pulls the tool towards the path and pushes it away from every near obstacle."""
        positions, quaternions = self.path.at([observation.time + dt])
        twist = self.gain * observation.tool_to_base.error_to(Pose(positions[0], quaternions[0]))
        for obstacle in observation.scene.obstacles:
            distance, normal = obstacle.distance_and_gradient(observation.tool_to_base.position)
            d = max(float(distance) - self.tool_spheres[0, 3], 0.01)
            if d < self.influence:
                twist[:3] += 2e-6 * (1.0 / d - 1.0 / self.influence) / d**2 * normal
        return Command(twist, progress=min(observation.time / self.path.duration, 1.0))

    def finished(self, observation: Observation) -> bool:
        """Return whether the duration of the motion is over and the tool has reached the goal."""
        away = np.linalg.norm(self.path.positions[-1] - observation.tool_to_base.position)
        return observation.time > self.path.duration and bool(away < 0.005)


POLICIES.register("repelled", Repelled)


def reaches(start: Pose, goal: Pose, n: int = 5) -> list[Demonstration]:
    """Generate synthetic demonstrations of a reach along an arch; the arch varies between demonstrations."""
    rng = np.random.default_rng(0)
    u = np.linspace(0.0, 1.0, 150)[:, None]
    pace = 10 * u**3 - 15 * u**4 + 6 * u**5
    quaternions = np.tile(start.quaternion, (len(u), 1))
    shown = []
    for i in range(n):
        arch = np.sin(np.pi * pace) * rng.normal([0.0, 0.0, 0.05], [0.01, 0.02, 0.01])
        positions = start.position + pace * (goal.position - start.position) + arch
        shown.append(
            Demonstration(Trajectory(4.0 * u[:, 0], positions, quaternions), task="reach", source=f"reach {i}")
        )
    return shown


def main() -> None:
    arm = ArmModel.load("panda", tool="gripper")
    tool = arm.tool_pose(arm.home)
    middle = tool.position - np.array([0.0, 0.0, 0.05])
    aside = np.array([0.0, 0.25, 0.0])
    start, goal = Pose(middle - aside, tool.quaternion), Pose(middle + aside, tool.quaternion)
    skill = Skill(n_components=7).fit(reaches(start, goal))

    # Between two balls the pull along the path and the pushes balance: a local minimum, where a field that considers
    # only the nearest points stops or touches. ACFRA considers the whole path.
    on_path = middle + np.array([0.0, 0.0, 0.05])
    balls = [Sphere(on_path + side * np.array([0.08, 0.0, 0.0]), 0.05) for side in (-1.0, 1.0)]
    scenes = {
        "nothing in the way": Scene(),
        "a ball on the path": Scene(None, [Sphere(on_path + np.array([0.01, 0.0, 0.0]), 0.04)]),
        "two balls, one on each side": Scene(None, balls),
    }
    for name, scene in scenes.items():
        print(name)
        for key in ("acfra", "repelled"):
            # Where a policy fails, the safety filter can still keep every link clear, whatever the policy commands.
            for clearance in (None, 0.01):
                robot = SimulatedRobot(arm, scene=scene, q=find_posture(arm, start))
                policy = POLICIES[key](skill, tool_spheres=[[0.0, 0.0, 0.0, arm.tool_radius]])
                safety = SafetyFilter(arm, clearance=clearance)
                rollout = reproduce(policy, robot, scene.at, timeout=6.0, safety=safety)
                near = f"clearance {1e3 * rollout.min_clearance:.0f} mm, " if scene.obstacles else ""
                held = "" if clearance is None else ", the filter keeps a clearance of the links"
                print(f"  {key}{held}: {near}{rollout.trajectory.duration:.1f} s, {rollout.reason}")
                if rollout.success:
                    break


if __name__ == "__main__":
    main()
