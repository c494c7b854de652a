"""Benchmark of perception: compare the detected obstacles with the true obstacles of the simulator."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from imitarm.benchmark.perception_scenes import DISTANCES, FAMILIES, SHAPES, images, make_scene, perception_arm
from imitarm.benchmark.tables import Table
from imitarm.perception import DepthFrame, DepthNoise, Detection, ObstacleDetector
from imitarm.scene import Obstacle
from imitarm.validation import whole_number

Array = NDArray[np.float64]

LEAST_VISIBLE = 12  # pixels of an obstacle that the camera must see for the obstacle to count
_COVERED = 0.2  # least fraction of an obstacle's volume inside of a detection that has found it
_FAR = 0.05  # [m] from every obstacle: a detection there is false
_SAMPLES = 400  # points in and on an obstacle
_CHI_SQUARE_95 = 7.815  # quantile of the chi-square distribution with 3 degrees of freedom


@dataclass(frozen=True)
class Seen:
    """How well one true obstacle was detected.

    Attributes:
        family: family of the scene.
        shape: true shape.
        distance: distance of the camera from the middle of the table [m].
        first: whether this is the first obstacle of the scene. The name of the family describes this obstacle.
        pixels: number of image pixels that show the obstacle.
        uncovered: fraction of the obstacle's volume that lies outside every detection.
        sticks_out: largest distance from a point of the obstacle's surface to the nearest detection [m].
        excess: largest distance from a surface point of the detection to the nearest true obstacle [m]; nan if the
            obstacle was missed or merged with another obstacle.
        error: distance between the detected and the true position [m]; nan in the same cases as ``excess``.
        size_error: mean absolute difference between the true and the detected lengths along three directions [m]; nan
            in the same cases as ``excess``.
        normalised: squared Mahalanobis distance of the position error, by the covariance of the detection; nan in the
            same cases as ``excess``.
        right_shape: whether the detection has the true kind of shape, for example a sphere; False if the
            obstacle was missed or merged.
    """

    family: str
    shape: str
    distance: float
    first: bool
    pixels: int
    uncovered: float
    sticks_out: float
    excess: float
    error: float
    size_error: float
    normalised: float
    right_shape: bool

    @property
    def merged(self) -> bool:
        """Whether the detector merged the obstacle with another obstacle into one detection."""
        return not self.missed and bool(np.isnan(self.error))

    @property
    def missed(self) -> bool:
        """Whether less than a fifth of the obstacle's volume lies inside the detections."""
        return self.uncovered > 1.0 - _COVERED


@dataclass(frozen=True)
class Frame:
    """One image.

    Attributes:
        family: family of the scene.
        seen: the obstacles that cover at least 12 pixels of the image.
        false: number of detections farther than 5 cm from every obstacle.
        detections: number of detections.
        seconds: processor time of the detection [s].
    """

    family: str
    seen: tuple[Seen, ...]
    false: int
    detections: int
    seconds: float


def run_frame(family: str, seed: int, *, noise: DepthNoise, height: int = 120) -> Frame:
    """Detect the obstacles in an image of one scene, and compare them with the true obstacles."""
    scene = make_scene(family, seed)
    exact, noisy = images(scene, noise, height)
    arm = perception_arm()
    detector = ObstacleDetector(arm, surfaces=scene.fixtures, noise=noise)
    start = time.process_time()
    found = detector.detect(noisy, arm.home)
    seconds = time.process_time() - start
    pixels = [_pixels(obstacle, exact) for obstacle in scene.obstacles]
    own = _assigned(scene.obstacles, found)
    seen = tuple(
        _compare(obstacle, found, own.get(i), scene.obstacles, (family, scene.distance, i == 0, pixels[i]))
        for i, obstacle in enumerate(scene.obstacles)
        if pixels[i] >= LEAST_VISIBLE
    )
    false = sum(_distance(detection.obstacle, scene.obstacles) > _FAR for detection in found)
    return Frame(family, seen, false, len(found), seconds)


