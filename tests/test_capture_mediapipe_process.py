from __future__ import annotations

import gc
import subprocess
import sys
import time
from pathlib import Path

import pytest

from imitarm.capture.mediapipe_environment import LONGEST, LineProcess
from mediapipe_samples import alive

STUBBORN = "import signal, sys, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); print('up', flush=True); "


def started(program, **options):
    return LineProcess([sys.executable, "-c", program], **options)


def test_lines_come_in_order_and_then_there_are_no_more():
    process = started("import sys; [print(i) for i in range(200)]; sys.stderr.write('bye'); sys.exit(3)", keep=4)
    assert [process.line(10.0) for _ in range(200)] == [str(i).encode() for i in range(200)]
    with pytest.raises(EOFError):
        process.line(10.0)
    assert process.ended() == "exit status 3: bye"
    process.close()
    assert not alive(process.pid)


def test_what_it_said_last_is_told_without_chatter():
    process = started(
        "import sys; sys.stderr.write('x' * 900 + ' I am ill\\nW0000 all is well\\nINFO: up\\n')",
        chatter="W0000 |INFO: ",
    )
    with pytest.raises(EOFError):
        process.line(10.0)
    assert process.ended().endswith("x I am ill") and len(process.ended()) < 700
    process.close()


def test_nothing_in_time_is_none():
    process = started("import time; time.sleep(600)")
    began = time.monotonic()
    assert process.line(0.05) is None and time.monotonic() - began >= 0.05
    assert process.ended() == "still running"
    process.close()


def test_the_newest_line_is_kept_when_nobody_reads():
    process = started("import time; [print(i, flush=True) for i in range(1000)]; time.sleep(600)", keep=1, newest=True)
    time.sleep(0.5)
    assert process.line(120.0) == b"0"  # the first of all may be a greeting
    last = b""
    until = time.monotonic() + 120.0
    while last != b"999" and time.monotonic() < until:
        time.sleep(0.05)
        last = process.line(1.0) or last
    assert last == b"999"
    process.close()


def test_a_line_without_an_end_does_not_fill_the_memory():
    process = started("import sys; sys.stdout.write('x' * 1000000)")
    assert len(process.line(10.0)) == LONGEST
    process.close()


@pytest.mark.parametrize("program", [STUBBORN + "sys.stdin.read()", STUBBORN + "time.sleep(600)"])
def test_close_ends_it_even_when_it_will_not(program):
    process = started(program)
    assert process.line(10.0) == b"up"
    process.close()
    process.close()
    assert not alive(process.pid)


def test_close_ends_it_while_lines_are_waiting():
    process = started("while True: print('more', flush=True)", keep=2)
    assert process.line(10.0) == b"more"
    process.close()
    assert not alive(process.pid)


def test_it_does_not_outlive_the_last_reference():
    process = started(STUBBORN + "time.sleep(600)")
    pid = process.pid
    assert process.line(10.0) == b"up"
    del process
    gc.collect()
    assert not alive(pid)


def test_it_does_not_outlive_a_program_that_is_killed():
    program = (
        "import sys, time\n"
        "from imitarm.capture.mediapipe_environment import LineProcess\n"
        "child = LineProcess([sys.executable, '-c', 'import sys; print(1, flush=True); sys.stdin.read()'])\n"
        "child.line(30.0)\n"
        "print(child.pid, flush=True)\n"
        "time.sleep(600)\n"
    )
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE) as parent:
        pid = int(parent.stdout.readline())
        assert alive(pid)
        parent.kill()
    until = time.monotonic() + 120.0
    while running(pid) and time.monotonic() < until:
        time.sleep(0.05)
    assert not running(pid)


def running(pid):
    """Whether a process that is not ours runs; one that has ended may wait as a zombie for who inherits it."""
    try:
        return Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def test_what_can_not_be_started_leaves_nothing():
    with pytest.raises(OSError, match="No such file"):
        LineProcess(["/nowhere/python"])
