"""The options that select a robot arm; they are the same in every command."""

from __future__ import annotations

import argparse

from imitarm.cli.screen import remark
from imitarm.errors import InputError
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.arm_file import ARMS, TOOLS

DEFAULT_ROBOT = "sawyer"


def add_robot_options(parser: argparse.ArgumentParser, *, default: str | None = DEFAULT_ROBOT) -> None:
    """Add ``--robot``, ``--tool``, ``--flange``, ``--package-path`` and ``--discard-meshes``.

    Args:
        parser: parser of the command.
        default: robot to use if ``--robot`` is not given; None for a command that does not require a robot.
    """
    group = parser.add_argument_group("the robot arm")
    group.add_argument(
        "--robot",
        metavar="NAME",
        default=default,
        help=f"{', '.join(sorted(ARMS))}, or a URDF or MJCF file; default: {default or 'none'}",
    )
    group.add_argument(
        "--tool", metavar="NAME", help=f"tool at the flange: {', '.join(sorted(TOOLS))}, or an MJCF file; default: none"
    )
    group.add_argument(
        "--flange", metavar="NAME", help="body or site in the file that is the flange; default: the end of the arm"
    )
    group.add_argument(
        "--package-path",
        metavar="FOLDER",
        action="append",
        default=[],
        help="folder to search for ROS packages and meshes that the file names; may be given several times",
    )
    group.add_argument(
        "--discard-meshes", action="store_true", help="ignore all meshes; contact is checked with primitive shapes only"
    )


def load_robot(arguments: argparse.Namespace) -> ArmModel:
    """Load the arm that the options select, and print the assumptions about values that its file does not define.

    Raises:
        InputError: if another option needs a robot but none is named, or the robot can't be loaded.
    """
    arm = load_optional_robot(arguments)
    if arm is None:
        raise InputError("name a robot with --robot")
    return arm


def load_optional_robot(arguments: argparse.Namespace) -> ArmModel | None:
    """Load the arm as :func:`load_robot` does; return None if no robot is named.

    Raises:
        InputError: if another option needs a robot but none is named, or the robot can't be loaded.
    """
    if arguments.robot is None:
        for option in ("tool", "flange", "package_path", "discard_meshes"):
            if getattr(arguments, option):
                raise InputError(f"--{option.replace('_', '-')} needs --robot: name the arm to which it applies")
        return None
    arm = ArmModel.load(
        arguments.robot,
        tool=arguments.tool,
        flange=arguments.flange,
        package_path=arguments.package_path,
        discard_meshes=arguments.discard_meshes,
    )
    for note in arm.notes:
        remark(f"note: {arm.name}: {note}")
    return arm


def robot_files(arguments: argparse.Namespace) -> list[tuple[str, str | None]]:
    """Return the options that may name an input file, with their values, so that no output overwrites this file."""
    return [("--robot", arguments.robot), ("--tool", arguments.tool)]
