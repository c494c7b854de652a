from __future__ import annotations

import numpy as np
import pytest

from imitarm.capture.sources import followed
from imitarm.capture.stream import SkeletonSender, UdpSource
from imitarm.demonstrations.recorder import DemonstrationRecorder
from imitarm.errors import InputError
from imitarm.kinematics.arm import ArmModel
from imitarm.kinematics.pose import Pose
from imitarm.retarget import RETARGETERS, Correspondence, ModernRetargeter
from imitarm.robots import SimulatedRobot
from imitarm.safety import SafetyFilter
from imitarm.scene import Box, Scene
from imitarm.teleoperation import Teleoperation
from imitarm.trajectory import Demonstration
from imitarm.transmission.messages import RobotStatus
from imitarm.transmission.rate import RateLimiter
from recording_samples import Listed, skeletons
from wire_samples import ARM, Clock, Paper, Served, assert_within_limits

DT = 0.01


def retargeter(arm=ARM):
    return ModernRetargeter(arm, Correspondence(orientation="fixed"), dt=DT)


def loop(robot, source=None, clock=None, sleep=None, **options):
    """A loop whose time is set by hand."""
    clock = Clock() if clock is None else clock

    def pass_time(seconds):
        clock.ns += round(1e9 * seconds)

    rate_limiter = RateLimiter(DT, clock_ns=clock, sleep=pass_time if sleep is None else sleep)
    return Teleoperation(
        Listed([]) if source is None else source,
        retargeter(robot.arm),
        robot,
        clock_ns=clock,
        rate_limiter=rate_limiter,
        **options,
    )


def lead(one, seconds, start=0.0, each=None, frames=None):
    """Show the loop 30 skeletons a second."""
    shown = skeletons(round(30 * (start + seconds)) + 30) if frames is None else frames
    for k in range(round(start / DT), round((start + seconds) / DT)):
        new = int((k + 1) * DT * 30) > int(k * DT * 30)
        one.step(k * DT, shown[int(k * DT * 30)] if new else None)
        if each is not None:
            each(k)


def test_a_robot_here_is_led_within_its_limits():
    robot = Paper()
    one = loop(robot)
    lead(one, 5.0)
    assert one.summary.engagement["following"] > 300 and one.summary.skeletons == 150
    assert np.abs(robot.q - ARM.home).max() > 0.05
    assert one.summary.speed <= 1.0 and one.summary.acceleration <= 1.0 + 1e-9
    assert_within_limits(robot.steps)
    np.testing.assert_allclose(robot.set_point, one.retargeter.latest.q, atol=2e-3)


def clearance(q, obstacle):
    """Distance of the arm to an obstacle [m]."""
    centers, radii = ARM.collision_spheres(q)
    return float((obstacle.signed_distance(centers) - radii).min())


def test_a_method_that_looks_after_nothing_is_kept_clear_by_the_filter():
    """M3 knows neither the arm's own links nor obstacles; the loop's filter does."""
    tool = ARM.tool_pose(ARM.home).position
    table = Box(Pose(tool - np.array([0.0, 0.0, 0.39]), [1.0, 0.0, 0.0, 0.0]), [0.4, 1.2, 0.6])
    assert clearance(ARM.home, table) > 0.02
    scene = Scene(None, [table])
    blind, kept = Paper(), Paper()
    postures: dict[int, list[np.ndarray]] = {}
    for robot, safety in ((blind, SafetyFilter(ARM, clearance=None)), (kept, SafetyFilter(ARM, clearance=0.01))):
        one = loop(robot, safety=safety)
        one.retargeter = RETARGETERS["m3"](ARM, Correspondence(orientation="fixed"), dt=DT, scene=scene)
        lead(one, 5.0, each=lambda k, r=robot: postures.setdefault(id(r), []).append(r.q.copy()))
        assert one.summary.engagement["following"] > 300
        if robot is kept:
            assert one.summary.filtered > 0
    assert min(clearance(q, table) for q in postures[id(blind)]) < 0.0
    assert min(clearance(q, table) for q in postures[id(kept)]) > 0.008


