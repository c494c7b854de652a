"""Motions that are known exactly, for tests of demonstrations."""

from __future__ import annotations

import numpy as np

from imitarm.kinematics.pose import quaternion_exp
from imitarm.trajectory import Demonstration, Trajectory

PEAK = 0.10  # [m] height of the bump that every sample motion goes over


def path(phase, *, peak=PEAK):
    """Positions (n, 3) of a smooth reach over a narrow bump, for a phase from 0 to 1."""
    s = np.asarray(phase, dtype=float)
    reach = s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
    bump = peak * np.exp(-0.5 * ((s - 0.5) / 0.08) ** 2)
    return np.stack([0.3 + 0.4 * reach, 0.05 * np.sin(2.0 * np.pi * s), 0.2 + bump], axis=1)


def turn(phase):
    """Rotations (n, 4) that go with the path: a quarter turn about z."""
    s = np.asarray(phase, dtype=float)
    return quaternion_exp(np.outer(s**2 * (3.0 - 2.0 * s), [0.0, 0.0, np.pi / 2.0]))


def phase_of(share, bend):
    """The phase at a share of the duration; ``bend`` (-0.3 to 0.3) makes the first half faster or slower."""
    u = np.asarray(share, dtype=float)
    return u + bend * np.sin(np.pi * u)


def motion(
    *,
    bend=0.0,
    duration=5.0,
    n=300,
    noise=0.0,
    offset=(0.0, 0.0, 0.0),
    rotations=False,
    joints=False,
    seed=0,
    source="",
):
    """One demonstration of the path."""
    times = np.linspace(0.0, duration, n)
    phase = phase_of(times / duration, bend)
    rng = np.random.default_rng(seed)
    positions = path(phase) + np.asarray(offset) + noise * rng.normal(size=(n, 3))
    quaternions = turn(phase) if rotations else None
    angles = np.stack([np.sin(phase), np.cos(phase)], axis=1) if joints else None
    return Demonstration(Trajectory(times, positions, quaternions), angles, "reach", source or f"sample {seed}")


def motions(n_demonstrations=8, *, bend=0.12, noise=0.0, spread=0.0, seed=0, **options):
    """Several demonstrations, each at its own pace."""
    rng = np.random.default_rng(seed)
    return [
        motion(
            bend=rng.uniform(-bend, bend),
            duration=rng.uniform(4.0, 6.0),
            noise=noise,
            offset=spread * rng.normal(size=3),
            seed=100 * seed + i,
            **options,
        )
        for i in range(n_demonstrations)
    ]


def with_idle(demonstration, head=1.0, tail=1.0, noise=0.0, seed=0):
    """The same, standing before and after [s]."""
    motion_ = demonstration.trajectory
    step = motion_.times[1] - motion_.times[0]
    n_head, n_tail = round(head / step), round(tail / step)
    rows = np.concatenate([np.zeros(n_head, int), np.arange(len(motion_)), np.full(n_tail, len(motion_) - 1)])
    rng = np.random.default_rng(seed)
    positions = motion_.positions[rows] + noise * rng.normal(size=(len(rows), 3))
    quaternions = None if motion_.quaternions is None else motion_.quaternions[rows]
    joints = None if demonstration.joints is None else demonstration.joints[rows]
    trajectory = Trajectory(step * np.arange(len(rows)), positions, quaternions)
    return demonstration.with_trajectory(trajectory, joints), (n_head, n_head + len(motion_) - 1)
