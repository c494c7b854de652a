"""Bone lengths of a person's arm, measured over many frames and then enforced in every frame (thesis Eq 3.1 to 3.4)."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.capture.skeleton import Skeleton
from imitarm.errors import InputError
from imitarm.validation import finite_number, finite_vector, whole_number

Array = NDArray[np.float64]

MAD_TO_SIGMA = 1.4826  # median absolute deviation to standard deviation, for a normal distribution
ACCEPTED = 0.005  # [m] standard error of a length that is good enough
_SLOW = 0.3  # [m/s] faster elbows and wrists are blurred by the camera's exposure
_LEAST_FRAMES = 5
_PLAUSIBLE = (0.10, 0.60)  # [m] of an upper arm or forearm
_POINT = 1e-3  # [m] a shorter bone has no direction
_ROUNDING = 1e-7  # [m] nearer to its true length than this, a bone needs no further step


@dataclass(frozen=True)
class LimbLengths:
    """Lengths of a person's upper arm and forearm.

    Attributes:
        upper_arm: distance from shoulder to elbow [m].
        forearm: distance from elbow to wrist [m].
        spread: standard deviation of the measured values of each length, from their median absolute deviation [m].
        n_frames: number of frames in which the lengths were measured; 0 if they were given without a measurement.

    Raises:
        InputError: when a length is not between 0.1 and 0.6 m, or ``spread`` or ``n_frames`` is negative.
    """

    upper_arm: float
    forearm: float
    spread: tuple[float, float] = (0.0, 0.0)
    n_frames: int = 0

    def __post_init__(self) -> None:
        low, high = _PLAUSIBLE
        for what, value in (("upper_arm", self.upper_arm), ("forearm", self.forearm)):
            length = finite_number(value, f"LimbLengths: {what}", "m")
            if not low <= length <= high:
                raise InputError(
                    f"LimbLengths: {what} must be between {low} and {high} m, got {length!r}; is the unit metres, and "
                    "is the arm in view?"
                )
        spread = finite_vector(self.spread, 2, "LimbLengths: spread", "m")
        if (spread < 0.0).any():
            raise InputError(f"LimbLengths: spread must not be negative [m], got {self.spread!r}")
        whole_number(self.n_frames, "LimbLengths: n_frames", at_least=0)

    @property
    def standard_error(self) -> float:
        """The larger of the standard errors of the two lengths [m]; 0 when the lengths were given."""
        return max(self.spread) / self.n_frames**0.5 if self.n_frames else 0.0

    @property
    def accepted(self) -> bool:
        """Whether the standard error of both lengths is below 5 mm."""
        return self.standard_error < ACCEPTED

    @property
    def reach(self) -> float:
        """Distance from shoulder to wrist when the arm is straight [m]."""
        return self.upper_arm + self.forearm


def measure_limbs(skeletons: Iterable[Skeleton], side: str = "right") -> LimbLengths:
    """Measure the bone lengths of an arm as medians over frames in which the whole arm is tracked (docs/capture.md).

    Frames in which the arm moves fast are ignored if at least five other frames remain.

    Args:
        skeletons: skeletons in order of time; a recording of two seconds is long enough.
        side: which arm of the person to measure, ``"left"`` or ``"right"``.

    Raises:
        InputError: when fewer than five frames show the whole arm, or a measured length is not between 0.1 and 0.6 m.
    """
    arms = [skeleton.arm(side) for skeleton in skeletons]
    whole = [arm for arm in arms if arm.confidence[:3].min() >= 1.0]
    slow = [
        after
        for before, after in pairwise(whole)
        if after.time > before.time
        and np.abs(after.points[1:3] - before.points[1:3]).max() < _SLOW * (after.time - before.time)
    ]
    used = slow if len(slow) >= _LEAST_FRAMES else whole
    if len(used) < _LEAST_FRAMES:
        raise InputError(
            f"limb lengths: the {side} arm is fully tracked in {len(used)} of {len(arms)} frames, but {_LEAST_FRAMES} "
            "are needed; face the sensor with the arm away from the body"
        )
    points = np.array([arm.points[:3] for arm in used])
    lengths = np.linalg.norm(np.diff(points, axis=1), axis=2)
    middle = np.median(lengths, axis=0)
    spread = MAD_TO_SIGMA * np.median(np.abs(lengths - middle), axis=0)
    return LimbLengths(float(middle[0]), float(middle[1]), (float(spread[0]), float(spread[1])), len(used))


def correct_limbs(
    shoulder: ArrayLike,
    elbow: ArrayLike,
    wrist: ArrayLike,
    lengths: LimbLengths,
    *,
    as_printed: bool = False,
) -> tuple[Array, Array]:
    r"""Give the bones of an arm their true lengths and keep their directions (thesis Eq 3.1 to 3.4, corrected).

    .. math:: E_c = S + L_U \frac{E - S}{|E - S|}, \qquad W_c = E_c + L_F \frac{W - E}{|W - E|}

    Args:
        shoulder: measured shoulder position, shape (..., 3) [m].
        elbow: measured elbow position, shape (..., 3) [m].
        wrist: measured wrist position, shape (..., 3) [m].
        lengths: bone lengths of this person's arm.
        as_printed: whether to use the equations as printed in the thesis. The printed signs place the elbow on the
            wrong side of the shoulder. In addition, the printed forearm begins at the measured elbow instead of the
            corrected elbow.

    Returns:
        The corrected positions of elbow and wrist, shape (..., 3) [m] each.
    """
    s, e, w = (np.asarray(point, dtype=float) for point in (shoulder, elbow, wrist))
    upper, fore = _direction(e - s), _direction(w - e)
    if as_printed:
        return s - lengths.upper_arm * upper, e - lengths.forearm * fore
    corrected = s + lengths.upper_arm * upper
    return corrected, corrected + lengths.forearm * fore


def fit_limbs(points: Array, confidence: Array, lengths: LimbLengths, *, rounds: int = 3) -> Array:
    r"""Move shoulder, elbow and wrist as little as possible so that the bones have their true lengths.

    Point j (shoulder, elbow or wrist) moves from its measured position :math:`\tilde x_j` to :math:`x_j`. The function
    minimises the sum of the squared displacements, weighted by the confidences :math:`c_j`. If the measurement errors
    of the points are independent and Gaussian, the result is the most likely posture of the arm.

    .. math:: \min \sum_j c_j |x_j - \tilde x_j|^2 \quad\text{s.t.}\quad |E - S| = L_U,\; |W - E| = L_F

    A few Gauss-Newton steps solve this minimisation problem. Each step solves a 2 x 2 system of equations for the
    Lagrange multipliers. In contrast, :func:`correct_limbs` assumes that the shoulder is exact, and uses only the
    directions of the bones. It therefore transfers the errors of shoulder and elbow to the wrist.

    Args:
        points: measured positions of shoulder, elbow and wrist, one row each, shape (3, 3) [m].
        confidence: confidence of each point, above 0, shape (3,).
        lengths: bone lengths of this person's arm.
        rounds: number of Gauss-Newton steps.

    Returns:
        Positions of shoulder, elbow and wrist, shape (3, 3) [m]. The distances between them are exactly the given
        lengths.
    """
    # plain floats: for nine numbers five times as fast as NumPy
    (sx, sy, sz), (ex, ey, ez), (wx, wy, wz) = points.tolist()
    free_s, free_e, free_w = (1.0 / max(c, 1e-3) for c in confidence.tolist())
    m11, m22 = free_s + free_e, free_e + free_w
    long_u, long_f = lengths.upper_arm, lengths.forearm
    for step in range(rounds + 1):
        ux, uy, uz, fx, fy, fz = ex - sx, ey - sy, ez - sz, wx - ex, wy - ey, wz - ez
        upper, fore = math.sqrt(ux * ux + uy * uy + uz * uz), math.sqrt(fx * fx + fy * fy + fz * fz)
        if upper < _POINT or fore < _POINT:
            ux, uy, uz = _unit(ux, uy, uz, upper)
            fx, fy, fz = _unit(fx, fy, fz, fore)
            break
        ux, uy, uz, fx, fy, fz = ux / upper, uy / upper, uz / upper, fx / fore, fy / fore, fz / fore
        r1, r2 = long_u - upper, long_f - fore
        if step == rounds or (-_ROUNDING < r1 < _ROUNDING and -_ROUNDING < r2 < _ROUNDING):
            break
        m12 = -free_e * (ux * fx + uy * fy + uz * fz)
        determinant = m11 * m22 - m12 * m12
        a, b = (m22 * r1 - m12 * r2) / determinant, (m11 * r2 - m12 * r1) / determinant
        at_s, at_e, at_f, at_w = free_s * a, free_e * a, free_e * b, free_w * b
        sx, sy, sz = sx - at_s * ux, sy - at_s * uy, sz - at_s * uz
        ex, ey, ez = ex + at_e * ux - at_f * fx, ey + at_e * uy - at_f * fy, ez + at_e * uz - at_f * fz
        wx, wy, wz = wx + at_w * fx, wy + at_w * fy, wz + at_w * fz
    # the remaining error is removed as in correct_limbs
    ex, ey, ez = sx + long_u * ux, sy + long_u * uy, sz + long_u * uz
    return np.array([[sx, sy, sz], [ex, ey, ez], [ex + long_f * fx, ey + long_f * fy, ez + long_f * fz]])


def _unit(x: float, y: float, z: float, length: float) -> tuple[float, float, float]:
    """Return the unit vector in the direction of a vector; zero if the vector is almost zero."""
    return (x / length, y / length, z / length) if length > _POINT else (0.0, 0.0, 0.0)


def _direction(vectors: Array) -> Array:
    """Return the unit vectors in the directions of vectors; zero for vectors that are almost zero."""
    length = np.sqrt(np.sum(vectors * vectors, axis=-1, keepdims=True))
    return np.where(length > _POINT, vectors / np.maximum(length, _POINT), 0.0)