def test_the_hand_leads_the_gripper():
    robot = Paper()
    one = loop(robot)
    open_and_closed = [
        s if i < 60 else type(s)(s.time, s.positions, s.tracking, (3, 3)) for i, s in enumerate(skeletons(150))
    ]
    lead(
        one,
        4.0,
        frames=[
            type(s)(s.time, s.positions, s.tracking, (2, 2)) if i < 60 else s for i, s in enumerate(open_and_closed)
        ],
    )
    assert robot.grasped == [0.0]
    without = Paper(widest=float("nan"))
    lead(loop(without), 1.0)
    assert without.grasped == []


def test_it_ends_with_the_source_or_the_time_and_the_arm_at_rest():
    robot = Paper()
    source = Listed(skeletons(40))
    summary = loop(robot, source).run()
    assert summary.reason == "the source has ended" and not robot.velocity.any()
    summary = loop(Paper(), Listed([None] * 5000)).run(0.5)
    assert summary.reason == "the time is up" and summary.steps + summary.overruns == 50


@pytest.mark.parametrize("seconds", [0.0, -1.0, np.nan, np.inf, "long"])
def test_a_duration_that_is_none_is_refused(seconds):
    with pytest.raises(InputError, match="Teleoperation: seconds"):
        loop(Paper()).run(seconds)


def test_ctrl_c_ends_it_with_the_arm_at_rest():
    robot = Paper()

    class Pressed(Listed):
        def read(self, timeout=1.0):
            if len(self.items) < 3:
                raise KeyboardInterrupt
            return super().read(timeout)

    summary = loop(robot, Pressed(skeletons(60))).run()
    assert summary.reason == "stopped by the user" and not robot.velocity.any()


def test_a_protective_stop_ends_it():
    robot = Paper()
    one = loop(robot)
    robot.fault = "protective stop: a joint was held"
    one.step(0.0, None)
    assert one.summary.reason == robot.fault and one.summary.interrupted == 1 and not one.summary.engagement


def test_what_the_robot_did_is_recorded_from_when_it_was_led(tmp_path):
    robot = SimulatedRobot(ArmModel.load("sawyer", tool="gripper"))
    path = tmp_path / "shown.csv"
    with DemonstrationRecorder(path, robot.arm) as recorder:
        one = loop(robot, recorder=recorder)
        lead(one, 2.0)
    shown = Demonstration.load(path)
    assert len(shown) == recorder.n_samples >= one.summary.engagement["following"] > 100
    np.testing.assert_array_equal(shown.joints[-1], robot.state().q)
    assert shown.trajectory.times[0] > 0.3


def test_a_state_that_came_once_is_recorded_once(tmp_path, monkeypatch):
    """Over UDP the newest state may be an old one: rows written again look like a robot that stood and then jumped."""
    robot = SimulatedRobot(ArmModel.load("sawyer", tool="gripper"))
    with DemonstrationRecorder(tmp_path / "shown.csv", robot.arm) as recorder:
        one = loop(robot, recorder=recorder)
        lead(one, 1.5)
        before, last = recorder.n_samples, robot.state()
        monkeypatch.setattr(robot, "state", lambda: last)
        lead(one, 0.2, start=1.5)
        assert recorder.n_samples == before
        monkeypatch.undo()
        lead(one, 0.2, start=1.7)
        assert recorder.n_samples == before + 20


# --- over the wire


class Wired:
    """Person, stream, loop, client and server, one after the other in the same time."""

    def __init__(self, confirm_enable=None):
        self.served = Served()
        self.clock = self.served.clock
        self.stream = UdpSource(0, clock_ns=self.clock)
        self.sender = SkeletonSender(self.stream.address, clock_ns=self.clock)
        self.robot = self.served.client()
        self.loop = loop(
            self.robot,
            followed(self.stream),
            self.clock,
            stream=self.stream,
            confirm_enable=confirm_enable,
            sleep=lambda s: None,
        )
        self.frames = skeletons(600)
        self.k = 0
        self.capturing = True

    def run(self, seconds):
        for _ in range(round(seconds / DT)):
            if self.capturing and int((self.k + 1) * DT * 30) > int(self.k * DT * 30):
                self.sender.send(self.frames[int(self.k * DT * 30)])
            skeleton = self.loop.source.read(0.0)
            if skeleton is not None:
                self.loop._arrival = self.stream.arrival
            self.loop.step(self.k * DT, skeleton)
            self.served.sleep(DT)
            self.k += 1

    def close(self):
        for one in (self.robot, self.sender, self.stream):
            one.close()
        self.served.kill()


