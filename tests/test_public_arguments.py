"""Every public callable: an argument that can't be used raises an ImitarmError, or leaves a finite answer.

For each name in ``imitarm.__all__`` there is one call that works. Each of its arguments is then replaced by values that
a mistake may produce. Nothing else than an ImitarmError may come of it: no other exception, no hang, no silent NaN.
"""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import imitarm
from imitarm import (
    DMP,
    ArmModel,
    ArmState,
    Command,
    Demonstration,
    ImitarmError,
    Observation,
    Pose,
    Scene,
    SimulatedRobot,
    Skill,
    Sphere,
    Trajectory,
    TwistTask,
)

NAN = float("nan")
NONSENSE: list[Any] = [
    None,
    NAN,
    float("inf"),
    -1.0,
    0,
    True,
    1j,
    "nonsense",
    b"\x00",
    object(),
    [],
    {},
    [NAN] * 3,
    [float("inf")] * 7,
    ["a", None],
    np.zeros(0),
    np.zeros((2, 3)),
    np.full((4, 3), NAN),
    np.full(6, NAN),
    np.full(7, 1e300),
    10**400,
    lambda: None,
    Path("no/such/file"),
]

Call = tuple[Callable[..., Any], dict[str, Any]]


def demonstrations(n: int = 3) -> list[Demonstration]:
    u = np.linspace(0.0, 1.0, 60)
    x, z = 0.4 + 0.2 * (10 * u**3 - 15 * u**4 + 6 * u**5), 0.3 + 0.03 * np.sin(3.0 * u)
    paths = [np.column_stack([x, 0.02 * i * np.sin(np.pi * u), z]) for i in range(n)]
    return [Demonstration(Trajectory(2.0 * u, path)) for path in paths]


