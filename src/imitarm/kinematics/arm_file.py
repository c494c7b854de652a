"""Read an arm and its tool from MJCF or URDF files: packaged files, or the user's own."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from imitarm.errors import FileFormatError, InputError, UnknownNameError
from imitarm.files.xml_tree import XmlElement, read_xml
from imitarm.kinematics.arm_joints import (
    arm_end,
    chain_to,
    check_joints,
    check_keyframe,
    complete_home,
    read_limits,
    take_keyframe,
)
from imitarm.kinematics.arm_xml import check_file, check_key_lengths, check_units, find_meshes
from imitarm.kinematics.spheres import COLLISION_GROUP

Array = NDArray[np.float64]

ARMS: Mapping[str, str] = {"panda": "panda.xml", "sawyer": "sawyer.xml"}
"""Packaged arms and their files."""
TOOLS: Mapping[str, str] = {"brush": "brush.xml", "gripper": "gripper.xml"}
"""Packaged tools and their files."""

TOOL_PREFIX = "tool/"
"""Prefix of every name from a tool's file, except its site ``tool``."""

_MESHES = {mujoco.mjtGeom.mjGEOM_MESH, mujoco.mjtGeom.mjGEOM_SDF, mujoco.mjtGeom.mjGEOM_HFIELD}
_LONGEST_ARM = 15.0  # [m] from the first joint to the last; longer arms are in another unit
_LARGEST = 1e6  # [m], [kg], [kg m^2]
_PLACEHOLDER_MASS, _PLACEHOLDER_INERTIA = 1e-3, 1e-6  # [kg], [kg m^2] of a link whose own can't be used


@dataclass(frozen=True, eq=False)
class ArmFile:
    """An arm as read from its file: a MuJoCo spec with the tool attached, and values that MuJoCo can't store.

    Attributes:
        name: name of the arm.
        spec: spec with a site ``flange`` and, if there is a tool, a site ``tool``.
        joints: names of the joints from base to flange, in order.
        max_velocity: largest speed of each joint [rad/s] or [m/s].
        max_acceleration: largest acceleration of each joint [rad/s^2] or [m/s^2].
        max_torque: largest torque of each joint [N m] or force [N]; inf when the file has no limit.
        home: position of every joint by name, including the joints of the tool.
        tool_radius: radius of the cylinder about the tool's axis that holds the tool's head [m]; 0 without a tool.
        notes: assumptions about values that the file does not define, and joints that were left out.
        mass_faults: one text for each link whose mass or inertia can't be used. With such a link, torques can't be
            computed.
    """

    name: str
    spec: mujoco.MjSpec
    joints: tuple[str, ...]
    max_velocity: Array
    max_acceleration: Array
    max_torque: Array
    home: Mapping[str, float]
    tool_radius: float
    notes: tuple[str, ...]
    mass_faults: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class _Part:
    """The content of one file: an arm or a tool."""

    spec: mujoco.MjSpec
    root: XmlElement
    mass_faults: tuple[str, ...]


