"""A simulated arm over a table, and simulated results, for the tests of the viewer."""

from __future__ import annotations

from dataclasses import dataclass, replace

import mujoco
import numpy as np

from imitarm.demonstrations import Finding, compute_alignment
from imitarm.kinematics.pose import Pose
from imitarm.scene import Box, Cylinder, Scene
from imitarm.trajectory import Demonstration, Rollout, Trajectory
from imitarm.viewer.content import LearningSummary, Report, SceneResult
from imitarm.viewer.recording import FrameRecorder, Recording

_LINKS = [  # axis, offset from the link before, capsule from the joint to the next
    ("0 0 1", "0 0 0.08", "0 0 0 0 0 0.24", 0.06, "0.66 0.13 0.16 1"),
    ("0 1 0", "0.08 0 0.24", "0 0 0 0.14 0 0.12", 0.055, "0.16 0.17 0.19 1"),
    ("1 0 0", "0.14 0 0.12", "0 0 0 0.2 0 0", 0.05, "0.66 0.13 0.16 1"),
    ("0 1 0", "0.22 0 0", "0 0 0 0.18 0 -0.12", 0.045, "0.16 0.17 0.19 1"),
    ("1 0 0", "0.18 0 -0.12", "0 0 0 0.16 0 0", 0.042, "0.66 0.13 0.16 1"),
    ("0 1 0", "0.16 0 0", "0 0 0 0.04 0 -0.1", 0.04, "0.16 0.17 0.19 1"),
    ("0 0 1", "0.04 0 -0.12", "0 0 0 0 0 -0.08", 0.035, "0.5 0.52 0.55 1"),
]


def world_xml(*, crumbs: int = 12) -> str:
    """MJCF of a seven-joint arm with a brush over a table, two obstacles, a pan and crumbs."""
    arm = ""
    for i, (axis, offset, segment, radius, rgba) in enumerate(_LINKS):
        arm += (
            f'<body name="link/{i}" pos="{offset}"><joint name="j{i}" axis="{axis}"/>'
            f'<geom type="capsule" fromto="{segment}" size="{radius}" rgba="{rgba}" group="2"/>'
            f'<geom type="sphere" size="{radius * 1.1}" rgba="0.2 0.21 0.23 1" group="2"/>'
            f'<geom type="capsule" fromto="{segment}" size="{radius * 1.3}" rgba="1 0 1 0.3" group="3"/>'
        )
    arm += '<body name="brush" pos="0 0 -0.1"><geom type="box" size="0.05 0.02 0.03" rgba="0.85 0.68 0.32 1"/></body>'
    arm += "</body>" * len(_LINKS)
    dirt = "".join(
        f'<body name="crumb{i}" pos="{0.45 + 0.02 * (i % 4)} {-0.3 + 0.02 * (i // 4)} 0.006"><freejoint/>'
        '<geom type="sphere" size="0.006" rgba="0.45 0.33 0.2 1"/></body>'
        for i in range(crumbs)
    )
    return f"""<mujoco><worldbody>
      <geom type="plane" size="0 0 1" pos="0 0 -0.75"/>
      <geom name="table" type="box" size="0.45 0.65 0.02" pos="0.6 0 -0.02" rgba="0.82 0.77 0.68 1"/>
      <geom type="box" size="0.1 0.1 0.37" pos="0 0 -0.38" rgba="0.35 0.37 0.4 1"/>
      <geom type="cylinder" size="0.09 0.04" pos="0 0 0.04" rgba="0.16 0.17 0.19 1"/>
      <geom type="box" size="0.08 0.1 0.004" pos="0.6 0.42 0.004" rgba="0.3 0.45 0.6 1"/>
      <body name="box" pos="0.55 -0.05 0.08"><geom type="box" size="0.05 0.04 0.08" rgba="0.49 0.42 0.38 1"/></body>
      <body name="cone" pos="0.62 0.2 0.06"><geom type="cylinder" size="0.04 0.06" rgba="0.9 0.5 0.2 1"/></body>
      {arm}{dirt}
    </worldbody></mujoco>"""


def make_recording(*, seconds: float = 4.0, rate: float = 25.0, crumbs: int = 12) -> Recording:
    """The simulated arm waving over its table; one crumb is pushed away."""
    model = mujoco.MjModel.from_xml_string(world_xml(crumbs=crumbs))
    data = mujoco.MjData(model)
    recorder = FrameRecorder(model, rate=rate)
    for time in np.arange(0.0, seconds + 1e-9, 0.01):
        phase = 2.0 * np.pi * time / max(seconds, 1e-9)
        data.qpos[:7] = [-0.5 * np.cos(phase), 0.25, 0.0, 0.35 + 0.1 * np.sin(phase), 0.0, -0.1, 0.0]
        if crumbs:
            data.qpos[8] = -0.3 + 0.05 * time
        mujoco.mj_kinematics(model, data)
        recorder.note(data, time)
    return recorder.recording()


@dataclass(frozen=True, eq=False)
class SampleAdaptation:
    """What the viewer asks of an adaptation."""

    nominal: Trajectory
    trajectory: Trajectory
    means: np.ndarray
    covariances: np.ndarray
    displacement: np.ndarray
    moved: np.ndarray
    tolerance: np.ndarray
    certified_clearance: float = 0.0201
    only_on_schedule: bool = False
    feasible: bool = True
    method: str = "certified"
    compute_time: float = 0.00134


