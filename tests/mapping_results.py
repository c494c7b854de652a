"""Synthetic results of the mapping benchmark, for tests of what is told of them."""

from __future__ import annotations

import numpy as np

from imitarm.benchmark.experiment import LIVE, Experiment, Result
from imitarm.benchmark.mapping_tables import TEST
from imitarm.benchmark.recordings import CAPTURED

ME = ("thesis", "modern")


def live(method, person, repeat, success=True, time=40.0):
    """A synthetic result of a closed-loop trial."""
    values = {
        **{"success": success, "failure": "" if success else "dropped", "time": time, "path_length": 5.0},
        **{"mean_torque": [1.0] * 7},
    }
    return Result(Experiment(LIVE, method, seed=person, repeat=repeat), "0", values, "", 1.0)


def replay(method, person, torque, path=3.0, singular=0.05, kind="stacking"):
    """A synthetic result of a recording that was replayed."""
    values = {
        **{"mean_torque": [torque] * 7, "path_length": path, "least_singular": singular, "engaged_fraction": 1.0},
        **{f"{kind_}_violations": 0 for kind_ in ("position", "velocity", "acceleration")},
        "failures": 0,
    }
    return Result(Experiment(kind, method, seed=person), "0", values, "", 1.0)


def world(mine, theirs, persons=8):
    """Results in which Me has one torque and all baselines another, persons differing more than methods."""
    rng = np.random.default_rng(0)
    found = []
    for person in range(persons):
        own = rng.uniform(5.0, 15.0)
        found += [replay(me, person, own + mine) for me in ME]
        found += [replay(baseline, person, own + theirs) for baseline in ("m1", "m2", "m3")]
    return found


def captured(method, camera, lag, seed=TEST):
    """A synthetic result of the captured arm before a camera."""
    values = {"lag": lag, "engaged_fraction": 1.0, "recorded": 43.0, "beyond_reach": 0.0}
    values |= {f"{kind}_violations": 0 for kind in ("position", "velocity", "acceleration")} | {"failures": 0}
    return Result(Experiment(CAPTURED, method, seed=seed, repeat=camera, data="x"), "0", values, "", 1.0)
