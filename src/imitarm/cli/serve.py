"""``imitarm serve``: a process for a robot, which others lead over UDP."""

from __future__ import annotations

import argparse
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from io import TextIOWrapper
from pathlib import Path

import numpy as np
from rich.text import Text

from imitarm.cli.outputs import check_outputs
from imitarm.cli.robot_options import add_robot_options, load_robot, robot_files
from imitarm.cli.screen import remark, say, show_table, working
from imitarm.errors import InputError
from imitarm.kinematics.arm import ArmModel
from imitarm.robots import RobotServer, SimulatedRobot
from imitarm.scene import Scene, load_scene
from imitarm.transmission.gate import REASONS
from imitarm.transmission.sockets import LOOPBACK

EPILOG = """\
examples:
  imitarm serve --robot sawyer --tool gripper --port 7500
  imitarm serve --robot panda --scene table.yaml --seconds 600
  imitarm serve --robot sawyer --trace steps.csv

Lead it with 'imitarm teleoperate SOURCE --to 127.0.0.1:7500'. It begins stopped, until the operator there enables it;
0.1 s without commands and it brakes, 0.5 s and it stays stopped. Whoever can reach the port can move the robot: it
listens to this machine only, unless --host says otherwise. Ctrl-C brakes and ends it.
"""

_PORT = 7500
_SHOWN_EVERY = 25  # periods between two looks at the status line


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add what the command takes."""
    add_robot_options(parser)
    parser.add_argument("--scene", type=Path, metavar="FILE", help="obstacles (YAML); default: none")
    parser.add_argument("--control", choices=("position", "torque"), default="position", help="of the simulated drives")
    wire = parser.add_argument_group("the wire")
    wire.add_argument("--port", type=int, default=_PORT, metavar="N", help=f"default: {_PORT}; 0: any that is free")
    wire.add_argument("--host", default=LOOPBACK, metavar="ADDRESS", help=f"to listen at; default: {LOOPBACK}")
    wire.add_argument("--rate", type=float, default=250.0, metavar="HZ", help="control periods a second; default: 250")
    parser.add_argument("--seconds", type=float, metavar="S", help="how long; default: till Ctrl-C")
    parser.add_argument("--trace", type=Path, metavar="FILE", help="write every period's status and set-point (CSV)")
    parser.add_argument("--force", action="store_true", help="replace the file of --trace")


def run(arguments: argparse.Namespace) -> int:
    """Serve until the time is up or the user stops it.

    Raises:
        InputError: when an option or a file is wrong, or the port is taken.
    """
    if arguments.seconds is not None and not 0.0 < arguments.seconds < np.inf:
        raise InputError(f"--seconds must be above 0, got {arguments.seconds!r}")
    if not 0 <= arguments.port < 65536:
        raise InputError(f"--port must be from 0 to 65535, got {arguments.port}")
    inputs = [("--scene", arguments.scene), *robot_files(arguments)]
    check_outputs([("--trace", arguments.trace)], inputs, force=arguments.force)
    scene = Scene() if arguments.scene is None else load_scene(arguments.scene)
    arm = load_robot(arguments)
    robot = SimulatedRobot(arm, scene=scene, control=arguments.control)
    with ExitStack() as stack:
        stack.enter_context(terminated_as_interrupted())
        status = working("starting")
        early: list[str] = []  # what happens before it listens, which on a port that is taken it never does
        tell: Callable[[str], None] = early.append
        server = RobotServer(
            robot,
            arguments.port,
            arguments.host,
            rate=arguments.rate,
            on_event=lambda event: tell(f"{robot.time:9.2f} s  {event}"),
        )
        stack.enter_context(server)
        trace = None if arguments.trace is None else Trace(arguments.trace, arm, replace=arguments.force)
        if trace is not None:
            stack.callback(trace.close)
        if arguments.host != LOOPBACK:
            remark("note: whoever can reach this address can move the robot; keep it on a network of its own")
        say(f"{arm.name} listens at {server.address[0]}:{server.address[1]}")
        tell = status.console.print
        for event in early:
            tell(event)
        stack.enter_context(status)
        try:
            server.run(arguments.seconds, on_step=_shown(trace, status.update))
        except KeyboardInterrupt:
            remark("stopped")
    _summary(server)
    return 0


def _shown(trace: Trace | None, update: Callable[[Text], None]) -> Callable[[RobotServer], None]:
    """Return what to do after every period: write it down, and now and then show it."""

    def on_step(server: RobotServer) -> None:
        supervisor = server.supervisor
        if trace is not None:
            trace.write(server)
        if server.pace.ticks % _SHOWN_EVERY == 0:
            moving = float(np.abs(supervisor.robot.velocity).max())
            words = f"{supervisor.status.name.lower()}, {supervisor.gate.admitted} commands"
            missed = f"{server.pace.overruns} periods missed"
            update(Text(f"{words}, {np.degrees(moving):.0f} deg/s, {missed} {supervisor.reason}"))

    return on_step


def _summary(server: RobotServer) -> None:
    """Print what came and what was dropped."""
    supervisor = server.supervisor
    status, why = supervisor.status.name.lower(), supervisor.reason
    dropped = supervisor.gate.dropped + supervisor.dropped
    show_table(
        ["served", supervisor.robot.arm.name],
        [
            ("control periods", f"{server.pace.ticks - server.pace.overruns}, missed {server.pace.overruns}"),
            ("commands admitted", str(supervisor.gate.admitted)),
            *(
                (f"dropped: {reason}", f"{n} {REASONS.get(reason, '')}".strip())
                for reason, n in sorted(dropped.items())
            ),
            ("at the end", why if why.startswith(status) else ": ".join(filter(None, [status, why]))),
        ],
    )


class Trace:
    """Every control period of a robot in a file, each line handed over at once, so that a kill loses none.

    Columns: time [s], status (0 stopped, 1 following, 2 slowing, 3 fault), then set-point [rad], its velocity [rad/s]
    and measured position [rad] of each joint.

    Args:
        path: where to.
        arm: whose joints.
        replace: an existing file may be replaced.

    Raises:
        InputError: when the file is there already, or can't be written.
    """

    def __init__(self, path: Path, arm: ArmModel, *, replace: bool = False) -> None:
        try:
            self._file: TextIOWrapper = path.open("w" if replace else "x", encoding="utf-8", newline="\n")
        except FileExistsError as error:
            raise InputError(
                f"--trace {path}: is there already; name another file, or replace it with --force"
            ) from error
        except OSError as error:
            raise InputError(f"--trace {path}: can't be written: {error.strerror or error}") from error
        names = [f"{what}_{joint}" for what in ("set", "velocity", "measured") for joint in arm.joint_names]
        self._file.write("# format: imitarm-trace\n" + ",".join(["t", "status", *names]) + "\n")
        self._file.flush()

    def write(self, server: RobotServer) -> None:
        """Add the period that is just over."""
        supervisor = server.supervisor
        robot = supervisor.robot
        state = robot.state()
        values = [state.time, float(supervisor.status), *robot.set_point, *robot.velocity, *state.q]
        self._file.write(",".join(repr(float(value)) for value in values) + "\n")
        self._file.flush()

    def close(self) -> None:
        """Close the file."""
        self._file.close()


@contextmanager
def terminated_as_interrupted() -> Iterator[None]:
    """Let the usual ``kill`` end what is in the ``with`` block as Ctrl-C does: with the robot braked."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
