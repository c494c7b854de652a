"""Count the source files that are executed by one job: how many a reader has to open to follow it.

``python tests/executed_files.py`` prints them for an inverse-kinematics solve, an adaptation, and the whole job from
reading a file to a reproduced motion. Files whose functions are called count; files that are only imported do not: the
body of a module or of a class is no function.
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
LIMITS = {"one IK solve": 5, "one adaptation": 9, "from a file to a reproduced motion": 30}


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
    """Return the three jobs; whatever only prepares them has been done."""
    arm = ArmModel.load("sawyer", tool="brush")
    skill = Skill(8).fit(align(read(DEMONSTRATIONS)))
    path = skill.generate().positions
    middle = path[len(path) // 2]
    scene, decomposed = Scene(None, [Sphere(middle, 0.04)]), ComponentPath.of_skill(skill)
    spheres = [[0.0, 0.0, 0.0, 0.02]]

    def motion() -> None:
        demonstrations = read(DEMONSTRATIONS)
        lint(demonstrations)
        learned = Skill(8).fit(align(demonstrations))
        robot = SimulatedRobot(arm, scene=scene, q=find_posture(arm, learned.start_))
        policy = ACFRA(learned, tool_spheres=spheres)
        reproduce(policy, robot, scene.at, timeout=0.5, safety=SafetyFilter(arm, clearance=0.02))

    return {
        "one IK solve": lambda: solve_ik(arm, arm.home, TwistTask(np.full(6, 0.01)), velocity=np.zeros(7)),
        "one adaptation": lambda: adapt(decomposed, scene, tool_spheres=spheres),
        "from a file to a reproduced motion": motion,
    }


def main() -> int:
    """Print the files of each job; return 1 when there are more than intended."""
    status = 0
    for name, job in jobs().items():
        files = executed(job)
        print(f"{name}: {len(files)} files, at most {LIMITS[name]} intended")
        print(*(f"  {file}" for file in files), sep="\n")
        status |= len(files) > LIMITS[name]
    return status


if __name__ == "__main__":
    raise SystemExit(main())
