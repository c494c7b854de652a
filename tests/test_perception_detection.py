"""A detection keeps what was measured and refuses what can't be a measurement."""

from __future__ import annotations

import numpy as np
import pytest

from imitarm.errors import InputError
from imitarm.perception import Detection
from imitarm.scene import Sphere


def test_a_detection_knows_its_position_and_can_not_be_changed():
    given = 1e-4 * np.eye(3)
    detection = Detection(Sphere([0.1, 0.2, 0.3], 0.05), given, "ball")
    np.testing.assert_array_equal(detection.position, [0.1, 0.2, 0.3])
    given[0, 0] = 1.0
    assert detection.covariance[0, 0] == 1e-4
    with pytest.raises(ValueError, match="read-only"):
        detection.covariance[0, 0] = 1.0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"obstacle": "a ball"}, "obstacle must be an obstacle"),
        ({"covariance": np.eye(2)}, r"shape \(3, 3\)"),
        ({"covariance": np.full((3, 3), np.nan)}, "finite"),
        ({"covariance": -np.eye(3)}, "positive semi-definite"),
        ({"covariance": np.triu(np.ones((3, 3)))}, "symmetric"),
        ({"label": 3}, "label must be text"),
    ],
)
def test_bad_arguments_are_refused(changes, message):
    good = {"obstacle": Sphere([0, 0, 1], 0.1), "covariance": np.eye(3)}
    with pytest.raises(InputError, match=message):
        Detection(**{**good, **changes})
