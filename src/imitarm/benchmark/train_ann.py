"""Train the network of the policy ``dmp-ann`` on paths of the expert: ``python -m imitarm.benchmark.train_ann``.

The expert is an optimiser that finds good paths around an obstacle. The network learns the coupling term, which is
added to the equation of a movement primitive so that the motion follows such a path. Each training scene has one
obstacle on the path of one of four skills, and a seed that is reserved for training. In the first round, the network
learns from the states along the expert's paths. Each further round adds the states that the motions of the network
visit (DAgger). For these states, the network learns the coupling term of the expert's path that is nearest to its
motion.
"""

from __future__ import annotations

import argparse
import contextlib
import sys
import time
from collections.abc import Iterable, Sequence
from functools import lru_cache
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline

from imitarm.benchmark.families import sparse_clutter
from imitarm.benchmark.provenance import code_version
from imitarm.benchmark.static_scenes import SPLITS, learned_path, learned_skill
from imitarm.errors import InfeasibleError
from imitarm.policies.baselines.baseline_policy import ToolGaps
from imitarm.policies.baselines.coupled_motion import MotionState, Surroundings
from imitarm.policies.baselines.dmp_ann import (
    DMPANN,
    N_FEATURES,
    N_OUTPUTS,
    Weights,
    inputs_of,
    save_weights,
)
from imitarm.policies.baselines.expert import N_SAMPLES, expert_paths
from imitarm.policies.baselines.mlp import MLP, train
from imitarm.scene import Scene
from imitarm.skills.skill import Skill
from imitarm.trajectory import Trajectory

Array = NDArray[np.float64]
Policy = TypeVar("Policy", bound=DMPANN)

SKILLS = (("S1", 2), ("S1", 3), ("S7", 2), ("S9", 3))  # families of static scenes that have these skills
CLEARANCE = 0.02  # [m]
_MARGIN = 0.01  # [m] that the expert keeps beyond the clearance, because the network does not follow it exactly
LAYERS = (32, 32)
GAINS = (1.0, 1.5, 2.0, 3.0)  # of which the best in the validation scenes is chosen
_LARGEST_RADIUS = 0.06  # [m] of the tool
_ROUNDS, _STEPS = 3, 20_000
_EVERY = 4  # steps of a motion, of which one state is kept


class TrainingScene(NamedTuple):
    """One scene with the expert's paths.

    Attributes:
        policy: policy ``dmp-ann`` with the skill, the tool and the forbidden directions of the scene.
        scene: the scene with one obstacle.
        nominal: the learned path, with 200 samples.
        deviations: deviation of each path of the expert from the learned path. The paths pass the obstacle on different
            sides. The best path is the first.
    """

    policy: DMPANN
    scene: Scene
    nominal: Trajectory
    deviations: tuple[Deviation, ...]


class Deviation:
    """The deviation of the expert's path from the learned path.

    It is a spline over the elapsed fraction of the duration.

    Args:
        nominal: the learned path.
        path: the expert's path at 100 equally spaced times, shape (100, 3) [m].
    """

    def __init__(self, nominal: Trajectory, path: Array) -> None:
        u = np.linspace(0.0, 1.0, N_SAMPLES)
        self._spline = make_interp_spline(u, path - nominal.at(nominal.times[0] + u * nominal.duration)[0], k=5)

    def at(self, fraction: float) -> Array:
        """Return the deviation e at a fraction of the duration, shape (3,) [m]."""
        return np.asarray(self._spline(min(fraction, 1.0)))

    def velocity(self, fraction: float) -> Array:
        """Return the derivative of e with respect to the fraction, shape (3,) [m]."""
        return np.asarray(self._spline(min(fraction, 1.0), 1))

    def term(self, fraction: float, stiffness: float, damping: float) -> Array:
        """Return the coupling term ``K e + D e' + e''`` that makes a movement primitive follow the path, (3,) [m]."""
        e, velocity, acceleration = (self._spline(min(fraction, 1.0), order) for order in range(3))
        return np.asarray(stiffness * e + damping * velocity + acceleration)


