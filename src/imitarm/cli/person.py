"""A person for a robot to follow, taken from a source: one person, in order, left and right kept apart."""

from __future__ import annotations

import argparse

from imitarm.capture.checks import check, repaired
from imitarm.capture.motions import Truth
from imitarm.capture.recording import SkeletonRecording, slowed
from imitarm.capture.skeleton import Skeleton, SkeletonSource
from imitarm.capture.sources import followed, live, open_source
from imitarm.capture.synthetic import SyntheticSource
from imitarm.cli.gathering import gather
from imitarm.cli.screen import remark
from imitarm.errors import InputError, TaskFailedError


def person_of(arguments: argparse.Namespace, side: str) -> tuple[list[Skeleton], list[str], Truth | None]:
    """Take the person whom ``source``, ``person``, ``seconds``, ``trim`` and ``pace`` of the arguments name.

    A recording is repaired first; whoever is seen elsewhere under the same number is passed over. What was done and
    what is wrong is printed.

    Args:
        arguments: of the command.
        side: of the arm that is followed.

    Returns:
        the skeletons; what was done to them and is wrong with them, a sentence each; and where the person truly was,
        when the source is a made-up one.

    Raises:
        InputError: when the source or an option is wrong.
        TaskFailedError: when fewer than two skeletons came.
    """
    going_on = live(arguments.source)
    if going_on and (arguments.trim is not None or arguments.pace != 1.0):
        raise InputError("--trim, --pace: what is live can't be cut or slowed; record it by 'imitarm capture' first")
    source = open_source(arguments.source)
    truth = source.truth if isinstance(source, SyntheticSource) else None
    notes: list[str] = []
    if isinstance(source, SkeletonRecording):
        source, notes = _mended(source, arguments.person)
    if going_on and arguments.seconds is None:
        remark("capturing; press Ctrl-C to end")
    with followed(source, person=arguments.person) as one:
        taken, _ = gather(one, arguments.seconds, "capturing", live=going_on, total=_duration(source))
    if one.passed_over:
        notes.append(f"passed over {one.passed_over} frames that show somebody else")
    unit = source.time_unit if isinstance(source, SkeletonRecording) else 1.0
    recording = SkeletonRecording(taken, name=source.name, time_unit=unit)
    if arguments.trim is not None:
        recording = recording.trim(*arguments.trim)
    if len(recording) < 2:
        raise TaskFailedError(
            f"{arguments.source}: {len(recording)} frames show a person, at least 2 are needed; stand 1.5 to 3 m "
            "before the sensor"
        )
    notes += [str(finding) for finding in check(recording, side)]
    begin, pace = recording.skeletons[0].time, arguments.pace
    if pace != 1.0:
        notes.append(f"slowed to {100 * pace:g} % of its pace")
    for line in notes:
        remark(line)
    return slowed(recording.skeletons, pace), notes, None if truth is None else _slow(truth, begin, pace)


def _slow(truth: Truth, begin: float, pace: float) -> Truth:
    """Return a motion that is slowed from a moment on."""
    return lambda time: truth(begin + pace * (time - begin))


def _mended(recording: SkeletonRecording, person: int | None) -> tuple[SkeletonRecording, list[str]]:
    """Return a recording of one person, mended; a note says what was."""
    one = recording if person is None else recording.person(person)
    mended, notes = repaired(one)
    return mended, [*(f"repaired: {note}" for note in notes), *(str(finding) for finding in recording.issues)]


def _duration(source: SkeletonSource) -> float | None:
    return source.duration if isinstance(source, SkeletonRecording) else None
