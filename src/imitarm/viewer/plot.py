"""``imitarm.plot``: one matplotlib figure of a trajectory, demonstration, skill, adaptation, rollout or scene."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from imitarm.errors import InputError
from imitarm.scene import Obstacle, Scene
from imitarm.skills import Skill
from imitarm.trajectory import Demonstration, Rollout, Trajectory
from imitarm.viewer import palette
from imitarm.viewer.content import AdaptedPath
from imitarm.viewer.maps import Grid, View, corners_of, draw_components, draw_ellipses

Array = NDArray[np.float64]

_SIZE: Final = (10.0, 4.8)  # [inch]
_MM: Final = 1000.0  # [mm/m]
_AXES: Final = "xyz"
_FAR: Final = 2.0  # [m] an obstacle that extends farther than this from the others is cut off
_DEPTHS: Final = 25  # cross-sections of an obstacle that make its projection


def plot(thing: Any) -> Any:
    """Draw an object of this library, and return the matplotlib figure.

    Args:
        thing: object to draw:

            * a :class:`~imitarm.Trajectory`: the path, and x, y and z over time;
            * a :class:`~imitarm.Demonstration` or a list of them: the paths, and x, y and z over the time since the
                start of each demonstration;
            * a :class:`~imitarm.Skill`: the learned path with the 95 % ellipses of the Gaussian components, and x, y
              and z over time with a band of two standard deviations;
            * an :class:`~imitarm.Adaptation`: the learned path, the adapted path and the moved components, and x, y
              and z of both paths over time;
            * a :class:`~imitarm.Rollout`: the measured path, and clearance, joint velocities and torques over time;
            * a :class:`~imitarm.Scene`: the goal and the obstacles, from above and from the side.

    Returns:
        A :class:`matplotlib.figure.Figure`. Save the figure with ``figure.savefig("picture.png")``, or open a window
        with ``matplotlib.pyplot.show()``. A notebook displays the figure automatically.

    Raises:
        InputError: when the object is of another type, or matplotlib is not installed.
        ImitarmError: when a skill has not been fitted.

    Examples:
        >>> from imitarm import Trajectory
        >>> figure = plot(Trajectory([0.0, 1.0], [[0.0, 0.0, 0.0], [0.3, 0.1, 0.0]]))
        >>> [axes.get_ylabel() for axes in figure.axes]
        ['y [m]', 'x [m]', 'y [m]', 'z [m]']
    """
    draw = _drawing(thing)
    try:
        import matplotlib  # noqa: PLC0415 (heavy, and an extra)
        from matplotlib import pyplot  # noqa: PLC0415
    except ImportError as error:
        raise InputError(
            "plot needs matplotlib, which is not installed; install it with: pip install 'imitarm[report]'"
        ) from error
    with matplotlib.rc_context({"axes.spines.top": False, "axes.spines.right": False}):
        figure = pyplot.figure(figsize=_SIZE, layout="constrained")
        try:
            draw(figure, thing)
        except BaseException:
            pyplot.close(figure)
            raise
    if "inline" in matplotlib.get_backend():
        pyplot.close(figure)  # a notebook shows the returned figure; an open one would be shown twice
    return figure


def _drawing(thing: Any) -> Callable[[Any, Any], None]:
    """Return the function that draws ``thing`` on a figure."""
    if isinstance(thing, list | tuple) and thing and all(isinstance(one, Demonstration) for one in thing):
        return _demonstrations
    for kind, draw in _DRAWINGS.items():
        if isinstance(thing, kind):
            return draw
    raise InputError(
        "plot: needs a Trajectory, a Demonstration or a list of them, a Skill, an Adaptation, a Rollout or a Scene, "
        f"got {type(thing).__name__}"
    )


def _map(figure: Any, place: Any, view: View, title: str) -> Any:
    """Add axes that show the base frame in the directions of ``view``; both axes have the same scale."""
    axes = figure.add_subplot(place, aspect="equal", adjustable="datalim")
    axes.set_xlabel(f"{_AXES[view.across]} [m]")
    axes.set_ylabel(f"{_AXES[view.up]} [m]")
    axes.set_title(title, loc="left")
    if view.leftwards:
        axes.invert_xaxis()
    axes.grid(alpha=0.2)
    return axes


def _charts(figure: Any, place: Any, labels: Sequence[str]) -> list[Any]:
    """Add charts over one time axis, one below the other."""
    grid = place.subgridspec(len(labels), 1)
    charts: list[Any] = []
    for i, label in enumerate(labels):
        axes = figure.add_subplot(grid[i], sharex=charts[0] if charts else None)
        axes.set_ylabel(label)
        axes.grid(alpha=0.2)
        axes.tick_params(labelbottom=i == len(labels) - 1)
        charts.append(axes)
    charts[-1].set_xlabel("time [s]")
    return charts


def _side_by_side(figure: Any, view: View, title: str, labels: Sequence[str]) -> tuple[Any, list[Any]]:
    """Add a map, and charts over time beside it."""
    places = figure.add_gridspec(1, 2)
    return _map(figure, places[0], view, f"{title}, {view.title}"), _charts(figure, places[1], labels)


def _draw_path(axes: Any, charts: Sequence[Any], view: View, path: Trajectory, **look: Any) -> None:
    """Draw one path on a map, and the coordinates x, y and z of the path over time."""
    axes.plot(*view.of(path.positions).T, **look)
    for axis, chart in enumerate(charts):
        chart.plot(path.times, path.positions[:, axis], **look)


def _ends(axes: Any, view: View, path: Trajectory, colour: str) -> None:
    """Mark where a path starts and ends."""
    axes.plot(*view.of(path.positions[:1]).T, "o", color=colour, ms=6, label="start")
    axes.plot(*view.of(path.positions[-1:]).T, "s", color=colour, ms=6, label="end")


def _coordinates() -> list[str]:
    return [f"{axis} [m]" for axis in _AXES]


def _paths(figure: Any, paths: Sequence[Trajectory], title: str, colour: str) -> None:
    view = View.best(np.concatenate([path.positions for path in paths]))
    axes, charts = _side_by_side(figure, view, title, _coordinates())
    for path in paths:
        _draw_path(axes, charts, view, path, color=colour, lw=1.3)
    _ends(axes, view, paths[0], colour)
    axes.legend()


def _demonstrations(figure: Any, shown: Sequence[Demonstration]) -> None:
    title = "Demonstration" if len(shown) == 1 else f"{len(shown)} demonstrations"
    paths = [replace(one.trajectory, times=one.trajectory.times - one.trajectory.times[0]) for one in shown]
    _paths(figure, paths, title, palette.DEMONSTRATION)


def _skill(figure: Any, skill: Skill) -> None:
    duration = skill.duration_  # raises when the skill has not been fitted
    gmr, times = skill.gmr_, np.linspace(0.0, duration, 200)
    path, variances = skill.nominal(times), np.einsum("nii->ni", skill.tolerance(times))
    view = View.best(path.positions)
    title = f"Skill with {len(gmr.position_means_)} components"
    axes, charts = _side_by_side(figure, view, title, _coordinates())
    draw_ellipses(axes, gmr.position_means_, gmr.position_covariances_, view, color=palette.UNMOVED, alpha=0.25, lw=0)
    axes.plot(*view.of(gmr.position_means_).T, ".", color=palette.UNMOVED, label="Gaussian components, 95 %")
    band = 2.0 * np.sqrt(np.maximum(variances, 0.0))
    for axis, chart in enumerate(charts):
        middle = path.positions[:, axis]
        look = {"color": palette.ADAPTED, "alpha": 0.2, "lw": 0}
        chart.fill_between(path.times, middle - band[:, axis], middle + band[:, axis], label="±2σ", **look)
    _draw_path(axes, charts, view, path, color=palette.ADAPTED, lw=1.6, label="learned path")
    axes.legend()
    charts[0].legend()


def _adaptation(figure: Any, adaptation: AdaptedPath) -> None:
    nominal, adapted = adaptation.nominal, adaptation.trajectory
    view = View.best(np.concatenate([nominal.positions, adapted.positions]))
    outcome = "feasible" if adaptation.feasible else "not feasible"
    title = f"{int(np.sum(adaptation.moved))} of {len(adaptation.moved)} components moved ({outcome})"
    axes, charts = _side_by_side(figure, view, title, _coordinates())
    draw_components(
        axes, view, adaptation.means, adaptation.covariances, adaptation.displacement, np.asarray(adaptation.moved)
    )
    _draw_path(axes, charts, view, nominal, color=palette.NOMINAL, ls="--", lw=1.4, label="learned path")
    _draw_path(axes, charts, view, adapted, color=palette.ADAPTED, lw=1.8, label="adapted path")
    axes.legend()


def _rollout(figure: Any, rollout: Rollout) -> None:
    path = rollout.trajectory
    view = View.best(path.positions)
    labels = ("clearance [mm]", "joint velocity [rad/s]", "torque [N m]")
    title = f"Rollout ({'succeeded' if rollout.success else 'failed'})"
    axes, (clearance, velocity, torque) = _side_by_side(figure, view, title, labels)
    axes.plot(*view.of(path.positions).T, color=palette.MEASURED, lw=1.6)
    _ends(axes, view, path, palette.MEASURED)
    axes.legend()
    if np.isfinite(rollout.clearance).any():
        clearance.plot(path.times, _MM * rollout.clearance, color=palette.ADAPTED)
        clearance.axhline(0.0, color=palette.LIMIT, lw=1.0, ls="--")
    else:
        clearance.text(0.5, 0.5, "no obstacle", transform=clearance.transAxes, ha="center", va="center")
        clearance.set_yticks([])
    for joint in range(rollout.joints.shape[1]):
        velocity.plot(path.times, rollout.velocities[:, joint], lw=1.1, label=f"joint {joint + 1}")
        torque.plot(path.times, rollout.torques[:, joint], lw=1.1)
    velocity.legend(fontsize="x-small", ncols=2, loc="upper left", bbox_to_anchor=(1.0, 1.0))


def _scene(figure: Any, scene: Scene) -> None:
    places = figure.add_gridspec(1, 2)
    corners = _corners(scene)
    for place, view in zip(places, (View(0, 1), View(0, 2)), strict=True):
        axes = _map(figure, place, view, f"Scene, {view.title}")
        low, high = view.of(corners)
        half = 0.5 * float((high - low).max())  # a square, so that equal scales keep these limits
        middle = 0.5 * (low + high)
        axes.set(xlim=(middle[0] - half, middle[0] + half), ylim=(middle[1] - half, middle[1] + half))
        axes.set_adjustable("box")
        grid = Grid.of(axes, view)
        depths = np.linspace(corners[0, view.depth], corners[1, view.depth], _DEPTHS)
        for kind, obstacles, colour in (
            ("fixture", scene.fixtures, palette.NOMINAL),
            ("obstacle", scene.obstacles, palette.OBSTACLE),
        ):
            for obstacle in obstacles:
                _draw_obstacle(axes, grid, obstacle, depths, colour, obstacle.name or kind)
        axes.plot(0.0, 0.0, "+", color=palette.ADAPTED, ms=10, label="origin of the base frame")
        if scene.goal is not None:
            axes.plot(*view.of(scene.goal.position[None]).T, "*", color=palette.ADAPTED, ms=12, label="goal")
        axes.legend()


def _draw_obstacle(axes: Any, grid: Grid, obstacle: Obstacle, depths: Array, colour: str, name: str) -> None:
    """Fill the projection of an obstacle, and write its name in the middle."""
    low, high = np.clip(obstacle.bounds()[:, grid.view.depth], depths[0], depths[-1])
    distance = grid.distance_to(obstacle, np.linspace(float(low), float(high), len(depths)))
    if distance.min() >= 0.0 or distance.max() < 0.0:
        return  # out of view, or a floor that fills the whole view
    axes.contourf(grid.across, grid.up, distance, levels=[-1e3, 0.0], colors=[colour], alpha=0.6)
    rows, columns = np.nonzero(distance < 0.0)
    place = float(grid.across[columns].mean()), float(grid.up[rows].mean())
    axes.annotate(name.replace("$", r"\$"), place, ha="center", va="center", fontsize="small")


def _corners(scene: Scene) -> Array:
    """Return the corners (2, 3) [m] of the box that contains the scene in the base frame."""
    points = [np.zeros((1, 3))]
    if scene.goal is not None:
        points.append(scene.goal.position[None])
    for obstacle in (*scene.obstacles, *scene.fixtures):
        bounds = obstacle.bounds()
        points.append(np.clip(np.where(np.isfinite(bounds), bounds, 0.0), -_FAR, _FAR))
    return corners_of(np.concatenate(points), 0.1)


_DRAWINGS: Final[dict[type, Callable[[Any, Any], None]]] = {
    Trajectory: lambda figure, path: _paths(figure, [path], "Trajectory", palette.ADAPTED),
    Demonstration: lambda figure, one: _demonstrations(figure, [one]),
    Skill: _skill,
    Rollout: _rollout,
    Scene: _scene,
    AdaptedPath: _adaptation,
}