def run_frames(
    count: int,
    first: int = 0,
    *,
    families: Sequence[str] = FAMILIES,
    noise: DepthNoise | None = None,
    height: int = 120,
    on_done: Callable[[int, int], object] = lambda _done, _of: None,
) -> list[Frame]:
    """Evaluate ``count`` scenes of each family.

    Args:
        count: number of scenes of each family.
        first: first seed.
        families: families of scenes.
        noise: noise of the camera; None: the noise of a Kinect.
        height: number of rows of each image.
        on_done: function that is called after each scene, with the number of evaluated scenes and the number of all
            scenes.
    """
    count = whole_number(count, "count", at_least=1)
    noise = DepthNoise() if noise is None else noise
    frames = []
    for family in families:
        for seed in range(first, first + count):
            frames.append(run_frame(family, seed, noise=noise, height=height))
            on_done(len(frames), count * len(families))
    return frames


def _pixels(obstacle: Obstacle, exact: DepthFrame) -> int:
    """Return how many pixels show an obstacle."""
    return int((np.abs(obstacle.signed_distance(exact.points())) < 1e-4).sum())


def _assigned(obstacles: Sequence[Obstacle], found: Sequence[Detection]) -> dict[int, Detection]:
    """Return the detection of each obstacle: the pairs with the smallest sum of the distances of their positions."""
    if not obstacles or not found:
        return {}
    cost = np.array([[np.linalg.norm(_center(o) - d.position) for d in found] for o in obstacles])
    return {int(i): found[j] for i, j in zip(*linear_sum_assignment(cost), strict=True)}


def _compare(
    obstacle: Obstacle,
    found: Sequence[Detection],
    own: Detection | None,
    every: Sequence[Obstacle],
    facts: tuple[str, float, bool, int],
) -> Seen:
    family, distance, first, pixels = facts
    shape = obstacle.kind.replace("_", " ")
    surface, inside = _samples(obstacle)
    covered = np.zeros(len(inside), dtype=bool)
    apart = np.full(len(surface), np.inf)
    for detection in found:
        covered |= detection.obstacle.signed_distance(inside) <= 0.0
        apart = np.minimum(apart, detection.obstacle.signed_distance(surface))
    uncovered = float(1.0 - covered.mean())
    sticks_out = max(float(apart.max()), 0.0)
    if own is None or uncovered > 1.0 - _COVERED:
        no = np.nan
        return Seen(family, shape, distance, first, pixels, uncovered, sticks_out, no, no, no, no, False)
    error = own.position - _center(obstacle)
    beyond = np.min([o.signed_distance(_samples(own.obstacle)[0]) for o in every], axis=0)
    sizes = np.sort(_extents(own.obstacle)) - np.sort(_extents(obstacle))
    return Seen(
        family,
        shape,
        distance,
        first,
        pixels,
        uncovered,
        sticks_out,
        max(float(beyond.max()), 0.0),
        float(np.linalg.norm(error)),
        float(np.abs(sizes).mean()),
        float(error @ np.linalg.solve(own.covariance, error)),
        own.obstacle.kind == obstacle.kind,
    )


def _center(obstacle: Obstacle) -> Array:
    """Return the middle of an obstacle: for a hull, the mean of points of its volume."""
    return _samples(obstacle)[1].mean(axis=0) if obstacle.kind in ("convex_hull", "cone") else obstacle.solid().position


def _samples(obstacle: Obstacle) -> tuple[Array, Array]:
    """Return points of the surface and of the volume, both (n, 3) [m]."""
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(_SAMPLES, 3))
    low, high = obstacle.bounds()
    points = rng.uniform(low, high, (8 * _SAMPLES, 3))
    inside = points[obstacle.signed_distance(points) <= 0.0][:_SAMPLES]
    return obstacle.support(directions), inside


def _extents(obstacle: Obstacle) -> Array:
    """Return the lengths of an obstacle along the principal axes of its volume, shape (3,) [m]."""
    inside = _samples(obstacle)[1]
    axes = np.linalg.eigh(np.cov(inside.T))[1].T
    return np.array([(obstacle.support(axis) - obstacle.support(-axis)) @ axis for axis in axes])


def _distance(obstacle: Obstacle, others: Iterable[Obstacle]) -> float:
    """Return the smallest distance between sample points of an obstacle and the obstacles ``others`` [m]."""
    points = np.concatenate(_samples(obstacle))
    return min((float(other.signed_distance(points).min()) for other in others), default=np.inf)


