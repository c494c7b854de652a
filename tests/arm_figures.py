"""Published figures of the arms, typed from their sources, and mechanics written out from the textbook.

Nothing here is read from the package: the tests compare the package with it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

PI = np.pi


@dataclass(frozen=True)
class Link:
    """A link as in a URDF: its joint's origin in the frame before, its mass and inertia in its own frame."""

    xyz: tuple
    rpy: tuple
    mass: float
    com: tuple
    inertia: tuple  # ixx iyy izz ixy ixz iyz, about the center of mass


# Rethink Robotics, sawyer_description, sawyer_base.urdf.xacro. The angles have the manufacturer's own roundings.
SAWYER = [
    Link((0, 0, 0.08), (0, 0, 0), 5.3213, (0.024366, 0.010969, 0.14363),
         (0.053314, 0.057902, 0.023659, 0.0047093, 0.011734, 0.0080179)),
    Link((0.081, 0.05, 0.237), (-1.57079632679, 1.57079632679, 0), 4.505, (-0.0030849, -0.026811, 0.092521),
         (0.022398, 0.014613, 0.017295, -0.00023986, -0.00029362, -0.0060875)),
    Link((0, -0.14, 0.1425), (1.57079632679, 0, 0), 1.745, (-0.00016044, -0.014967, 0.13582),
         (0.025506, 0.0253, 0.0034179, 4.4101e-06, 1.4955e-05, -0.0033204)),
    Link((0, -0.042, 0.26), (-1.57079632679, 0, 0), 2.5097, (-0.0048135, -0.0281, -0.084154),
         (0.01016, 0.0065685, 0.0069078, -9.7452e-06, 0.00026624, 0.0030316)),
    Link((0, -0.125, -0.1265), (1.57079632679, 0, 0), 1.1136, (-0.0018844, 0.0069001, 0.1341),
         (0.013557, 0.013555, 0.0013658, 1.8109e-05, 0.00013523, 0.0010561)),
    Link((0, 0.031, 0.275), (-1.57079632679, 0, 0), 1.5625, (0.0061133, -0.023697, 0.076416),
         (0.0047328, 0.0029676, 0.0031762, 0.00011526, 4.6269e-05, -0.0011557)),
    Link((0, -0.11, 0.1053), (-1.57079632679, -0.17453, 3.1416), 0.3292, (-8.0726e-06, 0.0085838, -0.0049566),
         (0.00031105, 0.00021549, 0.00035976, 1.4771e-06, -3.7074e-07, -8.4533e-06)),
]  # fmt: skip
# The head is a link of its own in the source; it does not pan here, so it is part of link 0.
SAWYER_HEAD = Link((0, 0, 0.2965), (0, 0, 0), 1.5795, (0.0053207, -2.6549e-05, 0.1021),
                   (0.011833, 0.0082709, 0.0049661, -4.4669e-06, 4.9425e-05, 4.2124e-07))  # fmt: skip

# Geometry: Franka Emika, franka_description. Masses and inertias: Gaz et al., IEEE RA-L 4(4), 2019.
PANDA = [
    Link((0, 0, 0.333), (0, 0, 0), 4.970684, (3.875e-3, 2.081e-3, -4.762e-2),
         (0.70337, 0.70661, 9.1170e-3, -1.3900e-4, 6.7720e-3, 1.9169e-2)),
    Link((0, 0, 0), (-PI / 2, 0, 0), 0.646926, (-3.141e-3, -2.872e-2, 3.495e-3),
         (7.9620e-3, 2.8110e-2, 2.5995e-2, -3.9250e-3, 1.0254e-2, 7.0400e-4)),
    Link((0, -0.316, 0), (PI / 2, 0, 0), 3.228604, (2.7518e-2, 3.9252e-2, -6.6502e-2),
         (3.7242e-2, 3.6155e-2, 1.0830e-2, -4.7610e-3, -1.1396e-2, -1.2805e-2)),
    Link((0.0825, 0, 0), (PI / 2, 0, 0), 3.587895, (-5.317e-2, 1.04419e-1, 2.7454e-2),
         (2.5853e-2, 1.9552e-2, 2.8323e-2, 7.7960e-3, -1.3320e-3, 8.6410e-3)),
    Link((-0.0825, 0.384, 0), (-PI / 2, 0, 0), 1.225946, (-1.1953e-2, 4.1065e-2, -3.8437e-2),
         (3.5549e-2, 2.9474e-2, 8.6270e-3, -2.1170e-3, -4.0370e-3, 2.2900e-4)),
    Link((0, 0, 0), (PI / 2, 0, 0), 1.666555, (6.0149e-2, -1.4117e-2, -1.0517e-2),
         (1.9640e-3, 4.3540e-3, 5.4330e-3, 1.0900e-4, -1.1580e-3, 3.4100e-4)),
    Link((0.088, 0, 0), (PI / 2, 0, 0), 7.35522e-1, (1.0517e-2, -4.252e-3, 6.1597e-2),
         (1.2516e-2, 1.0027e-2, 4.8150e-3, -4.2800e-4, -1.1960e-3, -7.4100e-4)),
]  # fmt: skip

LIMITS = {
    "sawyer": {
        "lower": [-3.0503, -3.8095, -3.0426, -3.0439, -2.9761, -2.9761, -4.7124],
        "upper": [3.0503, 2.2736, 3.0426, 3.0439, 2.9761, 2.9761, 4.7124],
        "max_velocity": [1.74, 1.328, 1.957, 1.957, 3.485, 3.485, 4.545],
        "max_torque": [80, 80, 40, 40, 9, 9, 9],
    },
    "panda": {
        "lower": [-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973],
        "upper": [2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973],
        "max_velocity": [2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61],
        "max_acceleration": [15, 7.5, 10, 12.5, 15, 20, 20],
        "max_torque": [87, 87, 87, 87, 12, 12, 12],
    },
}

