"""Charts of a report: quantities over time, displacements of components, and the choice of their number.

Every function returns one ``<svg>`` element. Figures of paths are in :mod:`~imitarm.viewer.maps`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.viewer import palette
from imitarm.viewer.canvas import INK, MM, canvas, thin_extremes

Array = NDArray[np.float64]

_WIDTH: Final = 5.5  # [inch]
_ROW: Final = 1.15  # [inch]
_LONGEST_NAME: Final = 9  # characters of a joint's name that fit above a chart together with a percentage
_SMALL: Final[dict[str, Any]] = {"fontsize": 7.5}


def clearance(times: ArrayLike, distances: ArrayLike, required: float, *, name: str = "clearance") -> str:
    """Draw the measured and the required clearance over time.

    Args:
        times: time stamps, shape (n_steps,) [s].
        distances: smallest distance between the arm, with its tool, and any obstacle, shape (n_steps,) [m].
        required: required clearance [m].
        name: name of the figure, unique in the page.

    Returns:
        An SVG element; an empty string if there was no obstacle (no distance is finite).
    """
    t, d = np.asarray(times, dtype=float), MM * np.asarray(distances, dtype=float)
    finite = np.isfinite(d)
    if not finite.any():
        return ""
    t, d = t[finite], d[finite]
    least = int(np.argmin(d))
    text = f"Clearance over time: at least {d[least]:.1f} mm, required {MM * required:.0f} mm"
    with canvas(name, text, (5.5, 2.2)) as drawing:
        axes = drawing.axes(0.74, 0.48, 5.4, 2.1)
        kept = thin_extremes(d)
        axes.plot(t[kept], d[kept], color=palette.ADAPTED, lw=1.6)
        axes.fill_between(t[kept], d[kept], 0.0, color=palette.ADAPTED, alpha=0.08, lw=0)
        axes.axhline(MM * required, color=palette.LIMIT, lw=1.1, ls="--")
        axes.axhline(0.0, color=INK, lw=1.0)
        axes.plot(t[least], d[least], "o", color=palette.LIMIT if d[least] < MM * required else palette.ADAPTED, ms=5)
        right = t[least] > 0.6 * t[-1]
        place = {
            "xytext": (-6 if right else 6, -14 if d[least] > 2.0 * MM * required else 9),
            "textcoords": "offset points",
        }
        place["ha"] = "right" if right else "left"
        axes.annotate(f"smallest: {d[least]:.1f} mm", (t[least], d[least]), **place)
        top = max(4.0 * MM * required, 2.0 * d[least], 60.0)
        axes.set_ylim(min(0.0, 1.15 * d[least]), min(1.08 * d.max(), 2.0 * top) if d.max() > 0.0 else top)
        axes.annotate(
            f"required: {MM * required:.0f} mm",
            (t[0] if right else t[-1], MM * required),  # on the side without the other label
            xytext=(3 if right else 0, 3),
            textcoords="offset points",
            ha="left" if right else "right",
        )
        axes.set_xlim(t[0], t[-1])
        axes.set_xlabel("time [s]")
        axes.set_ylabel("distance to the\nnearest obstacle [mm]")
    return drawing.svg


def torques(
    times: ArrayLike,
    values: ArrayLike,
    limits: ArrayLike,
    *,
    joint_names: Sequence[str] = (),
    name: str = "torques",
) -> str:
    """Draw the torque of each joint over time, with the rated torque of the joint.

    Args:
        times: time stamps, shape (n_steps,) [s].
        values: torques, shape (n_steps, n_joints) [N m].
        limits: rated torque, shape (n_joints,) [N m].
        joint_names: names shown above the charts; by default, joints are numbered.
        name: name of the figure, unique in the page.

    Returns:
        An SVG element.
    """
    t, tau, rated = np.asarray(times, float), np.asarray(values, float), np.asarray(limits, float)
    names = short_names(joint_names) or [f"joint {i + 1}" for i in range(tau.shape[1])]
    curves = [
        JointCurve(f"{names[i]}: {100.0 * np.abs(tau[:, i]).max() / rated[i]:.0f} %", tau[:, i], -rated[i], rated[i])
        for i in range(tau.shape[1])
    ]
    text = f"Torques of {len(curves)} joints over time, with the rated torques"
    return small_multiples(name, text, "torque [N m]", t, curves)


def short_names(names: Sequence[str]) -> list[str]:
    """Return joint names that fit above a small chart.

    If a name is too long, the common prefix up to "_" is removed.
    """
    first, _, _ = min(names, default="").rpartition("_")
    shared = f"{first}_" if max(map(len, names), default=0) > _LONGEST_NAME else ""
    return [name.removeprefix(shared) for name in names] if all(n.startswith(shared) for n in names) else list(names)


def displacement(lengths: ArrayLike, moved: ArrayLike, *, name: str = "displacement") -> str:
    """Draw the displacement of each Gaussian component.

    Args:
        lengths: length of each component's displacement, in the order of time, shape (n_components,) [m].
        moved: whether each component was moved, shape (n_components,).
        name: name of the figure, unique in the page.

    Returns:
        An SVG element.
    """
    far, went = MM * np.asarray(lengths, dtype=float), np.asarray(moved, dtype=bool)
    text = f"{int(went.sum())} of {len(far)} components were moved, by at most {far.max(initial=0.0):.0f} mm"
    with canvas(name, text, (5.5, 1.9)) as drawing:
        axes = drawing.axes(0.64, 0.48, 5.4, 1.7)
        numbers = np.arange(1, len(far) + 1)
        axes.bar(numbers[went], far[went], width=0.62, color=palette.MOVED, label="moved")
        axes.plot(
            numbers[~went],
            np.zeros(int((~went).sum())),
            "o",
            color=palette.UNMOVED,
            ms=5,
            label="not moved",
            clip_on=False,
        )
        for number, length in zip(numbers[went], far[went], strict=True):
            label = f"{length:.0f}" if length >= 0.5 else "<1"
            axes.annotate(label, (number, length), xytext=(0, 2), textcoords="offset points", ha="center", fontsize=7.5)
        drawing.figure.legend(loc="upper right", ncols=2, borderaxespad=0.0)
        axes.set_ylim(0.0, max(1.22 * far.max(initial=0.0), 5.0))
        axes.set_xticks(numbers)
        axes.grid(axis="x", visible=False)
        axes.set_xlabel("Gaussian component, in the order of time")
        axes.set_ylabel("displacement [mm]")
    return drawing.svg


def selection(
    n_components: ArrayLike,
    bic: ArrayLike,
    aic: ArrayLike,
    held_out_error: ArrayLike,
    chosen: int,
    *,
    name: str = "selection",
) -> str:
    """Draw three criteria for the number of components: BIC, AIC and the error on held-out demonstrations.

    Args:
        n_components: the numbers of components that were compared, shape (n,).
        bic: Bayesian information criterion for each number of components, lower is better, shape (n,); may be empty.
        aic: Akaike information criterion for each number of components, lower is better, shape (n,); may be empty.
        held_out_error: root mean square distance to held-out demonstrations, shape (n,) [m]; may be empty.
        chosen: the chosen number of components, which is marked.
        name: name of the figure, unique in the page.

    Returns:
        An SVG element.
    """
    k = np.asarray(n_components, dtype=float)
    with canvas(
        name, f"{chosen} Gaussian components were chosen out of {k.min():.0f} to {k.max():.0f}", (5.5, 2.4)
    ) as drawing:
        left, right = drawing.axes(0.88, 0.48, 2.75, 2.3), drawing.axes(3.45, 0.48, 5.4, 2.3)
        criteria = {"BIC": np.asarray(bic, dtype=float), "AIC": np.asarray(aic, dtype=float)}
        large = max((float(np.abs(values).max()) for values in criteria.values() if len(values)), default=0.0) >= 1e4
        for (label, values), colour, style in zip(
            criteria.items(), (palette.ADAPTED, palette.UNMOVED), ("o-", "s--"), strict=True
        ):
            if len(values):
                left.plot(k, values / (1e3 if large else 1.0), style, color=colour, ms=3.5, lw=1.4, label=label)
        left.set_ylabel("information criterion" + (" / 1000" if large else ""))
        left.legend()
        if len(np.asarray(held_out_error)):
            right.plot(k, MM * np.asarray(held_out_error, dtype=float), "o-", color=palette.MOVED, ms=3.5, lw=1.4)
        right.set_ylabel("error on held-out\ndemonstrations [mm]")
        for axes in (left, right):
            axes.axvline(chosen, color=INK, lw=0.9, ls=":")
            axes.set_xlabel("number of components K")
            axes.xaxis.get_major_locator().set_params(integer=True)
        late = chosen > 0.5 * (k.min() + k.max())
        side = {"xytext": (-4 if late else 4, -9), "textcoords": "offset points", "ha": "right" if late else "left"}
        right.annotate(f"K = {chosen}", (chosen, 1.0), xycoords=("data", "axes fraction"), **side)
    return drawing.svg


@dataclass(frozen=True, eq=False)
class JointCurve:
    """The data of a small chart: a quantity of one joint over time, with its limits.

    Attributes:
        title: title above the chart.
        values: values over time, shape (n_steps,).
        lower: lower limit, in the unit of the values.
        upper: upper limit, in the unit of the values.
        zero: whether to draw a line at 0.
    """

    title: str
    values: Array
    lower: float
    upper: float
    zero: bool = True


def small_multiples(name: str, description: str, unit: str, times: Array, curves: Sequence[JointCurve]) -> str:
    """Draw one small chart for each joint, with the limits of the joint.

    Args:
        name: name of the figure, unique in the page.
        description: description for screen readers.
        unit: label of the vertical axis.
        times: time stamps, shape (n_steps,) [s].
        curves: data to draw, one entry for each joint.

    Returns:
        An SVG element.
    """
    columns = min(len(curves), 4)
    rows = -(-len(curves) // columns)
    size = (_WIDTH, 0.3 + _ROW * rows)
    with canvas(name, description, size) as drawing:
        paper = drawing.axes(0.0, 0.0, *size, xlim=(0.0, size[0]), ylim=(0.0, size[1]))  # its units are inches
        paper.set_axis_off()
        for i, curve in enumerate(curves):
            row, column = divmod(i, columns)
            left = 0.58 + (size[0] - 0.26) / columns * column
            bottom = size[1] - _ROW * row - 0.94
            _Panel(left, bottom, (size[0] - 0.26) / columns - 0.42, 0.68).draw(paper, times, curve)
        paper.text(size[0] / 2, 0.06, "time [s]", ha="center")
        paper.text(0.08, size[1] / 2, unit, ha="center", va="center", rotation=90)
    return drawing.svg


@dataclass(frozen=True)
class _Panel:
    """A small chart in a figure of many.

    All charts share one pair of axes in inches, because drawing separate axes for each joint
    would take ten times longer.
    """

    left: float
    bottom: float
    width: float
    height: float

    def draw(self, paper: Any, times: Array, curve: JointCurve) -> None:
        """Draw the curve of a joint and the limits of the joint."""
        low, high = min(curve.lower, float(curve.values.min())), max(curve.upper, float(curve.values.max()))
        low, high = low - 0.06 * (high - low), high + 0.06 * (high - low)
        right = self.left + self.width
        kept = thin_extremes(curve.values, 160)
        span = max(float(times[-1] - times[0]), 1e-9)
        across = self.left + self.width * (times[kept] - times[0]) / span

        def up(values: Any) -> Any:
            return self.bottom + self.height * (values - low) / (high - low)

        paper.plot(across, up(curve.values[kept]), color=palette.ADAPTED, lw=1.1)
        marks = [(curve.lower, True), (curve.upper, True)]
        if curve.zero and curve.lower < 0.0 < curve.upper:
            marks.append((0.0, False))
        for value, limit in marks:
            look = {"color": palette.LIMIT, "lw": 1.0, "ls": "--"} if limit else {"color": INK, "lw": 0.6, "alpha": 0.3}
            paper.plot([self.left, right], [up(value)] * 2, **look)
            paper.text(self.left - 0.04, up(value), f"{value:.3g}", ha="right", va="center", **_SMALL)
        paper.plot(
            [self.left, self.left, right], [self.bottom + self.height, self.bottom, self.bottom], color=INK, lw=0.6
        )
        for x, value in ((self.left, times[0]), (right, times[-1])):
            paper.text(x, self.bottom - 0.04, f"{value:.3g}", ha="center", va="top", **_SMALL)
        paper.text(self.left, self.bottom + self.height + 0.05, curve.title.replace("$", r"\$"), fontsize=8.0)
