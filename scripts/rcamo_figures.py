"""Thesis Figs 5.2 and 5.3: the primitive of the sweep, and the cost around it, without and with a moving obstacle."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from numpy.typing import NDArray

from imitarm.demonstrations import align, read
from imitarm.kinematics.arm import ArmState
from imitarm.kinematics.pose import Pose
from imitarm.policies import HORIZONTAL_ONLY, RCAMO, Observation
from imitarm.scene import Scene, Sphere
from imitarm.skills import Skill
from imitarm.tasks import DEMONSTRATIONS
from imitarm.viewer import palette
from imitarm.viewer.maps import Grid, View

Array = NDArray[np.float64]

_DT = 0.01  # [s]
_TOOL = ((0.0, 0.0, 0.0, 0.03),)  # one sphere, 30 mm
_VIEW = View(1, 0)  # the sweep runs along y


def sweep() -> tuple[Skill, Array]:
    """Return the skill of the packaged sweep, and the positions of all demonstrations [m]."""
    shown = align(read(DEMONSTRATIONS))
    return Skill(12).fit(shown), np.concatenate([d.trajectory.positions for d in shown])


def tool_alone(policy: RCAMO, observe: Callable[[float], Scene], longest: float) -> Array:
    """Return the path of a tool that moves exactly as commanded, shape (n, 3) [m]."""
    x, q = policy.skill.start_.position, policy.skill.start_.quaternion
    rest, path = np.zeros(7), [policy.skill.start_.position]
    for k in range(round(longest / _DT)):
        state = ArmState(rest, rest, rest, k * _DT)
        now = Observation(k * _DT, state, Pose(x, q), observe(k * _DT))
        if k == 0:
            policy.reset(now)
        if policy.finished(now):
            break
        x = x + _DT * policy.step(now, _DT).twist[:3]
        path.append(x)
    return np.array(path)


def meeting(skill: Skill) -> tuple[Sphere, float]:
    """Return a ball that crosses the path of the sweep in its middle and meets the tool there, and the time [s]."""
    time = 0.5 * skill.duration_
    here = skill.generate(dt=time / 200.0).at([time])[0][0]
    velocity = np.array([0.12, 0.03, 0.0])
    return Sphere(here - time * velocity, 0.035, velocity=velocity, name="ball"), time


def framed(axes: Any, points: Array) -> Grid:
    """Show the area around points (n, 3) [m], and return a grid of it."""
    shown = _VIEW.of(points)
    low, high = shown.min(axis=0) - 0.02, shown.max(axis=0) + 0.02
    axes.set_xlim(high[0], low[0])
    axes.set_ylim(low[1] - 0.06, high[1] + 0.06)
    axes.set_aspect("equal")
    axes.set_xlabel("y [m]")
    axes.set_ylabel("x [m]")
    return Grid.of(axes, _VIEW)


def figure_5_2() -> Figure:
    """The motion of the primitive for the sweep."""
    skill, shown = sweep()
    path = skill.generate(dt=_DT)
    figure = Figure(figsize=(8.0, 2.6), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=[1.5, 1.0])
    framed(left, shown)
    left.plot(*_VIEW.of(shown).T, ".", color=palette.DEMONSTRATION, ms=0.8, label="demonstrations")
    left.plot(*_VIEW.of(skill.gmr_.trajectory(300).positions).T, color=palette.UNMOVED, lw=2.5, label="GMR")
    left.plot(*_VIEW.of(path.positions).T, "k:", lw=1.4, label="primitive (DMP)")
    left.legend(loc="lower left", ncols=3)
    left.set_title("(a) path")
    for i, name in enumerate("xyz"):
        right.plot(path.times, path.positions[:, i], label=name)
    right.set_xlabel("time [s]")
    right.set_ylabel("position [m]")
    right.legend(ncols=3)
    right.set_title("(b) over time")
    return figure


def figure_5_3() -> Figure:
    """The cost around the primitive, and the path of the tool past a moving obstacle."""
    skill, _ = sweep()
    ball, time = meeting(skill)
    policy = RCAMO(skill, tool_spheres=_TOOL, forbidden=HORIZONTAL_ONLY)
    nominal = skill.generate(dt=_DT).positions
    scenes = (Scene(), Scene(None, (ball,)))
    path = tool_alone(policy, scenes[1].at, 2.0 * skill.duration_)
    figure = Figure(figsize=(8.0, 4.6), layout="constrained")
    panels = figure.subplots(2, 1, sharex=True)
    titles = ("(a) no obstacle", f"(b) a ball that crosses the path, at {time:.1f} s")
    for axes, scene, title in zip(panels, scenes, titles, strict=True):
        grid = framed(axes, np.concatenate([nominal, path]))
        points = np.empty((len(grid.up), len(grid.across), 3))
        points[..., 1], points[..., 0] = np.meshgrid(grid.across, grid.up)
        points[..., 2] = nominal[len(nominal) // 2, 2]
        cost = policy.cost_field(scene.at(time), points)
        look = {"cmap": "turbo", "norm": LogNorm(1e-3, 10.0), "shading": "auto", "rasterized": True}
        colours = axes.pcolormesh(grid.across, grid.up, np.clip(cost, 1e-3, 10.0), **look)
        axes.plot(*_VIEW.of(nominal).T, "w:", lw=1.4, label="primitive (DMP)")
        if scene.obstacles:
            axes.plot(*_VIEW.of(path).T, color="white", lw=1.8, label="path of the tool")
            track = np.array([ball.after(t).center for t in np.linspace(time - 1.5, time + 1.5, 13)])
            axes.plot(*_VIEW.of(track).T, "k.", ms=3.0, label="ball, every 0.25 s")
        axes.legend(loc="lower left", ncols=3, labelcolor="white", frameon=True, facecolor="0.25", edgecolor="none")
        axes.set_title(title)
    figure.colorbar(colours, ax=panels, label="cost")
    return figure
