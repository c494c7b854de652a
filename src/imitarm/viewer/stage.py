"""What of a model is drawn, where its floor is, and from where to look at it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from mujoco import MjModel, mjtGeom
from numpy.typing import ArrayLike, NDArray

from imitarm.kinematics.pose import quaternion_to_matrix
from imitarm.viewer.geometry import Mesh, geom_mesh, geom_rgba, merge, visible_geoms
from imitarm.viewer.recording import Recording

Array = NDArray[np.float64]

_VIEW: Final = (1.0, -0.95, 0.62)  # from where the camera looks: in front, from the right, from above


@dataclass(frozen=True)
class Camera:
    """Where the view begins: ``position`` and ``look_at`` [m] in the world frame, vertical ``field_of_view`` [rad]."""

    position: tuple[float, float, float]
    look_at: tuple[float, float, float]
    field_of_view: float = 0.62

    @classmethod
    def around(cls, points: ArrayLike, *, direction: ArrayLike = _VIEW, aspect: float = 16 / 9) -> Camera:
        """Return the nearest camera, looking from ``direction``, that has all ``points`` (n, 3) [m] in the picture.

        Args:
            points: what must be seen, in the world frame.
            direction: from the middle of the points towards the camera.
            aspect: width of the picture divided by its height.
        """
        p = np.asarray(points, dtype=float)
        back = np.asarray(direction, dtype=float) / np.linalg.norm(direction)
        right = np.cross([0.0, 0.0, 1.0], back)
        right /= np.linalg.norm(right)
        up = np.cross(back, right)
        middle = 0.5 * (p.min(axis=0) + p.max(axis=0))
        tangent = np.tan(0.5 * cls.field_of_view)
        for _ in range(12):  # what is near takes more of the picture: turn to the picture's middle, then come nearer
            x, y, z = (p - middle) @ right, (p - middle) @ up, (p - middle) @ back
            distance = 1.04 * float(np.max(z + np.maximum(np.abs(y), np.abs(x) / aspect) / tangent))
            u, v = x / (distance - z), y / (distance - z)
            middle = middle + 0.5 * distance * ((u.min() + u.max()) * right + (v.min() + v.max()) * up)
        x, y, z = (p - middle) @ right, (p - middle) @ up, (p - middle) @ back
        distance = 1.04 * float(np.max(z + np.maximum(np.abs(y), np.abs(x) / aspect) / tangent))
        position = middle + distance * back
        return cls(tuple(map(float, position)), tuple(map(float, middle)))  # type: ignore[arg-type]


@dataclass(frozen=True, eq=False)
class Part:
    """The triangles of one colour of one body, in the body's frame."""

    mesh: Mesh
    rgba: tuple[float, float, float, float]


def body_parts(model: MjModel) -> dict[int, list[Part]]:
    """Return what is to be drawn of every body that has looks: one mesh for each colour."""
    found: dict[int, dict[tuple[float, ...], list[Mesh]]] = {}
    for geom in visible_geoms(model):
        mesh = geom_mesh(model, geom)
        if mesh is None:
            continue
        colour = tuple(np.round(geom_rgba(model, geom), 3).tolist())
        placed = mesh.moved(model.geom_pos[geom], quaternion_to_matrix(model.geom_quat[geom]))
        found.setdefault(int(model.geom_bodyid[geom]), {}).setdefault(colour, []).append(placed)
    return {
        body: [Part(merge(meshes), colour) for colour, meshes in colours.items()]  # type: ignore[arg-type]
        for body, colours in found.items()
    }


def _vertices(recording: Recording, frame: int, bodies: Iterable[int], parts: Mapping[int, list[Part]]) -> Array:
    """Return vertices (n, 3) [m] of some bodies in the world frame, not all when there are many."""
    found = [np.empty((0, 3))]
    for body in bodies:
        vertices = np.concatenate([part.mesh.vertices for part in parts[body]])
        vertices = vertices[:: max(1, len(vertices) // 400)]
        rotation = quaternion_to_matrix(recording.quaternions[frame, body])
        found.append(vertices @ rotation.T + recording.positions[frame, body])
    return np.concatenate(found)


def points_to_see(recording: Recording, parts: Mapping[int, list[Part]], paths: Iterable[Array]) -> Array:
    """Return points (n, 3) [m] that belong in the picture: all that moves, what it hangs on, and what is near it."""
    model, still = recording.model, recording.positions[:1]
    turned = np.any(np.abs(recording.quaternions - recording.quaternions[:1]) > 1e-3, axis=(0, 2))
    moves = np.any(np.abs(recording.positions - still) > 1e-3, axis=(0, 2)) | turned
    roots = {int(model.body_rootid[body]) for body in np.flatnonzero(moves)} - {0}
    actors = [body for body in parts if moves[body]]
    frames = np.unique(np.linspace(0, len(recording) - 1, 5).astype(int))
    action = [np.asarray(path, dtype=float) for path in paths]
    action += [_vertices(recording, int(frame), actors, parts) for frame in frames]
    seen = np.concatenate([np.empty((0, 3)), *action])
    stage = _vertices(recording, 0, parts, parts)
    if not len(seen):
        return stage if len(stage) else np.array([[-0.5, -0.5, 0.0], [0.5, 0.5, 1.0]])
    hung = _vertices(recording, 0, [body for body in parts if int(model.body_rootid[body]) in roots], parts)
    margin = np.array([0.2, 0.2, 0.1])  # [m] around the action
    low, high = seen.min(axis=0) - margin, seen.max(axis=0) + margin
    near = stage[((stage >= low) & (stage <= high)).all(axis=1)]
    return np.concatenate([seen, hung[hung[:, 2] >= low[2]], near])


def floor_height(recording: Recording, parts: Mapping[int, list[Part]]) -> float:
    """Return the height of the floor [m]: the lowest plane, or the lowest of what stands there."""
    model = recording.model
    planes = [model.geom_pos[g, 2] for g in range(model.ngeom) if model.geom_type[g] == mjtGeom.mjGEOM_PLANE]
    return float(min([*planes, *_vertices(recording, 0, parts, parts)[:, 2], 0.0]))
