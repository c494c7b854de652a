"""Learn a skill from recordings, save and load it, and generate a motion to another goal.

The package contains the recordings. In each of the eight recordings, a simulated teacher guides a simulated Sawyer,
which sweeps crumbs into a dustpan with a brush. You can use recordings of your own robot instead;
`docs/demonstrations.md` lists the file formats.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from imitarm import Demonstration, Skill, Trajectory, align, lint, read
from imitarm.tasks import DEMONSTRATIONS


def main() -> None:
    # Read a folder, a file or several files; the content determines the format.
    shown = read(DEMONSTRATIONS)
    for one in shown:
        motion = one.trajectory
        print(f"{Path(one.source).name}: {len(one)} poses, {motion.duration:.1f} s, {motion.path_length:.2f} m")

    # Check before learning. Notes are for information, warnings should be inspected, errors spoil the result.
    print("\nlint says:")
    for finding in lint(shown):
        print(f"  {finding.severity} {finding.code}: {finding.message}")

    # The findings for a recording in which the tool jumps by 8 cm between two samples:
    positions = np.array(shown[0].trajectory.positions)
    positions[150:] += [0.0, 0.08, 0.0]
    damaged = Demonstration(Trajectory(shown[0].trajectory.times, positions), source="damaged.csv")
    for finding in lint([damaged]):
        if finding.severity == "error":
            print(f"  {finding}")

    # Align. People never repeat a motion at exactly the same speed; averaging at equal times would flatten every bend.
    ready = align(shown)
    before = np.ptp([one.trajectory.duration for one in shown])
    print(
        f"\nafter alignment, every recording takes {ready[0].trajectory.duration:.1f} s; "
        f"before, the durations differed by {before:.1f} s"
    )

    # Learn. The number of Gaussians is the smallest that reproduces a demonstration it has not seen as well as any and
    # rounds off little (bias); where none does both, the one with the least held-out error. BIC alone would go on
    # falling with more of them, because neighbouring samples are not independent.
    skill = Skill().fit(ready)
    print("\nnumber of components, held-out error [mm], bias [mm], BIC")
    for tried in skill.gmr_.selection_:
        mark = "  <- chosen" if tried.n_components == skill.gmr_.n_components_ else ""
        errors = f"{tried.held_out_rmse_mm:6.2f}  {tried.bias_rmse_mm:6.2f}"
        print(f"  {tried.n_components:2d}  {errors}  {tried.bic:7.0f}{mark}")
    print(skill)

    # The required precision: the robot must be as precise as the person was, so the covariance is the tolerance.
    times = np.linspace(0.0, skill.duration_, 6)
    spread = 1e3 * np.sqrt(np.trace(skill.tolerance(times), axis1=1, axis2=2))
    print(
        "\ntolerance along the motion:", ", ".join(f"{t:.1f} s: {s:.0f} mm" for t, s in zip(times, spread, strict=True))
    )

    # Save and load. The file is JSON that a person can read; nothing in it is executed, and a cut or edited one is
    # refused.
    path = Path("sweep.json")
    skill.save(path)
    again = Skill.load(path)
    np.testing.assert_array_equal(again.generate().positions, skill.generate().positions)
    print(
        f"\nsaved and loaded {path}, {path.stat().st_size / 1000:.0f} kB; the loaded skill gives exactly the same "
        f"motion"
    )

    # Move to another goal, in half the time.
    goal = again.goal_.position + np.array([0.0, 0.06, 0.0])
    motion = again.generate(goal=goal, duration=0.5 * again.duration_, dt=0.01)
    away = 1e3 * np.linalg.norm(motion.positions[-1] - goal)
    print(
        f"motion to a goal 6 cm farther away: {motion.duration:.2f} s, {len(motion)} poses, ends {away:.2f} mm "
        f"from the goal"
    )


if __name__ == "__main__":
    main()
