from __future__ import annotations

import os
import pty
import queue
import time

import pytest

from imitarm.cli.teleoperate import EnablePrompt, _standard_input
from imitarm.errors import TaskFailedError
from imitarm.robots.udp import OTHER_CLIENT


class Keyboard:
    """What is typed, and b"" for the end of input."""

    def __init__(self):
        self.keys, self.taken = queue.Queue(), 0

    def read(self):
        typed = self.keys.get()
        self.taken += 1
        return typed

    def type(self, typed, prompt):
        """Type, and wait until it has been read."""
        before = prompt._typed.qsize()
        self.keys.put(typed)
        until = time.monotonic() + 120.0
        while time.monotonic() < until and prompt._typed.qsize() == before and not prompt._ended:
            time.sleep(0.001)


@pytest.fixture
def keyboard():
    keyboard = Keyboard()
    yield keyboard
    keyboard.keys.put(b"")  # lets the thread end


def test_a_stopped_robot_waits_for_enter(keyboard):
    printed = []
    prompt = EnablePrompt(printed.append, read=keyboard.read)
    assert [prompt("the server has just started", True) for _ in range(5)] == [False] * 5
    assert printed == [
        "the robot cannot be controlled: the server has just started. "
        "If the workspace is clear, press Enter to enable the robot"
    ]
    keyboard.type(b"y", prompt)
    assert not prompt("the server has just started", True)
    keyboard.type(b"\n", prompt)
    assert prompt("the server has just started", True)
    assert not prompt("the server has just started", True)  # one Enter, one answer
    prompt.reset()
    prompt("no valid command for 500 ms", True)
    assert len(printed) == 2


def test_what_was_typed_before_the_question_counts_for_nothing(keyboard):
    prompt = EnablePrompt(lambda line: None, read=keyboard.read)
    keyboard.type(b"\n\n\n", prompt)
    assert [prompt("the server has just started", True) for _ in range(3)] == [False] * 3
    prompt("another reason", True)
    keyboard.type(b"\n", prompt)
    assert prompt("another reason", True)


def test_a_robot_that_is_not_stopped_is_not_asked_about(keyboard):
    printed = []
    prompt = EnablePrompt(printed.append, read=keyboard.read)
    assert not prompt("the robot does not answer", False)
    keyboard.type(b"\n", prompt)
    assert not prompt("the robot does not answer", False)
    assert printed == ["the robot cannot be controlled: the robot does not answer"]
    assert not prompt("the server has just started", True)  # that Enter was not an answer to this


def test_at_the_start_it_may_be_let_without_asking_and_only_then(keyboard):
    prompt = EnablePrompt(lambda line: None, enable_first=True, read=keyboard.read)
    assert prompt("the server has just started", True) and not prompt("the robot does not answer", False)
    prompt.reset()
    assert not prompt("no valid command for 500 ms", True)


def test_a_robot_that_somebody_leads_at_the_start_is_not_taken_over_when_it_stops_later(keyboard):
    prompt = EnablePrompt(lambda line: None, enable_first=True, read=keyboard.read)
    assert not prompt(OTHER_CLIENT, False)
    assert not prompt("no valid command for 500 ms", True)
    assert not prompt("no valid command for 500 ms", True)


def test_where_nobody_can_answer_a_stopped_robot_ends_the_command(keyboard):
    prompt = EnablePrompt(lambda line: None, read=keyboard.read)
    keyboard.type(b"", prompt)
    assert not prompt("the robot does not answer", False)
    assert not prompt("the server has just started", True)
    with pytest.raises(TaskFailedError, match="the server has just started; it cannot be enabled without a terminal"):
        prompt("the server has just started", True)


def test_a_terminal_is_read_only_in_the_foreground(monkeypatch):
    ours, theirs = pty.openpty()
    before = os.dup(0)
    try:
        os.dup2(theirs, 0)
        monkeypatch.setattr(os, "tcgetpgrp", lambda descriptor: os.getpgrp() + 1)
        assert _standard_input() == b""
        monkeypatch.setattr(os, "tcgetpgrp", lambda descriptor: os.getpgrp())
        os.write(ours, b"\n")
        assert _standard_input() == b"\n"
    finally:
        os.dup2(before, 0)
        for descriptor in (before, ours, theirs):
            os.close(descriptor)
