"""What ``make bench`` times of learning, avoidance and importing; ``ROWS`` lists all rows.

To add a row, write a function that returns a :class:`timing.Row` and put it into ``ROWS``. Peers are imported inside
it: where one is missing, the row says how to install it.
"""

from __future__ import annotations

import os
import subprocess
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import arm_rows
import ik_rows
import rcamo_rows
import retarget_rows
import safety_rows
import tracking_rows
import transmission_rows
from imitarm.benchmark import avoidance, families
from imitarm.skills import DMP, GMR, GaussianMixture
from imitarm.trajectory import Trajectory
from timing import Row, seconds_of
from yardsticks import named, sklearn_fit

Array = NDArray[np.float64]

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def synthetic_demonstrations(seed: int, n_demonstrations: int = 8, n: int = 200) -> list[Trajectory]:
    """Return demonstrations of one synthetic motion of 2 s, each a little different and with 2 mm of noise."""
    rng = np.random.default_rng(seed)
    t = np.linspace(0.0, 2.0, n)
    shown = []
    for _ in range(n_demonstrations):
        a = 1.0 + 0.1 * rng.standard_normal(6)
        x = np.stack(
            [
                0.3 * a[0] * np.sin(1.5 * t + 0.1 * a[1]),
                0.2 * a[2] * np.cos(2.5 * t),
                0.1 * a[3] * np.sin(4.0 * t + 0.2 * a[4]),
            ],
            axis=1,
        )
        shown.append(Trajectory(t, x + 0.002 * rng.standard_normal((n, 3))))
    return shown


def _samples(seed: int) -> Array:
    return np.concatenate([np.column_stack([k.times, k.positions]) for k in synthetic_demonstrations(seed)])


def _minimum_jerk(n: int = 201) -> Trajectory:
    """Return 2 s of a smooth motion with known positions, to compare a reproduction with."""
    t = np.linspace(0.0, 2.0, n)
    u = t / 2.0
    return Trajectory(t, (u**3 * (10.0 + u * (6.0 * u - 15.0)))[:, None] * np.array([0.3, 0.2, -0.1]))


def gaussian_mixture() -> Row:
    """GMM of 8 demonstrations x 200 steps x 4 columns, 8 components; the same five data sets for both."""
    from sklearn.mixture import GaussianMixture as Peer

    data = [_samples(seed) for seed in range(5)]

    def check() -> tuple[bool, str]:
        gains = [GaussianMixture(8).fit(X).score(X) - Peer(8, random_state=0).fit(X).score(X) for X in data]
        note = f"log-likelihood per sample: {np.mean(gains):+.4f} on average, worst data set {min(gains):+.4f}"
        return bool(np.mean(gains) >= 0.0), note

    return Row(
        "GMM fit, 1600 x 4, 8 components (5 data sets)",
        lambda: [GaussianMixture(8).fit(X) for X in data],
        lambda: [Peer(8, random_state=0).fit(X) for X in data],
        named("scikit-learn"),
        faster=3.0,
        check=check,
        repeats=15,
    )


def _regressions() -> tuple[GMR, Any, Array]:
    """Return ours, the peer's with the same mixture, and 200 query times [s]."""
    import gmr

    ours = GMR(8).fit(synthetic_demonstrations(0))
    peer = gmr.GMM(8, priors=ours.weights_, means=ours.means_, covariances=ours.covariances_)
    return ours, peer, np.linspace(0.0, ours.duration_, 200)


def regression_with_covariance() -> Row:
    """GMR at 200 instants, mean and covariance; the peer gives covariances one query at a time."""
    ours, peer, times = _regressions()

    def peer_queries() -> tuple[Array, Array]:
        answers = [peer.condition(np.array([0]), np.array([t])).to_mvn() for t in times]
        return np.stack([a.mean for a in answers]), np.stack([a.covariance for a in answers])

    def check() -> tuple[bool, str]:
        apart = [np.abs(a - b).max() for a, b in zip(ours.predict(times), peer_queries(), strict=True)]
        return bool(max(apart) < 1e-6), f"agree to {apart[0]:.0e} m, {apart[1]:.0e} m^2"

    name = "GMR, 200 queries, mean and covariance"
    return Row(name, lambda: ours.predict(times), peer_queries, named("gmr"), faster=100.0, check=check, repeats=7)


def regression_threads_as_installed() -> Row:
    """GMR at 200 instants, ours with covariance, the peer's mean only, threads as NumPy comes.

    The peer's many small solves wait for threads, so its time depends on what else the machine does.
    """
    _regressions()  # fails here, not while it is timed, when the peer is missing

    def timed(which: str) -> Callable[[], float]:
        code = _TIME_REGRESSION.format(folder=str(Path(__file__).parent), which=which)
        return lambda: _in_fresh_interpreter(code, one_thread=False)

    return Row(
        "GMR, 200 queries, peer mean only, threads as installed",
        timed("ours.predict(times)"),
        timed("peer.predict(np.array([0]), times[:, None])"),
        named("gmr"),
        faster=5.0,
        repeats=7,
        self_timed=True,
    )


_TIME_REGRESSION = """
import sys, time
sys.path.insert(0, {folder!r})
import numpy as np
from speed_rows import _regressions
ours, peer, times = _regressions()
seconds = []
for _ in range(9):
    begin = time.perf_counter()
    {which}
    seconds.append(time.perf_counter() - begin)
print(np.median(seconds))
"""


def regression_mean_only() -> Row:
    """GMR at 200 instants, ours with covariance, the peer's mean only, one thread."""
    ours, peer, times = _regressions()
    return Row(
        "GMR, 200 queries, peer mean only, one thread",
        lambda: ours.predict(times),
        lambda: peer.predict(np.array([0]), times[:, None]),
        named("gmr"),
        faster=5.0,
    )


