"""The mapping benchmark as one self-contained HTML page: tables, figures, a person and a robot side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any, Final

from imitarm.benchmark import mapping_plots
from imitarm.benchmark.experiment import LIVE, Experiment, Result, plain
from imitarm.benchmark.mapping_methods import MAIN, METHODS
from imitarm.benchmark.mapping_pairs import OURS
from imitarm.benchmark.mapping_tables import Results, number
from imitarm.benchmark.recording_plan import CAPTURED
from imitarm.benchmark.tables import Table
from imitarm.kinematics.arm import ArmModel
from imitarm.viewer import palette
from imitarm.viewer.background import provenance_section
from imitarm.viewer.markup import figure
from imitarm.viewer.page import data_link, draw_page, page_html, shared_players
from imitarm.viewer.panels import Key, Panel, heading, player_card, tabbed
from imitarm.viewer.retarget_content import MethodResult, RetargetReport
from imitarm.viewer.retarget_report import playback

_SHOWN: Final = 9.0  # [s] of the recording that is played
_KEYS: Final = (
    Key(palette.DEMONSTRATION, "the person's arm, and where the tool should go"),
    Key(palette.ADAPTED, "path of the robot's tool"),
)
_WORDS: Final = {
    "Interval": "Where a mean over persons is with 95 % confidence: persons are drawn again with replacement. Two "
    "intervals that overlap say little of a difference; the paired comparison does.",
    "Lag": "The constant delay with which the tool follows the true hand best.",
    "From first hold": "The distance to where the hand of the first engagement leads, whatever the method let go of on "
    "the way.",
    "SPARC": "Length of the speed's spectrum: the nearer to 0, the smoother.",
    "Our reading": "The thesis names its rivals by words alone; these are methods that fit the words.",
}


def write_mapping_report(
    results: Results, tables: Sequence[Table], path: str | Path, *, provenance: Mapping[str, Any], folder: Path | None
) -> Path:
    """Write the page by :func:`~imitarm.viewer.page.draw_page` and return where it is.

    Args:
        results: of the benchmark.
        tables: as the command printed them.
        path: the file to write; its folder must exist.
        provenance: what is needed to do it again.
        folder: where recordings are kept; None: nowhere.

    Returns:
        Where it was written, absolute.

    Raises:
        InputError: when the place can't be written, or the libraries that draw are not installed.
        TaskFailedError: when the disk is full.
    """
    return draw_page(lambda: mapping_report_html(results, tables, provenance=provenance, folder=folder), path)


def mapping_report_html(
    results: Results, tables: Sequence[Table], *, provenance: Mapping[str, Any], folder: Path | None
) -> str:
    """Return the whole page; see :func:`write_mapping_report`."""
    players, panels = _players(results, folder)
    verdict, good = _verdict(results)
    summary = "The same recordings of made-up people through every method, and the same people stacking cubes with it."
    sections = [
        _figures(results),
        "".join(['<section id="tables"><h2>Tables</h2>', *(_table(table) for table in tables), "</section>"]),
        f'<section id="scenes"><h2>Side by side</h2>{tabbed(panels, "Methods")}</section>' if panels else "",
        f"<section><p>{data_link({'results': [_data(r) for r in results.all]}, 'imitarm-mapping.json')}</p></section>",
        provenance_section(provenance, _WORDS),
    ]
    return page_html(
        "Mapping benchmark", heading("Mapping benchmark", verdict, good, summary, _tiles(results)), sections, players
    )


def _verdict(results: Results) -> tuple[str, bool]:
    runs = [r for r in results.all if r.experiment.method == OURS and r.experiment.task != LIVE and not r.unmade]
    if not runs:
        return f"{OURS} was not run", False
    broken = sum(_breaks(r) for r in runs)
    text = f"{OURS} breaks a limit in {broken} of {len(runs)} recordings"
    return text, broken == 0


def _breaks(result: Result) -> bool:
    return bool(result.failure) or number(result, "broken_limits") > 0


def _tiles(results: Results) -> list[tuple[str, str]]:
    tiles = []
    for name in results.methods:
        runs = results.of(name, [LIVE])
        if runs:
            done = sum(bool(r.values.get("success")) for r in runs)
            tiles.append((f"{done}<small> of {len(runs)}</small>", f"towers stacked with {METHODS[name].title}"))
    return tiles[:5]


def _figures(results: Results) -> str:
    tasks = results.tasks()
    stacking = results.tasks(["stacking"]) or tasks
    main = Results(r for r in results.all if r.experiment.method in MAIN)
    bars = "Bars are means over persons, lines 95 % intervals."
    cards = [
        figure(mapping_plots.successes(main), "Success", f"Four cubes stacked, loop closed. {bars}"),
        figure(mapping_plots.torques(main, stacking), "Mean torque of each joint (Fig 3.6)", bars),
        figure(mapping_plots.path_lengths(main, tasks), "Path length (Fig 3.7)", bars),
        figure(mapping_plots.times(main), "Time to complete (Fig 3.8)", f"Of the trials that succeeded. {bars}"),
        figure(mapping_plots.accuracy(main, tasks), "Accuracy", bars),
        figure(mapping_plots.broken_limits(main, tasks), "Limits broken", bars),
    ]
    return f'<section id="figures"><h2>Figures</h2><div class="columns">{"".join(cards)}</div></section>'


def _table(table: Table) -> str:
    kinds = [_kind(column) for column in table.columns]
    head = "".join(
        f'<th scope="col"{kind}>{escape(column.removesuffix(">"))}</th>'
        for column, kind in zip(table.columns, kinds, strict=True)
    )
    rows = "".join(
        f'<tr><th scope="row">{escape(row[0])}</th>'
        + "".join(f"<td{kind}>{escape(cell)}</td>" for cell, kind in zip(row[1:], kinds[1:], strict=True))
        + "</tr>"
        for row in table.rows
    )
    return (
        f'<h3>{escape(table.title)}</h3><div class="card wide"><table><thead><tr>{head}</tr></thead>'
        f'<tbody>{rows}</tbody></table></div><p class="caption">{escape(table.note)}</p>'
    )


def _kind(column: str) -> str:
    """Return the class of a column: words wrap, a symbol keeps its case, numbers need none."""
    if not column.endswith(">"):
        return ' class="words"'
    return "" if column[:1].isascii() else ' class="symbol"'


def _players(results: Results, folder: Path | None) -> tuple[tuple[str, str] | None, list[Panel]]:
    """Return the playback of one recording by each of the main methods: the first one at the edge of reach."""
    replayed = [r.experiment for r in results.all if r.experiment.task != LIVE and not r.failure]
    chosen = next((e for e in replayed if e.task == "edge"), next(iter(replayed), None))
    if chosen is None:
        return None, []
    recording = chosen.recording(folder)
    first = recording.skeletons[0].time
    seen = [skeleton for skeleton in recording.skeletons if skeleton.time - first <= _SHOWN]
    arm, methods = ArmModel.load(chosen.robot, tool="gripper"), []
    for name in [name for name in results.methods if name in MAIN]:
        run = METHODS[name](arm, recording.correspondence).run(seen, recording.start)
        methods.append(MethodResult(name, METHODS[name].title, run))
    if not methods:
        return None, []
    report = RetargetReport("Mapping benchmark", methods, seen, recording.correspondence, "", good=True)
    shared, own = shared_players({method.name: playback(report, method) for method in methods})
    panels = [
        Panel(f"method-{m.name}", m.title, player_card(f"Person and robot: {m.title}", own[m.name], _KEYS))
        for m in methods
    ]
    return shared, panels


def _data(result: Result) -> dict[str, Any]:
    experiment: Experiment = result.experiment
    person = None if experiment.task == CAPTURED else experiment.seed  # that one is no made-up person
    facts = {"task": experiment.task, "method": experiment.method, "person": person}
    return {
        **facts,
        "repeat": experiment.repeat,
        "failure": result.failure,
        "values": plain(dict(result.values)),
    }
