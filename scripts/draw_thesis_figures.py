"""Draw what thesis Figs 4.2 to 4.8, 5.2 to 5.4 and 5.9 show, with this library, for the pages in docs/.

    MUJOCO_GL=egl python scripts/draw_thesis_figures.py docs/images

Nothing in the figures is drawn by hand: skills are learned, paths are adapted and sweeps are simulated. Figs 4.7,
4.8 and 5.4 show the simulated arm, so the simulator must be able to render without a window.
"""

from __future__ import annotations

import argparse
import io
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
import mujoco
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from imitarm.benchmark.tracked_motions import PERIOD, RecordedMotion
from imitarm.benchmark.tracking import follow
from imitarm.benchmark.tracking_report import draw_positions
from imitarm.control_loop import reproduce
from imitarm.control_loop.observer import SensorModel
from imitarm.control_loop.reproduce import Step
from imitarm.demonstrations import align, read
from imitarm.errors import InputError
from imitarm.kinematics.pose import Pose, quaternion_exp
from imitarm.perception import ObstacleTracker
from imitarm.policies import ACFRA, HORIZONTAL_ONLY, adapt
from imitarm.policies.adapted_path import Adaptation
from imitarm.policies.baselines.potential_components import INFLUENCE_DISTANCE, component_distances
from imitarm.policies.component_path import ComponentPath
from imitarm.robots import SimulatedRobot
from imitarm.safety import SafetyFilter
from imitarm.scene import Box, HalfSpace, MovingScene, Scene, Sphere, Track
from imitarm.skills import Skill
from imitarm.tasks import DEMONSTRATIONS, OpenBoxTask, SweepTask
from imitarm.tasks.habits import demonstrations_by, s_shaped_reach
from imitarm.trajectory import Demonstration, Rollout
from imitarm.viewer import palette
from imitarm.viewer.maps import Grid, View, draw_components, draw_ellipses, draw_obstacles
from rcamo_figures import figure_5_2, figure_5_3
from take_picture import small_enough

Array = NDArray[np.float64]

_STYLE = {
    "font.size": 8.0,
    "axes.titlesize": 8.5,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
    "legend.fontsize": 7.5,
}
_CLEARANCE = 0.02  # [m]
_TOOL_RADIUS = 0.02  # [m] of the reach in Fig 4.3
_PIXELS = (640, 480)
_DPI = 110
_MAX_BYTES = 60_000  # of a picture
_PANELS = "abcd"


def main(arguments: list[str] | None = None) -> None:
    """Draw the figures into a folder."""
    parser = argparse.ArgumentParser(prog="python scripts/draw_thesis_figures.py", description=main.__doc__)
    parser.add_argument("folder", type=Path, help="folder of the pictures")
    parser.add_argument("--only", nargs="+", choices=FIGURES, metavar="NUMBER", help="figures to draw; default: all")
    given = parser.parse_args(arguments)
    if not given.folder.is_dir():
        raise InputError(f"{given.folder}: is not a folder; create it first")
    with mpl.rc_context(_STYLE), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a planar motion has no spread in z, on purpose
        for number in given.only or FIGURES:
            target = given.folder / f"figure_{number.replace('.', '_')}.png"
            drawn = io.BytesIO()
            FIGURES[number]().savefig(drawn, dpi=_DPI, metadata={"Software": None})
            target.write_bytes(small_enough(drawn.getvalue(), _MAX_BYTES))
            print(f"wrote {target}")


class Sweep(NamedTuple):
    """A simulated sweep: the plan, what was measured, and pictures of the arm at the start and at the end."""

    adaptation: Adaptation
    rollout: Rollout
    scene: Scene
    crumbs: Array  # (2, n, 2) [m] at the start and at the end
    pictures: Sequence[NDArray[np.uint8]]