def read_arm(
    source: str | Path,
    tool: str | Path | None,
    flange: str | None,
    discard_meshes: bool,
    package_path: Iterable[str | Path] = (),
) -> ArmFile:
    """Read an arm and attach a tool to its flange.

    Args:
        source: ``"sawyer"``, ``"panda"`` or the path of an MJCF or URDF file.
        tool: ``"gripper"``, ``"brush"``, the path of an MJCF file with a site ``tool``, or None.
        flange: body or site that is the flange; None: the site ``flange``; without such a site, the last link of the
            only arm in the file.
        discard_meshes: whether to read the file without its meshes.
        package_path: folders to search for meshes and ROS packages.

    Raises:
        UnknownNameError: when a name is neither a packaged arm or tool nor a file, or when the file contains no such
            flange.
        FileFormatError: when the file can't be read as a robot.
        InputError: when the file has no joint, or the requested flange or tool can't be used.
    """
    path, folders = _located(source, ARMS, "robot"), [Path(folder) for folder in package_path]
    for folder in folders:
        try:
            is_folder = folder.expanduser().is_dir()
        except (OSError, ValueError, RuntimeError):  # a name that no folder can have
            is_folder = False
        if not is_folder:
            raise InputError(
                f"package path {str(folder)[:100]!r} is not a folder; give the folder that holds the ROS packages"
            )
    part = _read_part(path, discard_meshes, folders)
    spec, root, faults = part.spec, part.root, part.mass_faults
    keyframe, key_name = take_keyframe(spec, compiled(spec, path))
    joints, notes = _set_flange(spec, flange, path, root)
    model = compiled(spec, path)
    check_units(model, joints, path, root)
    limits = read_limits(spec, model, joints, path, root)
    check_keyframe(keyframe, key_name, model, joints, path, root)
    tool_radius = 0.0
    if tool is not None:
        tool_part = _read_part(_located(tool, TOOLS, "tool"), False, folders)
        tool_radius = _attach(spec, tool_part.spec, _located(tool, TOOLS, "tool"))
        faults += tool_part.mass_faults
    home, home_notes = complete_home(spec, compiled(spec, path), joints, keyframe, TOOL_PREFIX)
    name = Path(source).stem if str(source) not in ARMS else str(source)
    return ArmFile(
        name,
        spec,
        joints,
        limits.velocity,
        limits.acceleration,
        limits.torque,
        home,
        tool_radius,
        (
            *notes,
            *limits.notes,
            *home_notes,
            *(f"{fault}, so torques and simulation are not available" for fault in faults),
        ),
        faults,
    )


def _located(source: str | Path, packaged: Mapping[str, str], kind: str) -> Path:
    """Return the path of ``source``, which is either a packaged name or itself a path."""
    if str(source) in packaged:
        return Path(str(resources.files("imitarm") / "robots" / "models" / packaged[str(source)]))
    path = Path(source).expanduser()
    try:
        is_file, is_folder = path.is_file(), path.is_dir()
    except (OSError, ValueError) as error:  # a name that no file can have
        raise InputError(f"{kind} {str(source)[:60]!r} can't be a file: {error}") from error
    if is_file:
        return path
    if is_folder:
        raise InputError(f"{kind} {str(source)!r} is a folder; give the path of one MJCF or URDF file")
    if path.suffix or len(path.parts) > 1:
        raise InputError(f"{kind}: no such file: {path}")
    known = UnknownNameError.among(kind, str(source), packaged)
    raise UnknownNameError(f"{known}; or give the path of an MJCF or URDF file")


def _read_part(path: Path, discard_meshes: bool, package_path: list[Path]) -> _Part:
    """Read ``path``; links connected by fixed joints remain separate bodies, because one of them may be the flange."""
    root = read_xml(path, "an MJCF or URDF file")
    check_file(path, root)
    try:
        known = path.suffix.lower() in {".xml", ".urdf"}
        with _no_engine_log():
            spec = mujoco.MjSpec.from_file(str(path)) if known else mujoco.MjSpec.from_string(path.read_text())
    except ValueError as error:
        raise FileFormatError(f"{path}: {_one_line(error)}") from error
    spec.compiler.fusestatic = False
    if root.tag == "robot" and spec.compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO:
        # A URDF's link without <inertial> has no mass; MuJoCo would give it the mass of water of its shape.
        spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_FALSE
    for geom in list(spec.geoms):
        unwanted = spec.compiler.discardvisual and not _touches(geom)  # a URDF's, unless it says otherwise
        if unwanted or (discard_meshes and geom.type in _MESHES):
            spec.delete(geom)
    spec.compiler.discardvisual = False  # else a tool would lose its visual shapes too
    used = {geom.meshname for geom in spec.geoms}
    for asset in [*spec.hfields, *spec.skins] if discard_meshes else []:
        spec.delete(asset)
    for mesh in list(spec.meshes):
        if mesh.name not in used:
            spec.delete(mesh)
    if spec.meshes:
        find_meshes(spec, path, root, package_path)
    _name_all(spec)
    _separate_contact_shapes(spec)
    faults = _replace_unusable_masses(spec, path, root)
    model = compiled(spec, path)
    check_key_lengths(model.nq, path, root)
    _check_sizes(model, path, root)
    return _Part(spec, root, faults)


