r"""Learn the weights of the baseline ``gmm-irl``: ``python -m imitarm.benchmark.train_irl --output weights.json``.

The demonstrations are the best paths of the expert (:mod:`imitarm.policies.baselines.expert`) around one obstacle. Half
of the scenes are planar, and half are spatial. All scenes have seeds that are reserved for training. The same arguments
of the command always give the same weights.

Inverse reinforcement learning finds the weights of the path cost under which the demonstrated paths are most likely.
In the maximum-entropy model, a path ``X`` with the cost ``J_w(X)`` has the probability ``p(X) = exp(-J_w(X)) / Z_w``
(Ziebart et al. 2008). Laplace's approximation replaces the integral ``Z_w``. We apply it at ``X*``, the local minimum
of the cost that a search from the demonstration ``X_d`` finds. (Levine and Koltun 2012 apply it at ``X_d``.) Up to a
constant, the log-likelihood of the weights ``w`` is::

    L(w) = sum_d [J_w(X*) - J_w(X_d) + 1/2 log det H_w(X*)],     H_w = Hessian of J_w

The derivative of ``L`` is the difference between expected and demonstrated features. ``H_k`` is the Hessian of feature
``phi_k``::

    dL/dw_k = sum_d [E phi_k - phi_k(X_d)],     E phi_k = phi_k(X*) + 1/2 tr(H_w^-1 H_k)

We learn the logarithms of the weights, so the weights stay positive. The method is Fisher scoring: the covariance of
the features approximates the second derivative of ``L``, with ``Cov(phi_k, phi_l) = grad phi_k^T H^-1 grad phi_l + 1/2
tr(H^-1 H_k H^-1 H_l)``. A normal prior on the logarithms keeps every weight finite, even if the demonstrations do not
determine this weight.
"""

from __future__ import annotations

import argparse
import json
import shlex
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_solve_banded, cholesky_banded

from imitarm.benchmark.avoidance import learn
from imitarm.benchmark.families import CLEARANCE, TOOL_RADIUS, sparse_clutter
from imitarm.benchmark.provenance import code_version
from imitarm.errors import InputError
from imitarm.policies.baselines.baseline_policy import ToolGaps
from imitarm.policies.baselines.expert import PathProblem, expert_paths
from imitarm.policies.baselines.gmm_irl import path_cost
from imitarm.policies.baselines.path_cost import FEATURES, PathCost

Array = NDArray[np.float64]

_TOOL = [[0.0, 0.0, 0.0, TOOL_RADIUS]]
_FIRST_STEP = 1.0  # largest change of the logarithm of a weight in one iteration
_GROWTH, _SHRINKAGE = 1.2, 0.4  # of this limit, if the change keeps or reverses its direction
_SETTLED = 1e-2  # gain of log-likelihood that one more step promises, per demonstration: less ends the learning
_SHIFTS = (0.0, *np.logspace(-10, 0, 11))  # of an indefinite Hessian, relative to its largest entry


class Expectation(NamedTuple):
    """Mean and covariance of the features of a path in one scene, according to the maximum-entropy model.

    Attributes:
        minimum: deviation from the learned path at which the cost has a local minimum, shape (94, k) [m]. There are 94
            free samples of the path and k permitted directions.
        mean: expected value of each of the m features, shape (m,).
        covariance: covariance of the features, shape (m, m).
    """

    minimum: Array
    mean: Array
    covariance: Array


class Learned(NamedTuple):
    """The result of learning.

    Attributes:
        weights: learned weights w of the m features, shape (m,).
        demonstrated: mean features of the demonstrations, shape (m,).
        expected: mean expected features with the learned weights, shape (m,).
        n_iterations: number of iterations that were needed.
    """

    weights: Array
    demonstrated: Array
    expected: Array
    n_iterations: int


