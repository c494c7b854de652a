"""Velocities of tracked obstacles over a longer time: less noise for steady motions, no change for all others."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from imitarm import Scene, Sphere
from imitarm.perception.steady_velocity import SteadyVelocities


def seen(time, position, velocity, track=3):
    return Scene(None, [Sphere(position, 0.04, velocity=velocity, track_id=track)], time)


@given(st.integers(0, 1000), st.floats(0.0, 0.6))
def test_a_steady_velocity_has_less_noise(seed, speed):
    rng, velocities = np.random.default_rng(seed), SteadyVelocities()
    true = np.array([0.0, speed, 0.0])
    for time in np.arange(0.0, 1.5, 0.01):
        place = time * true + 0.003 * rng.normal(size=3)
        noisy = true + np.array([0.06, -0.05, 0.03]) * np.sin(9.0 * time)
        found = velocities.improved(seen(float(time), place, noisy)).obstacles[0].velocity
    np.testing.assert_allclose(found, true, atol=0.025)
    if speed == 0.0:
        assert np.linalg.norm(found) < 0.015


def test_an_obstacle_that_stops_has_the_velocity_of_the_tracker():
    velocities = SteadyVelocities()
    for time in np.arange(0.0, 1.2, 0.01):
        moves = time < 1.0
        scene = seen(float(time), [0.5 * min(time, 1.0), 0.0, 0.0], [0.5 * moves, 0.0, 0.0])
        found = velocities.improved(scene)
    assert found is scene


@pytest.mark.parametrize("track", [None, 3])
def test_given_velocities_and_young_tracks_are_not_changed(track):
    velocities = SteadyVelocities()
    until = 0.3 if track is not None else 2.0
    for time in np.arange(0.0, until, 0.01):
        scene = seen(float(time), [0.0, 0.0, 0.0], [0.05, 0.0, 0.0], track)
        assert velocities.improved(scene) is scene


def test_another_track_begins_anew():
    velocities = SteadyVelocities()
    for time in np.arange(0.0, 1.0, 0.01):
        velocities.improved(seen(float(time), [0.0, 0.0, 0.0], [0.05, 0.0, 0.0], 3))
    scene = seen(1.0, [1.0, 0.0, 0.0], [0.05, 0.0, 0.0], 4)
    assert velocities.improved(scene) is scene
