"""``imitarm teleoperate``: a person leads a robot, live."""

from __future__ import annotations

import argparse
import os
import queue
import threading
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
from rich.text import Text

from imitarm.capture.skeleton import SIDES
from imitarm.capture.sources import followed, open_source
from imitarm.capture.stream import UdpSource
from imitarm.cli.outputs import check_outputs
from imitarm.cli.person import add_source
from imitarm.cli.robot_options import add_robot_options, load_robot, robot_files
from imitarm.cli.screen import remark, say, show_table, working
from imitarm.cli.serve import terminated_as_interrupted
from imitarm.demonstrations.recorder import DemonstrationRecorder
from imitarm.errors import InputError, TaskFailedError
from imitarm.kinematics.arm import ArmModel
from imitarm.retarget import RETARGETERS, Correspondence
from imitarm.retarget.calibration import Calibration
from imitarm.retarget.correspondence import Orientation
from imitarm.robots import Robot, SimulatedRobot, UdpRobot
from imitarm.robots.udp import TAKEN
from imitarm.scene import Scene, load_scene
from imitarm.teleoperation.loop import INTERRUPTED, Moment, Tally, Teleoperation
from imitarm.transmission.latency import STAGES, LatencyLog
from imitarm.transmission.sockets import parse_address

EPILOG = """\
examples:
  imitarm teleoperate synthetic:7 --orientation upright --record reach.csv
  imitarm teleoperate udp:7400 --calibration mine.json --to 127.0.0.1:7500
  imitarm teleoperate wave.csv --side left --robot panda --latency latency.csv

The robot is simulated in this process, or served by 'imitarm serve' (--to). A served robot that is stopped moves only
after you have pressed Enter here, or with --enable once at the start. The person takes hold by being seen for half a
second. What is recorded is written at once: a program that is killed leaves FILE.part, which can be read.
Exit status 1 when nobody took hold, or the robot could not be led any more.
"""

