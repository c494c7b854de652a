"""From a word to a source: built-in ones, and those that other packages add."""

from __future__ import annotations

import sys

import pytest

from imitarm import SOURCES, SkeletonSource, cli
from imitarm.capture import filters, kinect, mediapipe, stream
from imitarm.capture.filters import PersonFilter, SideFilter
from imitarm.capture.recording import SkeletonRecording, read_recording
from imitarm.capture.sources import find_source, followed, is_live, open_source, source_words
from imitarm.capture.synthetic import SyntheticSource
from imitarm.errors import InputError, UnknownNameError
from imitarm.registry import Registry
from recording_samples import Listed, exchanged, same, skeletons
from test_registry import install


def test_a_file_and_a_synthetic_person(tmp_path, monkeypatch):
    SkeletonRecording(skeletons(3)).save(tmp_path / "a.csv")
    assert len(list(open_source(tmp_path / "a.csv"))) == 3
    assert len(list(open_source(f"file:{tmp_path / 'a.csv'}"))) == 3
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a.csv").rename("udp:7")  # a file of that name comes first
    assert len(list(open_source("udp:7"))) == 3 and not is_live("udp:7")
    source = open_source("synthetic:5")
    assert isinstance(source, SyntheticSource) and source.name == "synthetic:5"
    assert same(source.read(), SyntheticSource.from_seed(5).read())


@pytest.mark.parametrize(
    ("word", "family", "given"),
    [
        ("webcam:2", mediapipe.WebcamSource, (2,)),
        ("video:{}", mediapipe.VideoSource, ("{}",)),
        ("udp:7400", stream.UdpSource, (7400,)),
        ("udp:0.0.0.0:7400", stream.UdpSource, (7400, "0.0.0.0")),
        ("kinect2", kinect.KinectV2Source, ()),
        ("azure", kinect.AzureKinectSource, ()),
    ],
)
def test_a_word_leads_to_its_source_with_what_stands_after_the_colon(word, family, given, tmp_path, monkeypatch):
    film = tmp_path / "film.mp4"
    film.write_bytes(b"x")
    seen = []
    monkeypatch.setattr(family, "__init__", lambda self, *values, **_: seen.append(values))
    assert isinstance(open_source(word.format(film)), family)
    assert seen == [tuple(str(film) if g == "{}" else g for g in given)]
    assert is_live(word) == (not word.startswith("video"))


@pytest.mark.parametrize(
    ("word", "error", "message"),
    [
        (
            "kinect3",
            UnknownNameError,
            "unknown source 'kinect3'; known: FILE, azure, kinect2, synthetic:SEED, udp:PORT",
        ),
        ("camera:0", UnknownNameError, "unknown source 'camera:0'"),
        ("synthetic", InputError, "SEED is missing; write synthetic:SEED"),
        ("file", InputError, "FILE is missing"),
        ("udp:", InputError, "PORT is missing"),
        ("udp:65536", InputError, "PORT must be a whole number from 0 to 65535"),
        ("udp:localhost:x", InputError, "PORT must be a whole number"),
        ("webcam:front", InputError, "source webcam:front: NUMBER must be a whole number from 0 to 63"),
        ("synthetic:-1", InputError, "SEED must be"),
        ("azure:1", InputError, "takes nothing after a colon; write azure"),
        ("video:nowhere.mp4", InputError, "no such file"),
        ("nowhere.csv", InputError, r"nowhere\.csv: can't be read"),
    ],
)
def test_a_word_that_is_wrong_says_what_to_do(word, error, message):
    with pytest.raises(error, match=message):
        open_source(word)


def test_every_source_is_described_and_says_whether_it_is_live():
    words = source_words()
    assert len(words) == len(SOURCES) and all(words.values())
    live = {name for name in SOURCES if SOURCES[name].live}
    assert live >= {"udp", "webcam", "kinect2", "azure"} and not live & {"file", "synthetic", "video"}


def test_filters_are_as_live_as_what_they_filter():
    source = Listed([])
    assert not PersonFilter(SideFilter(source)).live
    source.live = True
    assert PersonFilter(SideFilter(source)).live


