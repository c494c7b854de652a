from __future__ import annotations

import json
from functools import lru_cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from imitarm.benchmark import train_ann
from imitarm.benchmark.avoidance import learn
from imitarm.benchmark.families import sparse_clutter
from imitarm.errors import FileFormatError, InputError
from imitarm.kinematics.pose import quaternion_exp, quaternion_to_matrix
from imitarm.policies import HORIZONTAL_ONLY, POLICIES
from imitarm.policies.baselines.baseline_policy import ToolGaps
from imitarm.policies.baselines.coupled_motion import Surroundings
from imitarm.policies.baselines.dmp_ann import (
    DMPANN,
    N_FEATURES,
    N_OUTPUTS,
    Weights,
    inputs_of,
    load_weights,
    packaged_weights,
    save_weights,
)
from imitarm.policies.baselines.mlp import MLP, train
from imitarm.scene import Scene, Sphere

SKILL, PATH = learn(planar=False)
PLANAR, PLANAR_PATH = learn(planar=True)
TOOL = [[0.0, 0.0, 0.0, 0.03]]
seeds = st.integers(0, 10_000)


def random_network(seed=0) -> MLP:
    return MLP.random((N_FEATURES, 8, 8, N_OUTPUTS), np.random.default_rng(seed))


@given(seeds)
def test_the_gradient_of_a_network_is_its_finite_difference(seed):
    rng = np.random.default_rng(seed)
    network = MLP.random((4, 5, 6, 2), rng)
    x, target = rng.normal(size=(7, 4)), rng.normal(size=(7, 2))
    slopes = network.gradient(x, lambda outputs: 2.0 * (outputs - target))
    for parameter, slope in zip(network.parameters, slopes, strict=True):
        assert parameter.shape == slope.shape
        place = tuple(rng.integers(n) for n in parameter.shape)
        before, losses = parameter[place], []
        for step in (1e-6, -1e-6):
            parameter[place] = before + step
            losses.append(float(np.sum((network(x) - target) ** 2)))
        parameter[place] = before
        assert slope[place] == pytest.approx((losses[0] - losses[1]) / 2e-6, rel=1e-4, abs=1e-6)


def test_adam_fits_a_function_and_is_deterministic():
    x = np.linspace(-2.0, 2.0, 200)[:, None]
    y = np.sin(2.0 * x)

    def gradient(network, batch):
        return network.gradient(x[batch], lambda outputs: 2.0 * (outputs - y[batch]) / len(batch))

    networks = []
    for _ in range(2):
        rng = np.random.default_rng(3)
        start = MLP.random((1, 16, 16, 1), rng)
        networks.append(train(start, gradient, len(x), rng, steps=1500, batch=64, step_size=1e-2))
    assert np.mean((networks[0](x) - y) ** 2) < 1e-3 * np.mean((start(x) - y) ** 2)
    np.testing.assert_array_equal(networks[0](x), networks[1](x))


@given(seeds)
def test_the_term_turns_with_the_scene(seed):
    """Features do not change when everything is rotated, and the term rotates."""
    rng = np.random.default_rng(seed)
    center, velocity, z, learned = rng.normal(size=3), rng.normal(size=3), rng.normal(size=(2, 3)), rng.normal(size=3)
    policy = DMPANN(SKILL, network=random_network())
    rotation = quaternion_to_matrix(quaternion_exp(rng.normal(size=3)))
    terms = []
    for turn in (np.eye(3), rotation):
        scene = Scene(None, [Sphere(turn @ center, 0.2, velocity=turn @ velocity)])
        surroundings = Surroundings(ToolGaps(scene, TOOL), scene.packed, 0.02, 2.0)
        state = surroundings.state(z @ turn.T, 0.3, turn @ learned)
        features, maps = inputs_of(state, 100.0)
        np.testing.assert_allclose(features[0, 9], 1.0)
        np.testing.assert_allclose(features[0, 6], 0.0, atol=1e-9)  # the obstacle is in the plane of the first two axes
        size = 100.0 * state.phase * np.exp(-state.distance[0] / 0.1)
        np.testing.assert_allclose(maps[0].T @ maps[0], size**2 * np.eye(3), atol=1e-6)
        terms.append(policy.term(state))
    np.testing.assert_allclose(terms[1], rotation @ terms[0], atol=1e-9)


