"""Tune the options of the methods of the static benchmark by a random search, in scenes that are not used for testing.

The ``search_space`` of a method lists its options and their ranges. A draw contains a random value of each option,
uniform in its logarithm. The best draw has the highest rate of success in the validation scenes. If several draws have
this rate, the best draw has the smallest mean RMSE of its successes.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from imitarm.benchmark.experiment import plain, write_text
from imitarm.benchmark.provenance import code_version
from imitarm.benchmark.running import OnDone, Store, Workers, run_experiments
from imitarm.benchmark.static import Options, StaticExperiment, StaticResult, policy_class, run_experiment
from imitarm.benchmark.static_measures import SUCCESSES
from imitarm.errors import FileFormatError, InputError

FORMAT = "imitarm-tuned-static 1"
DRAWS = 64
_SHIPPED = "tuned_static.json"


@dataclass(frozen=True)
class Search:
    """The definition of a random search.

    Attributes:
        scenes: validation scenes in which each draw is tried, each as family, dimension and seed.
        draws: number of draws for each method. The first draw has the default options.
        seed: seed of the draws.

    Raises:
        InputError: when there is no scene or no draw.
    """

    scenes: tuple[tuple[str, int, int], ...]
    draws: int = DRAWS
    seed: int = 0

    def __post_init__(self) -> None:
        if not self.scenes or self.draws < 1:
            raise InputError("tuning needs at least one scene and one draw")

    def options(self, method: str) -> list[Options]:
        """Return the options of each draw of a method. If the search space is empty, there is only the default draw."""
        space = policy_class(method).search_space
        rng = np.random.default_rng([self.seed, *method.encode()])
        drawn: list[Options] = [()]
        for _ in range(self.draws - 1 if space else 0):
            chosen = {
                name: float(f"{np.exp(rng.uniform(math.log(low), math.log(high))):.4g}")
                for name, (low, high) in sorted(space.items())
            }
            drawn.append(tuple(sorted(chosen.items())))
        return drawn


@dataclass(frozen=True)
class Draw:
    """The score of one draw.

    Attributes:
        method: name of the method.
        number: number of the draw. Draw 0 has the default options.
        options: the options of the method that this draw tries.
        success: rate of success in the validation scenes, from 0 to 1.
        rmse: mean RMSE of the successes [m]; nan if there is no success.
    """

    method: str
    number: int
    options: Options
    success: float
    rmse: float

    @property
    def order(self) -> tuple[float, float]:
        """Sort key of a draw. The best draw has the smallest key."""
        return -self.success, self.rmse if math.isfinite(self.rmse) else math.inf


def score(method: str, number: int, options: Options, results: Sequence[StaticResult]) -> Draw:
    """Return the score of one draw, computed from its results in all validation scenes."""
    good = [r.value("rmse") for r in results if r.outcome in SUCCESSES]
    return Draw(method, number, options, len(good) / len(results), float(np.mean(good)) if good else math.nan)


def tune(
    methods: Sequence[str],
    search: Search,
    store: Store[StaticExperiment, StaticResult],
    workers: Workers | None = None,
    *,
    log: Path | None = None,
    on_done: OnDone | None = None,
) -> dict[str, Draw]:
    """Search for the best options of each method, and return the best draw of each method.

    Args:
        methods: names of the methods.
        search: the scenes, the number of draws and the seed of the search.
        store: store that saves the results, so that an interrupted search can be continued.
        workers: the processes that run the experiments.
        log: file to which each draw is written as a line of JSON; None: no file.
        on_done: function that is called with the progress after each experiment.
    """
    drawn = [(method, i, options) for method in methods for i, options in enumerate(search.options(method))]
    experiments = [
        StaticExperiment(*scene, method=method, options=options)
        for method, _, options in drawn
        for scene in search.scenes
    ]
    results = run_experiments(experiments, run_experiment, store, workers, on_done=on_done)
    n, scored = len(search.scenes), []
    for k, (method, i, options) in enumerate(drawn):
        scored.append(score(method, i, options, results[k * n : (k + 1) * n]))
    if log is not None:
        write_text(log, "".join(json.dumps(plain(asdict(draw)), allow_nan=False) + "\n" for draw in scored))
    return {method: min((d for d in scored if d.method == method), key=lambda d: d.order) for method in methods}


def write_tuned(best: dict[str, Draw], search: Search, path: Path) -> None:
    """Write the best options of each method to a file. Options of other methods in the file stay unchanged."""
    try:
        known = _read(path.read_text(encoding="utf-8"), str(path))["methods"] if path.exists() else {}
    except OSError as error:
        raise InputError(f"{path}: can't be read ({error.strerror})") from error
    seeds = [scene[2] for scene in search.scenes]
    facts = {
        "code": code_version(),
        "draws": search.draws,
        "seed": search.seed,
        "families": sorted({f"{family} {dimension}-D" for family, dimension, _ in search.scenes}),
        "scenes": len(search.scenes),
        "seeds": [min(seeds), max(seeds)],
    }
    for method, draw in best.items():
        known[method] = {"options": dict(draw.options), "success": draw.success, "rmse": draw.rmse, "search": facts}
    content = {"format": FORMAT, "methods": plain(dict(sorted(known.items())))}
    write_text(path, json.dumps(content, indent=1, allow_nan=False) + "\n")


@lru_cache(maxsize=1)
def _shipped() -> dict[str, Options]:
    place = resources.files("imitarm.benchmark") / _SHIPPED
    content = _read(place.read_text(encoding="utf-8"), _SHIPPED)
    return {name: tuple(sorted(facts["options"].items())) for name, facts in content["methods"].items()}


def tuned_options(method: str) -> Options:
    """Return the tuned options of a method from the package; empty if the default options are the best."""
    return _shipped().get(method, ())


def _read(text: str, name: str) -> dict[str, Any]:
    try:
        content: dict[str, Any] = json.loads(text)
        if content["format"] != FORMAT:
            raise ValueError(f"format {content['format']!r} instead of {FORMAT!r}")
    except (ValueError, KeyError, TypeError) as error:
        raise FileFormatError(f"{name}: can't be read as tuned options ({error}); delete it and tune again") from error
    return content
