from __future__ import annotations

import copy
import pickle
import threading

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from arm_figures import LIMITS, chain, newton_euler, panda_flange, potential_energy, sawyer_flange
from imitarm.errors import InputError, UnknownNameError
from imitarm.kinematics.arm import ArmModel, ArmState
from imitarm.kinematics.pose import Pose

ARMS = {name: ArmModel.load(name) for name in ("sawyer", "panda")}
TOOLED = {(name, tool): ArmModel.load(name, tool=tool) for name in ARMS for tool in ("gripper", "brush")}
POSTURES = 500
either = pytest.mark.parametrize("name", list(ARMS))


def postures(arm, n=POSTURES, seed=0):
    return np.random.default_rng(seed).uniform(arm.lower, arm.upper, size=(n, arm.n_joints))


def rotation_between(a, b):
    """Angle [rad] by the sine: the usual arc cosine of the trace has only 1e-8 rad of resolution."""
    d = a.T @ b
    skew = 0.5 * np.array([d[2, 1] - d[1, 2], d[0, 2] - d[2, 0], d[1, 0] - d[0, 1]])
    return np.arctan2(np.linalg.norm(skew), 0.5 * (np.trace(d) - 1.0))


@pytest.mark.parametrize(("name", "flange"), [("sawyer", sawyer_flange), ("panda", panda_flange)])
def test_flange_is_where_the_published_denavit_hartenberg_table_says(name, flange):
    arm = ARMS[name]
    for q in postures(arm):
        pose, expected = arm.forward_kinematics(q), flange(q)
        assert np.linalg.norm(pose.position - expected[:3, 3]) < 1e-6
        assert rotation_between(pose.rotation, expected[:3, :3]) < 1e-6


@either
def test_every_link_frame_is_that_of_the_published_description(name):
    arm = ARMS[name]
    model = arm.spec().compile()
    data = mujoco.MjData(model)
    links = [model.body(model.jnt_bodyid[i]).name for i in range(arm.n_joints)]
    for q in postures(arm, 20):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        for body, (frame, _) in zip(links, chain(name, q), strict=True):
            assert np.allclose(data.body(body).xpos, frame[:3, 3], atol=1e-9)
            assert np.allclose(data.body(body).xmat.reshape(3, 3), frame[:3, :3], atol=1e-9)


@either
def test_gravity_torque_is_that_of_the_published_masses(name):
    arm, rest = ARMS[name], np.zeros(7)
    for q in postures(arm):
        difference = arm.gravity_torque(q) - newton_euler(name, q, rest, rest)
        assert np.max(np.abs(difference)) < 1e-6  # 0.05 N m would do


@either
def test_gravity_torque_is_the_gradient_of_the_potential_energy(name):
    arm, h = ARMS[name], 1e-5
    for q in postures(arm, 30, seed=1):
        gradient = [(potential_energy(name, q + s) - potential_energy(name, q - s)) / (2 * h) for s in h * np.eye(7)]
        assert np.allclose(arm.gravity_torque(q), gradient, atol=1e-5)


@either
def test_inverse_dynamics_is_that_of_a_textbook_newton_euler_with_the_published_inertias(name):
    arm, rng = ARMS[name], np.random.default_rng(2)
    for q in postures(arm):
        qd, qdd = rng.normal(size=7), 3.0 * rng.normal(size=7)
        expected = newton_euler(name, q, qd, qdd)
        assert np.max(np.abs(arm.inverse_dynamics(q, qd, qdd) - expected)) < 1e-6 * max(1.0, np.max(np.abs(expected)))


@either
def test_power_is_the_change_of_energy(name):
    arm, rng, h = ARMS[name], np.random.default_rng(3), 1e-5
    for q in postures(arm, 20, seed=3):
        qd, qdd = rng.normal(size=7), rng.normal(size=7)

        def energy(t, q=q, qd=qd, qdd=qdd):
            position, velocity = q + qd * t + 0.5 * qdd * t * t, qd + qdd * t
            return 0.5 * velocity @ arm.mass_matrix(position) @ velocity + potential_energy(name, position)

        power = (energy(h) - energy(-h)) / (2 * h)
        assert arm.inverse_dynamics(q, qd, qdd) @ qd == pytest.approx(power, rel=1e-6, abs=1e-5)


@pytest.mark.parametrize(("name", "tool"), list(TOOLED))
def test_mass_matrix_is_what_acceleration_costs(name, tool):
    arm = TOOLED[name, tool]
    for q in postures(arm, 10):
        rest = arm.gravity_torque(q)
        columns = [arm.inverse_dynamics(q, np.zeros(7), unit) - rest for unit in np.eye(7)]
        inertia = arm.mass_matrix(q)
        assert np.allclose(inertia, np.array(columns).T, atol=1e-9)
        assert np.allclose(inertia, inertia.T, atol=1e-12)
        assert np.linalg.eigvalsh(inertia)[0] > 0.0


