"""The result of the real-time benchmark: its file, its tables, its histogram and its page.

The drawings are in this file, because they are short and need nothing but the result.
"""

from __future__ import annotations

import json
import math
import os
import platform
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.benchmark.real_time_world import CAMERA_RATE, RealTimeSetup
from imitarm.benchmark.tables import Table
from imitarm.errors import FileFormatError, InputError
from imitarm.files.document import write_text

Array = NDArray[np.float64]

FORMAT, VERSION = "imitarm-real-time", 1
_QUANTILES = (0.5, 0.99, 0.999, 1.0)
_HEADINGS = ("median>", "99th percentile>", "99.9th percentile>", "maximum>")
_BINS = 20  # of the histogram, for each factor of ten
_SHORTEST = 1e-5  # [s] shorter times are counted here


@dataclass(frozen=True, eq=False)
class RealTimeResult:
    """What the four processes measured, as plain values.

    Attributes:
        setup: what was measured.
        code: version of the code that ran, see :func:`~imitarm.benchmark.provenance.code_version`.
        machine: description of the machine.
        simulation: measurements of the simulation process, see
            :func:`~imitarm.benchmark.real_time_processes.simulate`.
        camera: measurements of the camera process.
        tracker: measurements of the tracker process.
        control: measurements of the control process, see :func:`~imitarm.benchmark.real_time_control.control`.
    """

    setup: RealTimeSetup
    code: str
    machine: str
    simulation: dict[str, Any]
    camera: dict[str, Any]
    tracker: dict[str, Any]
    control: dict[str, Any]

    # --- measures

    @property
    def late(self) -> Array:
        """Delay of the start of each step after its scheduled time, shape (n,) [s]."""
        return 1e-9 * np.asarray(self.control["late"], dtype=float)

    @property
    def sent(self) -> Array:
        """Time from the scheduled start of each step until its command was sent, shape (n,) [s]."""
        return self.late + self.computed

    @property
    def computed(self) -> Array:
        """Time from the start of each step until its command was sent, shape (n,) [s]."""
        return 1e-9 * np.asarray(self.control["computed"], dtype=float)

    @property
    def periods(self) -> int:
        """Number of scheduled control periods."""
        return len(self.control["late"]) + int(self.control["skipped"])

    @property
    def missed(self) -> int:
        """Number of periods before whose end no command was sent, because the step was too late or was not started."""
        return int(self.control["skipped"]) + int((self.sent > self.setup.dt).sum())

    @property
    def contacts(self) -> list[str]:
        """The pairs of bodies that touched in the simulation."""
        return list(self.simulation["contacts"])

    # --- file

    def write(self, path: Path) -> None:
        """Write the result as JSON.

        Raises:
            InputError: when the file can't be written; an existing file is then unchanged.
        """
        content = {"format": FORMAT, "version": VERSION, **asdict(self)}
        write_text(path, json.dumps(content, allow_nan=True) + "\n")

    @classmethod
    def read(cls, path: Path) -> RealTimeResult:
        """Read a result that :meth:`write` has written.

        Raises:
            FileFormatError: when the file contains no such result.
        """
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
            if content.pop("format") != FORMAT or content.pop("version") != VERSION:
                raise ValueError("another format or version")
            return cls(setup=RealTimeSetup(**content.pop("setup")), **content)
        except (OSError, ValueError, LookupError, TypeError, AttributeError) as error:
            raise FileFormatError(
                f"{path}: is not a result of 'imitarm benchmark real-time --out' ({error}); measure again"
            ) from error

    # --- tables

    def tables(self) -> list[Table]:
        """Return the tables: deadlines, times of the control loop, and the other processes."""
        return [self._deadlines(), self._times(), self._processes()]

    def _deadlines(self) -> Table:
        motions = self.control["motions"]
        steps = max(sum(motion["steps"] for motion in motions), 1)
        row = (
            f"{self.setup.rate:g}",
            str(self.periods),
            str(self.missed),
            f"{100.0 * self.missed / max(self.periods, 1):.3f}",
            str(self.control["skipped"]),
            f"{sum(motion['finished'] for motion in motions)} of {len(motions)}",
            f"{100.0 * sum(motion['avoiding'] for motion in motions) / steps:.0f}",
            str(len(self.contacts)),
            f"{1e3 * self.simulation['clearance']:.1f}",
        )
        columns = (
            "rate [Hz]>",
            "periods>",
            "missed deadlines>",
            "missed [%]>",
            "periods without a step>",
            "motions finished>",
            "avoiding [%]>",
            "contacts>",
            "least clearance [mm]>",
        )
        code = "with" if self.control["compiled"] else "without"
        note = (
            f"{self.setup.robot}, policy {self.setup.policy}, {self.setup.duration:g} s, {code} compiled code. "
            f"Machine: {self.machine}. A deadline is missed if no command is sent before the next period is due. "
            "Avoiding: fraction of the steps in which the policy avoided an obstacle. The last motion is not finished, "
            "because the duration ends."
        )
        return Table("Deadlines of the control loop", columns, (row,), note)

    def _times(self) -> Table:
        worked = 1e-9 * np.asarray(self.control["worked"], dtype=float)
        rows = (
            ("start, after the scheduled start", *_milliseconds(self.late)),
            ("command sent, after the start", *_milliseconds(self.computed)),
            ("command sent, after the scheduled start", *_milliseconds(self.sent)),
            ("end of the step, after the start", *_milliseconds(worked)),
            ("age of the scene", *_milliseconds(self.control["ages"])),
        )
        note = "The age of a scene is the simulated time since the image was taken from which the scene was tracked."
        return Table("Times of the control loop [ms]", ("time", *_HEADINGS), rows, note)

    def _processes(self) -> Table:
        simulation, camera, tracker = self.simulation, self.camera, self.tracker
        none = ("-",) * len(_QUANTILES)
        rows = (
            ("simulation", f"{self.setup.rate:g}", str(simulation["periods"]), str(simulation["missed"]), *none),
            (
                "camera and detector",
                f"{CAMERA_RATE:g}",
                str(camera["images"] + camera["missed"]),
                str(camera["missed"]),
                *_milliseconds(camera["seconds"]),
            ),
            ("tracker", f"{CAMERA_RATE:g}", str(tracker["updates"]), "-", *_milliseconds(tracker["seconds"])),
        )
        columns = ("process", "rate [Hz]>", "periods>", "missed>", *(f"{h.removesuffix('>')} [ms]>" for h in _HEADINGS))
        return Table("The other processes", columns, rows, "Times: calculation for one image or one update.")


