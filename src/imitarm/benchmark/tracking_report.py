"""Write the results of the tracking benchmark as one HTML page, with figures like thesis Fig 5.9."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from imitarm.benchmark.tables import Table
from imitarm.benchmark.tracked_motions import RecordedMotion
from imitarm.benchmark.tracking import TrackLog, follow
from imitarm.benchmark.tracking_margins import COVERAGE, TIMES, synthetic_windows
from imitarm.control_loop.observer import SensorModel
from imitarm.perception import CoverageMargin, ObstacleTracker
from imitarm.viewer import palette
from imitarm.viewer.canvas import INK, canvas
from imitarm.viewer.page import Figure, Header, Tile, draw_page, render

Array = NDArray[np.float64]

_WINDOWS: Final = 400  # of the drawing of margins
_SECONDS: Final = 8.0  # [s] of each drawing
_WORDS: Final = {
    "NIS": "Normalised innovation squared: distance of a detection from its prediction, relative to the uncertainty.",
    "NEES": "Normalised estimation error squared: error of the estimate, relative to its uncertainty.",
    "Lag": "Delay of the estimated position behind the true position.",
    "Window": "One prediction, and the true motion after the prediction.",
}


def write_tracking_report(
    motions: Sequence[RecordedMotion],
    tables: Sequence[Table],
    path: str | Path,
    *,
    sensor: SensorModel,
    provenance: Mapping[str, Any],
) -> Path:
    """Write the page and return its path.

    Args:
        motions: recorded motions to draw.
        tables: tables that the command also prints.
        path: the file to write; its folder must exist.
        sensor: the sensor.
        provenance: facts needed to repeat the benchmark.

    Raises:
        InputError: when the file can't be written, or the drawing libraries are not installed.
        TaskFailedError: when the disk is full.
    """
    return draw_page(lambda: tracking_report_html(motions, tables, sensor=sensor, provenance=provenance), path)


def tracking_report_html(
    motions: Sequence[RecordedMotion], tables: Sequence[Table], *, sensor: SensorModel, provenance: Mapping[str, Any]
) -> str:
    """Return the whole page as HTML; for the arguments, see :func:`write_tracking_report`."""
    figures, tiles, nearer = [], [], []
    for motion in motions:
        tracking = follow(motion, ObstacleTracker(), sensor, (0.5, 1.0))
        for name, log in zip(motion.names, tracking.logs, strict=True):
            raw, predicted = (_rms_mm(log, values) for values in (log.raw, log.predicted))
            nearer.append(predicted < raw)
            text = f"RMS error of the {name} with the default process noise (last detection: {raw:.1f} mm)"
            tiles.append(Tile(f"{predicted:.1f}", "mm", text))
            figures.append(
                Figure(
                    position_chart(log, name),
                    f"Fig 5.9: position of the {name}",
                    "(a) Detections and estimate. (b) Detections, estimate and true position.",
                )
            )
    figures.append(
        Figure(
            margin_chart(synthetic_windows(_WINDOWS, 0, sensor), synthetic_windows(_WINDOWS, 1, sensor)),
            "Errors of predictions and their margin",
            f"Errors of {_WINDOWS} synthetic windows, and the margin that was calibrated with {_WINDOWS} other "
            "windows. Dashed line: at each look-ahead time, 95 % of the errors are below this line. The margin is "
            "larger, because it must cover 95 % of the whole windows.",
        )
    )
    verdict = (
        f"for {sum(nearer)} of {len(nearer)} obstacles, the estimate is nearer to the true position than the last "
        "detection is"
    )
    text = "The motions of the obstacles are recorded. Noise, latency and dropouts of the camera are simulated."
    return render(
        "avoidance.html",
        Header("Tracking of moving obstacles", verdict, bool(nearer) and all(nearer), text, tiles),
        data={"tables": [{"title": t.title, "columns": t.columns, "rows": t.rows, "note": t.note} for t in tables]},
        data_name="imitarm-tracking.json",
        provenance=provenance,
        words=_WORDS,
        figures=figures,
        tables=[table.for_page() for table in tables],
        scenes=[],
    )


def _rms_mm(log: TrackLog, values: Any) -> float:
    used = log.settled & np.isfinite(values).all(axis=1)
    return 1e3 * float(np.sqrt((((values - log.truth)[used]) ** 2).sum(axis=1).mean()))


def position_chart(log: TrackLog, name: str) -> str:
    """Draw thesis Fig 5.9 (a) and (b), one below the other: detections, estimate and true position over time."""
    with canvas(f"position-{name}", f"Detected, estimated and true position of the {name} over time", (5.5, 4.4)) as c:
        upper, lower = c.axes(0.74, 2.65, 5.4, 4.2), c.axes(0.74, 0.72, 5.4, 2.15)
        draw_positions(upper, lower, log, truth=INK)
        c.legend(3)
    return c.svg


def margin_chart(calibration: Array, test: Array) -> str:
    """Draw the prediction errors ``test`` over the look-ahead time, and the margin of the errors ``calibration``."""
    margin = CoverageMargin.calibrate(calibration, COVERAGE, times=TIMES)
    with canvas("margin", "Errors of predictions over the look-ahead time, and their margin", (5.5, 2.6)) as c:
        axes = c.axes(0.74, 0.78, 5.4, 2.5)
        for error in test[:100]:
            axes.plot(TIMES, 1e3 * error, color=palette.NOMINAL, lw=0.5, alpha=0.5)
        each = 1e3 * np.quantile(test, COVERAGE, axis=0)
        axes.plot(TIMES, each, color=palette.ADAPTED, lw=1.2, ls="--", label="95 % at each time")
        axes.plot(TIMES, 1e3 * margin.at(TIMES), color=palette.LIMIT, lw=1.6, label="margin of synthetic windows")
        axes.set_ylim(0.0, 1.4e3 * float(margin.at(TIMES[-1])))
        axes.set_xlim(TIMES[0], TIMES[-1])
        axes.set_xlabel("look-ahead time [s]")
        axes.set_ylabel("error [mm]")
        c.legend(2)
    return c.svg


def draw_positions(upper: Any, lower: Any, log: TrackLog, *, truth: str = "black") -> None:
    """Draw thesis Fig 5.9 (a) and (b) on two matplotlib axes. Only the coordinate with the largest motion is drawn.

    Args:
        upper: matplotlib axes for (a), which shows detections and estimate.
        lower: matplotlib axes for (b), which shows detections, estimate and true position.
        log: the true and the estimated motion of one obstacle.
        truth: colour of the line for the true position.
    """
    shown = log.settled & (log.times < log.times[log.settled][0] + _SECONDS)
    axis = int(np.ptp(log.truth[shown], axis=0).argmax())
    times = log.times[shown] - log.times[shown][0]
    middle = float(log.truth[shown, axis].mean())
    for axes, text in ((upper, "(a)"), (lower, "(b)")):
        mm = {key: 1e3 * (getattr(log, key)[shown, axis] - middle) for key in ("raw", "predicted", "truth")}
        label = (lambda words: words) if axes is upper else (lambda words: None)
        axes.plot(times, mm["raw"], color=palette.DEMONSTRATION, lw=0.9, label=label("last detection"))
        axes.plot(times, mm["predicted"], color=palette.UNMOVED, lw=1.4, label=label("estimate of the tracker"))
        if axes is lower:
            axes.plot(times, mm["truth"], color=truth, lw=1.0, ls="--", label="true position")
        axes.set_title(text, loc="left")
        axes.set_ylabel(f"{'xyz'[axis]} [mm]")
        axes.set_xlim(0.0, times[-1])
    lower.set_xlabel("time [s]")