def tables(frames: Sequence[Frame]) -> list[Table]:
    """Return the tables of the benchmark: quality by family, by shape and by distance, and processor times."""
    seen = [one for frame in frames for one in frame.seen]
    families = [family for family in FAMILIES if any(frame.family == family for frame in frames)]
    by_family = [
        (
            f"{family}: {'the object' if first else 'the other object'}",
            [o for o in seen if o.family == family and o.first == first],
        )
        for family in families
        for first in (True, False)
    ]
    single = [one for one in seen if one.family == FAMILIES[0]]
    by_shape = [(shape, [one for one in single if one.shape == shape]) for shape in SHAPES]
    by_distance = [(f"{d:g} m", [one for one in single if one.distance == d]) for d in DISTANCES]
    false = [(family, [frame for frame in frames if frame.family == family]) for family in families]
    return [
        _quality("Obstacles found, by family of scenes", "family", by_family, _NOTE),
        _quality("One object, by shape", "shape", by_shape),
        _quality("One object, by distance of the camera", "distance", by_distance),
        Table(
            "False detections and processor time",
            (
                "family",
                "images>",
                "detections>",
                "false>",
                "time, median [ms]>",
                "time, 99th percentile [ms]>",
                "images/s>",
            ),
            tuple(_cost(family, own) for family, own in false if own),
            "A detection is false if it is farther than 5 cm from every obstacle. Time: processor time of one thread "
            "for one image. Images/s: inverse of the mean time.",
        ),
    ]


_NOTE = (
    f"The tables count obstacles that cover at least {LEAST_VISIBLE} pixels of the image. Missed: less than a fifth "
    "of the obstacle's volume lies inside the detections. Merged: the detector merged the obstacle with another "
    "obstacle into one detection. Uncovered: mean fraction of the volume that lies outside every detection. Obstacle "
    "outside the detections: largest distance from a point of the obstacle's surface to the nearest detection. "
    "Detection outside the obstacles: largest distance from a point of the detection's surface to the nearest "
    "obstacle. In the 95 % region: fraction of the position errors that lie in the 95 % region of the estimated "
    "covariance."
)


def _quality(title: str, what: str, groups: Iterable[tuple[str, list[Seen]]], note: str = "") -> Table:
    columns = (
        what,
        "n>",
        "missed>",
        "merged>",
        "position error, median [mm]>",
        "position error, 95th percentile [mm]>",
        "size error, median [mm]>",
        "uncovered [%]>",
        "obstacle outside the detections, median [mm]>",
        "obstacle outside the detections, 95th percentile [mm]>",
        "detection outside the obstacles, median [mm]>",
        "same shape [%]>",
        "in the 95 % region>",
    )
    return Table(title, columns, tuple(_row(name, group) for name, group in groups if group), note)


def _row(name: str, group: list[Seen]) -> tuple[str, ...]:
    found = [one for one in group if not one.missed]
    own = [one for one in found if not one.merged]

    def quantile(values: list[float], q: float) -> str:
        return f"{1e3 * float(np.quantile(values, q)):.0f}" if values else "-"

    errors, out = [one.error for one in own], [one.sticks_out for one in found]
    return (
        name,
        str(len(group)),
        str(len(group) - len(found)),
        str(len(found) - len(own)),
        quantile(errors, 0.5),
        quantile(errors, 0.95),
        quantile([one.size_error for one in own], 0.5),
        f"{100.0 * float(np.mean([one.uncovered for one in found])):.1f}" if found else "-",
        quantile(out, 0.5),
        quantile(out, 0.95),
        quantile([one.excess for one in own], 0.5),
        f"{100.0 * float(np.mean([one.right_shape for one in own])):.0f}" if own else "-",
        f"{100.0 * float(np.mean([one.normalised <= _CHI_SQUARE_95 for one in own])):.0f} %" if own else "-",
    )


def _cost(family: str, frames: list[Frame]) -> tuple[str, ...]:
    seconds = [frame.seconds for frame in frames]
    return (
        family,
        str(len(frames)),
        str(sum(frame.detections for frame in frames)),
        str(sum(frame.false for frame in frames)),
        f"{1e3 * float(np.median(seconds)):.1f}",
        f"{1e3 * float(np.quantile(seconds, 0.99)):.1f}",
        f"{1.0 / max(float(np.mean(seconds)), 1e-9):.0f}",
    )