@pytest.mark.parametrize(("name", "tool"), [*TOOLED, ("sawyer", None), ("panda", None)])
def test_jacobians_are_finite_differences_of_the_poses(name, tool):
    arm, h = TOOLED.get((name, tool), ARMS[name]), 1e-6
    for q in postures(arm, 25, seed=4):
        for pose, jacobian in ((arm.forward_kinematics, arm.jacobian), (arm.tool_pose, arm.tool_jacobian)):
            columns = [pose(q - s).error_to(pose(q + s)) / (2 * h) for s in h * np.eye(7)]
            assert np.allclose(jacobian(q), np.array(columns).T, atol=1e-8)


@pytest.mark.parametrize(("name", "tool"), list(TOOLED))
def test_jacobians_of_the_covering_spheres_are_finite_differences(name, tool):
    arm, h = TOOLED[name, tool], 1e-6
    for q in postures(arm, 5, seed=5):
        columns = [(arm.collision_spheres(q + s)[0] - arm.collision_spheres(q - s)[0]) / (2 * h) for s in h * np.eye(7)]
        jacobians = arm.sphere_jacobians(q)
        assert jacobians.shape == (len(arm.sphere_bodies), 3, 7)
        assert np.allclose(jacobians, np.moveaxis(columns, 0, -1), atol=1e-8)
        centers, _ = arm.collision_spheres(q)
        last = arm.point_jacobian(q, arm.sphere_bodies[-1], centers[-1])
        assert np.allclose(last, jacobians[-1], atol=1e-12)


@either
@pytest.mark.parametrize("figure", ["lower", "upper", "max_velocity", "max_torque", "max_acceleration"])
def test_limits_are_the_published_ones(name, figure):
    if figure in LIMITS[name]:
        assert getattr(ARMS[name], figure).tolist() == LIMITS[name][figure]
    else:
        assert np.all(getattr(ARMS[name], figure) > 0.0)


@pytest.mark.parametrize(("name", "tool"), list(TOOLED))
def test_a_tool_loads_the_arm_with_its_weight_and_nothing_else(name, tool):
    bare, arm = ARMS[name], TOOLED[name, tool]
    mass = arm.spec().compile().body_mass.sum() - bare.spec().compile().body_mass.sum()
    assert 0.2 < mass < 1.0
    for q in postures(arm, 10):
        assert np.allclose(arm.forward_kinematics(q).matrix, bare.forward_kinematics(q).matrix, atol=1e-12)
        model = arm.spec().compile()
        data = mujoco.MjData(model)
        data.qpos[:] = arm.posture(model, q)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        bodies = [i for i in range(model.nbody) if model.body(i).name.startswith("tool/")]
        load = np.zeros(7)
        for body in bodies:
            jacobian = np.zeros((3, model.nv))
            mujoco.mj_jac(model, data, jacobian, None, data.xipos[body], body)
            load += jacobian[2, :7] * model.body_mass[body] * 9.81
        assert np.allclose(arm.gravity_torque(q) - bare.gravity_torque(q), load, atol=1e-9)


@pytest.mark.parametrize(("name", "tool"), list(TOOLED))
def test_home_is_comfortable(name, tool):
    arm = TOOLED[name, tool]
    pose = arm.tool_pose(arm.home)
    assert np.allclose(pose.rotation[:, 2], [0, 0, -1], atol=1e-3)  # the tool points down
    assert np.allclose(pose.rotation[:, 0], [1, 0, 0], atol=1e-3)  # and sweeps away from the base
    assert 0.4 < pose.position[0] < 0.7 and abs(pose.position[1]) < 1e-3 and 0.1 < pose.position[2] < 0.4
    assert np.all(np.minimum(arm.home - arm.lower, arm.upper - arm.home) > 0.5)
    scaled = arm.tool_jacobian(arm.home) * np.array([1, 1, 1, 0.3, 0.3, 0.3])[:, None]
    assert np.linalg.svd(scaled)[1][-1] > 0.1  # far from singular
    assert np.all(np.abs(arm.gravity_torque(arm.home)) < 0.5 * arm.max_torque)


def test_without_a_tool_the_tool_is_the_flange():
    arm = ARMS["panda"]
    assert not arm.has_tool and TOOLED["panda", "brush"].has_tool
    assert np.array_equal(arm.tool_to_flange.matrix, np.eye(4))
    q = arm.home
    assert np.array_equal(arm.tool_pose(q).matrix, arm.forward_kinematics(q).matrix)
    assert np.array_equal(arm.tool_jacobian(q), arm.jacobian(q))


