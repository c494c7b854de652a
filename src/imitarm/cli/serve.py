"""``imitarm serve``: make a robot available to other processes over UDP."""

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
from imitarm.transmission.datagram_filter import DROP_REASONS
from imitarm.transmission.sockets import LOOPBACK

EPILOG = """\
examples:
  imitarm serve --robot sawyer --tool gripper --port 7500
  imitarm serve --robot panda --scene table.yaml --seconds 600
  imitarm serve --robot sawyer --trace steps.csv

Control the robot with 'imitarm teleoperate SOURCE --to 127.0.0.1:7500'.
The robot stays stopped until the user of 'imitarm teleoperate' enables it.
After 0.1 s without a command, the robot brakes. After 0.5 s, the user must enable the robot again.
Anyone who can reach the port can move the robot. Without --host, only this machine can reach the port.
Ctrl-C brakes the robot and ends the command.
"""

_PORT = 7500
_SHOWN_EVERY = 25  # periods between two updates of the status line


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    add_robot_options(parser)
    parser.add_argument("--scene", type=Path, metavar="FILE", help="obstacles (YAML); default: none")
    parser.add_argument(
        "--control",
        choices=("position", "torque"),
        default="position",
        help="control mode of the simulated drives; default: position",
    )
    network = parser.add_argument_group("network")
    network.add_argument(
        "--port", type=int, default=_PORT, metavar="N", help=f"port to listen on; default: {_PORT}; 0: any free port"
    )
    network.add_argument(
        "--host", default=LOOPBACK, metavar="ADDRESS", help=f"address to listen on; default: {LOOPBACK}"
    )
    network.add_argument("--rate", type=float, default=250.0, metavar="HZ", help="control rate; default: 250")
    parser.add_argument("--seconds", type=float, metavar="S", help="duration; default: until Ctrl-C")
    parser.add_argument(
        "--trace", type=Path, metavar="FILE", help="write status and set-point of each control period (CSV)"
    )
    parser.add_argument("--force", action="store_true", help="replace the file of --trace")


def run(arguments: argparse.Namespace) -> int:
    """Serve the robot until the duration has passed or the user stops the command.

    Raises:
        InputError: when an option or a file is invalid, or the port is in use.
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
        stack.enter_context(sigterm_as_interrupt())
        status = working("starting")
        early: list[str] = []  # events before the server listens, which it never does if the port is in use
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
            remark("note: anyone who can reach this address can move the robot; use a separate network")
        say(f"{arm.name} listens on {server.address[0]}:{server.address[1]}")
        tell = status.console.print
        for event in early:
            tell(event)
        stack.enter_context(status)
        try:
            server.run(arguments.seconds, on_step=_show_progress(trace, status.update))
        except KeyboardInterrupt:
            remark("stopped")
    _show_summary(server)
    return 0


def _show_progress(trace: Trace | None, update: Callable[[Text], None]) -> Callable[[RobotServer], None]:
    """Return the function to call after every control period: it writes the trace and updates the status line."""

    def on_step(server: RobotServer) -> None:
        supervisor = server.supervisor
        if trace is not None:
            trace.write(server)
        if server.rate_limiter.ticks % _SHOWN_EVERY == 0:
            moving = float(np.abs(supervisor.robot.velocity).max())
            words = f"{supervisor.status.name.lower()}, {supervisor.datagram_filter.accepted} commands"
            missed = f"{server.rate_limiter.overruns} periods missed"
            update(Text(f"{words}, {np.degrees(moving):.0f} deg/s, {missed} {supervisor.reason}"))

    return on_step


def _show_summary(server: RobotServer) -> None:
    """Print how many commands were accepted and dropped."""
    supervisor = server.supervisor
    status, why = supervisor.status.name.lower(), supervisor.reason
    dropped = supervisor.datagram_filter.dropped + supervisor.dropped
    rate = server.rate_limiter
    show_table(
        ["served", supervisor.robot.arm.name],
        [
            ("control periods", f"{rate.ticks - rate.overruns}, missed {rate.overruns}"),
            ("commands accepted", str(supervisor.datagram_filter.accepted)),
            *(
                (f"dropped: {reason}", f"{n} {DROP_REASONS.get(reason, '')}".strip())
                for reason, n in sorted(dropped.items())
            ),
            ("at the end", ": ".join(filter(None, [status, why]))),
        ],
    )


class Trace:
    """A file with one line for each control period.

    Each line is written immediately, so that no line is lost if the process is killed.

    The first columns are the time [s] and the status (0 stopped, 1 following, 2 slowing, 3 fault). Three columns for
    each joint follow: set-point [rad], velocity of the set-point [rad/s] and measured position [rad].

    Args:
        path: file to write.
        arm: arm whose joints are written.
        replace: whether to replace an existing file.

    Raises:
        InputError: when the file exists already, or cannot be written.
    """

    def __init__(self, path: Path, arm: ArmModel, *, replace: bool = False) -> None:
        try:
            self._file: TextIOWrapper = path.open("w" if replace else "x", encoding="utf-8", newline="\n")
        except FileExistsError as error:
            raise InputError(
                f"--trace {path}: already exists; name another file, or replace it with --force"
            ) from error
        except OSError as error:
            raise InputError(f"--trace {path}: can't be written: {error.strerror or error}") from error
        names = [f"{what}_{joint}" for what in ("set", "velocity", "measured") for joint in arm.joint_names]
        self._file.write("# format: imitarm-trace\n" + ",".join(["t", "status", *names]) + "\n")
        self._file.flush()

    def write(self, server: RobotServer) -> None:
        """Write a line for the control period that has just ended."""
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
def sigterm_as_interrupt() -> Iterator[None]:
    """Let SIGTERM end the ``with`` block in the same way as Ctrl-C, so that the robot is braked."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
