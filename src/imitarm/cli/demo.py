"""``imitarm demo``: learn to sweep, sweep around standing and moving obstacles, and write a report."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from rich.progress import Progress, TaskID

from imitarm.cli.outputs import check_outputs
from imitarm.cli.run_scene import learning_summary, provenance, run_scene, show_results
from imitarm.cli.screen import progress_bar, say
from imitarm.control_loop.observer import SensorModel, TrackedScene
from imitarm.demonstrations import compute_alignment, lint
from imitarm.errors import InputError
from imitarm.files.document import write_text
from imitarm.perception import ObstacleTracker
from imitarm.policies import ACFRA, ADAPTERS, HORIZONTAL_ONLY, Policy
from imitarm.robots import SimulatedRobot
from imitarm.scene import Scene
from imitarm.skills import Skill
from imitarm.tasks import reaching_person
from imitarm.tasks.pushed_cube import LINKS, sweeping_rcamo
from imitarm.tasks.sweep import DEMONSTRATIONS, MOVING_SCENES, NUMBERED_SCENES, PERSON_REACHES, SCENES, SweepTask
from imitarm.trajectory import Demonstration
from imitarm.viewer import Report, SceneResult, as_data, write_report

EPILOG = """\
examples:
  imitarm demo
  imitarm demo --out results --method mapf
  imitarm demo --out demo_7 --seed 7
  imitarm demo --out person --scenes person_reaches
  imitarm demo --out thesis --scenes T1 T2 T3 T4 T5 T6 T7 T8

