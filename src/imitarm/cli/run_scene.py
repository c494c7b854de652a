"""Reproduce a skill in one scene, and collect the content of the report."""

from __future__ import annotations

import platform
import shlex
import sys
from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version

import numpy as np
from numpy.typing import NDArray

from imitarm import __version__
from imitarm.cli.screen import remark, say, show_table
from imitarm.control_loop.reproduce import Step, reproduce
from imitarm.demonstrations import Alignment, Finding
from imitarm.errors import InfeasibleError
from imitarm.policies import Policy
from imitarm.robots import SimulatedRobot
from imitarm.safety import SafetyFilter
from imitarm.scene import Scene
from imitarm.skills import Skill
from imitarm.trajectory import Demonstration, Rollout, Trajectory
from imitarm.viewer import FrameRecorder, LearningSummary, Report, SceneResult
from imitarm.viewer.content import CERTIFICATE_VOID

Array = NDArray[np.float64]

CONTROL_PERIOD = 0.01  # [s]
TIMEOUT = 4.0  # a reproduction may take this many times as long as the demonstrations
_LIBRARIES = ("numpy", "scipy", "mujoco", "daqp", "pyyaml", "rich", "viser", "matplotlib", "jinja2")

Evaluate = Callable[[SimulatedRobot, Rollout], Rollout]


def run_scene(
    name: str,
    title: str,
    robot: SimulatedRobot,
    policy: Policy,
    *,
    clearance: float,
    link_clearance: float | None = None,
    tool_radius: float = 0.0,
    tool_spheres: Array | None = None,
    demonstrations: Sequence[Demonstration] = (),
    evaluate: Evaluate | None = None,
    observe: Callable[[float], Scene] | None = None,
    caption: str = "",
    progress: Callable[[float], None] | None = None,
) -> SceneResult:
    """Let a policy reproduce its skill on a simulated robot, and collect the result for the report.

    Args:
        name: short, unique name of the scene.
        title: title for tables and the report.
        robot: simulated robot at its start posture, with the obstacles of its scene.
        policy: policy that has not been reset yet.
        clearance: required clearance [m].
        link_clearance: required clearance of every link [m]; None: only the tool keeps a clearance.
        tool_radius: radius of the tool for drawing [m].
        tool_spheres: spheres of the tool for drawing, instead of ``tool_radius``: rows x, y, z, radius, shape (m,
            4) [m].
        demonstrations: aligned demonstrations; the measured motion is compared with them.
        evaluate: function that tests whether the task succeeded. It takes the robot and the rollout, and returns the
            rollout with ``success`` and ``reason``.
        observe: function that takes the time since the start [s] and returns the scene that the policy sees; None: the
            scene at the start, in which obstacles keep their velocities.
        caption: one sentence that describes the scene.
        progress: function called with the fraction of the motion that is done, 0 to 1.

    Returns:
        The result. If the policy refuses to move, the result has a reason but no rollout.
    """
    scene = robot.scene_at_start
    frames = FrameRecorder(robot.model)
    frames.note(robot.data)
    phases: list[float] = []

    def on_step(step: Step) -> None:
        frames.note(robot.data, scene=step.scene)
        done = step.command.progress
        phases.append(done * policy.skill.duration_)
        if progress is not None and np.isfinite(done):
            progress(done)

    rollout: Rollout | None = None
    try:
        done = reproduce(
            policy,
            robot,
            scene.at if observe is None else observe,
            dt=CONTROL_PERIOD,
            safety=SafetyFilter(robot.arm, dt=CONTROL_PERIOD, clearance=link_clearance),
            timeout=TIMEOUT * policy.skill.duration_,
            on_step=on_step,
        )
    except InfeasibleError as refusal:
        reason = str(refusal)
    else:
        rollout = done if evaluate is None else evaluate(robot, done)
        reason = rollout.reason
    return SceneResult(
        name=name,
        title=title,
        scene=scene,
        success=rollout is not None and rollout.success,
        required_clearance=clearance,
        rollout=rollout,
        adaptation=policy.plan,
        rmse=_distance_to(demonstrations, rollout, phases),
        reason=reason,
        tool_radius=tool_radius,
        tool_spheres=tool_spheres,
        recording=frames.recording(),
        torque_limits=robot.arm.max_torque,
        joint_names=tuple(robot.arm.joint_names),
        caption=caption,
        details=_details(rollout, policy),
        nominal=policy.skill.gmr_.trajectory(200),
    )


