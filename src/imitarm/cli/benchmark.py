"""``imitarm benchmark``: measure how good the methods are, beside what the thesis says of it."""

from __future__ import annotations

import argparse
import importlib.util
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

from imitarm.benchmark import avoidance
from imitarm.benchmark.experiment import Result
from imitarm.benchmark.mapping import MappingBenchmark, check_document, fill_document, tables, write_tables
from imitarm.benchmark.mapping_methods import METHODS
from imitarm.benchmark.mapping_tables import JUDGED, Results
from imitarm.benchmark.provenance import code_version, origin
from imitarm.benchmark.recording_plan import KINDS
from imitarm.benchmark.running import LOCAL, run_all
from imitarm.benchmark.tables import Table
from imitarm.cli.outputs import check_outputs, same_place
from imitarm.cli.screen import progress_bar, remark, say, show_table
from imitarm.cli.trial import provenance
from imitarm.errors import InputError
from imitarm.policies.adaptation import ADAPTERS as ADAPTATIONS

EPILOG = """\
examples:
  imitarm benchmark mapping --quick --report mapping.html
  imitarm benchmark mapping --out mapping --report mapping.html --data recordings
  imitarm benchmark mapping --methods modern thesis --people 4 --no-live
  imitarm benchmark mapping --methods modern thesis --no-replay --sigma 5
  imitarm benchmark avoidance --seeds 200

'mapping' keeps what it has run in the folder --out; Ctrl-C ends it, and the same command goes on where it was.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add what the command takes."""
    parsers = parser.add_subparsers(metavar="WHAT", required=True, title="benchmarks")
    mapping = parsers.add_parser(
        "mapping", help="from a person's arm to a robot's: every method on the same recordings (thesis Table 3.1)"
    )
    mapping.add_argument("--people", type=int, metavar="N", help="made-up people; default: 10, with --quick 2")
    mapping.add_argument(
        "--first",
        type=int,
        metavar="N",
        help=f"first of them; default: {JUDGED}, with --quick 0. Those below {JUDGED} are for working on methods, the "
        "others judge",
    )
    mapping.add_argument("--repeats", type=int, metavar="N", help="closed-loop trials of each; default: 5, quick 1")
    mapping.add_argument("--quick", action="store_true", help="a few short recordings: shows that it runs, no more")
    mapping.add_argument("--methods", nargs="+", choices=METHODS, metavar="NAME", help=f"of {', '.join(METHODS)}")
    mapping.add_argument("--kinds", nargs="+", choices=KINDS, metavar="KIND", help=f"recordings: {', '.join(KINDS)}")
    mapping.add_argument(
        "--seconds", type=float, metavar="S", help="about how long a recording is; default: 10, quick 5"
    )
    mapping.add_argument("--sigma", type=float, metavar="MM", help="of the camera's error; default: 10 to 20 mm")
    mapping.add_argument("--no-live", action="store_true", help="leave out the stacking with the loop closed")
    mapping.add_argument("--no-replay", action="store_true", help="leave out the recordings: only stacking")
    mapping.add_argument("--data", type=Path, metavar="FOLDER", help="real recordings: adds the captured arm")
    mapping.add_argument("--out", type=Path, metavar="FOLDER", help="for results; default: benchmark-mapping")
    mapping.add_argument("--report", type=Path, metavar="FILE", help="a page with figures and playback (HTML)")
    mapping.add_argument("--fill", type=Path, metavar="FILE", help="put the tables into this document, between marks")
    mapping.add_argument("--fresh", action="store_true", help="run again what has been run")
    mapping.add_argument(
        "--reuse", action="store_true", help="take saved results of the same configuration, whatever code made them"
    )
    mapping.add_argument("--jobs", type=int, metavar="N", help="processes; default: one for each processor")
    mapping.add_argument("--backend", default=LOCAL, metavar="NAME", help="local, or a joblib backend: dask, ray")
    mapping.set_defaults(benchmark=_mapping)
    other = parsers.add_parser("avoidance", help="how often a method keeps its clearance, over seeded scenes")
    other.add_argument("--seeds", type=int, default=200, metavar="N", help="scenes in each family; default: 200")
    other.add_argument("--first", type=int, default=2000, metavar="N", help="first seed; default: 2000, the test seeds")
    other.add_argument("--methods", nargs="+", choices=ADAPTATIONS, default=list(ADAPTATIONS))
    other.set_defaults(benchmark=_avoidance)


def run(arguments: argparse.Namespace) -> int:
    """Run the benchmark that was asked for.

    Raises:
        InputError: when an option is wrong or a folder can't be used.
        TaskFailedError: when a worker was lost.
    """
    status: int = arguments.benchmark(arguments)
    return status


