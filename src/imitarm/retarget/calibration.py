"""Calibration: measurements of a person, a sensor and a robot that are made once and kept in a file."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
from numpy.typing import NDArray

from imitarm.errors import FileFormatError, InputError
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.pose import Pose
from imitarm.retarget.correspondence import FACING, Correspondence, Orientation
from imitarm.retarget.limbs import LimbLengths

Array = NDArray[np.float64]
Anchor = Literal["shoulder", "object"]

FORMAT = "imitarm calibration"
VERSION = 1
ANCHORS: tuple[Anchor, ...] = ("shoulder", "object")
_LARGEST = 2**20  # [bytes] a calibration takes about 1 kB
_GRID = 41


@dataclass(frozen=True, eq=False)
class Calibration:
    """Measurements that are valid until the person changes or the sensor is moved; None: not measured.

    Attributes:
        side: which arm of the person.
        lengths: of that arm.
        sensor_to_base: pose of the sensor in the robot's base frame.
        sensor_rms: RMS residual of that pose [m].
        scale: robot's motion over the person's; None: 1.
        orientation: how the tool rotates with the hand; None: exactly as the hand does.

    Raises:
        InputError: when a value is not usable.
    """

    side: str = "right"
    lengths: LimbLengths | None = None
    sensor_to_base: Pose | None = None
    sensor_rms: float | None = None
    scale: float | None = None
    orientation: Orientation | None = None

    def __post_init__(self) -> None:
        self.correspondence()
        if self.sensor_rms is not None and not 0.0 <= self.sensor_rms < math.inf:
            raise InputError(f"Calibration: sensor_rms must be a finite length [m], got {self.sensor_rms!r}")

    def correspondence(self) -> Correspondence:
        """Return the correspondence; with defaults for what was not measured."""
        return Correspondence(
            self.side,
            FACING if self.sensor_to_base is None else self.sensor_to_base,
            self.lengths,
            1.0 if self.scale is None else self.scale,
            "hand" if self.orientation is None else self.orientation,
        )

    def save(self, path: str | Path) -> None:
        """Write the calibration as readable JSON, atomically.

        Raises:
            InputError: when it can't be written; an existing file is then unchanged.
        """
        target = Path(path)
        aside = target.with_name(f".{target.name}.{os.getpid()}.part")
        try:
            aside.write_text(json.dumps(self._content(), indent=2, allow_nan=False) + "\n", encoding="utf-8")
            aside.replace(target)
        except OSError as error:
            aside.unlink(missing_ok=True)
            raise InputError(f"{path}: can't be written: {error.strerror or error}") from error

    def _content(self) -> dict[str, Any]:
        content: dict[str, Any] = {
            "format": FORMAT,
            "version": VERSION,
            "units": {"length": "m", "quaternion": "w x y z"},
            "side": self.side,
        }
        if self.lengths is not None:
            content["limbs"] = {
                "upper_arm": self.lengths.upper_arm,
                "forearm": self.lengths.forearm,
                "spread": list(self.lengths.spread),
                "n_frames": self.lengths.n_frames,
            }
        if self.sensor_to_base is not None:
            content["sensor_to_base"] = {
                "position": self.sensor_to_base.position.tolist(),
                "quaternion": self.sensor_to_base.quaternion.tolist(),
            }
            if self.sensor_rms is not None:
                content["sensor_to_base"]["rms"] = self.sensor_rms
        if self.scale is not None:
            content["scale"] = self.scale
        if self.orientation is not None:
            content["orientation"] = self.orientation
        return content

    @classmethod
    def load(cls, path: str | Path) -> Calibration:
        """Read a file written by :meth:`save`.

        Raises:
            InputError: when there is no such file.
            FileFormatError: when it is not a calibration, is damaged, or has an unknown version.
        """
        content = _read(Path(path))
        try:
            fields = _Fields(content, "the file")
            fields.refuse_others(
                {"format", "version", "units", "side", "limbs", "sensor_to_base", "scale", "orientation"}
            )
            side, orientation = fields.text("side"), content.get("orientation")
            if orientation is not None:
                fields.text("orientation")
            return cls(
                side,
                _limbs(content),
                *_sensor(content),
                fields.numbers("scale", ()).item() if "scale" in content else None,
                cast(Orientation | None, orientation),
            )
        except InputError as error:
            raise FileFormatError(f"{path}: {error}") from error


def _read(path: Path) -> dict[str, Any]:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(
            f"{path}: can't be read ({error.strerror or error}); make one with 'imitarm calibrate'"
        ) from error
    if len(data) > _LARGEST:
        raise FileFormatError(f"{path}: larger than {_LARGEST // 2**20} MB, so it is not a calibration")
    try:
        content = json.loads(data.decode("utf-8"))
    except (ValueError, RecursionError) as error:
        raise FileFormatError(f"{path}: not readable as JSON ({error}); it is damaged or not a calibration") from error
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise FileFormatError(f"{path}: not a calibration (its 'format' is not {FORMAT!r})")
    if content.get("version") != VERSION or isinstance(content.get("version"), bool):
        raise FileFormatError(
            f"{path}: has version {content.get('version')!r:.40}, this imitarm reads version {VERSION}; update imitarm"
        )
    return content


class _Fields:
    """A group of fields; every value has the requested type, or an error names the field."""

    def __init__(self, values: object, place: str) -> None:
        if not isinstance(values, Mapping):
            raise InputError(f"{place}: should be a group of named fields, is {type(values).__name__}")
        self._values, self._place = values, place

    def _get(self, name: str) -> Any:
        if name not in self._values:
            raise InputError(f"{self._place}: field {name!r} is missing")
        return self._values[name]

    def refuse_others(self, known: set[str]) -> None:
        """Refuse fields that are not ``known``, so that a misspelt name is not ignored."""
        for name in self._values:
            if name not in known:
                raise InputError(f"{self._place}: unknown field {name!r:.60}; known: {', '.join(sorted(known))}")

    def text(self, name: str) -> str:
        value = self._get(name)
        if not isinstance(value, str):
            raise InputError(f"{self._place}: {name!r} should be text, is {value!r:.60}")
        return value

    def numbers(self, name: str, shape: tuple[int, ...]) -> Array:
        value = self._get(name)
        flat = value if isinstance(value, list) else [value]
        if not all(type(number) in {int, float} for number in flat):
            raise InputError(f"{self._place}: {name!r} should hold numbers, is {value!r:.60}")
        try:
            array = np.array(value, dtype=float)
        except OverflowError:
            array = np.array(np.inf)
        if array.shape != shape or not np.isfinite(array).all():
            what = f"{shape[0]} finite numbers" if shape else "a finite number"
            raise InputError(f"{self._place}: {name!r} should be {what}, is {value!r:.60}")
        return array


def _limbs(content: Mapping[str, Any]) -> LimbLengths | None:
    if "limbs" not in content:
        return None
    fields = _Fields(content["limbs"], "limbs")
    fields.refuse_others({"upper_arm", "forearm", "spread", "n_frames"})
    spread, n_frames = fields.numbers("spread", (2,)), fields.numbers("n_frames", ()).item()
    if n_frames < 0 or n_frames != round(n_frames) or (spread < 0.0).any():
        raise InputError("limbs: n_frames must be a whole number and spread at least 0")
    return LimbLengths(
        fields.numbers("upper_arm", ()).item(),
        fields.numbers("forearm", ()).item(),
        (float(spread[0]), float(spread[1])),
        int(n_frames),
    )


def _sensor(content: Mapping[str, Any]) -> tuple[Pose | None, float | None]:
    if "sensor_to_base" not in content:
        return None, None
    fields = _Fields(content["sensor_to_base"], "sensor_to_base")
    fields.refuse_others({"position", "quaternion", "rms"})
    pose = Pose(fields.numbers("position", (3,)), fields.numbers("quaternion", (4,)))
    return pose, fields.numbers("rms", ()).item() if "rms" in content["sensor_to_base"] else None


def robot_reach(arm: ArmModel) -> float:
    """Return the largest distance of a robot's wrist from its shoulder [m], by a search over the joints.

    Raises:
        InputError: when the arm's file does not define shoulder and wrist.
    """
    q = np.array(arm.home)
    lower, upper = np.maximum(arm.lower, -math.pi), np.minimum(arm.upper, math.pi)
    width = upper - lower

    def stretch(joint: int, value: float) -> float:
        posture = q.copy()
        posture[joint] = value
        shoulder, _, wrist = arm.sew_points(posture)
        return float(np.linalg.norm(wrist - shoulder))

    for _ in range(4):
        for joint in range(arm.n_joints):
            grid = np.linspace(q[joint] - 0.5 * width[joint], q[joint] + 0.5 * width[joint], _GRID)
            grid = np.append(np.clip(grid, lower[joint], upper[joint]), q[joint])
            q[joint] = grid[int(np.argmax([stretch(joint, value) for value in grid]))]
        width = width / 5.0
    return stretch(0, q[0])


def suggested_scale(arm: ArmModel, lengths: LimbLengths, anchor: Anchor = "shoulder") -> float:
    r"""Return a scale for this robot and this person (docs/capture.md).

    Args:
        arm: the robot's.
        lengths: the person's.
        anchor: ``"shoulder"``: the straight arms of person and robot correspond,
            :math:`\rho = reach_{robot} / reach_{human}`, so that the whole workspace is used; ``"object"``: 1, for work
            on objects of the same size.
    """
    return 1.0 if anchor == "object" else robot_reach(arm) / lengths.reach
