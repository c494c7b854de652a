"""``imitarm demo``: learn a sweep from demonstrations, do it around obstacles, write a report."""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path

from rich.progress import Progress, TaskID

from imitarm.cli.outputs import check_outputs
from imitarm.cli.run_scene import learning_summary, provenance, run_scene, show_results
from imitarm.cli.screen import progress_bar, say
from imitarm.demonstrations import compute_alignment, lint
from imitarm.errors import InputError
from imitarm.files.document import write_text
from imitarm.policies import ACFRA, ADAPTERS, HORIZONTAL_ONLY
from imitarm.skills import Skill
from imitarm.tasks.sweep import DEMONSTRATIONS, SCENES, SweepTask
from imitarm.trajectory import Demonstration
from imitarm.viewer import Report, SceneResult, as_data, write_report

EPILOG = """\
examples:
  imitarm demo
  imitarm demo --out results --method mapf
  imitarm demo --seed 7

Eight demonstrations of a sweep come with the package: a seeded synthetic teacher guided the compliant simulated
Sawyer by hand. They are checked, aligned and learnt; the skill is then reproduced without obstacles and in four scenes
with obstacles. FOLDER gets skill.json, report.html (opens offline in any browser) and results.json; with --force they
may replace older ones.
Exit status 1 when a scene fails or something is touched.
"""

_SUMMARY = (
    "A Sawyer learns to sweep crumbs into a dustpan from eight demonstrations, then does it on tables where things "
    "stand in the way that were not there before. Only the parts of the learnt path near an obstacle move, by the "
    "least that keeps the asked clearance. The demonstrations were made by a synthetic teacher who hand-guides the "
    "simulated arm; clearance, torques and crumbs are measured by the simulator, not by the planner."
)

_CAPTIONS = {
    "free": "Nothing is in the way: the brush does what it was shown.",
    "two_boxes": "Two boxes stand on the learnt path, one before the dirt and one behind it.",
    "tall_and_low": "Boxes of other sizes, each on the other side of the path.",
    "boxes_and_cone": "A box and a cone stand on the path, and a tall box narrows the way round.",
    "cone_first": "A cone and a box stand on the path, and a large box narrows the way round.",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add what the command takes."""
    parser.add_argument("--out", type=Path, default=Path("demo"), metavar="FOLDER", help="default: demo")
    parser.add_argument("--seed", type=int, default=0, help="of where the crumbs lie; default: 0")
    parser.add_argument("--method", choices=ADAPTERS, default="certified", help="how to adapt; default: certified")
    parser.add_argument("--force", action="store_true", help="replace files that are there")


def run(arguments: argparse.Namespace) -> int:
    """Learn, reproduce in every scene, report; return 1 when a scene fails.

    Raises:
        InputError: when the folder can't be made, or a file in it would be lost.
    """
    folder: Path = arguments.out
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"--out {folder}: can't be made ({error.strerror}); name another folder") from error
    skill_file, page_file, results_file = (folder / name for name in ("skill.json", "report.html", "results.json"))
    check_outputs([("--out", path) for path in (skill_file, page_file, results_file)], [], force=arguments.force)
    task = SweepTask(seed=arguments.seed)
    with progress_bar() as progress:
        whole = progress.add_task("learning", total=len(SCENES) + 2.0)
        arm = task.arm()
        shown = packaged_demonstrations()
        findings = lint(shown, arm=arm)
        alignment = compute_alignment(shown)
        skill = Skill().fit(alignment.demonstrations, notes=[str(f) for f in findings] + alignment.notes())
        skill.save(skill_file)
        progress.advance(whole)
        results = [
            _sweep(task, name, skill, alignment.demonstrations, arguments.method, progress, whole) for name in SCENES
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
    """Return the demonstrations of the sweep that come with the package."""
    paths = sorted(DEMONSTRATIONS.glob("*.csv"))
    return [replace(Demonstration.load(path), source=path.name) for path in paths]  # a skill file names no folders


def _sweep(
    task: SweepTask,
    name: str,
    skill: Skill,
    demonstrations: tuple[Demonstration, ...],
    method: str,
    progress: Progress,
    whole: TaskID,
) -> SceneResult:
    """Reproduce the sweep in one scene."""
    scene = task.scene(name)
    progress.update(whole, description=f"sweeping: {name}")
    before = progress.tasks[0].completed
    robot = task.robot(scene)
    policy = ACFRA(
        skill,
        method=method,
        tool_radius=task.tool_radius,
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
        caption=_CAPTIONS.get(name, ""),
        progress=lambda share: progress.update(whole, completed=before + share),
    )
    progress.update(whole, completed=before + 1.0)
    return result


def _write_json(data: object, path: Path) -> None:
    try:
        write_text(path, json.dumps(data, indent=2, allow_nan=False))
    except InputError as error:
        raise InputError(f"{error}; choose another folder with --out") from error