class Samples(NamedTuple):
    """Training samples. In each sample, a matrix converts the output of the network to a coupling term.

    Attributes:
        features: inputs of the network, shape (n, 10).
        maps: matrices that convert the output of the network to a coupling term, shape (n, 3, 3). They remove
            components in forbidden directions.
        terms: coupling terms of the expert, which the network should reproduce, shape (n, 3) [m].
    """

    features: Array
    maps: Array
    terms: Array

    def and_more(self, other: Samples) -> Samples:
        """Return these samples and ``other`` as one set."""
        return Samples(*(np.concatenate(pair) for pair in zip(self, other, strict=True)))

    def loss(self, network: MLP) -> float:
        """Return the sum of squared errors divided by the sum of squared terms.

        It is 1 for a network that always returns 0.
        """
        error = np.einsum("nde,ne->nd", self.maps, network(self.features)) - self.terms
        return float(np.sum(error**2) / np.sum(self.terms**2))

    def gradient(self, network: MLP, batch: NDArray[np.intp]) -> list[Array]:
        """Return the derivatives of the mean loss of the samples ``batch`` with respect to the weights."""
        maps, terms = self.maps[batch], self.terms[batch]
        scale = 2.0 / (len(batch) * float(np.mean(np.sum(self.terms**2, axis=1))))

        def slope(outputs: Array) -> Array:
            error = np.einsum("nde,ne->nd", maps, outputs) - terms
            return scale * np.einsum("nde,nd->ne", maps, error)

        return network.gradient(self.features[batch], slope)


@lru_cache(maxsize=8)
def _skill(family: str, dimension: int) -> tuple[Skill, Array]:
    skill = learned_skill(family, dimension)
    return skill, learned_path(skill)


def training_scene(number: int, network: MLP, split: str = "train") -> TrainingScene | None:
    """Return one scene; None if the expert finds no path.

    Args:
        number: number of the scene. Successive scenes use the four skills in turn.
        network: network for the policy of the scene.
        split: name in :data:`~imitarm.benchmark.static_scenes.SPLITS`.
    """
    family, dimension = SKILLS[number % len(SKILLS)]
    skill, path = _skill(family, dimension)
    seed = SPLITS[split][0] + number
    case = sparse_clutter(seed, path, n_obstacles=1, planar=dimension == 2)
    radius = np.random.default_rng([51, seed]).uniform(0.0, _LARGEST_RADIUS)
    spheres = [[0.0, 0.0, 0.0, radius]]
    nominal = Trajectory(*_positions(skill.nominal(np.linspace(0.0, skill.duration_, 200))))
    gaps = ToolGaps(case.scene, spheres)
    paths = expert_paths(nominal, gaps, clearance=CLEARANCE + _MARGIN, forbidden=case.forbidden)
    if not paths:
        return None
    policy = DMPANN(skill, network=network, tool_spheres=spheres, clearance=CLEARANCE, forbidden=case.forbidden)
    return TrainingScene(policy, case.scene, nominal, tuple(Deviation(nominal, path) for path in paths))


def _positions(path: Trajectory) -> tuple[Array, Array]:
    return path.times, path.positions


def samples_of(scene: TrainingScene, states: Iterable[MotionState], deviation: Deviation) -> Samples:
    """Return one training sample for each state of a motion.

    The coupling term of a sample is that of the expert's path ``deviation`` at the same fraction of the duration. It
    does not depend on the distance of the state from this path, because the spring of the primitive already pulls the
    motion to the path.
    """
    stiffness, damping = scene.policy.skill.dmp_.gains_
    rows = []
    for state in states:
        features, maps = inputs_of(state, stiffness)
        allowed = scene.policy.allowed(maps[0].T).T  # every column without its part in a forbidden direction
        rows.append((features[0], allowed, deviation.term(state.fraction, stiffness, damping)))
    if not rows:
        return Samples(np.zeros((0, N_FEATURES)), np.zeros((0, 3, 3)), np.zeros((0, 3)))
    return Samples(*(np.stack(column) for column in zip(*rows, strict=True)))


