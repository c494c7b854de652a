"""Say what is wrong with demonstrations before anything is learnt from them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from imitarm.demonstrations.arm_checks import check_arm
from imitarm.demonstrations.finding import SEVERITIES, Finding, Usable, found
from imitarm.demonstrations.motion_checks import MOTION_CHECKS
from imitarm.demonstrations.raw import RawDemonstration
from imitarm.demonstrations.raw_checks import RAW_CHECKS
from imitarm.demonstrations.set_checks import SET_CHECKS
from imitarm.errors import InputError
from imitarm.trajectory import Demonstration

if TYPE_CHECKING:
    from imitarm.kinematics.arm import ArmModel


def lint(demonstrations: Sequence[Demonstration | RawDemonstration], *, arm: ArmModel | None = None) -> list[Finding]:
    """Look for everything that spoils learning: in each demonstration, against the arm, and between them.

    Args:
        demonstrations: of one motion. Raw ones (``read_raw``) are looked at with all their faults; what has become a
            Demonstration has none of those that reading refuses.
        arm: the arm that was recorded, with its tool; None: joint limits and reach are not checked.

    Returns:
        Findings, errors first, then warnings, then notes; empty when all is well.

    Raises:
        InputError: when there are no demonstrations.
    """
    if not demonstrations:
        raise InputError("lint: no demonstrations; read some first")
    findings: list[Finding] = []
    motions: list[Usable] = []
    for one in demonstrations:
        raw = RawDemonstration.of(one) if isinstance(one, Demonstration) else one
        for raw_check in RAW_CHECKS:
            findings += raw_check(raw)
        try:
            motion = Usable.of(raw.with_poses(arm))
        except InputError as error:
            message = str(error).removeprefix(f"{raw.source}: ")
            findings.append(found(raw, "error", "no-positions", message, "name the arm that was recorded"))
            continue
        if motion is None:
            findings.append(found(raw, "error", "too-short", "fewer than 5 rows can be used", "record it again"))
            continue
        motions.append(motion)
        for motion_check in MOTION_CHECKS:
            findings += motion_check(motion)
        if arm is not None:
            findings += check_arm(motion, arm)
    if motions:
        for set_check in SET_CHECKS:
            findings += set_check(motions)
    return sorted(findings, key=lambda finding: SEVERITIES.index(finding.severity))