The package contains eight demonstrations: a synthetic teacher guides the simulated Sawyer by hand to sweep a table.
The command checks and aligns the demonstrations, and learns a skill from them.
The command then reproduces the skill in seven scenes.
One scene has no obstacles, four have standing obstacles, and two have moving obstacles.
With --scenes, the command uses the scenes that you name instead.
In the scene person_reaches, a person reaches across the path of the brush.
A simulated sensor and a tracker observe the moving obstacles (noise 5 mm, 30 frames per second, 33 ms delay).
A simulated skeleton camera and a tracker observe the person (error 12 mm, 30 frames per second, 33 ms delay).
T1 to T8 are eight scenes with two to four obstacles, modelled on the eight tasks of the thesis (Table 4.1).
The command writes skill.json, report.html (opens offline in any browser) and results.json to FOLDER.
The command replaces existing files only with --force.
The exit status is 1 if a scene fails or the arm touches an obstacle.
"""

DEMO_SCENES = (
    "free",
    "two_boxes",
    "tall_and_low",
    "boxes_and_cone",
    "cone_first",
    "pushed_box",
    "pushed_box_and_bottle",
)

_MAX_ACCELERATION = 7.0  # [m/s^2] of the Sawyer's brush; more would tilt the brush until it touches the table

_SUMMARY = (
    "A Sawyer learns from eight demonstrations to sweep crumbs into a dustpan. The Sawyer then sweeps "
    "tables on which new obstacles stand in the way. Only the parts of the learned path that are near an obstacle are "
    "moved, and only as far as needed for the required clearance. A synthetic teacher gave the "
    "demonstrations by guiding the simulated arm by hand. Clearance, torques and the number of swept crumbs are "
    "measured in the simulator, not taken from the plan. In the scenes with moving obstacles, a tracker estimates "
    "their positions and velocities from noisy, late measurements, and the policy RCAMO evades them step by step."
)

_CAPTIONS = {
    "pushed_box": "A box is pushed into the path of the brush, out of it, and into it again behind the crumbs.",
    "pushed_box_and_bottle": "A bottle and a box are pushed into the path of the brush, one from each side; a low box "
    "stands beside the path.",
    PERSON_REACHES: "A person reaches across the path of the brush before the crumbs, and close to the path behind "
    "them. The arm is modelled as two capsules: the upper arm, and the forearm with the hand. A tracker estimates "
    "their motion from the skeletons of a simulated camera.",
    "free": "No obstacle is in the way: the brush follows the learned path.",
    "two_boxes": "Two boxes stand on the learned path, one in front of the crumbs and one behind them.",
    "tall_and_low": "A tall and a low box stand on opposite sides of the learned path.",
    "boxes_and_cone": "A box and a cone stand on the learned path, and a tall box narrows the space around them.",
    "cone_first": "A cone and a box stand on the learned path, and a large box narrows the space around them.",
    "box_and_cone": "A flat box and a cone stand on the learned path, one in front of the crumbs and one behind them.",
    "three_boxes": "Two boxes stand on the learned path, and a large box narrows the space beside the second one.",
    "two_boxes_two_cones": "A box and a cone stand on the learned path; another box and cone narrow the space.",
    "three_boxes_and_cone": "A box and a cone stand on the learned path; opposite each of them stands another box.",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument(
        "--out", type=Path, default=Path("demo"), metavar="FOLDER", help="folder for the results; default: demo"
    )
    parser.add_argument("--seed", type=int, default=0, help="seed for the positions of the crumbs; default: 0")
    parser.add_argument(
        "--method", choices=ADAPTERS, default="certified", help="method that adapts the path; default: certified"
    )
    parser.add_argument(
        "--scenes",
        nargs="+",
        choices=(*SCENES, *NUMBERED_SCENES, *MOVING_SCENES),
        metavar="NAME",
        help=f"scenes to sweep: {', '.join((*SCENES, *MOVING_SCENES))}, or T1 to T8; default: {', '.join(DEMO_SCENES)}",
    )
    parser.add_argument("--force", action="store_true", help="replace existing files")


def run(arguments: argparse.Namespace) -> int:
    """Learn, reproduce the skill in every scene and write the report; return 1 if a scene fails.

    Raises:
        InputError: when the folder cannot be created, or a file in it would be overwritten.
    """
    folder: Path = arguments.out
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"--out {folder}: cannot be created ({error.strerror}); name another folder") from error
    skill_file, page_file, results_file = (folder / name for name in ("skill.json", "report.html", "results.json"))
    check_outputs([("--out", path) for path in (skill_file, page_file, results_file)], [], force=arguments.force)
    task = SweepTask(seed=arguments.seed)
    names = dict.fromkeys(NUMBERED_SCENES.get(name, name) for name in arguments.scenes or DEMO_SCENES)
    with progress_bar() as progress:
        whole = progress.add_task("learning", total=len(names) + 2.0)
        arm = task.arm()
        shown = packaged_demonstrations()
        findings = lint(shown, arm=arm)
        alignment = compute_alignment(shown)
        skill = Skill().fit(alignment.demonstrations, notes=[str(f) for f in findings] + alignment.notes())
        skill.save(skill_file)
        progress.advance(whole)
        results = [
            _sweep(task, name, skill, alignment.demonstrations, arguments.method, progress, whole) for name in names
        ]
        progress.update(whole, description="writing the report")
        report = Report(
            title="Sweeping a table around obstacles",
            scenes=results,
            summary=_SUMMARY,
            learning=learning_summary(skill, alignment.demonstrations, findings, alignment),
            provenance=provenance(seed=arguments.seed, demonstrations="synthetic teacher, seeds 0 to 7"),
        )
        page = write_report(report, page_file)
        _write_json(as_data(report), results_file)
        progress.advance(whole)
    show_results(report)
    say(f"report: {page}")
    return 0 if report.passed else 1


def packaged_demonstrations() -> list[Demonstration]:
    """Return the demonstrations of sweeping that are part of the package."""
    paths = sorted(DEMONSTRATIONS.glob("*.csv"))
    return [replace(Demonstration.load(path), source=path.name) for path in paths]  # no folder names in the skill file


def _sweep(
    task: SweepTask,
    name: str,
    skill: Skill,
    demonstrations: tuple[Demonstration, ...],
    method: str,
    progress: Progress,
    whole: TaskID,
) -> SceneResult:
    """Reproduce the sweep in one scene, with ACFRA around standing obstacles and RCAMO around moving ones."""
    progress.update(whole, description=f"sweeping: {name}")
    before = progress.tasks[0].completed
    policy: Policy
    observe: Callable[[float], Scene] | None = None
    links: float | None = None
    if name in MOVING_SCENES:
        robot, policy, observe, links = _among_moving(task, name, skill)
    else:
        robot = task.robot(task.scene(name))
        policy = ACFRA(
            skill,
            method=method,
            arm=robot.arm,
            tool_radius=task.tool_radius,  # for the methods that plan only the tool
            clearance=task.clearance,
            forbidden=HORIZONTAL_ONLY,  # the bristles stay on the table
            pinned=[task.dirt_time(skill.gmr_.trajectory(1000))],
        )
    result = run_scene(
        name,
        name.replace("-", " ").replace("_", " "),
        robot,
        policy,
        clearance=task.clearance,
        tool_radius=task.tool_radius,
        demonstrations=demonstrations,
        evaluate=task.evaluate,
        observe=observe,
        link_clearance=links,
        caption=_CAPTIONS.get(name, ""),
        progress=lambda fraction: progress.update(whole, completed=before + fraction),
    )
    progress.update(whole, completed=before + 1.0)
    return result


def _among_moving(
    task: SweepTask, name: str, skill: Skill
) -> tuple[SimulatedRobot, Policy, Callable[[float], Scene], float]:
    """Return the robot in a scene with moving obstacles, the policy, the observer, and the clearance of the links [m].

    A skeleton camera observes a person; a simulated sensor observes all other obstacles.
    """
    moving = task.moving_scene(name)
    robot = task.robot(moving)
    if name == PERSON_REACHES:
        policy = sweeping_rcamo(
            skill, task, max_acceleration=reaching_person.MAX_ACCELERATION, tool_spheres=reaching_person.BRUSH_AND_WRIST
        )
        return robot, policy, reaching_person.ReachingPerson.observer(task.seed), reaching_person.LINKS
    policy = sweeping_rcamo(skill, task, max_acceleration=_MAX_ACCELERATION)
    return robot, policy, TrackedScene(moving, SensorModel(seed=task.seed), ObstacleTracker()), LINKS


def _write_json(data: object, path: Path) -> None:
    try:
        write_text(path, json.dumps(data, indent=2, allow_nan=False))
    except InputError as error:
        raise InputError(f"{error}; choose another folder with --out") from error
