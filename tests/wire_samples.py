"""For tests of the wire: messages, a clock that is set by hand, a perfect robot, a server without time."""

from __future__ import annotations

import numpy as np

from imitarm.kinematics.arm import ArmModel, ArmState
from imitarm.robots import Robot, RobotServer, UdpRobot
from imitarm.robots.server import fingerprint
from imitarm.transmission.datagram import Encoder
from imitarm.transmission.messages import CommandMode, JointCommand, JointState, RobotStatus, SkeletonFrame

ARM = ArmModel.load("sawyer")
N = ARM.n_joints
MS = 1_000_000
DT = 0.004


class Paper(Robot):
    """A robot that follows perfectly and keeps a list of where its set-point has been, and for how long it moved."""

    def __init__(self, q=ARM.home, widest=0.08):
        super().__init__(ARM, q)
        self.q, self.time = np.array(q, dtype=float), 0.0
        self.steps = [(self.set_point.copy(), self.velocity.copy(), 0.0)]
        self.grasped, self.widest = [], widest

    def state(self):
        return ArmState(self.q, self.velocity, np.zeros(N), self.time)

    def _send(self, previous, velocity, dt):
        self.q = self.q + 0.5 * dt * (previous + velocity)
        self.time += dt
        self.steps.append((self.q.copy(), velocity.copy(), dt))

    def grasp(self, opening):
        self.grasped.append(opening)

    @property
    def opening(self):
        return self.grasped[-1] if self.grasped else self.widest

    @property
    def widest_opening(self):
        return self.widest


def assert_within_limits(steps, arm=ARM):
    """Every step of a set-point is continuous, and within the limits of position, velocity and acceleration."""
    assert len(steps) > 1
    q = np.array([step[0] for step in steps])
    velocity = np.array([step[1] for step in steps])
    dt = np.array([step[2] for step in steps])[1:, None]
    assert np.all((q >= arm.lower - 1e-9) & (q <= arm.upper + 1e-9))
    assert np.all(np.abs(velocity) <= arm.max_velocity * (1 + 1e-9))
    assert np.all(np.abs(np.diff(velocity, axis=0)) <= arm.max_acceleration * dt * (1 + 1e-6) + 1e-9)
    np.testing.assert_allclose(np.diff(q, axis=0), 0.5 * dt * (velocity[1:] + velocity[:-1]), atol=1e-9)


def skeleton_frame(rng=None, **fields):
    rng = np.random.default_rng(0) if rng is None else rng
    given = {
        "time": float(rng.uniform(0, 100)),
        "positions": rng.uniform(-3, 3, (25, 3)),
        "tracking": rng.integers(0, 3, 25).astype(np.int8),
        "hands": (int(rng.integers(0, 5)), int(rng.integers(0, 5))),
        "person": int(rng.integers(0, 2**63)),
        "waited_ns": int(rng.integers(0, 10**9)),
    }
    return SkeletonFrame(**(given | fields))


def command(mode=CommandMode.MOVE, q=ARM.home, velocity=None, **fields):
    given = {"arm": fingerprint(ARM)} | fields
    return JointCommand(mode, np.asarray(q, dtype=float), np.zeros(N) if velocity is None else velocity, **given)


def joint_state(rng=None, **fields):
    rng = np.random.default_rng(0) if rng is None else rng
    given = {
        "status": RobotStatus(int(rng.integers(0, 4))),
        "time": float(rng.uniform(0, 100)),
        **{name: rng.normal(size=N) for name in ("q", "velocity", "torque", "set_point", "set_velocity")},
        "arm": int(rng.integers(0, 2**32)),
        "challenge": int(rng.integers(0, 2**32)),
        "owner": int(rng.integers(0, 2**32)),
        "opening": (0.03, 0.08),
        "echo": int(rng.integers(0, 2**32)),
        "echo_sent_ns": int(rng.integers(0, 2**62)),
        "received_ns": int(rng.integers(0, 2**62)),
        "applied_ns": int(rng.integers(0, 2**62)),
        "reason": "protective stop: right_j3 was held 0.12 rad from its set-point – so",
    }
    return JointState(**(given | fields))


class Clock:
    """A time that is set by hand [ns]."""

    def __init__(self, ns=10**12):
        self.ns = ns

    def __call__(self):
        return self.ns


class Served:
    """A robot server on loopback whose time only goes on in :meth:`sleep`, period by period."""

    def __init__(self, robot=None, port=0, clock=None):
        self.clock = Clock() if clock is None else clock
        self.robot = Paper() if robot is None else robot
        self.events = []
        self.server = RobotServer(self.robot, port, clock_ns=self.clock, on_event=self.events.append)
        self.alive = True

    @property
    def supervisor(self):
        return self.server.supervisor

    @property
    def status(self):
        return self.supervisor.status

    def sleep(self, seconds):
        for _ in range(max(round(seconds / DT), 1)):
            self.clock.ns += round(1e9 * DT)
            if self.alive:
                self.server.step()

    def client(self, **options):
        return UdpRobot(ARM, self.server.address, clock_ns=self.clock, sleep=self.sleep, **options)

    def kill(self):
        """As a killed process does: let go of the port and say nothing."""
        self.alive = False
        self.server.close()


class Sender:
    """A client made of bare datagrams."""

    def __init__(self, supervisor, session=None, first=0):
        self.supervisor, self.encoder = supervisor, Encoder(session, first)

    def bytes(self, message, now):
        return self.encoder.encode(message, now)

    def enable(self, now, **fields):
        data = self.bytes(command(CommandMode.ENABLE, **({"challenge": self.supervisor.challenge} | fields)), now)
        self.supervisor.receive(data, now)
        return data

    def move(self, now, q=ARM.home, velocity=None, **fields):
        data = self.bytes(command(CommandMode.MOVE, q, velocity, **fields), now)
        self.supervisor.receive(data, now)
        return data