@dataclass(frozen=True)
class SampleCandidate:
    """What the viewer asks of a number of components."""

    n_components: int
    bic: float
    aic: float
    held_out_rmse_mm: float


def make_path(n: int = 200, bump: float = 0.0) -> Trajectory:
    """A sweep along y at one height, with a bump of ``bump`` [m] in the middle."""
    u = np.linspace(0.0, 1.0, n)
    x = 0.55 + 0.04 * np.sin(3.0 * u) + bump * np.exp(-(((u - 0.45) / 0.13) ** 2))
    return Trajectory(4.0 * u, np.stack([x, -0.4 + 0.8 * u, np.full(n, 0.06)], axis=1))


def make_adaptation(bump: float = 0.12) -> SampleAdaptation:
    """Seven components on the simulated path; those in the middle are moved."""
    nominal, adapted = make_path(), make_path(bump=bump)
    at = np.linspace(12, 187, 7).astype(int)
    shift = adapted.positions[at] - nominal.positions[at]
    moved = np.linalg.norm(shift, axis=1) > 0.005
    spread = np.diag([2e-4, 1.4e-3, 1e-6])
    return SampleAdaptation(
        nominal,
        adapted,
        nominal.positions[at],
        np.repeat(spread[None], 7, axis=0),
        np.where(moved[:, None], shift, 0.0),
        moved,
        np.repeat(np.diag([6e-5, 6e-5, 1e-6])[None], len(nominal), axis=0),
    )


def make_rollout(path: Trajectory, *, clearance: float = 0.0213, n_joints: int = 7) -> Rollout:
    """A rollout that follows ``path`` and comes as near as ``clearance`` [m] to an obstacle."""
    n, t = len(path), path.times
    wave = np.sin(t[:, None] * (1.0 + 0.3 * np.arange(n_joints)))
    return Rollout(
        path,
        wave,
        np.gradient(wave, t, axis=0),
        np.array([12.0, 40.0, 15.0, 20.0, 3.0, 4.0, 1.0])[:n_joints] * wave,
        clearance + 0.3 * np.abs(np.linspace(-0.45, 0.55, n)),
        True,
    )


def make_scene() -> Scene:
    """The two obstacles of the simulated world."""
    upright = (1.0, 0.0, 0.0, 0.0)
    box = Box(Pose((0.55, -0.05, 0.08), upright), (0.1, 0.08, 0.16), name="box")
    return Scene(None, (box, Cylinder(Pose((0.62, 0.2, 0.06), upright), 0.04, 0.12, name="tin")))


def make_result(name: str = "two obstacles", *, recording: Recording | None = None, **changes: object) -> SceneResult:
    """One scene that went well."""
    adaptation = make_adaptation()
    values: dict[str, object] = {
        "name": name,
        "title": name.capitalize(),
        "scene": make_scene(),
        "success": True,
        "required_clearance": 0.02,
        "rollout": make_rollout(adaptation.trajectory),
        "adaptation": adaptation,
        "rmse": 0.0312,
        "tool_spheres": np.array([[0.0, 0.0, 0.0, 0.03], [0.02, 0.0, 0.05, 0.02]]),
        "recording": recording,
        "torque_limits": np.array([80.0, 80.0, 40.0, 40.0, 9.0, 9.0, 9.0]),
        "details": {"Crumbs in the pan": "6 of 6"},
    }
    return SceneResult(**(values | changes))  # type: ignore[arg-type]


def make_learning() -> LearningSummary:
    """Five demonstrations that differ a little."""
    adaptation, rng = make_adaptation(), np.random.default_rng(4)
    shown = []
    for i in range(5):
        wobble = rng.normal(0.0, 0.008) * np.sin(np.linspace(0.0, 3.0, 200) + rng.uniform(0.0, 3.0))
        positions = adaptation.nominal.positions + wobble[:, None] * [1.0, 0.3, 0.0]
        shown.append(Demonstration(Trajectory(adaptation.nominal.times, positions), source=f"sweep_{i}.csv"))
    tried = [SampleCandidate(k, 900.0 / k - 60.0 * k, 800.0 / k - 70.0 * k, 4.0 + 20.0 / k**2) for k in range(2, 13)]
    return LearningSummary(
        shown,
        adaptation.means,
        adaptation.covariances,
        adaptation.nominal,
        tried,
        [Finding("note", "idle", "the arm stands still for 0.31 s", "sweep_2.csv", 0, remedy="align cuts it off")],
        compute_alignment(shown, n=50),
    )


def make_report(*, recording: Recording | None = None, scenes: int = 2) -> Report:
    """A whole report with ``scenes`` scenes with obstacles and one without."""
    free = make_result(
        "free", title="No obstacle", scene=Scene(None, ()), adaptation=make_adaptation(0.0), recording=recording
    )
    free = replace(free, rollout=replace(free.rollout, clearance=np.full(200, np.inf)))
    results = [make_result(f"scene {i + 1}", recording=recording) for i in range(scenes)]
    return Report(
        "Sweeping, learnt from five demonstrations",
        [free, *results],
        "A simulated arm was shown how to sweep dirt into a dustpan, then did it around obstacles it had not seen.",
        make_learning(),
        {"Command": "imitarm demo --seed 0", "Seed": 0, "Platform": "Linux, 2 cores", "Versions": {"numpy": "2.4"}},
    )
