"""Reading an arm, and the tool it holds, from MJCF or URDF files: the packaged ones and any other."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from xml.etree import ElementTree

import mujoco
import numpy as np
from numpy.typing import NDArray

from imitarm.errors import FileFormatError, InputError, UnknownNameError

Array = NDArray[np.float64]

ARMS: Mapping[str, str] = {"panda": "panda.xml", "sawyer": "sawyer.xml"}
"""Packaged arms and their files."""
TOOLS: Mapping[str, str] = {"brush": "brush.xml", "gripper": "gripper.xml"}
"""Packaged tools and their files."""

TOOL_PREFIX = "tool/"
"""Stands before every name that comes from a tool's file, except its site ``tool``."""

DEFAULT_MAX_VELOCITY = 2.0  # [rad/s] or, for a slide, a tenth of it [m/s]: where a file says nothing
DEFAULT_MAX_ACCELERATION = 10.0  # [rad/s^2] or a tenth of it [m/s^2]: where a file says nothing
_HINGE, _SLIDE = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)


@dataclass(frozen=True, eq=False)
class ArmFile:
    """What was read: a spec with the tool attached, and the figures that MuJoCo has no place for.

    Attributes:
        name: of the arm.
        spec: with sites ``flange`` and, with a tool, ``tool``.
        joints: names of the joints from base to flange, in order.
        max_velocity: by joint [rad/s] or [m/s].
        max_acceleration: by joint [rad/s^2] or [m/s^2].
        max_torque: by joint [N m] or [N]; inf when the file names none.
        home: positions by name of every joint, those of the tool included.
        tool_radius: of the cylinder about the tool axis that holds the tool's head [m]; 0 without a tool.
    """

    name: str
    spec: mujoco.MjSpec
    joints: tuple[str, ...]
    max_velocity: Array
    max_acceleration: Array
    max_torque: Array
    home: Mapping[str, float]
    tool_radius: float


def read_arm(source: str | Path, tool: str | Path | None, flange: str | None, discard_meshes: bool) -> ArmFile:
    """Read an arm and attach a tool to its flange.

    Args:
        source: ``"sawyer"``, ``"panda"`` or the path of an MJCF or URDF file.
        tool: ``"gripper"``, ``"brush"``, the path of an MJCF file with a site ``tool``, or None.
        flange: body or site that is the flange; None: a site ``flange``, or the last body of the longest chain.
        discard_meshes: read the file without its meshes.

    Raises:
        UnknownNameError: when the name is neither a packaged one nor a file.
        FileFormatError: when the file can't be read as a robot.
        InputError: when it has no joint, or the flange or the tool is not what was asked for.
    """
    path = _located(source, ARMS, "robot")
    spec = _read_spec(path, discard_meshes)
    spec_home = _keyframe(spec)
    chain = _flange_and_joints(spec, flange, path)
    limits = _limits(spec, path, chain)
    tool_radius = 0.0
    if tool is not None:
        tool_radius = _attach(spec, _located(tool, TOOLS, "tool"))
    home = _home(spec, spec_home)
    name = Path(source).stem if str(source) not in ARMS else str(source)
    return ArmFile(name, spec, chain, *limits, home, tool_radius)


def compiled(spec: mujoco.MjSpec, what: object) -> mujoco.MjModel:
    """Compile a copy of ``spec``.

    Raises:
        FileFormatError: with MuJoCo's own words and what to do about the usual cause.
    """
    try:
        return spec.copy().compile()
    except ValueError as error:
        raise FileFormatError(f"{what}: {_explained(str(error))}") from error


def _located(source: str | Path, packaged: Mapping[str, str], kind: str) -> Path:
    """Return the path of a packaged name or of a file."""
    if str(source) in packaged:
        return Path(str(resources.files("imitarm") / "robots" / "models" / packaged[str(source)]))
    path = Path(source).expanduser()
    if path.is_file():
        return path
    if path.is_dir():
        raise InputError(f"{kind} {str(source)!r} is a folder; give the path of one MJCF or URDF file")
    if path.suffix or len(path.parts) > 1:
        raise InputError(f"{kind}: no such file: {path}")
    known = UnknownNameError.among(kind, str(source), packaged)
    raise UnknownNameError(f"{known}; the path of an MJCF or URDF file will do as well")


def _read_spec(path: Path, discard_meshes: bool) -> mujoco.MjSpec:
    """Parse ``path``; fixed links of a URDF stay bodies of their own, so that a flange can be found among them."""
    try:
        root = ElementTree.parse(path).getroot()
    except (ElementTree.ParseError, UnicodeDecodeError) as error:
        raise FileFormatError(f"{path}: not an XML file ({error}); an MJCF or URDF file was expected") from error
    if root.tag not in {"mujoco", "robot"}:
        raise FileFormatError(f"{path}: root element is <{root.tag}>; MJCF has <mujoco>, URDF has <robot>")
    try:
        spec = mujoco.MjSpec.from_file(str(path))
    except ValueError as error:
        raise FileFormatError(f"{path}: {_explained(str(error))}") from error
    spec.compiler.fusestatic = False
    if discard_meshes:
        for geom in list(spec.geoms):
            if geom.type in {mujoco.mjtGeom.mjGEOM_MESH, mujoco.mjtGeom.mjGEOM_SDF, mujoco.mjtGeom.mjGEOM_HFIELD}:
                spec.delete(geom)
        for asset in [*spec.meshes, *spec.hfields, *spec.skins]:
            spec.delete(asset)
    compiled(spec, path)
    return spec


