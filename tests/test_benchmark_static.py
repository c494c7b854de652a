from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest

from imitarm.benchmark import static_measures
from imitarm.benchmark.controls import AimsAtObstacle, NoAvoidance, middle
from imitarm.benchmark.result_lines import SUFFIX
from imitarm.benchmark.running import Workers, run_experiments
from imitarm.benchmark.static import RESULTS, StaticExperiment, build, method_names, run_experiment, torques_on_sawyer
from imitarm.benchmark.static_measures import (
    AT_GOAL,
    LATEST,
    MAX_ACCELERATION,
    MAX_SPEED,
    NEAR,
    OUTCOMES,
    measure,
    outcome,
)
from imitarm.benchmark.static_scenes import FAMILIES, SPLITS, static_case
from imitarm.errors import InfeasibleError, InputError, UnknownNameError
from imitarm.kinematics.pose import Pose
from imitarm.policies import POLICIES, PathPolicy
from imitarm.scene import Box, Scene, Sphere
from imitarm.trajectory import Trajectory

CLOCKS = {"build_seconds", "plan_seconds", "plan_cpu", "peak_memory"}
ONE = StaticExperiment("S1", 3, 1000, "acfra")


def without_clock(result):
    values = {name: value for name, value in result.values.items() if name not in CLOCKS}
    return json.dumps([result.outcome, result.reason, values])


def nominal(case, n=200):
    return case.skill.nominal(np.linspace(0.0, case.skill.duration_, n))


def in_scene(case, *obstacles):
    return replace(case, scene=Scene(None, obstacles))


@pytest.fixture(scope="module")
def case():
    return static_case("S1", 3, 1000)


# --- measures against closed forms -------------------------------------------------------------------------------


def test_the_learned_path_deviates_by_nothing(case):
    found = measure(case, nominal(case))
    for name in ("start_error", "goal_error", "contact_error", "forbidden", "rmse", "deviation"):
        assert getattr(found, name) == pytest.approx(0.0, abs=1e-12), name
    assert found.path_rmse < 1e-4  # the nearest of 4000 points
    assert found.length_ratio == pytest.approx(1.0)
    assert found.duration_ratio == pytest.approx(1.0)


def test_a_shifted_path_deviates_by_the_shift(case):
    shift = np.array([0.0, 0.003, 0.004])
    path = nominal(case)
    found = measure(case, path.with_positions(path.positions + shift))
    assert found.rmse == pytest.approx(0.005) == found.start_error == found.goal_error
    assert found.rmse_unaffected == pytest.approx(0.005)
    assert found.path_rmse <= 0.005 + 1e-9
    assert 0.0 < found.deviation <= 0.005 / 0.005 + 1e-9  # no standard deviation is below 5 mm


def test_a_slower_motion_on_the_same_path_has_the_same_deviation(case):
    path = nominal(case)
    slow = Trajectory(1.5 * path.times, path.positions)
    found, first = measure(case, slow), measure(case, path)
    assert found.rmse == pytest.approx(0.0, abs=1e-12)
    assert found.duration_ratio == pytest.approx(1.5)
    assert found.max_speed == pytest.approx(first.max_speed / 1.5, rel=1e-9)
    assert found.max_acceleration == pytest.approx(first.max_acceleration / 1.5**2, rel=1e-9)
    assert found.ldlj == pytest.approx(first.ldlj)


def test_a_plan_that_is_too_fast_is_executed_more_slowly(case):
    path = nominal(case)
    first = measure(case, path)
    assert first.slowdown == 1.0
    faster = 1.2 * (MAX_ACCELERATION / first.max_acceleration) ** 0.5
    found = measure(case, Trajectory(path.times / faster, path.positions))
    assert found.slowdown == pytest.approx(max(1.2, faster * first.max_speed / MAX_SPEED), rel=1e-6)
    assert found.duration == pytest.approx(found.slowdown * path.duration / faster, rel=1e-6)


def test_speed_and_acceleration_of_a_parabola(case):
    t = np.linspace(0.0, 2.0, 51)
    path = Trajectory(t, np.stack([0.3 * t**2, 0.0 * t, 0.4 * t**2], axis=1))
    found = measure(case, path)
    assert found.max_acceleration == pytest.approx(1.0, rel=1e-6)
    assert found.max_speed == pytest.approx(2.0, rel=0.01)


