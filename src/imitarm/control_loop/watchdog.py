"""Watchdog for the sensor: while no new scenes arrive, the arm slows down and then stops."""

from __future__ import annotations

import math
from dataclasses import replace

from imitarm.command import Command, Status
from imitarm.errors import InputError
from imitarm.validation import finite_number, flag, instance


class Watchdog:
    r"""Slows the arm down and stops it while the sensor is frozen or silent.

    The ``stamp`` of a scene is the time at which the scene was measured. Let a be the time that has passed since a
    scene with a new stamp last arrived. The watchdog multiplies the command by

    .. math:: f(a) = \min\Big(1,\; \max\Big(0,\; \frac{a_{stop} - a}{a_{stop} - a_{slow}}\Big)\Big) .

    The arm moves again when a scene with a later stamp arrives. As long as the stamp has never changed, the scene
    counts as static, and the watchdog does not stop the arm. If ``from_start`` is set, the watchdog also stops the arm
    in this case.

    Args:
        slow_after: a_slow, age of the newest scene at which the arm begins to slow down [s]. Choose at least twice the
            time between two scenes.
        stop_after: a_stop, age of the newest scene at which the arm has stopped [s].
        from_start: whether the arm also stops if no second scene arrives after the first one.

    Raises:
        InputError: when the times are not positive, or ``stop_after`` is not later than ``slow_after``.
    """

    def __init__(self, slow_after: float = 0.2, stop_after: float = 0.5, *, from_start: bool = False) -> None:
        self.slow_after = finite_number(slow_after, "Watchdog: slow_after", "s", above=0.0)
        self.stop_after = finite_number(stop_after, "Watchdog: stop_after", "s", above=0.0)
        if self.stop_after <= self.slow_after:
            raise InputError(f"Watchdog: needs slow_after < stop_after [s], got {slow_after!r} and {stop_after!r}")
        self.from_start = flag(from_start, "Watchdog: from_start")
        self.reset()

    def reset(self) -> None:
        """Forget all scenes."""
        self._newest, self._since, self._time = -math.inf, 0.0, -math.inf
        self._alive = self.from_start

    def guard(self, command: Command, stamp: float, time: float) -> Command:
        """Return the command, slowed down if no new scene has arrived for too long.

        Args:
            command: command of the policy.
            stamp: stamp of the latest scene [s].
            time: current time [s]; it must not decrease from one call to the next.

        Raises:
            InputError: when ``command`` is not a Command, or a time is not a finite number or decreases.
        """
        instance(command, Command, "Watchdog.guard: command")
        stamp = finite_number(stamp, "Watchdog.guard: stamp", "s")
        time = finite_number(time, "Watchdog.guard: time", "s")
        if time < self._time:
            raise InputError(
                f"Watchdog.guard: time {time:g} s is earlier than in the last call ({self._time:g} s); call reset() "
                "before a new run"
            )
        self._time = time
        if stamp > self._newest:
            self._alive |= self._newest > -math.inf
            self._newest, self._since = stamp, time
        age = time - self._since
        if not self._alive or age <= self.slow_after:
            return command
        factor = max(0.0, (self.stop_after - age) / (self.stop_after - self.slow_after))
        slowed = f"slowed down to {100.0 * factor:.0f} %" if factor else "stopped"
        velocity = command.joint_velocity
        return replace(
            command,
            twist=factor * command.twist,
            joint_velocity=None if velocity is None else factor * velocity,
            posture=command.posture if factor else None,
            elbow=command.elbow if factor else None,
            status=Status.BRAKING,
            reason=f"no new scene for {age:.2f} s: {slowed}",
        )
