r"""The thesis's ACFRA: a repulsive potential pushes the means of the components (thesis Eqs 4.2-4.8).

Gradient descent moves the means in one of two potentials. Let ``d`` be the distance from an obstacle to the ellipse of
a component, and ``n`` the outward normal. The component's spread towards the obstacle is ``sigma(n) = sqrt(n^T Sigma
n)``.

* ``literal``: Eq 4.7 as printed, ``U = 1/2 k (1/d - 1/d_th)^2 - exp(sigma^2)``. The term ``exp(sigma^2)`` does not
  depend on the position of the mean. The spread therefore has no effect on the force.
* ``mapf``: a modified potential with the effect that the thesis describes in words: ``U = 1/2 eta s d_th^2 (1/rho -
  1)^2`` with ``rho = d / d_th``. The gain ``s = exp((sigma(n)^2 - median) / max)`` pushes components with a large
  spread farther than components with a small spread. Here, ``median`` and ``max`` are the median and the maximum of
  ``sigma(n)^2`` over the components.

The potentials act only on the means, not on the path between two means. If two successive means are pushed to opposite
sides of an obstacle, the path between them passes through the obstacle. The potentials serve for comparison;
``certified`` is the default method.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from imitarm.policies.component_path import ComponentPath
from imitarm.policies.least_detour import AvoidanceProblem, Detour, PathAdapter
from imitarm.scene.obstacle import Obstacle

Array = NDArray[np.float64]

INFLUENCE_DISTANCE = 0.05  # [m] d_0: farther obstacles push nothing
_STEP = 0.002  # [m] the most that a mean moves in one iteration
_ITERATIONS = 200
_RHO_MIN = 0.15  # distances are floored here: inside an obstacle the push stays finite
_GAIN_RANGE = (0.25, 4.0)


def component_distances(
    path: ComponentPath, displacement: Array, obstacles: Sequence[Obstacle], margin: float
) -> tuple[Array, Array, Array]:
    """Return the distances from the obstacles, enlarged by ``margin``, to the one-sigma ellipses of the components.

    The distance is ``d = sd(mu) - sqrt(n^T Sigma n) - margin``. Here, ``sd(mu)`` is the signed distance of the
    ellipse's centre ``mu``, and the square root is the extent of the ellipse towards the obstacle. The result is exact
    if the ellipse is a circle or a sphere. It is a lower bound for every convex obstacle that does not contain the
    centre.

    Returns:
        distances (n_obstacles, n_components) [m], normals (n_obstacles, n_components, 3) and spreads
        sigma(n) (n_obstacles, n_components) [m].
    """
    pairs = [obstacle.distance_and_gradient(path.means + displacement) for obstacle in obstacles]
    centre, normal = np.stack([d for d, _ in pairs]), np.stack([n for _, n in pairs])
    spread = np.sqrt(np.einsum("okd,kde,oke->ok", normal, path.covariances, normal))
    return centre - spread - margin, normal, spread


def literal_force(distance: Array, normal: Array, spread: Array) -> Array:
    """Return the force of Eq 4.7 as printed, ``k (1/d - 1/d_th) / d^2 n`` with k = 1.

    Args:
        distance: distance from each ellipse to each obstacle, (n_obstacles, n_components) [m].
        normal: outward normals, (n_obstacles, n_components, 3).
        spread: not used (see the text of this module).
    """
    del spread
    d = np.clip(distance, _RHO_MIN * INFLUENCE_DISTANCE, INFLUENCE_DISTANCE)
    return ((1.0 / d - 1.0 / INFLUENCE_DISTANCE) / d**2)[..., None] * normal


def modified_force(distance: Array, normal: Array, spread: Array) -> Array:
    """Return the force ``s d_th (1/rho - 1) / rho^2 n`` of the modified potential (docs/avoidance.md, 10).

    Args:
        distance: distance from each ellipse to each obstacle, (n_obstacles, n_components) [m].
        normal: outward normals, (n_obstacles, n_components, 3).
        spread: sigma(n), (n_obstacles, n_components) [m].
    """
    variance = spread**2
    gain = np.clip(np.exp((variance - np.median(variance)) / variance.max()), *_GAIN_RANGE)
    rho = np.clip(distance / INFLUENCE_DISTANCE, _RHO_MIN, 1.0)
    return (gain * INFLUENCE_DISTANCE * (1.0 / rho - 1.0) / rho**2)[..., None] * normal


FORCES = {"literal": literal_force, "mapf": modified_force}


def push_components(
    path: ComponentPath, obstacles: Sequence[Obstacle], margin: float, *, method: str, forbidden: Array
) -> Array:
    """Move the means along the forces until all forces are zero, but for at most 200 steps.

    Args:
        path: the nominal path and its components.
        obstacles: obstacles with signed distance and gradient.
        margin: radius of the tool's sphere plus the required clearance [m].
        method: name of the potential, ``"literal"`` or ``"mapf"``.
        forbidden: directions in which no mean may move, unit vectors, shape (m, 3).

    Returns:
        The displacement of each mean, shape (n_components, 3) [m].
    """
    displacement = np.zeros((path.n_components, 3))
    for _ in range(_ITERATIONS):
        force = FORCES[method](*component_distances(path, displacement, obstacles, margin)).sum(axis=0)
        for f in forbidden:
            force = force - np.maximum(force @ f, 0.0)[:, None] * f
        size = np.linalg.norm(force, axis=1, keepdims=True)
        if size.max() < 1e-9:
            break
        displacement += _STEP * force / np.maximum(size, 1.0)
    return displacement


class PotentialField(PathAdapter):
    """The thesis's method: push the components of the path away from obstacles.

    The clearance of the resulting path is computed as for the method ``certified``. While the components are pushed,
    one sphere about the tip represents the tool, and the obstacles stay at their poses at time 0.

    Args:
        force: name of the force, ``"literal"`` or ``"mapf"``.
    """

    def __init__(self, force: str) -> None:
        self.force = force

    def detour(self, problem: AvoidanceProblem) -> Detour:
        """Return the path after the push; this path may violate the clearance."""
        tool = problem.nominal.tool
        pushed = push_components(
            problem.path,
            tool.obstacles,
            tool.reach + problem.clearance,
            method=self.force,
            forbidden=problem.allowed.forbidden,
        )
        return problem.evaluated(pushed)


MAPF, LITERAL = PotentialField("mapf"), PotentialField("literal")
