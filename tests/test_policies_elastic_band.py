from __future__ import annotations

import numpy as np
import pytest

from imitarm.benchmark.avoidance import learn
from imitarm.benchmark.families import CLEARANCE, TOOL_RADIUS, sparse_clutter
from imitarm.policies import HORIZONTAL_ONLY, NOT_DOWN
from imitarm.policies.baselines.baseline_policy import ToolGaps
from imitarm.policies.baselines.elastic_band import ElasticBand
from imitarm.scene import HalfSpace, Scene, Sphere

TOOL = [[0.0, 0.0, 0.0, TOOL_RADIUS]]
SKILL, PATH = learn(planar=False)
SAMPLES = SKILL.gmr_.trajectory(200).at(np.linspace(0.0, SKILL.duration_, 100))[0]


def test_against_a_wall_the_band_has_the_closed_form_of_a_spring_on_a_tense_string():
    """Over a stretch of constant load p, a string of unit tension bends by d'' = -p; free parts are straight."""
    height = PATH[:, 2].min() - TOOL_RADIUS - CLEARANCE
    wall = Scene(None, (HalfSpace([0.0, 0.0, height], [0.0, 0.0, 1.0]),))
    plan = ElasticBand(SKILL, tool_spheres=TOOL, repulsion=0.05, influence=0.06).plan_motion(wall)
    deviation = plan.trajectory.positions - SAMPLES
    gap = ToolGaps(wall, TOOL).gaps(plan.trajectory.positions)[0] - CLEARANCE
    load = 0.05 * np.maximum(0.06 - gap, 0.0)
    bent = deviation[:-2, 2] - 2.0 * deviation[1:-1, 2] + deviation[2:, 2]
    np.testing.assert_allclose(bent, -load[1:-1], atol=1e-5)
    np.testing.assert_allclose(deviation[:, :2], 0.0, atol=1e-9)
    assert load.max() > 1e-4


def test_the_band_goes_around_obstacles_and_rests_on_the_learned_path_without_any():
    assert ElasticBand(SKILL, tool_spheres=TOOL).plan_motion(Scene(None, ())).displaced.max() < 1e-3
    for seed in range(5):
        case = sparse_clutter(seed, PATH, n_obstacles=2, planar=False)
        plan = ElasticBand(SKILL, tool_spheres=TOOL).plan_motion(case.scene)
        assert ToolGaps(case.scene, TOOL).gaps(plan.trajectory.positions).min() > CLEARANCE
        np.testing.assert_array_equal(plan.trajectory.positions[[0, -1]], SAMPLES[[0, -1]])


def test_the_band_keeps_forbidden_directions():
    scene = Scene(None, (Sphere(PATH[200], 0.03),))
    flat = ElasticBand(SKILL, tool_spheres=TOOL, forbidden=HORIZONTAL_ONLY).plan_motion(scene)
    np.testing.assert_allclose(flat.trajectory.positions[:, 2], SAMPLES[:, 2], atol=1e-9)
    up = ElasticBand(SKILL, tool_spheres=TOOL, forbidden=NOT_DOWN).plan_motion(scene)
    assert (up.trajectory.positions - SAMPLES)[:, 2].min() >= -1e-9


def test_options_of_the_band_are_checked():
    for name, (lowest, highest) in ElasticBand.search_space.items():
        assert 0.0 < lowest < highest
        with pytest.raises(ValueError, match=name):
            ElasticBand(SKILL, **{name: 0.0})
