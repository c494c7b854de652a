"""evaluate_run: evaluate one retargeting run, and return measures, a one-line summary and warnings."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from imitarm.capture.motions import Truth
from imitarm.capture.skeleton import Skeleton
from imitarm.evaluation.mapping_metrics import MappingMetrics, measure
from imitarm.evaluation.tracking import TrueArm, rms, seen_arm, target_lag
from imitarm.kinematics.pose import quaternion_conjugate, quaternion_multiply
from imitarm.retarget import Correspondence, Retargeting
from imitarm.scene.clearance import SelfClearance

Array = NDArray[np.float64]

FAR = 0.05  # [m] a tool farther from its target has not reached it
FAR_FRACTION = 0.1  # of the time with a target, for which the tool may be that far: it lags where the hand is quickest
_LEAST_ENGAGED = 0.5  # fraction of the time for which the person must lead
_BRIEF = 0.05  # [s] shorter times would be printed as 0.0 s
_WOUND = math.radians(200.0)  # no hand rotates so far about the vertical
_FOLLOWS = 0.5  # of the hand's own motion (RMS); a tool with a larger error does not follow and has no lag


@dataclass(frozen=True)
class TargetTracking:
    """How closely the tool tracked the target that the retargeting method computed.

    The tool tracked the target if three conditions hold. The robot was engaged for at least half of the time. The RMS
    distance between tool and target was at most :data:`FAR`. The distance exceeded :data:`FAR` for at most the fraction
    :data:`FAR_FRACTION` of the time in which there was a target. FAR is 5 cm: at this distance from its target, a
    gripper is still at the object that it should grasp. The normal lag of the method ``modern`` is small enough for
    these conditions.

    Attributes:
        title: title of the method.
        rms: root mean square distance between tool and target [m]; nan when there was no target.
        far_fraction: ``far_time`` divided by the time in which there was a target, 0 to 1; nan without a target.
        far_time: time in which the tool was farther than :data:`FAR` from its target [s].
        farthest: largest distance between tool and target [m]; nan without a target.
        engagements: number of times that the robot began to follow the person.
        engaged_fraction: fraction of the whole time in which the robot was engaged (following, coasting, holding), 0 to
            1.
        violations: number of frames in which a joint exceeded a limit.
    """

    title: str
    rms: float
    far_fraction: float
    far_time: float
    farthest: float
    engagements: int
    engaged_fraction: float
    violations: int

    @classmethod
    def of(cls, run: Retargeting, metrics: MappingMetrics) -> TargetTracking:
        """Compute how closely the tool tracked its target in a run.

        Args:
            run: run of a retargeting method.
            metrics: metrics of this run.
        """
        away = np.linalg.norm(run.arm.tool_path(run.joints)[0] - run.targets[0], axis=1)
        away = away[np.isfinite(away)]
        far = away > FAR
        return cls(
            run.title or run.method,
            metrics.target_rms if len(away) else math.nan,
            float(far.mean()) if len(away) else math.nan,
            float(far.sum() * (run.times[1] - run.times[0])),
            float(away.max()) if len(away) else math.nan,
            metrics.engagements,
            metrics.engaged_fraction,
            metrics.limit_violations,
        )

    @property
    def near(self) -> bool:
        """Whether the distance between tool and target satisfied the conditions with FAR and FAR_FRACTION."""
        return self.rms <= FAR and self.far_fraction <= FAR_FRACTION

    @property
    def mostly_engaged(self) -> bool:
        """Whether the robot was engaged for at least half of the time."""
        return self.engaged_fraction >= _LEAST_ENGAGED

    @property
    def followed(self) -> bool:
        """Whether the tool tracked its target, by the three conditions in the description of this class."""
        return self.near and self.mostly_engaged

    @property
    def good(self) -> bool:
        """Whether the tool tracked its target and no joint exceeded a limit."""
        return self.followed and not self.violations

    def verdict(self) -> str:
        """Return one line: how well the tool followed its target, and whether a joint exceeded a limit."""
        limits = f"limits are exceeded in {self.violations} frames" if self.violations else "no joint exceeds a limit"
        if not np.isfinite(self.rms):
            return f"{self.title}: followed nothing; {limits}"
        word = "follows its target" if self.near else "does not follow its target"
        far = f"the distance exceeds {1e2 * FAR:.0f} cm for {_percent(self.far_fraction)} of the time"
        led = f"the person controlled the robot for {_percent(self.engaged_fraction)} of the time"
        mostly = "" if self.mostly_engaged else "nobody controlled the robot for most of the time: "
        return f"{self.title}: {mostly}{word} (RMS distance {1e3 * self.rms:.0f} mm; {far}); {led}; {limits}"


@dataclass(frozen=True, eq=False)
class RunEvaluation:
    """The result of :func:`evaluate_run`.

    Attributes:
        run: the evaluated run.
        metrics: measures of the run; some of them compare the robot with the person's arm.
        tracking: how closely the tool tracked the method's target.
        target_lag: lag of the tool behind the method's target [s]; nan when the tool does not follow the target.
        hand_lag: lag of the tool behind the hand [s]; nan when the tool does not follow the hand.
        link_distance: smallest distance between links that are not neighbours, measured between spheres that cover the
            links [m].
        truth_known: True: the measures compare the robot with the true hand. False: they compare the robot with the
            hand that the camera measured.
        warnings: remarks for the user about this run, one sentence each.
    """

    run: Retargeting
    metrics: MappingMetrics
    tracking: TargetTracking
    target_lag: float
    hand_lag: float
    link_distance: float
    truth_known: bool
    warnings: tuple[str, ...]


def evaluate_run(
    run: Retargeting,
    skeletons: Sequence[Skeleton],
    correspondence: Correspondence,
    truth: Truth | None = None,
) -> RunEvaluation:
    """Measure the quality of a retargeting run.

    Args:
        run: run of a retargeting method.
        skeletons: skeletons of the person, which were the input of the method.
        correspondence: arm, scale, orientation and sensor pose by which the method related the person to the robot.
        truth: true positions of the person over time; None: the camera's measurements are used instead.

    Raises:
        TaskFailedError: when the arm is never seen.
        InputError: when the run is too short to be measured.
    """
    times = run.times if run.shown_times is None else run.shown_times
    if truth is None:
        true = seen_arm(skeletons, times, correspondence)
    else:
        true = TrueArm.of(truth, times, correspondence, start=skeletons[0].time)
    metrics = measure(run, correspondence, true)
    tracking = TargetTracking.of(run, metrics)
    motion = correspondence.scale * rms(true.wrist - true.wrist.mean(axis=0))
    follows = metrics.tool_rms_without_lag < _FOLLOWS * motion
    links = SelfClearance(run.arm)
    apart = min(links.distance(q) for q in run.joints[::2])
    return RunEvaluation(
        run=run,
        metrics=metrics,
        tracking=tracking,
        target_lag=target_lag(run.times, run.arm.tool_path(run.joints)[0], run.targets[0]),
        hand_lag=metrics.lag if follows else math.nan,
        link_distance=apart,
        truth_known=truth is not None,
        warnings=tuple(warnings_of(run, metrics, tracking, apart)),
    )


def warnings_of(
    run: Retargeting, metrics: MappingMetrics, tracking: TargetTracking, link_distance: float = math.inf
) -> list[str]:
    """Return remarks for the user about a run, one sentence each.

    Args:
        run: run of a retargeting method.
        metrics: metrics of the run.
        tracking: how closely the tool tracked its target in the run.
        link_distance: smallest distance between links that are not neighbours [m].
    """
    dt = float(run.times[1] - run.times[0])
    lines = []
    if not metrics.engagements:
        lines.append("the robot never moved: the arm was not seen for half a second without a gap")
    stopped = int(np.sum(run.states == "stopped")) + _waiting_again(run.states)
    if stopped:
        lines.append(
            f"the robot stopped or waited for {stopped * dt:.1f} s during the motion, because the arm was not seen"
        )
    if tracking.far_time >= _BRIEF:
        lines.append(
            f"the tool was more than {1e2 * FAR:.0f} cm from its target for {tracking.far_time:.1f} s (at most "
            f"{1e2 * tracking.farthest:.0f} cm): the target was out of reach or too fast for the joints"
        )
    wound = winding(run)
    if wound > _WOUND:
        lines.append(
            f"the target of the tool rotated about the vertical by {np.degrees(wound):.0f} degrees in total, because "
            "the heading of a hand that points straight up or down is unknown; --orientation fixed keeps the "
            "tool's rotation"
        )
    exceeded = {
        "position": metrics.position_violations,
        "velocity": metrics.velocity_violations,
        "acceleration": metrics.acceleration_violations,
    }
    beyond = [f"{what} in {count} frames" for what, count in exceeded.items() if count]
    if beyond:
        lines.append(f"exceeds limits of {', '.join(beyond)}: a real arm can't execute this motion")
    if link_distance < 0.0:
        lines.append(
            "links of the arm come so close that they may touch each other: choose another start (--fit) or scale"
        )
    if run.closed.any():
        lines.append(
            "the person's hand closed during the motion; the demonstration does not contain this, because "
            "demonstrations have no gripper commands"
        )
    return lines


def winding(run: Retargeting) -> float:
    """Return the largest minus the smallest heading of the tool's target [rad]; above 2 pi after more than a turn."""
    rotations = run.targets[1]
    rotations = rotations[np.isfinite(rotations).all(axis=1)]
    if not len(rotations):
        return 0.0
    away = quaternion_multiply(rotations, quaternion_conjugate(rotations[0]))
    return float(np.ptp(np.unwrap(2.0 * np.arctan2(away[:, 3], away[:, 0]))))


def _waiting_again(states: NDArray[np.str_]) -> int:
    """Return the number of frames in which the robot waited or stopped after it had begun to follow."""
    followed = np.flatnonzero(states == "following")
    return int(np.sum(states[followed[0] :] == "waiting")) if len(followed) else 0


def _percent(fraction: float) -> str:
    """Return a fraction as a percentage; the text is 0 % or 100 % only if the fraction is exactly 0 or 1."""
    whole = round(100.0 * fraction)
    if 0.0 < fraction < 0.01:
        return "under 1 %"
    return "over 99 %" if whole == 100 and fraction < 1.0 else f"{whole} %"
