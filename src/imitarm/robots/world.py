"""A MuJoCo world around an arm: fixtures, obstacles, and distances measured by the simulator's own geometry."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from imitarm.kinematics.pose import Pose
from imitarm.scene import ConvexHull, Obstacle, Scene, standard_fixtures

if TYPE_CHECKING:
    from imitarm.kinematics.arm import ArmModel

Array = NDArray[np.float64]

COLLISION_GROUP = 3  # geoms of the arm and its tool that count for contact
OBSTACLE = "obstacle/"  # bodies and geoms of obstacles are called so, followed by the index in the scene

_COLORS = ((0.20, 0.42, 0.70), (0.78, 0.22, 0.20), (0.93, 0.58, 0.15), (0.45, 0.32, 0.60), (0.30, 0.55, 0.40))
_FIXTURE_COLORS = {"floor": (0.55, 0.57, 0.60, 1.0), "pedestal": (0.28, 0.30, 0.33, 1.0), "": (0.80, 0.68, 0.52, 1.0)}
_FAR = 100.0  # [m] farther pairs are not measured


def arm_world(
    arm: ArmModel, *, floor: float = -0.75, pedestal_radius: float = 0.12, fixtures: Sequence[Obstacle] | None = None
) -> mujoco.MjSpec:
    """Return a world with the arm on its fixtures, to which furniture can be added. The arm's base is at the origin.

    Args:
        arm: the arm with its tool.
        floor: height of the floor [m], see :func:`~imitarm.scene.standard_fixtures`.
        pedestal_radius: radius of the pedestal [m], see :func:`~imitarm.scene.standard_fixtures`.
        fixtures: fixtures (known objects that do not move) that replace the standard fixtures.

    Returns:
        A specification that :class:`~imitarm.robots.simulated.SimulatedRobot` takes as ``world``.
    """
    spec = arm.spec()
    spec.visual.headlight.ambient = [0.35, 0.35, 0.35]
    spec.visual.headlight.diffuse = [0.55, 0.55, 0.55]
    spec.visual.headlight.specular = [0.1, 0.1, 0.1]
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=[0.86, 0.90, 0.95],
        rgb2=[0.62, 0.70, 0.80],
        width=64,
        height=384,
    )
    spec.visual.global_.offwidth, spec.visual.global_.offheight = 1280, 960
    spec.worldbody.add_light(pos=[0.5, -1.0, 2.5], dir=[0.0, 0.35, -1.0], diffuse=[0.4, 0.4, 0.4])
    standard = standard_fixtures(floor=floor, pedestal_radius=pedestal_radius)
    add_fixtures(spec, standard if fixtures is None else fixtures)
    return spec


def add_fixtures(spec: mujoco.MjSpec, fixtures: Sequence[Obstacle]) -> None:
    """Add each fixture as a static geom with the fixture's name, or ``fixture/i`` for a fixture i without a name.

    Args:
        spec: world; changed in place. If the world already has a geom of the fixture's name, the fixture is not added.
        fixtures: fixtures in the base frame, which is the world frame.
    """
    there = {geom.name for geom in spec.geoms}
    for name, fixture in zip(fixture_names(fixtures), fixtures, strict=True):
        if name not in there:
            solid = fixture.solid()
            color = _FIXTURE_COLORS.get(name, _FIXTURE_COLORS[""])
            _add_geom(spec, spec.worldbody, name, fixture, color, pos=solid.position, quat=solid.quaternion)


def fixture_names(fixtures: Sequence[Obstacle]) -> list[str]:
    """Return the names of the geoms that :func:`add_fixtures` creates for ``fixtures``, in the same order."""
    return [fixture.name or f"fixture/{i}" for i, fixture in enumerate(fixtures)]


def add_obstacles(spec: mujoco.MjSpec, scene: Scene) -> None:
    """Add every obstacle of ``scene`` as a solid body.

    The body moves as the obstacle does; contact forces do not move it.

    Args:
        spec: world; changed in place.
        scene: obstacles in the base frame, which is the world frame.
    """
    for index, obstacle in enumerate(scene.obstacles):
        name, solid = f"{OBSTACLE}{index}", obstacle.solid()
        body = spec.worldbody.add_body(name=name, mocap=True, pos=solid.position, quat=solid.quaternion)
        _add_geom(spec, body, name, obstacle, (*_COLORS[index % len(_COLORS)], 1.0))


def _add_geom(
    spec: mujoco.MjSpec, body: Any, name: str, obstacle: Obstacle, color: tuple[float, ...], **place: Any
) -> None:
    """Add the shape of an obstacle to ``body``, whose frame must be the obstacle's local frame."""
    shape, size, vertices = _shape(obstacle)
    if vertices is None:
        body.add_geom(name=name, type=shape, size=size, rgba=color, **place)
    else:
        spec.add_mesh(name=name, uservert=np.ascontiguousarray(vertices, dtype=float).ravel())
        body.add_geom(name=name, type=shape, meshname=name, rgba=color, **place)


