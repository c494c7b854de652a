"""Common parts of 3-D drawings: the meshes and the floor of a model, the camera, colours, and moving nodes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from mujoco import MjModel, mjtGeom
from numpy.typing import ArrayLike, NDArray

from imitarm.kinematics.pose import quaternion_to_matrix
from imitarm.viewer.geometry import Mesh, geom_mesh, geom_rgba, merge, visible_geoms
from imitarm.viewer.recording import Recording

Array = NDArray[np.float64]

_VIEW: Final = (1.0, -0.95, 0.62)  # direction towards the camera: in front of the robot, to its right, above
STEP: Final = 2.0**-13  # [m], [-] poses are rounded to this (0.12 mm): a file of round numbers is a third as large
_EXPOSURE: Final = 0.7


@dataclass(frozen=True)
class Camera:
    """The initial view: ``position`` and ``look_at`` [m] in the world frame, and vertical ``field_of_view`` [rad]."""

    position: tuple[float, float, float]
    look_at: tuple[float, float, float]
    field_of_view: float = 0.62

    @classmethod
    def around(cls, points: ArrayLike, *, direction: ArrayLike = _VIEW, aspect: float = 16 / 9) -> Camera:
        """Return the nearest camera that shows all ``points`` (n, 3) [m] from ``direction``.

        Args:
            points: points that must be visible, in the world frame, shape (n, 3) [m].
            direction: direction from the center of the points towards the camera.
            aspect: width of the picture divided by its height.
        """
        p = np.asarray(points, dtype=float)
        back = np.asarray(direction, dtype=float) / np.linalg.norm(direction)
        right = np.cross([0.0, 0.0, 1.0], back)
        right /= np.linalg.norm(right)
        up = np.cross(back, right)
        middle = 0.5 * (p.min(axis=0) + p.max(axis=0))
        tangent = np.tan(0.5 * cls.field_of_view)
        for _ in range(12):  # near points take more of the picture: aim at the center of the picture, then move closer
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
    """All triangles of a body that have the same colour, in the frame of the body."""

    mesh: Mesh
    rgba: tuple[float, float, float, float]


def body_parts(model: MjModel) -> dict[int, list[Part]]:
    """Return the visible parts of each body: one mesh for each colour."""
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
    """Return vertices (n, 3) [m] of bodies in the world frame; if a body has many vertices, a subset of them."""
    found = [np.empty((0, 3))]
    for body in bodies:
        vertices = np.concatenate([part.mesh.vertices for part in parts[body]])
        vertices = vertices[:: max(1, len(vertices) // 400)]
        rotation = quaternion_to_matrix(recording.quaternions[frame, body])
        found.append(vertices @ rotation.T + recording.positions[frame, body])
    return np.concatenate(found)


def points_to_see(recording: Recording, parts: Mapping[int, list[Part]], paths: Iterable[Array]) -> Array:
    """Return points (n, 3) [m] that must be visible: of moving bodies, their parents and neighbours, and of paths."""
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
    """Return the height of the floor [m]: 0, or the height of the lowest plane or vertex if this is below 0."""
    model = recording.model
    planes = [model.geom_pos[g, 2] for g in range(model.ngeom) if model.geom_type[g] == mjtGeom.mjGEOM_PLANE]
    return float(min([*planes, *_vertices(recording, 0, parts, parts)[:, 2], 0.0]))


class Mover:
    """A node of viser's scene that changes from frame to frame.

    Args:
        handle: handle of the node.
        poses: values of the node's attributes (such as ``position``, ``wxyz`` or ``visible``) by name. The first
            dimension of each array is the frame.
    """

    def __init__(self, handle: Any, poses: Mapping[str, NDArray[Any]]) -> None:
        self._handle, self._poses = handle, poses
        self._changed = {
            name: np.any(values[1:] != values[:-1], axis=tuple(range(1, values.ndim))).tolist()
            for name, values in poses.items()
        }

    def show(self, frame: int) -> None:
        """Send those attributes of the frame ``frame`` that differ from the previous frame."""
        for name, values in self._poses.items():
            if self._changed[name][frame - 1]:
                value: Any = bool(values[frame]) if values.ndim == 1 else values[frame]
                setattr(self._handle, name, tuple(value.tolist()) if name == "scale" else value)  # not as raw bytes


def node_name(kind: str, *names: object) -> str:
    """Return the name of a node. Slashes in ``names`` are replaced, because viser reads them as tree levels."""
    return f"/{kind}/" + " ".join(str(name).replace("/", "|") for name in names)


def lit(rgba: Sequence[float], *, linear: bool = False) -> tuple[float, float, float]:
    """Return the colour that looks like ``rgba`` under viser's lights, which are brighter than MuJoCo's lights.

    If ``linear`` is true, the result is linear RGB, which viser's batched meshes need. Otherwise, the result is sRGB,
    which single meshes need.
    """
    srgb = np.asarray(rgba[:3], dtype=float)
    light = _EXPOSURE * np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    shown = light if linear else np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return float(shown[0]), float(shown[1]), float(shown[2])
