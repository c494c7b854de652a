"""Gaussian mixture regression: the mean motion and its covariance at every time, from several demonstrations."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.errors import InputError
from imitarm.kinematics.pose import mean_quaternion
from imitarm.skills.gmm import DegenerateAxisWarning, GaussianMixture
from imitarm.skills.mixture_fitting import MORE_NUMBERS, NUMBERS, Candidate, choose, try_numbers_of_components
from imitarm.skills.rotations import RotationReference, left_jacobian
from imitarm.trajectory import Demonstration, Trajectory
from imitarm.validation import (
    choice,
    finite_array,
    finite_number,
    finite_numbers,
    finite_vector,
    flag,
    instance,
    real_array,
    sequence,
    whole_number,
)

Array = NDArray[np.float64]

_AXES = ("x", "y", "z")
_LEAST_CORRECTED = 0.05  # of the duration: the shortest time in which the correction of an end fades out
_SAME_DURATION = 0.01  # demonstrations whose durations differ by a larger fraction were not aligned
_CLOCK_DIGITS = 6  # microseconds, the resolution of epoch times: rounded, they give the same skill as other times


class SingleDemonstrationWarning(UserWarning):
    """There is only one demonstration, so the covariance shows only the error of the fit."""


class UnalignedWarning(UserWarning):
    """The demonstrations differ in duration. Align them first, because the mean of unaligned motions is flattened."""


class GMR:
    r"""Gaussian mixture regression over time, of positions and rotations.

    A :class:`~imitarm.skills.gmm.GaussianMixture` is fitted to all samples z = [t; x] of all demonstrations. The
    regression then conditions this mixture on t (thesis Eq 2.6; the printed equation lacks the responsibilities
    :math:`h_k`):

    .. math::
        \beta_k = \Sigma_k^{xt} / \Sigma_k^{tt}, \quad
        m_k(t) = \mu_k^x + \beta_k (t - \mu_k^t), \quad
        S_k = \Sigma_k^{xx} - \beta_k \Sigma_k^{tx}

        h_k(t) = \frac{\pi_k N(t; \mu_k^t, \Sigma_k^{tt})}{\sum_j \pi_j N(t; \mu_j^t, \Sigma_j^{tt})}

        \hat x(t) = \sum_k h_k m_k, \qquad
        \hat\Sigma(t) = \sum_k h_k \left( S_k + (m_k - \hat x)(m_k - \hat x)^T \right)

    If the demonstrations have quaternions, x has six columns: the position [m] and a rotation vector [rad] relative to
    a reference rotation (:class:`~imitarm.skills.rotations.RotationReference`). If the tool rotates far, the reference
    rotates with the tool.

    Times are counted from the first sample. For times outside the demonstrated span, the regression returns its value
    at the nearest end of the span, because an extrapolation would drift away.

    Args:
        n_components: number K of Gaussians, or ``"auto"``. ``"auto"`` takes the smallest K that has a small bias and
            nearly the smallest error on held-out demonstrations (:func:`~imitarm.skills.mixture_fitting.choose`).
        candidates: the numbers of Gaussians that ``"auto"`` tries; None: 2 to 16, and larger numbers as long as the
            bias is large.
        reg_covar: see :class:`~imitarm.skills.gmm.GaussianMixture`.
        n_init: see :class:`~imitarm.skills.gmm.GaussianMixture`.
        min_std: an axis counts as constant if its standard deviation is at most this value. Pass two values, one for
            positions [m] and one for rotation vectors [rad].
        random_state: seed of the additional starts when ``n_init`` is above 1.

    Attributes:
        n_components_: number K of Gaussians.
        selection_: results of ``"auto"``, one entry for each number of components; empty if ``n_components`` was a
            number.
        duration_: demonstrated duration [s]; the median if the demonstrations have different durations.
        n_demonstrations_: number of demonstrations.
        has_orientation_: whether rotations were learned.
        weights_: priors, shape (K,).
        means_: means of [t; x], shape (K, 1 + D), D = 3 or 6.
        covariances_: covariances of [t; x], shape (K, 1 + D, 1 + D).
        reference_: the reference of the rotation vectors; None without rotations.
        ends_: mean start and mean goal of the demonstrations, as rows x (position, rotation vector), shape (2, D).
        degenerate_axes_: indices of the constant columns of x; 0 to 2 are the position, 3 to 5 the rotation vector.
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
        candidates: Sequence[int] | None = None,
        reg_covar: float = 1e-6,
        n_init: int = 1,
        min_std: tuple[float, float] = (1e-4, 1e-3),
        random_state: int = 0,
    ) -> None:
        if isinstance(n_components, str):
            choice(n_components, ("auto",), "n_components of GMR (a whole number or a name)")
        self.candidates = None if candidates is None else sequence(candidates, int, "GMR: candidates")
        if self.candidates == ():
            raise InputError("GMR: candidates is empty; give the numbers of components to try")
        numbers = (self.candidates or NUMBERS) if isinstance(n_components, str) else (n_components,)
        for number in numbers:  # the options are checked here, when they are given
            GaussianMixture(number, reg_covar=reg_covar, n_init=n_init, random_state=random_state)
        self.n_components = n_components
        self.reg_covar = reg_covar
        self.n_init = n_init
        self.min_std = tuple(finite_vector(min_std, 2, "GMR: min_std (position, rotation)", "m, rad").tolist())
        self.random_state = random_state

    def fit(self, demonstrations: Sequence[Demonstration | Trajectory]) -> Self:
        """Learn from demonstrations that were aligned before (``imitarm.demonstrations.align``).

        Times may start anywhere, because the first time of each demonstration is subtracted. All durations are scaled
        to their median. If they differ by more than 1 %, the method issues an :class:`UnalignedWarning`.

        Raises:
            InputError: when there is no demonstration, only some have quaternions, or there are fewer samples than
                components.
        """
        tables, reference, duration = samples_of(demonstrations)
        self.duration_, self.n_demonstrations_, self.reference_ = duration, len(tables), reference
        min_std = np.array([0.0, *[self.min_std[0]] * 3, *[self.min_std[1]] * 3])[: tables[0].shape[1]]
        if len(tables) == 1:
            warnings.warn(
                "only one demonstration: the covariance shows only the error of the fit; give 3 or more",
                SingleDemonstrationWarning,
                stacklevel=2,
            )
        self.selection_ = ()
        if self.n_components == "auto":
            numbers, more = (self.candidates, ()) if self.candidates else (NUMBERS, MORE_NUMBERS)
            self.selection_ = try_numbers_of_components(tables, numbers, min_std, self.reg_covar, more)
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
        if still:  # rotations about one axis only, or none, are usual
            warnings.warn(
                f"the demonstrations do not move in {', '.join(still)}; the skill keeps these coordinates constant and "
                "learns the others",
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
        """Build a regression from a mixture that was learned before.

        Each argument becomes the attribute of the same name with an underscore, for example ``means_``. If ``ends`` is
        None, the start and the goal of the mixture's mean are used.

        Raises:
            InputError: when shapes disagree, the weights do not sum to one, a covariance is not symmetric and positive
                definite, or the duration is not above 0.
        """
        what = "GMR.from_mixture:"
        columns = 4 if reference is None else 7
        w = finite_array(weights, (None,), f"{what} weights").copy()
        mu = finite_array(means, (len(w), columns), f"{what} means").copy()
        sigma = finite_array(covariances, (len(w), columns, columns), f"{what} covariances").copy()
        if not (len(w) and np.all(w > 0.0) and abs(w.sum() - 1.0) < 1e-6):
            raise InputError(f"{what} weights must be above 0 and sum to one")
        sizes = np.sqrt(np.maximum(np.diagonal(sigma, axis1=1, axis2=2), 1e-300))
        scaled = sigma / (sizes[:, :, None] * sizes[:, None, :])  # metres and radians side by side
        if not np.allclose(scaled, np.swapaxes(scaled, 1, 2)) or np.linalg.eigvalsh(scaled).min() <= 0.0:
            raise InputError(f"{what} every covariance must be symmetric and positive definite")
        gmr = cls(len(w))
        gmr.duration_ = finite_number(duration, f"{what} duration", "s", above=0.0)
        gmr.n_demonstrations_ = whole_number(n_demonstrations, f"{what} n_demonstrations", at_least=1)
        gmr.reference_ = None if reference is None else instance(reference, RotationReference, f"{what} reference")
        gmr.selection_ = sequence(selection, Candidate, f"{what} selection")
        gmr.degenerate_axes_ = sequence(degenerate_axes, int, f"{what} degenerate_axes")
        if any(not 0 <= i < columns - 1 for i in gmr.degenerate_axes_):
            raise InputError(f"{what} degenerate_axes must be from 0 to {columns - 2}, got {gmr.degenerate_axes_}")
        gmr.converged_ = flag(converged, f"{what} converged")
        gmr.lower_bound_ = float(real_array(lower_bound, (), f"{what} lower_bound"))
        gmr._learn(w, mu, sigma)
        if ends is None:
            gmr.ends_ = gmr._regress(np.array([0.0, gmr.duration_]), columns - 1)[0]
        else:
            gmr.ends_ = finite_array(ends, (2, columns - 1), f"{what} ends").copy()
        return gmr

    def _learn(self, weights: Array, means: Array, covariances: Array) -> None:
        """Store the mixture with its components in the order of time, and prepare the regression."""
        order = np.argsort(means[:, 0], kind="stable")
        self.weights_, self.means_, self.covariances_ = weights[order], means[order], covariances[order]
        self.n_components_ = len(order)
        variances = self.covariances_[:, 0, 0]
        self._curvature, self._log_peak = -0.5 / variances, np.log(self.weights_) - 0.5 * np.log(variances)
        # m_k is linear and m_k m_k^T quadratic in u_k = t - mu_k^t, so both sums over the components are products of
        # [h, h u, h u^2] with a table. Positions relative to the centre of the motion avoid cancellation.
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
        """Whether rotations were learned."""
        return self.reference_ is not None

    @property
    def time_means_(self) -> Array:
        """Means of the components' times [s], increasing, shape (K,)."""
        return self.means_[:, 0]

    @property
    def position_means_(self) -> Array:
        """Means of the positions [m], shape (K, 3)."""
        return self.means_[:, 1:4]

    @property
    def position_covariances_(self) -> Array:
        """Covariances of the positions [m^2], shape (K, 3, 3)."""
        return self.covariances_[:, 1:4, 1:4]

    def _fitted(self) -> Self:
        if not hasattr(self, "means_"):
            raise InputError("GMR: not fitted yet; call fit first")
        return self

    def _clamped(self, times: ArrayLike) -> Array:
        return np.clip(finite_numbers(times, "GMR: times", "s"), 0.0, self._fitted().duration_)

    def responsibilities(self, times: ArrayLike) -> Array:
        """Return h_k(t), the weight of each component at ``times`` (n,) [s], shape (n, K); each row sums to one."""
        return self._responsibilities(self._clamped(times)[:, None] - self.time_means_)

    def _responsibilities(self, u: Array) -> Array:
        """Return h (n, K) for u (n, K), the times relative to the components' mean times."""
        h = u * u * self._curvature + self._log_peak
        np.exp(h - h.max(axis=1, keepdims=True), out=h)
        return np.asarray(h / h.sum(axis=1, keepdims=True))

    def _regress(self, t: Array, n_columns: int) -> tuple[Array, Array]:
        """Return mean (n, D) and covariance (n, D, D) of the first columns of x, for times in the learned span."""
        u = t[:, None] - self.time_means_
        h = self._responsibilities(u)
        powers = np.concatenate([h, h * u, h * u * u], axis=1)
        mean = powers[:, : len(self._first)] @ self._first[:, :n_columns]
        second = powers @ self._second[:, :n_columns, :n_columns].reshape(len(self._second), -1)
        covariance = second.reshape(-1, n_columns, n_columns) - mean[:, :, None] * mean[:, None, :]
        return mean + self._center[:n_columns], covariance

    def predict(self, times: ArrayLike) -> tuple[Array, Array]:
        """Return the mean position (n, 3) [m] and its covariance (n, 3, 3) [m^2] at ``times`` (n,) [s]."""
        return self._regress(self._clamped(times), 3)

    def predict_orientation(self, times: ArrayLike) -> tuple[Array, Array]:
        """Return the mean rotation and its covariance at ``times`` (n,) [s].

        Returns:
            Quaternions wxyz (n, 4), and covariance (n, 3, 3) [rad^2]. The covariance is that of small rotation vectors
            from the mean rotation to the demonstrated rotations, in the base frame.

        Raises:
            InputError: when the demonstrations had no quaternions.
        """
        _, quaternions, covariance = self.predict_pose(times)
        return quaternions, covariance[:, 3:, 3:]

    def predict_pose(self, times: ArrayLike) -> tuple[Array, Array, Array]:
        """Return position, rotation and their joint covariance at ``times`` (n,) [s].

        Returns:
            Positions (n, 3) [m], quaternions wxyz (n, 4), and covariance (n, 6, 6) of [position; small rotation in the
            base frame], in m and rad.

        Raises:
            InputError: when the demonstrations had no quaternions.
        """
        t = self._clamped(times)
        if self.reference_ is None:
            raise InputError("GMR: the demonstrations had no quaternions, so no orientation was learned")
        mean, covariance = self._regress(t, 6)
        transport = np.zeros_like(covariance)
        transport[:, :3, :3] = np.eye(3)
        transport[:, 3:, 3:] = left_jacobian(mean[:, 3:])
        covariance = transport @ covariance @ np.swapaxes(transport, 1, 2)
        return mean[:, :3], self.reference_.to_quaternions(t, mean[:, 3:]), covariance

    def nominal(self, times: ArrayLike) -> tuple[Array, Array | None]:
        r"""Return the nominal path at ``times`` (n,) [s]: the mean motion, with exact start and goal.

        The mean :math:`\hat x` blends straight pieces and therefore misses the mean start and the mean goal of the
        demonstrations by some millimetres. To obtain the nominal path, both ends of the mean are corrected, weighted by
        the smooth step :math:`b`:

        .. math::
            \bar x(t) = \hat x(t) + b(t / w_1) (x_{start} - \hat x(0)) + b((T - t) / w_K) (x_{goal} - \hat x(T)), \quad
            b(u) = 1 - 10 u^3 + 15 u^4 - 6 u^5

        The correction at the start lasts until the centre of the first Gaussian, :math:`w_1 = \mu_1^t`. The correction
        at the goal begins at the centre of the last Gaussian, so :math:`w_K = T - \mu_K^t`, where T is the duration.
        Both :math:`w_1` and :math:`w_K` are at least a twentieth of the duration. The correction depends only on time.
        If a policy moves the mean of Gaussian k by :math:`\Delta_k`, the path therefore still moves by :math:`h_k(t)
        \Delta_k`.

        Returns:
            Positions (n, 3) [m] and quaternions wxyz (n, 4); None instead of quaternions if no rotations were learned.
        """
        t = self._clamped(times)
        x = self._regress(t, self.means_.shape[1] - 1)[0] + self._end_correction(t)
        return x[:, :3], None if self.reference_ is None else self.reference_.to_quaternions(t, x[:, 3:])

    def _end_correction(self, t: Array) -> Array:
        """Return the correction that the nominal path adds to the mean at clamped times (n,), shape (n, D)."""
        T, centres = self.duration_, self.time_means_
        widths = np.clip(np.array([centres[0], T - centres[-1]]), _LEAST_CORRECTED * T, T)
        u = np.minimum(np.stack([t, T - t], axis=1) / widths, 1.0)
        blend = 1.0 - u**3 * (10.0 + u * (6.0 * u - 15.0))
        gaps = self.ends_ - self._regress(np.array([0.0, T]), self.ends_.shape[1])[0]
        return np.asarray(blend @ gaps)

    def _mean_ends(self, demonstrations: Sequence[Demonstration | Trajectory]) -> Array:
        """Return the mean start and the mean goal of the demonstrations, as two vectors x, shape (2, D)."""
        motions = [d.trajectory if isinstance(d, Demonstration) else d for d in demonstrations]
        rows = [np.mean([m.positions[i] for m in motions], axis=0) for i in (0, -1)]
        if self.reference_ is not None:
            for i, t in ((0, 0.0), (-1, self.duration_)):
                turned = mean_quaternion(np.stack([m.quaternions[i] for m in motions if m.quaternions is not None]))
                rows[i] = np.concatenate([rows[i], self.reference_.to_vectors([t], turned[None])[0]])
        return np.stack(rows)

    def trajectory(self, n: int = 200) -> Trajectory:
        """Return the nominal path at ``n`` equally spaced times of the demonstrated span.

        Raises:
            InputError: when not fitted, or ``n`` is not a whole number from 2 to 10 million.
        """
        n = whole_number(n, "GMR.trajectory: n", at_least=2, at_most=10_000_000)
        times = np.linspace(0.0, self._fitted().duration_, n)
        return Trajectory(times, *self.nominal(times))


def samples_of(
    demonstrations: Sequence[Demonstration | Trajectory],
) -> tuple[list[Array], RotationReference | None, float]:
    """Return the samples of each demonstration as a table, with times scaled to run from 0 to the median duration.

    If all demonstrations have rotations, these become rotation vectors relative to a common reference.

    Returns:
        Three values: tables with rows [t, x, y, z] or [t, x, y, z, r1, r2, r3], the reference of the rotations (None
        without rotations), and the duration [s].

    Raises:
        InputError: when there is no demonstration, only some have quaternions, or their rotations differ too much.
    """
    if isinstance(demonstrations, Demonstration | Trajectory):
        raise InputError("GMR.fit: give a list of demonstrations, not a single one")
    if isinstance(demonstrations, str) or not isinstance(demonstrations, Sequence):
        raise InputError(f"GMR.fit: demonstrations must be a list, got {type(demonstrations).__name__}")
    if len(demonstrations) < 1:
        raise InputError("GMR.fit: no demonstrations; give at least 1, preferably 3 or more")
    trajectories = [d.trajectory if isinstance(d, Demonstration) else d for d in demonstrations]
    for i, trajectory in enumerate(trajectories):
        if not isinstance(trajectory, Trajectory):
            raise InputError(f"GMR.fit: demonstration {i} is a {type(trajectory).__name__}, not a Demonstration")
    without = [i for i, trajectory in enumerate(trajectories) if trajectory.quaternions is None]
    if 0 < len(without) < len(trajectories):
        raise InputError(
            f"GMR.fit: demonstrations {without} have no quaternions while the others have; "
            "record the orientation in all demonstrations, or remove it from all"
        )
    durations = np.array([trajectory.duration for trajectory in trajectories])
    duration = float(np.median(durations))
    if np.ptp(durations) > _SAME_DURATION * duration:
        warnings.warn(
            f"demonstrations last from {durations.min():.3g} to {durations.max():.3g} s; their times are scaled to "
            f"{duration:.3g} s. Align them first, because the mean of unaligned motions is flattened",
            UnalignedWarning,
            stacklevel=3,
        )
    times = [_since_start(k.times) * (duration / k.duration) for k in trajectories]
    tables = [np.column_stack([t, k.positions]) for t, k in zip(times, trajectories, strict=True)]
    if without:
        return tables, None, duration
    rotations = [(t, k.quaternions) for t, k in zip(times, trajectories, strict=True) if k.quaternions is not None]
    reference = RotationReference.among(rotations)
    vectors = [reference.to_vectors(t, q) for t, q in rotations]
    return [np.column_stack(pair) for pair in zip(tables, vectors, strict=True)], reference, duration


def _since_start(times: Array) -> Array:
    t = times - times[0]
    rounded = np.round(t, _CLOCK_DIGITS)
    return rounded if np.all(np.diff(rounded) > 0.0) else t