@contextmanager
def _no_engine_log() -> Iterator[None]:
    """Prevent MuJoCo from writing its warnings into the current folder; this module checks for their causes itself."""
    former = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda message: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(former)


def _check_sizes(model: mujoco.MjModel, path: Path, root: XmlElement) -> None:
    """Reject a model with NaN (possibly from an included file) or with sizes that are implausible for a robot."""
    kinds = {"body": model.body, "jnt": model.joint, "geom": model.geom, "site": model.site}
    for kind, item in kinds.items():
        for field in ("mass", "inertia", "pos", "ipos", "axis", "size"):
            values = getattr(model, f"{kind}_{field}", None)
            if values is None or not len(values):
                continue
            bad = ~(np.abs(values.reshape(len(values), -1)) <= _LARGEST).all(axis=1)
            if bad.any():
                index = int(np.argmax(bad))
                name = item(index).name or model.body(int(getattr(model, f"{kind}_bodyid")[index])).name
                lines = [e.line for e in root.walk() if name and e.get("name") == name]
                what = f"{'joint' if kind == 'jnt' else kind} {name!r}{f' (line {lines[0]})' if lines else ''}"
                raise FileFormatError(
                    f"{path}: {field} of {what} is {values[index]}, which is not plausible for a robot; correct it "
                    "(lengths are in metres, masses in kilograms)"
                )


def _name_all(spec: mujoco.MjSpec) -> None:
    """Name every joint and body that has no name: joint1, joint2, ..., body1, body2, ..."""
    for kind, items in (("joint", list(spec.joints)), ("body", list(spec.bodies)[1:])):
        taken = {item.name for item in items}
        free = (name for i in range(1, 2 * len(items) + 1) if (name := f"{kind}{i}") not in taken)
        for item in items:
            item.name = item.name or next(free)


def _replace_unusable_masses(spec: mujoco.MjSpec, path: Path, root: XmlElement) -> tuple[str, ...]:
    """Insert placeholder values where a link has no usable mass or inertia, so that the kinematics can be built.

    Returns:
        A description of the fault for each such link.
    """
    faults: list[str] = []
    for _ in range(len(spec.bodies)):
        try:
            spec.copy().compile()
        except ValueError as error:
            message = _one_line(error)
            named = re.search(r"Element name '(.*)', id", message)
            body = spec.body(named.group(1)) if named else None
            if body is None or not re.search(r"\b(mass|inertia|fullinertia)\b", message):
                return tuple(faults)  # something else is wrong: compiled() says what
            faults.append(_mass_fault(body, message, root))
            body.explicitinertial, body.mass = True, _PLACEHOLDER_MASS
            body.fullinertia = [math.nan, 0.0, 0.0, 0.0, 0.0, 0.0]
            body.inertia, body.ipos, body.iquat = [_PLACEHOLDER_INERTIA] * 3, [0.0] * 3, [1.0, 0.0, 0.0, 0.0]
        else:
            break
    return tuple(faults)


def _mass_fault(body: mujoco.MjsBody, message: str, root: XmlElement) -> str:
    lines = [e.line for e in root.walk() if e.tag in {"link", "body"} and e.get("name") == body.name]
    where = f"link {body.name!r}" + (f" (line {lines[0]})" if lines else "")
    if "A + B" in message or "eigenvalues" in message:
        return f"{where} has an inertia that no rigid body can have"
    if body.mass < 0.0:
        return f"{where} has a negative mass"
    return f"{where} has no inertia" if body.mass > 0.0 else f"{where} has no mass"


