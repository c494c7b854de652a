"""open_source: from a word, as one types it, to where skeletons come from."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from pathlib import Path
from typing import cast

from imitarm.capture.filters import PersonFilter, SwapGuard
from imitarm.capture.recording import read_recording
from imitarm.capture.skeleton import SkeletonSource
from imitarm.errors import InputError, UnknownNameError
from imitarm.files.part_file import PART

WORDS = {
    "FILE": "a recording: imitarm's own, a table of the Kinect SDK, or motion capture",
    "synthetic:SEED": "a made-up person before a made-up camera",
    "udp:PORT": "what 'imitarm capture --send' sends; udp:ADDRESS:PORT hears other machines too",
    "video:FILE": "the person in a video, by MediaPipe",
    "webcam:NUMBER": "the person before a webcam, by MediaPipe; 0 is the first",
    "kinect2": "a Kinect v2",
    "azure": "an Azure Kinect",
}
"""What a source may be called."""


def open_source(word: str | Path, *, realtime: bool = False) -> SkeletonSource:
    """Return the source of skeletons that a word names.

    Args:
        word: one of :data:`WORDS`; a file of that name comes first.
        realtime: give what is not live at the pace at which it happened; else as fast as it is asked for.

    Raises:
        UnknownNameError: when there is neither such a file nor such a source.
        InputError: when what stands behind the colon is wrong, a recording can't be read, or a device or a program
            that the source needs is not there; the message says what to do.
    """
    text = str(word)
    kind, colon, rest = text.partition(":")
    if Path(text).exists():
        return read_recording(text, realtime=realtime)
    if kind in _OPENERS:
        if kind in _WANTS and not rest:
            raise InputError(f"source {text!r}: {_WANTS[kind]} is missing; say {kind}: and then {_WANTS[kind]}")
        if kind not in _WANTS and colon:
            raise InputError(f"source {text!r}: takes nothing after a colon; say {kind}")
        return _OPENERS[kind](rest, realtime)
    path = Path(text)
    if (colon and len(kind) > 1) or not (path.suffix or path.parent != Path() or Path(text + PART).exists()):
        raise UnknownNameError.among("source", text, WORDS)
    return read_recording(text, realtime=realtime)  # which says that it is not there, and perhaps what is


def live(word: str) -> bool:
    """Whether a source goes on until it is stopped."""
    return word.partition(":")[0] in {"webcam", "udp", "kinect2", "azure"} and not Path(word).exists()


def followed(source: SkeletonSource, *, person: int | None = None) -> PersonFilter:
    """Return one person of a source with left and right kept apart: what a retargeter should be given.

    Args:
        source: as opened.
        person: who, as the source counts them; None: the first who is seen.
    """
    return PersonFilter(SwapGuard(source), person=person)


def _number(kind: str, text: str, largest: int) -> int:
    if not text.isdecimal() or int(text) > largest:
        raise InputError(f"source {kind}:{text}: {_WANTS[kind]} must be a whole number from 0 to {largest}")
    return int(text)


def _made(module: str, name: str, *values: object, **options: object) -> SkeletonSource:
    """Make a source whose module is imported only now: it may need a driver, or much time."""
    home = importlib.import_module(f"imitarm.capture.{module}")
    return cast(SkeletonSource, getattr(home, name)(*values, **options))


def _synthetic(rest: str, realtime: bool) -> SkeletonSource:
    from imitarm.capture.synthetic import SyntheticSource  # noqa: PLC0415

    return SyntheticSource.from_seed(_number("synthetic", rest, 2**31 - 1), realtime=realtime)


def _video(rest: str, realtime: bool) -> SkeletonSource:
    if not Path(rest).is_file():
        raise InputError(f"source video:{rest}: there is no such file; check the path")
    return _made("mediapipe", "MediaPipeSource", rest, realtime=realtime)


def _udp(rest: str, realtime: bool) -> SkeletonSource:
    host, colon, port = rest.rpartition(":")
    number = _number("udp", port, 65535)
    return _made("stream", "UdpSource", number, host) if colon else _made("stream", "UdpSource", number)


_OPENERS: dict[str, Callable[[str, bool], SkeletonSource]] = {
    "synthetic": _synthetic,
    "video": _video,
    "webcam": lambda rest, _: _made("mediapipe", "MediaPipeSource", _number("webcam", rest, 63)),
    "udp": _udp,
    "kinect2": lambda rest, _: _made("kinect", "KinectV2Source"),
    "azure": lambda rest, _: _made("kinect", "AzureKinectSource"),
}
_WANTS = {"synthetic": "the seed", "video": "the file", "webcam": "the camera's number", "udp": "the port"}
