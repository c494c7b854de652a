"""``imitarm teleoperate``: a person moves a robot in real time."""

from __future__ import annotations

import argparse
import os
import queue
import threading
from collections import Counter
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
from imitarm.cli.serve import sigterm_as_interrupt
from imitarm.demonstrations.recorder import DemonstrationRecorder
from imitarm.errors import InputError, TaskFailedError
from imitarm.kinematics.arm import ArmModel
from imitarm.retarget import RETARGETERS, Correspondence
from imitarm.retarget.calibration import Calibration
from imitarm.retarget.correspondence import Orientation
from imitarm.retarget.engagement import EngagementState
from imitarm.robots import Robot, SimulatedRobot, UdpRobot
from imitarm.robots.udp import OTHER_CLIENT
from imitarm.scene import Scene, load_scene
from imitarm.teleoperation import StepInfo, Summary, Teleoperation
from imitarm.transmission.latency import STAGES, LatencyLog
from imitarm.transmission.sockets import parse_address

EPILOG = """\
examples:
  imitarm teleoperate synthetic:7 --orientation upright --record reach.csv
  imitarm teleoperate udp:7400 --calibration mine.json --to 127.0.0.1:7500
  imitarm teleoperate wave.csv --side left --robot panda --latency latency.csv

By default, the robot is simulated in this process. With --to, the robot is one of 'imitarm serve'.
A robot of 'imitarm serve' is stopped at first, and moves only after you press Enter here.
With --enable, the robot is enabled once at the start, without asking.
The robot begins to follow a person who has been seen for half a second.
Each recorded sample is written to FILE.part immediately, so that it can be read even if the process is killed.
The exit status is 1 if the robot never followed a person, or could no longer be controlled.
"""

_INTERRUPTED = "interrupted"
_SHOWN_EVERY = 25  # steps between two updates of the status line


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    add_source(parser)
    person = parser.add_argument_group("the person")
    person.add_argument("--side", choices=SIDES, help="arm of the person; default: as calibrated, else right")
    person.add_argument(
        "--person",
        type=int,
        metavar="N",
        help="number of the person, if there are several; default: the first one seen",
    )
    person.add_argument("--calibration", type=Path, metavar="FILE", help="file written by 'imitarm calibrate'")
    person.add_argument("--scale", type=float, metavar="RHO", help="robot motion divided by hand motion; default: 1")
    person.add_argument(
        "--orientation",
        choices=get_args(Orientation),
        help="how the tool rotates with the hand; default: as calibrated, else upright",
    )
    add_robot_options(parser)
    robot = parser.add_argument_group("control")
    robot.add_argument("--to", metavar="HOST:PORT", help="use a robot of 'imitarm serve'; default: simulate one here")
    robot.add_argument("--enable", action="store_true", help="enable a stopped robot once at the start, without asking")
    robot.add_argument("--scene", type=Path, metavar="FILE", help="obstacles to avoid (YAML); default: none")
    robot.add_argument("--method", choices=sorted(RETARGETERS), default="modern", help="retargeter; default: modern")
    robot.add_argument("--rate", type=float, default=250.0, metavar="HZ", help="control steps per second; default: 250")
    parser.add_argument("--seconds", type=float, metavar="S", help="duration; default: until the source ends or Ctrl-C")
    output = parser.add_argument_group("output")
    output.add_argument("--record", type=Path, metavar="FILE", help="write the robot's motion as a demonstration (CSV)")
    output.add_argument("--task", default="", metavar="TEXT", help="description of the task, for the demonstration")
    output.add_argument(
        "--latency", type=Path, metavar="FILE", help="write the latency of each skeleton in each stage (CSV)"
    )
    output.add_argument("--force", action="store_true", help="replace existing files")