def test_the_term_vanishes_without_relative_motion_far_away_and_at_the_end():
    policy = DMPANN(SKILL, network=random_network())
    scene = Scene(None, [Sphere([0.0, 0.0, 0.5], 0.1)])
    surroundings = Surroundings(ToolGaps(scene, TOOL), scene.packed, 0.02, 4.0)

    def size(z, fraction):
        return np.linalg.norm(policy.term(surroundings.state(np.array(z), fraction, np.zeros(3))))

    near = size([[0.0, 0.0, 0.2], [1.0, 0.0, 0.2]], 0.2)
    assert near > 1e-2
    assert size([[0.0, 0.0, 0.2], [0.0, 0.0, 0.0]], 0.2) == 0.0
    assert size([[0.0, 0.0, -9.0], [1.0, 0.0, 0.2]], 0.2) < 1e-30
    assert size([[0.0, 0.0, 0.2], [1.0, 0.0, 0.2]], 2.0) < 1e-3 * near
    assert not policy.term(
        Surroundings(ToolGaps(Scene(), TOOL), Scene().packed, 0.02, 4.0).state(np.ones((2, 3)), 0.1, np.zeros(3))
    ).any()


@settings(max_examples=10)
@given(st.integers(0, 100))
def test_any_network_ends_at_the_goal(seed):
    """The factor s makes the motion converge, whatever the network returns (Rai et al. 2017)."""
    network = random_network(seed)
    wild = MLP(network.weights[:-1] + (100.0 * network.weights[-1],), network.biases)
    scene = sparse_clutter(seed, PATH, n_obstacles=2, planar=False).scene
    plan = DMPANN(SKILL, network=wild, tool_spheres=TOOL).plan_motion(scene).trajectory
    np.testing.assert_allclose(plan.positions[-1], PATH[-1], atol=5e-3)


@lru_cache(maxsize=1)
def one_scene() -> train_ann.TrainingScene:
    scene = train_ann.training_scene(1, random_network())
    assert scene is not None
    return scene


def test_the_term_of_an_expert_path_makes_the_primitive_follow_it():
    """C = K e + D T e' + T^2 e'' is what a perfect network would return."""
    scene = one_scene()
    expert = scene.deviations[0]
    gains = scene.policy.skill.dmp_.gains_

    class Perfect(DMPANN):
        def term(self, state):
            return expert.term(state.fraction, *gains)

    policy = Perfect(scene.policy.skill, network=random_network(), max_acceleration=1000.0)
    times, positions = policy.tool_path(scene.nominal, ToolGaps(Scene(), TOOL), Scene())
    wanted = [
        scene.nominal.at([min(t, scene.nominal.times[-1])])[0][0] + expert.at(t / scene.nominal.duration) for t in times
    ]
    assert max(np.linalg.norm(expert.at(t / times[-1])) for t in times) > 0.02
    np.testing.assert_allclose(positions, wanted, atol=2e-3)


def test_the_gradient_of_the_training_loss_is_its_finite_difference():
    scene = one_scene()
    samples = train_ann.samples_of(scene, train_ann.expert_states(scene), scene.deviations[0])
    network = random_network()
    slopes = samples.gradient(network, np.arange(len(samples.terms)))
    for parameter, slope in zip(network.parameters, slopes, strict=True):
        before, losses = parameter.flat[0], []
        for step in (1e-6, -1e-6):
            parameter.flat[0] = before + step
            losses.append(samples.loss(network))
        parameter.flat[0] = before
        assert slope.flat[0] == pytest.approx((losses[0] - losses[1]) / 2e-6, rel=1e-3, abs=1e-7)


