"""One self-contained HTML page that tells what a run did: it opens offline and asks nothing of any network.

The headline comes first, then the table, then everything else; :mod:`~imitarm.viewer.page` puts it together.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from imitarm.viewer import palette
from imitarm.viewer.background import WORDS, learning_section, provenance_section
from imitarm.viewer.content import Report, SceneResult
from imitarm.viewer.data import as_data
from imitarm.viewer.page import data_link, draw_page, page_html, shared_players
from imitarm.viewer.scene3d import ComponentMark, PathMark, playback_html
from imitarm.viewer.scene_sections import scenes_section
from imitarm.viewer.sections import header, table_section


def write_report(report: Report, path: str | Path) -> Path:
    """Write a report by :func:`~imitarm.viewer.page.draw_page` and return where it is.

    Args:
        report: what to tell.
        path: the file to write; its folder must exist.

    Raises:
        InputError: when it can't be written there, or the libraries that draw are not installed.
        TaskFailedError: when the disk is full.
    """
    return draw_page(lambda: report_html(report), path)


def report_html(report: Report) -> str:
    """Return the whole page.

    Args:
        report: what to tell.

    Raises:
        InputError: when the libraries that draw are not installed.
    """
    shared, own = shared_players(
        {scene.name: _playback(scene) for scene in report.scenes if scene.recording is not None}
    )
    sections = [
        table_section(report, data_link(as_data(report), "imitarm-report.json")),
        scenes_section(report, own),
        learning_section(report.learning) if report.learning is not None else "",
        provenance_section(report.provenance, WORDS),
    ]
    return page_html(report.title, header(report), sections, shared)


def _playback(scene: SceneResult) -> str:
    """Return the 3-D page of a scene: its recording with the paths and the components around it."""
    assert scene.recording is not None
    paths, components = [], []
    if scene.adaptation is not None:
        a = scene.adaptation
        paths += [
            PathMark("learnt path", a.nominal.positions, palette.NOMINAL, 0.004),
            PathMark("adapted path", a.trajectory.positions, palette.ADAPTED, 0.006),
        ]
        for k, moved in enumerate(a.moved):
            name, mean = f"component {k + 1}", a.means[k] + a.displacement[k]
            components.append(ComponentMark(name, mean, a.covariances[k], palette.MOVED if moved else palette.UNMOVED))
    if scene.rollout is not None:
        lifted = scene.rollout.trajectory.positions + np.array(
            [0.0, 0.0, 0.004]
        )  # [m] or two equal lines would flicker
        paths.append(PathMark("measured path", lifted, palette.MEASURED, 0.003))
    return playback_html(scene.recording, paths=paths, components=components)
