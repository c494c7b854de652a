"""Find the joints in a file that belong to the arm, and read their limits and their home positions."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from imitarm.errors import FileFormatError, InputError
from imitarm.files.xml_tree import XmlElement
from imitarm.kinematics.arm_home import usable_posture

Array = NDArray[np.float64]

DEFAULT_MAX_VELOCITY = 2.0  # [rad/s] or, for a slide, a tenth of it [m/s]: assumed where a file has no limit
DEFAULT_MAX_ACCELERATION = 10.0  # [rad/s^2] or a tenth of it [m/s^2]: assumed where a file has no limit
HINGE, SLIDE = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)
FREE = int(mujoco.mjtJoint.mjJNT_FREE)

_HAND_JOINT = re.compile(r"gripper|finger|jaw|knuckle|thumb|claw|pincer|pinch", re.IGNORECASE)
_WRIST_JOINT = re.compile(r"roll|pitch|yaw|rot|wrist|swivel", re.IGNORECASE)  # it turns the whole gripper
_HAND_LINK = re.compile(r"finger|jaw|knuckle|thumb|claw|pincer|pinch", re.IGNORECASE)
_PALM_LINK = re.compile(r"base|mount|palm|body|hand", re.IGNORECASE)
_END_LINK = re.compile(r"(^|[_/-])(tool0|flange)$", re.IGNORECASE)
_JAW_STROKE = 0.1  # [m] a slide at the end of an arm that moves no further is taken for a jaw
_FASTEST = 25.0  # [rad/s] no joint of an arm is faster
_LEAST_RANGE = 1e-6  # [rad] or [m] a joint with a smaller range can't move
_LONG_ARM = 5  # joints: a fork behind so many is a hand; behind fewer joints, only if its branches are equally long
_SIDE_BRANCH = 2  # joints: a branch of at most so many beside one more than twice as long is no arm (a head, a wheel)


@dataclass(frozen=True, eq=False)
class FileLimits:
    """Limits of an arm's joints, each of shape (n_joints,).

    Attributes:
        velocity: largest speed [rad/s] or [m/s].
        acceleration: largest acceleration [rad/s^2] or [m/s^2].
        torque: largest torque [N m] or force [N]; inf where the file has no limit.
        notes: assumptions about values that the file does not define.
    """

    velocity: Array
    acceleration: Array
    torque: Array
    notes: tuple[str, ...]


# Which joints belong to the arm


@dataclass(frozen=True, eq=False)
class _Limb:
    """A chain of joints that could be the arm, and the body at its end."""

    end: mujoco.MjsBody
    joints: tuple[str, ...]


def arm_end(spec: mujoco.MjSpec, path: Path) -> tuple[mujoco.MjsBody, list[str]]:
    """Return the last body of the only arm in ``spec``, and notes on the bodies that were left out.

    The arm ends before the jaws or fingers of a hand. Jaws and fingers are recognised by joint names such as jaw or
    finger, or as parallel joints coupled to each other (mimic joints). A short slide at the end also counts as a jaw.
    Several short chains that branch off at the end of a longer chain count as fingers if they are equally long. If the
    longer chain has at least five joints, their lengths may differ. A short branch beside a much longer chain, such as
    a head or a wheel, is left out.

    Raises:
        InputError: when no joint moves a body, or when several chains could be the arm; the message lists them.
    """
    notes: list[str] = []
    hand = _hand_joints(spec)
    limbs = _limbs(spec.worldbody, (), hand, notes)
    if hand and limbs:
        notes.insert(0, f"not part of the arm: {_listed(sorted(hand))} (gripper)")
    if not limbs:  # a file that holds nothing but a gripper
        notes.clear()
        limbs = _limbs(spec.worldbody, (), frozenset(), notes)
    if not limbs:
        raise InputError(
            f"{path}: has no joint that moves a body, so it is not an arm; give an arm's MJCF or URDF file"
        )
    if len(limbs) > 1:
        choices = "; ".join(
            f"{limb.end.name!r} ({len(limb.joints)} joint{'s' * (len(limb.joints) > 1)}: {limb.joints[0]} to "
            f"{limb.joints[-1]})"
            for limb in limbs
        )
        raise InputError(
            f"{path}: has several limbs, and only one can be the arm. Name its flange with flange=... (--flange on the "
            f"command line); candidates: {choices}"
        )
    return limbs[0].end, notes


def _limbs(body: mujoco.MjsBody, before: tuple[str, ...], hand: frozenset[str], notes: list[str]) -> list[_Limb]:
    """Return the chains through ``body`` that could be an arm; ``before`` are the joints between base and ``body``."""
    own = [joint.name for joint in body.joints]
    if hand.intersection(own):
        return []
    joints = (*before, *own)
    branches = [_limbs(child, joints, hand, notes) for child in body.bodies]
    branches = [limbs for limbs in branches if any(len(limb.joints) > len(joints) for limb in limbs)]
    if not branches:
        return [_Limb(_last_fixed(body), joints)] if joints else []
    depths = [max(len(limb.joints) for limb in limbs) - len(joints) for limbs in branches]
    longest = max(depths)
    fingers = len(joints) >= _LONG_ARM or min(depths) == longest
    if len(branches) > 1 and len(joints) >= 2 and longest < len(joints) and fingers:
        notes.append(f"not part of the arm: the {len(branches)} chains that branch off at {body.name!r} (a hand)")
        return [_Limb(body, joints)]
    is_arm = [depth > _SIDE_BRANCH or longest <= 2 * depth for depth in depths]
    left_out = [
        name
        for limbs, kept in zip(branches, is_arm, strict=True)
        if not kept
        for limb in limbs
        for name in limb.joints[len(joints) :]
    ]
    if left_out:
        notes.append(f"not part of the arm: {_listed(left_out)} (a short branch at {body.name!r})")
    return [limb for limbs, kept in zip(branches, is_arm, strict=True) if kept for limb in limbs]


def _last_fixed(body: mujoco.MjsBody) -> mujoco.MjsBody:
    """Return the last of the fixed links that follow ``body``; at a branch, follow the link named tool0 or flange."""
    while True:
        fixed = [child for child in body.bodies if not list(child.joints)]
        named = [child for child in fixed if _END_LINK.search(child.name)]
        chosen = named if len(named) == 1 else fixed
        if len(chosen) != 1:
            return body
        body = chosen[0]


def _hand_joints(spec: mujoco.MjSpec) -> frozenset[str]:
    """Return the joints of jaws and fingers: joints that move nothing but jaws and fingers."""
    owners = {joint.name: body for body in spec.bodies for joint in body.joints}
    prefix = len(os.path.commonprefix(list(owners))) if len(owners) > 1 else 0  # noqa: RUF071 (names, not paths)
    suspects = {name for name, body in owners.items() if _is_hand_name(name[prefix:], body.name)}
    suspects |= _parallel_mimics(spec, owners)
    suspects |= {name for name, body in owners.items() if _is_short_slide(name, body)}
    while True:  # a joint that moves an ordinary joint is none of a hand
        wrong = {name for name in suspects if not suspects.issuperset(_joints_below(owners[name]))}
        if not wrong:
            return frozenset(suspects)
        suspects -= wrong


def _is_hand_name(joint: str, link: str) -> bool:
    if _HAND_JOINT.search(joint) and not _WRIST_JOINT.search(joint):
        return True
    return bool(_HAND_LINK.search(link)) and not _PALM_LINK.search(link) and not _WRIST_JOINT.search(joint)


def _is_short_slide(name: str, body: mujoco.MjsBody) -> bool:
    """Return whether a joint is a slide with the stroke of a jaw, at the end of a chain of four or more hinges."""
    joint = next(joint for joint in body.joints if joint.name == name)
    stroke = float(joint.range[1] - joint.range[0])
    if int(joint.type) != SLIDE or not 0.0 < stroke <= _JAW_STROKE or len(_joints_below(body)) > 1:
        return False
    return sum(int(above.type) == HINGE for above in chain_to(body)) >= 4


def _parallel_mimics(spec: mujoco.MjSpec, owners: Mapping[str, mujoco.MjsBody]) -> set[str]:
    """Return each group of coupled joints in which at least two joints are on parallel branches, like fingers."""
    groups: list[set[str]] = []
    for follower, leader in mimics(spec):
        touched = [group for group in groups if group & {follower, leader}]
        groups = [group for group in groups if group not in touched]
        groups.append({follower, leader}.union(*touched))
    found: set[str] = set()
    for group in groups:
        below = {name: set(_joints_below(owners[name])) for name in group if name in owners}
        if any(a not in below[b] and b not in below[a] for a in below for b in below):
            found |= set(below)
    return found


def mimics(spec: mujoco.MjSpec) -> dict[tuple[str, str], tuple[float, float]]:
    """Return every coupling of two joints as {(follower, leader): (offset, linear factor)}."""
    return {
        (equality.name1, equality.name2): (float(equality.data[0]), float(equality.data[1]))
        for equality in spec.equalities
        if equality.type == mujoco.mjtEq.mjEQ_JOINT and equality.active and equality.name2
    }


def chain_to(body: mujoco.MjsBody) -> list[mujoco.MjsJoint]:
    """Return the joints from the base to ``body``, in order."""
    joints: list[mujoco.MjsJoint] = []
    while body is not None and body.name != "world":
        joints[:0] = list(body.joints)
        body = body.parent
    return joints


def _joints_below(body: mujoco.MjsBody) -> set[str]:
    """Return the names of all joints of ``body`` and of the bodies that it carries."""
    names: set[str] = set()
    pending = [body]
    while pending:
        link = pending.pop()
        names |= {joint.name for joint in link.joints}
        pending += list(link.bodies)
    return names


def check_joints(spec: mujoco.MjSpec, joints: list[mujoco.MjsJoint], path: Path, root: XmlElement) -> None:
    """Reject joints that an arm can't have: joints other than hinges and slides, and coupled joints.

    Raises:
        InputError: when the arm has such a joint; the message names the joint and its line.
    """
    names = [joint.name for joint in joints]
    for joint in joints:
        if int(joint.type) == FREE:
            lines = [e.line for e in root.walk() if e.tag == "body" and e.get("name") == joint.parent.name]
            line = f" (line {lines[0]})" if lines else ""
            raise InputError(
                f"{path}: body {joint.parent.name!r}{line} floats on a free joint: the base moves. imitarm "
                "needs an arm on a fixed base: remove the <freejoint/>"
            )
        if int(joint.type) not in {HINGE, SLIDE}:
            raise InputError(
                f"{place(path, root, joint.name)} is a ball joint; the joints of an arm must be hinges or slides: "
                "model it as three hinges"
            )
    for follower, leader in mimics(spec):
        if follower in names or leader in names:
            raise InputError(
                f"{place(path, root, follower)} mimics joint {leader!r}, but imitarm commands every joint of an arm "
                "separately. If the robot takes a command for each of the two joints, remove the coupling (<mimic> or "
                "<equality>); otherwise name a flange between the base and these joints with flange=... (--flange on "
                "the command line)"
            )


def place(path: Path, root: XmlElement, joint: str) -> str:
    """Return the name of a joint for messages: file, joint and, if it is defined in this file, line."""
    line = next((f" (line {e.line})" for e in root.walk() if e.tag == "joint" and e.get("name") == joint), "")
    return f"{path}: joint {joint!r}{line}"


# Limits


def read_limits(
    spec: mujoco.MjSpec, model: mujoco.MjModel, joints: tuple[str, ...], path: Path, root: XmlElement
) -> FileLimits:
    """Return the velocity, acceleration and torque limits, and check the position limits.

    Args:
        spec: content of the file as read by MuJoCo.
        model: the compiled ``spec``.
        joints: names of the arm's joints.
        path: path of the file, for messages.
        root: the elements of the file itself, which include values that MuJoCo drops from a URDF.

    Raises:
        FileFormatError: when a limit can't be used; the message names the joint and its line.
    """
    scale = np.array([1.0 if model.joint(name).type[0] == HINGE else 0.1 for name in joints])
    velocity, acceleration = np.full(len(joints), np.nan), DEFAULT_MAX_ACCELERATION * scale
    torque = np.array([_torque_limit(model, name) for name in joints])
    for name, values in (("max_velocity", velocity), ("max_acceleration", acceleration)):
        numeric = spec.numeric(name)
        if numeric is None:
            continue
        if len(numeric.data) != len(joints) or not np.all(np.asarray(numeric.data) > 0.0):
            raise FileFormatError(
                f"{path}: <numeric name={name!r}> needs {len(joints)} positive values in data, one for each joint"
            )
        values[:] = numeric.data
    if root.tag == "robot":
        for element in root.all("joint"):
            if element.get("name") in joints:
                index = joints.index(element.get("name"))
                velocity[index], torque[index] = _urdf_limits(element, place(path, root, joints[index]))
    notes = []
    fast = [name for name, v, one in zip(joints, velocity, scale, strict=True) if one == 1.0 and v > _FASTEST]
    if fast:
        notes.append(
            f"velocity limit above {_FASTEST:g} rad/s for {_located(fast, joints, root)}: no arm is so fast; if the "
            "file's limits are in degrees, convert them to radians"
        )
    if np.isnan(velocity).any():
        assumed = [name for name, value in zip(joints, velocity, strict=True) if np.isnan(value)]
        speeds = " and ".join(
            text
            for kind, text in ((1.0, f"{DEFAULT_MAX_VELOCITY:g} rad/s"), (0.1, f"{0.1 * DEFAULT_MAX_VELOCITY:g} m/s"))
            if (scale[np.isnan(velocity)] == kind).any()
        )
        notes.append(f"no velocity limit in the file for {_located(assumed, joints, root)}: {speeds} assumed")
        velocity = np.where(np.isnan(velocity), DEFAULT_MAX_VELOCITY * scale, velocity)
    if np.isinf(torque).any():
        free = [name for name, value in zip(joints, torque, strict=True) if np.isinf(value)]
        notes.append(f"no torque limit in the file for {_located(free, joints, root)}: assumed to be unlimited")
    return FileLimits(velocity, acceleration, torque, tuple(notes))


def _urdf_limits(joint: XmlElement, where: str) -> tuple[float, float]:
    """Return the limits of a URDF joint: velocity (nan if missing) and effort (inf if missing).

    A velocity or effort of 0 counts as missing, because exporters write 0 for values that were not filled in.
    """
    limit = joint.find("limit")
    kind = joint.get("type")
    if kind in {"revolute", "prismatic"}:
        free = ", or make it continuous" if kind == "revolute" else ""
        if limit is None or not limit.attributes.keys() & {"lower", "upper"}:
            raise FileFormatError(f"{where} is {kind} but has no limits; add <limit lower=... upper=.../>{free}")
        for key, other in (("lower", "upper"), ("upper", "lower")):
            if key not in limit.attributes:
                raise FileFormatError(f"{where} has the limit {other}, but not {key}; add {key}=... to <limit>{free}")
        lower, upper = (_limit(limit, key, where) or 0.0 for key in ("lower", "upper"))
        if lower > upper:
            raise FileFormatError(f"{where}: lower limit {lower:g} is above upper limit {upper:g}; exchange them")
        if upper - lower < _LEAST_RANGE:
            raise FileFormatError(
                f"{where}: lower and upper limit are both {lower:g}, so it can't move; write the true limits{free}, or "
                "make it fixed"
            )
    velocity, effort = (0.0 if limit is None else _limit(limit, key, where) or 0.0 for key in ("velocity", "effort"))
    for key, value in (("velocity", velocity), ("effort", effort)):
        if value < 0.0:
            raise FileFormatError(f"{where}: {key} limit {value:g} is negative; write its magnitude")
    return velocity or math.nan, effort or math.inf


def _limit(limit: XmlElement, key: str, where: str) -> float | None:
    """Return the number in the attribute ``key`` of a ``<limit>``; None if this attribute is missing."""
    if key not in limit.attributes:
        return None
    try:
        value = float(limit.get(key))
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise FileFormatError(
            f"{where}: {key}={limit.get(key)!r} in line {limit.line} is not a finite number; write one, or leave the "
            "attribute out if there is no such limit"
        )
    return value


def _torque_limit(model: mujoco.MjModel, name: str) -> float:
    """Return the torque limit of a joint: from its own force range, else from its actuator, else inf."""
    joint = model.joint(name).id
    if model.jnt_actfrclimited[joint]:
        return float(np.max(np.abs(model.jnt_actfrcrange[joint])))
    for actuator in range(model.nu):
        transmission = model.actuator_trntype[actuator]
        if transmission == mujoco.mjtTrn.mjTRN_JOINT and model.actuator_trnid[actuator, 0] == joint:
            gear = abs(float(model.actuator_gear[actuator, 0]))
            if model.actuator_forcelimited[actuator]:
                return gear * float(np.max(np.abs(model.actuator_forcerange[actuator])))
            if model.actuator_ctrllimited[actuator] and not model.actuator_biastype[actuator]:  # a plain motor
                gain = abs(float(model.actuator_gainprm[actuator, 0]))
                return gear * gain * float(np.max(np.abs(model.actuator_ctrlrange[actuator])))
    return math.inf


def _located(names: list[str], all_names: tuple[str, ...], root: XmlElement) -> str:
    """Return ``names`` with their lines in the file, or "any joint" if ``names`` contains all joints."""
    if len(names) == len(all_names):
        return "any joint"
    lines = {e.get("name"): e.line for e in reversed(list(root.walk())) if e.tag == "joint"}
    return ", ".join(f"{name} (line {lines[name]})" if name in lines else name for name in names)


def _listed(names: list[str]) -> str:
    return ", ".join(names) if len(names) <= 6 else f"{', '.join(names[:5])} and {len(names) - 5} more"


# Home


def take_keyframe(spec: mujoco.MjSpec, model: mujoco.MjModel) -> tuple[dict[str, float], str]:
    """Return the joint positions of the keyframe ``home``, else of the first keyframe, and the name of that keyframe.

    The function also removes all keyframes from ``spec``.
    """
    keys = list(spec.keys)
    home: dict[str, float] = {}
    index = next((i for i, key in enumerate(keys) if key.name == "home"), 0)
    name = keys[index].name if keys else ""
    if keys:
        for joint in range(model.njnt):
            if int(model.jnt_type[joint]) in {HINGE, SLIDE}:
                home[model.joint(joint).name] = float(model.key_qpos[index, model.jnt_qposadr[joint]])
    for key in keys:  # their lengths would be wrong once a tool with joints is attached
        spec.delete(key)
    return home, name


def check_keyframe(
    home: Mapping[str, float], name: str, model: mujoco.MjModel, joints: tuple[str, ...], path: Path, root: XmlElement
) -> None:
    """Reject a keyframe outside the limits of the arm's joints.

    Raises:
        FileFormatError: when a joint is outside its limits; the message names the keyframe, its line, the joint and its
            limits.
    """
    for joint in joints:
        index = model.joint(joint).id
        low, high = model.jnt_range[index]
        value = home.get(joint, low)
        if model.jnt_limited[index] and not low - 1e-6 <= value <= high + 1e-6:
            keys = [e for e in root.walk() if e.tag == "key" and e.get("name") == name]
            line = f" (line {keys[0].line})" if keys else ""
            raise FileFormatError(
                f"{place(path, root, joint)} is at {value:.4g} in the keyframe {name!r}{line}, outside its limits "
                f"[{low:.4g}, {high:.4g}]; correct the keyframe, or remove it so that a posture is chosen automatically"
            )


def complete_home(
    spec: mujoco.MjSpec, model: mujoco.MjModel, joints: tuple[str, ...], given: Mapping[str, float], tool_prefix: str
) -> tuple[dict[str, float], tuple[str, ...]]:
    """Return a position for every joint of ``model``, and notes on the choice.

    If ``given`` contains the position of a joint, this position is used. A tool's fingers are open, other joints that
    do not belong to the arm are in the middle of their ranges, and coupled joints follow their leader. The arm's own
    joints are also in the middle of their ranges if this posture is not singular and its links are at least 20 mm
    apart. Otherwise, the function chooses the best of many postures for the arm.
    """
    home: dict[str, float] = {}
    for index in range(model.njnt):
        name, (low, high) = model.joint(index).name, model.jnt_range[index]
        if name in given:
            home[name] = given[name]
        elif not model.jnt_limited[index]:
            home[name] = 0.0
        else:
            home[name] = float(high) if name.startswith(tool_prefix) else 0.5 * float(low + high)
    for (follower, leader), (offset, factor) in mimics(spec).items():
        if follower not in given and follower in home and leader in home:
            home[follower] = offset + factor * home[leader]
    if all(name in given for name in joints):
        return home, ()
    posture, notes = usable_posture(model, joints, home)
    return {**home, **dict(zip(joints, posture.tolist(), strict=True))}, notes