def expert_states(scene: TrainingScene) -> list[MotionState]:
    """Return the states along the best path of the expert."""
    nominal, deviation = scene.nominal, scene.deviations[0]
    surroundings = Surroundings(
        ToolGaps(scene.scene, scene.policy.tool_spheres), scene.scene.packed, CLEARANCE, nominal.duration
    )
    u = np.linspace(0.0, 1.0, N_SAMPLES)
    spline = make_interp_spline(nominal.times / nominal.duration, nominal.positions, k=3)
    learned, velocity = spline(u), spline(u, 1)
    states = []
    for fraction, x, v in zip(u.tolist(), learned, velocity, strict=True):
        z = np.stack([x + deviation.at(fraction), v + deviation.velocity(fraction)])
        states.append(surroundings.state(z, fraction, x))
    return states


class _Recorder(DMPANN):
    """Keeps every fourth state of its motions."""

    def __init__(self, *arguments: object, **options: object) -> None:
        super().__init__(*arguments, **options)  # type: ignore[arg-type]
        self.states: list[MotionState] = []
        self._count = 0

    def term(self, state: MotionState) -> Array:
        if self._count % _EVERY == 0 and state.fraction <= 1.0:
            self.states.append(state)
        self._count += 1
        return super().term(state)


def visited_samples(scene: TrainingScene, network: MLP) -> Samples:
    """Return the samples for the states that the motion of the network visits."""
    recorder = _policy_of(scene, _Recorder, network)
    with contextlib.suppress(InfeasibleError):  # the states of a motion that does not arrive are samples too
        recorder.tool_path(scene.nominal, ToolGaps(scene.scene, scene.policy.tool_spheres), scene.scene)
    moved = [(state.fraction, state.position - state.learned) for state in recorder.states]
    away = [sum(float(np.sum((d.at(u) - e) ** 2)) for u, e in moved) for d in scene.deviations]
    return samples_of(scene, recorder.states, scene.deviations[int(np.argmin(away))])


class Training(NamedTuple):
    """Result of a training.

    Attributes:
        network: the trained network.
        losses: loss at the states along the expert's paths in the training scenes. The first value is the loss before
            the training. Each further value is the loss after a round.
        validation_loss: loss at the states along the expert's paths in the validation scenes.
        kept: fraction of the validation scenes in which the motion keeps the clearance, for each gain in ``GAINS``.
        seconds: duration of the training, without the validation [s].
    """

    network: MLP
    losses: tuple[float, ...]
    validation_loss: float
    kept: tuple[float, ...]
    seconds: float

    @property
    def gain(self) -> float:
        """The gain with which the motion keeps the clearance in most validation scenes.

        If several gains are equally good, this is the smallest.
        """
        return GAINS[int(np.argmax(self.kept))]


def validation_samples(n_scenes: int) -> Samples:
    """Return the samples along the expert's paths in the first ``n_scenes`` validation scenes."""
    nothing = MLP.random((N_FEATURES, *LAYERS, N_OUTPUTS), np.random.default_rng(0))
    return _expert_samples(_scenes(n_scenes, nothing, "validation"))


def fraction_kept(scenes: Sequence[TrainingScene], network: MLP, gain: float) -> float:
    """Return the fraction of scenes in which the motion arrives and keeps the clearance at all samples."""
    kept = 0
    for scene in scenes:
        policy, gaps = _policy_of(scene, DMPANN, network, gain), ToolGaps(scene.scene, scene.policy.tool_spheres)
        with contextlib.suppress(InfeasibleError):
            positions = policy.tool_path(scene.nominal, gaps, scene.scene)[1]
            kept += bool(gaps.gaps(positions).min() >= CLEARANCE)
    return kept / len(scenes)