def inverse_hessian(cost: PathCost, weights: Array, blocks: Array) -> Array:
    """Return the inverse of the Hessian of the cost, shape (94 k, 94 k).

    An indefinite Hessian is made positive definite first.
    """
    band = cost.hessian(weights, blocks)
    for shift in _SHIFTS:
        shifted = band.copy()
        shifted[-1] += shift * band[-1].max()
        try:
            factor = cholesky_banded(shifted)
        except LinAlgError:
            continue
        return np.asarray(cho_solve_banded((factor, False), np.eye(band.shape[1])))
    raise InputError("train_irl: the Hessian of the path cost is not finite; check the learned path and the obstacle")


def expectation(cost: PathCost, weights: Array, start: Array) -> Expectation:
    """Search for a minimum of the cost from ``start``, shape (94, k); return the expected features there."""
    minimum = cost.minimised(weights, start)
    blocks = cost.blocks(minimum)
    inverse = inverse_hessian(cost, weights, blocks)
    n, k = minimum.shape
    scaled = [_times_blocks(inverse, part) for part in blocks]
    scaled[1] = _times_smoothness(inverse, 2.0 * cost.smoothness, k)
    traces = np.array([np.trace(part) for part in scaled])
    flat = np.stack([part.ravel() for part in scaled])
    crossed = np.stack([part.T.ravel() for part in scaled])
    slopes = cost.gradients(minimum).reshape(-1, n * k)
    covariance = slopes @ inverse @ slopes.T + 0.5 * flat @ crossed.T
    return Expectation(minimum, cost.features(minimum) + 0.5 * traces, covariance)


def _times_blocks(matrix: Array, blocks: Array) -> Array:
    """Return ``matrix @ B`` for the block-diagonal matrix B of blocks (n, k, k)."""
    n, k, _ = blocks.shape
    return np.asarray(np.einsum("rij,ijl->ril", matrix.reshape(-1, n, k), blocks).reshape(matrix.shape))


def _times_smoothness(matrix: Array, smoothness: Array, k: int) -> Array:
    """Return ``matrix @ kron(smoothness, I)``, with the identity of size k."""
    parts = matrix.reshape(len(matrix), -1, k)
    return np.asarray(np.moveaxis(np.moveaxis(parts, 1, 2) @ smoothness, 1, 2).reshape(matrix.shape))


def first_weights(costs: Sequence[PathCost], demonstrated: Array) -> Array:
    """Return initial weights, with which all features contribute equally to the cost of the demonstrations.

    The cost is then half the number of free coordinates.
    """
    freedom = np.mean([cost.precisions.shape[0] * cost.precisions.shape[1] for cost in costs])
    part = 0.5 * float(freedom) / len(FEATURES)
    return np.asarray(part / np.where(demonstrated > 1e-6, demonstrated, part))


def learn_weights(
    costs: Sequence[PathCost],
    demonstrations: Sequence[Array],
    *,
    prior: float = 3.0,
    iterations: int = 40,
    on_iteration: Callable[[int, Array], None] | None = None,
) -> Learned:
    """Learn the weights of the features from demonstrations.

    Args:
        costs: for each demonstration, the path cost of its scene.
        demonstrations: for each demonstration, its deviation from the learned path, shape (94, k) [m].
        prior: standard deviation of the normal prior on the logarithm of each weight. The mean of the prior is the
            logarithm of the initial weight.
        iterations: largest number of iterations.
        on_iteration: function that is called after each iteration, with its number and the weights.
    """
    shown = np.mean([cost.features(d) for cost, d in zip(costs, demonstrations, strict=True)], axis=0)
    first = np.log(first_weights(costs, shown))
    logarithm, minima = first.copy(), list(demonstrations)
    expected, iteration = shown, 0
    limit, before = np.full(len(first), _FIRST_STEP), np.zeros(len(first))
    for iteration in range(1, iterations + 1):
        w = np.exp(logarithm)
        found = [expectation(cost, w, start) for cost, start in zip(costs, minima, strict=True)]
        expected = np.mean([part.mean for part in found], axis=0)
        slope = len(costs) * w * (expected - shown) - (logarithm - first) / prior**2
        information = np.sum([part.covariance for part in found], axis=0) * np.outer(w, w)
        step = np.linalg.solve(information + np.eye(len(w)) / prior**2, slope)
        limit = limit * np.where(step * before < 0.0, _SHRINKAGE, _GROWTH)
        before = np.clip(step, -limit, limit)
        logarithm = logarithm + before
        if on_iteration is not None:
            on_iteration(iteration, np.exp(logarithm))
        if 0.5 * slope @ step < _SETTLED * len(costs):
            break
    return Learned(np.exp(logarithm), shown, expected, iteration)


