"""``imitarm benchmark static``: run, tune and compare the avoidance methods in static scenes."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from imitarm.benchmark.experiment import plain, write_text
from imitarm.benchmark.provenance import code_version, origin
from imitarm.benchmark.running import run_experiments
from imitarm.benchmark.static import (
    RESULTS,
    StaticExperiment,
    StaticResult,
    method_names,
    policy_class,
    run_experiment,
    saved_skill,
)
from imitarm.benchmark.static_claims import cost_law, static_tables
from imitarm.benchmark.static_scaling import scaling_tables
from imitarm.benchmark.static_scenes import ANY_SKILL, FAMILIES, SPLITS, static_case
from imitarm.benchmark.static_tables import ORACLE, OURS, StaticResults, checked_refusals_table, success_table
from imitarm.benchmark.static_tuning import DRAWS, Search, tune, tuned_options, write_tuned
from imitarm.cli.benchmark_options import (
    Actions,
    add_fill,
    add_saved,
    add_workers,
    command_line,
    place_of,
    report_tables,
    run_with_progress,
    scenes_to_play,
    workers_of,
)
from imitarm.cli.outputs import check_outputs
from imitarm.cli.screen import progress_bar, remark, say
from imitarm.errors import InputError

_FOLDER = Path("benchmark-static")
COVERED = "S6"
"""Family of scenes in which no path exists, so that every method must refuse to move."""
_SETTINGS = ("default", "tuned")


def add_static(parsers: Any) -> None:
    """Add the parser of the command."""
    static = parsers.add_parser("static", help="compare avoidance methods in random static scenes (thesis Table 4.1)")
    _add_scenes(static, count=100, split="test")
    static.add_argument(
        "--settings",
        nargs="+",
        choices=_SETTINGS,
        default=list(_SETTINGS),
        help="options of the methods: default, tuned, or both (default: both)",
    )
    static.add_argument(
        "--teachers",
        type=int,
        nargs="+",
        default=[1],
        metavar="N",
        help="number of synthetic teachers of a skill; default: 1",
    )
    static.add_argument(
        "--skill",
        nargs="+",
        default=[],
        metavar="FILE",
        help=f"skill files; the obstacles are placed on the paths of the skills, in the families {' '.join(ANY_SKILL)}",
    )
    static.add_argument(
        "--torque",
        type=int,
        default=0,
        metavar="N",
        help="also compute joint torques in the first N scenes of each family",
    )
    static.add_argument(
        "--memory",
        type=int,
        default=0,
        metavar="N",
        help="also measure memory use in the first N scenes of each family",
    )
    _add_running(static)
    static.set_defaults(benchmark=_run)
    actions = static.add_subparsers(
        action=Actions, metavar="ACTION", title="actions; if none is given, the experiments are run"
    )
    tuning = actions.add_parser("tune", help="search for the best options of each method on validation scenes")
    solvable = [family for family in FAMILIES if family != COVERED]  # no draw could succeed in the others
    _add_scenes(tuning, count=5, split="validation", families=solvable)
    tuning.add_argument(
        "--draws",
        type=int,
        default=DRAWS,
        metavar="N",
        help=f"number of option sets tried for each method; default: {DRAWS}",
    )
    tuning.add_argument("--save", type=Path, metavar="FILE", help="file of the best options; default: DIR/tuned.json")
    _add_running(tuning)
    tuning.set_defaults(benchmark=_tune)
    scaling = actions.add_parser(
        "scaling", help="measure time and success for 1 to 20 obstacles and for 1 to 16 tool spheres"
    )
    scaling.add_argument("--methods", nargs="+", default=[OURS], metavar="NAME", help=f"default: {OURS}")
    scaling.add_argument(
        "--count",
        type=int,
        default=10,
        metavar="N",
        help="number of scenes for each number of obstacles or spheres; default: 10",
    )
    scaling.add_argument("--first", type=int, default=2000, metavar="N", help="first seed; default: 2000")
    add_fill(scaling)
    scaling.set_defaults(benchmark=_scaling)
    refusals = actions.add_parser(
        "refusals", help=f"check with an independent search whether a path exists where {OURS} refused"
    )
    _add_scenes(refusals, count=100, split="test", methods=False)
    _add_running(refusals)
    add_fill(refusals)
    refusals.set_defaults(benchmark=_refusals)
    comparison = actions.add_parser("compare", help="print the tables of saved results")
    comparison.add_argument("folders", type=Path, nargs="+", metavar="FOLDER", help="folders of results")
    comparison.add_argument("--report", type=Path, metavar="FILE", help="write a page with figures and playback (HTML)")
    comparison.add_argument("--json", type=Path, metavar="FILE", help="write the tables as JSON")
    comparison.add_argument("--markdown", type=Path, metavar="FILE", help="write the tables as Markdown")
    comparison.add_argument(
        "--play",
        nargs="+",
        default=[],
        metavar="FAMILY,DIMENSION,SEED",
        help="scenes to draw, e.g. S5,3,2004",
    )
    add_fill(comparison)
    comparison.set_defaults(benchmark=_compare)


def _add_scenes(
    parser: argparse.ArgumentParser,
    *,
    count: int,
    split: str,
    families: Sequence[str] = FAMILIES,
    methods: bool = True,
) -> None:
    if methods:
        parser.add_argument(
            "--methods",
            nargs="+",
            metavar="NAME",
            help="policies that plan a whole path, and reference methods; default: all",
        )
    parser.add_argument(
        "--families",
        nargs="+",
        choices=FAMILIES,
        default=list(families),
        metavar="NAME",
        help=f"default: {' '.join(families)}",
    )
    parser.add_argument("--dimensions", nargs="+", type=int, choices=(2, 3), default=[2, 3], help="default: 2 3")
    parser.add_argument(
        "--count",
        type=int,
        default=count,
        metavar="N",
        help=f"number of scenes of each family in each dimension; default: {count}",
    )
    first, end = SPLITS[split]
    text = f"first seed; seeds {first} to {end - 1} are for {split}"
    parser.add_argument("--first", type=int, default=first, metavar="N", help=text)


def _add_running(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--out", type=Path, default=_FOLDER, metavar="DIR", help=f"folder of results; default: {_FOLDER}"
    )
    add_saved(parser)
    add_workers(parser)


def _scenes(arguments: argparse.Namespace) -> list[tuple[str, int, int]]:
    if arguments.count < 1 or arguments.first < 0:
        raise InputError(f"--count must be at least 1 and --first at least 0: {arguments.count}, {arguments.first}")
    seeds = range(arguments.first, arguments.first + arguments.count)
    found = [(family, d, seed) for seed in seeds for family in arguments.families for d in arguments.dimensions]
    return list(dict.fromkeys(found))


def experiments_of(arguments: argparse.Namespace) -> list[StaticExperiment]:
    """Return the experiments that the options describe; experiments in the same scene follow one another."""
    found: dict[StaticExperiment, None] = {}
    for skill, scene in _scenes_of_skills(arguments):
        number = scene[2] - arguments.first
        for teachers in arguments.teachers:
            for method in arguments.methods or method_names():
                for setting in arguments.settings:
                    options = tuned_options(method) if setting == "tuned" else ()
                    if setting == "tuned" and not options and "default" in arguments.settings:
                        continue
                    more = {"torque": number < arguments.torque, "memory": number < arguments.memory}
                    found[StaticExperiment(*scene, method, teachers, options, **more, skill=skill)] = None
    return list(found)


def _scenes_of_skills(arguments: argparse.Namespace) -> list[tuple[str, tuple[str, int, int]]]:
    """Return the name of the skill file and the scene of each experiment.

    Without ``--skill``, the name is empty. A scene is left out if the path of the skill is too short for the obstacles
    of the scene.
    """
    if not arguments.skill:
        return [("", scene) for scene in _scenes(arguments)]
    if arguments.teachers != [1]:
        raise InputError("--teachers: the skills come from files; give either --teachers or --skill")
    if tuple(arguments.families) == FAMILIES:
        arguments.families = list(ANY_SKILL)
    wanted = [(skill, scene) for scene in _scenes(arguments) for skill in arguments.skill]
    own = sorted(set(arguments.families) - set(ANY_SKILL))
    if own:
        raise InputError(f"--families {' '.join(own)}: with --skill, choose from {' '.join(ANY_SKILL)}")
    found = [(skill, scene) for skill, scene in wanted if _exists(skill, scene)]
    if len(found) < len(wanted):
        remark(
            f"left out {len(wanted) - len(found)} of {len(wanted)} scenes: the skill's path is too short for their "
            "obstacles"
        )
    return found


def _exists(skill: str, scene: tuple[str, int, int]) -> bool:
    learned = saved_skill(skill)
    try:
        static_case(*scene, skill=learned)
    except InputError:
        return False
    return True


def _run(arguments: argparse.Namespace) -> int:
    """Run the experiments; print the rates of success, the speed, and how the time depends on the obstacles."""
    wanted, workers = experiments_of(arguments), workers_of(arguments)
    store = RESULTS.store(arguments.out, reuse=arguments.reuse)
    done = run_with_progress("planning", wanted, run_experiment, store, workers, fresh=arguments.fresh)
    results = StaticResults(done.outcomes)
    report_tables([success_table(results)], None, [code_version()])
    say(done.summary)
    for row in results.rows:
        slope, error, n = cost_law(results, row)
        if row.split(",")[0] == OURS and n > 2:
            say(
                f"{row}: processor time grows with the number of obstacles to the power {slope:.2f} (standard error "
                f"{error:.2f})"
            )
    say(f"compare the methods: imitarm benchmark static compare {arguments.out}")
    return 0


def _tune(arguments: argparse.Namespace) -> int:
    """Search the options of the methods, and write the best ones."""
    scenes, (_, end) = _scenes(arguments), SPLITS["validation"]
    if arguments.first < SPLITS["validation"][0] or arguments.first + arguments.count > end:
        remark(
            "the scenes are not validation scenes: options tuned on test scenes must not be tested on the same scenes"
        )
    search = Search(tuple(scenes), arguments.draws)
    methods = arguments.methods or [m for m in method_names() if len(search.options(m)) > 1]
    store = RESULTS.store(arguments.out, reuse=arguments.reuse)
    path: Path = arguments.save or arguments.out / "tuned.json"
    log = arguments.out / "draws.json-lines"
    with progress_bar() as bar:
        task = bar.add_task("tuning", total=None)
        best = tune(
            methods,
            search,
            store,
            workers_of(arguments),
            log=log,
            on_done=lambda done, of: bar.update(task, completed=done, total=of),
        )
    for method, draw in best.items():
        options = ", ".join(f"{name} {value:g}" for name, value in draw.options) or "default options"
        found = f"{100 * draw.success:.1f} % success, RMSE {1e3 * draw.rmse:.1f} mm"
        say(f"{method}: {found} with {options} (draw {draw.number})")
    write_tuned(best, search, path)
    say(f"wrote {log}", f"wrote {path}")
    return 0


def _scaling(arguments: argparse.Namespace) -> int:
    """Print the tables of time and success over the number of obstacles and spheres."""
    if arguments.count < 1 or arguments.first < 0:
        raise InputError(f"--count must be at least 1 and --first at least 0: {arguments.count}, {arguments.first}")
    place = place_of(arguments, "static scaling")
    for method in arguments.methods:
        policy_class(method)
    with progress_bar() as bar:
        task = bar.add_task("planning", total=None)
        tables = scaling_tables(
            arguments.methods,
            range(arguments.first, arguments.first + arguments.count),
            on_done=lambda done, of: bar.update(task, completed=done, total=of),
        )
    report_tables(tables, place, [code_version()])
    return 0


def _refusals(arguments: argparse.Namespace) -> int:
    """Run the default method, check its refusals with the oracle, and print the counts for each family."""
    place, workers = place_of(arguments, "static refusals"), workers_of(arguments)
    store = RESULTS.store(arguments.out, reuse=arguments.reuse)
    wanted = [StaticExperiment(*scene, OURS) for scene in _scenes(arguments)]
    done: list[StaticResult] = []
    with progress_bar() as bar:
        for name in (OURS, ORACLE):
            task = bar.add_task(name, total=len(wanted))
            found = run_experiments(
                wanted,
                run_experiment,
                store,
                workers,
                fresh=arguments.fresh,
                on_done=lambda done, of, task=task: bar.update(task, completed=done, total=of),  # type: ignore[misc]
            )
            done += found
            wanted = [replace(r.experiment, method=ORACLE) for r in found if r.outcome == "refused"]
    report_tables([checked_refusals_table(StaticResults(done))], place, [r.code for r in done])
    return 0


def _compare(arguments: argparse.Namespace) -> int:
    """Print the tables of saved results, and write files."""
    place = place_of(arguments, "static")
    outputs = [("--report", arguments.report), ("--json", arguments.json), ("--markdown", arguments.markdown)]
    check_outputs([outputs[0]], [("--fill", arguments.fill), *outputs[1:]], new_folders=True)
    chosen = scenes_to_play(arguments, "S5,3,2004")
    found = RESULTS.read_folders(arguments.folders)
    results, versions = StaticResults(found), [r.code for r in found]
    tables = static_tables(results)
    if set(versions) != {code_version()}:
        remark(origin(versions))
    report_tables(tables, place, versions)
    if arguments.markdown is not None:
        write_text(arguments.markdown, "\n".join(table.markdown() for table in tables))
        say(f"wrote {arguments.markdown}")
    if arguments.json is not None:
        content = {
            "command": command_line(),
            "code": sorted(set(versions)),
            "tables": [
                {"title": t.title, "columns": list(t.columns), "rows": [list(r) for r in t.rows], "note": t.note}
                for t in tables
            ],
        }
        write_text(arguments.json, json.dumps(plain(content), indent=1, allow_nan=False))
        say(f"wrote {arguments.json}")
    if arguments.report is not None:
        from imitarm.benchmark.static_report import write_static_report  # noqa: PLC0415 (draws: needs an extra)
        from imitarm.cli.run_scene import provenance  # noqa: PLC0415

        facts = provenance(results=origin(versions), experiments=len(found))
        say(f"wrote {write_static_report(results, tables, arguments.report, provenance=facts, scenes=chosen)}")
    return 0
