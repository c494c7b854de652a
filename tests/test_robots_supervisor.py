from __future__ import annotations

import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from imitarm.kinematics.arm import ArmModel
from imitarm.robots import SimulatedRobot
from imitarm.robots.server import REACH_TIME, Supervisor, fingerprint
from imitarm.transmission.datagram import Encoder, decode
from imitarm.transmission.messages import CommandMode, JointState, RobotStatus
from test_transmission_datagram import signed
from wire_samples import ARM, DT, MS, N, Paper, Sender, assert_within_limits, command, joint_state, skeleton_frame

STEP = round(1e9 * DT)
BEGIN = 10**12


class Bench:
    """A supervisor with a perfect robot, an enabled sender, and a time that is set by hand."""

    def __init__(self, robot=None, session=5, enabled=True):
        self.robot = Paper() if robot is None else robot
        self.events = []
        self.supervisor = Supervisor(self.robot, DT, on_event=self.events.append)
        self.now = BEGIN
        self.sender = Sender(self.supervisor, session)
        if enabled:
            self.sender.enable(self.now)
            assert self.status is RobotStatus.FOLLOWING

    @property
    def status(self):
        return self.supervisor.status

    def step(self, n=1):
        for _ in range(n):
            self.now += STEP
            self.supervisor.step(self.now)

    def wave(self, seconds, size=0.25, seed=0, each=None):
        """Lead the arm along a smooth motion from where it is, a command every 12 ms."""
        start, phase = self.robot.set_point.copy(), np.random.default_rng(seed).uniform(2.0, 4.0, N)
        for k in range(round(seconds / DT)):
            time = k * DT
            if k % 3 == 0:
                q = start + size * (1 - np.cos(phase * time))
                self.sender.move(self.now, q, size * phase * np.sin(phase * time))
            if each is not None:
                each(k)
            self.step()


# --- what it does when all is well


def test_it_begins_stopped_and_holds():
    bench = Bench(enabled=False)
    assert bench.status is RobotStatus.STOPPED and bench.supervisor.challenge != 0
    bench.sender.move(bench.now, ARM.home + 0.05)
    bench.step(100)
    assert np.array_equal(bench.robot.q, ARM.home)
    assert bench.supervisor.dropped == {"stopped": 1}


def test_it_follows_closely_and_within_the_limits():
    bench = Bench()
    bench.wave(4.0)
    assert (
        bench.status is RobotStatus.FOLLOWING
        and not bench.supervisor.dropped
        and not bench.supervisor.datagram_filter.dropped
    )
    assert_within_limits(bench.robot.steps)
    q, velocity = bench.robot.set_point.copy() + 0.05, np.zeros(N)
    for _ in range(100):
        bench.sender.move(bench.now, q, velocity)
        bench.step(3)
    np.testing.assert_allclose(bench.robot.set_point, q, atol=1e-6)


def test_the_lag_behind_a_steady_motion_is_less_than_two_periods():
    bench, speed, lags = Bench(), 0.15 * ARM.max_velocity, []
    for k in range(70):
        bench.sender.move(bench.now, ARM.home + 3 * k * DT * speed, speed)
        bench.step(3)
        lags.append(np.max((ARM.home + 3 * (k + 1) * DT * speed - bench.robot.set_point) / speed))
    assert max(lags[40:]) < 2 * DT


def test_a_simulated_robot_is_led_like_any_other():
    arm = ArmModel.load("sawyer", tool="gripper")
    bench = Bench(SimulatedRobot(arm))
    bench.wave(1.0, size=0.1)
    assert not bench.robot.fault and bench.status is RobotStatus.FOLLOWING
    assert np.abs(bench.robot.state().q - arm.home).max() > 0.02
    bench.sender.move(bench.now, bench.robot.set_point, opening=0.0)
    bench.step(40)
    assert bench.robot.opening < bench.robot.widest_opening - 0.01
    bench.sender.move(bench.now, bench.robot.set_point, opening=0.5)
    assert bench.supervisor.dropped == {"gripper opening": 1}


# --- the watchdog


def test_the_watchdog_slows_after_100_ms_and_latches_after_500():
    bench = Bench()
    bench.wave(0.6)
    last, moving = bench.now - 3 * STEP + STEP, np.abs(bench.robot.velocity).max()
    assert moving > 0.3
    seen = {}
    while bench.now < last + 700 * MS:
        bench.step()
        seen.setdefault(bench.status, (bench.now - last) / MS)
    assert 100 <= seen[RobotStatus.SLOWING] <= 112 and 500 <= seen[RobotStatus.STOPPED] <= 512
    assert not bench.robot.velocity.any()
    assert_within_limits(bench.robot.steps)
    assert bench.events[-2:] == ["no valid command for 100 ms: slowing", "stopped: no valid command for 500 ms"]