def run(arguments: argparse.Namespace) -> int:
    """Run the teleoperation, then print a summary.

    Raises:
        InputError: when an option, a file or the source is invalid.
        TaskFailedError: when no robot answers, when the robot can no longer be controlled, or when it never followed a
            person.
    """
    _check_options(arguments)
    correspondence = _correspondence(arguments)
    scene = Scene() if arguments.scene is None else load_scene(arguments.scene)
    arm = load_robot(arguments)
    retargeter = RETARGETERS[arguments.method](arm, correspondence, dt=1.0 / arguments.rate, scene=scene)
    with ExitStack() as stack:
        stack.enter_context(sigterm_as_interrupt())
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
        prompt = _enable_prompt(arguments, status.console.print)
        loop = Teleoperation(
            person,
            retargeter,
            robot,
            stream=stream,
            recorder=recorder,
            confirm_enable=prompt,
            on_step=_show_progress(prompt, status.update),
        )
        summary = loop.run(arguments.seconds)
    _show(arguments, summary, robot, stream)
    if recorder is not None and recorder.path.exists() and recorder.n_samples >= 2:
        say(f"wrote {recorder.path}")
    if arguments.latency is not None:
        summary.latency.save(arguments.latency)
        say(f"wrote {arguments.latency}")
    _raise_failure(summary, robot)
    return 0


def _check_options(arguments: argparse.Namespace) -> None:
    """Check the options that would otherwise cause a failure only after the run."""
    if arguments.seconds is not None and not 0.0 < arguments.seconds < np.inf:
        raise InputError(f"--seconds must be above 0, got {arguments.seconds!r}")
    if not 50.0 <= arguments.rate <= 1000.0:  # at a lower rate the jerk cannot be limited
        raise InputError(f"--rate must be from 50 to 1000 Hz, got {arguments.rate:g}")
    inputs = [
        ("SOURCE", arguments.source),
        *((f"--{name}", getattr(arguments, name)) for name in ("calibration", "scene")),
        *robot_files(arguments),
    ]
    check_outputs([("--record", arguments.record), ("--latency", arguments.latency)], inputs, force=arguments.force)
    if arguments.enable and not arguments.to:
        raise InputError("--enable applies to a robot of 'imitarm serve'; name its address with --to, or omit --enable")


def _correspondence(arguments: argparse.Namespace) -> Correspondence:
    """Return the calibration, changed according to the options."""
    calibration = Calibration() if arguments.calibration is None else Calibration.load(arguments.calibration)
    found = calibration.correspondence()
    if calibration.orientation is None:  # a camera measures the rotation of the hand poorly
        found = replace(found, orientation="upright")
    if arguments.side is not None and arguments.side != found.side:
        if found.lengths is not None:
            remark(f"the calibration is for the {found.side} arm; the {arguments.side} arm is measured during the run")
        found = replace(found, side=arguments.side, lengths=None)
    if arguments.scale is not None:
        found = replace(found, scale=arguments.scale)
    return found if arguments.orientation is None else replace(found, orientation=arguments.orientation)


def _connected(arm: ArmModel, address: str) -> UdpRobot:
    return UdpRobot(arm, parse_address(address), timeout=5.0)


def _enable_prompt(arguments: argparse.Namespace, tell: Callable[[str], None]) -> EnablePrompt | None:
    """Return the prompt for enabling a robot of ``imitarm serve``; None for a robot simulated in this process."""
    return EnablePrompt(tell, enable_first=arguments.enable) if arguments.to else None


def _show_progress(prompt: EnablePrompt | None, update: Callable[[Text], None]) -> Callable[[StepInfo], None]:
    """Return the function to call after every control step: it updates the prompt and the status line."""
    steps = 0

    def on_step(step: StepInfo) -> None:
        nonlocal steps
        steps += 1
        if prompt is not None and step.engagement is not None:
            prompt.reset()
        if steps % _SHOWN_EVERY == 0:
            update(Text(f"{step.time:.1f} s  {step.engagement or _INTERRUPTED}  {step.problem}"))

    return on_step


