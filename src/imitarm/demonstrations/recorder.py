"""DemonstrationRecorder: writes a motion to a file sample by sample, so that a killed program loses no sample."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from imitarm.files.part_file import PartFile
from imitarm.kinematics.arm import ArmModel
from imitarm.trajectory import FORMAT, VERSION, Demonstration

Array = NDArray[np.float64]


class DemonstrationRecorder:
    """Writes each sample as a line of ``PATH.part``; closing the recorder converts this file to ``PATH``.

    Each line is handed to the operating system before :meth:`write` returns. If the program is killed, ``PATH.part``
    remains, and :meth:`Demonstration.load <imitarm.trajectory.Demonstration.load>` can read it. An older file ``PATH``
    stays intact until the new one is complete.

    Args:
        path: path of the file to write.
        arm: arm that moves; the poses of its tool and its joint positions are written.
        task: name of the task.
        source: origin of the motion, written into the file.
        replace: whether an existing file may be replaced.

    Attributes:
        path: path of the file to write.
        n_samples: number of samples written so far.

    Raises:
        InputError: when the file exists and may not be replaced, or when it can't be written. Also when ``PATH.part``
            exists, because another program is writing this file or was killed.
    """

    def __init__(
        self, path: str | Path, arm: ArmModel, *, task: str = "", source: str = "", replace: bool = False
    ) -> None:
        self.path, self.n_samples = Path(path), 0
        self._arm, self._task, self._source = arm, task, source
        self._time = -np.inf
        self._file = PartFile(path, self._header(), replace=replace)

    def _header(self) -> str:
        remarks = {
            "format": FORMAT,
            "version": VERSION,
            "units": "m s rad",
            "frame": "tool_to_base",
            "task": " ".join(self._task.split()),
            "source": " ".join(self._source.split()),
        }
        names = ("t", "x", "y", "z", "qw", "qx", "qy", "qz", *self._arm.joint_names)
        return "\n".join([*(f"# {key}: {value}" for key, value in remarks.items()), ",".join(names), ""])

    def write(self, time: float, q: Array) -> None:
        """Add a sample; a sample that is not later than the previous sample is ignored.

        Args:
            time: time of the sample [s].
            q: joint positions, shape (n_joints,) [rad].

        Raises:
            InputError: when the recorder is closed, or the disk is full.
        """
        if time <= self._time:
            return
        pose = self._arm.tool_pose(q)
        values = [time, *pose.position.tolist(), *pose.quaternion.tolist(), *q.tolist()]
        self._file.write(",".join(map(repr, values)) + "\n")
        self._time = time
        self.n_samples += 1

    def close(self) -> None:
        """Write the demonstration to its file. With fewer than two samples, no file is written.

        Calling this method again does nothing.

        Raises:
            InputError: when the file can't be completed; the samples stay in ``PATH.part``.
        """
        self._file.finish(self._take)

    def _take(self, part: Path) -> bool:
        if self.n_samples >= 2:
            replace(Demonstration.load(part), source=self._source).save(self.path)
        return False  # the part file was copied, not renamed

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
