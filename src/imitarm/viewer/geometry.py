"""Convert MuJoCo's geoms to triangle meshes with few triangles, sharp edges and smooth round surfaces.

Renderers average the normals of triangles that share a vertex, so shared vertices look smooth. Faces that meet at a
sharp edge therefore get separate vertices, while the faces of a round surface share vertices.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

_AROUND: Final = 28  # edges of a circle
_RINGS: Final = 7  # rings of half a sphere
_MAX_FACES: Final = 3000  # triangles of one mesh file; a nicer mesh is thinned to about this
_SMOOTH: Final = 0.77  # faces that meet at less than about 40 degrees are parts of one round surface
_FLOOR: Final = 1.0  # [m] half of a plane's width: larger ones, and endless ones (0), are floors
_NO_COLOUR: Final = (0.5, 0.5, 0.5, 1.0)  # MuJoCo's colour of a geom that was given none


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh.

    Attributes:
        vertices: positions of the vertices, shape (n_vertices, 3) [m].
        faces: vertex indices of each triangle, counter-clockwise seen from outside, shape (n_faces, 3).
    """

    vertices: Array
    faces: NDArray[np.int64]

    def moved(self, position: ArrayLike, rotation: ArrayLike) -> Mesh:
        """Return the mesh rotated by ``rotation`` (3, 3), then shifted by ``position`` (3,) [m]."""
        return Mesh(self.vertices @ np.asarray(rotation, dtype=float).T + np.asarray(position, dtype=float), self.faces)


def merge(meshes: list[Mesh]) -> Mesh:
    """Combine several meshes into one mesh."""
    starts = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes[:-1]])
    faces = [mesh.faces + start for mesh, start in zip(meshes, starts, strict=True)]
    return Mesh(np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(faces))


def box(half_size: ArrayLike) -> Mesh:
    """Return a box with edges of length ``2 * half_size`` (3,) [m]; every face has four vertices of its own."""
    corners: list[Array] = []
    faces: list[tuple[int, int, int]] = []
    for axis in range(3):
        for side in (-1.0, 1.0):
            u, v = np.eye(3)[(axis + 1) % 3], np.eye(3)[(axis + 2) % 3] * side  # u x v points outwards
            start = len(corners)
            corners += [side * np.eye(3)[axis] + a * u + b * v for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
            faces += [(start, start + 1, start + 2), (start, start + 2, start + 3)]
    return Mesh(np.array(corners) * np.asarray(half_size, dtype=float), np.array(faces))


def _revolved(profile: Array) -> Mesh:
    """Revolve a profile around the z axis; its rows (radius, z) [m] go from the lowest to the highest point."""
    angles = np.linspace(0.0, 2.0 * np.pi, _AROUND, endpoint=False)
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    rings = np.concatenate(
        [profile[:, None, :1] * circle[None], np.broadcast_to(profile[:, None, 1:], (len(profile), _AROUND, 1))], axis=2
    )
    low = np.arange(_AROUND)[None, :] + _AROUND * np.arange(len(profile) - 1)[:, None]
    low_next = (np.arange(_AROUND)[None, :] + 1) % _AROUND + _AROUND * np.arange(len(profile) - 1)[:, None]
    high, high_next = low + _AROUND, low_next + _AROUND
    lower = np.stack([low, low_next, high_next], axis=-1)[profile[:-1, 0] > 0.0]  # at a pole one of the two is a point
    upper = np.stack([low, high_next, high], axis=-1)[profile[1:, 0] > 0.0]
    return Mesh(rings.reshape(-1, 3), np.concatenate([lower.reshape(-1, 3), upper.reshape(-1, 3)]))


def cylinder(radius: float, half_length: float) -> Mesh:
    """Return a cylinder along z with flat ends; ``half_length`` is half of its length [m]."""
    ends = [(0.0, -half_length), (radius, -half_length)], [(radius, half_length), (0.0, half_length)]
    side = [(radius, -half_length), (radius, half_length)]
    return merge([_revolved(np.array(part)) for part in (ends[0], side, ends[1])])


def capsule(radius: float, half_length: float) -> Mesh:
    """Return a capsule along z: a cylinder of half length ``half_length`` [m] with a hemisphere on each end."""
    angles = np.linspace(0.0, 0.5 * np.pi, _RINGS + 1)
    cap = np.stack([radius * np.cos(angles), half_length + radius * np.sin(angles)], axis=1)
    cap[-1, 0] = 0.0  # the cosine of a right angle is not quite zero
    return _revolved(np.concatenate([cap[::-1] * [1.0, -1.0], cap if half_length > 0.0 else cap[1:]]))


def ellipsoid(semi_axes: ArrayLike) -> Mesh:
    """Return an ellipsoid with ``semi_axes`` (3,) [m]; three equal semi-axes give a sphere."""
    unit = capsule(1.0, 0.0)
    return Mesh(unit.vertices * np.asarray(semi_axes, dtype=float), unit.faces)


_PRIMITIVES: Final[dict[int, Callable[[Array], Mesh]]] = {
    int(mujoco.mjtGeom.mjGEOM_SPHERE): lambda size: ellipsoid(size[[0, 0, 0]]),
    int(mujoco.mjtGeom.mjGEOM_ELLIPSOID): ellipsoid,
    int(mujoco.mjtGeom.mjGEOM_CAPSULE): lambda size: capsule(size[0], size[1]),
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): lambda size: cylinder(size[0], size[1]),
    int(mujoco.mjtGeom.mjGEOM_BOX): box,
}


