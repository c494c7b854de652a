"""Reading an arm, and the tool it holds, from MJCF or URDF files: the packaged ones and any other."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from xml.etree import ElementTree

import mujoco
import numpy as np
from numpy.typing import NDArray

from imitarm.errors import FileFormatError, InputError, UnknownNameError
from imitarm.kinematics.arm_limits import HINGE, SLIDE, compiled, completed_home, explained, read_limits, taken_keyframe
from imitarm.kinematics.spheres import COLLISION_GROUP

Array = NDArray[np.float64]

ARMS: Mapping[str, str] = {"panda": "panda.xml", "sawyer": "sawyer.xml"}
"""Packaged arms and their files."""
TOOLS: Mapping[str, str] = {"brush": "brush.xml", "gripper": "gripper.xml"}
"""Packaged tools and their files."""

TOOL_PREFIX = "tool/"
"""Stands before every name that comes from a tool's file, except its site ``tool``."""

_MESHES = {mujoco.mjtGeom.mjGEOM_MESH, mujoco.mjtGeom.mjGEOM_SDF, mujoco.mjtGeom.mjGEOM_HFIELD}


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
    spec_home = taken_keyframe(spec)
    chain = _flange_and_joints(spec, flange, path)
    limits = read_limits(spec, path, chain)
    tool_radius = 0.0
    if tool is not None:
        tool_radius = _attach(spec, _located(tool, TOOLS, "tool"))
    home = completed_home(spec, spec_home, TOOL_PREFIX)
    name = Path(source).stem if str(source) not in ARMS else str(source)
    return ArmFile(name, spec, chain, *limits, home, tool_radius)


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
        raise FileFormatError(f"{path}: {explained(str(error))}") from error
    spec.compiler.fusestatic = False
    for geom in list(spec.geoms):
        unwanted = spec.compiler.discardvisual and not _touches(geom)  # a URDF's, unless it says otherwise
        if unwanted or (discard_meshes and geom.type in _MESHES):
            spec.delete(geom)
    spec.compiler.discardvisual = False  # else a tool would lose its looks too
    used = {geom.meshname for geom in spec.geoms}
    for asset in [*spec.hfields, *spec.skins] if discard_meshes else []:
        spec.delete(asset)
    for mesh in list(spec.meshes):
        if mesh.name not in used:
            spec.delete(mesh)
        elif mesh.file.startswith("package:"):
            mesh.file = _in_package(mesh.file, path)
    _part_contact_from_looks(spec)
    compiled(spec, path)
    return spec


def _in_package(file: str, path: Path) -> str:
    """Find ``package://name/rest`` in a folder ``name`` above the URDF at ``path``; else return it as it is."""
    name, _, rest = file.removeprefix("package:").lstrip("/").partition("/")
    for folder in path.resolve().parents:
        for root in (folder, folder / name):
            if root.name == name and (root / rest).is_file():
                return str(root / rest)
    return file


def _touches(geom: mujoco.MjsGeom) -> bool:
    return bool(geom.contype or geom.conaffinity)


def _part_contact_from_looks(spec: mujoco.MjSpec) -> None:
    """Put every shape that can touch into group 3; a link that would then look like nothing gets a copy in group 2."""
    for body in spec.bodies:
        touching = [geom for geom in body.geoms if _touches(geom)]
        unseen = len(touching) == len(body.geoms)
        for geom in touching:
            if geom.group == COLLISION_GROUP:
                continue
            geom.group = COLLISION_GROUP
            if unseen:
                shape = {key: getattr(geom, key) for key in ("type", "size", "pos", "quat", "fromto", "rgba")}
                names = {"meshname": geom.meshname, "material": geom.material}
                body.add_geom(**shape, **names, group=2, contype=0, conaffinity=0, density=0.0)


def _flange_and_joints(spec: mujoco.MjSpec, flange: str | None, path: Path) -> tuple[str, ...]:
    """Make sure of a site ``flange`` and return the names of the joints from the base to it."""
    site = spec.site(flange or "flange")
    body = site.parent if site is not None else spec.body(flange) if flange else _last_body(spec)
    if body is None and flange is None:
        raise InputError(f"{path}: has no joint that moves a body, so it is no arm; give the MJCF or URDF file of one")
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
        if int(joint.type) not in {HINGE, SLIDE}:
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
