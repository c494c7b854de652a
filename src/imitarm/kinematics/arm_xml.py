"""Check the XML of a robot's file before MuJoCo compiles it, and find the meshes.

MuJoCo drops or misreads some wrong entries without a message. Every error message of this module names the element, its
line and the remedy.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path
from xml.etree import ElementTree

import mujoco
import numpy as np

from imitarm.errors import FileFormatError, InputError
from imitarm.files.xml_tree import XmlElement
from imitarm.kinematics.arm_joints import HINGE, place

_NAMES = {
    "name",
    "link",
    "joint",
    "body",
    "site",
    "class",
    "childclass",
    "file",
    "filename",
    "mesh",
    "material",
    "model",
}
_MOST_ROTATION = 25.0  # [rad] limits of a hinge beyond this are degrees
_SHORTEST_AXIS = 1e-9  # an axis shorter than this has no direction
_LEAST_ROTATION = 0.2  # [rad] an arm none of whose hinges moves so far has limits in another unit
_RANGES = ("range", "actuatorfrcrange", "ctrlrange", "forcerange")
_MESHES = {".stl", ".obj", ".msh"}
_OTHER_MESHES = {
    ".dae": "COLLADA", ".glb": "glTF", ".gltf": "glTF", ".ply": "PLY", ".fbx": "FBX", ".3ds": "3DS", ".step": "STEP",
    ".stp": "STEP", ".iges": "IGES", ".wrl": "VRML", ".iv": "Open Inventor", ".mesh": "OGRE", ".off": "OFF",
}  # fmt: skip
_LEVELS = 4  # folders below a package path, and above the robot's file, in which packages are looked for
_MOST_FOLDERS = 300  # of one folder that are looked into


# Wrong entries


def check_file(path: Path, root: XmlElement) -> None:
    """Reject a file that is not the MJCF or URDF of an arm, and faulty entries that MuJoCo would not report.

    Raises:
        FileFormatError: when an entry is faulty; the message names the element, its line and the remedy.
        InputError: when the base of the arm is not fixed.
    """
    _check_kind(path, root)
    _check_numbers(path, root)
    _check_names(path, root)
    _check_ranges(path, root)


def _check_kind(path: Path, root: XmlElement) -> None:
    """Reject files that are not MJCF or URDF; the message names their type.

    Raises:
        FileFormatError: when the file is a xacro file, a part of an MJCF file, or neither MJCF nor URDF.
        InputError: when the base of the arm is not fixed.
    """
    for element in root.walk():
        xacro = element.tag.startswith("xacro:")
        unexpanded = [f"{key}={value!r}" for key, value in element.attributes.items() if re.search(r"\$[{(]", value)]
        if xacro or unexpanded:
            found = f"<{element.tag}>" if xacro else unexpanded[0]
            target = path.name.removesuffix(".xacro").removesuffix(".urdf") + "_expanded.urdf"
            raise FileFormatError(
                f"{path}: is a xacro file, from which a URDF is made ({found} in line {element.line}). Expand it "
                f"first, 'xacro {path.name} > {target}' (xacro comes with ROS, or with 'pip install xacro'), and load "
                f"{target}"
            )
    if root.tag == "mujocoinclude":
        raise FileFormatError(f"{path}: is a part that other MJCF files include; load the file that includes it")
    if root.tag == "sdf":
        raise FileFormatError(f"{path}: is an SDF file (Gazebo); load the robot's URDF or MJCF file instead")
    if root.tag not in {"mujoco", "robot"}:
        raise FileFormatError(f"{path}: root element is <{root.tag}>; MJCF has <mujoco>, URDF has <robot>")
    for joint in root.all("joint"):
        if joint.get("type") in {"floating", "planar"}:
            raise InputError(
                f"{path}: joint {joint.get('name')!r} (line {joint.line}) is {joint.get('type')}: the base moves. "
                "imitarm needs an arm on a fixed base: make this joint fixed (type='fixed')"
            )


def _check_numbers(path: Path, root: XmlElement) -> None:
    """Reject attributes that are NaN or infinite, and limits that are not numbers.

    Raises:
        FileFormatError: when an attribute is faulty; the message names its joint, link or body, and the line.
    """
    pending = [(root, "")]
    while pending:
        element, owner = pending.pop()
        if element.tag in {"joint", "link", "body", "geom", "site"} and element.get("name"):
            owner = f"{element.tag} {element.get('name')!r}, "
        for key, value in element.attributes.items():
            if key in _NAMES:
                continue
            numbers, fault = _numbers(value), ""
            if not all(math.isfinite(number) for number in numbers):
                fault = "not finite"
            elif element.tag == "limit" and value.strip() and not numbers:
                fault = "not a number"
            elif element.tag == "axis" and numbers and math.hypot(*numbers) < _SHORTEST_AXIS:
                raise FileFormatError(
                    f"{path}: {owner}line {element.line}: {key}={value!r} of <axis> has no direction; write the "
                    "direction of the joint's axis"
                )
            if fault:
                raise FileFormatError(
                    f"{path}: {owner}line {element.line}: {key}={value!r} of <{element.tag}> is {fault}; write a "
                    "finite number, or leave the attribute out if there is no such limit"
                )
        pending += [(child, owner) for child in reversed(element.children)]


def _numbers(value: str) -> list[float]:
    """Return the numbers in an attribute's value; an empty list when the value holds anything but numbers."""
    try:
        return [float(word) for word in value.split()]
    except ValueError:
        return []


