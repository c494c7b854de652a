"""``imitarm benchmark``: measure the methods and compare the results with those of the thesis."""

from __future__ import annotations

import argparse
import importlib.util
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from imitarm.benchmark import avoidance, real_motions, refusals, repeated_tasks
from imitarm.benchmark.experiment import METHODS, Result
from imitarm.benchmark.mapping import MappingBenchmark, run_all, tables, write_tables
from imitarm.benchmark.mapping_tables import TEST, Results
from imitarm.benchmark.provenance import code_version, origin
from imitarm.benchmark.recordings import KINDS
from imitarm.benchmark.refusal_proof import Answer
from imitarm.benchmark.repeated_tasks import REPEATED_TASKS, RepeatedTask
from imitarm.cli.benchmark_moving import add_moving
from imitarm.cli.benchmark_options import add_fill, add_saved, add_workers, place_of, report_tables, workers_of
from imitarm.cli.benchmark_perception import add_perception
from imitarm.cli.benchmark_placements import add_placements
from imitarm.cli.benchmark_real_time import add_real_time
from imitarm.cli.benchmark_static import add_static
from imitarm.cli.benchmark_tracking import add_tracking
from imitarm.cli.outputs import check_outputs, same_place
from imitarm.cli.run_scene import provenance
from imitarm.cli.screen import progress_bar, remark, say
from imitarm.errors import InputError
from imitarm.policies.adaptation import ADAPTERS

OTHERS = (add_placements, add_static, add_moving, add_tracking, add_perception, add_real_time)
"""Functions that add the subcommands whose code is in another module."""