@pytest.fixture
def wired():
    wired = Wired(confirm_enable=lambda problem, stopped: stopped)
    yield wired
    wired.close()


def test_a_served_robot_is_led_once_the_operator_lets_it(wired):
    asked = []
    wired.loop._confirm_enable = lambda problem, stopped: bool(asked.append((problem, stopped)))
    wired.run(2.0)
    assert set(asked) == {("the server has just started", True)} and np.array_equal(wired.served.robot.q, ARM.home)
    assert wired.loop.summary.interrupted == 200 and not wired.loop.summary.engagement
    wired.loop._confirm_enable = lambda problem, stopped: stopped
    wired.run(4.0)
    assert wired.loop.summary.engagement["following"] > 200 and wired.served.status is RobotStatus.FOLLOWING
    assert np.abs(wired.served.robot.q - ARM.home).max() > 0.05
    assert_within_limits(wired.served.robot.steps)


def test_the_latency_of_each_stage_is_noted(wired):
    wired.run(3.0)
    rows = {stage: n for stage, n, *_ in wired.loop.summary.latency.statistics()}
    assert set(rows) == {"expose", "arrive", "wait", "retarget", "send", "robot", "apply", "total"}
    assert rows["total"] >= 0.9 * rows["wait"] > 50
    values = dict(
        zip(wired.loop.summary.latency.stages, np.nanmax(wired.loop.summary.latency.values, axis=0), strict=True)
    )
    assert values["robot"] <= 0.004 + 1e-9 and values["total"] <= 0.02


def test_a_capture_process_that_dies_stops_the_arm_and_begins_anew(wired):
    wired.run(2.0)
    assert wired.loop.retargeter.latest.state == "following"
    wired.capturing = False
    wired.run(1.5)
    assert wired.loop.retargeter.latest.state in ("stopped", "waiting")
    assert np.abs(wired.served.robot.velocity).max() < 1e-4 and wired.served.status is RobotStatus.FOLLOWING
    wired.sender.close()
    wired.sender = SkeletonSender(wired.stream.address, clock_ns=wired.clock)
    wired.capturing = True
    wired.frames = [
        type(s)(s.time - wired.frames[0].time, s.positions, s.tracking, s.hand_states) for s in wired.frames
    ]
    wired.run(2.0)
    assert wired.loop.retargeter.latest.state == "following"
    assert_within_limits(wired.served.robot.steps)


def test_a_loop_that_was_held_up_takes_hold_anew_from_where_the_arm_is(wired):
    wired.run(2.5)
    for pause in (0.2, 0.8):  # the server slows, then latches
        wired.served.sleep(pause)
        wired.run(3.0)
        assert wired.loop.summary.interruptions >= 1
        assert wired.loop.retargeter.latest.state == "following"
        np.testing.assert_allclose(wired.robot.set_point, wired.loop.retargeter.latest.q, atol=5e-3)
    assert_within_limits(wired.served.robot.steps)


def test_a_robot_process_that_dies_and_comes_back_elsewhere_is_not_pulled_to_where_it_was(wired):
    wired.run(2.5)
    port = wired.served.server.address[1]
    wired.served.kill()
    wired.run(0.5)
    assert not wired.robot.ready
    wired.served = Served(Paper(ARM.home + 0.2), port=port, clock=wired.clock)
    wired.loop._confirm_enable = lambda problem, stopped: False
    wired.run(1.0)
    assert np.array_equal(wired.served.robot.q, ARM.home + 0.2)
    wired.loop._confirm_enable = lambda problem, stopped: stopped
    wired.run(3.0)
    assert wired.loop.retargeter.latest.state == "following"
    assert_within_limits(wired.served.robot.steps)


def test_a_faulty_robot_ends_it(wired):
    wired.run(1.5)
    wired.served.robot.fault = "protective stop: a joint was held"
    wired.run(0.1)
    assert wired.loop.summary.reason == "protective stop: a joint was held"
