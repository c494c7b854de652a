"""Reproduce a skill on a simulated arm around obstacles, and let the simulator measure the result.

The policy plans the motion of the whole arm, so that every moving part keeps the clearance. The simulator uses its own
shapes, inertias, limits and servos of the arm. It measures whether the arm follows the plan and keeps the clearance.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np

from imitarm import (
    ACFRA,
    HORIZONTAL_ONLY,
    Box,
    InfeasibleError,
    InputError,
    Pose,
    SafetyFilter,
    Scene,
    SimulatedRobot,
    Skill,
    align,
    find_posture,
    read,
    reproduce,
)
from imitarm.control_loop.reproduce import Step
from imitarm.tasks import DEMONSTRATIONS, SweepTask
from imitarm.viewer import FrameRecorder, Report, SceneResult, write_report

CLEARANCE = 0.02  # [m]


def main() -> None:
    skill = Skill(n_components=12).fit(align(read(DEMONSTRATIONS)))
    task = SweepTask()
    arm = task.arm()  # the same as ArmModel.load("sawyer", tool="brush")
    scene = task.scene("two_boxes")  # a packaged scene file; load_scene("yours.yaml") reads your own

    # The world: arm, table, dustpan, crumbs, and the scene's obstacles as solid bodies. Any arm in an empty world is
    # SimulatedRobot(arm, scene=scene). The arm begins where the skill does.
    robot = SimulatedRobot(arm, scene=scene, world=task.world(arm), q=find_posture(arm, task.start))

    # The policy plans the joints for the whole path when it is reset. It then follows the plan, and waits for the arm.
    policy = ACFRA(
        skill,
        arm=arm,
        clearance=CLEARANCE,
        forbidden=HORIZONTAL_ONLY,
        pinned=[task.dirt_time(skill.gmr_.trajectory(1000))],
    )

    frames = FrameRecorder(robot.model)  # for the playback in the report
    nearest: Counter[str] = Counter()

    def watch(step: Step) -> None:
        frames.note(robot.data)
        if step.clearance < 0.05:
            nearest[" to ".join(robot.nearest_pair() or ())] += 1

    # `observe` returns the scene at a given time; here it is the true scene of the simulator.
    # The safety filter checks every command again, before the arm gets it.
    rollout = reproduce(
        policy, robot, scene.at, timeout=40.0, safety=SafetyFilter(arm, clearance=CLEARANCE), on_step=watch
    )
    rollout = task.evaluate(robot, rollout)  # the success test of the task: is the dirt in the pan?

    adaptation = policy.adaptation
    print(f"{'done' if rollout.success else 'FAILED'}: {rollout.reason}")
    print(f"  {rollout.trajectory.duration:.1f} s, demonstrated in {skill.duration_:.1f} s")
    print(f"    certified clearance of arm and brush: {1e3 * adaptation.certified_clearance:.1f} mm")
    print(f"    measured clearance of arm and brush: {1e3 * rollout.min_clearance:.1f} mm")
    for pair, steps in nearest.most_common(3):
        print(f"    within 5 cm for {0.01 * steps:.1f} s: {pair}")
    effort = np.abs(rollout.torques).max(axis=0) / arm.max_torque
    print(
        f"  largest torque: {100 * effort.max():.0f} % of the rated torque of {arm.joint_names[int(effort.argmax())]}"
    )
    print(f"  commands that the robot reduced to keep a limit: {rollout.details['clamped'] or 'none'}")

    # An impossible task is refused before the robot moves.
    jar = Box(Pose(skill.goal_.position, [1.0, 0.0, 0.0, 0.0]), [0.05, 0.05, 0.1], name="jar")
    covered = Scene(None, [*scene.obstacles, jar])
    robot.reset()
    try:
        reproduce(policy, robot, covered.at)
    except InfeasibleError as refusal:
        print(f"\nwith a jar on the goal: {refusal}")

    # A page that plays the motion in 3-D and opens offline; it needs the extra `report`.
    result = SceneResult(
        name="two_boxes",
        title="two boxes",
        scene=scene,
        success=rollout.success,
        required_clearance=CLEARANCE,
        rollout=rollout,
        adaptation=adaptation,
        tool_radius=task.tool_radius,
        recording=frames.recording(),
        torque_limits=arm.max_torque,
        joint_names=arm.joint_names,
    )
    try:
        page = write_report(Report("Sweeping around two boxes", [result]), Path("sweep.html"))
        print(f"\nwrote {page.name}, {page.stat().st_size / 1e6:.1f} MB: open it in a browser")
    except InputError as error:
        print(f"\nno report: {error}")


if __name__ == "__main__":
    main()
