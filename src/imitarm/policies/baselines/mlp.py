"""A small neural network: layers with tanh, a linear last layer, and its training by Adam."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Self

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_DECAY_1, _DECAY_2, _TINY = 0.9, 0.999, 1e-8  # of Adam
_WARM_UP = 0.05  # fraction of the steps in which the step size rises; afterwards it falls to 0 like a cosine


@dataclass(frozen=True, eq=False)
class MLP:
    """A multilayer perceptron with the layers ``x_(i+1) = tanh(x_i W_i + b_i)``; the last layer has no tanh.

    Attributes:
        weights: matrices W_i of the layers, each of shape (inputs, outputs).
        biases: vectors b_i of the layers, each of shape (outputs,).
    """

    weights: tuple[Array, ...]
    biases: tuple[Array, ...]

    @classmethod
    def random(cls, sizes: Sequence[int], rng: np.random.Generator) -> Self:
        """Return a network with normally distributed weights of variance ``1 / inputs``, and biases of 0.

        Args:
            sizes: number of inputs, number of units in each layer, number of outputs. The weights of the last layer are
                divided by 10, so that the outputs of the untrained network are small.
            rng: random number generator for the weights.
        """
        weights = [rng.normal(size=pair) / np.sqrt(pair[0]) for pair in pairwise(sizes)]
        weights[-1] *= 0.1
        return cls(tuple(weights), tuple(np.zeros(n) for n in sizes[1:]))

    def __call__(self, x: Array) -> Array:
        """Return the outputs (n, k) for inputs ``x`` (n, m)."""
        for W, b in zip(self.weights[:-1], self.biases[:-1], strict=True):
            x = np.tanh(x @ W + b)
        return np.asarray(x @ self.weights[-1] + self.biases[-1])

    def gradient(self, x: Array, slope: Callable[[Array], Array]) -> list[Array]:
        """Return the derivatives of a loss with respect to all weights and biases.

        Args:
            x: inputs of n samples, shape (n, m).
            slope: function that gets the outputs (n, k) and returns the derivatives of the loss with respect to the
                outputs, shape (n, k).

        Returns:
            A list ``[dW_0, db_0, dW_1, db_1, ...]`` of arrays with the shapes of the parameters.
        """
        layers = [x]
        for W, b in zip(self.weights[:-1], self.biases[:-1], strict=True):
            layers.append(np.tanh(layers[-1] @ W + b))
        back = slope(layers[-1] @ self.weights[-1] + self.biases[-1])
        found: list[Array] = []
        for i in range(len(self.weights) - 1, -1, -1):
            found = [layers[i].T @ back, back.sum(axis=0), *found]
            back = (back @ self.weights[i].T) * (1.0 - layers[i] ** 2)
        return found

    @property
    def parameters(self) -> list[Array]:
        """All weights and biases, in the order of :meth:`gradient`."""
        return [p for pair in zip(self.weights, self.biases, strict=True) for p in pair]


def train(
    network: MLP,
    gradient: Callable[[MLP, NDArray[np.intp]], list[Array]],
    n_samples: int,
    rng: np.random.Generator,
    *,
    steps: int,
    batch: int = 512,
    step_size: float = 3e-3,
) -> MLP:
    """Return the network after ``steps`` steps of Adam on random batches.

    Args:
        network: the network to start from; it is not changed.
        gradient: function that gets a network and the indices of a batch's samples, shape (batch,). It returns the
            derivatives of the loss, in the order of :meth:`MLP.gradient`.
        n_samples: number of samples from which the batches are drawn.
        rng: random number generator for the batches.
        steps: number of steps.
        batch: number of samples in a batch.
        step_size: largest step size of Adam; the step size rises at first and then falls to 0.
    """
    parameters = [p.copy() for p in network.parameters]
    network = MLP(tuple(parameters[::2]), tuple(parameters[1::2]))
    first, second = [np.zeros_like(p) for p in parameters], [np.zeros_like(p) for p in parameters]
    for k in range(steps):
        done = (k + 1) / steps
        size = step_size * min(1.0, done / _WARM_UP) * 0.5 * (1.0 + np.cos(np.pi * done))
        slopes = gradient(network, rng.integers(n_samples, size=batch))
        for i, slope in enumerate(slopes):
            first[i] += (1.0 - _DECAY_1) * (slope - first[i])
            second[i] += (1.0 - _DECAY_2) * (slope * slope - second[i])
            mean, square = first[i] / (1.0 - _DECAY_1 ** (k + 1)), second[i] / (1.0 - _DECAY_2 ** (k + 1))
            parameters[i] -= size * mean / (np.sqrt(square) + _TINY)
    return network
