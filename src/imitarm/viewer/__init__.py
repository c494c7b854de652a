"""Drawing: 3-D playback, figures, and reports; a report is one HTML page that opens offline.

``FrameRecorder`` records a simulation while it runs. ``Report`` holds the results (``SceneResult``,
``LearningSummary``), and ``write_report`` writes the page. :mod:`imitarm.viewer.retarget_report` writes the report on a
retargeted motion. :func:`imitarm.plot` draws a single trajectory, skill, scene or other object. The packages viser,
matplotlib and jinja2 are imported only when something is drawn.
"""

from __future__ import annotations

from imitarm.viewer.content import LearningSummary, Report, SceneResult, as_data
from imitarm.viewer.person import PersonMark
from imitarm.viewer.recording import FrameRecorder, Recording
from imitarm.viewer.report import report_html, write_report
from imitarm.viewer.scene3d import ComponentMark, PathMark, playback_html
from imitarm.viewer.stage import Camera

__all__ = [
    "Camera",
    "ComponentMark",
    "FrameRecorder",
    "LearningSummary",
    "PathMark",
    "PersonMark",
    "Recording",
    "Report",
    "SceneResult",
    "as_data",
    "playback_html",
    "report_html",
    "write_report",
]