def _check_names(path: Path, root: XmlElement) -> None:
    """Reject duplicate names of joints or links, and a mimic joint whose leader does not exist."""
    if root.tag == "robot":
        elements = [*root.all("link"), *root.all("joint")]
    else:
        elements = [e for world in root.all("worldbody") for e in world.walk() if e.tag in {"body", "joint"}]
    first: dict[tuple[str, str], int] = {}
    for element in elements:
        key = (element.tag, element.get("name"))
        if key[1] and key in first:
            raise FileFormatError(
                f"{path}: lines {first[key]} and {element.line} both define {key[0]} {key[1]!r}; give each its own name"
            )
        first[key] = element.line
    for element in elements if root.tag == "robot" else []:
        mimic = element.find("mimic")
        if mimic is not None and ("joint", mimic.get("joint")) not in first:
            raise FileFormatError(
                f"{path}: joint {element.get('name')!r} (line {element.line}) mimics joint "
                f"{mimic.get('joint')!r}, which is not in the file; correct the name, or remove the <mimic>"
            )


def _check_ranges(path: Path, root: XmlElement) -> None:
    """Reject ranges of an MJCF file whose lower bound is above the upper bound; MuJoCo ignores such a range."""
    for element in root.walk() if root.tag == "mujoco" else ():
        for key in _RANGES:
            numbers = _numbers(element.get(key))
            if len(numbers) == 2 and numbers[0] > numbers[1]:
                name = f" {element.get('name')!r}" if element.get("name") else ""
                raise FileFormatError(
                    f"{path}: line {element.line}: {key}={element.get(key)!r} of {element.tag}{name} has its "
                    "lower limit above its upper limit; exchange them"
                )


def check_key_lengths(n_positions: int, path: Path, root: XmlElement) -> None:
    """Reject a keyframe with more or fewer positions than the model; MuJoCo would silently fill up such a keyframe."""
    for key in (e for e in root.walk() if e.tag == "key"):
        n = len(_numbers(key.get("qpos")))
        if n not in (0, n_positions):
            raise FileFormatError(
                f"{path}: keyframe {key.get('name')!r} (line {key.line}) has {n} positions, but the model has "
                f"{n_positions}; give one for each joint, or remove the keyframe"
            )


def check_units(model: mujoco.MjModel, joints: tuple[str, ...], path: Path, root: XmlElement) -> None:
    """Reject hinge limits that were read in the wrong unit: degrees instead of radians, or radians instead of degrees.

    Raises:
        FileFormatError: when the limits are in the wrong unit; the message names a joint and its line.
    """
    limited = [
        name for name in joints if model.joint(name).type[0] == HINGE and model.jnt_limited[model.joint(name).id]
    ]
    widest = 0.0
    for name in limited:
        low, high = model.joint(name).range
        if _MOST_ROTATION < max(abs(low), abs(high)) <= 720.0:
            remedy = "convert them to radians" if root.tag == "robot" else 'write <compiler angle="degree"/>'
            free = "make it continuous" if root.tag == "robot" else "leave out its range"
            raise FileFormatError(
                f"{place(path, root, name)}: limits {low:g} to {high:g} rad span {(high - low) / math.tau:.0f} full "
                f"rotations; if they are degrees, {remedy}; if the joint has no limits, {free}"
            )
        widest = max(widest, float(high - low))
    if len(limited) > 1 and widest < _LEAST_ROTATION:
        hint = "" if root.tag == "robot" else ': without <compiler angle="radian"/>, angles in MJCF are in degrees'
        raise FileFormatError(
            f"{place(path, root, limited[0])}: no hinge of the arm can rotate by more than {np.degrees(widest):.2g} "
            f"degrees; check the unit of the limits{hint}"
        )


# Meshes


def find_meshes(spec: mujoco.MjSpec, path: Path, root: XmlElement, package_path: Iterable[Path]) -> None:
    """Replace the file name of every mesh in ``spec`` by the path at which it was found.

    Each mesh is searched for in the ``meshdir`` of the robot's file, then in the folder of the robot's file, then in
    the folders of ``package_path``. In ``package://NAME/...``, NAME is a ROS package, which is a folder of that name or
    a folder whose ``package.xml`` has that name. Packages are searched for above and beside the robot's file, in
    ``package_path``, and in the folders of the environment variables ``ROS_PACKAGE_PATH`` and ``AMENT_PREFIX_PATH``.

    Raises:
        FileFormatError: when a mesh is not found, or can't be read in its format. The message names the mesh, its line,
            the searched paths and the remedy.
    """
    folder = path.resolve().parent
    extra = [Path(entry).expanduser().resolve() for entry in package_path]
    for mesh in spec.meshes:
        if not mesh.file:
            continue
        places = list(_places(mesh.file, folder, str(spec.meshdir or ""), extra))
        found = next((place for place in places if place.is_file()), None)
        where = f"{path}: mesh {mesh.file!r}{_mesh_line(root, mesh.file)}"
        if found is None:
            raise FileFormatError(f"{where} was not found. {_where_to_put(mesh.file, folder, places)}")
        _check_mesh(found, where)
        mesh.file = str(found)
    spec.meshdir = ""


