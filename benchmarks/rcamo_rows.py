"""What ``make bench`` times of RCAMO: a step while obstacles are near, beside the safety filter of CBFpy.

Both decide a velocity of a tool in space among moving spheres. CBFpy solves one quadratic program for the present, with
compiled code; RCAMO compares candidates over a horizon.
"""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from imitarm.kinematics.arm import ArmState
from imitarm.kinematics.pose import Pose
from imitarm.policies import RCAMO, Observation
from imitarm.scene import Scene, Sphere
from imitarm.skills import Skill
from imitarm.tasks.habits import demonstrations_by, s_shaped_reach
from timing import Row
from yardsticks import named

Array = NDArray[np.float64]

_DT, _TOOL = 0.01, 0.03  # [s], [m]
_STATE = ("_phase", "_rate", "_deviation", "_scaled")


def _balls(skill: Skill, n: int) -> Scene:
    """Return one ball that meets the tool in the middle of the motion, and others that pass nearby."""
    rng, time = np.random.default_rng(n), 0.5 * skill.duration_
    here = skill.nominal([time, skill.duration_]).positions[0]
    balls = []
    for i in range(n):
        velocity = rng.uniform(-0.2, 0.2, 3)
        beside = np.zeros(3) if i == 0 else rng.uniform(-0.25, 0.25, 3)
        balls.append(Sphere(here + beside - time * velocity, 0.03, velocity=velocity))
    return Scene(None, balls)


def _encounter(n: int) -> tuple[Callable[[], Any], list[Observation]]:
    """Return a function that repeats the steps in which the obstacles matter, one per call, and the observations."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        skill = Skill(6).fit(demonstrations_by(s_shaped_reach(planar=False), 3))
    scene, rest = _balls(skill, n), np.zeros(7)
    scene.packed.radii  # noqa: B018  computed once for a scene
    policy = RCAMO(skill, tool_spheres=[[0.0, 0.0, 0.0, _TOOL]])
    x, q, steps = skill.start_.position, skill.start_.quaternion, []
    for k in range(round(1.5 * skill.duration_ / _DT)):
        now = Observation(k * _DT, ArmState(rest, rest, rest, k * _DT), Pose(x, q), scene)
        if k == 0:
            policy.reset(now)
        before = {name: getattr(policy, name) for name in _STATE}
        before["_deviation"] = before["_deviation"].copy()
        x = x + _DT * policy.step(now, _DT).twist[:3]
        if before["_scaled"].any() or policy._scaled.any():
            steps.append((now, before))
    turns = itertools.cycle(steps)

    def ours() -> None:
        now, before = next(turns)
        policy.__dict__.update(before)
        policy.step(now, _DT)

    return ours, [now for now, _ in steps]


def _cbfpy(observations: list[Observation]) -> Callable[[], Any]:
    """Return a call of CBFpy's filter for the same tool and obstacles."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import jax.numpy as jnp
        from cbfpy import CBF, CBFConfig

    n = len(observations[0].scene.packed)

    class Tool(CBFConfig):  # type: ignore[misc, unused-ignore]
        """A point in space whose velocity is commanded; its distance to every sphere is a barrier."""

        def __init__(self) -> None:
            u = jnp.ones(3)
            super().__init__(n=3, m=3, u_min=-u, u_max=u, init_args=(np.zeros((n, 3)), np.ones(n)))

        def f(self, z: Any, *args: Any) -> Any:
            return jnp.zeros(3)

        def g(self, z: Any, *args: Any) -> Any:
            return jnp.eye(3)

        def h_1(self, z: Any, centers: Any, radii: Any) -> Any:
            return jnp.linalg.norm(z - centers, axis=1) - radii

        def alpha(self, h: Any, *args: Any) -> Any:
            return 5.0 * h

    barrier = CBF.from_config(Tool())
    wanted = np.array([0.2, 0.0, 0.0])
    radii = observations[0].scene.packed.radii + _TOOL + 0.02
    turns = itertools.cycle(observations)

    def peer() -> None:
        now = next(turns)
        packed = now.scene.packed
        centers = packed.positions + now.time * packed.velocities
        np.asarray(barrier.safety_filter(now.tool_to_base.position, wanted, centers, radii))

    return peer


def _step(n: int, cost: float) -> Row:
    ours, observations = _encounter(n)
    what = "one obstacle" if n == 1 else f"{n} obstacles"
    return Row(f"RCAMO, a step with {what} near", ours, _cbfpy(observations), f"filter of {named('cbfpy')}", cost=cost)


def step_with_one_obstacle() -> Row:
    """RCAMO, a step with one obstacle near."""
    return _step(1, 1.0)


def step_with_ten_obstacles() -> Row:
    """RCAMO, a step with ten obstacles near."""
    return _step(10, 2.0)


ROWS: tuple[Callable[[], Row], ...] = (step_with_one_obstacle, step_with_ten_obstacles)