def _show(arguments: argparse.Namespace, summary: Summary, robot: Robot, stream: UdpSource | None) -> None:
    """Print the summary."""
    counts = Counter({state.value: n for state, n in summary.engagement.items()})
    counts[_INTERRUPTED] = summary.interrupted
    states = ", ".join(f"{name} {100 * n / max(summary.steps, 1):.0f} %" for name, n in counts.most_common() if n)
    clamped = ", ".join(f"{name} in {n} steps" for name, n in sorted(summary.clamped.items())) or "none"
    limits = f"{100 * summary.speed:.0f} % and {100 * summary.acceleration:.0f} % of the limits"
    rows = [
        ("ended", summary.reason),
        ("duration", f"{summary.duration:.2f} s, {summary.steps} steps, {summary.overruns} missed"),
        ("skeletons", str(summary.skeletons)),
        ("states", states),
        ("commands changed to keep a limit", clamped),
        ("commands changed to keep a clearance", f"in {summary.filtered} steps"),
        ("no safe motion was found", f"in {summary.unsafe} steps"),
        ("highest velocity and acceleration", limits),
    ]
    received = [("skeletons", stream.datagram_filter.dropped)] if stream is not None else []
    if isinstance(robot, UdpRobot):
        rows.append(("interruptions", str(summary.interruptions)))
        received.append(("states", robot.datagram_filter.dropped))
    for what, dropped in received:
        rows.append((f"dropped {what}", ", ".join(f"{n} {reason}" for reason, n in sorted(dropped.items())) or "none"))
    show_table(["teleoperated", f"{arguments.source} to {robot.arm.name} by {arguments.method}"], rows)
    show_latencies(summary.latency)


def show_latencies(log: LatencyLog) -> None:
    """Print a table of latencies, with one row for each stage between the camera and the robot."""
    rows = [
        (stage, STAGES.get(stage, ""), str(n), *(f"{1e3 * value:.2f}" for value in values))
        for stage, n, *values in log.statistics()
    ]
    if rows:
        show_table(
            ["latency", "from, to", "skeletons>", "median [ms]>", "95 % [ms]>", "99 % [ms]>", "maximum [ms]>"], rows
        )


def _raise_failure(summary: Summary, robot: Robot) -> None:
    """Raise TaskFailedError if the robot failed or never followed a person."""
    fault = robot.fault or (robot.problem if isinstance(robot, UdpRobot) and summary.reason == robot.problem else "")
    if fault:
        raise TaskFailedError(f"the robot could no longer be controlled: {fault}")
    if not summary.engagement[EngagementState.FOLLOWING] and summary.reason != "stopped by the user":
        raise TaskFailedError(
            "the robot never followed a person: an arm must be seen for half a second; see 'imitarm capture --check'"
        )


class EnablePrompt:
    """Asks the user at the terminal whether a stopped robot may move again, without blocking the control loop.

    The prompt prints why the robot cannot be controlled and waits for Enter. Lines that the user typed before the
    question are ignored. Without a terminal, nobody can answer, so the command fails when the robot is stopped.

    Args:
        tell: function that prints a line.
        enable_first: whether to enable the robot once at the start without asking.
        read: function that blocks until a line is typed and returns it; an empty result means that the input has
            ended. None: standard input.
    """

    def __init__(
        self, tell: Callable[[str], None], *, enable_first: bool = False, read: Callable[[], bytes] | None = None
    ) -> None:
        self._tell, self._first = tell, enable_first
        self._read = _standard_input if read is None else read
        self._typed: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        self._ended = False
        self._asked: tuple[str, bool] = ("", False)
        # a thread, because not every system can read standard input without blocking
        threading.Thread(target=self._reading, daemon=True).start()

    def reset(self) -> None:
        """Forget the last problem, which has ended, so that the user is asked about the next problem."""
        self._first, self._asked = False, ("", False)

    def __call__(self, problem: str, stopped: bool) -> bool:
        """Return whether a stopped robot may move again.

        Args:
            problem: why the robot cannot be controlled.
            stopped: whether the robot is stopped and must be enabled.

        Raises:
            TaskFailedError: when the robot is stopped and nobody can answer.
        """
        self._first = self._first and problem != OTHER_CLIENT  # never takes over from another client
        if self._first:
            return stopped
        if (problem, stopped) != self._asked:
            self._asked = (problem, stopped)
            self._taken()
            question = ". If the workspace is clear, press Enter to enable the robot" if stopped else ""
            self._tell(f"the robot cannot be controlled: {problem}{question}")
            return False
        if stopped and self._ended:
            raise TaskFailedError(
                f"the robot is stopped: {problem}; it cannot be enabled without a terminal. Run this command in a "
                "terminal, or start it with --enable"
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
    """Block until a line is typed and return it; the result is empty if there is no terminal input."""
    try:
        if os.isatty(0) and hasattr(os, "tcgetpgrp") and os.tcgetpgrp(0) != os.getpgrp():
            return b""  # in the background, where reading would suspend the process
        return os.read(0, 4096)
    except OSError:
        return b""
