"""Seeded scenes in which an obstacle moves towards a standing arm, observed late; the simulator measures clearance."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from imitarm.command import Command
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.pose import Pose
from imitarm.robots import SimulatedRobot
from imitarm.safety import SafetyFilter
from imitarm.scene import Box, Capsule, MovingScene, Scene, Sphere

DT = 0.01
STANDS = 0.1  # [s] after which the obstacle moves
BEYOND = 0.25  # [m] how far it moves on after the point at which it aims


class Approach(NamedTuple):
    """A scene in which one obstacle stands, moves at a constant velocity, and stops."""

    q: np.ndarray
    scene: Scene  # with the obstacle's velocity
    duration: float  # of its motion [s]

    @property
    def speed(self) -> float:
        return float(np.linalg.norm(self.scene.obstacles[0].velocity))

    def truth(self) -> MovingScene:
        obstacle = self.scene.obstacles[0]
        start = obstacle.solid()

        def motion(time):
            moved = min(max(time - STANDS, 0.0), self.duration)
            return Pose(start.position + moved * obstacle.velocity, start.quaternion)

        return MovingScene(self.scene, {0: motion})


def approach(arm: ArmModel, seed: int, *, speeds=(0.1, 0.6), distance=(0.5, 0.8)) -> Approach:
    """Return a random approach to the forearm, hand or tool that leaves the first links alone, which can't yield."""
    rng = np.random.default_rng([77, seed])
    while True:
        q = np.clip(arm.home + 0.2 * rng.normal(size=arm.n_joints), arm.lower + 0.2, arm.upper - 0.2)
        centers, radii = arm.collision_spheres(q)
        target = centers[rng.choice(np.flatnonzero(arm.cover.links >= 4))]
        way = rng.normal(size=3) * [1.0, 1.0, 0.5]
        way /= np.linalg.norm(way)
        speed, away, r = rng.uniform(*speeds), rng.uniform(*distance), rng.uniform(0.03, 0.08)
        obstacle = _shape(rng, target - away * way, r, speed * way)
        scene, duration = Scene(None, [obstacle]), (away + BEYOND) / speed
        first = np.flatnonzero(arm.cover.links <= 2)
        fixed = np.concatenate([centers[first], arm.cover.base_centers])
        sizes = np.concatenate([radii[first], arm.cover.base_radii])
        poses = [scene.at(t) for t in np.linspace(0.0, duration, 40)]
        if (
            min(float((pose.distances(fixed) - sizes).min()) for pose in poses) > 0.08
            and float((scene.distances(centers) - radii).min()) > min(0.25, 0.9 * distance[0] - 0.05)
            and min(pose.obstacles[0].solid().position[2] for pose in (poses[0], poses[-1])) > -0.4
            and SimulatedRobot(arm, scene=scene, q=q).clearance() > 0.0  # nor does the arm touch itself
        ):
            return Approach(q, scene, duration)


def _shape(rng, place, r, velocity):
    kind = rng.integers(3)
    if kind == 0:
        return Sphere(place, r, velocity=velocity)
    if kind == 1:
        turn = rng.normal(size=4)
        size = 2.0 * r * rng.uniform(0.5, 1.2, size=3)
        return Box(Pose(place, turn / np.linalg.norm(turn)), size=size, velocity=velocity)
    half = rng.normal(size=3)
    half *= 0.1 / np.linalg.norm(half)
    return Capsule(place - half, place + half, 0.6 * r, velocity=velocity)


class Moment(NamedTuple):
    """One control period of :func:`stand`; the last three have one entry for each sphere that covers the arm."""

    time: float
    clearance: float
    safe: bool
    room: np.ndarray  # distance from the obstacle at the end of the period [m]
    receding: np.ndarray  # speed along the normal, positive away from the obstacle [m/s]
    braked: np.ndarray  # whether it approaches no faster than under full braking of all joints


def stand(arm: ArmModel, case: Approach, *, latency=0.0, clearance=0.02, velocity=None, seen_from=0.0) -> list[Moment]:
    """Let the arm stand (or begin with a joint velocity) while the obstacle comes; return all periods.

    Args:
        latency: age of each observed scene [s].
        velocity: initial velocity of the joints, which the command keeps up [rad/s].
        seen_from: time from which the obstacle is observed at all [s].
    """
    truth = case.truth()
    robot = SimulatedRobot(arm, scene=case.scene, motion=truth.motions, q=case.q)
    keeper, moments = SafetyFilter(arm, dt=DT, clearance=clearance, latency=latency), []
    wanted = Command(np.zeros(6), joint_velocity=velocity)
    while robot.time < case.duration + STANDS + 0.3 and not robot.fault:
        now = robot.time
        seen = truth.at(max(now - latency, 0.0)).now(now) if now - latency >= seen_from else Scene(None, (), now)
        before = robot.velocity
        kept = keeper.step(wanted, robot.set_point, before, seen)
        q = robot.set_point
        robot.move(kept.velocity, DT)
        moments.append(_moment(arm, robot, kept.safe, q, before, truth))
        if moments[-1].clearance <= 0.0:
            break
    return moments


def _moment(arm, robot, safe, q, before, truth):
    jacobians = arm.sphere_jacobians(q)
    centers, radii = arm.collision_spheres(robot.set_point)
    room = truth.at(robot.time).distances(centers)[0] - radii
    normal = truth.at(robot.time - DT).distances_and_gradients(arm.collision_spheres(q)[0])[1][0]
    rates = np.einsum("md,mdj->mj", normal, jacobians)
    receding, earlier = rates @ robot.velocity, rates @ before
    share = max(0.0, 1.0 - DT / max(float(np.max(np.abs(before) / arm.max_acceleration)), DT))
    braked = receding >= np.minimum(share * earlier, 0.0) - 1e-6
    return Moment(robot.time, robot.clearance(), safe, room, receding, braked)


def yielded(moments: list[Moment]) -> bool:
    """Return whether no part of the arm moves towards the obstacle at contact, or all such parts have braked fully.

    Full braking must have lasted since the first period in which no safe motion existed.
    """
    touching = moments[-1].room <= max(0.005, float(moments[-1].room.min()))
    first = next((k for k, moment in enumerate(moments) if not moment.safe), len(moments) - 1)
    since = np.all([moment.braked[touching] for moment in moments[first:]], axis=0)
    return bool(np.all((moments[-1].receding[touching] >= -0.01) | since))


def appearing(arm: ArmModel, seed: int) -> Approach:
    """Return an obstacle that appears 10 cm from the arm and moves towards it at 1 to 2 m/s."""
    case = approach(arm, seed, speeds=(1.0, 2.0))
    centers, radii = arm.collision_spheres(case.q)
    times = np.linspace(0.0, case.duration, 400)
    rooms = np.array([float((case.scene.at(t).distances(centers) - radii).min()) for t in times])
    start = times[np.flatnonzero(rooms < 0.1)[0]] if (rooms < 0.1).any() else 0.0
    return Approach(case.q, _moved(case.scene, start), case.duration - start)


def _moved(scene: Scene, time: float) -> Scene:
    return Scene(None, scene.at(time).obstacles)
