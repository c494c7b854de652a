from __future__ import annotations

import itertools

import mujoco
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from imitarm.errors import InputError
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.ik import solve_ik
from imitarm.kinematics.tasks import PostureTask, TwistTask
from imitarm.scene.clearance import SelfClearance, _shapes, meeting_links

ARMS = {name: ArmModel.load(name, tool="gripper") for name in ("sawyer", "panda")}
CLEARANCES = {name: SelfClearance(arm) for name, arm in ARMS.items()}
either = pytest.mark.parametrize("name", list(ARMS))
seeds = st.integers(0, 2**32 - 1)


def folded(name, seed):
    """Postures near to limits, where arms meet themselves."""
    arm, rng = ARMS[name], np.random.default_rng(seed)
    return rng.uniform(arm.lower, arm.upper)


def all_spheres(arm, q):
    """Centers, radii and links of the spheres of the arm and, after them, of its base."""
    centers, radii = arm.collision_spheres(q)
    base = arm.cover.base_centers, arm.cover.base_radii
    links = np.concatenate([arm.cover.links, np.zeros(len(base[1]), dtype=int)])
    return np.concatenate([centers, base[0]]), np.concatenate([radii, base[1]]), links


@settings(deadline=None, max_examples=60)
@given(st.sampled_from(list(ARMS)), seeds)
def test_the_nearest_pairs_are_those_of_all_pairs_looked_at_one_by_one(name, seed):
    arm, own = ARMS[name], CLEARANCES[name]
    q = folded(name, seed)
    (centers, radii, links), (at_home, _, _) = all_spheres(arm, q), all_spheres(arm, arm.home)
    meet = meeting_links(arm)
    best: dict[tuple[int, int], float] = {}
    close: list[float] = []
    for i in range(len(radii)):
        for j in np.flatnonzero(meet[links[i], links]):
            if np.linalg.norm(at_home[i] - at_home[j]) - radii[i] - radii[j] >= own.clearance:
                gap = np.linalg.norm(centers[i] - centers[j]) - radii[i] - radii[j]
                key = (links[i], links[j])
                close.append(gap)
                best[key] = min(best.get(key, np.inf), gap)
    near = sorted(gap for gap in best.values() if gap < own.clearance + 0.15)[:6]
    close = sorted(gap for gap in close if gap < own.clearance + 0.06)[:64]
    pairs, distances = own.nearest(q)
    expected = np.unique(np.round(np.concatenate([near, close]), 9))
    assert np.allclose(np.unique(np.round(distances, 9)), expected, atol=1e-8)
    assert len(distances) <= 70 and np.all(np.diff(distances) > -1e-5)  # sorted, to single precision
    assert own.distance(q) == pytest.approx(min(best.values()), abs=1e-9)
    for (i, j), gap in zip(pairs, distances, strict=True):
        assert gap == pytest.approx(np.linalg.norm(centers[i] - centers[j]) - radii[i] - radii[j], abs=1e-9)


@settings(deadline=None, max_examples=40)
@given(st.sampled_from(list(ARMS)), seeds)
def test_rows_are_the_gradients_of_the_distances(name, seed):
    arm, own = ARMS[name], CLEARANCES[name]
    q = folded(name, seed)
    pairs, distances = own.nearest(q)
    assume(len(pairs) > 0)
    rows, lower, _ = own.rows(q)
    room = distances - 0.02
    assert np.allclose(lower, -np.where(room < 0.0, 25.0, 5.0) * room)
    h = 1e-6

    def gaps(posture):
        centers = all_spheres(arm, posture)[0]
        return np.linalg.norm(centers[pairs[:, 0]] - centers[pairs[:, 1]], axis=1)

    for joint, step in enumerate(h * np.eye(7)):
        assert np.allclose(rows[:, joint], (gaps(q + step) - gaps(q - step)) / (2 * h), atol=1e-7)


@either
def test_home_is_clear_of_what_is_watched(name):
    own = CLEARANCES[name]
    assert own.n_pairs > 1000
    assert own.distance(ARMS[name].home) >= own.clearance
    links = all_spheres(ARMS[name], ARMS[name].home)[2]
    pairs, _ = own.nearest(ARMS[name].home)
    assert all(links[i] > links[j] + 1 for i, j in pairs)