@pytest.fixture(scope="module")
def calls(tmp_path_factory) -> dict[str, Call]:
    """One call that works for each public name, by keyword."""
    arm = ArmModel.load("panda", tool="gripper")
    still = ArmState(arm.home, np.zeros(7), np.zeros(7), 0.0)
    pose, n = arm.tool_pose(arm.home), arm.n_joints
    shown = demonstrations()
    skill = Skill(4).fit(shown)
    scene = Scene(None, [Sphere([0.5, 0.1, 0.3], 0.03)])
    folder = tmp_path_factory.mktemp("public")
    imitarm.save_scene(scene, folder / "scene.yaml")
    shown[0].save(folder / "one.csv")
    path = shown[0].trajectory
    identity = Pose([0.5, 0.0, 0.3], [1.0, 0.0, 0.0, 0.0])
    planned = imitarm.adapt(skill, Scene(), arm=arm)
    assert planned.joints is not None
    return {
        "ACFRA": (imitarm.ACFRA, {"skill": skill, "tool_radius": 0.01, "clearance": 0.02, "forbidden": ()}),
        "ArmModel": (ArmModel.load, {"name_or_path": "panda", "tool": "gripper", "flange": None}),
        "ArmState": (ArmState, {"q": arm.home, "velocity": np.zeros(n), "torque": np.zeros(n), "time": 0.0}),
        "Box": (imitarm.Box, {"pose": identity, "size": [0.1, 0.1, 0.1], "velocity": [0.0, 0.0, 0.0], "name": "a"}),
        "Capsule": (imitarm.Capsule, {"start": [0.0, 0, 0], "end": [0.1, 0, 0], "radius": 0.02}),
        "Command": (Command, {"twist": np.zeros(6), "joint_velocity": np.zeros(n), "posture": arm.home, "elbow": 0.1}),
        "Cone": (imitarm.Cone, {"pose": identity, "radius": 0.05, "height": 0.1}),
        "ConvexHull": (imitarm.ConvexHull, {"points": 0.1 * np.vstack([np.zeros(3), np.eye(3)])}),
        "Cylinder": (imitarm.Cylinder, {"pose": identity, "radius": 0.05, "length": 0.1}),
        "DMP": (lambda trajectory, gains: DMP(gains=gains).fit(trajectory), {"trajectory": path, "gains": "critical"}),
        "Demonstration": (Demonstration, {"trajectory": path, "joints": None, "task": "a", "source": "b"}),
        "ElbowTask": (
            lambda **task: imitarm.solve_ik(arm, arm.home, [TwistTask(np.zeros(6)), imitarm.ElbowTask(**task)]),
            {"angle": 0.1, "weight": 0.1, "confidence": 1.0, "gain": 5.0, "max_rate": 1.0},
        ),
        "Ellipsoid": (imitarm.Ellipsoid, {"pose": identity, "semi_axes": [0.1, 0.05, 0.03]}),
        "GMR": (
            lambda demonstrations, times: imitarm.GMR(4).fit(demonstrations).predict(times),
            {"demonstrations": shown, "times": np.linspace(0.0, 2.0, 5)},
        ),
        "GaussianMixture": (
            lambda X, n_components: imitarm.GaussianMixture(n_components).fit(X),
            {"X": np.random.default_rng(0).normal(size=(50, 2)), "n_components": 2},
        ),
        "HalfSpace": (imitarm.HalfSpace, {"point": [0.0, 0, 0], "normal": [0.0, 0, 1.0]}),
        "IKSolver": (imitarm.IKSolver, {"arm": arm, "limits": None, "dt": 0.01, "method": "qp"}),
        "JointLimits": (lambda q, velocity: imitarm.solve_ik(arm, q, TwistTask(np.zeros(6)), velocity=velocity), {
            "q": arm.home, "velocity": np.zeros(n)}),
        "JointVelocityTask": (
            lambda **task: imitarm.solve_ik(arm, arm.home, imitarm.JointVelocityTask(**task)),
            {"velocity": np.zeros(n), "weight": 1.0},
        ),
        "Observation": (Observation, {"time": 0.0, "state": still, "tool_to_base": pose, "scene": scene}),
        "Pose": (Pose, {"position": [0.0, 0, 0], "quaternion": [1.0, 0, 0, 0]}),
        "PostureTask": (
            lambda **task: imitarm.solve_ik(arm, arm.home, [TwistTask(np.zeros(6)), imitarm.PostureTask(**task)]),
            {"q": arm.home, "gain": 1.0, "weight": 1e-4},
        ),
        "SafetyFilter": (
            lambda dt, clearance, self_clearance, command, q, velocity, scene: imitarm.SafetyFilter(
                arm, dt=dt, clearance=clearance, self_clearance=self_clearance
            ).step(command, q, velocity, scene),
            {"dt": 0.01, "clearance": 0.02, "self_clearance": 0.01, "command": Command(np.zeros(6)), "q": arm.home,
             "velocity": np.zeros(n), "scene": scene},
        ),
        "Scene": (Scene, {"goal": identity, "obstacles": scene.obstacles, "stamp": 0.0}),
        "SimulatedRobot": (SimulatedRobot, {"arm": arm, "scene": scene, "control": "position", "q": arm.home}),
        "Skill": (lambda demonstrations, n: Skill(n).fit(demonstrations), {"demonstrations": shown, "n": 4}),
        "Sphere": (imitarm.Sphere, {"center": [0.0, 0, 0], "radius": 0.1, "velocity": [0.0, 0, 0], "name": ""}),
        "Trajectory": (Trajectory, {"times": path.times, "positions": path.positions, "quaternions": None}),
        "TwistTask": (
            lambda **task: imitarm.solve_ik(arm, arm.home, TwistTask(**task)),
            {"twist": np.zeros(6), "frame": "tool", "rotation_length": 0.3, "max_speed": 1.0},
        ),
        "adapt": (
            imitarm.adapt,
            {"skill": skill, "scene": scene, "tool_radius": 0.01, "clearance": 0.02, "method": "certified",
             "forbidden": (), "pinned": (), "start": None, "n_samples": 100},
        ),
        "align": (imitarm.align, {"demonstrations": shown}),
        "find_posture": (imitarm.find_posture, {"arm": arm, "pose": pose, "q0": arm.home, "restarts": 2}),
        "lint": (imitarm.lint, {"demonstrations": shown}),
        "load_scene": (imitarm.load_scene, {"path": folder / "scene.yaml"}),
        "read": (imitarm.read, {"paths": folder / "one.csv", "units": None, "duration": None, "rate": None}),
        "replan": (
            imitarm.replan,
            {"previous": planned, "scene": Scene(), "arm": arm,
             "state": ArmState(planned.joints[0], np.zeros(n), np.zeros(n), 0.0), "phase": 0.0, "clearance": 0.02,
             "forbidden": (), "max_tilt": None, "goal_tilt": 0.0, "allowance": 0.0},
        ),
        "reproduce": (
            lambda dt, timeout: imitarm.reproduce(
                imitarm.ACFRA(skill, tool_radius=0.01), SimulatedRobot(arm), lambda t: Scene(), dt=dt, timeout=timeout
            ),
            {"dt": 0.01, "timeout": 0.02},
        ),
        "save_scene": (imitarm.save_scene, {"scene": scene, "path": folder / "again.yaml"}),
        "singularity_limits": (imitarm.singularity_limits, {"arm": arm}),
        "solve_ik": (
            imitarm.solve_ik,
            {"arm": arm, "q": arm.home, "tasks": TwistTask(np.zeros(6)), "limits": None, "dt": 0.01, "method": "qp",
             "velocity": np.zeros(n), "rows": None},
        ),
    }  # fmt: skip


