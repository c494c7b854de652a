"""Recordings of depth images and point clouds, in files that contain only arrays and no executable code."""

from __future__ import annotations

import zipfile
from bisect import bisect_right
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from imitarm.errors import FileFormatError, InputError
from imitarm.kinematics.pose import Pose
from imitarm.perception.depth_frame import DepthFrame, Intrinsics
from imitarm.perception.point_cloud import PointCloud
from imitarm.validation import file_path, finite_number, function

Frame = DepthFrame | PointCloud

_VERSION = 1
_CAMERA = ("width", "height", "fx", "fy", "cx", "cy")


@dataclass(frozen=True, eq=False)
class FrameRecording:
    """Recorded frames (depth images or point clouds), which can replace a camera.

    Iterate over a recording, or use :meth:`camera` as a camera of :class:`~imitarm.control_loop.CameraObserver`.

    Attributes:
        frames: recorded frames; each frame has a later stamp (time [s]) than the frame before it.

    Raises:
        InputError: when there is no frame, a frame is neither an image nor a point cloud, or the stamps do not
            increase.
    """

    frames: tuple[Frame, ...]

    def __post_init__(self) -> None:
        frames = tuple(self.frames)
        if not frames or not all(isinstance(frame, DepthFrame | PointCloud) for frame in frames):
            raise InputError("FrameRecording: frames must be at least one DepthFrame or PointCloud")
        for before, after in pairwise(frames):
            if after.stamp <= before.stamp:
                raise InputError(
                    f"FrameRecording: the stamps must increase, but {after.stamp:g} s follows {before.stamp:g} s; sort "
                    "the frames, and record each camera in a file of its own"
                )
        object.__setattr__(self, "frames", frames)

    def __iter__(self) -> Iterator[Frame]:
        return iter(self.frames)

    def __len__(self) -> int:
        return len(self.frames)

    def at(self, time: float) -> Frame | None:
        """Return the frame that was current at ``time`` [s]; None if ``time`` is before the first frame."""
        time = finite_number(time, "FrameRecording.at: time", "s")
        i = bisect_right([frame.stamp for frame in self.frames], time + 1e-9)
        return self.frames[i - 1] if i else None

    def camera(self, clock: Callable[[], float]) -> Callable[[], Frame | None]:
        """Return a function that acts as a camera: each call returns the current frame of the recording.

        Args:
            clock: function that returns the current time on the clock of the stamps [s].
        """
        clock = function(clock, "FrameRecording.camera: clock")
        return lambda: self.at(clock())

    def save(self, path: str | Path) -> None:
        """Write the recording; :meth:`load` reads it.

        Depths and points are rounded to single precision, and colours to 256 levels.

        Args:
            path: path of the file, which must end in ``.npz``.

        Raises:
            InputError: when the path does not end in ``.npz``, or the file can't be written.
        """
        path = file_path(path, "FrameRecording.save: path")
        if path.suffix != ".npz":
            raise InputError(f"FrameRecording.save: {path} must end in .npz")
        arrays: dict[str, Any] = {"version": _VERSION, "stamps": [frame.stamp for frame in self.frames]}
        for i, frame in enumerate(self.frames):
            pose = frame.camera_to_base if isinstance(frame, DepthFrame) else frame.sensor_to_base
            arrays[f"pose_{i}"] = np.concatenate([pose.position, pose.quaternion])
            color = frame.color if isinstance(frame, DepthFrame) else frame.colors
            if color is not None:
                arrays[f"color_{i}"] = np.round(255.0 * np.clip(np.nan_to_num(color), 0.0, 1.0)).astype(np.uint8)
            if isinstance(frame, DepthFrame):
                arrays[f"depth_{i}"] = frame.depth.astype(np.float32)
                arrays[f"camera_{i}"] = [getattr(frame.intrinsics, key) for key in _CAMERA]
            else:
                arrays[f"points_{i}"] = frame.measured.astype(np.float32)
                arrays[f"spacing_{i}"] = frame.spacing
        try:
            with path.open("wb") as file:
                np.savez_compressed(file, **arrays)
        except OSError as error:
            raise InputError(f"{path}: can't be written ({error.strerror}); name another file") from error

    @classmethod
    def load(cls, path: str | Path) -> FrameRecording:
        """Read a recording.

        Raises:
            FileFormatError: when the file can't be read as a recording of frames.
        """
        path = file_path(path, "FrameRecording.load: path")
        try:
            with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
                if int(arrays["version"]) != _VERSION:
                    raise FileFormatError(
                        f"{path}: has format version {int(arrays['version'])}, this program reads version {_VERSION}"
                    )
                stamps: Sequence[float] = arrays["stamps"].tolist()
                return cls(tuple(_frame(arrays, i, stamp) for i, stamp in enumerate(stamps)))
        except FileFormatError:
            raise
        except (OSError, KeyError, ValueError, TypeError, AttributeError, EOFError, zipfile.BadZipFile) as error:
            raise FileFormatError(
                f"{path}: can't be read as a recording of frames ({error}); write one with FrameRecording.save"
            ) from error
        except InputError as error:
            raise FileFormatError(f"{path}: {error}") from error


def _frame(arrays: Any, i: int, stamp: float) -> Frame:
    """Return frame ``i`` of a file."""
    pose = Pose(arrays[f"pose_{i}"][:3], arrays[f"pose_{i}"][3:])
    color = arrays[f"color_{i}"] / 255.0 if f"color_{i}" in arrays else None
    if f"depth_{i}" not in arrays:
        measured = arrays[f"points_{i}"].astype(float)
        return PointCloud(stamp, measured, pose, spacing=float(arrays[f"spacing_{i}"]), colors=color)
    width, height, *rest = arrays[f"camera_{i}"].tolist()
    camera = Intrinsics(round(width), round(height), *rest)
    return DepthFrame(stamp, arrays[f"depth_{i}"].astype(float), camera, pose, color)
