"""TP-GMM: a path that is learned relative to the start and the goal (Calinon 2016), with repulsion from obstacles."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from itertools import product
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from imitarm.errors import InputError
from imitarm.policies.baselines.coupled_motion import CoupledMotion, MotionState
from imitarm.policies.baselines.gmm_dmp import reconstructed_demonstrations
from imitarm.policies.baselines.potential_field import repulsive_force
from imitarm.skills.dmp import DMP
from imitarm.skills.dynamical_systems import DECAY
from imitarm.skills.gmm import DegenerateAxisWarning, GaussianMixture
from imitarm.skills.gmr import GMR
from imitarm.skills.skill import Skill
from imitarm.trajectory import Demonstration, Trajectory
from imitarm.validation import finite_number, whole_number

Array = NDArray[np.float64]

_SAMPLES = 200  # of each demonstration


class FrameMixture(NamedTuple):
    r"""A Gaussian mixture in two frames: one at the start and one at the goal of a motion.

    Frame 1 describes a motion by ``z_1 = [t; x - start]``, and frame 2 by ``z_2 = [t; x - goal]``. In frame j,
    component k is the Gaussian ``N(mu_k^j, Sigma_k^j)``. For a new start and goal, each component is the product of its
    two Gaussians, both transformed to the base frame::

        Sigma_k^-1 = sum_j (Sigma_k^j)^-1,     mu_k = Sigma_k sum_j (Sigma_k^j)^-1 (mu_k^j + [0; b_j])

    Here, ``b_1`` is the start and ``b_2`` is the goal. The frame in which the demonstrations vary less therefore has
    more influence.

    Attributes:
        weights: weight of each of the K components, shape (K,).
        means: means mu of the components in both frames, shape (2, K, 4) [s, m].
        covariances: covariances Sigma of the components in both frames, shape (2, K, 4, 4).
        duration: duration of the motion [s].
    """

    weights: Array
    means: Array
    covariances: Array
    duration: float

    @classmethod
    def of(cls, demonstrations: Sequence[Trajectory], n_components: int) -> FrameMixture:
        """Fit the mixture to the samples ``[t; x - start; x - goal]`` of demonstrations, all with the same duration."""
        times = np.linspace(0.0, 1.0, _SAMPLES)
        duration = demonstrations[0].duration
        paths = [d.at(d.times[0] + times * d.duration)[0] for d in demonstrations]
        rows = [np.column_stack([duration * times, path - path[0], path - path[-1]]) for path in paths]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DegenerateAxisWarning)  # a planar motion has no spread in z
            fitted = GaussianMixture(n_components).fit(np.concatenate(rows))
        frames = np.array([[0, 1, 2, 3], [0, 4, 5, 6]])
        covariances = [fitted.covariances_[:, f[:, None], f[None, :]] for f in frames]
        means = [fitted.means_[:, f] for f in frames]
        return cls(fitted.weights_, np.stack(means), np.stack(covariances), duration)

    def between(self, start: Array, goal: Array) -> GMR:
        """Return the Gaussian mixture regression for the positions of a start and a goal, each of shape (3,) [m]."""
        moved = self.means.copy()
        moved[0, :, 1:] += start
        moved[1, :, 1:] += goal
        precisions = np.linalg.inv(self.covariances)
        covariances = np.linalg.inv(precisions.sum(axis=0))
        means = np.einsum("kab,jkbc,jkc->ka", covariances, precisions, moved)
        covariances = 0.5 * (covariances + np.swapaxes(covariances, 1, 2))
        ends = np.stack([start, goal])
        return GMR.from_mixture(self.weights, means, covariances, duration=self.duration, ends=ends)


def demonstrations_between_ends(skill: Skill, spread: float) -> list[Trajectory]:
    """Return simulated demonstrations of a skill, with different starts and goals.

    For each demonstration, the start or the goal is displaced by ``spread`` [m] along one axis, in the positive or the
    negative direction. The skill adapts its nominal path to the new ends. The same change is then added to each of the
    seven paths of :func:`~imitarm.policies.baselines.gmm_dmp.reconstructed_demonstrations`.
    """
    times = np.linspace(0.0, skill.duration_, _SAMPLES)
    learned = skill.nominal(times).positions
    paths = [path.positions for path in reconstructed_demonstrations(skill, _SAMPLES)]
    demonstrations = []
    for axis, sign, at_goal in product(range(3), (1.0, -1.0), (False, True)):
        offset = sign * spread * np.eye(3)[axis]
        ends = (None, learned[-1] + offset) if at_goal else (learned[0] + offset, None)
        moved = skill.nominal(times, *ends).positions - learned
        demonstrations += [Trajectory(times, path + moved) for path in paths]
    return demonstrations


class TPGMM(CoupledMotion):
    r"""TP-GMM: a path that is learned relative to the start and to the goal (Calinon 2016).

    Gaussian mixture regression with a :class:`FrameMixture` gives the path ``x(t)`` between the start and the goal of a
    motion. A spring with the gains K and D of the skill pulls the tool along this path, and obstacles repel the tool::

        T^2 x'' = K (y(t) - x) - D T x' + Phi,     Phi = sum k (1/d - 1/d_0) d^-2 n     (thesis Eq 2.19)

    Here, ``y`` is the target of a motion primitive that is fitted to ``x(t)``. In the paper, the frames can include
    obstacles, if the demonstrations contain them. The demonstrations of a skill contain no obstacle, so this class adds
    the repulsion ``Phi`` instead. With ``force=0``, the policy does not avoid obstacles.

    Args:
        skill: skill to reproduce.
        demonstrations: demonstrations with different starts and goals; None: :func:`demonstrations_between_ends`,
            because a skill does not keep its demonstrations.
        spread: displacement of the start or the goal in :func:`demonstrations_between_ends` [m].
        force: k, the factor of the repulsion [m^4].
        influence: d_0, the gap below which an obstacle repels [m].
        n_components: number of Gaussians; None: the same number as in the skill.
        options: arguments of :class:`~imitarm.policies.baselines.coupled_motion.CoupledMotion`.
    """

    search_space: ClassVar[Mapping[str, tuple[float, float]]] = {"force": (1e-6, 1e-2), "influence": (0.02, 0.2)}

    def __init__(
        self,
        skill: Skill,
        *,
        demonstrations: Sequence[Demonstration | Trajectory] | None = None,
        spread: float = 0.05,
        force: float = 1e-4,
        influence: float = 0.08,
        n_components: int | None = None,
        **options: Any,
    ) -> None:
        super().__init__(skill, **options)
        spread = finite_number(spread, "TPGMM: spread", "m", above=0.0)
        self.force = finite_number(force, "TPGMM: force", "m^4", at_least=0.0)
        self.influence = finite_number(influence, "TPGMM: influence", "m", above=0.0)
        number = skill.gmr_.n_components_ if n_components is None else n_components
        number = whole_number(number, "TPGMM: n_components", at_least=1)
        if demonstrations is None:
            shown = demonstrations_between_ends(skill, spread)
        else:
            shown = [d.trajectory if isinstance(d, Demonstration) else d for d in demonstrations]
            if len(shown) < 2:
                raise InputError(f"TPGMM: demonstrations: at least 2 are necessary, got {len(shown)}")
        self.mixture_ = FrameMixture.of(shown, number)

    def target(self, nominal: Trajectory, fractions: Array) -> Array:
        """Return the target of the spring for the start and the goal of this motion, shape (n, 3) [m]."""
        regression = self.mixture_.between(nominal.positions[0], nominal.positions[-1])
        path = regression.trajectory(_SAMPLES)
        primitive = DMP(self.skill.dmp_.gains_, n_basis=self.skill.dmp_.n_basis).fit(path, exact_ends=True)
        return primitive.begin().target.at(np.exp(-DECAY * fractions))

    def term(self, state: MotionState) -> Array:
        """Return the repulsion ``Phi``, shape (3,) [m]."""
        return repulsive_force(state.distance, state.normal, self.force, self.influence)