def _places(file: str, folder: Path, meshdir: str, extra: list[Path]) -> Iterator[Path]:
    """Yield possible paths of a mesh, the most likely one first."""
    file = file.replace("\\", "/")
    scheme, separator, rest = file.partition(":")
    if separator and scheme in {"package", "model"}:
        name, _, inside = rest.lstrip("/").partition("/")
        for package in _packages(name, folder, extra):
            yield package / inside
        return
    if separator and scheme == "file":
        file = "/" + rest.lstrip("/")
    yield folder / meshdir / file
    yield folder / file
    for entry in extra:
        yield entry / file


def _packages(name: str, folder: Path, extra: list[Path]) -> Iterator[Path]:
    """Yield the folders that may be the ROS package ``name``."""
    for level, above in enumerate([folder, *folder.parents]):
        if name in (above.name, _declared_name(above)):
            yield above
        yield above / name
        if level < _LEVELS:
            yield from (child for child in _subfolders(above) if _declared_name(child) == name)
    for root in [*extra, *_paths_in("ROS_PACKAGE_PATH")]:
        yield from _packages_below(root, name, _LEVELS)
    for prefix in _paths_in("AMENT_PREFIX_PATH"):
        yield prefix / "share" / name


def _packages_below(root: Path, name: str, levels: int) -> Iterator[Path]:
    declared = _declared_name(root)
    if name in (declared, root.name):
        yield root
    if declared is None and levels > 0:  # packages are not nested
        for child in _subfolders(root):
            yield from _packages_below(child, name, levels - 1)


def _paths_in(variable: str) -> list[Path]:
    return [Path(entry) for entry in os.environ.get(variable, "").split(os.pathsep) if entry]


def _subfolders(folder: Path) -> list[Path]:
    try:
        entries = sorted(entry for entry in folder.iterdir() if entry.is_dir() and not entry.name.startswith("."))
    except OSError:
        return []
    return entries[:_MOST_FOLDERS]


def _declared_name(folder: Path) -> str | None:
    """Return the name in a folder's ``package.xml``; None when the folder is not a package."""
    manifest = folder / "package.xml"
    try:
        if not manifest.is_file():
            return None
        return _name_in(manifest, manifest.stat().st_mtime_ns)
    except OSError:
        return None


@cache
def _name_in(manifest: Path, _changed: int) -> str | None:
    try:
        name = ElementTree.parse(manifest).getroot().findtext("name")
    except (ElementTree.ParseError, OSError, ValueError, LookupError):
        return None
    return name.strip() if name else None


def _check_mesh(mesh: Path, where: str) -> None:
    """Reject a mesh that MuJoCo can't read; the message names its format."""
    convert = (
        "convert it to binary STL or to OBJ (for example with MeshLab or Blender) and write the new file's name into "
        "the robot's file, or leave all meshes out with discard_meshes=True (--discard-meshes on the command line)"
    )
    suffix = mesh.suffix.lower()
    with mesh.open("rb") as file:
        head = file.read(1024)
    if head.startswith(b"version https://git-lfs"):
        raise FileFormatError(
            f"{where} is only a Git LFS pointer, not the mesh itself; run 'git lfs pull' in {mesh.parent}"
        )
    if suffix not in _MESHES:
        kind = _OTHER_MESHES.get(suffix, f"of the format {mesh.suffix!r}" if suffix else "of an unknown format")
        raise FileFormatError(f"{where} is {kind}; only STL, OBJ and MSH can be read: {convert}")
    if suffix == ".stl" and head.lstrip().startswith(b"solid") and b"facet" in head:
        raise FileFormatError(f"{where} is an STL file in text form; only binary STL can be read: {convert}")


def _mesh_line(root: XmlElement, file: str) -> str:
    lines = [e.line for e in root.walk() if e.tag == "mesh" and file in (e.get("filename"), e.get("file"))]
    return f" (line {lines[0]})" if lines else ""


def _where_to_put(file: str, folder: Path, places: list[Path]) -> str:
    if file.startswith(("package:", "model:")):
        name = file.partition(":")[2].lstrip("/").partition("/")[0]
        return (
            f"No package {name!r} with this mesh was found above or beside {folder}, in package_path or in "
            "ROS_PACKAGE_PATH. Say where the package is with package_path=... (--package-path FOLDER on the command "
            "line), or leave all meshes out with discard_meshes=True (--discard-meshes)"
        )
    looked = ", ".join(dict.fromkeys(str(place) for place in places))
    return (
        f"The mesh was searched for at {looked}. Put it there, name its folder with package_path=... (--package-path "
        "FOLDER on the command line), or leave all meshes out with discard_meshes=True (--discard-meshes)"
    )
