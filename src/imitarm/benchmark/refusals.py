"""``imitarm benchmark refusals``: plan paths with ``adapt`` in random scenes, and check the paths and the refusals.

Some scenes have no solution. The obstacles, the tool, the required clearance, the forbidden directions and the number
of samples are all random. The scenes therefore include unusual cases. An independent oracle
(:mod:`imitarm.benchmark.refusal_oracle`) decides whether a path exists.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from imitarm.benchmark.avoidance import learn
from imitarm.benchmark.refusal_oracle import answer, is_solved
from imitarm.benchmark.refusal_proof import Answer
from imitarm.benchmark.refusal_question import Question, separation
from imitarm.benchmark.static_scenes import StaticCase
from imitarm.benchmark.tables import Table
from imitarm.demonstrations import align, read
from imitarm.evaluation.intervals import wilson_interval
from imitarm.kinematics.pose import Pose, quaternion_exp, quaternion_to_matrix
from imitarm.policies.adaptation import HORIZONTAL_ONLY, NOT_DOWN, adapt
from imitarm.policies.adapted_path import Adaptation
from imitarm.policies.component_path import ComponentPath
from imitarm.scene import Box, Capsule, Cone, ConvexHull, Cylinder, Ellipsoid, Obstacle, Scene, Sphere
from imitarm.skills.skill import Skill
from imitarm.tasks import DEMONSTRATIONS

Array = NDArray[np.float64]

_ROUNDING = 1e-9  # [m]
_COLUMNS = ("scenes", "accepted>", "violations>", "oracle solves>", "refused>", "right>", "wrong>", "undecided>")


# The scenes


@dataclass(frozen=True, eq=False)
class RandomScene:
    """One random scene: all arguments of :func:`imitarm.policies.adapt` except the skill.

    Attributes:
        seed: number of the scene.
        family: name of the rule that placed the obstacles.
        scene: obstacles, some of which may move.
        tool_spheres: spheres that cover the tool, rows x y z radius in the tool's frame, shape (m, 4) [m].
        clearance: required clearance [m].
        forbidden: directions in which the path must not be displaced, shape (m, 3).
        pinned: times at which the path must not move [s].
        n_samples: number of samples along the path.
    """

    seed: int
    family: str
    scene: Scene
    tool_spheres: Array
    clearance: float
    forbidden: tuple[tuple[float, float, float], ...]
    pinned: tuple[float, ...]
    n_samples: int


RANDOM_FAMILIES = ("on the path", "cluster", "gap", "near an end", "huge", "thin", "enclosing", "moving")


def random_scene(seed: int, path: Array, duration: float, *, rotates: bool) -> RandomScene:
    """Make a random scene, which may have no solution.

    Args:
        seed: number of the scene.
        path: nominal path, shape (n, 3) [m].
        duration: time in which the tool follows the path [s].
        rotates: whether the skill rotates the tool. If False, the centres of all spheres of the tool are at the tip.
    """
    rng = np.random.default_rng([31, seed])
    family = RANDOM_FAMILIES[int(rng.choice(len(RANDOM_FAMILIES), p=[0.1, 0.1, 0.3, 0.12, 0.06, 0.06, 0.16, 0.1]))]
    planar = rng.random() < (0.8 if family == "gap" else 0.45)
    forbidden = HORIZONTAL_ONLY if planar else NOT_DOWN if rng.random() < 0.3 else ()
    kind = rng.random()
    if kind < 0.4:
        spheres = np.array([[0.0, 0.0, 0.0, 0.0 if kind < 0.2 else 0.005]])
    elif kind < 0.7 or not rotates:
        spheres = np.array([[0.0, 0.0, 0.0, rng.uniform(0.01, 0.05)]])
    else:
        direction = rng.normal(size=3)
        direction *= rng.uniform(0.04, 0.12) / np.linalg.norm(direction)
        along = np.linspace(0.0, 1.0, int(rng.integers(2, 5)))
        spheres = np.column_stack([along[:, None] * direction, np.full(len(along), rng.uniform(0.005, 0.025))])
    clearance = float(rng.choice([0.0, 0.001, 0.005, 0.02]))
    reach = float(np.max(np.linalg.norm(spheres[:, :3], axis=1) + spheres[:, 3])) + clearance
    may_cover = rng.random() < 0.1
    ends = path[[0, -1]]
    for _ in range(30):
        obstacles = _MAKERS[family](rng, path, duration, planar, reach)
        if family != "moving" and rng.random() < 0.15:
            obstacles += _on_the_path(rng, path, duration, planar, reach)[:1]
        at_ends = [(o.signed_distance(ends[0]), o.after(duration).signed_distance(ends[1])) for o in obstacles]
        if may_cover or np.min(at_ends) > reach:
            break
    pinned = (float(rng.uniform(0.2, 0.8) * duration),) if rng.random() < 0.1 else ()
    n_samples = 50 if rng.random() < 0.15 else 200
    return RandomScene(seed, family, Scene(None, obstacles), spheres, clearance, forbidden, pinned, n_samples)


def _any_obstacle(rng: np.random.Generator, centre: Array, planar: bool, scale: float = 1.0) -> Obstacle:
    """Make an obstacle of any shape, ``scale`` times 2 to 10 cm in size; in a planar scene, it stands upright."""
    pose = Pose(centre, quaternion_exp(_rotation(rng, planar)))
    half = scale * rng.uniform(0.012, 0.05, size=3)
    along = pose.rotation[:, 0] * half[0]
    radius = scale * rng.uniform(0.015, 0.05)
    return (
        lambda: Sphere(centre, radius),
        lambda: Box(pose, 2.0 * half),
        lambda: Capsule(centre - along, centre + along, 0.6 * radius),
        lambda: Cylinder(pose, radius, 4.0 * half[2]),
        lambda: Cone(pose, radius, 4.0 * half[2]),
        lambda: Ellipsoid(pose, half),
        lambda: ConvexHull(centre + scale * rng.normal(size=(12, 3)) * 0.025),
    )[int(rng.integers(7))]()


def _rotation(rng: np.random.Generator, planar: bool) -> Array:
    return np.array([0.0, 0.0, rng.uniform(-np.pi, np.pi)]) if planar else rng.normal(size=3)


def _inner_point(rng: np.random.Generator, path: Array, spread: float, first: float = 0.12) -> Array:
    last = len(path) - 1
    point = path[int(rng.uniform(first * last, (1.0 - first) * last))]
    return np.asarray(point + spread * rng.normal(size=3))


def _heading(rng: np.random.Generator, path: Array) -> tuple[int, Array]:
    """Return a sample in the middle of the path, and the unit direction of motion there."""
    at = int(rng.uniform(0.25, 0.75) * len(path))
    ahead = path[min(at + 5, len(path) - 1)] - path[at - 5]
    return at, ahead / max(float(np.linalg.norm(ahead)), 1e-9)


def _on_the_path(
    rng: np.random.Generator, path: Array, duration: float, planar: bool, reach: float
) -> tuple[Obstacle, ...]:
    return tuple(_any_obstacle(rng, _inner_point(rng, path, 0.015), planar) for _ in range(int(rng.integers(1, 5))))


def _cluster(
    rng: np.random.Generator, path: Array, duration: float, planar: bool, reach: float
) -> tuple[Obstacle, ...]:
    centre = _inner_point(rng, path, 0.02)
    return tuple(
        _any_obstacle(rng, centre + 0.05 * rng.normal(size=3), planar, 1.4) for _ in range(int(rng.integers(3, 8)))
    )


def _gap(rng: np.random.Generator, path: Array, duration: float, planar: bool, reach: float) -> tuple[Obstacle, ...]:
    """Two long walls across the path with a gap between them, which may be too narrow."""
    at, _ = _heading(rng, path)
    ahead = path[min(at + 5, len(path) - 1)] - path[at - 5]
    yaw = np.array([0.0, 0.0, np.arctan2(ahead[1], ahead[0])])
    across = quaternion_to_matrix(quaternion_exp(yaw))[:, 1]
    width = 2.0 * reach + rng.uniform(-0.04, 0.03)
    centre = path[at] + rng.uniform(-0.06, 0.06) * across
    thick, high = rng.uniform(0.004, 0.06), rng.choice([0.15, 1.6], p=[0.2, 0.8])
    return tuple(
        Box(Pose(centre + side * 0.5 * (width + 2.0) * across, quaternion_exp(yaw)), np.array([thick, 2.0, high]))
        for side in (1.0, -1.0)
    )


def _near_an_end(
    rng: np.random.Generator, path: Array, duration: float, planar: bool, reach: float
) -> tuple[Obstacle, ...]:
    """An obstacle near the start or the goal, at little more than the required clearance."""
    forward = bool(rng.random() < 0.5)
    end, inward = (path[0], path[len(path) // 9] - path[0]) if forward else (path[-1], path[-len(path) // 9] - path[-1])
    direction = inward / np.linalg.norm(inward) + rng.choice([0.1, 0.5]) * rng.normal(size=3)
    direction /= np.linalg.norm(direction)
    gap = reach + 10 ** rng.uniform(-5, -1.5)
    state = rng.bit_generator.state
    there = _any_obstacle(rng, np.zeros(3), planar)
    away = float(there.support(-direction) @ -direction) + gap
    rng.bit_generator.state = state  # the same obstacle again, now where it leaves that gap
    return (_any_obstacle(rng, end + away * direction, planar),)


def _huge(rng: np.random.Generator, path: Array, duration: float, planar: bool, reach: float) -> tuple[Obstacle, ...]:
    return (_any_obstacle(rng, _inner_point(rng, path, 0.05, 0.3), planar, rng.uniform(3.0, 9.0)),)


def _thin(rng: np.random.Generator, path: Array, duration: float, planar: bool, reach: float) -> tuple[Obstacle, ...]:
    """Plates and rods that are one or two millimetres thick."""
    made: list[Obstacle] = []
    for _ in range(int(rng.integers(1, 4))):
        pose = Pose(_inner_point(rng, path, 0.02), quaternion_exp(_rotation(rng, planar)))
        size = np.array([0.002, rng.uniform(0.02, 0.3), rng.uniform(0.02, 0.3)])
        made.append(Box(pose, size) if rng.random() < 0.5 else Cylinder(pose, 0.0015, float(size[1])))
    return tuple(made)


def _enclosing(
    rng: np.random.Generator, path: Array, duration: float, planar: bool, reach: float
) -> tuple[Obstacle, ...]:
    """Walls on several sides of a point of the path, as in a shelf or a box, sometimes without any opening."""
    at, ahead = _heading(rng, path)
    at = int(rng.choice([0, at, len(path) - 1]))
    yaw = np.array([0.0, 0.0, np.arctan2(ahead[1], ahead[0])])
    frame = quaternion_to_matrix(quaternion_exp(yaw))
    half, thick = rng.uniform(0.08, 0.3), rng.uniform(0.01, 0.05)
    made = []
    for axis, side in ((0, 1.0), (0, -1.0), (1, 1.0), (1, -1.0), (2, 1.0), (2, -1.0)):
        if rng.random() < 0.93:
            size = np.full(3, 2.0 * half)
            size[axis] = thick
            made.append(Box(Pose(path[at] + side * half * frame[:, axis], quaternion_exp(yaw)), size))
    return tuple(made) or _on_the_path(rng, path, duration, planar, reach)


def _moving(rng: np.random.Generator, path: Array, duration: float, planar: bool, reach: float) -> tuple[Obstacle, ...]:
    """Obstacles that cross the path at 0.1 to 0.6 m/s, each at about the time when the tool is at the crossing."""
    made = []
    for _ in range(int(rng.integers(1, 4))):
        at = int(rng.uniform(0.15, 0.85) * (len(path) - 1))
        velocity = rng.normal(size=3) * ([1.0, 1.0, 0.2] if planar else 1.0)
        velocity *= rng.uniform(0.1, 0.6) / np.linalg.norm(velocity)
        when = at / (len(path) - 1) * duration
        obstacle = _any_obstacle(rng, path[at] + 0.02 * rng.normal(size=3) - when * velocity, planar)
        made.append(replace(obstacle, velocity=velocity))
    return tuple(made)


_MAKERS = {
    "on the path": _on_the_path,
    "cluster": _cluster,
    "gap": _gap,
    "near an end": _near_an_end,
    "huge": _huge,
    "thin": _thin,
    "enclosing": _enclosing,
    "moving": _moving,
}


# The experiment


@dataclass(frozen=True)
class Verdict:
    """Result of ``adapt`` and of the oracle in one scene.

    Attributes:
        seed: number of the scene.
        family: name of the rule that placed the obstacles of the scene.
        accepted: whether ``adapt`` returned a path that can be executed.
        margin: proven lower bound of the path's clearance, minus the required clearance [m]; nan if ``adapt`` refused.
        oracle: the oracle's answer to the question whether a path exists. If ``accepted`` is True, the oracle only
            searches for a path, so the answer is "possible" or "undecided".
        seconds: computing time of ``adapt`` [s].
    """

    seed: int
    family: str
    accepted: bool
    margin: float
    oracle: Answer
    seconds: float

    @property
    def is_violation(self) -> bool:
        """Whether an accepted path comes closer to an obstacle than required."""
        return self.accepted and self.margin < -_ROUNDING


def skills_to_adapt(files: Sequence[Path] = ()) -> list[Skill]:
    """Return the skills of the benchmark: an S-shaped reach, the packaged sweep, and the skills in ``files``."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of one demonstration or of an axis that does not move: no matter here
        packaged = Skill(n_components=12).fit(align(read(DEMONSTRATIONS)))
    return [learn(planar=False)[0], packaged, *map(Skill.load, files)]


