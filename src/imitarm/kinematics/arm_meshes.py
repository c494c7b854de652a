"""Find the meshes that a URDF or MJCF file names, and report those that can't be read."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path
from xml.etree import ElementTree

import mujoco

from imitarm.errors import FileFormatError
from imitarm.files.xml_tree import XmlElement

_READABLE = {".stl", ".obj", ".msh"}
_FORMATS = {
    ".dae": "COLLADA", ".glb": "glTF", ".gltf": "glTF", ".ply": "PLY", ".fbx": "FBX", ".3ds": "3DS", ".step": "STEP",
    ".stp": "STEP", ".iges": "IGES", ".wrl": "VRML", ".iv": "Open Inventor", ".mesh": "OGRE", ".off": "OFF",
}  # fmt: skip
_LEVELS = 4  # folders below a package path, and above the robot's file, in which packages are looked for
_MOST_FOLDERS = 300  # of one folder that are looked into


def find_meshes(spec: mujoco.MjSpec, path: Path, root: XmlElement, package_path: Iterable[Path]) -> None:
    """Replace the file name of every mesh in ``spec`` by the path at which it was found.

    Each mesh is searched for in the ``meshdir`` of the robot's file, then in the folder of the robot's file, then in
    the folders of ``package_path``. In ``package://NAME/...``, NAME is a ROS package, which is a folder of that name or
    a folder whose ``package.xml`` has that name. Packages are searched for above and beside the robot's file, in
    ``package_path``, and in the folders of the environment variables ``ROS_PACKAGE_PATH`` and ``AMENT_PREFIX_PATH``.

    Raises:
        FileFormatError: when a mesh is not found or has a format that can't be read; the message names the mesh,
            its line, the paths searched and the remedy.
    """
    folder = path.resolve().parent
    extra = [Path(entry).expanduser().resolve() for entry in package_path]
    for mesh in spec.meshes:
        if not mesh.file:
            continue
        places = list(_places(mesh.file, folder, str(spec.meshdir or ""), extra))
        found = next((place for place in places if place.is_file()), None)
        where = f"{path}: mesh {mesh.file!r}{_line(root, mesh.file)}"
        if found is None:
            raise FileFormatError(f"{where} was not found. {_remedy(mesh.file, folder, places)}")
        _check_format(found, where)
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


def _check_format(mesh: Path, where: str) -> None:
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
    if suffix not in _READABLE:
        kind = _FORMATS.get(suffix, f"of the format {mesh.suffix!r}" if suffix else "of an unknown format")
        raise FileFormatError(f"{where} is {kind}; only STL, OBJ and MSH can be read: {convert}")
    if suffix == ".stl" and head.lstrip().startswith(b"solid") and b"facet" in head:
        raise FileFormatError(f"{where} is an STL file in text form; only binary STL can be read: {convert}")


def _line(root: XmlElement, file: str) -> str:
    lines = [e.line for e in root.walk() if e.tag == "mesh" and file in (e.get("filename"), e.get("file"))]
    return f" (line {lines[0]})" if lines else ""


def _remedy(file: str, folder: Path, places: list[Path]) -> str:
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
