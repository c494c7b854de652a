"""Whether a tool followed its target: the headline of ``imitarm retarget``, and what to do when it did not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from imitarm.capture.skeleton import SIDES, Skeleton
from imitarm.evaluation.mapping_metrics import MappingMetrics
from imitarm.retarget import Correspondence, Retargeting

FAR = 0.05  # [m] a tool farther from its target has not reached it
MOSTLY = 0.1  # of the time that it is led a tool may be that far off: it is late where the hand is quickest
_LED = 0.5  # of the whole time the person must have led, or it was mostly not followed at all
_MORE = 2.0  # an arm that goes this many times as far as the other is the one that shows something


@dataclass(frozen=True)
class Following:
    """How well a tool followed its own target.

    It followed when the person led it for at least half of the time, the distance was at most :data:`FAR` (RMS), and
    it was farther off for at most a tenth (:data:`MOSTLY`) of the time for which there was a target. The limits are a
    choice: within 5 cm a gripper is still at the thing that it is to grasp, and a tool that is only late by what
    ``modern`` is, at the speed that arms have, keeps both.

    Attributes:
        method: as people read it.
        rms: distance to the target [m]; nan when there was none.
        far_share: share of the time with a target in which it was farther than :data:`FAR`, 0 to 1; nan likewise.
        far_time: the same time [s].
        farthest: largest distance [m]; nan likewise.
        engagements: how often the person took hold.
        led_share: share of the whole time in which the person led the tool, 0 to 1.
        broken: frames in which a joint broke a limit.
    """

    method: str
    rms: float
    far_share: float
    far_time: float
    farthest: float
    engagements: int
    led_share: float
    broken: int

    @classmethod
    def of(cls, method: str, run: Retargeting, metrics: MappingMetrics) -> Following:
        """Return how a run followed.

        Args:
            method: as people read it.
            run: of the method.
            metrics: of the run.
        """
        away = np.linalg.norm(run.arm.tool_path(run.joints)[0] - run.targets[0], axis=1)
        away = away[np.isfinite(away)]
        far = away > FAR
        return cls(
            method,
            metrics.target_rms if len(away) else np.nan,
            float(far.mean()) if len(away) else np.nan,
            float(far.sum() * (run.times[1] - run.times[0])),
            float(away.max()) if len(away) else np.nan,
            metrics.engagements,
            metrics.led_share,
            metrics.broken_limits,
        )

    @property
    def near(self) -> bool:
        """Whether it was near its target while it had one."""
        return self.rms <= FAR and self.far_share <= MOSTLY

    @property
    def followed(self) -> bool:
        """Whether it followed; see the class."""
        return self.near and self.led_share >= _LED

    @property
    def good(self) -> bool:
        """Whether it followed and no joint broke a limit."""
        return self.followed and not self.broken

    def verdict(self) -> str:
        """Return it in one line: first whether it followed and how well, then the limits."""
        limits = "no joint breaks a limit" if not self.broken else f"limits are broken in {self.broken} frames"
        if not np.isfinite(self.rms):
            return f"{self.method}: followed nothing; {limits}"
        word = "does not follow its target" if not self.near else "follows its target"
        often = f"farther than {1e2 * FAR:.0f} cm for {_percent(self.far_share)} of the time"
        led = f"the person led for {_percent(self.led_share)}"
        mostly = "" if self.led_share >= _LED else "mostly led by nobody: "
        return f"{self.method}: {mostly}{word}, {1e3 * self.rms:.0f} mm from it (RMS), {often}; {led}; {limits}"


def _percent(share: float) -> str:
    """Return a share in words, never 0 % of what is something nor 100 % of what is not all."""
    whole = round(100.0 * share)
    if 0.0 < share < 0.01:
        return "under 1 %"
    return "over 99 %" if whole == 100 and share < 1.0 else f"{whole} %"


def remedy(
    following: Following, skeletons: Sequence[Skeleton], correspondence: Correspondence, *, fitted: bool, pace: float
) -> str:
    """Return what to try when a tool did not follow, likeliest first; empty when it did.

    Args:
        following: how it was.
        skeletons: of the person.
        correspondence: that the method was given.
        fitted: whether the start was chosen for the motion.
        pace: share of the person's own speed.
    """
    if following.followed:
        return ""
    if following.near:  # what it was led it did
        return "mostly nobody led the tool: keep the arm in view, cut the rest by --trim, or choose the arm by --side"
    tries, side = [], SIDES[1 - SIDES.index(correspondence.side)]
    mine, other = _goes(skeletons, correspondence.side), _goes(skeletons, side)
    if other > _MORE * mine:
        tries.append(
            f"--side {side} (that arm goes {1e2 * other:.0f} cm, the {correspondence.side} {1e2 * mine:.0f} cm)"
        )
    if correspondence.orientation != "fixed":
        tries.append("--orientation fixed (the tool need not turn)")
    if not fitted:
        tries.append("--fit (begins where all of the motion is in reach)")
    tries.append(f"--pace {0.5 * pace:.2g} (slower)")
    tries.append(f"--scale {0.5 * correspondence.scale:.2g} (smaller)")
    if mine / _MORE <= other <= _MORE * mine:
        tries.append(f"--side {side} (if the other arm is meant)")
    return "the tool did not follow its target: try " + ", ".join(tries)


def _goes(skeletons: Sequence[Skeleton], side: str) -> float:
    """Return how far a wrist goes from where it is on average, RMS [m]; 0 when it is never seen."""
    wrists = np.array([skeleton.arm(side).wrist - skeleton.arm(side).shoulder for skeleton in skeletons])
    seen = wrists[np.isfinite(wrists).all(axis=1)]
    return float(np.sqrt(np.mean(np.sum((seen - seen.mean(axis=0)) ** 2, axis=1)))) if len(seen) else 0.0
