"""The packaged arms and tools as things: what is seen, what can be touched, what they weigh."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from imitarm.kinematics.arm import ArmModel
from shapes import rotation, signed_distance, surface_points

ARMS = ["sawyer", "panda"]
COMPOSED = [(arm, tool) for arm in ARMS for tool in (None, "gripper", "brush")]
every = pytest.mark.parametrize(("arm", "tool"), COMPOSED)


def compiled(arm, tool):
    return ArmModel.load(arm, tool=tool).spec().compile()


@every
def test_looks_touch_nothing_and_contact_shapes_weigh_nothing(arm, tool):
    model = compiled(arm, tool)
    looks, contact = model.geom_group == 2, model.geom_group == 3
    assert np.all(looks | contact)
    assert not np.any(model.geom_contype[looks] | model.geom_conaffinity[looks])
    assert np.all(model.geom_contype[contact] & model.geom_conaffinity[contact])


@every
def test_what_is_seen_of_a_link_is_inside_what_can_be_touched(arm, tool):
    """A measured clearance is then never better than what the eye sees (to 1 mm)."""
    model = compiled(arm, tool)
    for geom in np.flatnonzero(model.geom_group == 2):
        body = model.geom_bodyid[geom]
        points = surface_points(model, geom, 300, 0)
        while not np.any((model.geom_bodyid == body) & (model.geom_group == 3)):  # the head is covered by its link
            points = points @ rotation(model.body_quat[body]).T + model.body_pos[body]
            body = model.body_parentid[body]
        shapes = np.flatnonzero((model.geom_bodyid == body) & (model.geom_group == 3))
        distance = np.min([signed_distance(model, shape, points) for shape in shapes], axis=0)
        assert np.max(distance) < 1e-3, (model.body(body).name, geom)


@every
def test_at_home_nothing_touches(arm, tool):
    loaded = ArmModel.load(arm, tool=tool)
    model = loaded.spec().compile()
    data = mujoco.MjData(model)
    data.qpos[:] = loaded.posture(model)
    mujoco.mj_forward(model, data)
    assert data.ncon == 0


@every
def test_neighbouring_links_never_touch(arm, tool):
    """Links joined by one joint overlap on purpose; their contact is left out, so that it can't lock the arm."""
    loaded = ArmModel.load(arm, tool=tool)
    model = loaded.spec().compile()
    data = mujoco.MjData(model)
    neighbours = set()
    for joint in range(model.njnt):
        body = model.jnt_bodyid[joint]
        neighbours.add(frozenset((model.body_weldid[body], model.body_weldid[model.body_parentid[body]])))
    for q in np.random.default_rng(0).uniform(loaded.lower, loaded.upper, size=(60, 7)):
        data.qpos[:] = loaded.posture(model, q)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        for contact in data.contact:
            pair = frozenset(int(model.body_weldid[model.geom_bodyid[geom]]) for geom in contact.geom)
            assert pair not in neighbours


@pytest.mark.parametrize("tool", ["gripper", "brush"])
@pytest.mark.parametrize("arm", ARMS)
def test_the_tool_radius_holds_the_head_of_the_tool(arm, tool):
    loaded = ArmModel.load(arm, tool=tool)
    model = loaded.spec().compile()
    data = mujoco.MjData(model)
    data.qpos[:] = loaded.posture(model)
    mujoco.mj_kinematics(model, data)
    to_tool = loaded.tool_pose(loaded.home).inverse()
    widest = 0.0
    for geom in range(model.ngeom):
        if model.body(model.geom_bodyid[geom]).name.startswith("tool/"):
            world = surface_points(model, geom, 200, 0, in_body=False) @ data.geom_xmat[geom].reshape(3, 3).T
            points = to_tool.apply(world + data.geom_xpos[geom])
            assert points[:, 2].max() < (1e-9 if tool == "brush" else 0.011)  # pads reach past the point they grip
            widest = max(widest, np.hypot(points[:, 0], points[:, 1]).max())
    assert widest <= loaded.tool_radius + 1e-9
    assert widest > 0.9 * loaded.tool_radius
    if tool == "brush":
        assert loaded.tool_radius <= 0.06


def test_the_brush_is_a_u_that_is_open_ahead():
    """Crumbs inside can't leave sideways or to the back, only ahead."""
    model = compiled("sawyer", "brush")
    walls = [g for g in range(model.ngeom) if model.geom_group[g] == 3 and model.geom(g).name.startswith("tool/")]
    height = 0.198  # just above the tip, where crumbs are

    def open_way(angle):
        ray = np.linspace(0.0, 0.06, 120)[:, None] * [np.cos(angle), np.sin(angle), 0.0] + [0.005, 0.0, height]
        return np.min([signed_distance(model, wall, ray) for wall in walls]) > 0.0

    degrees = np.arange(-180, 180, 1)
    opened = degrees[[open_way(np.radians(d)) for d in degrees]]
    assert np.array_equal(opened, np.arange(opened[0], opened[-1] + 1))  # one opening
    assert opened[0] == pytest.approx(-opened[-1], abs=1)  # about the sweeping direction
    assert 45 <= opened[-1] <= 75
    bristles = [wall for wall in walls if model.geom_size[wall][2] == 0.02]
    assert len(bristles) == 5
    outline = np.concatenate([surface_points(model, wall, 300, 0) for wall in bristles])
    assert np.ptp(outline[:, 1]) == pytest.approx(0.090, abs=0.002)
    assert np.ptp(outline[:, 0]) == pytest.approx(0.060, abs=0.002)


@pytest.mark.parametrize("arm", ARMS)
def test_the_gripper_opens_and_closes_both_fingers_alike(arm):
    loaded = ArmModel.load(arm, tool="gripper")
    model = loaded.spec().compile()
    model.opt.gravity[:] = 0.0
    data = mujoco.MjData(model)
    data.qpos[:] = loaded.posture(model)
    for opening in (0.0, 0.03, 0.08):
        data.actuator("tool/opening").ctrl = opening
        for _ in range(1500):
            data.qpos[:7], data.qvel[:7] = loaded.home, 0.0
            mujoco.mj_step(model, data)
        fingers = np.array([data.joint("tool/left").qpos[0], data.joint("tool/right").qpos[0]])
        assert np.allclose(fingers, opening / 2, atol=1e-3)
        pads = [data.geom(f"tool/collision_{side}_pad").xpos for side in ("left", "right")]
        middle = 0.5 * (pads[0] + pads[1])
        axis = loaded.tool_pose(loaded.home)
        assert np.linalg.norm((axis.inverse().apply(middle))[:2]) < 1e-3


@pytest.mark.parametrize(("arm", "mass"), [("sawyer", 20.7337), ("panda", 16.6919)])
def test_total_mass_is_the_sum_of_the_published_ones(arm, mass):
    assert compiled(arm, None).body_mass.sum() == pytest.approx(mass, abs=1e-3)


@every
def test_a_limp_arm_swings_quietly(arm, tool):
    """Damping and rotor inertia are for the simulator: with them a free arm comes to rest at 2 ms steps."""
    loaded = ArmModel.load(arm, tool=tool)
    spec = loaded.spec()
    spec.option.timestep = 0.002
    model = spec.compile()
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    data = mujoco.MjData(model)
    data.qpos[:] = loaded.posture(model)
    for _ in range(4000):
        mujoco.mj_step(model, data)
    assert np.all(np.isfinite(data.qpos))
    assert not any(w.number for w in data.warning)
    assert np.max(np.abs(data.qvel)) < 0.4
