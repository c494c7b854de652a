"""``imitarm reproduce``: let a simulated arm reproduce a skill around obstacles."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imitarm.cli.outputs import check_outputs
from imitarm.cli.robot_options import add_robot_options, load_robot, robot_files
from imitarm.cli.run_scene import provenance, run_scene, show_results
from imitarm.cli.screen import progress_bar, remark, say
from imitarm.control_loop.observer import SensorModel, TrackedScene
from imitarm.errors import InputError
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.arm_kinematics import find_posture
from imitarm.kinematics.pose import Pose
from imitarm.perception import ObstacleTracker
from imitarm.policies import ADAPTERS, HORIZONTAL_ONLY, NOT_DOWN, POLICIES, Policy
from imitarm.robots import SimulatedRobot
from imitarm.scene import MovingScene, Scene, load_moving_scene, standard_fixtures
from imitarm.skills import Skill
from imitarm.tasks.watching import delayed, watched
from imitarm.trajectory import Demonstration
from imitarm.validation import finite_number, finite_vector
from imitarm.viewer import Report, write_report

EPILOG = """\
examples:
  imitarm reproduce sweep.json --robot sawyer --tool brush --keep-height
  imitarm reproduce pour.json --robot panda --tool gripper --scene bottles.yaml --report pour.html
  imitarm reproduce left.json --alternative right.json --robot panda --scene bottles.yaml
  imitarm reproduce pour.json --robot panda --scene bottles.yaml --clearance 30 --goal 40 -30 25
  imitarm reproduce pour.json --robot panda --scene moving.yaml --policy rcamo --sensor 5 30 33
  imitarm reproduce pour.json --robot panda --scene moving.yaml --policy rcamo --camera 150 0 90