def test_a_source_in_real_time_gives_nothing_early(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(filters.clock, "monotonic", lambda: now[0])
    monkeypatch.setattr(filters.clock, "sleep", lambda seconds: now.__setitem__(0, now[0] + seconds))
    frames = skeletons(31, start=7.0)
    source = filters.RealtimeSource(Listed(frames))
    assert source.read() is frames[0] and now[0] == pytest.approx(100.0)
    assert source.read(0.01) is None and now[0] == pytest.approx(100.01) and not source.over
    assert [source.read() for _ in range(30)] == frames[1:] and now[0] == pytest.approx(101.0)
    assert source.over and source.read() is None


def test_a_retargeter_is_given_one_person_with_the_sides_right():
    frames = skeletons(20, person=1)
    wrong = [exchanged(s) if i == 9 else s for i, s in enumerate(frames)]
    source = followed(Listed([s for pair in zip(wrong, skeletons(20, person=2), strict=True) for s in pair]))
    assert isinstance(source, PersonFilter)
    assert all(map(same, source, frames))
    assert {s.person for s in followed(Listed(skeletons(3) + skeletons(3, person=2)), person=2)} == {2}


# --- sources of other packages

THEIRS = '''\
import numpy as np

from imitarm import Skeleton, SkeletonSource
from imitarm.capture.motions import reaching
from imitarm.capture.person import Person


class MarionetteSource(SkeletonSource):
    """A person on strings."""

    argument, description = "FRAMES", "a marionette, 100 % wood"

    def __init__(self, frames):
        self.name, self.left = f"marionette:{frames}", int(frames)
        self.truth, self.time = reaching(Person.from_seed(4), 4), 0.0

    @property
    def over(self):
        return self.left == 0

    def read(self, timeout=1.0):
        self.left, self.time = self.left - 1, self.time + 1.0 / 30.0
        return self.truth(self.time)
'''


@pytest.fixture
def theirs(tmp_path, monkeypatch):
    """An installed package with a source of its own, one that can't be imported, and one that is no source."""
    folder = tmp_path / "site"
    folder.mkdir()
    (folder / "their_sources.py").write_text(THEIRS, encoding="utf-8")
    marionette = "their_sources:MarionetteSource"
    install(folder, "imitarm.sources", marionette=marionette, broken="no_such_module:X", person="imitarm:Skeleton")
    monkeypatch.syspath_prepend(str(folder))
    monkeypatch.setattr(SOURCES, "_found", None)  # as in a process that starts now
    yield
    sys.modules.pop("their_sources", None)
    SOURCES._loaded.pop("marionette", None)
    SOURCES._loaded.pop("person", None)


@pytest.mark.usefixtures("theirs")
def test_a_source_of_another_package_is_captured_from_retargeted_and_listed(tmp_path, capsys):
    out = tmp_path / "captured.csv"
    assert cli.main(["capture", "marionette:90", "--check", "--out", str(out)]) == 0
    assert len(read_recording(out)) == 90 and "# source: marionette:90" in out.read_text(encoding="utf-8")
    arguments = ["retarget", "marionette:60", "--orientation", "fixed", "--out", str(tmp_path / "shown.csv")]
    assert cli.main(arguments) == 0 and (tmp_path / "shown.csv").exists()
    record = ["--record", str(tmp_path / "led.csv")]
    assert cli.main(["teleoperate", "marionette:60", "--seconds", "1.8", "--orientation", "fixed", *record]) == 0
    capsys.readouterr()
    for command in (["capture"], ["retarget"], ["teleoperate"], ["calibrate", "limbs"], ["calibrate", "sensor"]):
        assert cli.main([*command, "--help"]) == 0
        shown = " ".join(capsys.readouterr().out.split())
        assert "marionette:FRAMES: a marionette, 100 % wood" in shown, command
        assert "synthetic:SEED: a synthetic person" in shown and "broken: not usable:" in shown


@pytest.mark.usefixtures("theirs")
def test_a_faulty_source_of_another_package_says_whose_fault_it_is(capsys):
    assert issubclass(find_source("marionette:1")[0], SkeletonSource)
    for word, message in (("broken", "can't be imported"), ("person", "is not a class derived from imitarm.Skele")):
        assert cli.main(["capture", word]) == 2
        error = capsys.readouterr().err
        assert message in " ".join(error.split()) and "Traceback" not in error


def test_nothing_is_imported_before_a_source_is_asked_for():
    fresh: Registry[type[SkeletonSource]] = Registry(SOURCES.kind, SOURCES.group, SOURCES._built_in)
    assert list(fresh) and not fresh._loaded
