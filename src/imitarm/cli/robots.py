"""``imitarm robots``: list the known arms and tools, or show the joints and limits of one arm."""

from __future__ import annotations

import argparse

import numpy as np

from imitarm.cli.robot_options import add_robot_options, load_robot
from imitarm.cli.screen import say, show_table
from imitarm.demonstrations.plausibility import reach
from imitarm.errors import InputError
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.arm_file import ARMS, TOOLS

EPILOG = """\
examples:
  imitarm robots
  imitarm robots sawyer --tool brush
  imitarm robots my_arm.urdf --flange tool0 --package-path ~/catkin_ws/src
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument(
        "arm", nargs="?", metavar="ARM", help="arm to show, as with --robot; default: list all known arms"
    )
    add_robot_options(parser, default=None)


def run(arguments: argparse.Namespace) -> int:
    """Print one arm, or the list of all arms.

    Raises:
        InputError: if the robot can't be loaded, or two robots are named.
    """
    if arguments.arm is not None:
        if arguments.robot not in (None, arguments.arm):
            raise InputError(f"name one robot: {arguments.arm!r} and --robot {arguments.robot!r} differ")
        arguments.robot = arguments.arm
    if arguments.robot is None:
        _list(arguments.tool)
    else:
        _inspect(load_robot(arguments))
    return 0


def _list(tool: str | None) -> None:
    arms = [ArmModel.load(name, tool=tool) for name in sorted(ARMS)]
    show_table(
        ["arm", "joints>", "reach from the shoulder [m]>", "largest torque [N m]>", "fastest joint [deg/s]>"],
        [
            (
                arm.name,
                str(arm.n_joints),
                f"{reach(arm)[1]:.2f}",
                _figure(float(arm.max_torque.max())),
                f"{np.degrees(arm.max_velocity.max()):.0f}",
            )
            for arm in arms
        ],
    )
    say(
        f"tools: {', '.join(sorted(TOOLS))}",
        "other arms can be loaded from MJCF or URDF files; give the name or file of an arm to see its joints and "
        "limits",
    )


def _inspect(arm: ArmModel) -> None:
    show_table(
        [
            "joint",
            "from [deg]>",
            "to [deg]>",
            "home [deg]>",
            "speed [deg/s]>",
            "acceleration [deg/s2]>",
            "torque [N m]>",
        ],
        [
            (name, *(_figure(float(np.degrees(x))) for x in degrees), _figure(torque))
            for name, *degrees, torque in zip(
                arm.joint_names,
                arm.lower,
                arm.upper,
                arm.home,
                arm.max_velocity,
                arm.max_acceleration,
                arm.max_torque.tolist(),
                strict=True,
            )
        ],
        title=arm.name,
    )
    shoulder, distance = reach(arm)
    tip = "tool" if arm.has_tool else "flange"
    place = " ".join(f"{100 * x:.1f}" for x in shoulder.round(3) + 0.0)
    say(f"the {tip} reaches {100 * distance:.1f} cm from the shoulder, which is at {place} cm in the base frame")
    if arm.has_tool:
        offset = " ".join(f"{100 * x:.1f}" for x in arm.tool_to_flange.position.round(3) + 0.0)
        say(f"the tool's tip is at {offset} cm from the flange")


def _figure(value: float) -> str:
    return "none" if np.isinf(value) else f"{value:.4g}"
