"""For commands that read a person's motion: add the arguments, read the motion, and print issues."""

from __future__ import annotations

import argparse
import time as clock
from collections.abc import Callable, Sequence

from imitarm.capture.checks import check, repaired
from imitarm.capture.issue import SEVERITIES, RecordingIssue
from imitarm.capture.motions import Truth
from imitarm.capture.recording import SkeletonRecording, slowed
from imitarm.capture.skeleton import SIDES, Skeleton, SkeletonSource
from imitarm.capture.sources import followed, is_live, open_source, source_words
from imitarm.capture.synthetic import SyntheticSource
from imitarm.cli.screen import progress_bar, remark, say, show_table
from imitarm.errors import InputError, TaskFailedError

_COLOURS = {"error": "red", "warning": "yellow", "note": ""}
_WAIT = 0.2  # [s] for one read of a silent source

# --- arguments


class _SourceArgument(argparse.Action):
    """Stores the name of a source.

    The help text lists all sources; their modules are imported only when it is shown.
    """

    @property
    def help(self) -> str | None:
        """Text for ``--help``."""
        listed = "; ".join(f"{word}: {what}" for word, what in source_words().items())
        return f"{self._before}{listed}".replace("%", "%%")

    @help.setter
    def help(self, before: str | None) -> None:
        self._before = before or ""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: object,
        option_string: str | None = None,
    ) -> None:
        setattr(namespace, self.dest, values)


def add_source(parser: argparse.ArgumentParser, name: str = "source", purpose: str = "") -> None:
    """Add the argument that names a source of skeletons.

    Args:
        parser: parser of the command.
        name: ``"source"``, or ``"--source"`` for an option.
        purpose: what the command uses the source for; the help text of the argument begins with this text.
    """
    parser.add_argument(name, metavar="SOURCE", action=_SourceArgument, help=purpose)


def add_side_and_person(parser: argparse.ArgumentParser) -> None:
    """Add the options that choose an arm and a person."""
    parser.add_argument("--side", choices=SIDES, default="right", help="arm of the person; default: right")
    parser.add_argument(
        "--person",
        type=int,
        metavar="N",
        help="number of the person, if there are several; default: the first one seen",
    )


# --- reading


def gather(
    source: SkeletonSource,
    seconds: float | None,
    what: str,
    *,
    live: bool,
    total: float | None = None,
    on_skeleton: Callable[[Skeleton], None] | None = None,
) -> tuple[list[Skeleton], bool]:
    """Read skeletons until the source ends, the duration has passed, or the user stops the reading; show the progress.

    Args:
        source: source of the skeletons.
        seconds: duration [s]. A clock measures the duration of a live source; otherwise, the times of the skeletons are
            used. None: until the source ends.
        what: text of the progress bar, for example ``"capturing"``.
        live: whether the source runs until it is stopped.
        total: expected duration of the source [s], for the progress bar; None: unknown. If ``seconds`` is given,
            ``total`` is not used.
        on_skeleton: function called with each skeleton.

    Returns:
        The skeletons, and whether the user stopped the reading.
    """
    taken: list[Skeleton] = []
    began = clock.monotonic()
    expected = total if seconds is None else seconds
    stopped = False
    progress = progress_bar()
    progress.disable = not progress.console.is_terminal
    with progress:
        task = progress.add_task(what, total=expected)
        try:
            while not source.over:
                skeleton = source.read(_WAIT)
                done = clock.monotonic() - began
                if skeleton is not None:
                    if not live:
                        done = skeleton.time - (taken[0].time if taken else skeleton.time)
                    if seconds is None or done <= seconds:
                        taken.append(skeleton)
                        if on_skeleton is not None:
                            on_skeleton(skeleton)
                if seconds is not None and done > seconds:
                    break
                waiting = live and not taken
                progress.update(
                    task,
                    completed=done if expected is not None else None,
                    description=f"{what}: waiting for a person" if waiting else f"{what}: {len(taken)} frames",
                )
        except KeyboardInterrupt:
            stopped = True
            remark(f"stopped; {len(taken)} frames are kept")
    return taken, stopped


def person_of(arguments: argparse.Namespace, side: str) -> tuple[list[Skeleton], list[str], Truth | None]:
    """Read the person from the source, according to the options ``person``, ``seconds``, ``trim`` and ``pace``.

    If the source is a recording, the function first repairs it. The function prints the repairs and the issues.

    Args:
        arguments: arguments of the command.
        side: which of the person's arms the robot follows, ``"left"`` or ``"right"``.

    Returns:
        The skeletons, then one sentence for each repair and each issue, then the person's true motion (None if the
        source is not synthetic).

    Raises:
        InputError: when the source or an option is wrong.
        TaskFailedError: when fewer than two skeletons arrived.
    """
    if is_live(arguments.source) and (arguments.trim is not None or arguments.pace != 1.0):
        raise InputError("--trim, --pace: a live source can't be cut or slowed; record it with 'imitarm capture' first")
    source = open_source(arguments.source)
    truth = source.truth if isinstance(source, SyntheticSource) else None
    notes: list[str] = []
    if isinstance(source, SkeletonRecording):
        source, notes = _repaired_person(source, arguments.person)
    if source.live and arguments.seconds is None:
        remark("capturing; press Ctrl-C to end")
    with followed(source, person=arguments.person) as one:
        taken, _ = gather(one, arguments.seconds, "capturing", live=one.live, total=_duration(source))
    if one.passed_over:
        notes.append(f"ignored {one.passed_over} frames that show another person")
    unit = source.time_unit if isinstance(source, SkeletonRecording) else 1.0
    recording = SkeletonRecording(taken, name=source.name, time_unit=unit)
    if arguments.trim is not None:
        recording = recording.trim(*arguments.trim)
    if len(recording) < 2:
        raise TaskFailedError(
            f"{arguments.source}: {len(recording)} frames show a person, but at least 2 are needed; stand 1.5 to 3 m "
            "in front of the sensor"
        )
    notes += [str(issue) for issue in check(recording, side)]
    begin, pace = recording.skeletons[0].time, arguments.pace
    if pace != 1.0:
        notes.append(f"slowed the recording to {100 * pace:g} % of its speed")
    for line in notes:
        remark(line)
    return slowed(recording.skeletons, pace), notes, None if truth is None else _slow(truth, begin, pace)


def _slow(truth: Truth, begin: float, pace: float) -> Truth:
    """Return the true motion, slowed down by the factor ``pace`` from the time ``begin`` [s] on."""
    return lambda time: truth(begin + pace * (time - begin))


def _repaired_person(recording: SkeletonRecording, person: int | None) -> tuple[SkeletonRecording, list[str]]:
    """Return a repaired recording of one person, and sentences about the repairs and the issues found while reading."""
    one = recording if person is None else recording.person(person)
    fixed, notes = repaired(one)
    return fixed, [*(f"repaired: {note}" for note in notes), *(str(issue) for issue in recording.issues)]


def _duration(source: SkeletonSource) -> float | None:
    return source.duration if isinstance(source, SkeletonRecording) else None


# --- showing


def show_issues(issues: Sequence[RecordingIssue]) -> None:
    """Print the issues as a table, and the number of issues of each severity."""
    if issues:
        show_table(
            ["", "place", "code", "issue", "remedy"],
            [(i.severity, i.place, i.code, i.message, i.remedy) for i in issues],
            styles=[_COLOURS[i.severity] for i in issues],
        )
    counts = [(sum(issue.severity == severity for issue in issues), severity) for severity in SEVERITIES]
    say(", ".join(f"{n} {what}{'' if n == 1 else 's'}" for n, what in counts))
