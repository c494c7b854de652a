"""Real people lead the simulated arms: the tables of docs/real_data.md, as Markdown.

    python -m imitarm.benchmark.real_motions DATA [VIDEO ...] [--fill docs/real_data.md]

DATA is the folder with ``kinect_gestures`` and ``mocap_arm``, VIDEO are films of a person or recordings of one.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from imitarm.benchmark.experiment import write_text
from imitarm.benchmark.tables import Table
from imitarm.capture.checks import repaired
from imitarm.capture.recording import SkeletonRecording, slowed
from imitarm.capture.skeleton import Skeleton
from imitarm.capture.sources import followed, open_source
from imitarm.errors import ImitarmError, InputError
from imitarm.evaluation.execution import execute_on_robot
from imitarm.evaluation.mapping_metrics import measure
from imitarm.evaluation.tracking import seen_arm, target_lag
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.self_clearance import SelfClearance
from imitarm.retarget import RETARGETERS, Correspondence
from imitarm.retarget.engagement import SEEN_FOR
from imitarm.retarget.fitting import fit_motion

PACES = (1.0, 0.5)
BEGIN, END = "<!-- real motions -->", "<!-- end -->"
"""Between these lines of a document stand the tables."""
_PERIOD = 0.01  # [s]
_ARMS = ("sawyer", "panda")
_COLUMNS = (
    "scale>",
    "tool asked for, up to [m/s]>",
    "following [%]>",
    "to its target, RMS [mm]>",
    "lag [ms]>",
    "frames beyond a limit>",
    "highest velocity, acceleration [% of the limit]>",
    "links apart, least [mm]>",
    "driven: behind, at most [mrad]>",
    "driven: torque [% of the rated]>",
)
_STRIDE = 10  # periods over which a hand's speed is taken: a camera's noise would be most of it in one
_FILMS = (".mp4", ".mov", ".avi", ".mkv", ".webm")
_GESTURES = {
    "wave hand": ("Ges01_wavehand.csv", "right"),
    "balance hands": ("Ges02_balancinghands.csv", "right"),
    "draw lines": ("Ges03_drawlines.csv", "right"),
    "come here": ("Ges04_comehere.csv", "left"),
}


class Shown(NamedTuple):
    """A motion of a real person: its name, the skeletons, the arm that moves."""

    name: str
    skeletons: list[Skeleton]
    side: str


def main(argv: Sequence[str] | None = None) -> int:
    """Print the tables, and put them into a document where that is asked for; return the exit status."""
    parser = argparse.ArgumentParser(prog="python -m imitarm.benchmark.real_motions", description=__doc__)
    parser.add_argument("data", type=Path, metavar="DATA")
    parser.add_argument("videos", nargs="*", metavar="VIDEO")
    parser.add_argument("--fill", type=Path, metavar="FILE", help=f"a document, between {BEGIN!r} and {END!r}")
    arguments = parser.parse_args(argv)
    try:
        if arguments.fill is not None:
            _split(arguments.fill)
        text = "\n".join(table.markdown() for table in tables(list(real_motions(arguments.data, arguments.videos))))
        sys.stdout.write(text)
        if arguments.fill is not None:
            head, tail = _split(arguments.fill)
            write_text(arguments.fill, f"{head}{BEGIN}\n\n{text}\n{END}{tail}")
    except ImitarmError as error:
        sys.stderr.write(f"{error}\n")
        return error.exit_status
    return 0


def _split(document: Path) -> tuple[str, str]:
    """Return what stands before and after the tables of a document.

    Raises:
        InputError: when it can't be read, or the tables have no place in it.
    """
    try:
        text = document.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{document}: can't be read as a document ({error})") from error
    head, begins, rest = text.partition(BEGIN)
    _, ends, tail = rest.partition(END)
    if not (begins and ends):
        raise InputError(f"{document}: needs a line {BEGIN!r} and after it a line {END!r}: the tables go between")
    return head, tail


def real_motions(data: Path, videos: Sequence[str] = ()) -> Iterator[Shown]:
    """Give what there is of real people in motion.

    Args:
        data: the folder of real recordings.
        videos: films of a person, or recordings of one.

    Raises:
        InputError: when a file is missing or can't be read, or MediaPipe is needed and not there.
    """
    for name, (file, side) in _GESTURES.items():
        yield Shown(name, _person(str(data / "kinect_gestures" / file)), side)
    yield Shown("motion capture", _person(str(data / "mocap_arm" / "recording.tsv")), "right")
    for video in videos:
        word = f"video:{video}" if Path(video).suffix.lower() in _FILMS else video
        yield Shown(f"video {Path(video).stem}", _person(word), "left")


def _person(word: str) -> list[Skeleton]:
    source = open_source(word)
    mended = repaired(source)[0] if isinstance(source, SkeletonRecording) else source
    with followed(mended) as one:
        return list(one)


def tables(motions: Sequence[Shown]) -> list[Table]:
    """Return two tables: ``modern`` on every motion and arm at each pace, and all methods on the first motion.

    Args:
        motions: at least one.
    """
    modern = [
        (motion.name, arm, f"{pace:g}", *_row(motion, arm, pace, "modern"))
        for motion in motions
        for arm in _ARMS
        for pace in PACES
    ]
    first, pace = motions[0], PACES[-1]
    every = [(arm, method, *_row(first, arm, pace, method)) for arm in _ARMS for method in RETARGETERS]
    return [
        Table("modern on every motion", ("motion", "arm", "pace>", *_COLUMNS), tuple(modern)),
        Table(f"All methods on {first.name!r} at pace {pace:g}", ("arm", "method", *_COLUMNS), tuple(every)),
    ]


def _row(motion: Shown, robot: str, pace: float, method: str) -> list[str]:
    """Return the cells of one motion by one method on one arm, which begins where all of the motion is in its reach."""
    arm = ArmModel.load(robot, tool="gripper")
    skeletons = slowed(motion.skeletons, pace)
    follow = Correspondence(motion.side, orientation="fixed")
    wrist = seen_arm(skeletons, np.arange(SEEN_FOR, skeletons[-1].time - skeletons[0].time, _PERIOD), follow).wrist
    fit = fit_motion(arm, wrist, wrist[0])
    follow = replace(follow, scale=fit.scale)
    gone = np.linalg.norm(wrist[_STRIDE:] - wrist[:-_STRIDE], axis=1) / (_STRIDE * _PERIOD)
    run = RETARGETERS[method](arm, follow, dt=_PERIOD).run(skeletons, fit.q)
    m, execution, links = measure(run, follow), execute_on_robot(run), SelfClearance(arm)
    lag = 1e3 * target_lag(run.times, arm.tool_path(run.joints)[0], run.targets[0])
    return [
        f"{fit.scale:.2f}",
        f"{fit.scale * float(gone.max()):.1f}",
        f"{100 * m.following_fraction:.0f}",
        f"{1e3 * m.target_rms:.0f}",
        f"{lag:.0f}" if np.isfinite(lag) else "–",
        str(m.limit_violations),
        f"{100 * m.velocity_ratio:.0f}, {100 * m.acceleration_ratio:.0f}",
        f"{1e3 * min(links.distance(q) for q in run.joints[::2]):.0f}",
        f"{1e3 * execution.error_max:.1f}",
        f"{100 * execution.peak_torque_ratio:.0f}" + (" (stopped itself)" if execution.fault else ""),
    ]


if __name__ == "__main__":
    sys.exit(main())