def _shape(obstacle: Obstacle) -> tuple[mujoco.mjtGeom, list[float], Array | None]:
    """Return the type of an obstacle's geom, its size, and the vertices of its mesh in the local frame."""
    types, solid = mujoco.mjtGeom, obstacle.solid()
    a, b, c = (float(length) for length in solid.size)
    primitives = {
        "sphere": (types.mjGEOM_SPHERE, [a, 0.0, 0.0]),
        "box": (types.mjGEOM_BOX, [0.5 * a, 0.5 * b, 0.5 * c]),
        "cylinder": (types.mjGEOM_CYLINDER, [a, 0.5 * b, 0.0]),
        "capsule": (types.mjGEOM_CAPSULE, [a, max(0.5 * b, 1e-6), 0.0]),
        "ellipsoid": (types.mjGEOM_ELLIPSOID, [a, b, c]),
        "half_space": (types.mjGEOM_PLANE, [0.0, 0.0, 0.05]),  # without end
    }
    if solid.kind in primitives:
        return *primitives[solid.kind], None
    # any other convex solid becomes the hull of its vertices, or of points of its surface
    vertices = obstacle.vertices if isinstance(obstacle, ConvexHull) else _surface(obstacle)
    own = Pose(solid.position, solid.quaternion).inverse().apply(vertices)
    return types.mjGEOM_MESH, [0.0, 0.0, 0.0], own


def _surface(obstacle: Obstacle, n_around: int = 96, n_up: int = 32) -> Array:
    """Return distinct surface points (m, 3) of a convex obstacle: the farthest points in many directions."""
    azimuth = np.arange(n_around) * (2.0 * np.pi / n_around)
    height = np.linspace(-1.0, 1.0, n_up)
    flat = np.sqrt(1.0 - height**2)[:, None]
    directions = np.stack(
        [flat * np.cos(azimuth), flat * np.sin(azimuth), np.broadcast_to(height[:, None], (n_up, n_around))], axis=-1
    )
    if hasattr(obstacle, "pose"):
        directions = directions @ obstacle.pose.rotation.T  # around its own axis
    points = obstacle.support(directions.reshape(-1, 3))
    return points[np.unique(np.round(points, 7), axis=0, return_index=True)[1]]


