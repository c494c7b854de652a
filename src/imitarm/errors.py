"""The errors that imitarm raises; all have one base class, so that one ``except`` clause catches every error.

Every message says what is wrong, where the fault is, and what to do about the fault. Arguments and files are checked
when an object is constructed or a file is read, not inside a control loop.
"""

from __future__ import annotations


class ImitarmError(Exception):
    """Base class of all errors that imitarm raises deliberately.

    The command line shows only the message and exits with ``exit_status``: 2 for invalid input, 1 for a task that
    failed although the input was valid.
    """

    exit_status = 2


class InputError(ImitarmError, ValueError):
    """A value, shape, unit or option that can't be used; the message names the faulty item and the remedy."""


class FileFormatError(InputError):
    """A file that is damaged or has an unexpected format; the message names the file, and the place in the file."""


class UnknownNameError(InputError):
    """A name that is not registered; the message lists the registered names."""

    @classmethod
    def among(cls, kind: str, name: object, known: object) -> UnknownNameError:
        """Build the message ``unknown <kind> '<name>'; known: a, b, c``.

        Args:
            kind: kind of the named object, for example ``"robot"``.
            name: unknown name.
            known: existing names.
        """
        names = ", ".join(sorted(str(k) for k in known))  # type: ignore[attr-defined]
        return cls(f"unknown {kind} {name!r}; known: {names}")


class TaskFailedError(ImitarmError):
    """The input is valid, but the task failed (exit status 1)."""

    exit_status = 1


class UnreachableError(TaskFailedError):
    """No joint configuration within the limits reaches the requested pose."""

    exit_status = 2


class InfeasibleError(TaskFailedError):
    """No path with the required clearance was found; the message names the obstacle and the reason."""