@pytest.mark.parametrize(("name", "tool"), list(TOOLED))
def test_tool_to_flange_chains(name, tool):
    arm = TOOLED[name, tool]
    for q in postures(arm, 5):
        chained = arm.forward_kinematics(q) @ arm.tool_to_flange
        assert np.allclose(chained.matrix, arm.tool_pose(q).matrix, atol=1e-12)


def test_poses_made_without_checks_are_ordinary_ones():
    pose = ARMS["sawyer"].forward_kinematics(ARMS["sawyer"].home)
    again = Pose(pose.position, pose.quaternion)
    assert np.allclose(again.matrix, pose.matrix, atol=1e-12)
    with pytest.raises(ValueError, match="read-only"):
        pose.position[0] = 1.0


@settings(deadline=None, max_examples=30)
@given(st.data())
def test_what_was_asked_before_does_not_matter(data):
    arm = TOOLED["panda", "gripper"]
    rng = np.random.default_rng(data.draw(st.integers(0, 2**32 - 1)))
    a, b = postures(arm, 2, seed=data.draw(st.integers(0, 1000)))
    expected = arm.gravity_torque(a)
    arm.inverse_dynamics(b, rng.normal(size=7), rng.normal(size=7))
    arm.mass_matrix(b)
    assert np.array_equal(arm.gravity_torque(a), expected)
    arm.inverse_dynamics(a, rng.normal(size=7), rng.normal(size=7))
    assert np.array_equal(arm.gravity_torque(a), expected)


def test_results_are_the_callers_own():
    arm = ARMS["sawyer"]
    for method in (arm.jacobian, arm.gravity_torque, arm.mass_matrix):
        first = method(arm.home)
        kept = first.copy()
        method(arm.home + 0.3)
        assert np.array_equal(first, kept)
        first += 1.0
        assert np.array_equal(method(arm.home), kept)