def _mapping(arguments: argparse.Namespace) -> int:
    """Run the mapping benchmark, print its tables, write its files."""
    benchmark = _asked(arguments)
    experiments = benchmark.experiments()
    folder: Path = arguments.out or Path("benchmark-mapping")
    _check(arguments, folder)
    if not benchmark.data and benchmark.kinds:
        remark("the captured arm is left out: it needs real recordings, name their folder with --data")
    with progress_bar() as bar:
        task = bar.add_task("measuring", total=None)
        done = run_all(
            experiments,
            folder,
            jobs=arguments.jobs,
            fresh=arguments.fresh,
            reuse=arguments.reuse,
            backend=arguments.backend,
            on_done=lambda finished, of: bar.update(task, completed=finished, total=of),
        )
    results = Results(done)
    found = tables(results)
    for table in found:
        _show(table)
    for text in _not_done(done):
        remark(text)
    versions = [result.code for result in done]
    if set(versions) != {code_version()}:
        remark(origin(versions))
    for path in write_tables(results, found, folder):
        say(f"wrote {path}")
    if arguments.fill is not None:
        fill_document(arguments.fill, found, _command(), versions)
        say(f"filled {arguments.fill}")
    if arguments.report is not None:
        from imitarm.benchmark.mapping_report import write_mapping_report  # noqa: PLC0415 (draws: needs an extra)

        facts = provenance(results=origin(versions), experiments=len(done))
        kept = folder / "recordings"
        say(f"wrote {write_mapping_report(results, found, arguments.report, provenance=facts, folder=kept)}")
    return 0


def _avoidance(arguments: argparse.Namespace) -> int:
    """Run the avoidance benchmark and print its table."""
    if arguments.seeds < 1 or arguments.first < 0:
        raise InputError(f"--seeds must be at least 1 and --first 0, got {arguments.seeds} and {arguments.first}")
    with progress_bar() as bar:
        task = bar.add_task("avoiding", total=None)
        table = avoidance.success_table(
            arguments.seeds,
            arguments.first,
            arguments.methods,
            on_done=lambda finished, of: bar.update(task, completed=finished, total=of),
        )
    _show(table)
    return 0


def _asked(arguments: argparse.Namespace) -> MappingBenchmark:
    quick: bool = arguments.quick
    data: Path | None = arguments.data
    return MappingBenchmark(
        people=_given(arguments.people, 2 if quick else 10),
        first=_given(arguments.first, 0 if quick else JUDGED),
        repeats=_given(arguments.repeats, 1 if quick else 5),
        methods=arguments.methods or tuple(METHODS),
        kinds=() if arguments.no_replay else arguments.kinds or KINDS,
        seconds=arguments.seconds if arguments.seconds is not None else 5.0 if quick else 10.0,
        sigma=None if arguments.sigma is None else 1e-3 * arguments.sigma,
        live=not arguments.no_live,
        data="" if data is None or arguments.no_replay else str(data.absolute()),
    )


def _command() -> str:
    """Return the command without the places where this machine keeps its files."""
    words, places = sys.argv[1:], {"--out", "--report", "--fill", "--jobs", "--backend"}
    kept = [
        w
        for i, w in enumerate(words)
        if w not in places | {"--fresh", "--reuse"} and (i == 0 or words[i - 1] not in places)
    ]
    named = ["recordings" if i > 0 and kept[i - 1] == "--data" else w for i, w in enumerate(kept)]
    return shlex.join(["imitarm", *named])


def _not_done(results: Sequence[Result]) -> list[str]:
    """Return what could not be done and why: a recording that can't be made is told once, not for every method."""
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
    """Find out before the work what would only fail after it."""
    if arguments.jobs is not None and arguments.jobs < 1:
        raise InputError(f"--jobs must be at least 1, got {arguments.jobs}")
    if arguments.data is not None and not arguments.data.is_dir():
        raise InputError(f"--data {arguments.data}: there is no such folder")
    if folder.exists() and not folder.is_dir():
        raise InputError(f"--out {folder}: is no folder; name another one")
    if arguments.data is not None and same_place(folder, arguments.data):
        raise InputError(f"--out {folder}: is the folder of --data, too; name another one")
    if arguments.fill is not None:
        check_document(arguments.fill)
    written = [("--out", folder / name) for name in ("mapping.md", "mapping.json")]
    check_outputs([("--report", arguments.report)], [("--fill", arguments.fill), *written], new_folders=True)
    if arguments.report is None:
        return
    missing = [name for name in ("matplotlib", "viser") if importlib.util.find_spec(name) is None]
    if missing:
        raise InputError(f"--report needs {' and '.join(missing)}: pip install 'imitarm[report]'")
    page: Path = arguments.report
    try:
        page.absolute().parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"--report {page}: its folder can't be made ({error.strerror}); name another one") from error
    from imitarm.viewer.page import check_writable  # noqa: PLC0415 (draws: needs an extra)

    check_writable(page)


def _show(table: Table) -> None:
    show_table(table.columns, table.rows, title=table.title)
    if table.note:
        say(table.note)
    say("")