def draw_histogram(result: RealTimeResult, picture: Path | None = None) -> str:
    """Draw how often each delay after the scheduled start of a period occurred, and return the drawing as SVG.

    Args:
        result: the measured times.
        picture: file in which the drawing is also saved, for example a PNG file.

    Raises:
        InputError: when matplotlib is not installed, or the file can't be written.
    """
    from imitarm.viewer import palette  # noqa: PLC0415 (draws: needs an extra)
    from imitarm.viewer.canvas import canvas  # noqa: PLC0415

    longest = max(float(result.sent.max(initial=0.0)), 2.0 * result.setup.dt)
    decades = math.log10(longest / _SHORTEST)
    edges = 1e3 * np.geomspace(_SHORTEST, longest, max(round(_BINS * decades), 2))
    with canvas("real-time", "Histogram of the delays after the scheduled start of a period", (5.8, 3.0)) as c:
        axes = c.axes(0.7, 0.85, 5.7, 2.9)
        for name, values, colour in (
            ("start of the step", result.late, palette.NOMINAL),
            ("command sent", result.sent, palette.ADAPTED),
        ):
            counts, _ = np.histogram(np.clip(1e3 * values, edges[0], edges[-1]), edges)
            axes.stairs(counts, edges, fill=True, alpha=0.35, color=colour)
            axes.stairs(counts, edges, color=colour, lw=1.2, label=name)
        axes.axvline(1e3 * result.setup.dt, color=palette.LIMIT, lw=1.2, ls="--", label="deadline")
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_ylim(bottom=0.7)
        axes.set_xlabel("delay after the scheduled start of the period [ms]")
        axes.set_ylabel("number of periods")
        c.legend(3)
        if picture is not None:
            _save(c.figure, picture)
    return c.svg


def _save(figure: Any, picture: Path) -> None:
    """Save a drawing under a temporary name, then rename the file."""
    aside = picture.with_name(f".{picture.stem}.{os.getpid()}.part{picture.suffix}")
    try:
        figure.savefig(aside, dpi=130, facecolor="white", metadata={"Software": None})
        aside.replace(picture)
    except (OSError, ValueError) as error:  # ValueError: matplotlib does not know this kind of file
        aside.unlink(missing_ok=True)
        raise InputError(f"{picture}: can't be written ({error}); name a PNG file in a folder that exists") from error


def write_page(result: RealTimeResult, path: Path, provenance: Mapping[str, Any]) -> Path:
    """Write tables and histogram as one HTML page, and return its path.

    Args:
        result: the result.
        path: the file to write; its folder must exist.
        provenance: facts needed to repeat the measurement.

    Raises:
        InputError: when the file can't be written, or the drawing libraries are not installed.
        TaskFailedError: when the disk is full.
    """
    from imitarm.viewer.page import Figure, Header, Tile, draw_page, render  # noqa: PLC0415 (draws: needs an extra)

    def page() -> str:
        tables = result.tables()
        late = float(np.quantile(result.sent, 0.999))
        header = Header(
            "The control loop in real time",
            f"{result.missed} of {result.periods} deadlines were missed",
            result.missed == 0 and not result.contacts,
            "Simulation, camera, tracker and control loop are four processes on one machine.",
            [
                Tile(f"{result.setup.rate:g}", "Hz", "rate of the control loop"),
                Tile(f"{1e3 * late:.2f}", "ms", "99.9th percentile of the time until a command is sent"),
                Tile(str(len(result.contacts)), "", "contacts in the simulation"),
            ],
        )
        caption = "Both axes are logarithmic. Delays below 0.01 ms are counted as 0.01 ms."
        figure = Figure(draw_histogram(result), "Delays after the scheduled start of a period", caption)
        return render(
            "avoidance.html",
            header,
            data={"tables": [{"title": t.title, "columns": t.columns, "rows": t.rows, "note": t.note} for t in tables]},
            data_name="imitarm-real-time.json",
            provenance=provenance,
            words={"Deadline": "The start of the next period, before which the command must be sent."},
            figures=[figure],
            tables=[table.for_page() for table in tables],
            scenes=[],
        )

    return draw_page(page, path)


def _milliseconds(seconds: ArrayLike) -> tuple[str, ...]:
    values = np.asarray(seconds, dtype=float)
    if not len(values):
        return ("-",) * len(_QUANTILES)
    return tuple(f"{1e3 * float(value):.3f}" for value in np.quantile(values, _QUANTILES))


def machine() -> str:
    """Return the number and the kind of the processors, the operating system and the version of Python."""
    kind = ""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        kind = next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), "")
    except OSError:  # not Linux
        kind = platform.processor()
    processors = f"{os.cpu_count()} processors" + (f" ({kind})" if kind else "")
    return f"{processors}, {platform.system()}, Python {platform.python_version()}"
