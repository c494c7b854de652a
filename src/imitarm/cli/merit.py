"""How good a retargeting is: the figures that ``imitarm retarget`` prints and its report shows, and what to warn of."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from imitarm.capture.motions import Truth
from imitarm.capture.skeleton import Skeleton
from imitarm.cli.following import FAR, Following
from imitarm.evaluation.mapping_metrics import MappingMetrics, measure
from imitarm.evaluation.seen_arm import seen_arm, target_lag
from imitarm.evaluation.tracking import TrueArm, rms
from imitarm.kinematics.pose import quaternion_conjugate, quaternion_multiply
from imitarm.kinematics.self_clearance import SelfClearance
from imitarm.retarget import Correspondence, Retargeting
from imitarm.retarget.engagement import EngagementState
from imitarm.viewer.retarget_content import Measure, MethodResult, PlainTable

Array = NDArray[np.float64]

_BRIEF = 0.05  # [s] less would be told as 0.0 s
_WOUND = np.radians(200.0)  # no hand turns so far about the vertical
TITLES = {
    "modern": "modern",
    "thesis": "thesis",
    "m1": "M1, our reading",
    "m2": "M2, our reading",
    "m3": "M3, our reading",
}
CAPTIONS = {
    "modern": "What we would use on a robot: every limit kept, the elbow followed, losses of sight survived.",
    "thesis": "The thesis's Chapter 3, corrected: damped least squares towards a smooth curve.",
    "m1": "Our reading of demonstration modification: the person's joint angles, corrected where they do not do.",
    "m2": "Our reading of a discrete-time adaptive controller that follows the person's joint angles.",
    "m3": "Our reading of incremental inverse kinematics, without a treatment of singularities.",
}
TARGET_RMS = "tool to its own target, RMS"
TARGET_FAR = f"farther than {1e2 * FAR:.0f} cm from its own target"
TARGET_LAG = "lag behind its own target"
_FOLLOWS = 0.5  # share of the hand's own motion (RMS) within which a tool follows it
_DEGREES = 180.0 / np.pi


def judged(
    run: Retargeting,
    skeletons: Sequence[Skeleton],
    correspondence: Correspondence,
    truth: Truth | None = None,
) -> tuple[MethodResult, Following]:
    """Measure what a method made of a recording.

    Args:
        run: of the method.
        skeletons: of the person.
        correspondence: that the method was given.
        truth: where the person truly was, when that is known; None: what the camera saw stands for it.

    Returns:
        the result for the report, and how well the tool followed its target.
    """
    times = run.times if run.shown_times is None else run.shown_times
    if truth is None:
        true = seen_arm(skeletons, times, correspondence)
    else:
        true = TrueArm.of(truth, times, correspondence, start=skeletons[0].time)
    metrics = measure(run, correspondence, true)
    goes = correspondence.scale * rms(true.wrist - true.wrist.mean(axis=0))
    lags = metrics.tool_rms_without_lag < _FOLLOWS * goes
    title = TITLES.get(run.method, run.method)
    following = Following.of(title, run, metrics)
    result = MethodResult(
        name=run.method,
        title=title,
        run=run,
        measures=_measures(run, metrics, following, "hand as seen" if truth is None else "true hand", lags),
        tables=[_torques(run, metrics)],
        notes=warnings_of(run, metrics, following),
        caption=CAPTIONS.get(run.method, ""),
        clock=run.shown_times,
    )
    return result, following


def _measures(run: Retargeting, m: MappingMetrics, following: Following, hand: str, lags: bool) -> list[Measure]:
    """Return the figures of merit, in the units in which people think; what does not follow the hand has no lag."""
    tool = run.arm.tool_path(run.joints)[0]
    shares = [Measure(s, 100.0 * float(np.mean(run.states == s)), "% of the time", 1) for s in EngagementState]
    return [
        Measure("duration", m.duration, "s", 2),
        *shares,
        Measure("hold taken", m.engagements, "times", 0),
        Measure(TARGET_RMS, 1e3 * m.target_rms, "mm", 1, "less"),
        Measure(TARGET_FAR, 1e2 * following.far_share, "% of the time", 1, "less"),
        Measure(TARGET_LAG, 1e3 * target_lag(run.times, tool, run.targets[0]), "ms", 0, "less"),
        Measure(f"tool to the {hand}, RMS", 1e3 * m.tool_rms, "mm", 1, "less"),
        Measure("the same without its lag", 1e3 * m.tool_rms_without_lag, "mm", 1, "less"),
        Measure(f"lag behind the {hand}", 1e3 * m.lag if lags else np.nan, "ms", 0),
        Measure("upper arm's direction, RMS error", _DEGREES * m.elbow_direction_rms, "°", 1, "less"),
        Measure("beyond a limit of position", m.position_violations, "frames", 0, "less", fault=True),
        Measure("beyond a limit of velocity", m.velocity_violations, "frames", 0, "less", fault=True),
        Measure("beyond a limit of acceleration", m.acceleration_violations, "frames", 0, "less", fault=True),
        Measure("highest velocity", 100.0 * m.velocity_ratio, "% of the limit", 0, "less"),
        Measure("highest acceleration", 100.0 * m.acceleration_ratio, "% of the limit", 0, "less"),
        Measure("jerk of the joints, RMS", m.joint_jerk_rms, "rad/s³", 0, "less"),
        Measure("least singular value", m.least_singular, "m/rad", 3, "more"),
        Measure("links off each other, at least", 1e3 * _links_apart(run), "mm", 0, "more"),
        Measure("path of the tool", m.path_length, "m", 2),
        Measure("highest torque", 100.0 * m.peak_torque_ratio, "% of the rated", 0, "less"),
    ]


def _links_apart(run: Retargeting) -> float:
    """Return the least distance between links that are not neighbours [m], by the spheres that cover them."""
    links = SelfClearance(run.arm)
    return min(links.distance(q) for q in run.joints[::2])


def _torques(run: Retargeting, m: MappingMetrics) -> PlainTable:
    """Return the torques of each joint."""
    columns = (m.mean_torque, m.mean_gravity_torque, m.mean_motion_torque, m.rms_torque, run.arm.max_torque)
    rows = [
        (name, *(f"{value:.2f}" if np.isfinite(value) else "–" for value in values))
        for name, *values in zip(run.arm.joint_names, *columns, strict=True)
    ]
    return PlainTable(
        "Torques [N m]",
        ("Joint", "Mean", "holds the weight", "moves", "RMS", "Rated"),
        tuple(rows),
        "By inverse dynamics, without friction. Means are of absolute values, so the two parts need not add up.",
    )


def warnings_of(run: Retargeting, m: MappingMetrics, following: Following) -> list[str]:
    """Return what the user should know of a run, a sentence each."""
    dt = float(run.times[1] - run.times[0])
    lines = []
    if not m.engagements:
        lines.append("never took hold: the arm was not seen for half a second on end")
    stopped = int(np.sum(run.states == "stopped")) + _waiting_again(run.states)
    if stopped:
        lines.append(f"stopped or waited for {stopped * dt:.1f} s on the way, because the arm was not seen")
    if following.far_time >= _BRIEF:
        lines.append(
            f"the tool was more than {1e2 * FAR:.0f} cm from its target for {following.far_time:.1f} s (at most "
            f"{1e2 * following.farthest:.0f} cm): out of reach, or quicker than the joints may"
        )
    wound = winding(run)
    if wound > _WOUND:
        lines.append(
            f"the tool was to turn about the vertical by {np.degrees(wound):.0f} degrees in all: a hand that points "
            "straight up or down does not tell its turn; --orientation fixed keeps the tool's"
        )
    broken = {
        "position": m.position_violations,
        "velocity": m.velocity_violations,
        "acceleration": m.acceleration_violations,
    }
    beyond = [f"{what} in {count} frames" for what, count in broken.items() if count]
    if beyond:
        lines.append(f"breaks limits of {', '.join(beyond)}: no real arm would do this")
    if _links_apart(run) < 0.0:
        lines.append("links come so near each other that they may touch: choose another start (--fit) or scale")
    if run.closed.any():
        lines.append("the hand closed on the way; a demonstration holds no gripper, so that is not kept")
    return lines


def winding(run: Retargeting) -> float:
    """Return how far apart the farthest two headings of the tool's target are, full turns counted [rad]."""
    turns = run.targets[1]
    turns = turns[np.isfinite(turns).all(axis=1)]
    if not len(turns):
        return 0.0
    away = quaternion_multiply(turns, quaternion_conjugate(turns[0]))
    return float(np.ptp(np.unwrap(2.0 * np.arctan2(away[:, 3], away[:, 0]))))


def _waiting_again(states: NDArray[np.str_]) -> int:
    """Return in how many frames the robot waited after it had once followed."""
    led = np.flatnonzero(states == "following")
    return int(np.sum(states[led[0] :] == "waiting")) if len(led) else 0