def test_a_small_training_is_deterministic_and_reduces_the_loss():
    done = [train_ann.train_network(1, n_scenes=4, n_validation=2, rounds=1, steps=150) for _ in range(2)]
    np.testing.assert_array_equal(done[0].network.weights[0], done[1].network.weights[0])
    assert done[0].losses == done[1].losses and done[0].validation_loss == done[1].validation_loss
    assert done[0].losses[-1] < 0.5 * done[0].losses[0]


def test_the_packaged_weights_have_their_recorded_validation_loss_and_say_where_they_come_from():
    network, provenance = packaged_weights()
    loss = train_ann.validation_samples(int(provenance["validation_scenes"])).loss(network)
    assert loss == pytest.approx(provenance["validation_loss"], rel=0.02)
    assert {"command", "code", "seed", "training_scenes", "training_seconds", "gain"} <= set(provenance)
    assert "train_ann" in str(provenance["command"])
    assert DMPANN(SKILL).gain == provenance["gain"] and provenance["gain"] in train_ann.GAINS
    assert [W.shape for W in network.weights] == [(10, 32), (32, 32), (32, 3)]


def test_it_passes_obstacles_that_it_has_not_seen():
    """As in the published figures: the learned term passes an obstacle that the primitive alone hits."""
    passed = hit = 0
    policy, alone = DMPANN(SKILL, tool_spheres=TOOL), DMPANN(SKILL, gain=0.0, tool_spheres=TOOL)
    for seed in range(1100, 1112):
        scene = sparse_clutter(seed, PATH, n_obstacles=1, planar=False).scene
        gaps = ToolGaps(scene, TOOL)
        passed += gaps.gaps(policy.plan_motion(scene).trajectory.positions).min() > 0.0
        hit += gaps.gaps(alone.plan_motion(scene).trajectory.positions).min() < 0.0
    assert hit == 12 and passed >= 9


def test_no_part_of_the_path_is_displaced_in_a_forbidden_direction():
    scene = sparse_clutter(5, PLANAR_PATH, n_obstacles=1, planar=True).scene
    plan = DMPANN(PLANAR, tool_spheres=TOOL, forbidden=HORIZONTAL_ONLY).plan_motion(scene).trajectory
    np.testing.assert_allclose(plan.positions[:, 2], PLANAR_PATH[0, 2], atol=1e-6)


def test_weights_are_saved_and_read_and_wrong_files_are_refused(tmp_path):
    path = tmp_path / "weights.json"
    network = random_network()
    save_weights(Weights(network, {"seed": 3}), path)
    found = load_weights(path)
    np.testing.assert_array_equal(found.network.weights[1], network.weights[1])
    assert found.provenance == {"seed": 3}
    content = json.loads(path.read_text())
    for change, message in (
        ({"format": "other"}, "the format is 'other'"),
        ({"weights": content["weights"][:-1]}, "finite matrices from 10 inputs"),
        ({"biases": [*content["biases"][:-1], [0.0, 0.0]]}, "finite matrices from 10 inputs"),
        ({"weights": [[[1.0], [1.0, 2.0]], *content["weights"][1:]]}, "rows of different lengths"),
        ({"weights": "none"}, "weights"),
        ({"more": 1}, "more"),
    ):
        path.write_text(json.dumps(content | change))
        with pytest.raises(FileFormatError, match=message):
            load_weights(path)
    path.write_text("{")
    with pytest.raises(FileFormatError, match="is not JSON"):
        load_weights(path)
    with pytest.raises(InputError, match="can't be read"):
        load_weights(tmp_path / "missing.json")


def test_the_command_trains_prints_and_writes_weights(tmp_path, capsys):
    path = tmp_path / "weights.json"
    train_ann.main(["--scenes", "2", "--validation", "1", "--steps", "20", "--out", str(path)])
    printed = capsys.readouterr().out
    assert "validation loss" in printed and "training time" in printed
    provenance = load_weights(path).provenance
    assert provenance["training_scenes"] == 2 and "--scenes 2" in provenance["command"]


def test_it_is_registered_with_options_to_search():
    assert POLICIES["dmp-ann"] is DMPANN
    for option, (low, high) in DMPANN.search_space.items():
        assert 0.0 < low < high and getattr(DMPANN(SKILL, **{option: high}), option) == high
