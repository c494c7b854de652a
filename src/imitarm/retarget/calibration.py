"""Calibration: measurements of a person's arm and of the sensor's pose, saved in a file."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.errors import FileFormatError, InputError
from imitarm.files.document import write_text
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.pose import Pose, matrix_to_quaternion
from imitarm.retarget.correspondence import FACING, Correspondence, Orientation
from imitarm.retarget.limbs import LimbLengths

Array = NDArray[np.float64]
Anchor = Literal["shoulder", "object"]

FORMAT = "imitarm calibration"
VERSION = 1
ANCHORS: tuple[Anchor, ...] = ("shoulder", "object")
_LARGEST = 2**20  # [bytes] a calibration takes about 1 kB
_GRID = 41

LEAST_PAIRS = 4
GOOD = 0.02  # [m] RMS residual of a good calibration; the noise of a skeleton camera is 1 to 2 cm
_USABLE = 0.10  # [m] with a larger RMS residual a unit, the order or an axis is wrong
_NEAR = 0.05  # [m] points within this distance of their mean are one point for a skeleton camera
_THIN = 0.03  # [m] the same for the distance from a line
_FLAT = 0.02  # [m] the same for the distance from a plane
_MISTAKEN = 3.0  # a pair is suspect when the RMS residual without it is smaller by this factor
_WORTH = 0.005  # [m] RMS residual below which no pair is suspect


@dataclass(frozen=True, eq=False)
class Calibration:
    """Measurements of a person's arm and of a sensor; a value that was not measured is None.

    Attributes:
        side: side of the measured arm, ``"left"`` or ``"right"``.
        lengths: bone lengths of this arm.
        sensor_to_base: pose of the sensor in the robot's base frame.
        sensor_rms: root mean square error of the points from which the pose of the sensor was computed [m].
        scale: motion of the tool divided by the motion of the hand; None: 1.
        orientation: how the tool rotates with the hand, see :class:`~imitarm.retarget.correspondence.Correspondence`;
            None: the tool rotates like the hand.

    Raises:
        InputError: when a value is out of range or has the wrong type.
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
        """Return a correspondence with the measured values, and with default values for all others."""
        return Correspondence(
            self.side,
            FACING if self.sensor_to_base is None else self.sensor_to_base,
            self.lengths,
            1.0 if self.scale is None else self.scale,
            "hand" if self.orientation is None else self.orientation,
        )

    def save(self, path: str | Path) -> None:
        """Write the calibration as JSON; an existing file is replaced only when the new file is complete.

        Raises:
            InputError: when the file can't be written; an existing file is then unchanged.
        """
        write_text(path, json.dumps(self._content(), indent=2, allow_nan=False) + "\n")

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
            InputError: when the file does not exist.
            FileFormatError: when the file is not a calibration, is damaged, or has an unknown version.
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
            f"{path}: can't be read ({error.strerror or error}); create a calibration with 'imitarm calibrate'"
        ) from error
    if len(data) > _LARGEST:
        raise FileFormatError(f"{path}: larger than {_LARGEST // 2**20} MB, so it is not a calibration; check the path")
    try:
        content = json.loads(data.decode("utf-8"))
    except (ValueError, RecursionError) as error:
        raise FileFormatError(
            f"{path}: not readable as JSON ({error}); the file is damaged or not a calibration"
        ) from error
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise FileFormatError(f"{path}: not a calibration, because its 'format' is not {FORMAT!r}; check the path")
    if content.get("version") != VERSION or isinstance(content.get("version"), bool):
        raise FileFormatError(
            f"{path}: has version {content.get('version')!r:.40}, but this imitarm reads version {VERSION}; "
            "update imitarm"
        )
    return content


class _Fields:
    """A group of fields of a document, with checked types; error messages name the field."""

    def __init__(self, values: object, place: str) -> None:
        if not isinstance(values, Mapping):
            raise InputError(f"{place}: must be a group of named fields, but is {type(values).__name__}")
        self._values, self._place = values, place

    def _get(self, name: str) -> Any:
        if name not in self._values:
            raise InputError(f"{self._place}: field {name!r} is missing")
        return self._values[name]

    def refuse_others(self, known: set[str]) -> None:
        """Reject fields that are not ``known``, so that a misspelt name is not ignored."""
        for name in self._values:
            if name not in known:
                raise InputError(f"{self._place}: unknown field {name!r:.60}; known: {', '.join(sorted(known))}")

    def text(self, name: str) -> str:
        value = self._get(name)
        if not isinstance(value, str):
            raise InputError(f"{self._place}: {name!r} must be text, but is {value!r:.60}")
        return value

    def numbers(self, name: str, shape: tuple[int, ...]) -> Array:
        value = self._get(name)
        flat = value if isinstance(value, list) else [value]
        if not all(type(number) in {int, float} for number in flat):
            raise InputError(f"{self._place}: {name!r} must contain numbers, but is {value!r:.60}")
        try:
            array = np.array(value, dtype=float)
        except OverflowError:
            array = np.array(np.inf)
        if array.shape != shape or not np.isfinite(array).all():
            what = f"{shape[0]} finite numbers" if shape else "a finite number"
            raise InputError(f"{self._place}: {name!r} must be {what}, but is {value!r:.60}")
        return array