@pytest.mark.parametrize("gap", [0.04, 0.011, -0.02])
def test_the_clearance_is_the_true_distance_between_samples(case, gap):
    """A thin sphere beside the middle of a long segment, where the plan has no sample."""
    ends = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    path = Trajectory([0.0, 4.0], ends)
    radius, tool = 0.01, float(case.tool_spheres[0, 3])
    at = in_scene(case, Sphere([0.50003, gap + tool + radius, 0.0], radius))
    times = np.linspace(0.0, 4.0, static_measures.DENSE)
    assert static_measures.tool_clearance(at, Trajectory(times, path.at(times)[0])) == pytest.approx(gap, abs=1e-6)
    found = measure(at, Trajectory([0.0, 1.0, 4.0], [[0, 0, 0], [0.25, 0, 0], [1, 0, 0]]))
    assert found.clearance == pytest.approx(gap, abs=1e-6)
    assert found.separation == pytest.approx(gap, abs=1e-6)


def test_both_distances_agree_in_random_scenes():
    for family in FAMILIES:
        for dimension in (2, 3):
            case = static_case(family, dimension, 1001)
            for method in (NoAvoidance, AimsAtObstacle):
                plan = method.build(case.skill, forbidden=case.forbidden).plan_motion(case.scene)
                found = measure(case, plan.trajectory)
                assert found.separation <= found.clearance + 1e-9
                if found.clearance > 0.0:
                    assert found.separation == pytest.approx(found.clearance, abs=1e-5)


def test_a_rotated_tool_is_where_its_rotation_puts_it(case):
    spheres = np.array([[0.0, 0.0, 0.1, 0.01]])
    at = replace(in_scene(case, Sphere([0.5, 0.0, -0.2], 0.05)), tool_spheres=spheres)
    down = np.tile([0.0, 1.0, 0.0, 0.0], (2, 1))  # its z axis points down
    path = Trajectory([0.0, 4.0], [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], down)
    found = measure(at, path)
    assert found.clearance == pytest.approx(0.1 - 0.05 - 0.01, abs=1e-6) == found.separation


def test_unaffected_samples_follow_from_the_scene_alone(case):
    path = nominal(case)
    away = case.scene.clearance(path.positions) - case.tool_spheres[0, 3]
    assert (static_measures.unaffected(case, path) == (away > NEAR)).all()
    everywhere = in_scene(case, Box(Pose([0.3, 0.0, 0.3], [1.0, 0.0, 0.0, 0.0]), [2.0, 2.0, 2.0]))
    assert math.isnan(measure(everywhere, path).rmse_unaffected)


def test_displacement_in_a_forbidden_direction_is_found():
    case = static_case("S1", 2, 1000)
    path = nominal(case)
    up = path.with_positions(path.positions + np.array([0.0, 0.0, 0.02]))
    assert measure(case, up).forbidden == pytest.approx(0.02)
    aside = path.with_positions(path.positions + np.array([0.0, 0.02, 0.0]))
    assert measure(case, aside).forbidden == pytest.approx(0.0, abs=1e-12)


def test_samples_that_nearly_coincide_with_the_dense_times_are_measured():
    case = static_case("S1", 2, 1000)
    path = nominal(case)
    dense = np.linspace(path.times[0], path.times[-1], static_measures.DENSE)
    times = np.sort(np.append(path.times, np.nextafter(dense[100:3900:100], 10.0)))
    found = measure(case, Trajectory(times, path.at(times)[0]))
    assert found.forbidden == pytest.approx(0.0, abs=1e-9)


def test_a_missed_contact_point_is_found():
    case = next(c for seed in range(1000, 1050) if (c := static_case("S6", 3, seed)).pinned)
    free = in_scene(case)
    path = nominal(case)
    assert measure(free, path).contact_error < 1e-3
    sample = int(np.argmin(np.abs(path.times - case.pinned[0])))
    bump = np.exp(-(((np.arange(200) - sample) / 15.0) ** 2))[:, None] * np.array([0.0, 0.0, 0.05])
    found = measure(free, path.with_positions(path.positions + bump))
    assert found.contact_error > 0.02
    assert outcome(free, found)[0] == "missed goal"


def test_every_outcome_has_its_cause(case):
    good = replace(measure(in_scene(case), nominal(case)), clearance=0.03)
    cases = {
        "success": {},
        "too near": {"clearance": 0.5 * case.clearance},
        "contact": {"clearance": 0.0},
        "missed goal": {"goal_error": 1.01 * AT_GOAL},
        "late": {"duration_ratio": 1.01 * LATEST},
        "limit": {"duration_ratio": 1.01 * LATEST, "slowdown": 1.5},
    }
    for name, change in cases.items():
        assert outcome(case, replace(good, **change))[0] == name
    assert {*cases, "refused", "failed"} == set(OUTCOMES)


def test_torques_hold_at_least_the_weight_of_the_arm(case):
    found = torques_on_sawyer(nominal(case))
    assert 10.0 < found["torque_rms"] < 60.0
    assert 0.1 < found["torque_peak"] < 1.0
    far = nominal(case)
    far = far.with_positions(5.0 * far.positions)
    assert math.isnan(torques_on_sawyer(far)["torque_rms"])


