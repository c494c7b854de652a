"""Learn the weights of the baseline ``gmm-irl``: ``python -m imitarm.benchmark.train_irl --output weights.json``.

The demonstrations are the best paths of the expert (:mod:`imitarm.policies.baselines.expert`) around one obstacle, half
of them in a plane and half in space, in scenes with the seeds of training. The result depends only on the arguments.
"""

from __future__ import annotations

import argparse
import json
import shlex
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from imitarm.benchmark.avoidance import learn
from imitarm.benchmark.families import CLEARANCE, TOOL_RADIUS, sparse_clutter
from imitarm.benchmark.provenance import code_version
from imitarm.policies.baselines.baseline_policy import ToolGaps
from imitarm.policies.baselines.expert import PathProblem, expert_paths
from imitarm.policies.baselines.gmm_irl import path_cost
from imitarm.policies.baselines.irl_learning import learn_weights
from imitarm.policies.baselines.path_cost import FEATURES, PathCost

Array = NDArray[np.float64]

_TOOL = [[0.0, 0.0, 0.0, TOOL_RADIUS]]


def demonstrations(n_scenes: int, first_seed: int = 0) -> Iterator[tuple[PathCost, Array]]:
    """Yield the path cost of each training scene, and the expert's deviation from the learned path.

    Args:
        n_scenes: number of scenes; every second one is planar.
        first_seed: seed of the first two scenes.
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
    """Learn the weights and write them with their origin."""
    parser = argparse.ArgumentParser(prog="python -m imitarm.benchmark.train_irl", description=__doc__)
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