def _limbs(content: Mapping[str, Any]) -> LimbLengths | None:
    if "limbs" not in content:
        return None
    fields = _Fields(content["limbs"], "limbs")
    fields.refuse_others({"upper_arm", "forearm", "spread", "n_frames"})
    spread, n_frames = fields.numbers("spread", (2,)), fields.numbers("n_frames", ()).item()
    if n_frames < 0 or n_frames != round(n_frames) or (spread < 0.0).any():
        raise InputError("limbs: n_frames must be a whole number, and spread must be at least 0")
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
    """Return the largest distance between a robot's wrist and its shoulder [m], from a search over the joint positions.

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
    r"""Return a suitable ratio of the tool's to the hand's displacement, for a robot and a person (docs/capture.md).

    Args:
        arm: arm of the robot.
        lengths: bone lengths of the person's arm.
        anchor: what determines the scale. With ``"shoulder"``, the scale is the reach of the robot's arm divided by the
            reach of the person's arm, so that the person can use the robot's whole workspace. With ``"object"``, the
            scale is 1, because robot and person handle objects of the same size.
    """
    return 1.0 if anchor == "object" else robot_reach(arm) / lengths.reach


@dataclass(frozen=True, eq=False)
class SensorFit:
    """Result of a sensor calibration: the pose of the sensor and its uncertainty.

    Attributes:
        sensor_to_base: pose of the sensor in the robot's base frame.
        residuals: distance between the two points of each pair after the fit, shape (n,) [m].
        condition: first singular value of the points' cross-covariance H, divided by the second. It is large if the
            points lie almost on a line, so that the rotation is uncertain.
        angle_error: standard error of the rotation about the axis with the largest uncertainty [rad].
        flat: whether the points lie in a plane, so that a mirrored axis can't be detected.
        suspect: index, from 0, of the pair that does not fit the other pairs; None: all pairs fit.
    """

    sensor_to_base: Pose
    residuals: Array
    condition: float
    angle_error: float
    flat: bool
    suspect: int | None = None

    @property
    def rms(self) -> float:
        """Root mean square of the residuals [m]."""
        return float(np.sqrt(np.mean(self.residuals**2)))

    @property
    def accepted(self) -> bool:
        """Whether the fit is good enough for teleoperation.

        A fit is good enough if the root mean square of the residuals is at most 2 cm and no pair is ``suspect``.
        """
        return self.rms <= GOOD and self.suspect is None

    def notes(self) -> list[str]:
        """Return one line of text for each problem of the fit, which says what the user can do."""
        lines = []
        if self.flat:
            lines.append(
                "the points lie in a plane, so a mirrored axis would not be detected; add a point well outside that "
                "plane"
            )
        if self.suspect is not None:
            lines.append(
                f"point {self.suspect + 1} does not fit the others (by {100 * self.residuals[self.suspect]:.1f} cm); "
                "touch this point again, or leave it out"
            )
        elif self.rms > GOOD:
            lines.append(
                f"the average error is {100 * self.rms:.1f} cm, but should be at most {100 * GOOD:.0f} cm; "
                "hold the hand still and in view during the measurement"
            )
        return lines


def fit_sensor_to_base(sensor: ArrayLike, base: ArrayLike, weights: ArrayLike | None = None) -> SensorFit:
    r"""Compute the pose of the sensor from points that are known in both frames (Kabsch 1976, Umeyama 1991).

    .. math::
        H = \sum_i c_i (k_i - \bar k)(b_i - \bar b)^T = U S V^T, \quad
        R = V\,\mathrm{diag}(1, 1, \det V U^T)\,U^T, \quad t = \bar b - R \bar k

    Here, H is the weighted cross-covariance of the points :math:`k_i` in the sensor's frame and :math:`b_i` in the base
    frame. R and t are the rotation and the translation from sensor to base. No scale is fitted, because a scale would
    hide a wrong unit of length.

    Args:
        sensor: points :math:`k_i` as the sensor measured them, in the sensor's frame, shape (n, 3) [m].
        base: the same points :math:`b_i` in the robot's base frame, shape (n, 3) [m].
        weights: weights :math:`c_i` of the pairs of points, shape (n,); None: equal weights.

    Raises:
        InputError: when there are fewer than four pairs, when a point is not finite, when the points lie on a line or
            too close together, or when no rigid motion maps one set of points to the other. The message says what to
            do.
    """
    k, b, c = _checked(sensor, base, weights)
    pose, singular = _kabsch(k, b, c)
    residuals = np.linalg.norm(pose.apply(k) - b, axis=1)
    spread = _spread(b)
    rms = float(np.sqrt(np.mean(residuals**2)))
    if rms > _USABLE:
        error = f"sensor calibration: the average error is {100 * rms:.0f} cm"
        raise InputError(f"{error}; {_misfit(k, b, c, rms)}")
    sigma = math.sqrt(float(np.sum(residuals**2)) / max(3 * len(k) - 6, 1))
    lever = math.sqrt(len(k) * float(spread[1] ** 2 + spread[2] ** 2))
    return SensorFit(
        pose,
        residuals,
        float(singular[0] / max(singular[1], 1e-12)),
        sigma / lever,
        bool(spread[2] < _FLAT),
        _suspect(k, b, c, rms),
    )


def _checked(sensor: ArrayLike, base: ArrayLike, weights: ArrayLike | None) -> tuple[Array, Array, Array]:
    k, b = np.asarray(sensor, dtype=float), np.asarray(base, dtype=float)
    if k.ndim != 2 or k.shape[1:] != (3,) or k.shape != b.shape:
        raise InputError(f"sensor calibration: needs two arrays of shape (n, 3), got shapes {k.shape} and {b.shape}")
    if len(k) < LEAST_PAIRS:
        raise InputError(
            f"sensor calibration: {len(k)} pairs of points, but at least {LEAST_PAIRS} are needed; touch more points"
        )
    bad = ~np.isfinite(k).all(axis=1) | ~np.isfinite(b).all(axis=1)
    if bad.any():
        raise InputError(f"sensor calibration: point {int(np.argmax(bad)) + 1} is not finite; touch it again")
    c = np.ones(len(k)) if weights is None else np.asarray(weights, dtype=float)
    if c.shape != (len(k),) or not np.isfinite(c).all() or (c <= 0.0).any():
        raise InputError(f"sensor calibration: weights must be {len(k)} positive numbers, got {weights!r}")
    for points, whose in ((k, "the sensor"), (b, "the robot")):
        wide, thin, _ = _spread(points)
        if wide < _NEAR:
            raise InputError(
                f"sensor calibration: the points of {whose} lie within {100 * wide:.1f} cm of their mean; choose "
                "points that are 20 to 60 cm apart, and give them in metres"
            )
        if thin < _THIN:
            raise InputError(
                f"sensor calibration: the points of {whose} lie on a line (within {100 * thin:.1f} cm), so "
                "the rotation about that line is unknown; add points well outside it"
            )
    return k, b, c


def _spread(points: Array) -> Array:
    """Return the standard deviations of points along their principal directions, largest first, shape (3,) [m]."""
    return np.asarray(np.linalg.svd(points - points.mean(axis=0), compute_uv=False) / math.sqrt(len(points)))


def _kabsch(k: Array, b: Array, c: Array) -> tuple[Pose, Array]:
    """Return the rigid motion that maps points k to points b, and the singular values of H."""
    weight = c / c.sum()
    k_mean, b_mean = weight @ k, weight @ b
    u, singular, vt = np.linalg.svd((k - k_mean).T @ (weight[:, None] * (b - b_mean)))
    rotation = vt.T @ np.diag([1.0, 1.0, np.sign(np.linalg.det(vt.T @ u.T))]) @ u.T
    return Pose(b_mean - rotation @ k_mean, matrix_to_quaternion(rotation)), singular


def _rms(k: Array, b: Array, c: Array) -> float:
    pose, _ = _kabsch(k, b, c)
    return float(np.sqrt(np.mean(np.sum((pose.apply(k) - b) ** 2, axis=1))))


def _suspect(k: Array, b: Array, c: Array, rms: float) -> int | None:
    """Return the index of the pair whose removal improves the fit most; None when no pair is an outlier."""
    if len(k) < LEAST_PAIRS + 1 or rms < _WORTH:
        return None
    every = np.arange(len(k))
    without = [_rms(k[every != i], b[every != i], c[every != i]) for i in every]
    best = int(np.argmin(without))
    return best if _MISTAKEN * without[best] < rms else None


def _misfit(k: Array, b: Array, c: Array, rms: float) -> str:
    """Return the most likely reason why no rigid motion maps one set of points to the other."""
    ratio = float(np.linalg.norm(b - b.mean(axis=0)) / np.linalg.norm(k - k.mean(axis=0)))
    if _rms(k * [-1.0, 1.0, 1.0], b, c) < 0.5 * rms:
        return "one of the frames is mirrored: reverse the sensor's x axis (is its image mirrored?)"
    if not 0.67 < ratio < 1.5 and _rms(ratio * k, b, c) < 0.5 * rms:
        return f"the robot's points are {ratio:.3g} times as far apart as the sensor's points: give both in metres"
    suspect = _suspect(k, b, c, rms)
    if suspect is not None:
        return f"point {suspect + 1} does not fit the others: touch this point again, or leave it out"
    return "the points of sensor and robot are not the same points in the same order: touch them again one by one"
