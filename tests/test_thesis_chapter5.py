"""What docs/thesis_map.md says of Chapter 5: one class for each part of the chapter."""

from __future__ import annotations

import time

import numpy as np
import pytest

from imitarm.evaluation.intervals import wilson_interval
from imitarm.kinematics.pose import Pose
from imitarm.perception import Detection, ObstacleTracker
from imitarm.policies import RCAMO, DistanceCost, GaussianCost
from imitarm.policies.obstacle_cost import Groups, PredictedObstacles
from imitarm.policies.primitive_path import learned_precision
from imitarm.scene import Scene, Sphere
from imitarm.skills import Skill
from imitarm.trajectory import Demonstration, Trajectory


class TestTracking:
    """Section 5.1.3, Eqs 5.2 to 5.4 and Fig 5.9: the obstacle's position."""

    SIGMA = 0.005  # [m]
    NOISE = SIGMA**2 * np.eye(3)
    VELOCITY = np.array([0.3, 0.1, 0.0])  # [m/s]

    def watched(self, motion="constant-velocity", n=90, seed=0):
        """Follow a steady obstacle; return detections, tracks and true positions."""
        rng = np.random.default_rng(seed)
        tracker = ObstacleTracker(motion)
        times = np.arange(n) / 30.0
        truth = times[:, None] * self.VELOCITY
        detected = truth + rng.normal(0.0, self.SIGMA, truth.shape)
        tracks = [
            tracker.update(stamp, [Detection(Sphere(z, 0.05), self.NOISE)])
            for stamp, z in zip(times, detected, strict=True)
        ]
        return detected, [found[0] if found else None for found in tracks], truth

    def test_an_estimate_that_contains_the_noise_is_worse(self):
        """Eq 5.2 adds the noise of the motion to the estimate; a Kalman filter adds its covariance to P."""
        _, tracks, _ = self.watched()
        q, dt = 0.05, 1.0 / 30.0
        rng = np.random.default_rng(1)
        noise = rng.normal(0.0, np.sqrt(q * dt), (len(tracks), 3))  # of the velocity, for one step
        estimates = np.array([t.velocity for t in tracks[30:]])
        clean = np.sqrt(((estimates - self.VELOCITY) ** 2).mean())
        printed = np.sqrt(((estimates + noise[30:] - self.VELOCITY) ** 2).mean())
        assert printed > 1.2 * clean

    def test_predicted_positions_have_a_covariance_that_grows(self):
        """Eqs 5.3 and 5.4: a set of predicted positions, each with a covariance."""
        track = self.watched()[1][-1]
        ahead = [track.predict(tau) for tau in (0.0, 0.1, 0.2, 0.4)]
        sizes = [np.trace(one.covariance[:3, :3]) for one in ahead]
        assert (np.diff(sizes) > 0.0).all()
        np.testing.assert_allclose(ahead[2].position, track.position + 0.2 * track.velocity, atol=1e-12)

    def test_the_first_position_is_the_prior_and_the_deviation_shrinks_to_a_limit(self):
        """The text says that the deviation "becomes smaller": it does, until noise and motion balance."""
        detected, tracks, _ = self.watched()
        first = ObstacleTracker(confirm=(1, 1)).update(0.0, [Detection(Sphere(detected[0], 0.05), self.NOISE)])[0]
        np.testing.assert_array_equal(first.position, detected[0])
        sizes = np.array([np.trace(t.covariance[:3, :3]) for t in tracks[1:]])
        assert (np.diff(sizes) < 1e-12).all()
        assert sizes[-1] == pytest.approx(sizes[-10], rel=1e-6)
        assert sizes[-1] > 0.1 * np.trace(self.NOISE)

    def test_figure_5_9_the_estimate_is_steadier_and_nearer_to_the_truth_than_the_detections(self):
        detected, tracks, truth = self.watched()
        estimates = np.array([t.position for t in tracks[15:]])
        steps = [np.diff(x, n=2, axis=0).std() for x in (estimates, detected[15:])]
        assert steps[0] < 0.6 * steps[1]  # steadier
        errors = [np.sqrt(((x - truth[15:]) ** 2).sum(axis=1).mean()) for x in (estimates, detected[15:])]
        assert errors[0] < 0.8 * errors[1]

    def test_the_extended_filter_is_not_too_expensive(self):
        """The text calls the EKF "not ideal for real-time problems" because of its cost; 30 Hz leave 33 ms."""
        tracker = ObstacleTracker("ekf")
        camera = Pose(np.array([0.0, 0.0, -2.0]), np.array([1.0, 0.0, 0.0, 0.0]))
        positions = np.random.default_rng(0).uniform(-0.5, 0.5, (10, 3))
        began = time.process_time()
        for k in range(30):
            found = [Detection(Sphere(p, 0.02), self.NOISE, camera_to_base=camera) for p in positions]
            assert len(tracker.update(k / 30.0, found)) == (10 if k else 0)
        assert time.process_time() - began < 1.0  # one second of frames, on any machine