The arm is simulated with its inertias and limits.
The simulator measures the clearance between its own shapes of the arm and of the obstacles.
The exit status is 1 if no path keeps the clearance, if the arm touched something, or if the motion did not finish.
"""

_NEAREST_CAMERA = 0.7  # [m] from the middle of the path
_FARTHEST_CAMERA = 4.5  # [m] likewise; obstacles behind the path are then still within the 5 m that the camera measures
_AROUND = 0.5  # [m] obstacles are searched so far around the learned path
FORBIDDEN = {"keep_height": HORIZONTAL_ONLY, "not_down": NOT_DOWN}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument("skill", metavar="SKILL", type=Path, help="skill file, written by 'imitarm learn'")
    add_robot_options(parser)
    parser.add_argument(
        "--scene", type=Path, metavar="FILE", help="file of obstacles and goal (YAML); default: no obstacles"
    )
    seen = parser.add_mutually_exclusive_group()
    seen.add_argument(
        "--sensor",
        nargs=3,
        type=float,
        metavar=("MM", "HZ", "MS"),
        help="observe the obstacles with a sensor and a tracker: standard deviation of the measured positions, frames "
        "per second, latency; default: true positions and velocities without delay",
    )
    seen.add_argument(
        "--camera",
        nargs=3,
        type=float,
        metavar=("X", "Y", "Z"),
        help="observe the obstacles with a depth camera at this position [cm], a detector and a tracker; the camera "
        "looks at the middle of the learned path, and watches for one second before the arm moves",
    )
    avoid = parser.add_argument_group("avoidance")
    avoid.add_argument(
        "--policy", choices=POLICIES, default="acfra", help="policy that reproduces the skill; default: acfra"
    )
    avoid.add_argument(
        "--alternative",
        type=Path,
        action="append",
        default=[],
        metavar="SKILL",
        help="skill of another demonstrated path of the same task (see 'imitarm learn --each-path'); acfra follows the "
        "path that needs the smallest displacement; may be repeated",
    )
    avoid.add_argument(
        "--method", choices=ADAPTERS, help="method by which the policy acfra adapts the path; default: certified"
    )
    avoid.add_argument(
        "--clearance", type=float, default=20.0, metavar="MM", help="required distance to every obstacle; default: 20"
    )
    avoid.add_argument(
        "--tool-radius",
        type=float,
        metavar="MM",
        help="use a sphere of this radius about the tool's tip instead of the tool's shape",
    )
    avoid.add_argument(
        "--tool-only",
        action="store_true",
        help="keep the clearance only for the tool, not for the links of the arm; for comparisons only",
    )
    avoid.add_argument(
        "--max-tilt",
        type=float,
        metavar="DEG",
        help="largest angle by which the tool is rotated away from the learned rotation, to make room for the arm; "
        "default: two standard deviations of the demonstrated rotation",
    )
    avoid.add_argument(
        "--goal-tilt",
        type=float,
        metavar="DEG",
        help="the same angle at the goal; the tool is rotated there only if "
        "the arm would otherwise be too close to an obstacle; default: 0",
    )
    held = avoid.add_mutually_exclusive_group()
    held.add_argument("--keep-height", action="store_true", help="move the path only sideways, as on a table")
    held.add_argument("--not-down", action="store_true", help="never move the path downwards")
    moved = parser.add_argument_group("different start and goal")
    triple: Any = {"nargs": 3, "type": float, "metavar": ("X", "Y", "Z")}
    moved.add_argument("--start", **triple, help="start position of the tool [cm]; default: the learned start")
    moved.add_argument(
        "--goal",
        **triple,
        help="goal position of the tool [cm]; default: the goal in the scene file, else the learned goal",
    )
    parser.add_argument(
        "--control", choices=("position", "torque"), default="position", help="control mode of the simulated drives"
    )
    output = parser.add_argument_group("output")
    output.add_argument("--out", type=Path, metavar="FILE", help="write the measured motion as a demonstration (CSV)")
    output.add_argument("--force", action="store_true", help="replace existing files")
    output.add_argument("--report", type=Path, metavar="FILE", help="write a page with 3-D playback and figures (HTML)")


def run(arguments: argparse.Namespace) -> int:
    """Reproduce the skill once; return 1 when it failed.

    Raises:
        InputError: when a file or an option is wrong.
        UnreachableError: when the arm can't reach the start.
    """
    inputs = [
        ("SKILL", arguments.skill),
        *(("--alternative", file) for file in arguments.alternative),
        ("--scene", arguments.scene),
        *robot_files(arguments),
    ]
    check_outputs([("--out", arguments.out), ("--report", arguments.report)], inputs, force=arguments.force)
    _check_numbers(arguments)
    skill = Skill.load(arguments.skill)
    arm = load_robot(arguments)
    tracked = MovingScene(Scene()) if arguments.scene is None else load_moving_scene(arguments.scene).from_stamp()
    scene = tracked.scene
    if arguments.goal is not None:
        scene = replace(scene, goal=Pose(0.01 * np.array(arguments.goal), skill.goal_.quaternion))
    if not scene.fixtures:
        scene = replace(scene, fixtures=standard_fixtures())
    scene.check()
    start = _start(skill, arm, arguments.start)
    if scene.goal is not None:  # said before anything moves
        turn = skill.goal_.quaternion if skill.gmr_.has_orientation_ else start.quaternion
        find_posture(arm, Pose(scene.goal.position, turn))
    truth = MovingScene(scene, tracked.motions)
    world = truth if arguments.camera is None else delayed(truth)
    robot = SimulatedRobot(
        arm, scene=world.scene, motion=world.motions or None, control=arguments.control, q=find_posture(arm, start)
    )
    spheres = _tool(skill, arm, arguments.tool_radius)
    policy = _policy(arguments, skill, arm, spheres)
    with progress_bar() as progress:
        moving = progress.add_task("reproducing", total=1.0)
        result = run_scene(
            "scene",
            f"{skill.task_ or 'skill'} on {arm.name}",
            robot,
            policy,
            clearance=1e-3 * arguments.clearance,
            link_clearance=None if arguments.tool_only else 1e-3 * arguments.clearance,
            tool_spheres=spheres,
            observe=_observer(arguments, truth, robot, skill),
            progress=lambda share: progress.update(moving, completed=share),
        )
    report = Report(title=f"{skill.task_ or 'A skill'} on {arm.name}", scenes=[result], provenance=provenance())
    if arguments.out is not None and result.rollout is not None:
        source = f"{arm.name}, simulated, from {arguments.skill.name}"
        Demonstration(result.rollout.trajectory, result.rollout.joints, skill.task_, source).save(arguments.out)
        say(f"wrote {arguments.out}")
    elif arguments.out is not None:
        remark(f"the robot did not move, so {arguments.out} was not written")
    if arguments.report is not None:
        say(f"wrote {write_report(report, arguments.report)}")
    show_results(report)
    return 0 if report.passed else 1


def _observer(
    arguments: argparse.Namespace, truth: MovingScene, robot: SimulatedRobot, skill: Skill
) -> Callable[[float], Scene] | None:
    """Return the function by which the policy observes the scene.

    None: the policy uses the scene at the start, in which obstacles keep their velocities.
    """
    scene = truth.scene
    if arguments.camera is not None:
        path = skill.gmr_.trajectory(100).positions
        eye = [0.01 * finite_number(value, "--camera", "cm") for value in arguments.camera]
        middle = 0.5 * (path.min(axis=0) + path.max(axis=0))
        if np.linalg.norm(middle - eye) < _NEAREST_CAMERA:
            raise InputError(
                f"--camera: {1e2 * np.linalg.norm(middle - eye):.0f} cm from the learned path is too near; the camera "
                f"measures only depths above 50 cm, so place it at least {1e2 * _NEAREST_CAMERA:.0f} cm away"
            )
        if np.linalg.norm(middle - eye) > _FARTHEST_CAMERA:
            raise InputError(
                f"--camera: {np.linalg.norm(middle - eye):.1f} m from the learned path is too far; the camera measures "
                f"only depths up to 5 m, so place it at most {_FARTHEST_CAMERA:g} m away. Its position is in cm"
            )
        workspace = (path.min(axis=0) - _AROUND, path.max(axis=0) + _AROUND)
        surfaces, goal = scene.fixtures, scene.goal
        return watched(robot, eye, middle, workspace, surfaces=surfaces, goal=goal, fixtures=surfaces)
    if arguments.sensor is None:
        return truth.at if truth.motions else None
    noise, rate, latency = arguments.sensor
    try:
        model = SensorModel(noise=1e-3 * noise, rate=rate, latency=1e-3 * latency)
    except InputError as error:
        raise InputError(f"--sensor: {error}") from error
    return TrackedScene(truth, model, ObstacleTracker(), goal=scene.goal, fixtures=scene.fixtures)


def _policy(arguments: argparse.Namespace, skill: Skill, arm: ArmModel, spheres: NDArray[np.float64]) -> Policy:
    """Return the chosen policy, created with the arguments that all policies share."""
    options: dict[str, Any] = {
        "tool_spheres": spheres,
        "clearance": 1e-3 * arguments.clearance,
        "forbidden": next((FORBIDDEN[key] for key in FORBIDDEN if getattr(arguments, key)), ()),
    }
    whole_arm = not arguments.tool_only and arguments.tool_radius is None
    if whole_arm:
        options["arm"] = arm
    for name in ("max_tilt", "goal_tilt"):
        value, option = getattr(arguments, name), f"--{name.replace('_', '-')}"
        if value is not None:
            if not whole_arm:
                raise InputError(
                    f"{option} applies only to a plan of the whole arm: leave out --tool-only and --tool-radius"
                )
            if not POLICIES[arguments.policy].takes(name):
                raise InputError(f"{option}: the policy {arguments.policy} has no such option; leave it out")
            options[name] = math.radians(finite_number(value, option, "degrees", at_least=0.0))
    if arguments.method is not None:
        if arguments.policy != "acfra":
            raise InputError(f"--method is an option of --policy acfra, not of {arguments.policy}; leave out --method")
        options["method"] = arguments.method
    if arguments.alternative:
        if arguments.policy != "acfra":
            raise InputError(f"--alternative is an option of --policy acfra, not of {arguments.policy}; leave it out")
        options["alternatives"] = [Skill.load(file) for file in arguments.alternative]
    return POLICIES[arguments.policy].build(skill, **options)


def _check_numbers(arguments: argparse.Namespace) -> None:
    """Reject lengths and positions that can't be used, with the name and the unit of their options."""
    finite_number(arguments.clearance, "--clearance", "mm", at_least=0.0)
    if arguments.tool_radius is not None:
        finite_number(arguments.tool_radius, "--tool-radius", "mm", at_least=0.0)
    for option, position in (("--start", arguments.start), ("--goal", arguments.goal)):
        if position is not None:
            finite_vector(position, 3, option, "cm")


def _start(skill: Skill, arm: ArmModel, centimetres: Sequence[float] | None) -> Pose:
    """Return the start pose of the tool; if the skill has no orientation, use the rotation at the home posture."""
    learned = skill.start_
    position = learned.position if centimetres is None else 0.01 * np.array(centimetres)
    return Pose(position, learned.quaternion if skill.gmr_.has_orientation_ else arm.tool_pose(arm.home).quaternion)


def _tool(skill: Skill, arm: ArmModel, millimetres: float | None) -> NDArray[np.float64]:
    """Return spheres that cover the tool, one row x y z radius for each sphere [m]."""
    if millimetres is not None:
        return np.array([[0.0, 0.0, 0.0, 1e-3 * millimetres]])
    if skill.gmr_.has_orientation_:
        return arm.tool_spheres
    return np.array([[0.0, 0.0, 0.0, arm.tool_radius]])
