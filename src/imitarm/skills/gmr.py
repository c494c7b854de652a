"""Gaussian mixture regression: the mean motion and its spread at every instant, from several demonstrations."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.errors import InputError
from imitarm.kinematics.pose import mean_quaternion
from imitarm.skills.gmm import DegenerateAxisWarning, GaussianMixture
from imitarm.skills.rotation_reference import RotationReference, left_jacobian
from imitarm.skills.samples import SingleDemonstrationWarning, samples_of
from imitarm.skills.selection import Candidate, choose, try_numbers_of_components
from imitarm.trajectory import Demonstration, Trajectory

Array = NDArray[np.float64]

_AXES = ("x", "y", "z")
_LEAST_CORRECTED = 0.05  # of the duration: the shortest time over which the nominal path leaves an end's correction


class GMR:
    r"""Gaussian mixture regression over time, of positions and rotations.

    A :class:`~imitarm.skills.gmm.GaussianMixture` is fitted to all samples z = [t; x] of all demonstrations, and then
    conditioned on t (METHODS C; thesis Eq 2.6, whose print lacks the responsibilities h_k):

    .. math::
        \beta_k = \Sigma_k^{xt} / \Sigma_k^{tt}, \quad
        m_k(t) = \mu_k^x + \beta_k (t - \mu_k^t), \quad
        S_k = \Sigma_k^{xx} - \beta_k \Sigma_k^{tx}

        h_k(t) = \frac{\pi_k N(t; \mu_k^t, \Sigma_k^{tt})}{\sum_j \pi_j N(t; \mu_j^t, \Sigma_j^{tt})}

        \hat x(t) = \sum_k h_k m_k, \qquad
        \hat\Sigma(t) = \sum_k h_k \left( S_k + (m_k - \hat x)(m_k - \hat x)^T \right)

    When the demonstrations have quaternions, x holds six columns: position [m] and the rotation vector [rad] in the
    tangent space of a reference rotation, which turns along when the motion turns far
    (:class:`~imitarm.skills.rotation_reference.RotationReference`).

    Times are those since the first sample. A query outside the demonstrated span is held at its end, because the
    linear pieces drift away there.

    Args:
        n_components: number K of Gaussians, or ``"auto"``: the smallest K that reproduces held-out demonstrations as
            well as any and rounds off little, see :func:`~imitarm.skills.selection.choose`.
        candidates: the numbers that ``"auto"`` tries.
        reg_covar: as in GaussianMixture.
        n_init: as in GaussianMixture.
        min_std: smallest standard deviations that count as motion (position [m], rotation [rad]).
        random_state: seed of further starts when ``n_init`` is above 1.

    Attributes:
        n_components_: number K of Gaussians.
        selection_: what ``"auto"`` tried, one row a number of components; empty when the number was given.
        duration_: demonstrated span [s]; the median when demonstrations differ.
        n_demonstrations_: number of demonstrations.
        has_orientation_: whether rotations were learnt.
        weights_: priors, shape (K,).
        means_: of [t; x], shape (K, 1 + D), D = 3 or 6.
        covariances_: of [t; x], shape (K, 1 + D, 1 + D).
        reference_: the rotation near which rotations are vectors; None without rotations.
        ends_: mean start and mean goal of the demonstrations, as x (position, rotation vector), shape (2, D).
        degenerate_axes_: columns of x that don't move, 0 to 2 for x, y, z, 3 to 5 for rotations.
        converged_: whether the fit converged.
        lower_bound_: mean log-likelihood per sample.

    Raises:
        InputError: when an option is out of range.
    """

    n_components_: int
    selection_: tuple[Candidate, ...]
    duration_: float
    n_demonstrations_: int
    weights_: Array
    means_: Array
    covariances_: Array
    reference_: RotationReference | None
    ends_: Array
    degenerate_axes_: tuple[int, ...]
    converged_: bool
    lower_bound_: float

    def __init__(
        self,
        n_components: int | Literal["auto"] = "auto",
        *,
        candidates: Sequence[int] = tuple(range(2, 17)),
        reg_covar: float = 1e-6,
        n_init: int = 1,
        min_std: tuple[float, float] = (1e-4, 1e-3),
        random_state: int = 0,
    ) -> None:
        if isinstance(n_components, str):
            if n_components != "auto":
                raise InputError(f"GMR: n_components must be a whole number or 'auto', got {n_components!r}")
            if len(candidates) == 0:
                raise InputError("GMR: candidates is empty; give the numbers of components to try")
        numbers = candidates if n_components == "auto" else [n_components]
        for number in numbers:  # the options are checked here, when they are given
            GaussianMixture(number, reg_covar=reg_covar, n_init=n_init)
        self.n_components = n_components
        self.candidates = tuple(candidates)
        self.reg_covar = reg_covar
        self.n_init = n_init
        self.min_std = min_std
        self.random_state = random_state

    def fit(self, demonstrations: Sequence[Demonstration | Trajectory]) -> Self:
        """Learn from demonstrations, aligned beforehand (``imitarm.demonstrations.align``).

        Times start anywhere: each demonstration's first time is subtracted. Durations that differ by more than 1 %
        are scaled to their median, with an
        :class:`~imitarm.skills.samples.UnalignedWarning`.

        Raises:
            InputError: when there is no demonstration, only some have quaternions, or there are fewer samples than
                components.
        """
        tables, reference, duration = samples_of(demonstrations)
        self.duration_, self.n_demonstrations_, self.reference_ = duration, len(tables), reference
        min_std = np.array([0.0, *[self.min_std[0]] * 3, *[self.min_std[1]] * 3])[: tables[0].shape[1]]
        if len(tables) == 1:
            warnings.warn(
                "only one demonstration: the covariance tells how well it was fitted, not how much a person varies; "
                "give 3 or more",
                SingleDemonstrationWarning,
                stacklevel=2,
            )
        self.selection_ = ()
        if self.n_components == "auto":
            self.selection_ = try_numbers_of_components(tables, self.candidates, min_std, self.reg_covar)
            number = choose(self.selection_)
        else:
            number = int(self.n_components)
        mixture = GaussianMixture(
            number,
            reg_covar=self.reg_covar,
            n_init=self.n_init,
            min_std=min_std,
            random_state=self.random_state,
        )
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DegenerateAxisWarning)
            mixture.fit(np.concatenate(tables))
        self._learn(mixture.weights_, mixture.means_, mixture.covariances_)
        self.ends_ = self._mean_ends(demonstrations)
        self.converged_, self.lower_bound_ = mixture.converged_, mixture.lower_bound_
        self.degenerate_axes_ = tuple(i - 1 for i in mixture.degenerate_axes_)
        still = [_AXES[i] for i in self.degenerate_axes_ if i < len(_AXES)]
        if still:  # rotations that stay, or turn about one axis, are nothing unusual
            warnings.warn(
                f"the demonstrations don't move in {', '.join(still)}; kept constant there, without influence on the "
                "other axes",
                DegenerateAxisWarning,
                stacklevel=2,
            )
        return self

    @classmethod
    def from_mixture(
        cls,
        weights: ArrayLike,
        means: ArrayLike,
        covariances: ArrayLike,
        *,
        duration: float,
        n_demonstrations: int = 1,
        reference: RotationReference | None = None,
        ends: ArrayLike | None = None,
        selection: Sequence[Candidate] = (),
        degenerate_axes: Sequence[int] = (),
        converged: bool = True,
        lower_bound: float = np.nan,
    ) -> GMR:
        """Build from a mixture that was learnt before.

        Args:
            weights: priors, shape (K,).
            means: of [t; x], shape (K, 1 + D), D = 3, or 6 with a reference.
            covariances: of [t; x], shape (K, 1 + D, 1 + D).
            duration: demonstrated span [s].
            n_demonstrations: how many it was learnt from.
            reference: the rotation near which the last three columns are rotation vectors.
            ends: mean start and mean goal of the demonstrations, shape (2, D); None: where the mixture's mean begins
                and ends.
            selection: what was tried.
            degenerate_axes: columns of x that don't move.
            converged: whether the fit converged.
            lower_bound: mean log-likelihood per sample.

        Raises:
            InputError: when shapes disagree, the weights don't sum to one, a covariance is not symmetric and positive
                definite, or the duration is not above 0.
        """
        w, mu, sigma = (np.array(a, dtype=float) for a in (weights, means, covariances))
        columns = 4 if reference is None else 7
        K = len(w) if w.ndim == 1 else 0
        if K < 1 or mu.shape != (K, columns) or sigma.shape != (K, columns, columns):
            raise InputError(
                f"GMR.from_mixture: shapes (K,), (K, {columns}), (K, {columns}, {columns}) are needed, "
                f"got {w.shape}, {mu.shape}, {sigma.shape}"
            )
        if not (np.all(w > 0.0) and abs(w.sum() - 1.0) < 1e-6):
            raise InputError("GMR.from_mixture: weights must be above 0 and sum to one")
        if not (np.all(np.isfinite(mu)) and np.all(np.isfinite(sigma))):
            raise InputError("GMR.from_mixture: means and covariances must be finite")
        sizes = np.sqrt(np.maximum(np.diagonal(sigma, axis1=1, axis2=2), 1e-300))
        scaled = sigma / (sizes[:, :, None] * sizes[:, None, :])  # metres and radians side by side
        if not np.allclose(scaled, np.swapaxes(scaled, 1, 2)) or np.linalg.eigvalsh(scaled).min() <= 0.0:
            raise InputError("GMR.from_mixture: every covariance must be symmetric and positive definite")
        if not (np.isfinite(duration) and duration > 0.0):
            raise InputError(f"GMR.from_mixture: duration must be above 0 s, got {duration!r}")
        gmr = cls(K)
        gmr.duration_, gmr.n_demonstrations_, gmr.reference_ = float(duration), int(n_demonstrations), reference
        gmr.selection_, gmr.degenerate_axes_ = tuple(selection), tuple(int(i) for i in degenerate_axes)
        gmr.converged_, gmr.lower_bound_ = converged, float(lower_bound)
        gmr._learn(w, mu, sigma)
        gmr.ends_ = gmr._regress(np.array([0.0, gmr.duration_]), columns - 1)[0]
        if ends is not None:
            given = np.array(ends, dtype=float)
            if given.shape != gmr.ends_.shape or not np.all(np.isfinite(given)):
                raise InputError(f"GMR.from_mixture: ends must be 2 rows of {columns - 1} finite numbers")
            gmr.ends_ = given
        return gmr

    def _learn(self, weights: Array, means: Array, covariances: Array) -> None:
        """Take the mixture, its components in the order of time, and prepare the regression."""
        order = np.argsort(means[:, 0], kind="stable")
        self.weights_, self.means_, self.covariances_ = weights[order], means[order], covariances[order]
        self.n_components_ = len(order)
        # m_k is linear and m_k m_k^T quadratic in u_k = t - mu_k^t, so that both sums over the components are products
        # of [h, h u, h u^2] with a table. Taken about the centre of the motion nothing is lost by cancellation.
        self._center = self.weights_ @ self.means_[:, 1:]
        mu = self.means_[:, 1:] - self._center
        beta = self.covariances_[:, 1:, 0] / self.covariances_[:, 0, :1]
        within = self.covariances_[:, 1:, 1:] - beta[:, :, None] * self.covariances_[:, None, 0, 1:]
        mixed = mu[:, :, None] * beta[:, None, :]
        self._first = np.concatenate([mu, beta])
        self._second = np.concatenate(
            [
                within + mu[:, :, None] * mu[:, None, :],
                mixed + np.swapaxes(mixed, 1, 2),
                beta[:, :, None] * beta[:, None, :],
            ]
        )

    @property
    def has_orientation_(self) -> bool:
        """Whether rotations were learnt."""
        return self.reference_ is not None

    @property
    def time_means_(self) -> Array:
        """Where in time the components lie [s], increasing, shape (K,)."""
        return self.means_[:, 0]

    @property
    def position_means_(self) -> Array:
        """Means of the positions [m], shape (K, 3)."""
        return self.means_[:, 1:4]

    @property
    def position_covariances_(self) -> Array:
        """Covariances of the positions [m^2], shape (K, 3, 3)."""
        return self.covariances_[:, 1:4, 1:4]

    def _clamped(self, times: ArrayLike) -> Array:
        if not hasattr(self, "means_"):
            raise InputError("GMR: not fitted yet; call fit first")
        t = np.atleast_1d(np.asarray(times, dtype=float))
        if t.ndim != 1 or not np.all(np.isfinite(t)):
            raise InputError(f"GMR: times must be finite numbers [s] of shape (n,), got shape {t.shape}")
        return np.clip(t, 0.0, self.duration_)

    def responsibilities(self, times: ArrayLike) -> Array:
        """Return h_k(t), how much each component has to say at ``times`` (n,) [s], shape (n, K), rows sum to one."""
        return self._responsibilities(self._clamped(times)[:, None] - self.time_means_)

    def _responsibilities(self, u: Array) -> Array:
        """Return h (n, K) for times since the components' own, u (n, K)."""
        variances = self.covariances_[:, 0, 0]
        h = u * u * (-0.5 / variances) + (np.log(self.weights_) - 0.5 * np.log(variances))
        np.exp(h - h.max(axis=1, keepdims=True), out=h)
        return np.asarray(h / h.sum(axis=1, keepdims=True))

    def _regress(self, t: Array, n_columns: int) -> tuple[Array, Array]:
        """Return mean (n, D) and covariance (n, D, D) of the first columns of x at clamped times."""
        u = t[:, None] - self.time_means_
        h = self._responsibilities(u)
        powers = np.concatenate([h, h * u, h * u * u], axis=1)
        mean = powers[:, : len(self._first)] @ self._first[:, :n_columns]
        second = powers @ self._second[:, :n_columns, :n_columns].reshape(len(self._second), -1)
        covariance = second.reshape(-1, n_columns, n_columns) - mean[:, :, None] * mean[:, None, :]
        return mean + self._center[:n_columns], covariance

    def predict(self, times: ArrayLike) -> tuple[Array, Array]:
        """Return mean position (n, 3) [m] and its covariance (n, 3, 3) [m^2] at ``times`` (n,) [s]."""
        return self._regress(self._clamped(times), 3)

    def predict_orientation(self, times: ArrayLike) -> tuple[Array, Array]:
        """Return the mean rotation and its covariance at ``times`` (n,) [s].

        Returns:
            Quaternions wxyz (n, 4), and covariance (n, 3, 3) [rad^2] of the small turn, in the base frame, that takes
            the mean rotation to a demonstrated one.

        Raises:
            InputError: when the demonstrations had no quaternions.
        """
        _, quaternions, covariance = self.predict_pose(times)
        return quaternions, covariance[:, 3:, 3:]

    def predict_pose(self, times: ArrayLike) -> tuple[Array, Array, Array]:
        """Return position, rotation and their joint covariance at ``times`` (n,) [s].

        Returns:
            Positions (n, 3) [m], quaternions wxyz (n, 4), and covariance (n, 6, 6) of [position; small turn in the
            base frame], in m and rad.

        Raises:
            InputError: when the demonstrations had no quaternions.
        """
        t = self._clamped(times)
        if self.reference_ is None:
            raise InputError("GMR: the demonstrations had no quaternions, so no orientation was learnt")
        mean, covariance = self._regress(t, 6)
        transport = np.zeros_like(covariance)
        transport[:, :3, :3] = np.eye(3)
        transport[:, 3:, 3:] = left_jacobian(mean[:, 3:])
        covariance = transport @ covariance @ np.swapaxes(transport, 1, 2)
        return mean[:, :3], self.reference_.to_quaternions(t, mean[:, 3:]), covariance

    def nominal(self, times: ArrayLike) -> tuple[Array, Array | None]:
        r"""Return the nominal path at ``times`` (n,) [s]: the mean motion, made to begin and end exactly as shown.

        The mean :math:`\hat x` consists of straight pieces, blended, and misses the mean start and goal of the
        demonstrations by millimetres. The nominal path closes both gaps by smooth steps that depend on time alone:

        .. math::
            x_0(t) = \hat x(t) + b(t / w_1) (x_{start} - \hat x(0)) + b((T - t) / w_K) (x_{goal} - \hat x(T)), \quad
            b(u) = 1 - 10 u^3 + 15 u^4 - 6 u^5

        The widths :math:`w_1 = \mu_1^t` and :math:`w_K = T - \mu_K^t` reach to the centres of the first and the last
        Gaussian, at least a twentieth of the duration. Moving the mean of Gaussian k by :math:`\Delta_k` still moves
        the path by :math:`h_k(t) \Delta_k`.

        Returns:
            Positions (n, 3) [m], and quaternions wxyz (n, 4), None without rotations.
        """
        t = self._clamped(times)
        x = self._regress(t, self.means_.shape[1] - 1)[0] + self._end_correction(t)
        return x[:, :3], None if self.reference_ is None else self.reference_.to_quaternions(t, x[:, 3:])

    def _end_correction(self, t: Array) -> Array:
        """Return what the nominal path adds to the mean at clamped times (n,), shape (n, D)."""
        T, centres = self.duration_, self.time_means_
        widths = np.clip(np.array([centres[0], T - centres[-1]]), _LEAST_CORRECTED * T, T)
        u = np.minimum(np.stack([t, T - t], axis=1) / widths, 1.0)
        blend = 1.0 - u**3 * (10.0 + u * (6.0 * u - 15.0))
        gaps = self.ends_ - self._regress(np.array([0.0, T]), self.ends_.shape[1])[0]
        return np.asarray(blend @ gaps)

    def _mean_ends(self, demonstrations: Sequence[Demonstration | Trajectory]) -> Array:
        """Return the mean of the demonstrated starts and of the goals, as x, shape (2, D)."""
        motions = [d.trajectory if isinstance(d, Demonstration) else d for d in demonstrations]
        rows = [np.mean([m.positions[i] for m in motions], axis=0) for i in (0, -1)]
        if self.reference_ is not None:
            for i, t in ((0, 0.0), (-1, self.duration_)):
                turned = mean_quaternion(np.stack([m.quaternions[i] for m in motions if m.quaternions is not None]))
                rows[i] = np.concatenate([rows[i], self.reference_.to_vectors([t], turned[None])[0]])
        return np.stack(rows)

    def trajectory(self, n: int = 200) -> Trajectory:
        """Return the nominal path at ``n`` equally spaced times of the demonstrated span."""
        times = np.linspace(0.0, self.duration_, n)
        return Trajectory(times, *self.nominal(times))
