"""``imitarm benchmark people``: make simulated arms follow recorded motions of real people."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from imitarm.benchmark.tables import Table
from imitarm.capture.checks import repaired
from imitarm.capture.recording import SkeletonRecording, slowed
from imitarm.capture.skeleton import Skeleton
from imitarm.capture.sources import followed, open_source
from imitarm.evaluation.execution import execute_on_robot
from imitarm.evaluation.mapping_metrics import measure
from imitarm.evaluation.tracking import seen_arm, target_lag
from imitarm.kinematics.arm import ArmModel
from imitarm.retarget import RETARGETERS, Correspondence
from imitarm.retarget.engagement import SEEN_FOR
from imitarm.retarget.fitting import fit_motion
from imitarm.scene.clearance import SelfClearance

SPEEDS = (1.0, 0.5)
_PERIOD = 0.01  # [s]
_ARMS = ("sawyer", "panda")
_COLUMNS = (
    "scale>",
    "largest target speed [m/s]>",
    "following [%]>",
    "distance to the target, RMS [mm]>",
    "lag [ms]>",
    "frames beyond a limit>",
    "highest joint velocity and acceleration [% of the limit]>",
    "smallest distance between links of the arm [mm]>",
    "largest joint error of the simulated arm [mrad]>",
    "largest torque of the simulated arm [% of the rated torque]>",
)
_STRIDE = 10  # periods over which a hand's speed is measured: in one, most of it would be the camera's noise
_VIDEOS = (".mp4", ".mov", ".avi", ".mkv", ".webm")
_GESTURES = {
    "wave hand": ("Ges01_wavehand.csv", "right"),
    "balance hands": ("Ges02_balancinghands.csv", "right"),
    "draw lines": ("Ges03_drawlines.csv", "right"),
    "come here": ("Ges04_comehere.csv", "left"),
}


class Motion(NamedTuple):
    """A recorded motion of a real person: name, skeletons, and the side of the arm that moves."""

    name: str
    skeletons: list[Skeleton]
    side: str


def real_motions(data: Path, videos: Sequence[str] = ()) -> Iterator[Motion]:
    """Yield the motions of real people, read from files.

    Args:
        data: folder with the recordings ``kinect_gestures`` and ``mocap_arm``.
        videos: further files: videos or skeleton recordings of a person whose left arm moves.

    Raises:
        InputError: when a file is missing or can't be read, or MediaPipe is needed but not installed.
    """
    for name, (file, side) in _GESTURES.items():
        yield Motion(name, _person(str(data / "kinect_gestures" / file)), side)
    yield Motion("motion capture", _person(str(data / "mocap_arm" / "recording.tsv")), "right")
    for video in videos:
        word = f"video:{video}" if Path(video).suffix.lower() in _VIDEOS else video
        yield Motion(f"video {Path(video).stem}", _person(word), "left")


def _person(word: str) -> list[Skeleton]:
    source = open_source(word)
    played = repaired(source)[0] if isinstance(source, SkeletonRecording) else source
    with followed(played) as one:
        return list(one)


def tables(motions: Sequence[Motion]) -> list[Table]:
    """Return two tables.

    The first table shows the method ``modern`` with every motion, arm and playback speed. The second table shows all
    methods, with the first motion at half speed.

    Args:
        motions: at least one motion.
    """
    arms = {name: ArmModel.load(name, tool="gripper") for name in _ARMS}
    modern, starts = [], {}
    for motion in motions:
        for arm in _ARMS:
            for speed in SPEEDS:
                start = starts[motion.name, arm, speed] = _start(motion, arms[arm], speed)
                modern.append((motion.name, arm, f"{speed:g}", *_row(start, "modern")))
    first, speed = motions[0], SPEEDS[-1]
    every = [(arm, name, *_row(starts[first.name, arm, speed], name)) for arm in _ARMS for name in RETARGETERS]
    return [
        Table(
            "Results of the method modern for every motion, arm and playback speed",
            ("motion", "arm", "playback speed>", *_COLUMNS),
            tuple(modern),
        ),
        Table(
            f"Results of all methods for the motion {first.name!r} at playback speed {speed:g}",
            ("arm", "method", *_COLUMNS),
            tuple(every),
        ),
    ]


class Start(NamedTuple):
    """The input for retargeting a motion to an arm.

    Scale and start posture are chosen so that the whole motion is within the reach of the arm.

    Attributes:
        arm: the arm with a gripper.
        skeletons: the recorded skeletons at the playback speed.
        follow: map from the person's motion to the robot's motion.
        q: start posture, shape (n_joints,) [rad].
        target_speed: highest speed of the robot's target [m/s].
    """

    arm: ArmModel
    skeletons: list[Skeleton]
    follow: Correspondence
    q: NDArray[np.float64]
    target_speed: float


def _start(motion: Motion, arm: ArmModel, speed: float) -> Start:
    skeletons = slowed(motion.skeletons, speed)
    follow = Correspondence(motion.side, orientation="fixed")
    wrist = seen_arm(skeletons, np.arange(SEEN_FOR, skeletons[-1].time - skeletons[0].time, _PERIOD), follow).wrist
    fit = fit_motion(arm, wrist, wrist[0])
    follow = replace(follow, scale=fit.scale)
    speeds = np.linalg.norm(wrist[_STRIDE:] - wrist[:-_STRIDE], axis=1) / (_STRIDE * _PERIOD)
    return Start(arm, skeletons, follow, fit.q, fit.scale * float(speeds.max()))


def _row(start: Start, method: str) -> list[str]:
    """Return the table cells for one motion, one method and one arm."""
    arm, follow = start.arm, start.follow
    run = RETARGETERS[method](arm, follow, dt=_PERIOD).run(start.skeletons, start.q)
    m, execution, links = measure(run, follow), execute_on_robot(run), SelfClearance(arm)
    lag = 1e3 * target_lag(run.times, arm.tool_path(run.joints)[0], run.targets[0])
    return [
        f"{follow.scale:.2f}",
        f"{start.target_speed:.1f}",
        f"{100 * m.following_fraction:.0f}",
        f"{1e3 * m.target_rms:.0f}",
        f"{lag:.0f}" if np.isfinite(lag) else "–",
        str(m.limit_violations),
        f"{100 * m.velocity_ratio:.0f}, {100 * m.acceleration_ratio:.0f}",
        f"{1e3 * min(links.distance(q) for q in run.joints[::2]):.0f}",
        f"{1e3 * execution.error_max:.1f}",
        f"{100 * execution.peak_torque_ratio:.0f}" + (" (stopped itself)" if execution.fault else ""),
    ]