def _policy_of(scene: TrainingScene, kind: type[Policy], network: MLP, gain: float = 1.0) -> Policy:
    """Return a policy for the skill, the tool and the forbidden directions of a scene."""
    its = scene.policy
    return kind(
        its.skill,
        network=network,
        gain=gain,
        tool_spheres=its.tool_spheres,
        clearance=CLEARANCE,
        forbidden=its.forbidden,
    )


def _scenes(n_scenes: int, network: MLP, split: str) -> list[TrainingScene]:
    found = (training_scene(number, network, split) for number in range(n_scenes))
    return [scene for scene in found if scene is not None]


def _expert_samples(scenes: list[TrainingScene]) -> Samples:
    parts = [samples_of(scene, expert_states(scene), scene.deviations[0]) for scene in scenes]
    return Samples(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def train_network(
    seed: int = 0, *, n_scenes: int = 200, n_validation: int = 40, rounds: int = _ROUNDS, steps: int = _STEPS
) -> Training:
    """Train a network.

    Args:
        seed: seed of the initial weights and of the batches.
        n_scenes: number of training scenes.
        n_validation: number of validation scenes.
        rounds: number of rounds after the first. In each of them, the motions of the network add samples.
        steps: number of steps of the optimiser Adam in each round.
    """
    begun = time.perf_counter()
    rng = np.random.default_rng([52, seed])
    network = MLP.random((N_FEATURES, *LAYERS, N_OUTPUTS), rng)
    scenes = _scenes(n_scenes, network, "train")
    expert = samples = _expert_samples(scenes)
    losses = [expert.loss(network)]
    for number in range(rounds + 1):
        if number:
            for scene in scenes:
                samples = samples.and_more(visited_samples(scene, network))
        network = train(network, samples.gradient, len(samples.terms), rng, steps=steps)
        losses.append(expert.loss(network))
    seconds = time.perf_counter() - begun
    held_out = _scenes(n_validation, network, "validation")
    kept = tuple(fraction_kept(held_out, network, gain) for gain in GAINS)
    return Training(network, tuple(losses), _expert_samples(held_out).loss(network), kept, seconds)


def main(arguments: list[str] | None = None) -> None:
    """Train a network, print its losses and write its weights."""
    parser = argparse.ArgumentParser(prog="python -m imitarm.benchmark.train_ann", description=__doc__)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--scenes", type=int, default=200, help="number of training scenes; default: 200")
    parser.add_argument("--validation", type=int, default=40, help="number of validation scenes; default: 40")
    parser.add_argument("--steps", type=int, default=_STEPS, help="steps of Adam in each round; default: %(default)s")
    parser.add_argument("--out", required=True, help="JSON file to write")
    chosen = parser.parse_args(arguments)
    code = code_version()  # of the code that now runs
    done = train_network(chosen.seed, n_scenes=chosen.scenes, n_validation=chosen.validation, steps=chosen.steps)
    kept = ", ".join(f"{100 * k:.0f} % (gain {gain:g})" for gain, k in zip(GAINS, done.kept, strict=True))
    losses = ", ".join(f"{loss:.3f}" for loss in done.losses)
    sys.stdout.write(
        f"loss on the expert's states, before the training and after each round: {losses}\n"
        f"validation loss: {done.validation_loss:.4f}\n"
        f"validation scenes with the required clearance: {kept}\n"
        f"training time: {done.seconds:.0f} s\n"
    )
    options = f"--seed {chosen.seed} --scenes {chosen.scenes} --validation {chosen.validation} --steps {chosen.steps}"
    provenance: dict[str, str | float | int] = {
        "command": f"python -m imitarm.benchmark.train_ann {options}",
        "code": code,
        "seed": chosen.seed,
        "training_scenes": chosen.scenes,
        "validation_scenes": chosen.validation,
        "validation_loss": done.validation_loss,
        "gain": done.gain,
        "training_seconds": round(done.seconds, 1),
    }
    save_weights(Weights(done.network, provenance), chosen.out)


if __name__ == "__main__":
    main()