# --- methods that check the benchmark: a benchmark that a toy can win is void -----------------------------------------


def test_a_method_that_aims_at_the_obstacle_never_succeeds_and_no_avoidance_hardly_ever():
    scenes = [(f, d, s) for f in FAMILIES for d in (2, 3) for s in range(1000, 1010)]
    aimed = [StaticExperiment(*scene, "aims-at-obstacle").run().outcome for scene in scenes]
    assert set(aimed) == {"contact"}
    solvable = [scene for scene in scenes if scene[0] != "S6"]  # of S6, every scene must be refused
    ignored = [StaticExperiment(*scene, "no-avoidance").run().outcome for scene in solvable]
    assert sum(o in static_measures.SUCCESSES for o in ignored) <= 0.02 * len(solvable)


def test_the_middle_of_an_obstacle_is_inside():
    for seed in range(1000, 1020):
        for obstacle in static_case("S3", 3, seed).scene.obstacles:
            assert obstacle.signed_distance(middle(obstacle)) < 0.0


def test_the_oracle_keeps_the_clearance_or_says_why_not():
    for family, seed in (("S1", 1000), ("S4", 1000), ("S6", 1001)):
        found = StaticExperiment(family, 2, seed, "oracle").run()
        if found.outcome == "refused":
            assert found.values["answer"] in {"impossible", "undecided"}
        else:
            assert found.outcome == "success"
            assert found.values["answer"] == "possible"
    refused = StaticExperiment("S6", 2, 1001, "oracle").run()
    assert (refused.outcome, refused.values["answer"]) == ("refused", "impossible")


class Raises(PathPolicy):
    def plan_motion(self, scene, start=None, state=None):
        raise ZeroDivisionError("by design")


class Refuses(PathPolicy):
    def plan_motion(self, scene, start=None, state=None):
        raise InfeasibleError("by design")


def test_an_error_is_a_failure_with_its_reason_and_a_refusal_is_not(monkeypatch):
    monkeypatch.setitem(POLICIES._loaded, "raises", Raises)
    POLICIES._places()["raises"] = POLICIES._places()["refuses"] = "registered"
    monkeypatch.setitem(POLICIES._loaded, "refuses", Refuses)
    try:
        found = replace(ONE, method="raises").run()
        assert (found.outcome, found.reason) == ("failed", "ZeroDivisionError: by design")
        found = replace(ONE, method="refuses").run()
        assert (found.outcome, found.reason) == ("refused", "by design")
        assert found.values["plan_seconds"] >= 0.0
    finally:
        del POLICIES._places()["raises"], POLICIES._places()["refuses"]


class Counts(NoAvoidance):
    plans = 0

    def plan_motion(self, scene, start=None, state=None):
        Counts.plans += 1
        return super().plan_motion(scene, start, state)


def test_a_method_plans_once_without_a_clock_for_each_skill(monkeypatch):
    monkeypatch.setitem(POLICIES._loaded, "counts", Counts)
    monkeypatch.setitem(POLICIES._places(), "counts", "registered")
    first = replace(ONE, method="counts")
    for experiment, plans in ((first, 2), (replace(first, seed=1001), 3), (replace(first, dimension=2), 5)):
        experiment.run()
        assert Counts.plans == plans


def test_options_reach_the_method_and_unknown_ones_are_refused():
    with pytest.raises(InputError, match="magic"):
        build("acfra", static_case("S1", 2, 1000), (("magic", 1.0),))
    literal = replace(ONE, options=(("method", "literal"),)).run()
    assert without_clock(literal) == without_clock(replace(ONE, method="acfra-literal").run())
    assert replace(ONE, memory=True).run().value("peak_memory") > 1e4


@pytest.mark.parametrize(
    "bad", [{"family": "S0"}, {"dimension": 4}, {"seed": -1}, {"teachers": 0}, {"method": "magic"}]
)
def test_what_is_no_experiment_is_refused(bad):
    with pytest.raises((InputError, UnknownNameError)):
        replace(ONE, **bad)


def test_all_methods_have_a_name():
    assert {"acfra", "oracle", "no-avoidance", "acfra-literal"} <= set(method_names())
    assert SPLITS["validation"][0] <= ONE.seed < SPLITS["validation"][1]  # no method is developed on test scenes


# --- saved results -----------------------------------------------------------------------------------------------


def test_a_result_is_read_as_it_was_written():
    for experiment in (ONE, StaticExperiment("S6", 2, 1001, "acfra", options=(("b", 2.0), ("a", "x")))):
        result = experiment.run()
        read = RESULTS.result(RESULTS.line(result))
        assert read.experiment == experiment
        assert RESULTS.line(read) == RESULTS.line(result)


