"""Adapt a learned path to a scene with obstacles, by three methods and with forbidden directions.

`adapt` refuses some of the scenes.

No robot moves in this example: the function `adapt` only plans. It returns a path, and a lower bound of the clearance
along the path (the certified clearance). The example `03_reproduce_on_an_arm.py` lets a simulated robot execute such a
path.
"""

from __future__ import annotations

import numpy as np

from imitarm import HORIZONTAL_ONLY, NOT_DOWN, Adaptation, Box, Pose, Scene, Skill, Sphere, adapt, align, read
from imitarm.tasks import DEMONSTRATIONS, SweepTask

UPRIGHT = [1.0, 0.0, 0.0, 0.0]  # quaternions are w, x, y, z everywhere


def show(adaptation: Adaptation) -> None:
    verdict = "can be executed" if adaptation.feasible else "refused"
    print(
        f"  {adaptation.method:9s} {verdict}: {1e3 * adaptation.certified_clearance:.1f} mm certified clearance of "
        f"the path, "
        f"{int(adaptation.moved.sum())} of {len(adaptation.moved)} components moved, "
        f"{1e3 * adaptation.rmse_to_nominal:.0f} mm from the learned path on average (RMS)"
    )
    if adaptation.reason:
        print(f"            {adaptation.reason}")


def main() -> None:
    skill = Skill(n_components=12).fit(align(read(DEMONSTRATIONS)))
    task = SweepTask()
    # What every call below has in common. The brush is 55 mm about its tip; 20 mm is what we want between it and
    # anything else. The dirt must still be met, so the path does not move at that instant.
    dirt = task.dirt_time(skill.gmr_.trajectory(1000))
    options = {"tool_radius": task.tool_radius, "clearance": 0.02, "pinned": [dirt]}

    # Obstacles can have any pose, a name and a velocity; a scene without a goal keeps the learned goal.
    cup = Sphere([0.57, -0.28, 0.03], 0.04, name="cup")
    box = Box(Pose([0.66, 0.14, 0.05], UPRIGHT), [0.08, 0.05, 0.1], name="tin")
    scene = Scene(goal=None, obstacles=[cup, box])

    # The thesis pushes each component along its own normal ("literal", as printed; "mapf", corrected) and does not look
    # at the path between two of them. "certified" chooses a side, moves the components as little as possible, and
    # proves the clearance.
    print("a cup and a tin on the path; the brush must stay on the table:")
    for method in ("literal", "mapf", "certified"):
        show(adapt(skill, scene, method, forbidden=HORIZONTAL_ONLY, **options))

    # Only the parts near an obstacle move: the rest of the path is the same to the last bit.
    print("\nthe tin alone:")
    alone = adapt(skill, Scene(None, [box]), forbidden=HORIZONTAL_ONLY, **options)
    show(alone)
    same = np.all(alone.trajectory.positions == alone.nominal.positions, axis=1)
    print(f"  {same.sum()} of {len(same)} samples of the path are exactly on the learned path")

    # Forbidden directions determine how the path avoids an obstacle: above it, or beside it.
    print("\na low wall across the table:")
    wall = Scene(None, [Box(Pose([0.6, -0.28, 0.02], UPRIGHT), [1.2, 0.02, 0.04], name="low wall")])
    show(adapt(skill, wall, forbidden=HORIZONTAL_ONLY, **options))
    over = adapt(skill, wall, forbidden=NOT_DOWN, **options)
    show(over)
    print(f"  if the brush may be lifted, it rises by up to {1e2 * over.displacement[:, 2].max():.0f} cm")

    # A refusal names the obstacle and the reason; its path is the best attempt, which must not be executed.
    print("\na jar on the goal, then a jar on the dirt (both scenes are refused):")
    for place in (skill.goal_.position, task.dirt.position):
        jar = Sphere(place, 0.03, name="jar")
        show(adapt(skill, Scene(None, [jar]), forbidden=HORIZONTAL_ONLY, **options))

    # Another goal: the skill first adapts its path to the goal, and the components move with it.
    print("\nthe first scene (cup and tin), with the goal moved by 5 cm:")
    goal = Pose(skill.goal_.position + np.array([0.05, 0.0, 0.0]), skill.goal_.quaternion)
    moved = adapt(skill, Scene(goal, scene.obstacles), forbidden=HORIZONTAL_ONLY, **options)
    show(moved)
    print(f"  the path ends at {np.round(moved.trajectory.positions[-1], 3)} m")


if __name__ == "__main__":
    main()
