"""``imitarm benchmark refusals``: let ``adapt`` plan in random scenes, and check its paths and refusals.

An oracle, :mod:`imitarm.benchmark.refusal_oracle`, decides independently whether a path exists.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from imitarm.benchmark.avoidance import learn
from imitarm.benchmark.random_scenes import RANDOM_FAMILIES, RandomScene, random_scene
from imitarm.benchmark.refusal_oracle import Answer, answer, is_solved
from imitarm.benchmark.refusal_proof import Question, separation
from imitarm.benchmark.static_scenes import StaticCase
from imitarm.benchmark.tables import Table
from imitarm.demonstrations import align, read
from imitarm.evaluation.intervals import wilson_interval
from imitarm.policies.adaptation import adapt
from imitarm.policies.adapted_path import Adaptation
from imitarm.policies.component_path import ComponentPath
from imitarm.skills.skill import Skill
from imitarm.tasks import DEMONSTRATIONS

_ROUNDING = 1e-9  # [m]
_COLUMNS = ("scenes", "accepted>", "violations>", "oracle solves>", "refused>", "right>", "wrong>", "undecided>")


@dataclass(frozen=True)
class Verdict:
    """Result of one scene.

    Attributes:
        seed: number of the scene.
        family: name of the rule by which the obstacles of the scene were placed.
        accepted: whether the library found a feasible adaptation.
        margin: proven lower bound of the distance along an accepted path, minus required clearance [m]; nan if refused.
        oracle: the oracle's answer to the question whether a path exists. If ``accepted``, the answer is "possible" or
            "undecided", because the oracle then does not try to prove that no path exists.
        seconds: compute time of the adaptation [s].
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
    """Return the skills of the benchmark: an S-shaped reach, the packaged sweep, and skills from files."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of one demonstration or of an axis that does not move: no matter here
        packaged = Skill(n_components=12).fit(align(read(DEMONSTRATIONS)))
    return [learn(planar=False)[0], packaged, *map(Skill.load, files)]


def scene_for(skill: Skill, seed: int) -> RandomScene:
    """Return random scene ``seed`` around the path of a skill."""
    path = skill.gmr_.trajectory(400).positions
    return random_scene(seed, path, skill.duration_, rotates=skill.gmr_.has_orientation_)


def question_of(skill: Skill, case: RandomScene | StaticCase) -> Question:
    """Return a scene in the form that the oracle uses."""
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
    """Adapt a skill to a scene."""
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
    """Adapt a skill to one random scene, and check with the oracle whether the path or the refusal is right."""
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
    """Adapt the skills, one after the other, to random scenes, and count the results.

    Args:
        n_scenes: how many.
        first: seed of the first scene.
        files: skill files used in addition to the two packaged skills.
        on_done: function called with the number of finished scenes and the total number.
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
        parts.append(f"The clearance of each accepted path exceeds the required clearance by at least {margin:.2f} um.")
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
