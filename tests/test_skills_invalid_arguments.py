"""Every public function of skills refuses invalid arguments with InputError, and returns no NaN."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from imitarm.errors import InputError
from imitarm.kinematics.pose import Pose
from imitarm.skills import (
    DMP,
    GMR,
    DMPState,
    Gains,
    GaussianMixture,
    QuaternionDMP,
    RhythmicDMP,
    Skill,
    ellipsoid_scale,
)
from imitarm.skills.rotations import RotationReference
from imitarm.trajectory import Demonstration, Trajectory
from skill_samples import shown

BAD: list[Any] = [
    float("nan"),
    float("inf"),
    -1.0,
    0,
    -3,
    2.5,
    10**400,
    1e300,
    True,
    1j,
    "abc",
    b"abc",
    [],
    ["a"],
    [1.0, None],
    [[1.0], [1.0, 2.0]],
    {},
    object(),
    np.array(np.nan),
    np.array([0.0, np.nan, 1.0]),
    np.full((3, 3), np.inf),
    np.zeros((0, 3)),
    np.zeros((2, 2, 2, 2)),
    np.ma.masked_array([1.0, 2.0, 3.0], mask=[0, 1, 0]),
    lambda *_: np.nan,
]
MOTIONS = shown(n=3)
MOTION = MOTIONS[0].trajectory
T = np.linspace(0.0, 2.0, 200)
CIRCLE = Trajectory(T, np.column_stack([np.cos(np.pi * T), np.sin(np.pi * T), 0.0 * T]))
POSE = Pose([0.1, 0.2, 0.3], [1.0, 0.0, 0.0, 0.0])
X = np.random.default_rng(0).standard_normal((50, 3))

SKILL = Skill(8).fit(MOTIONS)
GMR_, DMP_ = SKILL.gmr_, SKILL.dmp_
ROTATION = DMP_.orientation_
assert ROTATION is not None
MIXTURE = GaussianMixture(2).fit(X)
RHYTHM = RhythmicDMP().fit(CIRCLE)
STATE = DMP_.begin()
REFERENCE = RotationReference(np.zeros(1), np.array([[1.0, 0.0, 0.0, 0.0]]))
WXYZ = np.array([[1.0, 0.0, 0.0, 0.0]] * 2)

CALLS: dict[str, tuple[Callable[..., Any], dict[str, Any]]] = {
    "ellipsoid_scale": (ellipsoid_scale, {"probability": 0.9, "n_dims": 2}),
    "GaussianMixture": (
        GaussianMixture,
        {
            "n_components": 2,
            "reg_covar": 1e-6,
            "n_init": 1,
            "init": "time",
            "min_std": 0.0,
            "random_state": 0,
            "tol": 1e-4,
            "max_iter": 10,
        },
    ),
    "GaussianMixture.fit": (lambda X: GaussianMixture(2).fit(X).means_, {"X": X}),
    "GaussianMixture.score": (MIXTURE.score, {"X": X}),
    "GaussianMixture.score_samples": (MIXTURE.score_samples, {"X": X}),
    "GaussianMixture.predict_proba": (MIXTURE.predict_proba, {"X": X}),
    "GaussianMixture.predict": (MIXTURE.predict, {"X": X}),
    "GaussianMixture.bic": (MIXTURE.bic, {"X": X}),
    "GaussianMixture.aic": (MIXTURE.aic, {"X": X}),
    "GaussianMixture.sample": (MIXTURE.sample, {"n_samples": 3, "random_state": 0}),
    "GMR": (
        GMR,
        {
            "n_components": "auto",
            "candidates": (2, 3),
            "reg_covar": 1e-6,
            "n_init": 1,
            "min_std": (1e-4, 1e-3),
            "random_state": 0,
        },
    ),
    "GMR.fit": (lambda demonstrations: GMR(3).fit(demonstrations).means_, {"demonstrations": MOTIONS}),
    "GMR.from_mixture": (
        lambda **k: GMR.from_mixture(**k).predict(T)[0],
        {
            "weights": GMR_.weights_,
            "means": GMR_.means_,
            "covariances": GMR_.covariances_,
            "duration": 2.0,
            "n_demonstrations": 3,
            "reference": GMR_.reference_,
            "ends": GMR_.ends_,
            "degenerate_axes": (1,),
            "converged": True,
        },
    ),
    "GMR.predict": (GMR_.predict, {"times": T}),
    "GMR.predict_orientation": (GMR_.predict_orientation, {"times": T}),
    "GMR.predict_pose": (GMR_.predict_pose, {"times": T}),
    "GMR.nominal": (GMR_.nominal, {"times": T}),
    "GMR.responsibilities": (GMR_.responsibilities, {"times": T}),
    "GMR.trajectory": (GMR_.trajectory, {"n": 20}),
    "DMP": (DMP, {"gains": "critical", "n_basis": 5, "regularisation": 1e-7}),
    "DMP of Gains": (lambda K, D: DMP(Gains(K, D)), {"K": 100.0, "D": 20.0}),
    "DMP.fit": (lambda **k: DMP(n_basis=6).fit(**k).weights_, {"trajectory": MOTION, "exact_ends": False}),
    "DMP.from_weights": (
        lambda **k: DMP.from_weights(**k).generate().positions,
        {
            "weights": DMP_.weights_,
            "progress_weights": DMP_.progress_weights_,
            "gains": DMP_.gains_,
            "start": DMP_.start_,
            "goal": DMP_.goal_,
            "start_velocity": DMP_.start_velocity_,
            "duration": 2.0,
            "path_length": 1.0,
            "orientation": ROTATION,
        },
    ),
    "DMP.progress": (DMP_.progress, {"times": T}),
    "DMP.begin": (
        DMP_.begin,
        {"start": POSE, "goal": POSE, "duration": 2.0, "start_velocity": [0.0] * 3, "adjustment": "progress"},
    ),
    "DMP.step": (
        DMP_.step,
        {
            "state": STATE,
            "dt": 0.01,
            "goal": [0.1, 0.2, 0.3],
            "coupling": lambda x, v: np.zeros(3),
            "measured": [0.0, 0.0, 0.0],
            "patience": 0.01,
        },
    ),
    "DMP.generate": (
        DMP_.generate,
        {"start": POSE, "goal": POSE, "duration": 2.0, "dt": 0.1, "coupling": lambda x, v: np.zeros(6)},
    ),
    "QuaternionDMP": (QuaternionDMP, {"gains": "critical", "n_pieces": 5}),
    "QuaternionDMP.fit": (
        lambda **k: QuaternionDMP().fit(**k).coefficients_,
        {"trajectory": MOTION, "exact_ends": True},
    ),
    "QuaternionDMP.from_spline": (
        lambda **k: QuaternionDMP.from_spline(**k).start_,
        {"knots": ROTATION.knots_, "coefficients": ROTATION.coefficients_, "gains": "critical"},
    ),
    "QuaternionDMP.begin": (ROTATION.begin, {"start": WXYZ[0], "goal": WXYZ[0]}),
    "QuaternionDMP.target": (ROTATION.target, {"state": ROTATION.begin(), "fraction": T}),
    "QuaternionDMP.step": (
        ROTATION.step,
        {"state": ROTATION.begin(), "step": 0.01, "acceleration": [0.0, 0.0, 0.0]},
    ),
    "RhythmicDMP": (RhythmicDMP, {"gains": "critical", "n_basis": 10, "regularisation": 1e-7}),
    "RhythmicDMP.fit": (lambda **k: RhythmicDMP().fit(**k).weights_, {"trajectory": CIRCLE, "period": 2.0}),
    "RhythmicDMP.begin": (
        RHYTHM.begin,
        {"start": POSE, "center": [0.0, 0.0, 0.0], "amplitude": 1.0, "period": 2.0},
    ),
    "RhythmicDMP.step": (
        RHYTHM.step,
        {"state": RHYTHM.begin(), "dt": 0.01, "coupling": lambda x, v: np.zeros(3)},
    ),
    "RhythmicDMP.quaternion": (RHYTHM.quaternion, {"state": RHYTHM.begin()}),
    "RhythmicDMP.generate": (RHYTHM.generate, {"duration": 2.0, "dt": 0.1, "start": POSE, "amplitude": 1.0}),
    "RotationReference": (RotationReference, {"times": [0.0, 1.0], "quaternions": WXYZ}),
    "RotationReference.at": (REFERENCE.at, {"times": [0.0, 1.0]}),
    "RotationReference.to_vectors": (REFERENCE.to_vectors, {"times": [0.0, 1.0], "quaternions": WXYZ}),
    "RotationReference.to_quaternions": (REFERENCE.to_quaternions, {"times": [0.0, 1.0], "vectors": np.zeros((2, 3))}),
    "Skill": (Skill, {"n_components": 4, "gains": "critical", "n_basis": 10, "random_state": 0}),
    "Skill.fit": (
        lambda **k: Skill(8).fit(**k).gmr_.means_,
        {"demonstrations": MOTIONS, "notes": ["a"], "date": "2020-01-01"},
    ),
    "Skill.nominal": (SKILL.nominal, {"times": T, "start": POSE, "goal": POSE}),
    "Skill.generate": (
        SKILL.generate,
        {"start": POSE, "goal": POSE, "duration": 2.0, "dt": 0.1, "adjustment": "progress"},
    ),
    "Skill.tolerance": (SKILL.tolerance, {"times": T, "duration": 2.0}),
    "Skill.save": (SKILL.save, {"path": "/proc/nowhere/s.json"}),
    "Skill.load": (Skill.load, {"path": "/proc/nowhere/s.json"}),
    "Trajectory": (Trajectory, {"times": [0.0, 1.0], "positions": np.zeros((2, 3)), "quaternions": WXYZ}),
    "Trajectory.at": (MOTION.at, {"times": T}),
    "Trajectory.pose": (MOTION.pose, {"index": 3}),
    "Trajectory.resample": (MOTION.resample, {"n": 10}),
    "Demonstration": (
        Demonstration,
        {"trajectory": CIRCLE, "joints": np.zeros((200, 2)), "task": "a", "source": "b", "joint_names": ("c", "d")},
    ),
}


def no_nan(value: Any) -> bool:
    if isinstance(value, np.ndarray):
        return value.dtype.kind not in "fc" or not np.isnan(value).any()
    if isinstance(value, float):
        return not np.isnan(value)
    if isinstance(value, tuple | list):
        return all(no_nan(v) for v in value)
    if dataclasses.is_dataclass(value):
        return all(no_nan(getattr(value, f.name)) for f in dataclasses.fields(value))
    return True


@pytest.mark.parametrize("name", CALLS)
def test_valid_arguments_are_accepted(name: str) -> None:
    function, arguments = CALLS[name]
    if name in {"Skill.save", "Skill.load"}:
        return
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        assert no_nan(function(**arguments))


@pytest.mark.parametrize("name", CALLS)
def test_invalid_arguments_are_refused_with_input_error(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # the text "abc" is a good path to save to
    function, arguments = CALLS[name]
    for changed in arguments:
        for bad in BAD:
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                warnings.simplefilter("ignore", UserWarning)
                try:
                    result = function(**{**arguments, changed: bad})
                except InputError as error:
                    assert "\n" not in str(error)
                    continue
                except Exception as error:
                    pytest.fail(f"{name}({changed}={bad!r:.60}) raised {error!r:.200}")
            assert no_nan(result), f"{name}({changed}={bad!r:.60}) returned NaN"


def test_a_state_with_nan_is_refused_by_every_step() -> None:
    """It used to return a state of NaN."""
    nan = np.full_like(STATE.motion, np.nan)
    with pytest.raises(InputError, match="finite"):
        DMP_.step(STATE._replace(motion=nan), 0.01)
    state = RHYTHM.begin()
    with pytest.raises(InputError, match="finite"):
        RHYTHM.step(state._replace(motion=np.full_like(state.motion, np.nan)), 0.01)


def test_a_step_after_a_lag_of_kilometres_changes_nothing() -> None:
    state = DMP_.step(STATE, 0.01)
    after = DMP_.step(state, 0.01, measured=[1e300, 0.0, 0.0])
    np.testing.assert_allclose(after.motion, state.motion, rtol=0.0, atol=1e-12)


def test_before_fitting_every_use_is_refused() -> None:
    uses: list[Callable[[], Any]] = [
        lambda: DMP().begin(),
        lambda: DMP().step(STATE, 0.01),
        lambda: DMP().progress([0.0]),
        lambda: QuaternionDMP().begin(),
        lambda: QuaternionDMP().start_,
        lambda: RhythmicDMP().step(RHYTHM.begin(), 0.01),
        lambda: GMR().nominal([0.0]),
        lambda: GMR().trajectory(),
        lambda: Skill().nominal([0.0, 1.0]),
        lambda: Skill().tolerance([0.0]),
        lambda: GaussianMixture(2).bic(X),
    ]
    for use in uses:
        with pytest.raises(InputError, match=r"not (fitted|learned) yet"):
            use()
    assert isinstance(STATE, DMPState)
