from __future__ import annotations

import sys
from types import ModuleType

import pytest

from imitarm.capture import sources
from imitarm.capture.filters import PersonFilter
from imitarm.capture.recording import SkeletonRecording
from imitarm.capture.sources import followed, live, open_source
from imitarm.capture.synthetic import SyntheticSource
from imitarm.errors import InputError, UnknownNameError
from recording_samples import Listed, exchanged, same, skeletons


def test_a_file_and_a_made_up_person(tmp_path, monkeypatch):
    SkeletonRecording(skeletons(3)).save(tmp_path / "a.csv")
    assert len(list(open_source(tmp_path / "a.csv"))) == 3
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a.csv").rename("udp:7")  # a file of that name comes first
    assert len(list(open_source("udp:7"))) == 3 and not live("udp:7")
    source = open_source("synthetic:5")
    assert isinstance(source, SyntheticSource) and source.name == "synthetic:5"
    assert same(source.read(), SyntheticSource.from_seed(5).read())


@pytest.mark.parametrize(
    ("word", "module", "name", "given"),
    [
        ("webcam:2", "mediapipe", "MediaPipeSource", (2,)),
        ("video:{}", "mediapipe", "MediaPipeSource", ("{}",)),
        ("udp:7400", "stream", "UdpSource", (7400,)),
        ("udp:0.0.0.0:7400", "stream", "UdpSource", (7400, "0.0.0.0")),
        ("kinect2", "kinect", "KinectV2Source", ()),
        ("azure", "kinect", "AzureKinectSource", ()),
    ],
)
def test_a_word_leads_to_its_source_which_is_imported_only_then(word, module, name, given, tmp_path, monkeypatch):
    film = tmp_path / "film.mp4"
    film.write_bytes(b"x")
    stand_in = ModuleType(module)
    setattr(stand_in, name, lambda *values, realtime=False: (name, values))
    monkeypatch.setitem(sys.modules, f"imitarm.capture.{module}", stand_in)
    assert open_source(word.format(film)) == (name, tuple(str(film) if g == "{}" else g for g in given))
    assert live(word) == (not word.startswith("video"))


@pytest.mark.parametrize(
    ("word", "error", "message"),
    [
        (
            "kinect3",
            UnknownNameError,
            "unknown source 'kinect3'; known: FILE, azure, kinect2, synthetic:SEED, udp:PORT",
        ),
        ("camera:0", UnknownNameError, "unknown source 'camera:0'"),
        ("synthetic", InputError, "the seed is missing; say synthetic:"),
        ("udp:", InputError, "the port is missing"),
        ("udp:65536", InputError, "the port must be a whole number from 0 to 65535"),
        ("webcam:front", InputError, "the camera's number must be a whole number"),
        ("synthetic:-1", InputError, "the seed must be"),
        ("azure:1", InputError, "takes nothing after a colon; say azure"),
        ("video:nowhere.mp4", InputError, "no such file"),
        ("nowhere.csv", InputError, r"nowhere\.csv: can't be read"),
    ],
)
def test_a_word_that_is_wrong_says_what_to_do(word, error, message):
    with pytest.raises(error, match=message):
        open_source(word)


def test_every_word_is_explained_and_opened():
    kinds = {word.partition(":")[0] for word in sources.WORDS} - {"FILE"}
    assert kinds == set(sources._OPENERS)


def test_a_retargeter_is_given_one_person_with_the_sides_right():
    frames = skeletons(20, person=1)
    wrong = [exchanged(s) if i == 9 else s for i, s in enumerate(frames)]
    source = followed(Listed([s for pair in zip(wrong, skeletons(20, person=2), strict=True) for s in pair]))
    assert isinstance(source, PersonFilter)
    assert all(map(same, source, frames))
    assert {s.person for s in followed(Listed(skeletons(3) + skeletons(3, person=2)), person=2)} == {2}