def test_a_command_is_carried_on_for_30_ms_and_has_faded_by_100():
    bench, speed, fastest = Bench(), 0.15 * ARM.max_velocity, []
    for k in range(70):
        bench.sender.move(bench.now, ARM.home + 3 * k * DT * speed, speed)
        bench.step(3)
    for _ in range(21):
        bench.step()
        fastest.append(np.max(np.abs(bench.robot.velocity) / speed))
    assert bench.status is RobotStatus.FOLLOWING
    assert min(fastest[:4]) > 0.95 and fastest[-1] < 0.35
    assert_within_limits(bench.robot.steps)


def test_an_arm_that_is_not_told_to_brakes_at_once_and_stays():
    """From full speed to rest within the limits of acceleration, and not a step afterwards."""
    bench = Bench()
    for k in range(40):
        speed = np.minimum(ARM.max_velocity, ARM.max_acceleration * 0.8 * k * 3 * DT)
        bench.sender.move(bench.now, np.clip(bench.robot.set_point, ARM.lower, ARM.upper), speed)
        bench.step(3)
    assert (np.abs(bench.robot.velocity) > 0.3 * ARM.max_velocity).any()
    slowest = (ARM.max_velocity / ARM.max_acceleration).max()
    bench.step(round((0.1 + slowest) / DT) + 2)
    at_rest = bench.robot.q.copy()
    assert not bench.robot.velocity.any()
    bench.step(500)
    assert np.array_equal(bench.robot.q, at_rest)
    assert_within_limits(bench.robot.steps)


def test_commands_that_come_again_in_time_are_followed_without_a_jump():
    bench = Bench()
    bench.wave(0.6)
    bench.step(round(0.3 / DT))
    assert bench.status is RobotStatus.SLOWING
    bench.wave(0.6, seed=1)
    assert bench.status is RobotStatus.FOLLOWING
    assert_within_limits(bench.robot.steps)


def test_a_latched_stop_is_only_left_by_the_challenge_of_that_stop():
    bench = Bench()
    first = bench.sender.bytes(command(CommandMode.ENABLE, challenge=123), bench.now)
    recorded = [first]
    bench.wave(
        0.5, each=lambda k: recorded.append(bench.sender.bytes(command(CommandMode.ENABLE, challenge=1), bench.now))
    )
    bench.step(200)
    assert bench.status is RobotStatus.STOPPED
    before, challenge = bench.robot.q.copy(), bench.supervisor.challenge
    for _ in range(20):
        bench.sender.move(bench.now, before + 0.05)
        bench.step(3)
    for data in recorded:
        bench.supervisor.receive(data, bench.now)
    for wrong in (0, 1, challenge + 1 if challenge < 2**32 - 1 else 5):
        bench.sender.enable(bench.now, challenge=wrong)
    bench.sender.enable(bench.now, arm=1)
    bench.step(10)
    assert bench.status is RobotStatus.STOPPED and np.array_equal(bench.robot.q, before)
    good = bench.sender.enable(bench.now)
    assert bench.status is RobotStatus.FOLLOWING and bench.supervisor.challenge == 0
    bench.step(10)
    assert np.array_equal(bench.robot.q, before)  # it begins from where it is
    bench.wave(0.3)
    bench.step(200)
    for _ in range(3):
        bench.supervisor.receive(good, bench.now)  # replayed: the next stop has another challenge
    assert bench.status is RobotStatus.STOPPED
    assert_within_limits(bench.robot.steps)


def test_it_can_not_be_enabled_before_it_is_at_rest():
    bench = Bench()
    bench.wave(0.6)
    bench.supervisor.receive(bench.sender.bytes(command(CommandMode.STOP), bench.now), bench.now)
    bench.sender.enable(bench.now)
    assert bench.status is RobotStatus.STOPPED and bench.supervisor.dropped == {"still braking": 1}
    bench.step(200)
    assert_within_limits(bench.robot.steps)


def test_an_enabled_robot_that_is_not_led_latches_again():
    bench = Bench()
    bench.step(round(0.6 / DT))
    assert bench.status is RobotStatus.STOPPED


def test_anybody_may_stop_it_but_only_the_owner_leads_it():
    bench = Bench()
    other = Sender(bench.supervisor, 6)
    bench.wave(0.3, each=lambda k: other.move(bench.now, bench.robot.set_point + 0.1))
    assert bench.supervisor.datagram_filter.dropped["foreign"] == round(0.3 / DT)
    alone = Bench()
    alone.wave(0.3)
    assert np.array_equal(bench.robot.q, alone.robot.q)  # as if the other were not there
    other.enable(bench.now, challenge=bench.supervisor.challenge)
    assert bench.supervisor.dropped == {"not stopped": 1}
    bench.supervisor.receive(other.bytes(command(CommandMode.STOP), bench.now), bench.now)
    assert bench.status is RobotStatus.STOPPED and bench.supervisor.reason == "a client has stopped it"


