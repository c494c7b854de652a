"""Drawing: 3-D playback, figures, and the report, one HTML page that opens offline.

``FrameRecorder`` notes a simulation while it runs, ``SceneResult``, ``LearningSummary`` and ``Report`` say what came
of it, ``write_report`` writes the page. :mod:`imitarm.viewer.retarget_report` does the same for a person's motion that
became a robot's. viser and matplotlib are only imported when something is drawn.
"""

from __future__ import annotations

from imitarm.viewer.content import LearningSummary, Report, SceneResult
from imitarm.viewer.data import as_data
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