def scene_for(skill: Skill, seed: int) -> RandomScene:
    """Return the random scene with number ``seed`` around the path of a skill."""
    path = skill.gmr_.trajectory(400).positions
    return random_scene(seed, path, skill.duration_, rotates=skill.gmr_.has_orientation_)


def question_of(skill: Skill, case: RandomScene | StaticCase) -> Question:
    """Return a scene and a skill as a question for the oracle."""
    path = ComponentPath.of_skill(skill, n_samples=case.n_samples, pinned=case.pinned)
    forbidden = np.array(case.forbidden, dtype=float).reshape(-1, 3)
    return Question(
        path.nominal,
        path.basis,
        case.scene.obstacles,
        case.tool_spheres,
        case.clearance,
        forbidden,
        path.fixed_times,
    )


def adapted(skill: Skill, case: RandomScene | StaticCase) -> Adaptation:
    """Adapt the path of a skill to a scene."""
    return adapt(
        skill,
        case.scene,
        tool_spheres=case.tool_spheres,
        clearance=case.clearance,
        forbidden=case.forbidden,
        pinned=case.pinned,
        n_samples=case.n_samples,
    )


def evaluate_scene(skill: Skill, seed: int) -> Verdict:
    """Adapt a skill to one random scene, and check the path or the refusal."""
    case = scene_for(skill, seed)
    adaptation = adapted(skill, case)
    question = question_of(skill, case)
    margin = np.nan
    if adaptation.feasible:
        margin = separation(question, adaptation.trajectory.times, adaptation.trajectory.positions)
        oracle = Answer.POSSIBLE if is_solved(question) else Answer.UNDECIDED
    else:
        oracle = answer(question)
    return Verdict(seed, case.family, adaptation.feasible, margin, oracle, adaptation.compute_time)


