from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from imitarm import ArmModel
from imitarm.errors import InputError
from imitarm.retarget.baselines.demonstrated_motion import FeasibilityCheck, above, blend, segments, upright

SAWYER = ArmModel.load("sawyer", tool="gripper")
F = FeasibilityCheck(SAWYER, 0.01)


def standing(q, n=5):
    return np.tile(q, (n, 1))


def only(reasons):
    return {name for name, found in reasons.items() if found.any()}


def test_a_comfortable_posture_is_feasible():
    assert F.clear(standing(SAWYER.home))
    assert F.allows(SAWYER.home)
    assert not F.anywhere(standing(SAWYER.home)).any()


def test_each_predicate_finds_what_it_is_for():
    beyond = SAWYER.home.copy()
    beyond[0] = SAWYER.upper[0] + 0.01
    assert only(F.reasons(standing(beyond))) == {"limits"}
    straight = SAWYER.home.copy()
    straight[3] = 0.31
    assert only(F.reasons(standing(straight))) == {"stretched"}
    straight[3] = 0.33
    assert F.allows(straight)
    fast = SAWYER.home + np.outer(np.arange(5), 1.1 * 0.01 * SAWYER.max_velocity * [1, 0, 0, 0, 0, 0, 0])
    assert only(F.reasons(fast)) == {"speed"}


def test_singular_is_where_the_tool_can_hardly_move_in_some_direction():
    joints = np.random.default_rng(0).uniform(SAWYER.lower, SAWYER.upper, (300, 7))
    least = np.array([np.linalg.svd(SAWYER.tool_jacobian(q), compute_uv=False)[-1] for q in joints])
    found = F.postures(joints)["singular"]
    assert 5 < found.sum() < 100
    assert (least[found] < 0.03).all()
    assert (least[~found] >= 0.03).all()


def test_only_the_samples_beside_a_quick_step_are_too_fast():
    joints = standing(SAWYER.home, 10)
    joints[6:, 0] += 0.1
    np.testing.assert_array_equal(np.flatnonzero(F.too_fast(joints)), [5, 6])


def test_a_teachers_constraints_count_too():
    table = FeasibilityCheck(SAWYER, 0.01, {"table": above(0.5), "upright": upright(np.deg2rad(15.0))})
    assert only(table.reasons(standing(SAWYER.home))) == {"table"}  # the home is lower, and looks down
    turned = SAWYER.home.copy()
    turned[5] += np.deg2rad(20.0)
    assert "upright" in only(table.reasons(standing(turned)))
    assert not table.allows(turned)
    with pytest.raises(InputError, match="speed"):
        FeasibilityCheck(SAWYER, 0.01, {"speed": above(0.0)})


@given(st.lists(st.booleans(), min_size=1, max_size=200))
def test_segments_hold_all_that_was_found_and_lie_apart(found):
    found = np.array(found)
    parts = segments(found, 0.05)
    held = np.zeros(len(found), dtype=bool)
    for first, past in parts:
        assert 0 <= first < past <= len(found)
        held[first:past] = True
    near = np.array([found[max(i - 4, 0) : i + 5].any() for i in range(len(found))])
    np.testing.assert_array_equal(held, near)  # 0.2 s to both sides are four samples
    assert all(a[1] < b[0] for a, b in pairwise(parts))


def test_a_change_is_whole_where_it_is_needed_and_gone_at_the_ends():
    found = np.zeros(100, dtype=bool)
    found[40:45] = True
    ((first, past),) = segments(found, 0.01)
    weight = blend(found, first, past, 0.01)
    assert (weight[found[first:past]] == 1.0).all()
    assert weight[0] == weight[-1] == pytest.approx(0.0, abs=1e-9)
    assert (np.diff(weight[: 40 - first]) >= 0.0).all()
