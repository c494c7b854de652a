"""The home of an arm: the keyframe of its file, or a usable posture that is found."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc

from imitarm.errors import FileFormatError
from imitarm.files.xml_tree import XmlElement
from imitarm.kinematics.arm_joints import HINGE, SLIDE, mimics, place
from imitarm.kinematics.spheres import COLLISION_GROUP

Array = NDArray[np.float64]

_SAMPLES = 1024  # postures among which a home is looked for
_TRIED = 64  # of them, at most, are tested for contact
_WELL_BENT = 0.1  # [m/rad] smallest singular value of a home; less for an arm shorter than _USUAL_REACH
_USUAL_REACH = 0.8  # [m]
_APART = 0.02  # [m] between links at home
_AS_GOOD = 0.98  # of the score: less is a loss
_ANGLE_LENGTH = 0.3  # [m/rad] a rotation of 1 rad counts as much as a displacement of 0.3 m


def take_keyframe(spec: mujoco.MjSpec, model: mujoco.MjModel) -> tuple[dict[str, float], str]:
    """Return positions by joint of the keyframe ``home``, else of the first one, and its name; remove all keyframes."""
    keys = list(spec.keys)
    home: dict[str, float] = {}
    index = next((i for i, key in enumerate(keys) if key.name == "home"), 0)
    name = keys[index].name if keys else ""
    if keys:
        for joint in range(model.njnt):
            if int(model.jnt_type[joint]) in {HINGE, SLIDE}:
                home[model.joint(joint).name] = float(model.key_qpos[index, model.jnt_qposadr[joint]])
    for key in keys:  # their lengths would be wrong once a tool with joints is attached
        spec.delete(key)
    return home, name


def check_keyframe(
    home: Mapping[str, float], name: str, model: mujoco.MjModel, joints: tuple[str, ...], path: Path, root: XmlElement
) -> None:
    """Refuse a keyframe outside the limits of the arm's joints.

    Raises:
        FileFormatError: naming the keyframe, its line, the joint and its limits.
    """
    for joint in joints:
        index = model.joint(joint).id
        low, high = model.jnt_range[index]
        value = home.get(joint, low)
        if model.jnt_limited[index] and not low - 1e-6 <= value <= high + 1e-6:
            keys = [e for e in root.walk() if e.tag == "key" and e.get("name") == name]
            line = f" (line {keys[0].line})" if keys else ""
            raise FileFormatError(
                f"{place(path, root, joint)} is at {value:.4g} in the keyframe {name!r}{line}, outside its limits "
                f"[{low:.4g}, {high:.4g}]; correct the keyframe, or remove it to have a posture chosen"
            )


def complete_home(
    spec: mujoco.MjSpec, model: mujoco.MjModel, joints: tuple[str, ...], given: Mapping[str, float], tool_prefix: str
) -> tuple[dict[str, float], tuple[str, ...]]:
    """Return a position for every joint of ``model``, and notes on it.

    Joints that are given keep their values. A tool's fingers are open; other joints that do not belong to the arm
    stand in the middle of their ranges, coupled ones as their leader says. The arm's own joints stand in the middle
    of their ranges too where that is a usable posture: away from singularities and with the links apart. Else the
    most usable of many postures is taken.
    """
    home: dict[str, float] = {}
    for index in range(model.njnt):
        name, (low, high) = model.joint(index).name, model.jnt_range[index]
        if name in given:
            home[name] = given[name]
        elif not model.jnt_limited[index]:
            home[name] = 0.0
        else:
            home[name] = float(high) if name.startswith(tool_prefix) else 0.5 * float(low + high)
    for (follower, leader), (offset, factor) in mimics(spec).items():
        if follower not in given and follower in home and leader in home:
            home[follower] = offset + factor * home[leader]
    if all(name in given for name in joints):
        return home, ()
    posture, notes = _usable_posture(model, joints, home)
    return {**home, **dict(zip(joints, posture.tolist(), strict=True))}, notes


def _usable_posture(
    model: mujoco.MjModel, joints: tuple[str, ...], home: Mapping[str, float]
) -> tuple[Array, tuple[str, ...]]:
    """Return the middle of the ranges if it is a usable posture, else the best of many, shape (n_joints,)."""
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
        return candidates[order[0]], ("home: no posture was found in which all links keep 20 mm apart",)
    for index in range(len(best)):  # a joint that makes no difference, such as the first, stands in its middle
        tidier = np.where(np.arange(len(best)) == index, middle, best)
        if search.score(tidier) >= _AS_GOOD * search.score(best) and search.apart(tidier):
            best = tidier
    return best, ()


class _HomeSearch:
    """Rates postures of an arm: how far from singular, how far from limits, whether links keep apart."""

    def __init__(self, model: mujoco.MjModel, joints: tuple[str, ...], home: Mapping[str, float]) -> None:
        self._model, self._data = model, mujoco.MjData(model)
        ids = [model.joint(name).id for name in joints]
        for name, value in home.items():
            self._data.qpos[model.jnt_qposadr[model.joint(name).id]] = value
        self._qpos, self._dofs = model.jnt_qposadr[ids], model.jnt_dofadr[ids]
        self._bodies = [int(model.jnt_bodyid[i]) for i in ids]
        self._flange, self._moved = model.site("flange").id, False
        limited = model.jnt_limited[ids].astype(bool)
        slides = model.jnt_type[ids] == SLIDE
        far = np.where(slides, 1.0, math.pi)
        self._low = np.where(limited, np.maximum(model.jnt_range[ids, 0], -far), -far)
        self._high = np.where(limited, np.minimum(model.jnt_range[ids, 1], far), far)
        self._jacobian = np.zeros((6, model.nv))
        pairs, probes = self._link_pairs(), self.candidates()[:: _SAMPLES // 8]
        # Shapes that overlap in every posture are drawn too large or belong together; they say nothing about a home.
        self._pairs = [pair for pair in pairs if any(self._distance(pair, q) >= _APART for q in probes)]
        # An arm whose last joints do not move the flange has a linear part that is always singular.
        self._linear_counts = any(self._singular_values(q)[0] > 1e-6 for q in probes)
        anchors = self._move(np.array([home[name] for name in joints])).xanchor[ids]
        ends = np.vstack([anchors, self._data.site_xpos[self._flange]])
        self.reach = float(np.linalg.norm(np.diff(ends, axis=0), axis=1).sum())  # [m] along the links

    def candidates(self) -> Array:
        """Return postures that fill the ranges evenly (a Sobol sequence), shape (n, n_joints)."""
        fractions = qmc.Sobol(len(self._low), scramble=False).random(_SAMPLES)
        return np.asarray(self._low + (0.1 + 0.8 * fractions) * (self._high - self._low))

    def bend(self, q: Array) -> float:
        """Return how far a posture is from a singular one [m/rad]; 0 where singular.

        It is the smallest singular value of the flange's Jacobian, whose rotations are weighted by 0.3 m, and of its
        linear part: an arm with few joints may lose a direction while it can still rotate.
        """
        linear, whole = self._singular_values(q)
        return min(linear, whole) if self._linear_counts else whole

    def _singular_values(self, q: Array) -> tuple[float, float]:
        """Return the smallest singular values of the Jacobian's linear part and of the whole Jacobian."""
        mujoco.mj_comPos(self._model, self._move(q))
        mujoco.mj_jacSite(self._model, self._data, self._jacobian[:3], self._jacobian[3:], self._flange)
        linear, angular = self._jacobian[:3, self._dofs], self._jacobian[3:, self._dofs]
        stacked = np.vstack([linear, _ANGLE_LENGTH * angular])
        smallest = [float(np.linalg.svd(part, compute_uv=False)[-1]) for part in (linear, stacked)]
        return smallest[0], smallest[1]

    def score(self, q: Array) -> float:
        """Return how good a home is: far from singular, not near limits, the flange not below the base."""
        bend = self.bend(q)
        margin = float(np.min(np.minimum(q - self._low, self._high - q) / (self._high - self._low)))
        below = self._data.site_xpos[self._flange, 2] < 0.0
        return bend * min(1.0, 4.0 * margin) * (0.5 if below else 1.0)

    def apart(self, q: Array) -> bool:
        """Return whether links that do not share a joint keep 20 mm apart."""
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
        """Return the pairs of shapes on links with at least two joints between them."""
        model = self._model
        links: list[tuple[int, int]] = []
        for geom in np.flatnonzero(model.geom_group == COLLISION_GROUP).tolist():
            body, link = int(model.geom_bodyid[geom]), 0
            while body > 0 and link == 0:
                link = self._bodies.index(body) + 1 if body in self._bodies else 0
                body = int(model.body_parentid[body])
            links.append((geom, link))
        return [(a, b) for i, (a, one) in enumerate(links) for b, other in links[i + 1 :] if abs(one - other) >= 2]