def refusal_table(
    n_scenes: int,
    first: int = 0,
    files: Sequence[Path] = (),
    on_done: Callable[[int, int], None] | None = None,
) -> tuple[Table, list[Verdict]]:
    """Adapt skills to random scenes, and count the results. Successive scenes use the skills in turn.

    Args:
        n_scenes: number of scenes.
        first: seed of the first scene.
        files: skill files that are used in addition to the two skills of the benchmark.
        on_done: function that is called after each scene, with the number of finished scenes and the number of all
            scenes.
    """
    skills = skills_to_adapt(files)
    verdicts = []
    for seed in range(first, first + n_scenes):
        verdicts.append(evaluate_scene(skills[seed % len(skills)], seed))
        if on_done is not None:
            on_done(len(verdicts), n_scenes)
    rows = [_row(family, [v for v in verdicts if v.family == family]) for family in RANDOM_FAMILIES]
    rows.append(_row("all", verdicts))
    return Table(f"{n_scenes} random scenes", _COLUMNS, tuple(rows), _note(verdicts)), verdicts


def _row(name: str, verdicts: Sequence[Verdict]) -> tuple[str, ...]:
    accepted = [v for v in verdicts if v.accepted]
    refused = [v for v in verdicts if not v.accepted]
    solved = sum(v.oracle is Answer.POSSIBLE for v in accepted)
    counts = [sum(v.oracle is kind for v in refused) for kind in (Answer.IMPOSSIBLE, Answer.POSSIBLE, Answer.UNDECIDED)]
    violations = sum(v.is_violation for v in verdicts)
    return (name, *map(str, (len(accepted), violations, solved, len(refused), *counts)))


def _note(verdicts: Sequence[Verdict]) -> str:
    accepted = [v for v in verdicts if v.accepted]
    refused = [v for v in verdicts if not v.accepted]
    parts = []
    if accepted:
        solved = sum(v.oracle is Answer.POSSIBLE for v in accepted)
        margin = 1e6 * min(v.margin for v in accepted)
        parts.append(f"The clearance of each accepted path exceeds the required clearance by at least {margin:.2f} µm.")
        parts.append(f"The oracle solves {100 * solved / len(accepted):.1f} % of the accepted scenes.")
    if refused:
        right = sum(v.oracle is Answer.IMPOSSIBLE for v in refused)
        low, high = wilson_interval(right, len(refused))
        parts.append(
            f"{100 * right / len(refused):.1f} % of the refusals are right (95 % interval {100 * low:.1f} to "
            f"{100 * high:.1f} %; an undecided refusal counts as wrong)."
        )
    for name, group in (("accepted", accepted), ("refused", refused)):
        if group:
            seconds = np.median([v.seconds for v in group])
            parts.append(f"Median computing time of {name} scenes: {1e3 * seconds:.1f} ms.")
    return " ".join(parts)