def swept(name: str, *, render: bool) -> Sweep:
    """Learn from the packaged demonstrations, and sweep in the scene ``name`` with the simulated arm."""
    task, skill = SweepTask(), Skill().fit(align(read(DEMONSTRATIONS)))
    scene, arm = task.scene(name), task.arm()
    robot = task.robot(scene, arm=arm)
    policy = ACFRA(
        skill,
        arm=arm,
        clearance=task.clearance,
        forbidden=HORIZONTAL_ONLY,
        pinned=[task.dirt_time(skill.gmr_.trajectory(1000))],
    )
    before = crumbs_of(robot, task)
    pictures = [picture(robot, [])] if render else []
    safety = SafetyFilter(arm, clearance=task.clearance)
    rollout = task.evaluate(robot, reproduce(policy, robot, scene.at, safety=safety, timeout=60.0))
    assert policy.adaptation is not None
    if render:
        paths = [
            (policy.adaptation.nominal.positions, palette.NOMINAL),
            (rollout.trajectory.positions, palette.MEASURED),
        ]
        pictures.append(picture(robot, paths))
    return Sweep(policy.adaptation, rollout, scene, np.stack([before, crumbs_of(robot, task)]), pictures)


def crumbs_of(robot: SimulatedRobot, task: SweepTask) -> Array:
    """Return the horizontal positions of the crumbs, shape (n, 2) [m]."""
    return np.array([robot.data.body(f"crumb/{i}").xpos[:2] for i in range(task.n_crumbs)])


def picture(
    robot: SimulatedRobot, paths: Sequence[tuple[Array, str]], look: tuple[float, float] = (215.0, -38.0)
) -> NDArray[np.uint8]:
    """Return a picture of the simulated world, with paths (n, 3) [m] drawn as beads of a colour.

    Args:
        robot: the simulated robot.
        paths: paths and their colours.
        look: azimuth and elevation of the line of sight [degrees].
    """
    camera = mujoco.MjvCamera()
    camera.lookat, camera.distance = [0.55, -0.02, 0.10], 1.75
    camera.azimuth, camera.elevation = look
    with mujoco.Renderer(robot.model, _PIXELS[1], _PIXELS[0]) as renderer:
        renderer.update_scene(robot.data, camera)
        for positions, colour in paths:
            along = np.linspace(0, len(positions) - 1, 90).astype(int)
            for point in positions[along] + [0.0, 0.0, 0.006]:
                geom = renderer.scene.geoms[renderer.scene.ngeom]
                rgba = np.array([*(c / 255.0 for c in palette.rgb(colour)), 1.0])
                size, sphere = np.array([0.004, 0.0, 0.0]), mujoco.mjtGeom.mjGEOM_SPHERE
                mujoco.mjv_initGeom(geom, sphere, size, point, np.eye(3).ravel(), rgba.astype(np.float32))
                renderer.scene.ngeom += 1
        return np.asarray(renderer.render())


def framed(axes: Any, view: View, points: Array, margin: float) -> None:
    """Show the area around ``points`` (n, 3) [m], with the same scale on both axes."""
    shown = view.of(points)
    low, high = shown.min(axis=0) - margin, shown.max(axis=0) + margin
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_aspect("equal")
    if view.leftwards:
        axes.invert_xaxis()
    axes.set_xlabel(f"{'xyz'[view.across]} [m]")
    axes.set_ylabel(f"{'xyz'[view.up]} [m]")


def draw_demonstrations(axes: Any, view: View, shown: Sequence[Demonstration]) -> None:
    """Draw the paths of demonstrations."""
    for i, demonstration in enumerate(shown):
        label = "demonstrations" if i == 0 else None
        axes.plot(*view.of(demonstration.trajectory.positions).T, color=palette.DEMONSTRATION, lw=0.6, label=label)