EPILOG = """\
examples:
  imitarm benchmark mapping --quick --report mapping.html
  imitarm benchmark mapping --out mapping --report mapping.html --data recordings
  imitarm benchmark mapping --methods modern thesis --people 4 --no-live
  imitarm benchmark mapping --methods modern thesis --no-replay --sigma 5
  imitarm benchmark avoidance --seeds 200
  imitarm benchmark placements --skill pour.json --robot panda --tool gripper --seeds 100
  imitarm benchmark placements --skill pour.json shelf.json --robots sawyer panda --tool gripper --jobs 2
  imitarm benchmark placements --skill pour.json --policies acfra rrt-connect --out placements.jsonl
  imitarm benchmark comparison placements.jsonl
  imitarm benchmark packing --seeds 100 --out packing
  imitarm benchmark pushed-cube --observer camera --seeds 20
  imitarm benchmark people recordings person.mp4
  imitarm benchmark refusals --scenes 1000
  imitarm benchmark static --count 100 --out static
  imitarm benchmark static compare static --report static.html
  imitarm benchmark tracking --data recordings --report tracking.html
  imitarm benchmark perception --count 105
  imitarm benchmark moving --count 100 --out moving
  imitarm benchmark moving compare moving --report moving.html
  imitarm benchmark real-time --duration 60 --rate 1000 --out real_time.json --figure real_time.png

'mapping' saves its results in the folder named by --out, and 'placements' in the file named by --out.
If you interrupt one of these two commands, the same command later continues where it stopped.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parsers = parser.add_subparsers(metavar="BENCHMARK", required=True, title="benchmarks")
    mapping = parsers.add_parser(
        "mapping", help="compare all retargeting methods on the same recordings (thesis Table 3.1)"
    )
    mapping.add_argument("--people", type=int, metavar="N", help="simulated people; default: 10 (2 with --quick)")
    mapping.add_argument(
        "--first",
        type=int,
        metavar="N",
        help=f"number of the first simulated person; default: {TEST} (0 with --quick). Persons below {TEST} are for "
        "developing methods, the other persons for testing them",
    )
    mapping.add_argument(
        "--repeats",
        type=int,
        metavar="N",
        help="trials of each person with the simulated robot; default: 5 (1 with --quick)",
    )
    mapping.add_argument("--quick", action="store_true", help="use a few short recordings, for a quick test")
    mapping.add_argument(
        "--methods", nargs="+", choices=METHODS, metavar="NAME", help=f"methods to compare: {', '.join(METHODS)}"
    )
    mapping.add_argument("--kinds", nargs="+", choices=KINDS, metavar="KIND", help=f"recordings: {', '.join(KINDS)}")
    mapping.add_argument(
        "--seconds", type=float, metavar="S", help="approximate duration of a recording; default: 10 (5 with --quick)"
    )
    mapping.add_argument(
        "--sigma", type=float, metavar="MM", help="standard deviation of the camera's error; default: 10 to 20 mm"
    )
    mapping.add_argument(
        "--no-live", action="store_true", help="use only recordings; leave out the trials with the simulated robot"
    )
    mapping.add_argument(
        "--no-replay", action="store_true", help="use only trials with the simulated robot; leave out recordings"
    )
    mapping.add_argument(
        "--data",
        type=Path,
        metavar="DIR",
        help="folder of real recordings; with this option, the methods also run on motion capture of a real arm",
    )
    mapping.add_argument("--out", type=Path, metavar="DIR", help="folder of the results; default: benchmark-mapping")
    mapping.add_argument("--report", type=Path, metavar="FILE", help="write a page with figures and playback (HTML)")
    add_fill(mapping)
    add_saved(mapping)
    add_workers(mapping)
    mapping.set_defaults(benchmark=_mapping)
    other = parsers.add_parser("avoidance", help="measure how often each method keeps its clearance in random scenes")
    other.add_argument(
        "--seeds", type=int, default=200, metavar="N", help="number of scenes in each family; default: 200"
    )
    other.add_argument(
        "--first", type=int, default=2000, metavar="N", help="first seed; default: 2000, where the test seeds begin"
    )
    other.add_argument("--methods", nargs="+", choices=ADAPTERS, default=list(ADAPTERS))
    add_fill(other)
    other.set_defaults(benchmark=_avoidance)
    third = parsers.add_parser(
        "refusals",
        help="check planned paths and refusals with an independent search for a path",
    )
    third.add_argument("--scenes", type=int, default=1000, metavar="N", help="number of scenes; default: 1000")
    third.add_argument("--first", type=int, default=0, metavar="N", help="first seed; default: 0")
    third.add_argument("--skills", type=Path, nargs="+", default=[], metavar="FILE", help="additional skills to adapt")
    add_fill(third)
    third.set_defaults(benchmark=_refusals)
    for name, task in REPEATED_TASKS.items():
        _add_repeated(parsers, name, task)
    for add in OTHERS:
        add(parsers)
    people = parsers.add_parser("people", help="retarget recordings of real people to simulated arms")
    people.add_argument(
        "data",
        type=Path,
        metavar="DATA",
        help="folder of real recordings, with the subfolders kinect_gestures and mocap_arm",
    )
    people.add_argument("videos", nargs="*", metavar="VIDEO", help="videos or recordings of a person")
    add_fill(people)
    people.set_defaults(benchmark=_people)


def run(arguments: argparse.Namespace) -> int:
    """Run a benchmark.

    Raises:
        InputError: when an option is wrong or a folder can't be used.
        TaskFailedError: when a worker process ended unexpectedly.
    """
    status: int = arguments.benchmark(arguments)
    return status


def _mapping(arguments: argparse.Namespace) -> int:
    """Run the mapping benchmark, print its tables, write its files."""
    benchmark = _configured(arguments)
    experiments = benchmark.experiments()
    folder: Path = arguments.out or Path("benchmark-mapping")
    place = place_of(arguments, "mapping")
    _check(arguments, folder)
    if not benchmark.data and benchmark.kinds:
        remark(
            "the arm measured by motion capture is left out, because it needs real recordings; name their folder "
            "with --data"
        )
    with progress_bar() as bar:
        task = bar.add_task("measuring", total=None)
        done = run_all(
            experiments,
            folder,
            workers_of(arguments),
            fresh=arguments.fresh,
            reuse=arguments.reuse,
            on_done=lambda finished, of: bar.update(task, completed=finished, total=of),
        )
    results, versions = Results(done), [result.code for result in done]
    found = tables(results)
    for text in _not_done(done):
        remark(text)
    if set(versions) != {code_version()}:
        remark(origin(versions))
    report_tables(found, place, versions)
    for path in write_tables(results, found, folder):
        say(f"wrote {path}")
    if arguments.report is not None:
        from imitarm.benchmark.mapping_report import write_mapping_report  # noqa: PLC0415 (draws: needs an extra)

        facts = provenance(results=origin(versions), experiments=len(done))
        kept = folder / "recordings"
        say(f"wrote {write_mapping_report(results, found, arguments.report, provenance=facts, folder=kept)}")
    return 0


def _avoidance(arguments: argparse.Namespace) -> int:
    """Run the avoidance benchmark and print its table."""
    if arguments.seeds < 1 or arguments.first < 0:
        raise InputError(
            f"--seeds must be at least 1 and --first at least 0, got {arguments.seeds} and {arguments.first}"
        )
    place = place_of(arguments, "avoidance")
    with progress_bar() as bar:
        task = bar.add_task("avoiding", total=None)
        table = avoidance.success_table(
            arguments.seeds,
            arguments.first,
            list(dict.fromkeys(arguments.methods)),
            on_done=lambda finished, of: bar.update(task, completed=finished, total=of),
        )
    report_tables([table], place, [code_version()])
    return 0


def _refusals(arguments: argparse.Namespace) -> int:
    """Adapt skills to random scenes and print the results; return 1 when an accepted path violates its clearance."""
    if arguments.scenes < 1 or arguments.first < 0:
        raise InputError(
            f"--scenes must be at least 1 and --first at least 0, got {arguments.scenes} and {arguments.first}"
        )
    place = place_of(arguments, "refusals")
    with progress_bar() as bar:
        task = bar.add_task("adapting", total=arguments.scenes)
        table, verdicts = refusals.refusal_table(
            arguments.scenes,
            arguments.first,
            arguments.skills,
            on_done=lambda finished, _: bar.update(task, completed=finished),
        )
    report_tables([table], place, [code_version()])
    doubtful = [v for v in verdicts if v.is_violation or (not v.accepted and v.oracle is not Answer.IMPOSSIBLE)]
    for v in doubtful:
        say(f"seed {v.seed} ({v.family}): {'violated' if v.is_violation else f'refused, {v.oracle.value}'}")
    return int(any(v.is_violation for v in verdicts))


def _add_repeated(parsers: Any, name: str, task: RepeatedTask) -> None:
    """Add the command that runs a task with many seeds."""
    parser = parsers.add_parser(name, help=task.title[0].lower() + task.title[1:])
    parser.add_argument("--seeds", type=int, default=20, metavar="N", help="number of runs; default: 20")
    parser.add_argument("--first", type=int, default=0, metavar="N", help="seed of the first run; default: 0")
    parser.add_argument(
        "--observer", choices=task.observers, default="sensor", help="how the obstacles are observed; default: sensor"
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=Path(f"benchmark-{name}"),
        metavar="FOLDER",
        help=f"folder for the results; an interrupted command continues there; default: benchmark-{name}",
    )
    add_workers(parser)
    add_fill(parser)
    parser.set_defaults(benchmark=_repeated, task=name)


def _repeated(arguments: argparse.Namespace) -> int:
    """Run a task with many seeds and print its table."""
    if arguments.seeds < 1 or arguments.first < 0:
        raise InputError(
            f"--seeds must be at least 1 and --first at least 0, got {arguments.seeds} and {arguments.first}"
        )
    place = place_of(arguments, arguments.task)
    with progress_bar() as progress:
        bar = progress.add_task(arguments.task, total=arguments.seeds)
        results = repeated_tasks.run_repeatedly(
            arguments.task,
            arguments.seeds,
            first=arguments.first,
            observer=arguments.observer,
            workers=workers_of(arguments),
            out=arguments.out,
            on_done=lambda done, total: progress.update(bar, completed=done, total=total),
        )
    report_tables(repeated_tasks.success_tables(results), place, [result.code for result in results])
    return 0


def _people(arguments: argparse.Namespace) -> int:
    """Retarget recordings of real people to the arms, and print the tables."""
    place = place_of(arguments, "people")
    motions = list(real_motions.real_motions(arguments.data, arguments.videos))
    report_tables(real_motions.tables(motions), place, [code_version()])
    return 0


def _configured(arguments: argparse.Namespace) -> MappingBenchmark:
    quick: bool = arguments.quick
    data: Path | None = arguments.data
    return MappingBenchmark(
        people=_given(arguments.people, 2 if quick else 10),
        first=_given(arguments.first, 0 if quick else TEST),
        repeats=_given(arguments.repeats, 1 if quick else 5),
        methods=arguments.methods or tuple(METHODS),
        kinds=() if arguments.no_replay else arguments.kinds or KINDS,
        seconds=arguments.seconds if arguments.seconds is not None else 5.0 if quick else 10.0,
        sigma=None if arguments.sigma is None else 1e-3 * arguments.sigma,
        live=not arguments.no_live,
        data="" if data is None or arguments.no_replay else str(data.absolute()),
    )


def _not_done(results: Sequence[Result]) -> list[str]:
    """Return the failed experiments and their reasons; a recording that can't be made is listed only once."""
    found: dict[tuple[str, int, int, str], list[str]] = {}
    for result in results:
        if result.failure:
            e = result.experiment
            found.setdefault((e.task, e.seed, e.repeat, result.failure), []).append(e.method)
    return [
        f"{task}, person {person}, repeat {repeat}, {', '.join(methods)}: {why}"
        for (task, person, repeat, why), methods in found.items()
    ]


