"""Rates of certified re-planning with one moving obstacle on a collision course; time of a plan with one to three.

``python tests/replanning_rates.py [number of seeds] [rate of the sensor, 0 observes the truth]`` prints, for two arms
and three families of motion, how many runs arrive without contact within twice the learned duration. The obstacle is a
sphere, a box or a cylinder at 0.1 to 0.6 m/s that meets the tool on its path: from the side, from ahead or from behind.
The sensor has 5 mm of noise and 33 ms of latency, and a plan takes effect 60 ms after its observation.
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass, replace

import numpy as np

from imitarm import SafetyFilter, Scene, adapt, replan, reproduce
from imitarm.control_loop.observer import SensorModel, TrackedScene
from imitarm.perception import CoverageMargin, ObstacleTracker
from imitarm.policies import CertifiedRCAMO, PlanInExecution
from imitarm.robots import SimulatedRobot
from imitarm.scene import MovingScene
from test_policies_certified_replanning import ARMS, MARGIN, SHAPES, TILT, at, carrying, crossing

FAMILIES = ("crossing", "oncoming", "chasing")
FREE_AT_START = 0.08  # [m] between the arm and the obstacle
FREE_OF_BASE = 0.25  # [m] from the vertical axis through the base


@dataclass(frozen=True)
class Run:
    """How one run ended."""

    arrived: bool
    touched: bool
    clearance: float
    duration: float
    certified: float
    reason: str


def collision_course(name, family, seed):
    """A scene with one obstacle that meets the tool in the middle of its path."""
    skill, arm, start = carrying(name)
    rng = np.random.default_rng([FAMILIES.index(family), seed])
    centers, radii = arm.collision_spheres(start)
    while True:
        share = rng.uniform(0.3, 0.7) * skill.duration_
        (before, place, after), _ = skill.generate().at([share - 0.05, share, share + 0.05])
        tangent = (after - before) / np.linalg.norm(after - before)
        direction = 0.15 * rng.normal(size=3) + {"oncoming": -1.0, "chasing": 1.0, "crossing": 0.0}[family] * tangent
        if family == "crossing":
            direction -= (direction @ tangent) * tangent
        velocity = rng.uniform(0.1, 0.6) * direction / np.linalg.norm(direction)
        obstacle = list(SHAPES.values())[seed % 3](place + 0.02 * rng.normal(size=3) - share * velocity, velocity)
        times = np.linspace(0.0, 2.0 * skill.duration_, 60)[:, None]
        centre = obstacle.bounds().mean(axis=0)
        of_base = np.linalg.norm((centre + times * velocity)[:, :2], axis=1).min()
        if of_base > FREE_OF_BASE and (obstacle.signed_distance(centers) - radii).min() > FREE_AT_START:
            return Scene(None, [obstacle])


def run(name, family, seed, rate):
    """Reproduce the skill in one scene, in the simulator."""
    skill, arm, start = carrying(name)
    scene = collision_course(name, family, seed)
    robot = SimulatedRobot(arm, scene=scene, q=start)
    observe = lambda now: robot.scene  # noqa: E731
    if rate > 0.0:
        sensor = SensorModel(noise=0.005, rate=rate, latency=0.033, seed=seed)
        observe = TrackedScene(MovingScene(scene), sensor, ObstacleTracker())
    policy = CertifiedRCAMO(skill, arm=arm, margin=CoverageMargin(0.005, 0.03), planning_time=0.06, **TILT)
    safety = SafetyFilter(arm, dt=0.01, clearance=0.005)
    done = reproduce(policy, robot, observe, dt=0.01, timeout=2.0 * skill.duration_, safety=safety)
    arrived = np.linalg.norm(done.trajectory.positions[-1] - skill.goal_.position) < 0.005
    share = policy.certified / max(policy.plans, 1)
    times = done.trajectory.duration / skill.duration_
    return Run(bool(arrived), bool(done.details["contacts"]), float(done.clearance.min()), times, share, done.reason)


def time_of_plans(name, n_obstacles, seeds):
    """Processor time [s] of planning again from a state with speed, and whether it was certified, for each scene."""
    skill, arm, start = carrying(name)
    free = adapt(skill, Scene(), arm=arm, state=at(arm, start), **TILT)
    plan = PlanInExecution.of(arm, free, 0.0, 0.0, Scene(), (), 0.02)
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        phase = rng.uniform(0.1, 0.4) * skill.duration_
        balls = [
            crossing(skill, rng.normal(size=3), rng.uniform(0.1, 0.4), share=rng.uniform(0.5, 0.8))
            for _ in range(n_obstacles)
        ]
        balls = [replace(ball, center=ball.center + 0.06 * rng.normal(size=3)) for ball in balls]
        scene = Scene(None, Scene(None, balls).at(phase).obstacles)
        state = at(arm, plan.joints_at(phase), plan.velocity_at(phase))
        options = {"margin": MARGIN, "margin_horizon": 1.0, "max_attempts": 1, "hold": 0.5, **TILT}
        began = time.process_time()
        found = replan(free, scene, arm=arm, state=state, phase=phase, **options)
        yield time.process_time() - began, found.feasible


def main(seeds: int = 2, rate: float = 30.0) -> None:
    """Print both tables."""
    for name in ARMS:
        for n in (1, 2, 3):
            spent, certified = np.array(list(time_of_plans(name, n, 10 * seeds))).T
            low, high = 1e3 * np.quantile(spent, [0.5, 0.9])
            print(
                f"{name}, {n} obstacles: {low:.0f} ms (90 %: {high:.0f} ms), {certified.mean():.0%} certified",
                flush=True,
            )
    for name in ARMS:
        for family in FAMILIES:
            runs = [run(name, family, seed, rate) for seed in range(seeds)]
            good = sum(one.arrived and not one.touched for one in runs)
            print(
                f"{name}, {family}: {good} of {seeds} arrive clear, {sum(one.touched for one in runs)} touch, "
                f"clearance at least {1e3 * min(one.clearance for one in runs):.0f} mm, "
                f"{np.median([one.duration for one in runs]):.2f} times the learned duration, "
                f"{np.mean([one.certified for one in runs]):.0%} of the plans certified",
                flush=True,
            )
            for one in runs:
                if not one.arrived or one.touched:
                    print(f"   {one.reason}")


if __name__ == "__main__":
    main(*(kind(value) for kind, value in zip((int, float), sys.argv[1:], strict=False)))
