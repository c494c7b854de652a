"""The ``imitarm`` command. Each subcommand has its own file with ``add_arguments(parser)`` and ``run(arguments)``.

A module is imported only when its command is used, so ``imitarm --help`` answers at once. To add a command, write a
file in this folder and add a line to ``COMMANDS``.
"""

from __future__ import annotations

import argparse
import importlib
import os
import sys
from collections.abc import Sequence

from imitarm import __version__
from imitarm.errors import ImitarmError

COMMANDS = {
    "capture": "record a person's motion from a camera or a file, and check it",
    "calibrate": "measure a person's arm, locate the sensor, choose how the robot follows the person",
    "retarget": "convert a person's motion to a robot demonstration",
    "teleoperate": "let a person move a robot in real time",
    "serve": "make a simulated robot available to other processes over UDP",
    "lint": "check demonstrations and list their faults",
    "learn": "learn a skill from demonstrations",
    "reproduce": "let a simulated arm reproduce a skill around obstacles",
    "demo": "learn a sweep, reproduce it around obstacles, write a report",
    "benchmark": "run a benchmark of the methods, and compare the results with those of the thesis",
    "robots": "list the known arms and tools, or inspect one",
}

_EXAMPLES = """\
examples:
  imitarm lint recordings/ --units cm --duration 10
  imitarm learn recordings/ --task pour --out pour.json --units cm --duration 10
  imitarm robots sawyer

Run 'imitarm COMMAND --help' for the options of a command.
The exit status is 0 after success, 1 after a failure, 2 after wrong input and 130 after an interruption.
"""

_INTERRUPTED, _PIPE_CLOSED = 130, 141  # 128 and the number of the signal, as shells count


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit status; a failure prints one message, never a traceback.

    Args:
        argv: command-line arguments without the program's name; by default, the arguments of this process.
    """
    # Many small matrices: one thread is quicker than several that wait for each other. NumPy is not loaded yet.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    words = sys.argv[1:] if argv is None else list(argv)
    status: int
    try:
        arguments = _parser(words).parse_args(words)
        status = arguments.run(arguments)
        sys.stdout.flush()
    except SystemExit as stop:  # argparse has said why
        status = stop.code if isinstance(stop.code, int) else ImitarmError.exit_status
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # nobody reads on: let the exit be quiet
        status = _PIPE_CLOSED
    except (Exception, KeyboardInterrupt) as error:
        if os.environ.get("IMITARM_DEBUG"):
            raise
        message, status = _explained(error)
        sys.stderr.write(f"imitarm: error: {message}\n")
    return status


def _explained(error: BaseException) -> tuple[str, int]:
    """Return the message and the exit status for an error."""
    if isinstance(error, KeyboardInterrupt):
        return "interrupted", _INTERRUPTED
    if isinstance(error, ImitarmError):
        return str(error), error.exit_status
    if isinstance(error, OSError):
        return str(error), ImitarmError.exit_status
    what = f"{type(error).__name__}: {error}".removesuffix(": ")
    return f"this is a bug in imitarm, please report it ({what}); IMITARM_DEBUG=1 shows where it happened", 1


def _parser(words: Sequence[str]) -> argparse.ArgumentParser:
    """Build the parser.

    Only the subcommand named in ``words`` gets its arguments, so that the modules of other commands are not imported.
    """
    parser = argparse.ArgumentParser(
        prog="imitarm",
        description="Teach industrial robot arms by demonstration: learn a motion, and reproduce it safely around "
        "obstacles.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"imitarm {__version__}")
    commands = parser.add_subparsers(metavar="COMMAND", required=True, title="commands")
    asked = next((word for word in words if not word.startswith("-")), None)
    for name, summary in COMMANDS.items():
        command = commands.add_parser(name, help=summary, formatter_class=argparse.RawDescriptionHelpFormatter)
        if name == asked:
            module = importlib.import_module(f"imitarm.cli.{name}")
            command.description, command.epilog = summary[:1].upper() + summary[1:] + ".", module.EPILOG
            module.add_arguments(command)
            command.set_defaults(run=module.run)
    return parser