def test_a_client_that_was_started_again_takes_over_from_where_the_arm_is():
    bench = Bench()
    bench.wave(0.6)
    again = Sender(bench.supervisor, 77)
    again.move(bench.now, ARM.home)  # too early: the dead one still leads
    bench.step(round(0.55 / DT))
    assert bench.status is RobotStatus.STOPPED
    rest = bench.robot.q.copy()
    again.enable(bench.now)
    assert bench.status is RobotStatus.FOLLOWING
    again.move(bench.now, rest)
    bench.step(3)
    assert np.array_equal(bench.robot.q, rest)
    bench.sender = again
    bench.wave(0.5)
    assert_within_limits(bench.robot.steps)
    bench.sender = Sender(bench.supervisor, 5, first=10_000)  # one that had died comes late
    before = len(bench.robot.steps)
    bench.wave(0.05)
    assert bench.supervisor.datagram_filter.dropped["retired"] > 0 and len(bench.robot.steps) > before


def test_a_protective_stop_is_final():
    class Held(Paper):
        held = False

        def state(self):
            state = super().state()
            return state if not self.held else type(state)(ARM.home, state.velocity, state.torque, state.time)

    bench = Bench(Held())
    bench.robot.held = True
    bench.wave(1.0)
    assert bench.status is RobotStatus.FAULT and "protective stop" in bench.supervisor.reason
    bench.sender.enable(bench.now, challenge=0)
    bench.sender.move(bench.now, bench.robot.q)
    bench.step(300)
    assert bench.status is RobotStatus.FAULT
    state = decode(bench.supervisor.answer(lambda: bench.now))[1]
    assert state.reason == bench.supervisor.reason and state.owner == 0


# --- what it must not believe


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({"q": ARM.upper + 0.01}, "beyond a position limit"),
        ({"q": ARM.lower - 0.01}, "beyond a position limit"),
        ({"velocity": 1.01 * ARM.max_velocity}, "beyond a velocity limit"),
        ({"q": ARM.home + 1.01 * REACH_TIME * ARM.max_velocity}, "too far from the set-point"),
        ({"arm": 3}, "wrong arm"),
        ({"q": ARM.home[:6], "velocity": np.zeros(6)}, "wrong arm"),
        ({"opening": 0.9}, "gripper opening"),
    ],
)
def test_what_is_impossible_does_not_move_the_arm_nor_calm_the_watchdog(fields, reason):
    bench = Bench()
    for _ in range(round(0.6 / DT)):
        bench.sender.move(bench.now, **fields)
        bench.step()
    assert np.array_equal(bench.robot.q, ARM.home)
    assert bench.status is RobotStatus.STOPPED
    assert bench.supervisor.dropped[reason] > 100


def junk(rng, bench, recorded):
    """Return something hostile: noise, damage, replays, lies."""
    data = recorded[int(rng.integers(len(recorded)))] if recorded else b"IMTR"
    session = int(rng.integers(0, 2**32)) if rng.random() < 0.5 else bench.sender.encoder.session
    numbers = rng.choice([np.nan, np.inf, -np.inf, 1e308, 1e6, 0.0, 5.0], N)
    match int(rng.integers(0, 8)):
        case 0:
            return rng.bytes(int(rng.integers(0, 900)))
        case 1:
            return data[: int(rng.integers(0, len(data) + 1))]
        case 2:
            broken = bytearray(data)
            broken[int(rng.integers(len(broken)))] ^= 1 << int(rng.integers(8))
            return bytes(broken)
        case 3:
            return data  # replayed, also out of order
        case 4:
            return signed(data[:4] + bytes([int(rng.integers(2, 256))]) + data[5:]) if len(data) > 28 else data
        case 5:  # right in form and checksum, from the owner's own session, with numbers that can't be
            return Encoder(session, 2**30).encode(command(q=numbers, velocity=numbers), bench.now)
        case 6:
            kind = skeleton_frame(rng) if rng.random() < 0.5 else joint_state(rng)
            return Encoder(session, 2**30).encode(kind, bench.now)
        case _:  # from a stranger, with numbers that could be
            mode = CommandMode.MOVE if rng.random() < 0.5 else CommandMode.ENABLE
            wrong = int(rng.integers(1, 2**32))
            return Encoder(int(rng.integers(0, 2**32))).encode(
                command(mode, ARM.home + 0.1, challenge=wrong), bench.now
            )


