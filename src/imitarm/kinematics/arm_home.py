"""Choice of a usable home posture for an arm whose file has no keyframe."""

from __future__ import annotations

import math
from collections.abc import Mapping

import mujoco
import numpy as np
from numpy.typing import NDArray

from imitarm.kinematics.spheres import COLLISION_GROUP

Array = NDArray[np.float64]

_SAMPLES = 1024  # postures among which a home is looked for
_TRIED = 64  # of them, at most, are tested for contact
_WELL_BENT = 0.1  # [m/rad] smallest singular value of a home; less for an arm shorter than _USUAL_REACH
_USUAL_REACH = 0.8  # [m]
_APART = 0.02  # [m] between links at home
_AS_GOOD = 0.98  # of the score: less is a loss
_ROTATION_LENGTH = 0.3  # [m/rad] a rotation of 1 rad counts as much as a displacement of 0.3 m


def usable_posture(
    model: mujoco.MjModel, joints: tuple[str, ...], home: Mapping[str, float]
) -> tuple[Array, tuple[str, ...]]:
    """Return a usable home posture and notes for the user.

    A posture is usable if it is not singular and its links are at least 20 mm apart. If the middle of the joints'
    ranges is usable, the function returns it. Otherwise, the function returns the best of many postures.

    Args:
        model: a compiled model with a site ``flange``.
        joints: names of the arm's joints.
        home: positions of all joints of the model by name, with the arm's joints in the middle of their ranges.

    Returns:
        The posture, shape (n_joints,) [rad], and notes for the user.
    """
    search = _HomeSearch(model, joints, home)
    middle = np.array([home[name] for name in joints])
    needed = _WELL_BENT * min(1.0, search.reach / _USUAL_REACH)
    if search.bend(middle) >= needed and search.apart(middle):
        return middle, ()
    candidates = search.candidates()
    scores = np.array([search.score(q) for q in candidates])
    order = np.argsort(-scores, kind="stable")
    best = next((q for q in candidates[order[:_TRIED]] if search.apart(q)), None)
    if best is None:
        return candidates[order[0]], ("home: no posture was found in which all links are at least 20 mm apart",)
    for index in range(len(best)):  # a joint that makes no difference, such as the first, stands in its middle
        tidier = np.where(np.arange(len(best)) == index, middle, best)
        if search.score(tidier) >= _AS_GOOD * search.score(best) and search.apart(tidier):
            best = tidier
    return best, ()


