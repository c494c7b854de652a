"""DMP+ANN: a primitive whose coupling term is a neural network that was trained on expert paths (Rai et al. 2017)."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from functools import lru_cache
from importlib import resources
from itertools import pairwise
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from imitarm.errors import FileFormatError, InputError
from imitarm.files.document import as_document, write_text
from imitarm.policies.baselines.coupled_motion import CoupledMotion, MotionState
from imitarm.policies.baselines.mlp import MLP
from imitarm.skills.skill import Skill
from imitarm.validation import finite_number

Array = NDArray[np.float64]

N_FEATURES, N_OUTPUTS = 10, 3
REACH = 0.1  # [m] distance at which the term has decayed to exp(-1); unit of the features that are lengths
_DEVIATION = 0.05  # [m] unit of the deviation from the learned path
_SLOW = 1e-6  # [m] scaled speed at which the frame is not defined
_HEAD_ON = 1e-6  # sine of an angle at which the side is not defined
_PACKAGED = "dmp_ann_weights.json"
_REMEDY = "train the network again with python -m imitarm.benchmark.train_ann"


class Inputs(NamedTuple):
    """The inputs of the network for each obstacle, and the linear map from the network's outputs to the coupling term.

    Attributes:
        features: inputs of the network for each obstacle, shape (n, 10).
        maps: linear map for each obstacle, shape (n, 3, 3); the coupling term is ``sum_i maps_i outputs_i`` [m].
    """

    features: Array
    maps: Array


def inputs_of(state: MotionState, stiffness: float) -> Inputs:
    r"""Return the inputs of the network, and the linear maps of its outputs, for one state of the motion.

    Each obstacle has a frame ``Q = [v_r / |v_r|, p, b]``. The first axis is the direction of the relative velocity
    ``v_r``. The second axis ``p`` is perpendicular to the first and points towards the obstacle. The third axis ``b``
    is perpendicular to both. Features in this frame do not change when the whole scene is rotated. Let ``r`` be the
    vector from the tool to the obstacle's closest point, ``d`` the gap, ``theta`` the angle between ``v_r`` and ``r``,
    ``s`` the phase, and ``x - x_0`` the deviation from the learned path. The ten features are::

        d / 0.1 m, |v_r|, cos(theta), sin(theta), Q^T r / 0.1 m (3), s, |x - x_0| / 0.05 m, 1

    The linear map is ``K s exp(-d / 0.1 m) Q``, or 0 if the tool does not move relative to the obstacle.

    Args:
        state: state of the motion.
        stiffness: stiffness K of the primitive.
    """
    v, n = state.relative, state.normal
    speed = np.sqrt(np.einsum("nd,nd->n", v, v))
    frame = np.empty((len(n), 3, 3))
    ahead, beside, binormal = frame[:, :, 0], frame[:, :, 1], frame[:, :, 2]
    np.divide(v, np.maximum(speed, _SLOW)[:, None], out=ahead)
    cosine = -np.einsum("nd,nd->n", ahead, n)
    beside[:] = -n - cosine[:, None] * ahead
    sine = np.sqrt(np.einsum("nd,nd->n", beside, beside))
    for i in np.flatnonzero(sine < _HEAD_ON):  # any perpendicular direction
        beside[i] = np.cross(ahead[i], np.eye(3)[np.argmin(np.abs(ahead[i]))])
        sine[i] = np.linalg.norm(beside[i])
    beside /= np.maximum(sine, _HEAD_ON)[:, None]
    for axis in range(3):
        j, k = (axis + 1) % 3, (axis + 2) % 3
        binormal[:, axis] = ahead[:, j] * beside[:, k] - ahead[:, k] * beside[:, j]
    features = np.empty((len(n), N_FEATURES))
    features[:, 0], features[:, 1], features[:, 2] = state.distance / REACH, speed, cosine
    features[:, 3] = np.sqrt(np.maximum(1.0 - cosine * cosine, 0.0))
    features[:, 4:7] = np.einsum("nde,nd->ne", frame, -n) * (state.reach / REACH)[:, None]
    features[:, 7], features[:, 9] = state.phase, 1.0
    deviation = state.position - state.learned
    features[:, 8] = np.sqrt(deviation.dot(deviation)) / _DEVIATION
    size = stiffness * state.phase * np.exp(-state.distance / REACH) * (speed > _SLOW)
    return Inputs(features, size[:, None, None] * frame)


class DMPANN(CoupledMotion):
    r"""DMP+ANN: a primitive with a learned coupling term (after Rai et al. 2017).

    A small network NN computes one vector for each obstacle, in a frame Q that moves with the tool. The coupling term
    is a weighted sum of these vectors over the obstacles::

        Phi = gain K s sum exp(-d / 0.1 m) Q NN(features)

    :func:`inputs_of` explains the features and the frame Q. The network has two layers of 32 units with tanh. The
    factor ``s`` is the phase of the primitive. It decays to 0, so the coupling term vanishes at the end of the motion.

    **Training.** The expert is an optimiser (:mod:`~imitarm.policies.baselines.expert`), which is independent of the
    compared methods. The expert's path in a scene is the nominal path plus a deviation ``e(t)``. A primitive with the
    coupling term ``C = K e + D T e' + T^2 e''`` moves along this path. The network first learns C along the expert's
    paths around one obstacle. Then, in three rounds, it also learns C in the states that its own motions visit (DAgger,
    Ross et al. 2011). A network that minimises the squared error returns mean values, which are too small to keep the
    clearance. The factor ``gain`` compensates for this; its value was chosen in validation scenes. The package contains
    the trained weights. The command ``python -m imitarm.benchmark.train_ann`` trains the network again.

    **Changes.** The network of the paper learns from human demonstrations. In the paper, a separate step sets the
    output to zero when the tool has passed the obstacle or is at the goal. Here, the factors ``s`` and ``exp(-d / 0.1
    m)`` have this effect.

    **Known failure.** The expert passes an obstacle on one of two sides. If the tool moves straight at the obstacle,
    the features do not show which side the expert chooses. The network then returns a mean of the terms for both sides,
    which does not avoid the obstacle. The training scenes have only one obstacle. If several obstacles are near, the
    policy adds their coupling terms. The network has not been trained for this case.

    Args:
        skill: skill to reproduce.
        gain: factor of the coupling term; None: the factor chosen for the network of the package, or 1 for another
            network.
        network: trained network; None: the network of the package.
        options: arguments of :class:`~imitarm.policies.baselines.coupled_motion.CoupledMotion`.
    """

    search_space: ClassVar[Mapping[str, tuple[float, float]]] = {"gain": (0.3, 4.0)}

    def __init__(self, skill: Skill, *, gain: float | None = None, network: MLP | None = None, **options: Any) -> None:
        super().__init__(skill, **options)
        if gain is None:
            gain = float(packaged_weights().provenance["gain"]) if network is None else 1.0
        self.gain = finite_number(gain, "DMPANN: gain", at_least=0.0)
        self.network = packaged_weights().network if network is None else network

    def term(self, state: MotionState) -> Array:
        """Return Phi, the sum over all obstacles, shape (3,) [m]."""
        if not len(state.distance):
            return np.zeros(3)
        features, maps = inputs_of(state, self.skill.dmp_.gains_.stiffness)
        return self.gain * np.einsum("nde,ne->d", maps, self.network(features))


class _Document(msgspec.Struct, forbid_unknown_fields=True):
    format: str
    provenance: dict[str, str | float | int]
    weights: list[list[list[float]]]
    biases: list[list[float]]


_FORMAT = "imitarm dmp-ann weights 1"


class Weights(NamedTuple):
    """A trained network, and a record of its training.

    Attributes:
        network: the trained network.
        provenance: record of the training: command, seed, version of the code, numbers of scenes, validation loss,
            chosen gain and training time.
    """

    network: MLP
    provenance: dict[str, str | float | int]


def save_weights(weights: Weights, path: str | os.PathLike[str]) -> None:
    """Write a network as JSON.

    Raises:
        InputError: when the file can't be written.
    """
    content = {
        "format": _FORMAT,
        "provenance": weights.provenance,
        "weights": [W.tolist() for W in weights.network.weights],
        "biases": [b.tolist() for b in weights.network.biases],
    }
    write_text(path, json.dumps(content) + "\n")


def load_weights(path: str | os.PathLike[str]) -> Weights:
    """Read a network that :func:`save_weights` wrote.

    Raises:
        InputError: when the file can't be read.
        FileFormatError: when the file does not contain a network with 10 inputs and 3 outputs.
    """
    try:
        content = json.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{os.fspath(path)}: can't be read: {error.strerror}") from error
    except ValueError as error:
        raise FileFormatError(f"{os.fspath(path)}: is not JSON: {error}; {_REMEDY}") from error
    document = as_document(content, _Document, path, _REMEDY)
    if document.format != _FORMAT:
        raise FileFormatError(f"{os.fspath(path)}: the format is {document.format!r}, not {_FORMAT!r}; {_REMEDY}")
    try:
        matrices = [np.array(W, dtype=float) for W in document.weights]
        vectors = [np.array(b, dtype=float) for b in document.biases]
    except ValueError as error:
        raise FileFormatError(f"{os.fspath(path)}: a matrix has rows of different lengths; {_REMEDY}") from error
    sizes = [N_FEATURES, *(len(b) for b in vectors)]
    shapes = list(pairwise(sizes))
    finite = all(np.isfinite(p).all() for p in (*matrices, *vectors))
    if [W.shape for W in matrices] != shapes or sizes[-1] != N_OUTPUTS or not finite:
        raise FileFormatError(
            f"{os.fspath(path)}: must hold finite matrices from {N_FEATURES} inputs to {N_OUTPUTS} outputs; {_REMEDY}"
        )
    return Weights(MLP(tuple(matrices), tuple(vectors)), document.provenance)


@lru_cache(maxsize=1)
def packaged_weights() -> Weights:
    """Return the trained network that the package contains."""
    with resources.as_file(resources.files("imitarm.policies.baselines") / _PACKAGED) as path:
        return load_weights(path)
