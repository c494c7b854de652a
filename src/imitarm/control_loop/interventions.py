"""Records how the safety filter changed commands during a motion."""

from __future__ import annotations

from dataclasses import dataclass, field

from imitarm.safety import SafetyStep


@dataclass(frozen=True)
class Intervention:
    """Summary of the control steps in which the safety filter changed the command to keep the same two parts apart.

    Attributes:
        link: name of the part of the arm.
        other: name of the obstacle, or of another link.
        count: number of these steps.
        first: time of the first of these steps [s].
        last: time of the last of these steps [s].
        room: smallest value of distance minus required clearance in these steps [m]; negative if the required clearance
            was violated.
        unsafe: number of these steps in which no safe motion existed.
    """

    link: str
    other: str
    count: int
    first: float
    last: float
    room: float
    unsafe: int = 0


@dataclass
class InterventionLog:
    """Collects the interventions of a motion."""

    _found: dict[tuple[str, str], Intervention] = field(default_factory=dict)

    def take(self, time: float, step: SafetyStep) -> None:
        """Add one control step at ``time`` [s]."""
        cause = step.cause
        if cause is None:
            return
        known = self._found.get(cause[:2])
        before = known or Intervention(*cause[:2], 0, time, time, cause.room)
        self._found[cause[:2]] = Intervention(
            *cause[:2],
            before.count + 1,
            before.first,
            time,
            min(before.room, cause.room),
            before.unsafe + (not step.safe),
        )

    def result(self) -> tuple[Intervention, ...]:
        """Return the interventions, sorted by their number of steps, the largest first."""
        return tuple(sorted(self._found.values(), key=lambda found: -found.count))

    def sentence(self) -> str:
        """Return one sentence about what the filter did; empty if the filter did nothing."""
        found = self.result()
        if not found:
            return ""
        count, unsafe = sum(one.count for one in found), sum(one.unsafe for one in found)
        first, last = min(one.first for one in found), max(one.last for one in found)
        sentence = (
            f"the safety filter intervened in {count} steps, from {first:.2f} to {last:.2f} s, "
            f"mostly between {found[0].link} and {found[0].other}"
        )
        return f"{sentence}; no safe motion in {unsafe} of them" if unsafe else sentence