def test_equation_5_1_as_printed_grows_with_the_distance():
    """Section 5.1.2: the exponent lacks its minus sign, and a width is subtracted from a cost."""
    distance = np.linspace(0.0, 0.5, 20)
    printed = 1.0 * np.exp(distance**2 * 40.0) - 0.05
    assert (np.diff(printed) > 0.0).all() and printed.argmin() == 0
    ball = PredictedObstacles(Scene(obstacles=[Sphere([0, 0, 0], 0.05)]).packed, np.zeros(1), np.zeros((1, 1)))
    groups = Groups(*[np.zeros(20, dtype=np.intp)] * 3)
    still = np.outer(distance, [1.0, 0.0, 0.0]), np.zeros(20), np.zeros((1, 3))
    for cost in (DistanceCost(0.02, np.zeros(1)), GaussianCost(0.02, np.zeros(1))):
        values = cost.values(ball, groups, *still, cost.gaps(ball, groups, *still))
        assert (np.diff(values[:, 0]) <= 0.0).all() and values[0, 0] > values[-1, 0]


def reach():
    """Demonstrations that agree in the first half of the motion, and differ by centimetres in the second."""
    t = np.linspace(0.0, 2.0, 100)
    rise = np.clip(t - 1.0, 0.0, 1.0)
    return Skill(5).fit(
        [
            Demonstration(Trajectory(t, np.column_stack([0.3 + 0.2 * t, side * rise, 0.3 + 0.05 * np.sin(3.0 * t)])))
            for side in (-0.06, -0.02, 0.03, 0.07)
        ]
    )


def test_theta_of_equation_5_1_is_large_where_the_demonstrations_agree():
    precision = learned_precision(reach())
    assert precision[100, 1, 1] > 4.0 * precision[550, 1, 1]
    sizes = np.linalg.eigvalsh(precision)
    assert sizes.min() >= 0.25 - 1e-9 and sizes.max() <= 4.0 + 1e-9


def test_the_cost_of_figure_5_3_is_lowest_on_the_path_and_highest_at_the_obstacle():
    skill = reach()
    path = skill.generate().positions
    policy = RCAMO(skill, tool_spheres=[[0.0, 0.0, 0.0, 0.02]])
    beside = path + [0.0, 0.0, 0.05]
    assert policy.cost_field(Scene(), path).max() < 1e-4
    assert policy.cost_field(Scene(), beside).min() > policy.cost_field(Scene(), path).max()
    ball = Sphere(path[len(path) // 2], 0.04)
    cost = policy.cost_field(Scene(obstacles=[ball]), path)
    inside = ball.signed_distance(path) < 0.0
    assert cost[inside].min() > cost[~inside].max() and cost[[0, -1]].max() < 1e-3
    grid = np.zeros((4, 5, 3))
    assert policy.cost_field(Scene(), grid).shape == (4, 5)


def test_five_runs_without_a_failure_show_little():
    low, high = wilson_interval(5, 5)
    assert 0.56 < low < 0.58 and high == pytest.approx(1.0)