def test_results_do_not_depend_on_the_workers(tmp_path):
    wanted = [replace(ONE, method=m, seed=s) for m in ("acfra", "acfra-mapf") for s in (1000, 1001, 1002)]
    alone = run_experiments(wanted, run_experiment, RESULTS.store(tmp_path / "a"), Workers(1))
    both = run_experiments(wanted, run_experiment, RESULTS.store(tmp_path / "b"), Workers(2))
    assert [r.experiment for r in both] == wanted
    assert [without_clock(r) for r in alone] == [without_clock(r) for r in both]
    assert {without_clock(r) for r in RESULTS.read_folders([tmp_path / "a", tmp_path / "b"])} == set(
        map(without_clock, both)
    )


def test_an_incomplete_line_is_run_again_and_no_other(tmp_path):
    wanted = [replace(ONE, seed=s) for s in (1000, 1001, 1002)]
    store = RESULTS.store(tmp_path)
    first = run_experiments(wanted, run_experiment, store, Workers(1))
    path = tmp_path / f"acfra{SUFFIX}"
    whole = path.read_bytes()
    for cut in (1, 2, len(whole.splitlines()[-1]) // 2):
        path.write_bytes(whole[:-cut])
        told = []
        again = run_experiments(wanted, run_experiment, store, Workers(1), on_done=lambda *n, t=told: t.append(n))
        assert told[0][0] == (3 if cut == 1 else 2)
        assert [without_clock(r) for r in again] == [without_clock(r) for r in first]
        assert len(RESULTS.read(path)) == 3
    path.write_bytes(whole.replace(b'"code":"', b'"code":"old '))
    assert not store.known(wanted)
    assert len(RESULTS.store(tmp_path, reuse=True).known(wanted)) == 3


def test_a_folder_that_cant_be_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="another folder"):
        RESULTS.store(tmp_path / "file" / "x")
    with pytest.raises(InputError, match="no such folder"):
        RESULTS.read_folders([tmp_path / "nowhere"])
    with pytest.raises(InputError, match="holds no results"):
        RESULTS.read_folders([tmp_path])


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="signals")
def test_a_run_that_is_killed_again_and_again_loses_nothing(tmp_path):
    """Kill at random instants; what was saved is kept, and the end is that of a run that was left alone."""
    script = (
        "import sys\n"
        "from imitarm.benchmark.running import Workers, run_experiments\n"
        "from imitarm.benchmark.static import RESULTS, StaticExperiment, run_experiment\n"
        "if __name__ == '__main__':\n"
        "    wanted = [StaticExperiment('S1', 2, s, 'acfra') for s in range(1000, 1150)]\n"
        "    run_experiments(wanted, run_experiment, RESULTS.store(sys.argv[1]), Workers(2))\n"
    )
    program = tmp_path / "program.py"
    program.write_text(script)
    out = tmp_path / "out"
    path = out / f"acfra{SUFFIX}"
    rng, saved = np.random.default_rng(0), 0
    for _ in range(4):
        child = subprocess.Popen([sys.executable, program, out], stderr=subprocess.DEVNULL)
        for _ in range(9000):  # three minutes: a busy machine imports slowly
            if path.exists() and path.read_bytes().count(b"\n") > saved:
                break
            time.sleep(0.02)
        time.sleep(rng.uniform(0.0, 0.1))
        child.send_signal(signal.SIGKILL)
        child.wait(timeout=60)
        found = len(RESULTS.read(path))
        assert found > saved
        saved = found
    wanted = [StaticExperiment("S1", 2, s, "acfra") for s in range(1000, 1150)]
    kept = {r.experiment: RESULTS.line(r) for r in RESULTS.read(path)}
    results = run_experiments(wanted, run_experiment, RESULTS.store(out), Workers(1))
    assert len(results) == 150
    assert all(RESULTS.line(r) == kept[r.experiment] for r in results if r.experiment in kept)
    assert without_clock(results[0]) == without_clock(wanted[0].run())


def test_a_full_disk_is_told_and_what_is_saved_stays(tmp_path, monkeypatch):
    store = RESULTS.store(tmp_path)
    (first,) = run_experiments([ONE], run_experiment, store, Workers(1))
    target = tmp_path / f"acfra{SUFFIX}"
    target.unlink()
    target.symlink_to("/dev/full")
    with pytest.raises(Exception, match="free some space, then start the benchmark again"):
        run_experiments([replace(ONE, seed=1001)], run_experiment, store, Workers(1), fresh=True)
    assert first.outcome == "success"
