"""GMM+DMP: a spring that follows a learned attractor (Calinon et al. 2012), with a repulsion from obstacles."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from imitarm.policies.baselines.coupled_motion import CoupledMotion, MotionState
from imitarm.policies.baselines.potential_field import repulsive_force
from imitarm.skills.dmp import DMP
from imitarm.skills.dynamical_systems import DECAY
from imitarm.skills.gmm import DegenerateAxisWarning
from imitarm.skills.gmr import GMR
from imitarm.skills.skill import Skill
from imitarm.trajectory import Trajectory
from imitarm.validation import finite_number, flag, whole_number

Array = NDArray[np.float64]

_SAMPLES = 200  # of each reconstructed demonstration
_STIFFNESS_RANGE = 0.3, 3.0  # of the variable stiffness, relative to K
_LEAST_VARIANCE = 1e-8  # [m^2] keeps the factors of planar covariances finite


def reconstructed_demonstrations(skill: Skill, n_samples: int = _SAMPLES) -> list[Trajectory]:
    r"""Return seven paths that have the mean and the covariance of the demonstrations of a skill at every time.

    A skill keeps the mean ``m(t)`` and the covariance ``S(t)`` of its demonstrations, but not the demonstrations. With
    the columns ``L_i`` of the Cholesky factor ``S = L L^T``, the paths are ``m(t)`` and ``m(t) +/- sqrt(7/2) L_i(t)``.
    """
    times = np.linspace(0.0, skill.duration_, n_samples)
    mean, covariance = skill.gmr_.nominal(times)[0], skill.gmr_.predict(times)[1]
    factor = np.sqrt(3.5) * np.linalg.cholesky(covariance + _LEAST_VARIANCE * np.eye(3))
    offsets = [np.zeros_like(mean), *(sign * factor[:, :, i] for i in range(3) for sign in (1.0, -1.0))]
    return [Trajectory(times, mean + offset) for offset in offsets]


def attractor_of(path: Trajectory, skill: Skill) -> Trajectory:
    """Return the attractor ``y = x + (D/K) T x' + (T^2/K) x''`` of a path; K and D are the gains of the skill.

    A spring that follows this attractor moves along the path. The function does not differentiate the samples twice.
    Instead, it fits a motion primitive to the path and returns the primitive's target.
    """
    primitive = DMP(skill.dmp_.gains_, n_basis=skill.dmp_.n_basis).fit(path, exact_ends=True)
    phases = np.exp(-DECAY * (path.times - path.times[0]) / path.duration)
    return Trajectory(path.times, primitive.begin().target.at(phases))


class GMMDMP(CoupledMotion):
    r"""GMM+DMP: a spring that follows an attractor learned by a Gaussian mixture (Calinon et al. 2012).

    The attractor of a demonstration ``x(t)`` with the duration T is ``y = x + (D/K) T x' + (T^2/K) x''``. A Gaussian
    mixture is fitted to the times and attractors of all demonstrations. Gaussian mixture regression gives the mean
    attractor ``y(t)`` and its covariance. The motion is::

        T^2 x'' = K (y(t) - x) - D T x' + Phi,        Phi = sum k (1/d - 1/d_0) d^-2 n     (thesis Eq 2.19)

    The published method does not avoid obstacles. Here, ``Phi`` is the repulsion of
    :mod:`~imitarm.policies.baselines.potential_field`; with ``force=0``, the method is the published one.

    **Changes.** A skill does not keep its demonstrations; :func:`reconstructed_demonstrations` replaces them. The
    mixture is over the time t instead of the phase ``s = exp(-alpha t / T)``. Because the phase decays exponentially,
    one Gaussian over the phase would cover the second half of the motion. The motion would then end beside the goal.

    **Known failure.** The repulsion depends only on the position. In front of a wide obstacle, spring and repulsion
    balance, and the tool waits until the attractor has passed the obstacle. Then the spring pulls the tool through the
    obstacle, or the tool arrives late.

    Args:
        skill: skill to reproduce.
        force: k, the factor of the repulsion [m^4].
        influence: d_0, the gap below which an obstacle repels [m].
        variable_stiffness: whether K is multiplied by ``clip(mean variance / variance(t), 0.3, 3)``, so that the spring
            is stiff where the demonstrations agree. Here, ``variance(t)`` is the trace of the attractor's covariance. A
            motion without obstacles does not change.
        n_components: number of Gaussians in the mixture of the attractors. If None, this mixture has twice as many
            Gaussians as the skill's mixture. It needs more Gaussians, because an attractor bends more sharply than the
            path of its demonstration.
        options: arguments of :class:`~imitarm.policies.baselines.coupled_motion.CoupledMotion`.
    """

    search_space: ClassVar[Mapping[str, tuple[float, float]]] = {"force": (1e-6, 1e-2), "influence": (0.02, 0.2)}

    def __init__(
        self,
        skill: Skill,
        *,
        force: float = 1e-4,
        influence: float = 0.08,
        variable_stiffness: bool = False,
        n_components: int | None = None,
        **options: Any,
    ) -> None:
        super().__init__(skill, **options)
        self.force = finite_number(force, "GMMDMP: force", "m^4", at_least=0.0)
        self.influence = finite_number(influence, "GMMDMP: influence", "m", above=0.0)
        self.variable_stiffness = flag(variable_stiffness, "GMMDMP: variable_stiffness")
        number = 2 * skill.gmr_.n_components_ if n_components is None else n_components
        number = whole_number(number, "GMMDMP: n_components", at_least=1)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DegenerateAxisWarning)  # the skill has reported it
            self.regression_ = GMR(number).fit([attractor_of(p, skill) for p in reconstructed_demonstrations(skill)])
        times = np.linspace(0.0, skill.duration_, _SAMPLES)
        variance = np.trace(self.regression_.predict(times)[1], axis1=1, axis2=2)
        self._ratios = np.clip(variance.mean() / variance, *_STIFFNESS_RANGE)

    def target(self, nominal: Trajectory, fractions: Array) -> Array:
        """Return the mean attractor, shifted for a new start or goal like the target of the skill's primitive."""
        primitive, phases = self.skill.dmp_, np.exp(-DECAY * fractions)
        moved = primitive.begin(nominal.positions[0], nominal.positions[-1]).target.at(phases)
        learned = primitive.begin().target.at(phases)
        return np.asarray(self.regression_.nominal(fractions * self.skill.duration_)[0] + moved - learned)

    def term(self, state: MotionState) -> Array:
        """Return the repulsion plus the force of the variable stiffness, shape (3,) [m]."""
        phi = repulsive_force(state.distance, state.normal, self.force, self.influence)
        if self.variable_stiffness:
            ratio = self._ratios[min(round(state.fraction * (_SAMPLES - 1)), _SAMPLES - 1)]
            phi = phi + (ratio - 1.0) * self.skill.dmp_.gains_.stiffness * (state.learned - state.position)
        return phi
