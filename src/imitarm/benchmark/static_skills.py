"""Tables of the static benchmark by skill: skills of one or several teachers, and skills from files."""

from __future__ import annotations

from pathlib import Path

from imitarm.benchmark.static import StaticResult
from imitarm.benchmark.static_tables import (
    IMPOSSIBLE,
    ORACLE,
    POSSIBLE,
    StaticResults,
    is_success,
    mean,
    rate,
)
from imitarm.benchmark.tables import Table


def numbers_of_teachers(results: StaticResults) -> list[int]:
    """Return the numbers of teachers of the skills that were learned from synthetic teachers, in ascending order."""
    return sorted({scene[3] for scene in results.by_scene if not scene[4]})


def teachers_table(results: StaticResults) -> Table:
    """Return a table of success and deviation by the number of teachers."""
    numbers = numbers_of_teachers(results)
    common = common_seeds(results)
    rows = []
    for row in results.rows:
        cells = []
        for n in numbers:
            found = results.of(row, lambda s, n=n: s[3] == n and not s[4] and s[:3] in common)  # type: ignore[misc]
            good = [r for r in found if is_success(r)]
            cells += [rate(len(good), len(found)), mean([r.value("rmse") for r in good], 1e3)]
        rows.append((row, *cells))
    names = ["1 teacher" if n == 1 else f"{n} teachers" for n in numbers]
    columns = [c for name in names for c in (f"{name}: success % (95 %)>", f"{name}: RMSE [mm]>")]
    note = f"{len(common)} seeds, for which the scenes of every number of teachers have a solution."
    return Table("Number of teachers", ("method", *columns), tuple(rows), note)


def common_seeds(results: StaticResults) -> set[tuple[str, int, int]]:
    """Return family, dimension and seed of the scenes that have a solution with every number of teachers."""
    own = [s for s in results.by_scene if not s[4] and results.solvable(s)]
    return set.intersection(*({s[:3] for s in own if s[3] == n} for n in numbers_of_teachers(results)))


def skills_table(results: StaticResults) -> Table:
    """Return a table of success, refusals and deviation for each skill that comes from a file."""
    skills = sorted({scene[4] for scene in results.by_scene if scene[4]})
    rows = []
    for skill in skills:
        for row in results.rows:

            def having(answer: str, row: str = row, skill: str = skill) -> list[StaticResult]:
                return results.of(row, lambda s: s[4] == skill and results.answers[s] == answer)

            found, hard = having(POSSIBLE), having(IMPOSSIBLE)
            good = [r for r in found if is_success(r)]
            refused = [sum(r.outcome == "refused" for r in some) for some in (hard, found)]
            if found or hard:
                rows.append(
                    (
                        Path(skill).stem,
                        row,
                        str(len(found)),
                        rate(len(good), len(found)),
                        rate(sum(r.outcome == "success" for r in found), len(found)),
                        str(sum(r.outcome == "contact" for r in found)),
                        str(refused[1]),
                        f"{refused[0]} of {len(hard)}" if row != ORACLE else "–",
                        mean([r.value("rmse") for r in good], 1e3),
                        mean([r.value("deviation") for r in good]),
                    )
                )
    columns = (
        "skill",
        "method",
        "scenes with a solution>",
        "success % (95 %)>",
        "keeps the clearance % (95 %)>",
        "contact>",
        "refused>",
        "refused of the impossible scenes>",
        "RMSE of the successes [mm]>",
        "largest deviation [sigma]>",
    )
    note = (
        "Scenes on the paths of skills from files. The other tables leave out these scenes, unless there are no others."
    )
    return Table("Skills from files", columns, tuple(rows), note)
