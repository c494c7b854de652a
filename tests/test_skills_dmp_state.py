from __future__ import annotations

import numpy as np
import pytest

from imitarm.skills.course import Course
from imitarm.skills.dmp_state import DMPState
from imitarm.skills.quaternion_dmp import Turn

COURSE = Course(np.zeros(3), np.ones(3), 4.0, "progress", np.zeros((5, 3)))
MOTION = np.array([[1.0, 2.0, 3.0], [4.0, 0.0, -4.0]])


def test_it_answers_in_metres_and_seconds() -> None:
    state = DMPState(MOTION, 0.5, COURSE)
    np.testing.assert_array_equal(state.position, [1.0, 2.0, 3.0])
    np.testing.assert_array_equal(state.velocity, [1.0, 0.0, -1.0])
    assert state.time == 2.0
    assert state.phase == pytest.approx(0.1)
    assert state.quaternion is None


def test_the_phase_falls_from_one_to_a_hundredth() -> None:
    assert DMPState(MOTION, 0.0, COURSE).phase == 1.0
    assert DMPState(MOTION, 1.0, COURSE).phase == pytest.approx(0.01)


def test_the_rotation_is_that_of_the_turn() -> None:
    q = np.array([1.0, 0.0, 0.0, 0.0])
    turn = Turn(q, np.zeros((2, 3)), 0.5, np.zeros(3), np.zeros(3))
    assert DMPState(MOTION, 0.5, COURSE, turn).quaternion is q