class ClearanceGauge:
    """Measures the smallest distance from an arm to obstacles and finds contacts, using the simulator's geoms.

    For each pair of geoms, the distance between the bounding spheres is a lower bound of the pair's distance. The pairs
    are measured by ``mj_geomDistance`` in the order of their lower bounds, until the next bound exceeds the smallest
    measured distance. Most pairs therefore need no exact measurement.

    Args:
        model: the compiled world.
        arm_geoms: ids of the geoms of arm and tool.
        obstacle_geoms: ids of the geoms whose distance is measured.
        fixture_geoms: ids of the geoms on which the arm stands; they count only for contact.
        links: index of the link to which each arm geom belongs: the number of joints between the base and the geom.
            Contact between geoms of two different links is a self-contact. None: self-contacts are not checked.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        arm_geoms: Sequence[int],
        obstacle_geoms: Sequence[int],
        fixture_geoms: Sequence[int] = (),
        links: Sequence[int] | None = None,
    ) -> None:
        self._model = model
        self._arm = np.array(arm_geoms, dtype=np.intp)
        self._obstacles = np.array(obstacle_geoms, dtype=np.intp)
        bounding = np.where(model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE, np.inf, model.geom_rbound)
        self._radii = bounding[self._arm][:, None] + bounding[self._obstacles][None]
        self._other = np.zeros(model.ngeom, dtype=bool)
        self._other[self._obstacles] = True
        self._other[np.array(fixture_geoms, dtype=np.intp)] = True
        self._link = np.full(model.ngeom, -1)  # -1: not a geom of the arm
        self._link[self._arm] = 0 if links is None else links
        self._by_design: set[tuple[int, int]] = set()
        self._from_to = np.zeros(6)
        self._in_contact: tuple[bytes, set[tuple[int, int]]] = b"", set()  # geoms in contact, and what touching gives

    def ignore_present_self_contacts(self, data: mujoco.MjData) -> None:
        """From now on, ignore contacts between links that touch now.

        In some robot files, neighbouring links overlap.
        """
        self._by_design = {(first, second) for _, first, second in self._self_contacts(data)}
        self._in_contact = b"", set()

    def measure(self, data: mujoco.MjData) -> tuple[float, tuple[int, int] | None]:
        """Return the smallest signed distance [m], negative in contact, and the ids of the two geoms.

        For a self-contact, the distance is minus the depth of the contact. Without contact, and without an obstacle
        within 100 m, the result is inf and None.
        """
        smallest, pair = _FAR, None
        for depth, first, second in self._self_contacts(data):
            if depth < smallest:
                smallest, pair = depth, (first, second)
        if self._radii.size:
            apart = data.geom_xpos[self._arm][:, None] - data.geom_xpos[self._obstacles][None]
            bounds = (np.sqrt(np.einsum("ijk,ijk->ij", apart, apart)) - self._radii).ravel()
            for flat in np.argsort(bounds):
                if bounds[flat] >= smallest:
                    break
                i, j = divmod(int(flat), len(self._obstacles))
                first, second = int(self._arm[i]), int(self._obstacles[j])
                distance = mujoco.mj_geomDistance(self._model, data, first, second, smallest, self._from_to)
                if distance < smallest:
                    smallest, pair = distance, (first, second)
        return (smallest, pair) if pair is not None else (np.inf, None)

    def touching(self, data: mujoco.MjData) -> set[tuple[int, int]]:
        """Return the pairs of geoms currently in contact.

        Each pair holds the ids of a geom of the arm and a geom of an obstacle or fixture, or of two geoms of the arm
        (lower id first).
        """
        if not data.ncon:
            return set()
        geoms = data.contact.geom
        now = geoms.tobytes()
        if now != self._in_contact[0]:  # from one step to the next, few contacts begin or end
            pairs: set[tuple[int, int]] = set()
            for first, second in (geoms.T, geoms.T[::-1]):
                hits = (self._link[first] >= 0) & self._other[second]
                pairs.update(zip(first[hits].tolist(), second[hits].tolist(), strict=True))
            self._in_contact = now, pairs | {(first, second) for _, first, second in self._self_contacts(data)}
        return self._in_contact[1]

    def _self_contacts(self, data: mujoco.MjData) -> list[tuple[float, int, int]]:
        """Return depth (negative) [m] and geoms of each contact between two links of the arm."""
        if not data.ncon:
            return []
        geoms = data.contact.geom
        first, second = self._link[geoms[:, 0]], self._link[geoms[:, 1]]
        hits = (first >= 0) & (second >= 0) & (first != second)
        if not hits.any():
            return []
        pairs = np.sort(geoms[hits], axis=1).tolist()
        found = zip(data.contact.dist[hits].tolist(), pairs, strict=True)
        return [(depth, a, b) for depth, (a, b) in found if (a, b) not in self._by_design]
