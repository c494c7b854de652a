"""The working memory in which an arm's kinematics is computed, one for each thread."""

from __future__ import annotations

import threading
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from imitarm.kinematics.pose import Pose

Array = NDArray[np.float64]
Columns = slice | NDArray[np.int32]


class ArmMemory:
    """MuJoCo's working memory, and the posture it holds; for one thread.

    Attributes:
        data: kinematics of the posture.
        jacobian: of the site that was asked for last, shape (6, nv), linear rows first.
        linear: its first three rows.
        angular: its last three rows.
        sites: where the sites are, shape (nsite, 3) [m].
        force: shape (nv,).
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        home: Array,
        positions: Columns,
        joints: Columns,
        marked: tuple[int, ...] = (),
    ) -> None:
        """Begin at ``home``.

        Args:
            model: the arm.
            home: shape (nq,).
            positions: where the arm's joints stand in qpos.
            joints: where they stand in qvel.
            marked: sites of which :meth:`marked_jacobians` are asked for.
        """
        self.data = mujoco.MjData(model)
        self.data.qpos[:] = home
        self.jacobian = np.zeros((6, model.nv))
        self.linear, self.angular = self.jacobian[:3], self.jacobian[3:]
        self.force = np.zeros(model.nv)
        self._model, self._positions, self._joints, self._posture = model, positions, joints, b""
        stacked = np.zeros((len(marked), 3, model.nv))
        self._stacked = stacked.reshape(-1, model.nv)
        # views, where the joints stand side by side: asking for them anew each time takes as long as the computing
        self._views = None
        if isinstance(joints, slice):
            self._views = self.jacobian[:, joints], self._stacked[:, joints]
        self._marked = list(zip(marked, stacked, strict=True))
        self.sites = self.data.site_xpos
        self._qpos = self.data.qpos  # asking for it each time takes as long as the kinematics of a link

    def move_to(self, q: Array) -> None:
        """Compute the kinematics at ``q`` (n,), unless it is what the memory holds."""
        posture = q.tobytes()
        if posture != self._posture:
            self._qpos[self._positions] = q
            mujoco.mj_kinematics(self._model, self.data)
            mujoco.mj_comPos(self._model, self.data)
            self._posture = posture

    def site_pose(self, site: int) -> Pose:
        """Return the pose of a site in the base frame."""
        quaternion = np.empty(4)
        mujoco.mju_mat2Quat(quaternion, self.data.site_xmat[site])
        return Pose.trusted(self.data.site_xpos[site].copy(), quaternion)

    def site_jacobian(self, site: int) -> Array:
        """Return the Jacobian of a site, shape (6, n), as a view that the next one overwrites."""
        mujoco.mj_jacSite(self._model, self.data, self.linear, self.angular, site)
        return self.jacobian[:, self._joints] if self._views is None else self._views[0]

    def marked_jacobians(self) -> Array:
        """Return the Jacobians of the marked sites below each other, (3 m, n): a view that the next ones overwrite."""
        for site, rows in self._marked:
            mujoco.mj_jacSite(self._model, self.data, rows, None, site)
        return self._stacked[:, self._joints] if self._views is None else self._views[1]


class ArmMemories(threading.local):
    """The working memory of the thread that asks."""

    def __init__(self, *arguments: Any) -> None:
        """Take what :class:`ArmMemory` takes."""
        self.mine = ArmMemory(*arguments)


def columns(indices: NDArray[np.int32]) -> Columns:
    """Return consecutive indices as a slice, which is several times quicker."""
    first = int(indices[0])
    return slice(first, first + len(indices)) if np.all(np.diff(indices) == 1) else indices
