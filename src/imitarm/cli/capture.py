"""``imitarm capture``: read a person's motion from a source, and record, send or check it."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from imitarm.capture.checks import check, repaired
from imitarm.capture.filters import PersonFilter
from imitarm.capture.issue import RecordingIssue
from imitarm.capture.recording import SkeletonRecorder, SkeletonRecording
from imitarm.capture.skeleton import Skeleton, SkeletonSource
from imitarm.capture.sources import is_live, open_source
from imitarm.capture.stream import SkeletonSender
from imitarm.cli.outputs import check_outputs
from imitarm.cli.person import add_side_and_person, add_source, gather, show_issues
from imitarm.cli.screen import remark, say, show_table
from imitarm.errors import InputError, TaskFailedError
from imitarm.transmission.sockets import parse_address

EPILOG = """\
examples:
  imitarm capture kinect.csv --check
  imitarm capture wave.csv --trim 2.5 9 --repair --out wave_cut.csv
  imitarm capture synthetic:7 --out synthetic.csv
  imitarm capture synthetic:7 --send 127.0.0.1:7400

Each frame is written to FILE.part immediately, so that it can be read even if the program is killed.
Ctrl-C ends a live source and keeps the recorded frames.
The exit status is 2 when --check finds an error.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    add_source(parser)
    add_side_and_person(parser)
    parser.add_argument("--seconds", type=float, metavar="S", help="duration; default: to the end, or until Ctrl-C")
    parser.add_argument("--check", action="store_true", help="exit with status 2 when an issue is an error")
    parser.add_argument("--realtime", action="store_true", help="replay a recording at its original speed")
    output = parser.add_argument_group("output")
    output.add_argument("--out", type=Path, metavar="FILE", help="record into this file; default: none")
    output.add_argument("--force", action="store_true", help="replace an existing file")
    output.add_argument(
        "--send",
        metavar="HOST:PORT",
        help="send each skeleton by UDP at the original speed; the source 'udp:PORT' receives the skeletons",
    )
    output.add_argument(
        "--trim", type=float, nargs=2, metavar=("A", "B"), help="keep only the part from A to B seconds"
    )
    output.add_argument(
        "--repair",
        action="store_true",
        help="fix clear faults: several persons, wrong order, repeated frames, spikes, swapped left and right sides",
    )


def run(arguments: argparse.Namespace) -> int:
    """Capture, record and check a person's motion, and print a summary; with --check, return 2 if an issue is an error.

    Raises:
        InputError: when an option, the source or the output file is wrong.
        TaskFailedError: when the source never showed a person.
    """
    _check_options(arguments)
    going_on = is_live(arguments.source)
    with ExitStack() as stack:
        source = open_source(arguments.source, realtime=arguments.realtime or arguments.send is not None)
        recorded = source if isinstance(source, SkeletonRecording) else None
        source = stack.enter_context(_chosen(source, arguments.person))
        given: list[Callable[[Skeleton], object]] = []
        if arguments.send is not None:  # first, so that the receiver does not wait for the file
            sender = stack.enter_context(SkeletonSender(parse_address(arguments.send)))
            stack.callback(_tell_sent, sender, arguments.send)
            given.append(sender.send)
        if arguments.out is not None:
            recorder = SkeletonRecorder(arguments.out, source=source.name, replace=arguments.force)
            given.append(stack.enter_context(recorder).write)

        def give(skeleton: Skeleton) -> None:
            for one in given:
                one(skeleton)

        if going_on and arguments.seconds is None:
            remark("capturing; press Ctrl-C to end")
        total = recorded.duration if recorded is not None else None
        taken, _ = gather(source, arguments.seconds, "capturing", live=going_on, total=total, on_skeleton=give)
    if not taken:
        raise TaskFailedError(
            f"{arguments.source}: nobody was seen, so nothing is written; stand 1.5 to 3 m in front of the sensor"
        )
    captured = SkeletonRecording(taken, name=source.name) if recorded is None else recorded.with_skeletons(taken)
    recording = _finished(captured, arguments)
    issues = check(recording, arguments.side)
    _show(recording, arguments.side)
    show_issues(issues)
    if arguments.out is not None:
        say(f"wrote {arguments.out}")
    return 2 if arguments.check and _has_error(issues) else 0


def _tell_sent(sender: SkeletonSender, address: str) -> None:
    """Print how many skeletons were sent."""
    remark(f"sent {sender.sent} skeletons to {address}")
    if sender.failed:
        remark(f"sent {sender.failed} more skeletons to {address}, but no program received them")


def _check_options(arguments: argparse.Namespace) -> None:
    """Check the options that would otherwise cause a failure only after the capture."""
    if arguments.seconds is not None and not 0.0 < arguments.seconds < np.inf:
        raise InputError(f"--seconds must be above 0, got {arguments.seconds!r}")
    if arguments.trim is not None and not 0.0 <= arguments.trim[0] < arguments.trim[1] < np.inf:
        raise InputError(f"--trim must be two increasing times, got {arguments.trim}")
    check_outputs([("--out", arguments.out)], [("SOURCE", arguments.source)], force=arguments.force)


def _chosen(source: SkeletonSource, person: int | None) -> SkeletonSource:
    """Return the source, limited to one person if ``person`` is given; a recording must contain that person."""
    if person is None:
        return source
    if isinstance(source, SkeletonRecording):
        return source.person(person)
    return PersonFilter(source, person=person)


def _finished(recording: SkeletonRecording, arguments: argparse.Namespace) -> SkeletonRecording:
    """Return the recording, trimmed and repaired as requested; a changed recording is written to the output file."""
    done = recording
    if arguments.trim is not None:
        done = done.trim(*arguments.trim)
    if arguments.repair:
        done, notes = repaired(done)
        for note in notes:
            remark(f"repaired: {note}")
    if arguments.out is not None and done is not recording:
        done.save(arguments.out)
    return done


def _show(recording: SkeletonRecording, side: str) -> None:
    """Print a summary of the recording."""
    arms = [skeleton.arm(side).confidence[:3].min() for skeleton in recording.skeletons]
    persons = recording.persons
    numbers = ", ".join(map(str, persons))
    tracked, lost = np.mean(np.array(arms) >= 1.0), np.mean(np.array(arms) == 0.0)
    show_table(
        ["captured", recording.name],
        [
            ("frames", str(len(recording))),
            ("duration", f"{recording.duration:.2f} s"),
            ("rate", f"{recording.rate:.1f} frames per second"),
            ("persons", f"{len(persons)} ({'number' if len(persons) == 1 else 'numbers'} {numbers})"),
            (f"{side} arm", f"tracked in {100 * tracked:.0f} % of the frames, lost in {100 * lost:.0f} %"),
        ],
    )


def _has_error(issues: list[RecordingIssue]) -> bool:
    return any(issue.severity == "error" for issue in issues)
