"""DemonstrationRecorder: writes a motion to a file as it happens, nothing is lost when the program is killed."""

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
    """Writes to ``PATH.part``, one whole sample a line, and makes a demonstration of it when it is closed.

    Each line is handed to the operating system before :meth:`write` returns: a program that is killed leaves
    ``PATH.part``, which :meth:`Demonstration.load <imitarm.trajectory.Demonstration.load>` reads as it is. An older
    file ``PATH`` stays whole until the new one is.

    Args:
        path: where to.
        arm: that moves; its tool's poses are written, and its joints.
        task: what is shown.
        source: where it comes from.
        replace: an existing file may be replaced.

    Attributes:
        path: where to.
        n_samples: written so far.

    Raises:
        InputError: when the file is there already and may not be replaced, another recorder has left or is writing
            ``PATH.part``, or it can't be written.
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
        """Add a sample; one that is not later than the last is left out.

        Args:
            time: [s].
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
        """Write the demonstration under its name; fewer than two samples make none, and leave no file.

        A second call does nothing.

        Raises:
            InputError: when that is not possible; what was written stays in ``PATH.part``.
        """
        self._file.finish(self._take)

    def _take(self, part: Path) -> bool:
        if self.n_samples >= 2:
            replace(Demonstration.load(part), source=self._source).save(self.path)
        return False  # it was copied

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