def _thinned(mesh: Mesh) -> Mesh:
    """Merge all vertices in one cell of a grid; the cells are enlarged until the mesh has few enough triangles."""
    cell = 1e-5 + 1e-3 * float(np.ptp(mesh.vertices, axis=0).max())
    while len(mesh.faces) > _MAX_FACES:
        _, kept, index = np.unique(np.round(mesh.vertices / cell), axis=0, return_index=True, return_inverse=True)
        faces = index.reshape(-1)[mesh.faces]
        a, b, c = faces.T
        mesh = Mesh(mesh.vertices[kept], faces[(a != b) & (b != c) & (c != a)])
        cell *= 1.5
    return mesh


def _sharpened(mesh: Mesh) -> Mesh:
    """Give separate vertices to faces that meet at a sharp edge; faces with similar normals share vertices."""
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    normals = np.cross(b - a, c - a)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-15)
    faces = mesh.faces.copy()
    copies: dict[int, list[tuple[int, Array]]] = {}  # of each vertex: its number, and the normal it began with
    origin: list[int] = []
    for face, corner in np.ndindex(faces.shape):
        vertex, normal = int(faces[face, corner]), normals[face]
        mine = copies.setdefault(vertex, [])
        number = next((n for n, other in mine if other @ normal > _SMOOTH), None)
        if number is None:
            number = len(origin)
            origin.append(vertex)
            mine.append((number, normal))
        faces[face, corner] = number
    return Mesh(mesh.vertices[origin], faces)


def geom_mesh(model: mujoco.MjModel, geom: int) -> Mesh | None:
    """Return the triangles of a geom in its local frame; None for floors (large planes) and height fields.

    Args:
        model: any compiled MuJoCo model.
        geom: index of the geom.
    """
    kind, size = int(model.geom_type[geom]), np.array(model.geom_size[geom])
    if kind in _PRIMITIVES:
        return _PRIMITIVES[kind](size)
    if kind == mujoco.mjtGeom.mjGEOM_PLANE and 0.0 < size[:2].min() <= _FLOOR:
        return Mesh(box([size[0], size[1], 0.0]).vertices[-4:], np.array([[0, 1, 2], [0, 2, 3]]))
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = model.geom_dataid[geom]
        first_vertex, first_face = model.mesh_vertadr[mesh], model.mesh_faceadr[mesh]
        vertices = model.mesh_vert[first_vertex : first_vertex + model.mesh_vertnum[mesh]]
        faces = model.mesh_face[first_face : first_face + model.mesh_facenum[mesh]]
        return _sharpened(_thinned(Mesh(np.array(vertices, dtype=float), np.array(faces, dtype=np.int64))))
    return None


def geom_rgba(model: mujoco.MjModel, geom: int) -> Array:
    """Return the colour of a geom as red, green, blue and opacity (4,), 0 to 1.

    As in MuJoCo, the colour of the geom itself overrides the colour of its material.
    """
    material, own = int(model.geom_matid[geom]), np.array(model.geom_rgba[geom], dtype=float)
    return own if material < 0 or not np.allclose(own, _NO_COLOUR) else np.array(model.mat_rgba[material], dtype=float)


def visible_geoms(model: mujoco.MjModel) -> list[int]:
    """Return the indices of the visible geoms: those in groups 0 to 2 that are not fully transparent."""
    return [g for g in range(model.ngeom) if model.geom_group[g] <= 2 and geom_rgba(model, g)[3] > 0.0]
