"""Questions that are asked until they are answered, and points that are touched until they are measured."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TypeVar

import numpy as np

from imitarm.capture.skeleton import JOINT, SkeletonSource, Tracking
from imitarm.cli.gathering import gather
from imitarm.cli.screen import remark
from imitarm.errors import InputError
from imitarm.retarget.sensor import LEAST_PAIRS

Word = TypeVar("Word", bound=str)

_STILL = 0.015  # [m] standard deviation of a hand that is held still, as a camera has it
_SEEN = 0.5  # share of the frames
_LEAST_FRAMES = 5


def ask(question: str) -> str:
    """Show a question and return the answer, in lower case.

    Raises:
        InputError: when nobody can answer, because input has ended.
    """
    remark(question)
    try:
        return input().strip().lower()
    except EOFError as error:
        raise InputError(
            "input ended before the question was answered; run it in a terminal, or give options"
        ) from error


def choose(question: str, choices: Mapping[Word, str]) -> Word:
    """Ask until one of the choices is named, by its number or by how it begins.

    Raises:
        InputError: when nobody can answer.
    """
    names = list(choices)
    for i, name in enumerate(names, start=1):
        question += f"\n  {i} {name}: {choices[name]}"
    while True:
        answer = ask(question)
        fitting = [n for i, n in enumerate(names, start=1) if answer and (n.startswith(answer) or answer == str(i))]
        if len(fitting) == 1:
            return fitting[0]
        question = f"{answer!r} is none of them; say {', '.join(names)}, or a number"


def touched_points(
    source: SkeletonSource,
    points: Sequence[Sequence[float]],
    side: str,
    seconds: float,
    *,
    only: int | None = None,
) -> dict[int, list[float]]:
    """Let the user put a hand on the robot's tool at one point after the other, and measure the hand there.

    A hand that moved or was not seen is measured again.

    Args:
        source: what sees the hand; live, or replayed in real time.
        points: in the robot's base frame, shape (n, 3) [m].
        side: of the hand.
        seconds: of each measurement.
        only: the one point to touch, from 0; None: all.

    Returns:
        for each point that was not skipped, from 0, the hand in the sensor's frame (3,) [m].

    Raises:
        InputError: when the user gives up, the source is over, or fewer than four points are left.
    """
    wanted = range(len(points)) if only is None else [only]
    if only is None:
        if len(points) < LEAST_PAIRS:
            raise InputError(f"sensor calibration: {len(points)} points, at least {LEAST_PAIRS} are needed; add more")
        remark(f"{len(points)} points. At each: bring the robot's tool there, put the palm of your {side} hand on its")
        remark("tip so that the sensor sees the hand, hold still, press Enter. 's' skips a point, 'q' gives up.")
    seen: dict[int, list[float]] = {}
    for i in wanted:
        place = " ".join(f"{100 * value:.1f}" for value in points[i])
        while True:
            answer = ask(f"Point {i + 1} of {len(points)}: tool at {place} cm, hand on it, Enter")
            if answer == "q":
                raise InputError("sensor calibration: given up; nothing was written")
            if answer == "s":
                break
            hand, fault = _measured(source, side, seconds)
            if hand is not None:
                seen[i] = hand
                break
            if source.over:
                raise InputError(f"sensor calibration: {source.name} is over at point {i + 1}; use a live source")
            remark(f"{fault}. Once more:")
    if only is None and len(seen) < LEAST_PAIRS:
        raise InputError(f"sensor calibration: {len(seen)} points were measured, at least {LEAST_PAIRS} are needed")
    return seen


def _measured(source: SkeletonSource, side: str, seconds: float) -> tuple[list[float] | None, str]:
    """Return where the hand is held (3,) [m], or None and why that is not known."""
    while source.read(0.0) is not None:  # what was seen before Enter
        pass
    taken, _ = gather(source, seconds, "measuring", live=True)
    index = JOINT[f"hand_{side}"]
    hands = np.array([s.positions[index] for s in taken if s.tracking[index] == Tracking.TRACKED])
    if len(hands) < max(_LEAST_FRAMES, _SEEN * len(taken)):
        return None, f"the {side} hand was seen in {len(hands)} of {len(taken)} frames; turn it to the sensor"
    spread = float(np.sqrt(np.var(hands, axis=0).max()))
    if spread > _STILL:
        return None, f"the hand moved by {100 * spread:.1f} cm; hold it still"
    return [float(x) for x in np.median(hands, axis=0)], ""
