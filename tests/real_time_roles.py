"""Functions for processes of the real-time benchmark that end in all the ways in which a process can end."""

from __future__ import annotations

import os
import signal
import time

from imitarm.errors import InputError


def wait(setup, shared, *connections):
    """Wait until all processes must end."""
    del connections
    while not shared.stopping:
        time.sleep(0.01)
    return {"setup": setup}


def read(setup, shared, connection):
    """Wait for a message, until the connection is lost."""
    del setup, shared
    return {"message": connection.recv()}


def fail(setup, shared, *connections):
    """Fail with an error that a user can understand."""
    raise InputError("the lens is dirty")


def crash(setup, shared, *connections):
    """Fail with an error in the code."""
    raise ZeroDivisionError("one over nothing")


def die(setup, shared, *connections):
    """End like a process that is killed."""
    os.kill(os.getpid(), signal.SIGKILL)


def hang(setup, shared, *connections):
    """Never end."""
    time.sleep(1000.0)
