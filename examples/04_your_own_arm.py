"""Load your own arm from a URDF or MJCF file: kinematics, inverse kinematics, gravity, and simulation.

The example writes a URDF file of an arm with six joints, and then loads this file. To use your own arm, load its file
instead.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from imitarm import ArmModel, Pose, SimulatedRobot, TwistTask, UnreachableError, find_posture, solve_ik

# Six axes: axis of the joint, its position in the frame of the previous joint [m], mass [kg], torque [N m], speed
# [rad/s].
AXES = (
    ("0 0 1", 0.00, 12.0, 250, 2.0),
    ("0 1 0", 0.40, 10.0, 250, 2.0),
    ("0 1 0", 0.42, 8.0, 150, 2.5),
    ("0 0 1", 0.20, 3.0, 60, 3.0),
    ("0 1 0", 0.20, 2.5, 60, 3.0),
    ("0 0 1", 0.10, 1.0, 30, 4.0),
)


def urdf() -> str:
    links, joints = ['<link name="base"/>'], []
    lengths = [axis[1] for axis in AXES[1:]] + [0.08]
    parent = "base"
    for i, ((axis, offset, mass, torque, speed), length) in enumerate(zip(AXES, lengths, strict=True), start=1):
        inertia = mass * length**2 / 12 + 0.01
        links.append(f"""<link name="link_{i}">
          <inertial><origin xyz="0 0 {length / 2}"/><mass value="{mass}"/>
            <inertia ixx="{inertia}" iyy="{inertia}" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial>
          <collision><origin xyz="0 0 {length / 2}"/><geometry><cylinder radius="0.05" length="{length}"/></geometry>
          </collision></link>""")
        joints.append(f"""<joint name="axis_{i}" type="revolute"><parent link="{parent}"/><child link="link_{i}"/>
          <origin xyz="0 0 {offset}"/><axis xyz="{axis}"/>
          <limit lower="-2.8" upper="2.8" effort="{torque}" velocity="{speed}"/></joint>""")
        parent = f"link_{i}"
    flange = f"""<link name="flange_plate"/><joint name="bolts" type="fixed"><parent link="{parent}"/>
      <child link="flange_plate"/><origin xyz="0 0 0.08"/></joint>"""
    return f'<robot name="six_axis">{"".join(links)}{"".join(joints)}{flange}</robot>'


def main() -> None:
    Path("six_axis.urdf").write_text(urdf(), encoding="utf-8")
    bare = ArmModel.load("six_axis.urdf")
    arm = ArmModel.load("six_axis.urdf", tool="gripper")  # a packaged tool, or an MJCF file with a site "tool"
    print(f"{arm.name}: {arm.n_joints} joints, {', '.join(arm.joint_names)}")
    print(f"  torque limits {arm.max_torque} N m, speed limits {arm.max_velocity} rad/s")
    # A URDF does not define accelerations: 10 rad/s^2 is assumed. An MJCF file can define them (see ArmModel.load).
    print(f"  acceleration limits {arm.max_acceleration} rad/s^2, tool {arm.tool_to_flange.position} m from the flange")

    # A posture for a pose. The tool points down: rotated by 180 degrees about y.
    down = [0.0, 0.0, 1.0, 0.0]  # quaternion w, x, y, z
    pose = Pose([0.55, 0.1, 0.3], down)
    q = find_posture(arm, pose)
    print(f"\nposture for {pose.position} m: {np.round(q, 3)} rad")
    print(f"  pose error {np.linalg.norm(arm.tool_pose(q).error_to(pose)):.1e} (m and rad)")
    try:
        find_posture(arm, Pose([1.6, 0.0, 0.3], down), restarts=5)
    except UnreachableError as error:
        print(f"  {error}")

    # A straight line at 10 cm/s by differential inverse kinematics. Velocity, acceleration and position limits hold at
    # every step; the twist is linear velocity, then angular velocity, in the base frame.
    dt, velocity = 0.01, np.zeros(arm.n_joints)
    line, beside = [], 0.0
    for step in range(200):
        target = Pose(pose.position + np.array([0.0, -0.001 * step, 0.0]), down)
        twist = np.array([0.0, -0.1, 0.0, 0.0, 0.0, 0.0]) + 5.0 * arm.tool_pose(q).error_to(target)
        velocity = solve_ik(arm, q, TwistTask(twist), dt=dt, velocity=velocity)
        q = q + velocity * dt
        line.append(arm.tool_pose(q))
        beside = max(beside, float(np.abs(line[-1].position - pose.position)[[0, 2]].max()))
    length = np.linalg.norm(line[-1].position - pose.position)
    print(f"\nalong a straight line of {100 * length:.1f} cm, the tool deviates by at most {1e3 * beside:.2f} mm")

    # The gravity torques without and with the gripper, also as a fraction of the torque limits.
    holding = arm.gravity_torque(q)
    print(f"\ngravity torque   {np.round(bare.gravity_torque(q), 1)} N m")
    print(f"  with the tool  {np.round(holding, 1)} N m, {np.round(100 * np.abs(holding) / arm.max_torque)} %")
    torque = arm.inverse_dynamics(q, velocity, np.full(arm.n_joints, 2.0))
    print(f"  at 2 rad/s^2   {np.round(torque, 1)} N m")

    # Simulation: the drives hold the posture with this torque.
    robot = SimulatedRobot(arm, q=q)
    for _ in range(100):
        state = robot.move(np.zeros(arm.n_joints), dt)
    print(
        f"\nafter {state.time:.0f} s of holding the posture: joints sagged by at most "
        f"{np.abs(state.q - q).max():.1e} rad,"
    )
    print(f"  drives give    {np.round(state.torque, 1)} N m")


if __name__ == "__main__":
    main()
