"""The figures in an arm's file: limits of the joints from wherever a format keeps them, and the home posture."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from xml.etree import ElementTree

import mujoco
import numpy as np
from numpy.typing import NDArray

from imitarm.errors import FileFormatError

Array = NDArray[np.float64]

DEFAULT_MAX_VELOCITY = 2.0  # [rad/s] or, for a slide, a tenth of it [m/s]: where a file says nothing
DEFAULT_MAX_ACCELERATION = 10.0  # [rad/s^2] or a tenth of it [m/s^2]: where a file says nothing
HINGE, SLIDE = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)


def compiled(spec: mujoco.MjSpec, what: object) -> mujoco.MjModel:
    """Compile a copy of ``spec``.

    Raises:
        FileFormatError: with MuJoCo's own words and what to do about the usual cause.
    """
    try:
        return spec.copy().compile()
    except ValueError as error:
        raise FileFormatError(f"{what}: {explained(str(error))}") from error


def explained(message: str) -> str:
    """Add the remedy to MuJoCo's message."""
    message = " ".join(message.split())
    if "opening file" in message or "mesh" in message.lower():
        return f"{message}; a mesh is missing or unreadable: put it there, or load with discard_meshes=True"
    if "mass" in message or "inertia" in message:
        return f"{message}; every moving link needs a mass and an inertia"
    return message


def read_limits(spec: mujoco.MjSpec, path: Path, joints: tuple[str, ...]) -> tuple[Array, Array, Array]:
    """Return the limits of velocity, acceleration and torque, from wherever the format keeps them."""
    model = compiled(spec, path)
    scale = np.array([1.0 if model.joint(j).type[0] == HINGE else 0.1 for j in joints])
    velocity, acceleration = DEFAULT_MAX_VELOCITY * scale, DEFAULT_MAX_ACCELERATION * scale
    torque = np.array([_torque_limit(model, joint) for joint in joints])
    for name, values in (("max_velocity", velocity), ("max_acceleration", acceleration)):
        numeric = spec.numeric(name)
        if numeric is None:
            continue
        if len(numeric.data) != len(joints) or not np.all(np.asarray(numeric.data) > 0.0):
            raise FileFormatError(f"{path}: numeric {name!r} needs {len(joints)} positive values, one for each joint")
        values[:] = numeric.data
    for joint in ElementTree.parse(path).getroot().iter("joint"):  # what MuJoCo drops from a URDF
        limit, name = joint.find("limit"), joint.get("name", "")
        if limit is not None and name in joints:
            for key, values in (("velocity", velocity), ("effort", torque)):
                if float(limit.get(key, 0.0)) > 0.0:
                    values[joints.index(name)] = float(limit.get(key, 0.0))
    return velocity, acceleration, torque


def _torque_limit(model: mujoco.MjModel, name: str) -> float:
    """Return the joint's own force range, else that of its actuator, else inf."""
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


def taken_keyframe(spec: mujoco.MjSpec) -> dict[str, float]:
    """Return joint positions by name of the keyframe ``home``, else of the first one, and remove all keyframes."""
    keys = list(spec.keys)
    chosen = next((key for key in keys if key.name == "home"), keys[0] if keys else None)
    home: dict[str, float] = {}
    if chosen is not None:
        model = spec.copy().compile()
        qpos = model.key(chosen.name).qpos if chosen.name else model.key_qpos[0]
        for joint in range(model.njnt):
            if int(model.jnt_type[joint]) in {HINGE, SLIDE}:
                home[model.joint(joint).name] = float(qpos[model.jnt_qposadr[joint]])
    for key in keys:  # their lengths would be wrong once a tool with joints is attached
        spec.delete(key)
    return home


def completed_home(spec: mujoco.MjSpec, given: Mapping[str, float], tool_prefix: str) -> dict[str, float]:
    """Complete a posture: joints without a value stand in the middle of their range, fingers are open."""
    model = spec.copy().compile()
    home: dict[str, float] = {}
    for index in range(model.njnt):
        name, (low, high) = model.joint(index).name, model.jnt_range[index]
        if name in given:
            home[name] = given[name]
        elif not model.jnt_limited[index]:
            home[name] = 0.0
        else:
            home[name] = float(high) if name.startswith(tool_prefix) else 0.5 * float(low + high)
    return home
