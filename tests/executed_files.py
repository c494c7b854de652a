"""Count the source files that are executed by one job: how many a reader has to open to follow it.

``python tests/executed_files.py`` prints them for five jobs: one solve of inverse kinematics, one adaptation, and three
jobs that begin with the recorded files. The first of these three ends with the motion that the skill generates. The
second also adapts this motion to an obstacle, and the third executes the adapted motion with a simulated arm. A file
counts if one of its functions is called. Code that is only executed by an import does not count.
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable
from pathlib import Path
from types import FrameType

import numpy as np

import imitarm
from imitarm import ACFRA, ArmModel, Scene, SimulatedRobot, Skill, Sphere, TwistTask, find_posture, solve_ik
from imitarm.control_loop import reproduce
from imitarm.demonstrations import align, lint, read
from imitarm.policies import adapt
from imitarm.policies.component_path import ComponentPath
from imitarm.safety import SafetyFilter
from imitarm.tasks.sweep import DEMONSTRATIONS

PACKAGE = Path(imitarm.__file__).parent
LIMITS: dict[str, int | None] = {
    "one IK solve": 5,
    "one adaptation": 9,
    "from a file to a reproduced motion": 30,
    "from a file to a motion adapted to an obstacle": 30,
    "from a file to a simulated arm behind the safety filter": None,
}


def executed(job: Callable[[], object]) -> list[str]:
    """Return the files of the package whose functions ``job`` calls."""
    found: set[str] = set()

    def note(frame: FrameType, event: str, _argument: object) -> None:
        if event == "call" and frame.f_code.co_flags & inspect.CO_OPTIMIZED:
            found.add(frame.f_code.co_filename)

    sys.setprofile(note)
    try:
        job()
    finally:
        sys.setprofile(None)
    paths = [Path(name) for name in found]
    return sorted(str(p.relative_to(PACKAGE)) for p in paths if p.is_relative_to(PACKAGE))


def jobs() -> dict[str, Callable[[], object]]:
    """Return the jobs; whatever only prepares them has been done."""
    arm = ArmModel.load("sawyer", tool="brush")
    skill = Skill(8).fit(align(read(DEMONSTRATIONS)))
    path = skill.generate().positions
    middle = path[len(path) // 2]
    scene, decomposed = Scene(None, [Sphere(middle, 0.04)]), ComponentPath.of_skill(skill)
    spheres = [[0.0, 0.0, 0.0, 0.02]]

    def learned() -> Skill:
        demonstrations = read(DEMONSTRATIONS)
        lint(demonstrations)
        return Skill(8).fit(align(demonstrations))

    def executed_motion() -> None:
        known = learned()
        robot = SimulatedRobot(arm, scene=scene, q=find_posture(arm, known.start_))
        policy = ACFRA(known, tool_spheres=spheres)
        reproduce(policy, robot, scene.at, timeout=0.5, safety=SafetyFilter(arm, clearance=0.02))

    tasks = [
        lambda: solve_ik(arm, arm.home, TwistTask(np.full(6, 0.01)), velocity=np.zeros(7)),
        lambda: adapt(decomposed, scene, tool_spheres=spheres),
        lambda: learned().generate(),
        lambda: adapt(learned(), scene, tool_spheres=spheres),
        executed_motion,
    ]
    return dict(zip(LIMITS, tasks, strict=True))


def main() -> int:
    """Print the files of each job; return 1 when there are more than intended."""
    status = 0
    for name, job in jobs().items():
        files = executed(job)
        limit = LIMITS[name]
        print(f"{name}: {len(files)} files" + ("" if limit is None else f", at most {limit} intended"))
        print(*(f"  {file}" for file in files), sep="\n")
        status |= limit is not None and len(files) > limit
    return status


if __name__ == "__main__":
    raise SystemExit(main())
