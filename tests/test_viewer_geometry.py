from __future__ import annotations

import mujoco
import numpy as np
import pytest

from imitarm.viewer.geometry import Mesh, box, capsule, cylinder, ellipsoid, geom_mesh, geom_rgba, merge, visible_geoms
from viewer_samples import world_xml


def volume(mesh: Mesh) -> float:
    """Signed: positive when all triangles are counter-clockwise seen from outside."""
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)


def is_closed(mesh: Mesh) -> bool:
    """Every edge is used once in each direction, when vertices at one place are taken as one."""
    _, index = np.unique(np.round(mesh.vertices, 9), axis=0, return_inverse=True)
    edges = np.concatenate([index.reshape(-1)[mesh.faces][:, pair] for pair in ([0, 1], [1, 2], [2, 0])])
    edges = edges[edges[:, 0] != edges[:, 1]]
    there = {tuple(edge) for edge in edges.tolist()}
    return all((b, a) in there for a, b in there)


@pytest.mark.parametrize(
    ("mesh", "exact", "within"),
    [
        (box([0.1, 0.2, 0.3]), 8 * 0.006, 1e-12),
        (cylinder(0.2, 0.3), np.pi * 0.04 * 0.6, 0.02),
        (capsule(0.2, 0.3), np.pi * 0.04 * 0.6 + 4 / 3 * np.pi * 0.008, 0.03),
        (ellipsoid([0.1, 0.2, 0.3]), 4 / 3 * np.pi * 0.006, 0.03),
    ],
    ids=["box", "cylinder", "capsule", "ellipsoid"],
)
def test_a_primitive_is_closed_points_outwards_and_has_its_volume(mesh: Mesh, exact: float, within: float) -> None:
    assert is_closed(mesh)
    assert volume(mesh) == pytest.approx(exact, rel=within)
    assert volume(mesh) <= exact * (1 + 1e-12)  # inscribed
    assert len(mesh.faces) < 1000


def test_no_triangle_is_degenerate() -> None:
    for mesh in (box([1, 1, 1]), cylinder(1, 1), capsule(1, 1), ellipsoid([1, 1, 1])):
        a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
        assert np.linalg.norm(np.cross(b - a, c - a), axis=1).min() > 1e-4


def test_merge_and_moved_keep_every_triangle() -> None:
    one, two = box([0.1, 0.1, 0.1]), cylinder(0.1, 0.2)
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    both = merge([one.moved([0, 0, 5], np.eye(3)), two.moved([3, 0, 0], turn)])
    assert volume(both) == pytest.approx(volume(one) + volume(two))
    assert both.faces.max() == len(both.vertices) - 1
    np.testing.assert_allclose(both.vertices[0], one.vertices[0] + [0, 0, 5])


def test_collision_geoms_and_transparent_ones_are_not_drawn() -> None:
    model = mujoco.MjModel.from_xml_string(world_xml())
    drawn = visible_geoms(model)
    assert all(model.geom_group[g] <= 2 for g in drawn)
    assert len(drawn) == model.ngeom - 7
    model.geom_rgba[drawn[0], 3] = 0.0
    assert drawn[0] not in visible_geoms(model)


def test_own_colour_wins_over_the_material_as_in_mujoco() -> None:
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><asset><material name="m" rgba="0 1 0 1"/></asset><worldbody>
        <geom type="sphere" size="1" material="m"/>
        <geom type="sphere" size="1" material="m" rgba="1 0 0 1"/><geom type="sphere" size="1"/>
        </worldbody></mujoco>"""
    )
    np.testing.assert_allclose(geom_rgba(model, 0), [0, 1, 0, 1])
    np.testing.assert_allclose(geom_rgba(model, 1), [1, 0, 0, 1])
    np.testing.assert_allclose(geom_rgba(model, 2), [0.5, 0.5, 0.5, 1])


def test_every_kind_of_geom_has_the_size_mujoco_gives_it() -> None:
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><asset><mesh name="roof" vertex="0 0 0  1 0 0  0 1 0  0 0 1"/></asset><worldbody>
        <geom type="sphere" size="0.1"/><geom type="ellipsoid" size="0.1 0.2 0.3"/>
        <geom type="capsule" size="0.1 0.2"/><geom type="cylinder" size="0.1 0.2"/><geom type="box" size="0.1 0.2 0.3"/>
        <geom type="plane" size="0.4 0.3 1"/><geom type="mesh" mesh="roof"/>
        <geom type="plane" size="0 0 1"/><geom type="plane" size="4 4 1"/></worldbody></mujoco>"""
    )
    wanted = [(0.2, 0.2, 0.2), (0.2, 0.4, 0.6), (0.2, 0.2, 0.6), (0.2, 0.2, 0.4), (0.2, 0.4, 0.6), (0.8, 0.6, 0.0)]
    for geom, size in enumerate(wanted):
        mesh = geom_mesh(model, geom)
        assert mesh is not None
        np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), size, rtol=0.01)
    roof = geom_mesh(model, 6)
    assert roof is not None and volume(roof) == pytest.approx(1 / 6, rel=1e-3)
    assert len(roof.vertices) == 4 * 3  # sharp: no two of its faces share a vertex
    assert geom_mesh(model, 7) is None and geom_mesh(model, 8) is None  # floors


def test_a_fine_mesh_is_thinned_and_keeps_its_shape() -> None:
    angles = np.linspace(0.0, np.pi, 60)
    ring = np.stack([np.sin(angles), np.cos(angles)], axis=1)
    around = np.linspace(0.0, 2.0 * np.pi, 80, endpoint=False)
    ball = np.stack(
        [np.outer(ring[:, 0], np.cos(around)), np.outer(ring[:, 0], np.sin(around)), np.outer(ring[:, 1], np.ones(80))],
        axis=-1,
    ).reshape(-1, 3)
    spec = mujoco.MjSpec()
    spec.add_mesh(name="ball", uservert=(0.1 * ball).ravel().tolist())
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="ball")
    model = spec.compile()
    assert model.nmeshface > 3000
    mesh = geom_mesh(model, 0)
    assert mesh is not None and 1000 < len(mesh.faces) <= 3000
    assert volume(mesh) == pytest.approx(4 / 3 * np.pi * 1e-3, rel=0.03)
    assert len(mesh.vertices) < 1.2 * len(mesh.faces)  # round: faces share vertices