def demonstrations(n_scenes: int, first_seed: int = 0) -> Iterator[tuple[PathCost, Array]]:
    """Yield the path cost of each training scene, and the deviation of the expert's best path from the learned path.

    Args:
        n_scenes: number of scenes. Every second scene is planar.
        first_seed: seed of the first two scenes (one planar, one spatial).
    """
    skills = {planar: learn(planar=planar) for planar in (True, False)}
    for i in range(n_scenes):
        planar, seed = i % 2 == 0, first_seed + i // 2
        skill, path = skills[planar]
        case = sparse_clutter(seed, path, n_obstacles=1, planar=planar)
        nominal, gaps = skill.gmr_.trajectory(200), ToolGaps(case.scene, _TOOL)
        paths = expert_paths(nominal, gaps, clearance=CLEARANCE, forbidden=case.forbidden)
        if paths:
            forbidden = np.reshape(np.asarray(case.forbidden, dtype=float), (-1, 3))
            cost = path_cost(PathProblem.of(nominal, gaps, CLEARANCE, forbidden), skill)
            yield cost, cost.deviation(paths[0])


def main(arguments: Sequence[str] | None = None) -> None:
    """Learn the weights, and write them to a file together with the command and the version of the code."""
    parser = argparse.ArgumentParser(prog="python -m imitarm.benchmark.train_irl", description=__doc__.split("\n\n")[0])
    parser.add_argument("--scenes", type=int, default=200, help="number of training scenes (default: 200)")
    parser.add_argument("--first-seed", type=int, default=0, help="seed of the first scene (default: 0)")
    parser.add_argument("--iterations", type=int, default=60, help="largest number of iterations (default: 60)")
    parser.add_argument("--output", type=Path, required=True, help="JSON file to write")
    options = parser.parse_args(arguments)
    started, code = time.process_time(), code_version()
    costs, shown = zip(*demonstrations(options.scenes, options.first_seed), strict=True)
    expert_seconds = time.process_time() - started

    def report(iteration: int, weights: Array) -> None:
        print(iteration, *(f"{w:.4g}" for w in weights), flush=True)  # noqa: T201

    learned = learn_weights(costs, shown, iterations=options.iterations, on_iteration=report)
    words = sys.argv[1:] if arguments is None else arguments
    document = {
        "weights": _by_feature(learned.weights),
        "mean features of the expert's paths": _by_feature(learned.demonstrated),
        "expected features under the weights": _by_feature(learned.expected),
        "demonstrations": len(costs),
        "iterations": learned.n_iterations,
        "command": shlex.join(["python", "-m", "imitarm.benchmark.train_irl", *words]),
        "code": code,
        "CPU time of the expert [s]": round(expert_seconds, 1),
        "CPU time of learning [s]": round(time.process_time() - started - expert_seconds, 1),
    }
    options.output.write_text(json.dumps(document, indent=2) + "\n", encoding="utf-8")


def _by_feature(values: Array) -> dict[str, float]:
    return {name: float(f"{value:.6g}") for name, value in zip(FEATURES, values, strict=True)}


if __name__ == "__main__":
    main()
