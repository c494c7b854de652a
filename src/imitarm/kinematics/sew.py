r"""The shoulder-elbow-wrist angle: the position of the elbow on its circle about the line from shoulder to wrist.

The elbow of an arm with seven joints can move while the hand is at rest. One angle describes the elbow's position, both
for a person and for a robot. This angle is measured from a reference direction. For every choice of the reference
direction, the angle is undefined at some wrist positions (Elias and Wen 2024). The ``"conventional"`` angle is measured
from a fixed vector v. It is undefined when the line from shoulder to wrist is parallel to v. The ``"stereographic"``
angle is undefined only when the wrist is on one half of a line through the shoulder. In this module, this half-line
points backwards from the shoulder, where the wrist rarely is.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.errors import InputError, UnknownNameError

Array = NDArray[np.float64]
# Three components, either floats or arrays of one shape: the same formulas serve one instant and many.
Vector = tuple[Any, Any, Any]

UP = (0.0, 0.0, 1.0)
"""Upward direction. If the wrist is in front of the shoulder, the angle is 0 when the elbow is above the line between
shoulder and wrist. The angle is pi when the elbow is below this line."""
_LOST = 1e-12  # squared sine below which an angle is only rounding


class SewAngle(NamedTuple):
    """The SEW angle of one or more arms, and its derivatives.

    Attributes:
        angle: SEW angle in [-pi, pi], shape (...) [rad].
        shoulder: derivative with respect to the shoulder's position, shape (..., 3) [rad/m].
        elbow: derivative with respect to the elbow's position, shape (..., 3) [rad/m].
        wrist: derivative with respect to the wrist's position, shape (..., 3) [rad/m].
        bend: squared sine of the angle at the elbow, shape (...); 0 where the arm is straight and the angle is
            undefined.
        reference: squared length of the reference direction, shape (...); 0 where the reference is undefined.
    """

    angle: Any
    shoulder: Any
    elbow: Any
    wrist: Any
    bend: Any
    reference: Any


def sew_angle(
    shoulder: ArrayLike, elbow: ArrayLike, wrist: ArrayLike, *, convention: str = "stereographic"
) -> NDArray[np.float64]:
    r"""Return the angle of the elbow about the line from shoulder to wrist.

    Let :math:`\hat w` be the direction from shoulder to wrist, e the direction from shoulder to elbow, :math:`e_t` the
    backward direction (-x) and :math:`e_r` the upward direction (z). Then the stereographic angle is measured from
    :math:`e_x`:

    .. math::
        k_r = (\hat w - e_t) \times e_r, \quad k_x = k_r \times (W - S), \quad e_x = k_x / |k_x|, \quad
        \psi = \mathrm{atan2}(\hat w \cdot (e_x \times e),\; e_x \cdot e)

    The conventional angle is measured from the component of :math:`e_r` perpendicular to :math:`\hat w`. Both angles
    increase when the elbow rotates right-handed about the direction to the wrist.

    Args:
        shoulder: position of the shoulder, shape (..., 3) [m], in a frame with x ahead and z up.
        elbow: position of the elbow, shape (..., 3) [m].
        wrist: position of the wrist, shape (..., 3) [m].
        convention: ``"stereographic"`` or ``"conventional"``.

    Returns:
        SEW angle, shape (...) [rad], in [-pi, pi]; nan where a point is nan, the arm is straight, or the reference
        direction is undefined.

    Raises:
        UnknownNameError: when the convention is not known.
        InputError: when a point does not have three coordinates.
    """
    return np.asarray(sew_derivatives(shoulder, elbow, wrist, convention=convention).angle, dtype=float)


def sew_derivatives(
    shoulder: ArrayLike, elbow: ArrayLike, wrist: ArrayLike, *, convention: str = "stereographic"
) -> SewAngle:
    """Return the SEW angle and its derivatives with respect to the three points; arguments as in :func:`sew_angle`."""
    formula = _formula(convention)
    points = [np.asarray(point, dtype=float) for point in (shoulder, elbow, wrist)]
    if any(point.shape[-1:] != (3,) for point in points):
        shapes = ", ".join(str(point.shape) for point in points)
        raise InputError(f"sew_angle: shoulder, elbow and wrist need 3 coordinates each, got shapes {shapes}")
    s, e, w = np.broadcast_arrays(*points)
    with np.errstate(divide="ignore", invalid="ignore"):
        found = formula(np, _components(e - s), _components(w - s))
    known = (found.bend > _LOST) & (found.reference > _LOST)
    by = [np.stack(gradient, axis=-1) for gradient in (found.shoulder, found.elbow, found.wrist)]
    return SewAngle(np.where(known, found.angle, math.nan), by[0], by[1], by[2], found.bend, found.reference)


def sew_jacobian(points: Array, jacobians: Array, *, convention: str = "stereographic") -> tuple[float, Array]:
    """Return the SEW angle of an arm in one posture, and the Jacobian of this angle.

    Args:
        points: positions of shoulder, elbow and wrist, shape (3, 3) [m], for example from ``ArmModel.sew_points``.
        jacobians: Jacobians of these points, shape (3, 3, n), for example from ``ArmModel.sew_jacobians``.
        convention: see :func:`sew_angle`.

    Returns:
        Angle [rad], and its Jacobian, shape (n,); both are nan if the angle is undefined.
    """
    shoulder, elbow, wrist = points.tolist()
    found = one_angle(shoulder, elbow, wrist, convention)
    if found is None:
        return math.nan, np.full(jacobians.shape[-1], math.nan)
    gradient = np.array(found.shoulder + found.elbow + found.wrist)
    return found.angle, gradient.dot(jacobians.reshape(9, -1))


def one_angle(
    shoulder: Sequence[float], elbow: Sequence[float], wrist: Sequence[float], convention: str = "stereographic"
) -> SewAngle | None:
    """Return the angle and derivatives of one arm as plain floats, which is many times faster than with arrays.

    Args:
        shoulder: three floats [m].
        elbow: three floats [m].
        wrist: three floats [m].
        convention: see :func:`sew_angle`.

    Returns: The angle and its derivatives; None if the angle is undefined.
    """
    (sx, sy, sz), (ex, ey, ez), (wx, wy, wz) = shoulder, elbow, wrist
    try:
        found = _formula(convention)(math, (ex - sx, ey - sy, ez - sz), (wx - sx, wy - sy, wz - sz))
    except ZeroDivisionError:
        return None
    return found if found.bend > _LOST and found.reference > _LOST else None


def _stereographic(m: Any, e: Vector, w: Vector) -> SewAngle:
    """Return the angle and its derivatives, with the products simplified for e_t = -x and e_r = z."""
    # written out without _dot and _cross, whose calls would take a third of the time
    (e0, e1, e2), (w0, w1, w2) = e, w
    length = m.sqrt(w0 * w0 + w1 * w1 + w2 * w2)
    x, y, z = w0 / length, w1 / length, w2 / length  # along: the direction to the wrist
    to_wrist = x * e0 + y * e1 + z * e2
    p0, p1, p2 = e0 - to_wrist * x, e1 - to_wrist * y, e2 - to_wrist * z
    p_squared = p0 * p0 + p1 * p1 + p2 * p2
    k0, k1 = y, -1.0 - x  # k_r = (along - e_t) x e_r, whose third component is 0
    c0, c1, c2 = k1 * z, -k0 * z, k0 * y - k1 * x  # k_x = k_r x along
    k_squared = c0 * c0 + c1 * c1 + c2 * c2
    size = m.sqrt(k_squared)
    x0, x1, x2 = c0 / size, c1 / size, c2 / size  # e_x
    y0, y1, y2 = y * x2 - z * x1, z * x0 - x * x2, x * x1 - y * x0  # e_y = along x e_x
    b0, b1, b2 = (y * p2 - z * p1) / p_squared, (z * p0 - x * p2) / p_squared, (x * p1 - y * p0) / p_squared
    # The reference turns because k_r follows the direction to the wrist, -P (e_r x (along x e_y)), where
    # along x e_y = -e_x, and because the wrist itself moves, e_y x k_r.
    t0, t1 = x1, -x0
    off = x * t0 + y * t1
    c = 1.0 / (size * length)
    n0 = c * (t0 - off * x - y2 * k1)
    n1 = c * (t1 - off * y + y2 * k0)
    n2 = c * (-off * z + y0 * k1 - y1 * k0)
    share = to_wrist / length
    by_wrist = -share * b0 - n0, -share * b1 - n1, -share * b2 - n2
    angle = (m.atan2 if m is math else m.arctan2)(y0 * e0 + y1 * e1 + y2 * e2, x0 * e0 + x1 * e1 + x2 * e2)
    return _found(angle, (b0, b1, b2), by_wrist, e, w, length, p_squared, k_squared)


def _conventional(m: Any, e: Vector, w: Vector) -> SewAngle:
    """Return the conventional angle, which is measured from a fixed direction, and its derivatives."""
    length = m.sqrt(_dot(w, w))
    along = _times(1.0 / length, w)
    to_wrist, to_up = _dot(along, e), _dot(along, UP)
    p, reference = _minus(e, _times(to_wrist, along)), _minus(UP, _times(to_up, along))
    p_squared, squared = _dot(p, p), _dot(reference, reference)
    y, x = _dot(along, _cross(reference, p)), _dot(reference, p)
    angle = m.atan2(y, x) if m is math else m.arctan2(y, x)
    by_elbow = _times(1.0 / p_squared, _cross(along, p))
    turn = _times(to_up / squared, _cross(along, reference))
    by_wrist = _times(1.0 / length, _minus(turn, _times(to_wrist, by_elbow)))
    return _found(angle, by_elbow, by_wrist, e, w, length, p_squared, squared)


def _found(
    angle: Any, by_elbow: Vector, by_wrist: Vector, e: Vector, w: Vector, length: Any, p_squared: Any, reference: Any
) -> SewAngle:
    f0, f1, f2 = w[0] - e[0], w[1] - e[1], w[2] - e[2]
    bend = p_squared * length * length / (_dot(e, e) * (f0 * f0 + f1 * f1 + f2 * f2))  # |e x f|^2 = |e x w|^2
    by_shoulder = -by_elbow[0] - by_wrist[0], -by_elbow[1] - by_wrist[1], -by_elbow[2] - by_wrist[2]
    return SewAngle(angle, by_shoulder, by_elbow, by_wrist, bend, reference)


CONVENTIONS: dict[str, Callable[[Any, Vector, Vector], SewAngle]] = {
    "conventional": _conventional,
    "stereographic": _stereographic,
}
"""Functions that compute the SEW angle, by the name of the convention."""


def _formula(convention: str) -> Callable[[Any, Vector, Vector], SewAngle]:
    if convention not in CONVENTIONS:
        raise UnknownNameError.among("convention of the SEW angle", convention, CONVENTIONS)
    return CONVENTIONS[convention]


def _components(vectors: Array) -> Vector:
    return vectors[..., 0], vectors[..., 1], vectors[..., 2]


def _dot(a: Vector, b: Vector) -> Any:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: Vector, b: Vector) -> Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def _minus(a: Vector, b: Vector) -> Vector:
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def _times(factor: Any, a: Vector) -> Vector:
    return factor * a[0], factor * a[1], factor * a[2]