_SHOWN_EVERY = 25  # steps between two looks at the status line


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add what the command takes."""
    add_source(parser)
    person = parser.add_argument_group("the person")
    person.add_argument("--side", choices=SIDES, help="whose arm leads; default: as calibrated, else right")
    person.add_argument("--person", type=int, metavar="N", help="of several; default: the first who is seen")
    person.add_argument("--calibration", type=Path, metavar="FILE", help="as 'imitarm calibrate' writes it")
    person.add_argument("--scale", type=float, metavar="RHO", help="robot's motion over person's; default: 1")
    person.add_argument(
        "--orientation",
        choices=get_args(Orientation),
        help="what of the hand's turning the tool follows; default: as calibrated, else upright",
    )
    add_robot_options(parser)
    robot = parser.add_argument_group("how the robot is led")
    robot.add_argument("--to", metavar="HOST:PORT", help="lead a served robot; default: simulate it here")
    robot.add_argument(
        "--enable", action="store_true", help="let a stopped robot move, once at the start, without asking"
    )
    robot.add_argument("--scene", type=Path, metavar="FILE", help="obstacles to keep clear of (YAML); default: none")
    robot.add_argument("--method", choices=sorted(RETARGETERS), default="modern", help="default: modern")
    robot.add_argument("--rate", type=float, default=250.0, metavar="HZ", help="control steps a second; default: 250")
    parser.add_argument("--seconds", type=float, metavar="S", help="how long; default: to the end, or till Ctrl-C")
    output = parser.add_argument_group("output")
    output.add_argument("--record", type=Path, metavar="FILE", help="the robot's motion, as a demonstration (CSV)")
    output.add_argument("--task", default="", metavar="WORDS", help="what is shown, for the demonstration")
    output.add_argument("--latency", type=Path, metavar="FILE", help="the latency of each stage, frame by frame (CSV)")
    output.add_argument("--force", action="store_true", help="replace files that are there")


def run(arguments: argparse.Namespace) -> int:
    """Let the person lead, then print how it went.

    Raises:
        InputError: when an option, a file or the source is wrong.
        TaskFailedError: when no robot answers, it could not be led any more, or nobody took hold.
    """
    _check_options(arguments)
    correspondence = _correspondence(arguments)
    scene = Scene() if arguments.scene is None else load_scene(arguments.scene)
    arm = load_robot(arguments)
    retargeter = RETARGETERS[arguments.method](arm, correspondence, dt=1.0 / arguments.rate, scene=scene)
    with ExitStack() as stack:
        stack.enter_context(terminated_as_interrupted())
        source = open_source(arguments.source, realtime=True)
        stream = source if isinstance(source, UdpSource) else None
        person = stack.enter_context(followed(source, person=arguments.person))
        robot = stack.enter_context(_connected(arm, arguments.to)) if arguments.to else SimulatedRobot(arm, scene=scene)
        retargeter.start(np.clip(robot.set_point, arm.lower, arm.upper))
        recorder = None
        if arguments.record is not None:
            recorder = DemonstrationRecorder(
                arguments.record, arm, task=arguments.task, source=person.name, replace=arguments.force
            )
            stack.callback(recorder.close)
        status = stack.enter_context(working("waiting for a person"))
        operator = _operator(arguments, status.console.print)
        loop = Teleoperation(
            person,
            retargeter,
            robot,
            stream=stream,
            recorder=recorder,
            operator=operator,
            on_step=_shown(operator, status.update),
        )
        tally = loop.run(arguments.seconds)
    _show(arguments, tally, robot, stream)
    if recorder is not None and recorder.path.exists() and recorder.n_samples >= 2:
        say(f"wrote {recorder.path}")
    if arguments.latency is not None:
        tally.latency.save(arguments.latency)
        say(f"wrote {arguments.latency}")
    _judge(tally, robot)
    return 0


def _check_options(arguments: argparse.Namespace) -> None:
    """Find out before the work what would only fail after it."""
    if arguments.seconds is not None and not 0.0 < arguments.seconds < np.inf:
        raise InputError(f"--seconds must be above 0, got {arguments.seconds!r}")
    if not 50.0 <= arguments.rate <= 1000.0:  # slower, and the jerk could not be limited
        raise InputError(f"--rate must be from 50 to 1000 Hz, got {arguments.rate:g}")
    inputs = [
        ("SOURCE", arguments.source),
        *((f"--{name}", getattr(arguments, name)) for name in ("calibration", "scene")),
        *robot_files(arguments),
    ]
    check_outputs([("--record", arguments.record), ("--latency", arguments.latency)], inputs, force=arguments.force)
    if arguments.enable and not arguments.to:
        raise InputError("--enable is about a served robot; name it with --to, or leave --enable out")


def _correspondence(arguments: argparse.Namespace) -> Correspondence:
    """Return what was calibrated, changed by what was given."""
    calibration = Calibration() if arguments.calibration is None else Calibration.load(arguments.calibration)
    found = calibration.correspondence()
    if calibration.orientation is None:  # a camera sees the hand's turning badly
        found = replace(found, orientation="upright")
    if arguments.side is not None and arguments.side != found.side:
        if found.lengths is not None:
            remark(f"the calibration is of the {found.side} arm; the {arguments.side} one is learnt as it is seen")
        found = replace(found, side=arguments.side, lengths=None)
    if arguments.scale is not None:
        found = replace(found, scale=arguments.scale)
    return found if arguments.orientation is None else replace(found, orientation=arguments.orientation)


def _connected(arm: ArmModel, address: str) -> UdpRobot:
    return UdpRobot(arm, parse_address(address), timeout=5.0)


def _operator(arguments: argparse.Namespace, tell: Callable[[str], None]) -> EnablePrompt | None:
    """Return who decides; None for a robot in this process, which is never stopped for want of commands."""
    return EnablePrompt(tell, enable_first=arguments.enable) if arguments.to else None


def _shown(operator: EnablePrompt | None, update: Callable[[Text], None]) -> Callable[[Moment], None]:
    """Return what to do after every step: tell the operator, and now and then show how it goes."""
    steps = 0

    def on_step(moment: Moment) -> None:
        nonlocal steps
        steps += 1
        if operator is not None and moment.doing != INTERRUPTED:
            operator.led()
        if steps % _SHOWN_EVERY == 0:
            update(Text(f"{moment.time:.1f} s  {moment.doing}  {moment.trouble}"))

    return on_step


def _show(arguments: argparse.Namespace, tally: Tally, robot: Robot, stream: UdpSource | None) -> None:
    """Print how it went."""
    shares = ", ".join(f"{name} {100 * n / max(tally.steps, 1):.0f} %" for name, n in tally.doing.most_common())
    clamped = ", ".join(f"{name} in {n} steps" for name, n in sorted(tally.clamped.items())) or "none"
    limits = f"velocity {100 * tally.speed:.0f} %, acceleration {100 * tally.acceleration:.0f} % at most"
    rows = [
        ("ended", tally.reason),
        ("duration", f"{tally.duration:.2f} s, {tally.steps} steps, {tally.overruns} missed"),
        ("skeletons", str(tally.frames)),
        ("states", shares),
        ("commands changed by a limit", clamped),
        ("of the limits used", limits),
    ]
    gates = [("skeletons", stream.gate.dropped)] if stream is not None else []
    if isinstance(robot, UdpRobot):
        rows.append(("interruptions", str(tally.interruptions)))
        gates.append(("states", robot.gate.dropped))
    for what, dropped in gates:
        rows.append((f"dropped {what}", ", ".join(f"{n} {reason}" for reason, n in sorted(dropped.items())) or "none"))
    show_table(["teleoperated", f"{arguments.source} to {robot.arm.name} by {arguments.method}"], rows)
    show_latencies(tally.latency)


def show_latencies(log: LatencyLog) -> None:
    """Print a table of latencies, one stage a row."""
    rows = [
        (stage, STAGES.get(stage, ""), str(n), *(f"{1e3 * value:.2f}" for value in values))
        for stage, n, *values in log.rows()
    ]
    if rows:
        show_table(["latency", "from, to", "frames>", "median [ms]>", "95 % [ms]>", "99 % [ms]>", "most [ms]>"], rows)


def _judge(tally: Tally, robot: Robot) -> None:
    """Raise when it did not go as wanted."""
    fault = robot.fault or (robot.trouble if isinstance(robot, UdpRobot) and tally.reason == robot.trouble else "")
    if fault:
        raise TaskFailedError(f"the robot could not be led any more: {fault}")
    if not tally.doing["following"] and tally.reason != "stopped by the user":
        raise TaskFailedError("nobody took hold: the arm must be seen for half a second; see 'imitarm capture --check'")


class EnablePrompt:
    """Asks the user at the terminal whether a stopped robot may move again, without blocking the control loop.

    It prints why the robot can't be led and waits for Enter. Lines typed before the question are ignored. Without a
    terminal nobody can answer, and a stopped robot ends the command.

    Args:
        tell: prints a line.
        enable_first: let the robot move at the start without asking.
        read: blocks until something is typed and returns it; empty: input has ended. None: standard input.
    """

    def __init__(
        self, tell: Callable[[str], None], *, enable_first: bool = False, read: Callable[[], bytes] | None = None
    ) -> None:
        self._tell, self._first = tell, enable_first
        self._read = _standard_input if read is None else read
        self._typed: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        self._ended = False
        self._asked: tuple[str, bool] = ("", False)
        # a thread, since standard input can't be asked without waiting on every system
        threading.Thread(target=self._reading, daemon=True).start()

    def led(self) -> None:
        """The robot can be led again: the next problem is a new one."""
        self._first, self._asked = False, ("", False)

    def __call__(self, trouble: str, stopped: bool) -> bool:
        """Return whether a stopped robot may move again.

        Args:
            trouble: why the robot can't be led.
            stopped: whether it is stopped.

        Raises:
            TaskFailedError: when it is stopped and nobody can answer.
        """
        self._first = self._first and trouble != TAKEN  # never takes over from another client
        if self._first:
            return stopped
        if (trouble, stopped) != self._asked:
            self._asked = (trouble, stopped)
            self._taken()
            question = ". If the workspace is clear, press Enter to let it move again" if stopped else ""
            self._tell(f"the robot can't be led: {trouble}{question}")
            return False
        if stopped and self._ended:
            raise TaskFailedError(
                f"the robot is stopped: {trouble}; nobody can let it move again, since there is no terminal. Run this "
                "in one, or begin with --enable"
            )
        return stopped and b"\n" in self._taken()

    def _reading(self) -> None:
        while typed := self._read():
            self._typed.put(typed)
        self._ended = True

    def _taken(self) -> bytes:
        typed = b""
        while not self._typed.empty():
            typed += self._typed.get()
        return typed


def _standard_input() -> bytes:
    """Block until something is typed and return it; empty when nobody can type here."""
    try:
        if os.isatty(0) and hasattr(os, "tcgetpgrp") and os.tcgetpgrp(0) != os.getpgrp():
            return b""  # in the background, where reading would halt the process
        return os.read(0, 4096)
    except OSError:
        return b""