@settings(max_examples=25)
@given(seed=st.integers(0, 2**32 - 1))
def test_hostile_datagrams_move_nothing_that_is_stopped(seed):
    rng, bench = np.random.default_rng(seed), Bench(enabled=False)
    recorded = [Encoder(9, k).encode(command(q=ARM.home + 0.01 * k), bench.now) for k in range(20)]
    for _ in range(60):
        for _ in range(3):
            bench.supervisor.receive(junk(rng, bench, recorded), bench.now)
        bench.step()
    assert bench.status is RobotStatus.STOPPED
    assert all(np.array_equal(q, ARM.home) and not v.any() for q, v, _ in bench.robot.steps)


@settings(max_examples=25)
@given(seed=st.integers(0, 2**32 - 1))
def test_hostile_datagrams_do_not_change_the_motion_of_an_arm_that_is_led(seed):
    """To the last bit: the same commands with and without them."""
    rng, alone, among = np.random.default_rng(seed), Bench(), Bench()
    alone.wave(0.5, seed=seed)
    recorded = []
    move = among.sender.move
    among.sender.move = lambda *given, **fields: recorded.append(move(*given, **fields))
    among.wave(0.5, seed=seed, each=lambda k: among.supervisor.receive(junk(rng, among, recorded), among.now))
    assert all(np.array_equal(a[0], b[0]) for a, b in zip(alone.robot.steps, among.robot.steps, strict=True))
    assert sum((among.supervisor.dropped + among.supervisor.datagram_filter.dropped).values()) > 50


@settings(max_examples=40)
@given(seed=st.integers(0, 2**32 - 1), wild=st.floats(0.0, 1.0))
def test_no_stream_of_commands_breaks_a_limit(seed, wild):
    """From the owner itself, gone mad: jumps, gaps, full speed, enabling in between."""
    rng, bench = np.random.default_rng(seed), Bench()
    for _ in range(150):
        if rng.random() < 0.7:
            q = bench.robot.set_point + rng.uniform(-1, 1, N) * REACH_TIME * ARM.max_velocity
            if rng.random() < wild:
                q = rng.uniform(ARM.lower, ARM.upper)
            speed = rng.uniform(-1, 1, N) * ARM.max_velocity
            bench.sender.move(bench.now, np.clip(q, ARM.lower, ARM.upper), speed)
        if rng.random() < 0.05:
            bench.sender.enable(bench.now)
        if rng.random() < 0.02:
            bench.step(int(rng.integers(20, 160)))
        bench.now += STEP
        bench.supervisor.step(bench.now, int(rng.integers(1, 6)))
    assert_within_limits(bench.robot.steps)


def test_queued_commands_are_not_caught_up_with():
    """A whole second of commands that comes at once, after a pause, counts for nothing."""
    bench = Bench()
    bench.wave(0.3)
    late = [bench.sender.bytes(command(q=bench.robot.q + 0.01), bench.now + k * 12 * MS) for k in range(80)]
    bench.step(round(1.2 / DT))
    before = bench.robot.q.copy()
    for data in late:
        bench.supervisor.receive(data, bench.now)
    bench.step(50)
    assert np.array_equal(bench.robot.q, before)


def test_commands_that_were_long_on_their_way_slow_it_down():
    """Each 200 ms old: as if there were none."""
    bench = Bench()
    bench.wave(0.3)
    for _ in range(round(0.7 / DT)):
        bench.supervisor.receive(bench.sender.bytes(command(q=bench.robot.q), bench.now - 200 * MS), bench.now)
        bench.step()
    assert bench.status is RobotStatus.STOPPED and bench.supervisor.datagram_filter.dropped["stale"] > 100


def test_the_state_says_how_things_are():
    bench = Bench()
    bench.wave(0.2)
    header, state = decode(bench.supervisor.answer(lambda: bench.now))
    assert isinstance(state, JointState) and header.time_ns == bench.now
    assert state.status is RobotStatus.FOLLOWING and state.owner == 5 and state.challenge == 0
    assert state.arm == fingerprint(ARM) != fingerprint(ArmModel.load("panda"))
    np.testing.assert_array_equal(state.set_point, bench.robot.set_point)
    np.testing.assert_array_equal(state.set_velocity, bench.robot.velocity)
    assert state.applied_ns >= state.received_ns > 0 and state.opening == (0.08, 0.08)
    np.testing.assert_array_equal(struct.pack("<d", state.time), struct.pack("<d", bench.robot.time))


def test_an_arm_with_too_many_joints_is_refused():
    class Centipede:
        arm = type("Arm", (), {"n_joints": 17})()

    with pytest.raises(ValueError, match="17 joints"):
        Supervisor(Centipede(), DT)
