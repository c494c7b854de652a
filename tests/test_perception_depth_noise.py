"""The noise of a depth camera has the stated size, is seeded, and leaves nothing invalid."""

from __future__ import annotations

import numpy as np
import pytest

from imitarm.errors import InputError
from imitarm.kinematics.pose import Pose
from imitarm.perception import DepthFrame, DepthNoise, Intrinsics

CAMERA = Intrinsics.from_field_of_view(160, 120, 1.0)


def flat(depth):
    return DepthFrame(0.0, np.full((120, 160), depth), CAMERA, Pose.identity())


@pytest.mark.parametrize("depth", [0.5, 1.5, 4.0])
def test_the_standard_deviation_is_as_stated(depth):
    noise = DepthNoise(dropout=0.0)
    noisy = noise.apply(flat(depth), np.random.default_rng(1)).depth
    assert np.std(noisy - depth) == pytest.approx(float(noise.sigma(depth)), rel=0.03)
    assert abs(np.mean(noisy - depth)) < 3.0 * float(noise.sigma(depth)) / np.sqrt(noisy.size)
    np.testing.assert_allclose(noisy, np.round(noisy, 3), atol=1e-12)


def test_pixels_are_lost_and_mixed_at_edges():
    depth = np.full((120, 160), 2.0)
    depth[:, 80:] = 1.0
    frame = DepthFrame(0.0, depth, CAMERA, Pose.identity())
    noise = DepthNoise(offset=0.0, growth=0.0, edge_dropout=0.5, dropout=0.05, mixed=0.4, step=0.0)
    noisy = noise.apply(frame, np.random.default_rng(2)).depth
    lost = np.isnan(noisy)
    assert abs(lost[:, 80].mean() - 0.5) < 0.15
    assert abs(np.delete(lost, 80, axis=1).mean() - 0.05) < 0.01
    edge = noisy[:, 80][~lost[:, 80]]
    assert abs(np.mean(edge > 1.0) - 0.4) < 0.2
    assert (edge <= 2.0).all()


def test_the_same_seed_gives_the_same_image_and_no_noise_changes_nothing():
    frame = flat(1.0)
    first, second = (DepthNoise().apply(frame, np.random.default_rng(5)).depth for _ in range(2))
    np.testing.assert_array_equal(first, second)
    np.testing.assert_array_equal(DepthNoise.none().apply(frame, np.random.default_rng(0)).depth, frame.depth)
    assert DepthNoise.none().sigma(2.0) == 0.0


def test_bad_numbers_are_refused():
    for changes in ({"offset": -1.0}, {"growth": np.nan}, {"dropout": 1.1}, {"edge_dropout": -0.1}, {"step": "1"}):
        with pytest.raises(InputError, match=next(iter(changes))):
            DepthNoise(**changes)