# Sawyer, classic D-H: a, alpha, d, offset of theta. d2..d6 are sums of the link lengths above; the usual table prints
# 133.75 mm for d7 (the flange plate), while the frame right_hand is at 110 + 24.5 mm. d4 is negative: with +0.1685,
# which some toolboxes ship, the flange is 0.337 m off. Offset 3.1416 and the twist of 10 degrees are as published.
SAWYER_DH = [
    (0.081, -PI / 2, 0.317, 0.0),
    (0.0, -PI / 2, 0.1925, -PI / 2),
    (0.0, -PI / 2, 0.4, PI),
    (0.0, -PI / 2, -0.1685, PI),
    (0.0, -PI / 2, 0.4, PI),
    (0.0, -PI / 2, 0.1363, 3.1416),
    (0.0, 0.0, 0.110 + 0.0245, -0.17453 + 1.570796),
]
# Panda, modified D-H (Craig), Franka Control Interface: a(i-1), alpha(i-1), d(i); the last row is the flange.
PANDA_DH = [
    (0.0, 0.0, 0.333),
    (0.0, -PI / 2, 0.0),
    (0.0, PI / 2, 0.316),
    (0.0825, PI / 2, 0.0),
    (-0.0825, -PI / 2, 0.384),
    (0.0, PI / 2, 0.0),
    (0.088, PI / 2, 0.0),
    (0.0, 0.0, 0.107),
]


def turn(axis, angle):
    """Return the homogeneous rotation about a coordinate axis."""
    c, s = np.cos(angle), np.sin(angle)
    m = np.eye(4)
    i, j = [(1, 2), (2, 0), (0, 1)][axis]
    m[i, i] = m[j, j] = c
    m[i, j], m[j, i] = -s, s
    return m


def shift(x, y, z):
    m = np.eye(4)
    m[:3, 3] = x, y, z
    return m


def sawyer_flange(q):
    """Classic D-H: Rz(theta) Tz(d) Tx(a) Rx(alpha)."""
    m = np.eye(4)
    for angle, (a, alpha, d, offset) in zip(q, SAWYER_DH, strict=True):
        m = m @ turn(2, angle + offset) @ shift(a, 0, d) @ turn(0, alpha)
    return m


def panda_flange(q):
    """Modified D-H: Rx(alpha) Tx(a) Rz(theta) Tz(d)."""
    m = np.eye(4)
    for angle, (a, alpha, d) in zip([*q, 0.0], PANDA_DH, strict=True):
        m = m @ turn(0, alpha) @ shift(a, 0, 0) @ turn(2, angle) @ shift(0, 0, d)
    return m


def chain(name, q):
    """Return for each link its frame, then a list of (mass, com, inertia tensor) in it, head included."""
    m, links = np.eye(4), []
    for i, (angle, link) in enumerate(zip(q, SAWYER if name == "sawyer" else PANDA, strict=True)):
        roll, pitch, yaw = link.rpy
        m = m @ shift(*link.xyz) @ turn(2, yaw) @ turn(1, pitch) @ turn(0, roll) @ turn(2, angle)
        bodies = [(link, np.zeros(3))]
        if name == "sawyer" and i == 0:
            bodies.append((SAWYER_HEAD, np.array(SAWYER_HEAD.xyz)))
        links.append((m, [(b.mass, np.array(b.com) + at, tensor(b.inertia)) for b, at in bodies]))
    return links


def tensor(values):
    xx, yy, zz, xy, xz, yz = values
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def newton_euler(name, q, qd, qdd, gravity=9.81):
    """Inverse dynamics in base coordinates: accelerations outwards, forces and moments inwards."""
    links = chain(name, q)
    spin, spinning = np.zeros(3), np.zeros(3)  # angular velocity and acceleration
    origin, lifting = np.zeros(3), np.array([0.0, 0.0, gravity])  # of the frame before, which falls upwards
    wrenches = []
    for (m, bodies), rate, change in zip(links, qd, qdd, strict=True):
        rotation, position = m[:3, :3], m[:3, 3]
        arm = position - origin
        lifting = lifting + np.cross(spinning, arm) + np.cross(spin, np.cross(spin, arm))
        axis = rotation[:, 2]
        spinning = spinning + axis * change + np.cross(spin, axis * rate)
        spin = spin + axis * rate
        origin = position
        force, moment = np.zeros(3), np.zeros(3)  # moment about this frame's origin
        for mass, com, inertia in bodies:
            lever = rotation @ com
            world = rotation @ inertia @ rotation.T
            f = mass * (lifting + np.cross(spinning, lever) + np.cross(spin, np.cross(spin, lever)))
            force += f
            moment += np.cross(lever, f) + world @ spinning + np.cross(spin, world @ spin)
        wrenches.append((force, moment, position, axis))
    torque = np.zeros(len(links))
    force, moment, before = np.zeros(3), np.zeros(3), np.zeros(3)
    for i in reversed(range(len(links))):
        f, n, position, axis = wrenches[i]
        moment = n + moment + np.cross(before - position, force)
        force = f + force
        before = position
        torque[i] = axis @ moment
    return torque


def potential_energy(name, q, gravity=9.81):
    return gravity * sum(
        mass * (m[:3, :3] @ com + m[:3, 3])[2] for m, bodies in chain(name, q) for mass, com, _ in bodies
    )