def _primitives() -> tuple[Trajectory, DMP]:
    """Return a motion whose exact positions are known, and our primitive of it."""
    shown = _minimum_jerk()
    return shown, DMP(n_basis=40).fit(shown)


def _movement_primitives_dmp(shown: Trajectory) -> Any:
    from movement_primitives import dmp

    peer = dmp.DMP(n_dims=3, execution_time=shown.duration, dt=0.01, n_weights_per_dim=40)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        peer.imitate(shown.times, shown.positions)
        peer.configure(start_y=shown.positions[0], goal_y=shown.positions[-1])
    return peer


def _all_steps(ours: DMP) -> None:
    state = ours.begin()
    for _ in range(200):
        state = ours.step(state, 0.01)


def steps_against_pydmps() -> Row:
    """A motion of 200 steps, one step at a time, 3 dimensions, 40 basis functions."""
    from pydmps.dmp_discrete import DMPs_discrete

    shown, ours = _primitives()
    peer = DMPs_discrete(n_dmps=3, n_bfs=40, dt=0.005)
    peer.imitate_path(shown.positions.T)

    def peer_steps() -> None:
        peer.reset_state()
        for _ in range(200):
            peer.step()

    name = "DMP, 200 times one step"
    return Row(name, lambda: _all_steps(ours), peer_steps, named("pydmps"), faster=3.0)


def steps_against_movement_primitives() -> Row:
    """The same against another peer."""
    shown, ours = _primitives()
    peer = _movement_primitives_dmp(shown)

    def peer_steps() -> None:
        peer.reset()
        y, yd = shown.positions[0], np.zeros(3)
        for _ in range(200):
            y, yd = peer.step(y, yd)

    name = "DMP, 200 times one step"
    return Row(name, lambda: _all_steps(ours), peer_steps, named("movement-primitives"), faster=7.0)


def rollout() -> Row:
    """A whole motion of 200 steps at once, and how far it is from the motion shown at the same instants."""
    shown, ours = _primitives()
    peer = _movement_primitives_dmp(shown)

    def peer_rollout() -> Array:
        peer.reset()
        return np.asarray(peer.open_loop()[1])

    def check() -> tuple[bool, str]:
        mine = 1e3 * np.abs(ours.generate().positions - shown.positions).max()
        theirs = 1e3 * np.abs(peer_rollout()[: len(shown)] - shown.positions).max()
        return bool(mine <= theirs), f"largest error: ours {mine:.4f} mm, theirs {theirs:.4f} mm"

    return Row(
        "DMP rollout of 200 steps",
        ours.generate,
        peer_rollout,
        named("movement-primitives"),
        faster=15.0,
        check=check,
    )


def _in_fresh_interpreter(code: str, *, one_thread: bool = True) -> float:
    """Run ``code`` in a new Python and return the number it prints."""
    environment = {k: v for k, v in os.environ.items() if k not in THREADS}
    if one_thread:
        environment |= dict.fromkeys(THREADS, "1")
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True, env=environment)
    return float(done.stdout)


def importing() -> Row:
    """``import imitarm`` against ``import numpy``, each in a fresh interpreter."""

    def timed(package: str) -> Callable[[], float]:
        code = f"import time; t = time.perf_counter(); import {package}; print(time.perf_counter() - t)"
        return lambda: _in_fresh_interpreter(code)

    return Row(
        "import imitarm",
        timed("imitarm"),
        timed("numpy"),
        f"import numpy {np.__version__}",
        cost=1.5,
        repeats=9,
        self_timed=True,
    )


def _avoidance(n_obstacles: int, cost: float) -> Row:
    """Certified ACFRA in 3-D over 40 seeded scenes of spheres and boxes, against a fit of scikit-learn."""
    skill, path = avoidance.learn(planar=False)
    cases = [
        families.sparse_clutter(seed, path, n_obstacles=n_obstacles, planar=False, kinds=families.SIMPLE)
        for seed in range(40)
    ]

    def outcomes() -> list[avoidance.Outcome]:
        return avoidance.run_family(skill, cases)

    def check() -> tuple[bool, str]:
        done = outcomes()
        kept = sum(o.accepted and o.kept for o in done)
        slow = 1e3 * np.percentile([o.seconds for o in done], 95)
        return kept == len(done), f"{kept} of {len(done)} keep 20 mm; 95th percentile {slow:.1f} ms"

    fit = sklearn_fit()
    return Row(
        f"certified ACFRA, 3-D, 200 samples, 8 components, {n_obstacles} obstacle{'s' * (n_obstacles > 1)}",
        lambda: float(np.median([o.seconds for o in outcomes()])),
        lambda: seconds_of(fit, 3),
        f"{named('scikit-learn')}, GMM fit 1600 x 4",
        cost=cost,
        check=check,
        repeats=11,
        self_timed=True,
    )


def avoidance_of_one() -> Row:
    """Certified ACFRA with one obstacle on the path."""
    return _avoidance(1, 0.1)


def avoidance_of_three() -> Row:
    """Certified ACFRA with three obstacles on the path."""
    return _avoidance(3, 0.3)


ROWS: tuple[Callable[[], Row], ...] = (
    gaussian_mixture,
    regression_with_covariance,
    regression_threads_as_installed,
    regression_mean_only,
    steps_against_pydmps,
    steps_against_movement_primitives,
    rollout,
    avoidance_of_one,
    avoidance_of_three,
    *arm_rows.ROWS,
    *ik_rows.ROWS,
    *rcamo_rows.ROWS,
    *retarget_rows.ROWS,
    *safety_rows.ROWS,
    *tracking_rows.ROWS,
    *transmission_rows.ROWS,
    importing,
)