def test_one_model_serves_many_threads():
    arm = TOOLED["sawyer", "brush"]
    sets = [postures(arm, 200, seed=seed) for seed in range(4)]
    expected = [[arm.tool_pose(q).position for q in some] for some in sets]
    wrong = []

    def work(some, right):
        for q, position in zip(some, right, strict=True):
            if not np.array_equal(arm.tool_pose(q).position, position):
                wrong.append(q)

    threads = [threading.Thread(target=work, args=pair) for pair in zip(sets, expected, strict=True)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong


def test_an_arm_never_changes():
    arm = ARMS["sawyer"]
    with pytest.raises(AttributeError, match="can't be changed"):
        arm.name = "other"
    with pytest.raises(ValueError, match="read-only"):
        arm.upper[0] = 5.0
    spec = arm.spec()
    spec.body("right_l3").pos = [1, 2, 3]
    spec.delete(spec.body("head"))
    assert arm.spec().body("head") is not None
    assert np.allclose(arm.spec().body("right_l3").pos, [0, -0.042, 0.26])


def test_an_arm_can_be_copied_and_sent_to_another_process():
    arm = TOOLED["panda", "brush"]
    for other in (copy.deepcopy(arm), pickle.loads(pickle.dumps(arm))):
        assert np.array_equal(other.tool_pose(arm.home).matrix, arm.tool_pose(arm.home).matrix)


def test_tool_path_is_the_tool_pose_of_each_row():
    arm = TOOLED["sawyer", "brush"]
    rows = postures(arm, 7)
    positions, quaternions = arm.tool_path(rows)
    assert positions.shape == (7, 3) and quaternions.shape == (7, 4)
    assert np.array_equal(positions[3], arm.tool_pose(rows[3]).position)
    assert np.array_equal(quaternions[6], arm.tool_pose(rows[6]).quaternion)
    assert arm.tool_path(np.zeros((0, 7)))[0].shape == (0, 3)


def test_a_world_is_put_into_the_arms_posture():
    arm = TOOLED["panda", "gripper"]
    world = mujoco.MjSpec()
    ball = world.worldbody.add_body(name="ball", pos=[0.1, 0.2, 0.3])
    ball.add_freejoint()
    ball.add_geom(size=[0.02, 0, 0])
    world.attach(arm.spec(), prefix="a/", frame=world.worldbody.add_frame(pos=[0, 0, 1]))
    model = world.compile()
    data = mujoco.MjData(model)
    data.qpos[:] = arm.posture(model, arm.home, prefix="a/")
    mujoco.mj_forward(model, data)
    assert np.allclose(data.body("ball").xpos, [0.1, 0.2, 0.3])
    assert np.allclose(data.site("a/tool").xpos - [0, 0, 1], arm.tool_pose(arm.home).position, atol=1e-12)
    assert model.joint("a/tool/left").qposadr is not None and data.joint("a/tool/left").qpos == 0.04


@pytest.mark.parametrize(
    ("q", "said"),
    [
        (np.zeros(6), r"must be 7 numbers \[rad\], got shape \(6,\)"),
        (np.zeros((1, 7)), "must be 7 numbers"),
        ([0, 0, np.nan, 0, 0, 0, 0], "finite"),
        ([0, 0, np.inf, 0, 0, 0, 0], "finite"),
    ],
)
@pytest.mark.parametrize("method", ["forward_kinematics", "jacobian", "gravity_torque", "collision_spheres"])
def test_what_is_no_posture_is_refused(q, said, method):
    with pytest.raises(InputError, match=said):
        getattr(ARMS["sawyer"], method)(q)


def test_a_joint_past_its_limit_is_named():
    arm = ARMS["panda"]
    arm.check_limits(arm.home)
    q = arm.home.copy()
    q[3] = 0.2
    with pytest.raises(InputError, match=r"panda_joint4 at 0\.2000 rad is outside its limits \[-3\.0718, -0\.0698\]"):
        arm.check_limits(q)


def test_an_unknown_body_is_answered_with_the_known_ones():
    with pytest.raises(UnknownNameError, match="right_l5"):
        ARMS["sawyer"].point_jacobian(ARMS["sawyer"].home, "elbow", [0, 0, 0])


Q = np.full(7, 0.3)
WORLD = ARMS["sawyer"].spec().compile()
GOOD = {
    "at": {"q": Q},
    "forward_kinematics": {"q": Q},
    "tool_pose": {"q": Q},
    "tool_path": {"joints": np.full((2, 7), 0.3)},
    "jacobian": {"q": Q},
    "tool_jacobian": {"q": Q},
    "point_jacobian": {"q": Q, "body": "right_hand", "point": np.zeros(3)},
    "sew_points": {"q": Q},
    "sew_jacobians": {"q": Q},
    "collision_spheres": {"q": Q},
    "sphere_centers": {"q": Q},
    "sphere_jacobians": {"q": Q},
    "gravity_torque": {"q": Q},
    "inverse_dynamics": {"q": Q, "qd": Q, "qdd": Q},
    "mass_matrix": {"q": Q},
    "check_limits": {"q": 0.0 * Q - 0.1, "tolerance": 10.0},
    "posture": {"model": WORLD, "q": Q, "prefix": ""},
    "site": {"frame": "tool"},
    "load": {
        "name_or_path": "sawyer", "tool": "brush", "flange": "right_hand", "package_path": (), "discard_meshes": False,
    },
}  # fmt: skip
CORRUPTED = [
    None, np.nan, "nonsense", "", b"x", 3, -1.5, 1j, True, {}, [], [None], object(),
    np.zeros(6), np.zeros((7, 7)), np.zeros((2, 3)), np.full(7, np.nan), np.full(3, np.inf), np.array(["a"] * 7),
    [[1.0], [2.0, 3.0]], "\0", "x" * 5000,
]  # fmt: skip
ALLOWED = [  # what is right although it is in the list above
    ("posture", "q", "None"), ("posture", "prefix", "''"), ("load", "tool", "None"), ("load", "flange", "None"),
    ("load", "flange", "''"), ("load", "discard_meshes", "True"), ("load", "package_path", "[]"),
    ("check_limits", "tolerance", "3"), ("load", "package_path", "''"), ("tool_path", "joints", repr(np.zeros((7, 7)))),
]  # fmt: skip


def test_all_public_methods_are_among_those_that_are_given_nonsense():
    public = {name for name in dir(ArmModel) if not name.startswith("_") and callable(getattr(ArmModel, name))}
    assert public == {*GOOD, "spec", "required_landmarks", "check_dynamics"}  # these three take nothing


@pytest.mark.parametrize("method", GOOD)
def test_every_argument_of_every_method_is_checked(method):
    """No crash, no silent NaN, no foreign error: InputError, whatever is given."""
    call = getattr(ARMS["sawyer"], method)
    call(**GOOD[method])
    for argument in GOOD[method]:
        for value in CORRUPTED:
            if (method, argument, repr(value)) in ALLOWED:
                continue
            with pytest.raises(InputError):
                call(**{**GOOD[method], argument: value})
                pytest.fail(f"{method}({argument}={value!r}) was taken")


def test_a_point_that_moves_with_a_body_is_checked_before_it_reaches_the_engine():
    """MuJoCo ends the process when it is given no name."""
    for body, point in ((None, np.zeros(3)), ("right_hand", None), (3, np.zeros(3))):
        with pytest.raises(InputError):
            ARMS["sawyer"].point_jacobian(Q, body, point)


def test_a_state_is_checked():
    assert ArmState([0.0, 1.0], [0, 0], np.zeros(2), 0).q.dtype == float
    for values in (
        (Q, Q, np.zeros(6), 0.0),
        (Q, np.full(7, np.nan), Q, 0.0),
        (None, Q, Q, 0.0),
        (Q, Q, Q, np.nan),
        (Q, Q, Q, None),
    ):
        with pytest.raises(InputError):
            ArmState(*values)