def figure_4_2() -> Figure:
    """Gaussian components of four motions."""
    motions = (
        ("S-shaped reach, one teacher", demonstrations_by(s_shaped_reach(planar=True), 1)),
        ("S-shaped reach, ten teachers", demonstrations_by(s_shaped_reach(planar=True), 10)),
        ("sweep, guided by hand", read(DEMONSTRATIONS)),
        ("reach into an open box", demonstrations_by(OpenBoxTask.motion(), 3)),
    )
    figure = Figure(figsize=(8.0, 5.6), layout="constrained")
    for letter, axes, (title, shown) in zip(_PANELS, figure.subplots(2, 2).flat, motions, strict=True):
        aligned = align(shown)
        gmr = Skill(8).fit(aligned).gmr_
        positions = np.concatenate([d.trajectory.positions for d in aligned])
        view = View(1, 2) if "box" in title else View(1, 0) if "sweep" in title else View(0, 1)
        framed(axes, view, positions, 0.04)
        if "sweep" in title:
            axes.set_aspect("auto")  # a long and narrow motion
        draw_demonstrations(axes, view, aligned)
        means, covariances = gmr.position_means_, gmr.position_covariances_
        draw_ellipses(axes, means, covariances, view, color=palette.UNMOVED, alpha=0.25, lw=0)
        axes.plot(*view.of(means).T, ".", color=palette.UNMOVED, label="Gaussian components, 95 %")
        path = gmr.trajectory(300).positions
        axes.plot(*view.of(path).T, "k:", lw=1.4, label="learned path (GMR)")
        axes.set_title(f"({letter}) {title}")
    figure.axes[0].legend(loc="lower left")
    return figure


def obstructed() -> tuple[Skill, Scene]:
    """Return a skill of six components, and a scene with an obstacle on its path."""
    skill = Skill(6).fit(align(demonstrations_by(s_shaped_reach(planar=True), 10)))
    pose = Pose(np.array([0.44, -0.14, 0.10]), quaternion_exp(np.array([0.0, 0.0, 0.4])))
    return skill, Scene(None, (Box(pose, np.array([0.06, 0.05, 0.10]), name="obstacle"),))


