"""Measures that need only the joint positions of a robot: path, torques, limits, smoothness, singularity."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.errors import InputError
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.arm_kinematics import ROTATION_LENGTH

Array = NDArray[np.float64]

HIGHEST = 20.0  # [Hz] highest frequency that counts for smoothness
QUIET = 0.05  # smaller amplitudes, relative to the first, do not count
_PADDING = 4  # powers of two by which the spectrum is refined
_ROUNDING = 1e-6  # relative tolerance of velocity and acceleration limits: rounding of differences
_ROUNDED = 1e-9  # [rad] tolerance of a position limit


@dataclass(frozen=True, eq=False)
class ArmMotion:
    """A motion of an arm's joints, and quantities that are computed from it for each sample.

    Attributes:
        dt: sampling period [s].
        joints: joint positions, shape (n, n_joints) [rad].
        tool: positions of the tool in the base frame, shape (n, 3) [m].
        quaternions: rotations of the tool, wxyz, shape (n, 4).
        sew: shoulder, elbow and wrist, shape (n, 3, 3) [m]; nan for an arm without these landmarks.
        torques: torques required for the motion, from inverse dynamics, shape (n, n_joints) [N m].
        gravity: torques that hold the arm at rest against gravity, part of ``torques``, shape (n, n_joints) [N m].
        least_singular: smallest singular value of the tool's Jacobian, with 1 rad counted as 0.3 m, shape (n,) [m/rad].
    """

    dt: float
    joints: Array
    tool: Array
    quaternions: Array
    sew: Array
    torques: Array
    gravity: Array
    least_singular: Array

    @classmethod
    def of(cls, arm: ArmModel, times: ArrayLike, joints: ArrayLike) -> ArmMotion:
        """Compute all quantities from joint positions.

        Velocity and acceleration are central differences of the positions.

        Args:
            arm: arm that moves.
            times: at least 4 evenly spaced times, shape (n,) [s].
            joints: joint positions, shape (n, n_joints) [rad].

        Raises:
            InputError: when there are fewer than 4 samples, they are not evenly spaced, or a position is not finite.
        """
        t, q = np.asarray(times, dtype=float), np.asarray(joints, dtype=float)
        if len(t) < 4 or q.shape != (len(t), arm.n_joints):
            raise InputError(
                f"ArmMotion: needs at least 4 samples of {arm.n_joints} joints, got {t.shape} and {q.shape}"
            )
        dt = float(t[-1] - t[0]) / (len(t) - 1)
        if not np.allclose(np.diff(t), dt, rtol=1e-3, atol=1e-6) or not np.isfinite(q).all():
            raise InputError("ArmMotion: times must be evenly spaced and positions finite")
        velocity = np.gradient(q, dt, axis=0)
        acceleration = np.empty_like(q)
        acceleration[1:-1] = np.diff(q, 2, axis=0) / dt**2
        acceleration[0], acceleration[-1] = acceleration[1], acceleration[-2]
        n, marked, site = len(t), arm.landmarks is not None, arm.site("tool")
        tool, quaternions, sew = np.empty((n, 3)), np.empty((n, 4)), np.full((n, 3, 3), np.nan)
        jacobians = np.empty((n, 6, arm.n_joints))
        torques, gravity = np.full_like(q, np.nan), np.full_like(q, np.nan)  # unknown for an arm without masses
        for i, posture in enumerate(q):  # one posture at a time: its kinematics is computed once
            pose = arm.tool_pose(posture)
            tool[i], quaternions[i] = pose.position, pose.quaternion
            jacobians[i] = arm.at(posture).site_jacobian(site)
            if marked:
                sew[i] = arm.sew_points(posture)
            if arm.has_masses:
                torques[i] = arm.inverse_dynamics(posture, velocity[i], acceleration[i])
                gravity[i] = arm.gravity_torque(posture)
        jacobians[:, 3:] *= ROTATION_LENGTH
        least = np.asarray(np.linalg.svd(jacobians, compute_uv=False)[:, -1], dtype=float)
        return cls(dt, q, tool, quaternions, sew, torques, gravity, least)


@dataclass(frozen=True)
class Violations:
    """Number of frames in which a motion exceeds the limits of its arm, and the largest excess.

    Attributes:
        position: number of frames in which a joint is outside its range.
        velocity: number of frames in which a joint exceeds its velocity limit.
        acceleration: number of frames in which a joint exceeds its acceleration limit.
        position_excess: largest distance of a joint from its range [rad]; 0 when all joints are inside.
        velocity_ratio: largest velocity of a joint, divided by the joint's limit.
        acceleration_ratio: largest acceleration of a joint, divided by the joint's limit.
    """

    position: int
    velocity: int
    acceleration: int
    position_excess: float
    velocity_ratio: float
    acceleration_ratio: float


def violations(arm: ArmModel, joints: ArrayLike, dt: float) -> Violations:
    """Count the frames in which a motion that starts at rest exceeds a limit, from finite differences of the positions.

    Args:
        arm: the arm whose limits are checked.
        joints: joint positions, shape (n, n_joints) [rad].
        dt: sampling period [s].
    """
    q = np.asarray(joints, dtype=float)
    velocity = np.diff(q, axis=0) / dt
    acceleration = np.diff(velocity, axis=0, prepend=np.zeros((1, q.shape[1]))) / dt
    beyond = np.maximum(q - arm.upper, arm.lower - q).max(axis=1)
    fast = (np.abs(velocity) / arm.max_velocity).max(axis=1)
    sudden = (np.abs(acceleration) / arm.max_acceleration).max(axis=1)
    return Violations(
        int(np.sum(beyond > _ROUNDED)),
        int(np.sum(fast > 1.0 + _ROUNDING)),
        int(np.sum(sudden > 1.0 + _ROUNDING)),
        max(float(beyond.max()), 0.0),
        float(fast.max()),
        float(sudden.max()),
    )


def path_length(positions: ArrayLike) -> float:
    """Return the length of the polyline through positions (n, 3) [m]."""
    return float(np.linalg.norm(np.diff(np.asarray(positions, dtype=float), axis=0), axis=1).sum())


def jerk_rms(positions: ArrayLike, dt: float) -> float:
    """Return the RMS jerk of ``positions`` (n, d), from third differences divided by dt^3 [unit of positions / s^3]."""
    jerk = np.diff(np.asarray(positions, dtype=float), 3, axis=0) / dt**3
    return float(np.sqrt(np.mean(np.sum(jerk * jerk, axis=1))))


def spectral_arc_length(speed: ArrayLike, dt: float) -> float:
    r"""Return the smoothness of a motion from the arc length of its speed's spectrum; the closer to 0, the smoother.

    .. math:: -\int_0^{\omega_c} \sqrt{\left(\tfrac{1}{\omega_c}\right)^2
              + \left(\tfrac{d\hat V}{d\omega}\right)^2}\, d\omega, \qquad \hat V = |V(\omega)| / |V(0)|

    Here, V is the Fourier transform of the speed, and :math:`\omega_c` is the largest frequency up to 20 Hz at which
    :math:`\hat V` exceeds 0.05. The measure is called SPARC (Balasubramanian et al., Journal of NeuroEngineering and
    Rehabilitation, 2015). The value also depends on the number of movements in a recording, so compare only motions of
    the same recording.

    Args:
        speed: speed of a point, shape (n,) [m/s].
        dt: sampling period [s].

    Returns:
        A number without unit; nan for a point that does not move.
    """
    v = np.asarray(speed, dtype=float)
    n = 2 ** (int(np.ceil(np.log2(len(v)))) + _PADDING)
    spectrum = np.abs(np.fft.rfft(v, n))
    if not spectrum[0] > 0.0:
        return float("nan")
    frequency = np.fft.rfftfreq(n, dt)
    size = spectrum / spectrum[0]
    last = int(np.flatnonzero((frequency <= HIGHEST) & (size > QUIET))[-1])
    if last == 0:
        return float("nan")
    steps = np.diff(frequency[: last + 1]) / frequency[last]
    return -float(np.sum(np.hypot(steps, np.diff(size[: last + 1]))))


def log_dimensionless_jerk(positions: ArrayLike, dt: float) -> float:
    r"""Return the smoothness of a motion from its logarithmic dimensionless jerk; the closer to 0, the smoother.

    .. math:: -\ln \left( \frac{T^3}{v_{peak}^2} \int_0^T \lVert \dddot x \rVert^2 \, dt \right)

    Here, x is the position and :math:`v_{peak}` the largest speed. The value does not depend on the duration T or on
    the size of the motion. A minimum-jerk motion has -ln(204.8) = -5.32 (Balasubramanian et al., Journal of
    NeuroEngineering and Rehabilitation, 2015).

    Args:
        positions: shape (n, d), evenly spaced in time, n at least 4 [m].
        dt: sampling period [s].

    Returns:
        A number without unit; nan for a point that does not move.
    """
    x = np.asarray(positions, dtype=float)
    peak = float((np.linalg.norm(np.diff(x, axis=0), axis=1) / dt).max())
    if not peak > 0.0:
        return float("nan")
    jerk = np.diff(x, 3, axis=0) / dt**3
    total = float(np.mean(np.sum(jerk * jerk, axis=1))) * dt * (len(x) - 1)
    return -float(np.log((dt * (len(x) - 1)) ** 3 / peak**2 * total)) if total > 0.0 else float("nan")