@pytest.mark.parametrize(
    ("name", "fold"), [("sawyer", [0, -1.0, 0, 2.9, 0, 1.4, 0]), ("panda", [0, -0.9, 0, -3.0, 0, 0.4, 0.8])]
)
def test_an_arm_that_is_led_into_itself_stops_short(name, fold):
    arm, own = ARMS[name], CLEARANCES[name]
    target = arm.tool_pose(np.array(fold))

    def least(rows):
        q, velocity, nearest = arm.home.copy(), np.zeros(7), np.inf
        for _ in range(500):
            twist = 3.0 * arm.tool_pose(q).error_to(target)
            tasks = [TwistTask(twist, max_speed=0.4), PostureTask(np.array(fold))]
            found = own.rows(q) if rows else None
            velocity = solve_ik(arm, q, tasks, velocity=velocity, rows=() if found is None else found)
            q = q + 0.01 * velocity
            nearest = min(nearest, own.distance(q))
        return nearest

    assert least(rows=False) < 0.0  # without the rows it runs into itself
    assert least(rows=True) > own.clearance - 0.003


@either
def test_links_that_are_said_not_to_meet_do_not(name):
    """In other postures than those that were tried, by the exact distance of their shapes."""
    arm, rng = ARMS[name], np.random.default_rng(0)
    meet = meeting_links(arm)
    model = arm.spec().compile()
    data, shapes = mujoco.MjData(model), _shapes(arm, model)
    for q in rng.uniform(arm.lower, arm.upper, (300, 7)):
        data.qpos[:] = arm.posture(model, q)
        mujoco.mj_kinematics(model, data)
        for outer in range(2, 8):
            for inner in np.flatnonzero(~meet[outer, : outer - 1]):
                for one, other in itertools.product(shapes[outer], shapes[inner]):
                    assert mujoco.mj_geomDistance(model, data, one, other, 0.01, None) > 0.0
    assert meet[7, 0] and meet[7, 1] and not meet[3, 1] and not np.triu(meet).any()
    assert all(shapes)


@settings(deadline=None, max_examples=25)
@given(st.sampled_from(list(ARMS)), seeds)
def test_a_periodic_search_predicts_the_distances_in_between(name, seed):
    """Joints at no more than 1 rad/s: what is missing of the distances after 50 ms is a fraction of the clearance."""
    arm, own, rng = ARMS[name], CLEARANCES[name], np.random.default_rng(seed)
    watch, q, velocity = own.periodic(), folded(name, seed), rng.uniform(-1.0, 1.0, 7)
    pairs, _ = own.nearest(q)
    for step in range(5):
        rows = watch.rows(q, may_search=False)
        if len(pairs) == 0:
            assert rows is None
            continue
        centers, radii, _ = all_spheres(arm, q)
        gaps = np.linalg.norm(centers[pairs[:, 0]] - centers[pairs[:, 1]], axis=1) - radii[pairs].sum(axis=1)
        told = own.clearance - rows[1] / np.where(rows[1] > 0.0, 25.0, 5.0)
        apart = gaps > 0.0  # deep inside each other distances change quickly
        assert np.abs(told - gaps)[apart].max(initial=0.0) < (1e-9 if step == 0 else 0.008)
        q = q + 0.01 * velocity
    later = watch.rows(q)
    assert (later is None) == (own.rows(q) is None)
    if later is not None:
        np.testing.assert_allclose(later[1], own.rows(q)[1])


def test_no_rows_when_nothing_is_near(tmp_path):
    file = tmp_path / "two.xml"
    file.write_text(
        "<mujoco><worldbody><body><joint/><geom size='.1'/><body pos='0 0 .3'><joint axis='0 1 0'/><geom size='.1'/>"
        "</body></body></worldbody></mujoco>"
    )
    two = SelfClearance(ArmModel.load(file))
    assert two.n_pairs == 0 and two.rows([0, 0]) is None and two.distance([0, 0]) == np.inf


@pytest.mark.parametrize("options", [{"clearance": -0.1}, {"clearance": np.nan}, {"n_rows": 0}, {"gain": 0.0}])
def test_what_can_not_be_used_is_refused(options):
    with pytest.raises(InputError, match="SelfClearance: "):
        SelfClearance(ARMS["panda"], **options)
