import numpy as np
import pytest

from imitarm import ArmModel
from imitarm.errors import InputError
from imitarm.retarget.baselines.adaptive_control import JointPlant

ARMS = {name: ArmModel.load(name, tool="gripper") for name in ("sawyer", "panda")}
each = pytest.mark.parametrize("arm", ARMS.values(), ids=ARMS)


@each
def test_the_torque_that_holds_the_arm_holds_it(arm):
    plant = JointPlant(arm, 0.01)
    for _ in range(100):
        plant.step(arm.gravity_torque(arm.home))
    np.testing.assert_allclose(plant.q, arm.home, atol=1e-3)


@each
def test_left_alone_it_falls_and_loses_energy(arm):
    """Friction only takes: the integration must not add any, or a controller would be blamed for it."""
    plant = JointPlant(arm, 0.01)
    energies = []
    for _ in range(300):
        plant.step(np.zeros(arm.n_joints))
        energies.append(plant.energy)
    assert energies[-1] < energies[0] - 5.0
    assert np.diff(energies[:20]).max() < 1e-6
    assert max(energies) <= energies[0] + 1e-6  # at a stop some is lent to the stop, never more than there was
    assert np.isfinite(plant.velocity).all()


@each
def test_a_free_swing_obeys_the_arms_own_equation_of_motion(arm):
    """Measured acceleration, with rotors, damping and friction added, gives the torque back that was applied."""
    plant = JointPlant(arm, 0.002)
    assert plant.substeps == 1
    model = arm.spec().compile()
    dofs = [model.joint(name).dofadr[0] for name in arm.joint_names]
    torque = arm.gravity_torque(arm.home) + 0.3 * arm.max_torque
    for _ in range(40):
        plant.step(torque)
    q, before = plant.q, plant.velocity
    plant.step(torque)
    after = plant.velocity
    acceleration = (after - before) / 0.002
    found = arm.inverse_dynamics(q, 0.5 * (before + after), acceleration) + model.dof_armature[dofs] * acceleration
    found += model.dof_damping[dofs] * after + model.dof_frictionloss[dofs] * np.sign(after)
    np.testing.assert_allclose(found, torque, atol=0.05 * arm.max_torque.max())


def test_time_is_cut_into_steps_that_the_physics_can_take():
    assert JointPlant(ARMS["sawyer"], 0.01).substeps == 5
    with pytest.raises(InputError, match="dt"):
        JointPlant(ARMS["sawyer"], 0.0)