def _details(rollout: Rollout | None, policy: Policy) -> dict[str, object]:
    """Return further measured values for the table of results."""
    details: dict[str, object] = {}
    if rollout is not None and "swept_fraction" in rollout.details:
        details["dirt in the pan"] = f"{100 * rollout.details['swept_fraction']:.0f} %"
    if policy.plan is not None:
        details["largest displacement [σ]"] = f"{policy.plan.deviation:.1f}"
    return details


def _distance_to(demonstrations: Sequence[Demonstration], rollout: Rollout | None, phases: Sequence[float]) -> float:
    """Return the root mean square distance from the measured tool positions to all demonstrations [m].

    The formula is thesis Eq 4.9, with the square root that the printed equation lacks. Positions are compared at the
    same phase (completed fraction of the motion), not at the same time, so that waiting does not count as inaccuracy.
    """
    if rollout is None or not demonstrations or not phases:
        return float("nan")
    positions = rollout.trajectory.positions
    n = min(len(phases), len(positions) - 1)
    done, at = positions[1 : n + 1], np.asarray(phases[:n])
    if not np.isfinite(at).all():
        return float("nan")
    squares = [np.sum((done - one.trajectory.at(at)[0]) ** 2, axis=1).mean() for one in demonstrations]
    return float(np.sqrt(np.mean(squares)))


def learning_summary(
    skill: Skill, demonstrations: Sequence[Demonstration], findings: Sequence[Finding], alignment: Alignment | None
) -> LearningSummary:
    """Return the part of the report that describes how the skill was learned."""
    gmr = skill.gmr_
    predicted: Trajectory = gmr.trajectory(200)
    return LearningSummary(
        demonstrations=demonstrations,
        means=gmr.position_means_,
        covariances=gmr.position_covariances_,
        predicted=predicted,
        candidates=gmr.selection_,
        findings=findings,
        alignment=alignment,
    )


def provenance(**facts: object) -> Mapping[str, object]:
    """Return the facts that are needed to repeat a run: command, versions, platform, and the given ``facts``."""
    return {
        "command": shlex.join(["imitarm", *sys.argv[1:]]),
        **facts,
        "platform": f"{platform.system()} {platform.machine()}, Python {platform.python_version()}",
        "versions": {"imitarm": __version__, **{name: _version(name) for name in _LIBRARIES}},
    }


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"


def _certified(scene: SceneResult) -> str:
    """Return the certified clearance in mm, for the table."""
    assert scene.adaptation is not None
    return "void" if scene.certificate_void else f"{1e3 * scene.adaptation.certified_clearance:.1f}"


def show_results(report: Report) -> None:
    """Print a table with a row for each scene, and below the table the reasons why scenes failed."""
    rows, styles = [], []
    for scene in report.scenes:
        adaptation = scene.adaptation
        around = adaptation is not None and bool(scene.scene.obstacles)
        rows.append(
            (
                scene.title,
                "done" if scene.success else "FAILED",
                str(len(scene.scene.obstacles)),
                f"{1e3 * scene.min_clearance:.1f}" if np.isfinite(scene.min_clearance) else "-",
                _certified(scene) if around else "-",
                f"{1e3 * scene.rmse:.1f}" if np.isfinite(scene.rmse) else "-",
                f"{100 * scene.unmoved_fraction:.0f} %" if np.isfinite(scene.unmoved_fraction) else "-",
                f"{1e3 * adaptation.compute_time:.1f}" if adaptation else "-",
            )
        )
        styles.append("" if scene.success else "red")
    headings = ["scene", "", "obstacles>", "clearance>", "certified>", "RMSE>", "unmoved>", "adaptation>"]
    show_table(headings, rows, styles=styles)
    remark(
        "Clearance: smallest measured distance between the arm (with tool) and any obstacle [mm]. Certified: "
        "guaranteed lower bound of the clearance on the planned path [mm]; with --tool-only, the bound holds only for "
        "the tool. "
        "RMSE: root mean square distance to the demonstrations [mm]. Unmoved: fraction of the Gaussian components "
        "that were not moved. Adaptation: computing time [ms]."
    )
    if any(scene.certificate_void for scene in report.scenes):
        say(f"void: {CERTIFICATE_VOID}")
    for scene in report.scenes:
        if not scene.success:
            say(f"{scene.title}: {scene.reason}")
    say(report.verdict)