def _explained(message: str) -> str:
    """Add the remedy to MuJoCo's message."""
    message = " ".join(message.split())
    if "opening file" in message or "mesh" in message.lower():
        return f"{message}; a mesh is missing or unreadable: put it there, or load with discard_meshes=True"
    if "mass" in message or "inertia" in message:
        return f"{message}; every moving link needs a mass and an inertia"
    return message


def _flange_and_joints(spec: mujoco.MjSpec, flange: str | None, path: Path) -> tuple[str, ...]:
    """Make sure of a site ``flange`` and return the names of the joints from the base to it."""
    site = spec.site(flange or "flange")
    body = site.parent if site is not None else spec.body(flange) if flange else _last_body(spec)
    if body is None:
        raise UnknownNameError.among(f"flange in {path}: body or site", flange, _names(spec))
    if site is None or site.name != "flange":
        former = spec.site("flange")
        if former is not None:  # the file has a flange of its own; the one that was asked for counts
            former.name = "former_flange"
        pose = {} if site is None else {"pos": site.pos, "quat": site.quat}
        body.add_site(name="flange", group=4, **pose)
    joints: list[mujoco.MjsJoint] = []
    while body is not None and body.name != "world":
        joints[:0] = list(body.joints)
        body = body.parent
    if not joints:
        raise InputError(f"{path}: no joint between the base and the flange; name another one with flange=...")
    for index, joint in enumerate(joints):
        if int(joint.type) not in {_HINGE, _SLIDE}:
            raise InputError(f"{path}: joint {joint.name!r} is neither a hinge nor a slide; fix the base of the arm")
        joint.name = joint.name or f"joint{index + 1}"
    return tuple(joint.name for joint in joints)


def _names(spec: mujoco.MjSpec) -> list[str]:
    return [item.name for item in [*spec.bodies, *spec.sites] if item.name and item.name != "world"]


def _last_body(spec: mujoco.MjSpec) -> mujoco.MjsBody | None:
    """Follow the longest chain of joints; where two equally long ones part (fingers), the chain ends."""

    def depth(body: mujoco.MjsBody) -> int:
        return len(body.joints) + max((depth(child) for child in body.bodies), default=0)

    body = spec.worldbody
    while True:
        children = list(body.bodies)
        jointed = sorted((child for child in children if depth(child)), key=depth, reverse=True)
        if not jointed:
            if len(children) != 1:
                return None if body.name == "world" else body
            body = children[0]  # a fixed link at the end, such as a flange without a mass
        elif len(jointed) > 1 and depth(jointed[0]) == depth(jointed[1]):
            return None if body.name == "world" else body
        else:
            body = jointed[0]


def _limits(spec: mujoco.MjSpec, path: Path, joints: tuple[str, ...]) -> tuple[Array, Array, Array]:
    """Return the limits of velocity, acceleration and torque, from wherever the format keeps them."""
    model = compiled(spec, path)
    scale = np.array([1.0 if model.joint(j).type[0] == _HINGE else 0.1 for j in joints])
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


def _keyframe(spec: mujoco.MjSpec) -> dict[str, float]:
    """Return joint positions by name of the keyframe ``home``, else of the first one, and remove all keyframes."""
    keys = list(spec.keys)
    chosen = next((key for key in keys if key.name == "home"), keys[0] if keys else None)
    home: dict[str, float] = {}
    if chosen is not None:
        model = spec.copy().compile()
        qpos = model.key(chosen.name).qpos if chosen.name else model.key_qpos[0]
        for joint in range(model.njnt):
            if int(model.jnt_type[joint]) in {_HINGE, _SLIDE}:
                home[model.joint(joint).name] = float(qpos[model.jnt_qposadr[joint]])
    for key in keys:  # their lengths would be wrong once a tool with joints is attached
        spec.delete(key)
    return home


def _home(spec: mujoco.MjSpec, given: Mapping[str, float]) -> dict[str, float]:
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
            home[name] = float(high) if name.startswith(TOOL_PREFIX) else 0.5 * float(low + high)
    return home


def _attach(spec: mujoco.MjSpec, path: Path) -> float:
    """Attach the tool in ``path`` to the flange (turned as the site ``tool_mount`` says) and return its radius."""
    tool = _read_spec(path, discard_meshes=False)
    if tool.site("tool") is None:
        raise InputError(f"{path}: a tool needs a site named 'tool' at its tip, z pointing away from the flange")
    for key in list(tool.keys):
        tool.delete(key)
    radius = tool.numeric("tool_radius")
    for site in spec.sites:
        if site.name == "tool":  # the file has a tool of its own; the one that was asked for counts
            site.name = "former_tool"
    spec.attach(tool, prefix=TOOL_PREFIX, site=spec.site("tool_mount") or spec.site("flange"))
    spec.site(f"{TOOL_PREFIX}tool").name = "tool"
    return 0.0 if radius is None else float(radius.data[0])


def quiet(spec: mujoco.MjSpec, unwanted: Callable[[mujoco.MjsGeom], bool]) -> mujoco.MjSpec:
    """Return a copy of ``spec`` without the geoms that are ``unwanted``."""
    copy = spec.copy()
    for geom in list(copy.geoms):
        if unwanted(geom):
            copy.delete(geom)
    return copy