class _HomeSearch:
    """Rates postures of an arm by their distances from singularities and limits, and by the distances between links."""

    def __init__(self, model: mujoco.MjModel, joints: tuple[str, ...], home: Mapping[str, float]) -> None:
        self._model, self._data = model, mujoco.MjData(model)
        ids = [model.joint(name).id for name in joints]
        for name, value in home.items():
            self._data.qpos[model.jnt_qposadr[model.joint(name).id]] = value
        self._qpos, self._dofs = model.jnt_qposadr[ids], model.jnt_dofadr[ids]
        self._bodies = [int(model.jnt_bodyid[i]) for i in ids]
        self._flange, self._moved = model.site("flange").id, False
        limited = model.jnt_limited[ids].astype(bool)
        slides = model.jnt_type[ids] == mujoco.mjtJoint.mjJNT_SLIDE
        far = np.where(slides, 1.0, math.pi)
        low, high = np.where(limited, model.jnt_range[ids].T, np.array([[-np.inf], [np.inf]]))
        nearest = np.clip(0.0, low, high)  # a range need not contain 0
        self._low, self._high = np.maximum(low, nearest - far), np.minimum(high, nearest + far)
        self._jacobian = np.zeros((6, model.nv))
        pairs, probes = self._link_pairs(), self.candidates()[:: _SAMPLES // 8]
        # Shapes that overlap in every posture are drawn too large or belong together; they say nothing about a home.
        self._pairs = [pair for pair in pairs if any(self._distance(pair, q) >= _APART for q in probes)]
        values = [self._singular_values(q) for q in probes]
        self._ranks = [max(1, *(int(np.sum(each[part] > 1e-6)) for each in values)) for part in (0, 1)]
        anchors = self._move(np.array([home[name] for name in joints])).xanchor[ids]
        ends = np.vstack([anchors, self._data.site_xpos[self._flange]])
        self.reach = float(np.linalg.norm(np.diff(ends, axis=0), axis=1).sum())  # [m] along the links

    def candidates(self) -> Array:
        """Return postures that fill the ranges evenly (a Sobol sequence), shape (n, n_joints)."""
        from scipy.stats import qmc  # noqa: PLC0415  takes half a second to import

        fractions = qmc.Sobol(len(self._low), scramble=False).random(_SAMPLES)
        return np.asarray(self._low + (0.1 + 0.8 * fractions) * (self._high - self._low))

    def bend(self, q: Array) -> float:
        """Return a measure of the distance of a posture from a singularity [m/rad]; 0 at a singularity.

        The measure is the smaller of two values. The first value is the smallest singular value of the flange's
        Jacobian, with rotations weighted by 0.3 m. The second value is the smallest singular value of the Jacobian's
        linear part. The linear part counts separately because an arm with few joints may be unable to move in a
        direction although it can still rotate. Singular values that are 0 in every posture are ignored, because an arm
        with three joints can never move its flange in all directions.
        """
        return min(float(values[rank - 1]) for values, rank in zip(self._singular_values(q), self._ranks, strict=True))

    def _singular_values(self, q: Array) -> tuple[Array, Array]:
        """Return the singular values of the Jacobian's linear part and of the whole Jacobian, largest first."""
        mujoco.mj_comPos(self._model, self._move(q))
        mujoco.mj_jacSite(self._model, self._data, self._jacobian[:3], self._jacobian[3:], self._flange)
        linear, angular = self._jacobian[:3, self._dofs], self._jacobian[3:, self._dofs]
        stacked = np.vstack([linear, _ROTATION_LENGTH * angular])
        return np.linalg.svd(linear, compute_uv=False), np.linalg.svd(stacked, compute_uv=False)

    def score(self, q: Array) -> float:
        """Return a score that grows with the distance from singularities and limits.

        The score is halved if the flange is below the base.
        """
        bend = self.bend(q)
        margin = float(np.min(np.minimum(q - self._low, self._high - q) / (self._high - self._low)))
        below = self._data.site_xpos[self._flange, 2] < 0.0
        return bend * min(1.0, 4.0 * margin) * (0.5 if below else 1.0)

    def apart(self, q: Array) -> bool:
        """Return whether links that do not share a joint are at least 20 mm apart."""
        return all(self._distance(pair, q) >= _APART for pair in self._pairs)

    def _distance(self, pair: tuple[int, int], q: Array) -> float:
        return float(mujoco.mj_geomDistance(self._model, self._move(q), *pair, 2.0 * _APART, None))

    def _move(self, q: Array) -> mujoco.MjData:
        if not np.array_equal(self._data.qpos[self._qpos], q) or not self._moved:
            self._data.qpos[self._qpos] = q
            mujoco.mj_kinematics(self._model, self._data)
            self._moved = True
        return self._data

    def _link_pairs(self) -> list[tuple[int, int]]:
        """Return the pairs of shapes whose links are separated by at least two joints."""
        model = self._model
        links: list[tuple[int, int]] = []
        for geom in np.flatnonzero(model.geom_group == COLLISION_GROUP).tolist():
            body, link = int(model.geom_bodyid[geom]), 0
            while body > 0 and link == 0:
                link = self._bodies.index(body) + 1 if body in self._bodies else 0
                body = int(model.body_parentid[body])
            links.append((geom, link))
        return [(a, b) for i, (a, one) in enumerate(links) for b, other in links[i + 1 :] if abs(one - other) >= 2]
