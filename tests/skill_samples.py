"""Demonstrations that skills are learnt from in several tests."""

from __future__ import annotations

import numpy as np

from imitarm.kinematics.pose import quaternion_exp
from imitarm.skills import Skill
from imitarm.trajectory import Demonstration, Trajectory


def shown(n: int = 5, turn: float | None = np.deg2rad(270.0), planar: bool = False) -> list[Demonstration]:
    rng = np.random.default_rng(0)
    t = np.linspace(0.0, 2.0, 120)
    u = t / 2.0
    p = u**3 * (10.0 + u * (6.0 * u - 15.0))
    answer = []
    for i in range(n):
        a = 0.01 * rng.standard_normal(3)
        x = np.column_stack(
            [0.4 * p, (0.1 + a[1]) * np.sin(np.pi * p), 0.23 + (0.0 if planar else 1.0) * (0.05 + a[2]) * p]
        )
        q = None if turn is None else quaternion_exp((turn * p)[:, None] * np.array([0.6, 0.0, 0.8]))
        answer.append(Demonstration(Trajectory(t + 100.0 * i, x, q), task="sweep", source=f"file {i}"))
    return answer


def same(a: Skill, b: Skill) -> bool:
    times = np.linspace(0.0, a.duration_, 30)
    x, y = a.generate(goal=[0.1, 0.2, 0.3]), b.generate(goal=[0.1, 0.2, 0.3])
    pairs = [(x.positions, y.positions), (a.tolerance(times), b.tolerance(times))]
    if x.quaternions is not None and y.quaternions is not None:
        pairs += [(x.quaternions, y.quaternions)]
        pairs += list(zip(a.gmr_.predict_orientation(times), b.gmr_.predict_orientation(times), strict=True))
    about = [(s.task_, s.n_demonstrations_, s.provenance_, s.gmr_.selection_, s.gmr_.degenerate_axes_) for s in (a, b)]
    return all(np.array_equal(p, q) for p, q in pairs) and repr(about[0]) == repr(about[1])