def compiled(spec: mujoco.MjSpec, what: object) -> mujoco.MjModel:
    """Compile a copy of ``spec``.

    Raises:
        FileFormatError: when MuJoCo can't compile the spec; the message quotes MuJoCo's message and adds a remedy for
            the usual cause.
    """
    try:
        return spec.copy().compile()
    except ValueError as error:
        message = _one_line(error)
        if "mesh" in message.lower() or "opening file" in message:
            message += "; a mesh can't be read: replace it, or load with discard_meshes=True (--discard-meshes)"
        raise FileFormatError(f"{what}: {message}") from error


def _one_line(error: Exception) -> str:
    """Return MuJoCo's message in one line, without its remark that static bodies were fused."""
    return " ".join(str(error).split("The static bodies of the spec were fused")[0].split())


def _touches(geom: mujoco.MjsGeom) -> bool:
    return bool(geom.contype or geom.conaffinity)


def _separate_contact_shapes(spec: mujoco.MjSpec) -> None:
    """Put shapes used for contact into group 3; if a link has no other shapes, add copies for drawing in group 2."""
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


def _set_flange(
    spec: mujoco.MjSpec, flange: str | None, path: Path, root: XmlElement
) -> tuple[tuple[str, ...], list[str]]:
    """Add a site ``flange`` if it is missing; return the names of the joints from base to flange, and notes."""
    notes: list[str] = []
    site = spec.site(flange or "flange")
    if site is not None:
        body = site.parent
    elif flange:
        body = spec.body(flange)
    else:
        body, notes = arm_end(spec, path)
    if body is None:
        raise UnknownNameError.among(f"flange in {path}: body or site", flange, _names(spec))
    if site is None or site.name != "flange":
        former = spec.site("flange")
        if former is not None:  # the file has a flange of its own; the requested one takes its place
            former.name = "former_flange"
        pose = {} if site is None else {"pos": site.pos, "quat": site.quat}
        body.add_site(name="flange", group=4, **pose)
    joints = chain_to(body)
    if not joints:
        raise InputError(
            f"{path}: no joint between the base and the flange {flange or body.name!r}; name another flange with "
            "flange=... (--flange on the command line)"
        )
    check_joints(spec, joints, path, root)
    offsets = [float(np.linalg.norm(joint.parent.pos)) for joint in joints[1:]]
    if sum(offsets) > _LONGEST_ARM:
        raise FileFormatError(
            f"{path}: the offsets from the first joint to the last add up to {sum(offsets):.3g} m; lengths must be in "
            "metres, so check whether the file uses millimetres"
        )
    return tuple(joint.name for joint in joints), notes


def _names(spec: mujoco.MjSpec) -> list[str]:
    return [item.name for item in [*spec.bodies, *spec.sites] if item.name and item.name != "world"]


def _attach(spec: mujoco.MjSpec, tool: mujoco.MjSpec, path: Path) -> float:
    """Attach a tool, read from ``path``, to the flange (or to the site ``tool_mount``) and return its radius."""
    if tool.site("tool") is None:
        raise InputError(
            f"{path}: a tool needs a site named 'tool' at its tip, whose z axis points away from the flange"
        )
    for key in list(tool.keys):
        tool.delete(key)
    radius = tool.numeric("tool_radius")
    for site in spec.sites:
        if site.name == "tool":  # the file has a tool of its own; the requested one takes its place
            site.name = "former_tool"
    spec.attach(tool, prefix=TOOL_PREFIX, site=spec.site("tool_mount") or spec.site("flange"))
    spec.site(f"{TOOL_PREFIX}tool").name = "tool"
    return 0.0 if radius is None else float(radius.data[0])


def without_geoms(spec: mujoco.MjSpec, unwanted: Callable[[mujoco.MjsGeom], bool]) -> mujoco.MjSpec:
    """Return a copy of ``spec`` without the geoms for which ``unwanted`` is true."""
    copy = spec.copy()
    for geom in list(copy.geoms):
        if unwanted(geom):
            copy.delete(geom)
    return copy