UNCALLED = {
    **dict.fromkeys(("HORIZONTAL_ONLY", "NOT_DOWN", "POLICIES", "RETARGETERS", "SOURCES"), "a constant"),
    **dict.fromkeys(("Obstacle", "Policy", "Retargeter", "Robot", "SkeletonSource", "Status"), "abstract, or an enum"),
    **dict.fromkeys(("Adaptation", "Finding", "Rollout"), "a result"),
    **dict.fromkeys(("Correspondence", "Skeleton", "plot"), "has tests of its own"),
}


def is_an_error(thing: object) -> bool:
    return inspect.isclass(thing) and issubclass(thing, Exception)


def test_every_public_name_is_tried_or_left_out_for_a_reason(calls):
    names = {name for name in imitarm.__all__ if not is_an_error(getattr(imitarm, name))}
    assert names - set(calls) <= set(UNCALLED)


def test_the_calls_work(calls):
    for name, (function, arguments) in calls.items():
        function(**arguments)
        assert name in imitarm.__all__


NAMES = sorted(name for name in imitarm.__all__ if name not in UNCALLED and not is_an_error(getattr(imitarm, name)))


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.filterwarnings("ignore")
def test_an_argument_that_can_not_be_used_is_refused_or_the_answer_is_finite(calls, name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # some names are those of files that can be written
    function, arguments = calls[name]
    faults = []
    for argument in arguments:
        for value in NONSENSE:
            try:
                answer = function(**{**arguments, argument: value})
            except ImitarmError:
                continue
            except Exception as error:
                faults.append(f"{argument}={str(value)[:30]!r}: {type(error).__name__}: {str(error)[:80]}")
                continue
            hidden = not_finite(answer)
            if hidden:
                faults.append(f"{argument}={str(value)[:30]!r}: accepted, {hidden} of the answer is not finite")
    assert not faults, f"{name}: " + "; ".join(faults)


def not_finite(answer: object, depth: int = 0) -> str:
    """Return where an answer holds NaN; empty when it does not."""
    if isinstance(answer, float | np.ndarray):
        values = np.asarray(answer)
        return "it" if values.dtype.kind == "f" and np.isnan(values).any() else ""
    if depth > 2:
        return ""
    parts: dict[str, object] = {}
    if dataclasses.is_dataclass(answer) and not isinstance(answer, type):
        parts = {f.name: getattr(answer, f.name, None) for f in dataclasses.fields(answer) if f.name not in ALLOWED}
    elif isinstance(answer, list | tuple):
        parts = {str(i): part for i, part in enumerate(answer)}
    return next((key for key, part in parts.items() if not_finite(part, depth + 1)), "")


ALLOWED = {"progress", "clearance", "torques", "torque"}
"""Fields in which NaN means "unknown"."""