def figure_4_3() -> Figure:
    """Components before and after an obstacle appears."""
    skill, scene = obstructed()
    found = adapt(skill, scene, tool_radius=_TOOL_RADIUS, clearance=_CLEARANCE, forbidden=HORIZONTAL_ONLY)
    figure, view = Figure(figsize=(8.0, 3.2), layout="constrained"), View(0, 1)
    shift = np.zeros_like(found.displacement)
    panels = (
        ("(a) learned", shift, np.zeros(len(shift), dtype=bool)),
        ("(b) adapted", found.displacement, found.moved),
    )
    points = np.concatenate([found.nominal.positions, found.trajectory.positions, scene.obstacles[0].bounds()])
    for axes, (title, displacement, moved) in zip(figure.subplots(1, 2, sharey=True), panels, strict=True):
        framed(axes, view, points, 0.07)
        grid, depth = Grid.of(axes, view), np.array([0.10])
        draw_obstacles(axes, scene, grid, depth, _TOOL_RADIUS + _CLEARANCE, view.of(found.nominal.positions))
        draw_components(axes, view, found.means, found.covariances, displacement, moved)
        axes.plot(*view.of(found.nominal.positions).T, "k:", lw=1.4, label="learned path (GMR)")
        if moved.any():
            axes.plot(*view.of(found.trajectory.positions).T, color=palette.ADAPTED, lw=1.8, label="adapted path")
        axes.set_title(f"{title}: {int(moved.sum())} of {len(moved)} components moved")
    figure.legend(*figure.axes[1].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return figure


def figure_4_4() -> Figure:
    """The distance from a component's ellipse to an obstacle, and the distance at which the obstacle acts on it."""
    skill, scene = obstructed()
    obstacle, parts = scene.obstacles[0], ComponentPath.of_skill(skill)
    distances, normals, spreads = component_distances(parts, np.zeros_like(parts.means), scene.obstacles, 0.0)
    k = int(np.argmin(np.where(obstacle.signed_distance(parts.means) > 0.0, distances[0], np.inf)))
    mean, normal, spread = parts.means[k], normals[0, k], spreads[0, k]
    nearest = mean - (distances[0, k] + spread) * normal
    figure, view = Figure(figsize=(5.6, 4.4), layout="constrained"), View(0, 1)
    axes = figure.subplots()
    framed(axes, view, np.stack([*obstacle.bounds(), mean + 0.06]), 0.06)
    grid, depth = Grid.of(axes, view), np.array([0.10])
    draw_obstacles(axes, scene, grid, depth, INFLUENCE_DISTANCE, view.of(parts.nominal.positions))
    draw_ellipses(axes, mean[None], parts.covariances[k][None] / 2.448**2, view, color=palette.MOVED, alpha=0.3, lw=0)
    axes.plot(*view.of(parts.nominal.positions).T, "k:", lw=1.2, label="learned path (GMR)")
    edge = mean - spread * normal
    across = np.array([-normal[1], normal[0], 0.0])
    axes.plot(*view.of(np.stack([edge - 0.06 * across, edge + 0.06 * across])).T, color=palette.MOVED, lw=0.8)
    for start, end, text in (
        (mean, edge, rf"$\sigma(n)$ = {1e3 * spread:.0f} mm"),
        (edge, nearest, f"$d$ = {1e3 * distances[0, k]:.0f} mm"),
    ):
        axes.annotate("", view.of(end), view.of(start), arrowprops={"arrowstyle": "<->", "shrinkA": 0, "shrinkB": 0})
        axes.annotate(text, view.of(0.5 * (start + end)), xytext=(8, -12), textcoords="offset points")
    axes.plot(*view.of(mean), ".", color=palette.MOVED, label="component, one-sigma ellipse")
    handles, labels = axes.get_legend_handles_labels()
    labels = [
        f"{1e3 * INFLUENCE_DISTANCE:.0f} mm: influence" if text == "required clearance" else text for text in labels
    ]
    figure.legend(handles, labels, loc="outside lower center", ncols=3)
    return figure


def draw_table(axes: Any, view: View, crumbs: Array) -> None:
    """Draw the points S, T and G, the edge of the pan and the crumbs at one time (n, 2) [m]."""
    for name, pose in (("S", SweepTask.start), ("T", SweepTask.dirt), ("G", SweepTask.goal)):
        axes.annotate(name, view.of(pose.position), xytext=(4, -11), textcoords="offset points", fontweight="bold")
        axes.plot(*view.of(pose.position), "k+", ms=6)
    x, y = SweepTask.goal.position[:2]
    corners = np.array(
        [[x + a, y - 0.085 + b, 0.0] for a, b in ((-0.125, 0.15), (-0.125, 0), (0.125, 0), (0.125, 0.15))]
    )
    axes.plot(*view.of(corners).T, color="#287a85", lw=1.4)
    axes.plot(crumbs[:, view.across], crumbs[:, view.up], ".", color="#3d291a", ms=2.5)


def figure_4_5() -> Figure:
    """The sweeping task: start, dirt, goal, and the packaged demonstrations."""
    view, task = View(1, 0), SweepTask()
    figure = Figure(figsize=(6.4, 3.0), layout="constrained")
    axes = figure.subplots()
    shown = read(DEMONSTRATIONS)
    framed(axes, view, np.array([[0.44, -0.55, 0.0], [0.80, 0.50, 0.0]]), 0.02)
    draw_demonstrations(axes, view, shown)
    draw_table(axes, view, task.crumb_positions())
    axes.set_title(f"{len(shown)} demonstrations of the sweep, seen from above")
    return figure


def figure_4_6() -> Figure:
    """Simulated sweeps among obstacles of different position, pose and size."""
    view, figure = View(1, 0), Figure(figsize=(8.0, 6.2), layout="constrained")
    names = ("T1", "T2", "T3", "T6")
    for letter, axes, name in zip(_PANELS, figure.subplots(2, 2).flat, names, strict=True):
        run = swept(name, render=False)
        framed(axes, view, np.array([[0.28, -0.56, 0.0], [0.88, 0.52, 0.0]]), 0.01)
        solids = Scene(None, [o for o in run.scene.obstacles if not isinstance(o, HalfSpace)])
        path = run.adaptation.nominal.positions
        draw_obstacles(
            axes, solids, Grid.of(axes, view), np.array([0.01]), SweepTask.tool_radius + _CLEARANCE, view.of(path)
        )
        axes.plot(*view.of(path).T, "k:", lw=1.2, label="learned path")
        axes.plot(*view.of(run.rollout.trajectory.positions).T, color=palette.MEASURED, lw=1.6, label="measured path")
        draw_table(axes, view, run.crumbs[1])
        done = "dirt in the pan" if run.rollout.success else "failed"
        axes.set_title(f"({letter}) {name}: {done}, clearance {1e3 * run.rollout.min_clearance:.0f} mm")
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return figure


def pictured(name: str) -> Figure:
    """The simulated arm at the start and at the end of a sweep."""
    run, figure = swept(name, render=True), Figure(figsize=(8.0, 3.2), layout="constrained")
    done = "dirt in the pan" if run.rollout.success else "failed"
    titles = ("(a) start", f"(b) end: {done}, clearance {1e3 * run.rollout.min_clearance:.0f} mm")
    for axes, title, image in zip(figure.subplots(1, 2), titles, run.pictures, strict=True):
        axes.imshow(image)
        axes.set_axis_off()
        axes.set_title(title)
    return figure


def figure_5_4() -> Figure:
    """The simulated Panda at the start, above the obstacles, and at the goal in the open box."""
    task, arm = OpenBoxTask(seed=4, n_obstacles=3), OpenBoxTask.arm()
    skill = Skill(8).fit(align(demonstrations_by(task.motion(), 10)))
    robot, scene, look = task.robot(arm=arm), task.scene(), (155.0, -30.0)
    policy, pictures = ACFRA(skill, arm=arm, clearance=task.clearance), [picture(robot, [], look)]

    def on_step(step: Step) -> None:
        if len(pictures) == 1 and step.command.progress > 0.5:
            pictures.append(picture(robot, [], look))

    safety = SafetyFilter(arm, clearance=task.clearance)
    rollout = task.evaluate(robot, reproduce(policy, robot, scene.at, safety=safety, on_step=on_step))
    path = (rollout.trajectory.positions, palette.MEASURED)
    pictures.append(picture(robot, [path], look))
    figure = Figure(figsize=(9.0, 2.6), layout="constrained")
    done = "in the box" if rollout.success else "failed"
    titles = ("(a) start", "(b) halfway", f"(c) {done}, clearance {1e3 * rollout.min_clearance:.0f} mm")
    for axes, title, image in zip(figure.subplots(1, 3), titles, pictures, strict=True):
        axes.imshow(image)
        axes.set_axis_off()
        axes.set_title(title)
    return figure


def figure_5_9() -> Figure:
    """Detections of a swaying obstacle, the estimate of the tracker, and the true position."""
    times = np.arange(0.0, 12.0, PERIOD)
    angle = 2.0 * np.pi * 0.15 * times
    positions = np.stack([0.25 * np.sin(angle), 0.05 * np.cos(angle), np.zeros(len(times))], axis=1)
    scene = MovingScene(Scene(None, (Sphere(positions[0], 0.05),)), {0: Track(times, positions)})
    velocities = np.gradient(positions, PERIOD, axis=0)
    motion = RecordedMotion("swaying", ("sphere",), times, positions[None], velocities[None], scene)
    log = follow(motion, ObstacleTracker(), SensorModel(noise=0.015, dropout=0.2)).logs[0]
    figure = Figure(figsize=(6.0, 4.0), layout="constrained")
    draw_positions(*figure.subplots(2, 1, sharex=True), log)
    figure.legend(loc="outside lower center", ncols=3)
    return figure


FIGURES = {
    "4.2": figure_4_2,
    "4.3": figure_4_3,
    "4.4": figure_4_4,
    "4.5": figure_4_5,
    "4.6": figure_4_6,
    "4.7": lambda: pictured("T1"),
    "4.8": lambda: pictured("T4"),
    "5.2": figure_5_2,
    "5.3": figure_5_3,
    "5.4": figure_5_4,
    "5.9": figure_5_9,
}

if __name__ == "__main__":
    main()