def _given(value: int | None, otherwise: int) -> int:
    return otherwise if value is None else value


def _check(arguments: argparse.Namespace, folder: Path) -> None:
    """Check the options now, because a wrong option would otherwise fail only after the long run."""
    if arguments.no_replay:
        for option in ("kinds", "data"):
            if getattr(arguments, option):
                raise InputError(
                    f"--{option} selects recordings, but --no-replay leaves them out; give only one of them"
                )
    workers_of(arguments)
    if arguments.data is not None and not arguments.data.is_dir():
        raise InputError(f"--data {arguments.data}: there is no such folder")
    if folder.exists() and not folder.is_dir():
        raise InputError(f"--out {folder}: is not a folder; name another path")
    if arguments.data is not None and same_place(folder, arguments.data):
        raise InputError(f"--out {folder}: is also the folder of --data; name another folder")
    written = [("--out", folder / name) for name in ("mapping.md", "mapping.json")]
    check_outputs([("--report", arguments.report)], [("--fill", arguments.fill), *written], new_folders=True)
    if arguments.report is None:
        return
    missing = [name for name in ("jinja2", "matplotlib", "viser") if importlib.util.find_spec(name) is None]
    if missing:
        raise InputError(f"--report needs {' and '.join(missing)}: pip install 'imitarm[report]'")
    page: Path = arguments.report
    try:
        page.absolute().parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"--report {page}: its folder can't be created ({error.strerror}); name another file"
        ) from error
    from imitarm.viewer.page import check_writable  # noqa: PLC0415 (draws: needs an extra)

    check_writable(page)
