"""Charts of a retargeted motion over time: states, joints, the tool and its target, and the upper arms.

Every public function that draws returns one ``<svg>`` element.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from imitarm.retarget import Retargeting
from imitarm.retarget.engagement import EngagementState
from imitarm.viewer import palette
from imitarm.viewer.canvas import INK, MM, canvas, thin, thin_extremes
from imitarm.viewer.charts import JointCurve, short_names, small_multiples

Array = NDArray[np.float64]

STATE_COLOURS: Final = dict(zip(EngagementState, ("#bfc5cf", "#009e73", "#56b4e9", "#e69f00", "#d55e00"), strict=True))
"""Colours of the states of a retargeter (waiting, following, coasting, holding, stopped), in this order."""
_DEGREES: Final = 180.0 / np.pi


def states(runs: Sequence[tuple[str, Retargeting]], *, name: str = "states") -> str:
    """Draw one coloured band for each method, which shows the state of the retargeter over time.

    Args:
        runs: one pair (title, retargeted motion) for each method.
        name: name of the figure, unique in the page.

    Returns:
        An SVG element.
    """
    height = 0.72 + 0.24 * len(runs)
    fractions = "; ".join(f"{title}: following {100 * np.mean(run.states == 'following'):.0f} %" for title, run in runs)
    with canvas(name, f"State over time. {fractions}", (5.5, height + 0.05)) as drawing:
        axes = drawing.axes(0.95, 0.68, 5.4, height)
        longest = max(float(run.times[-1]) for _, run in runs)
        for row, (_, run) in enumerate(runs):
            for first, last in stretches(run.states):
                start, end = run.times[first], run.times[min(last + 1, len(run.times) - 1)]
                axes.barh(
                    -row,
                    end - start,
                    left=start,
                    height=0.72,
                    color=STATE_COLOURS[EngagementState(run.states[first])],
                    lw=0,
                )
        axes.set_yticks([-row for row in range(len(runs))], [title for title, _ in runs])
        axes.tick_params(axis="y", length=0)
        axes.set_xlim(0.0, longest)
        axes.set_ylim(-len(runs) + 0.5, 0.5)
        axes.grid(axis="y", visible=False)
        axes.set_xlabel("time [s]", labelpad=3)
        for state in EngagementState:
            axes.bar(0.0, 0.0, color=STATE_COLOURS[state], label=state)
        drawing.legend(5)
    return drawing.svg


def stretches(states: NDArray[Any]) -> list[tuple[int, int]]:
    """Return the first and the last index of each interval with a constant state."""
    ends = np.flatnonzero(states[1:] != states[:-1])
    firsts = np.concatenate([[0], ends + 1])
    return list(zip(firsts.tolist(), [*ends.tolist(), len(states) - 1], strict=True))


def tool(run: Retargeting, path: Array, *, name: str = "tool") -> str:
    """Draw tool and target over time, in one chart for each axis, and the distance between tool and target.

    Args:
        run: the retargeted motion.
        path: path of the tool, shape (n, 3) [m].
        name: name of the figure, unique in the page.

    Returns:
        An SVG element.
    """
    target = run.targets[0]
    apart = MM * np.linalg.norm(path - target, axis=1)
    known = np.isfinite(apart)
    text = "Tool and target over time"
    if known.any():
        text += f"; largest distance {apart[known].max():.0f} mm"
    with canvas(name, text, (5.5, 4.0)) as drawing:
        for i, axis in enumerate("xyz"):
            top = 3.9 - 0.82 * i
            axes = drawing.axes(0.74, top - 0.66, 5.4, top)
            few = thin(len(path))
            label = {"label": "target"} if i == 0 else {}
            axes.plot(run.times[few], target[few, i], color=palette.DEMONSTRATION, lw=2.4, alpha=0.75, **label)
            label = {"label": "tool"} if i == 0 else {}
            axes.plot(run.times[few], path[few, i], color=palette.ADAPTED, lw=1.1, **label)
            _finish(axes, run.times, f"{axis} [m]", last=False)
        axes = drawing.axes(0.74, 0.72, 5.4, 1.4)
        if known.any():
            kept = np.flatnonzero(known)[thin_extremes(apart[known])]
            axes.fill_between(run.times[kept], apart[kept], 0.0, color=palette.MOVED, alpha=0.25, lw=0)
            axes.plot(run.times[kept], apart[kept], color=palette.MOVED, lw=1.0)
            axes.set_ylim(0.0, 1.1 * max(float(apart[known].max()), 1.0))
        _finish(axes, run.times, "distance [mm]", last=True)
        drawing.legend(2)
    return drawing.svg


def _finish(axes: Any, times: Array, label: str, *, last: bool) -> None:
    axes.set_xlim(times[0], times[-1])
    axes.set_ylabel(label)
    axes.locator_params(axis="y", nbins=4)
    if last:
        axes.set_xlabel("time [s]", labelpad=3)
    else:
        axes.tick_params(axis="x", labelbottom=False)


def joints(run: Retargeting, *, name: str = "joints") -> str:
    """Draw the position of each joint with its limits [degrees]."""
    arm = run.arm
    curves = []
    for i, title in enumerate(short_names(arm.joint_names)):
        values = _DEGREES * run.joints[:, i]
        free = not (np.isfinite(arm.lower[i]) and np.isfinite(arm.upper[i]))
        low, high = (float(values.min()) - 1.0, float(values.max()) + 1.0) if free else (arm.lower[i], arm.upper[i])
        unit = 1.0 if free else _DEGREES
        curves.append(JointCurve(title, values, unit * float(low), unit * float(high)))
    return small_multiples(
        name, f"Positions of {len(curves)} joints, with their limits", "position [°]", run.times, curves
    )


def velocities(run: Retargeting, *, name: str = "velocities") -> str:
    """Draw the velocity of each joint (from differences of its positions), as a percentage of the velocity limit."""
    dt = float(run.times[1] - run.times[0])
    percentages = 100.0 * np.diff(run.joints, axis=0) / dt / run.arm.max_velocity
    return _percentages(run, run.times[1:], percentages, "velocity", name)


def accelerations(run: Retargeting, *, name: str = "accelerations") -> str:
    """Draw the acceleration of each joint (from second differences of its positions), as a percentage of its limit."""
    dt = float(run.times[1] - run.times[0])
    percentages = 100.0 * np.diff(run.joints, 2, axis=0) / dt**2 / run.arm.max_acceleration
    return _percentages(run, run.times[2:], percentages, "acceleration", name)


def _percentages(run: Retargeting, times: Array, percentages: Array, what: str, name: str) -> str:
    """Draw percentages of a limit (n, n_joints) over times (n,) [s]."""
    curves = [
        JointCurve(f"{title}: {np.abs(percentages[:, i]).max():.0f} %", percentages[:, i], -100.0, 100.0)
        for i, title in enumerate(short_names(run.arm.joint_names))
    ]
    text = f"{what.capitalize()} of {len(curves)} joints as a percentage of the limit"
    return small_multiples(name, text, f"{what} [% of the limit]", times, curves)


def elbow(run: Retargeting, points: Array, *, name: str = "elbow") -> str:
    """Draw how far the upper arms of person and robot point upwards and to the left, as angles over time.

    Args:
        run: the retargeted motion.
        points: positions of the robot's shoulder, elbow and wrist at each sample, shape (n, 3, 3) [m].
        name: name of the figure, unique in the page.

    Returns:
        An SVG element; an empty string when the person's elbow was never known.
    """
    known = np.isfinite(run.elbows).all(axis=1)
    if not known.any():
        return ""
    upper = points[:, 1] - points[:, 0]
    robot = _directions(upper / np.linalg.norm(upper, axis=1, keepdims=True))
    person = _directions(run.elbows)
    person[~known] = np.nan
    with canvas(name, "Directions of the upper arms of person and robot over time", (5.5, 2.6)) as drawing:
        for i, label in enumerate(("upwards [°]", "to the left [°]")):
            top = 2.5 - 0.95 * i
            axes = drawing.axes(0.74, top - 0.8, 5.4, top)
            few = thin(len(robot))
            named = i == 0
            axes.plot(
                run.times[few],
                person[few, i],
                color=palette.DEMONSTRATION,
                lw=2.4,
                alpha=0.75,
                label="person" if named else None,
            )
            axes.plot(run.times[few], robot[few, i], color=palette.ADAPTED, lw=1.1, label="robot" if named else None)
            axes.axhline(0.0, color=INK, lw=0.6, alpha=0.3)
            _finish(axes, run.times, label, last=i == 1)
        drawing.legend(2)
    return drawing.svg


def _directions(upper: Array) -> Array:
    """Return the angles of unit vectors (n, 3) above the horizontal plane and to the left, shape (n, 2) [degrees]."""
    return _DEGREES * np.arcsin(np.clip(upper[:, [2, 1]], -1.0, 1.0))
