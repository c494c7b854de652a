"""A person in the 3-D playback: an articulated figure that stands beside the robot and moves with it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.capture.skeleton import JOINT, JOINTS, Skeleton, Tracking
from imitarm.errors import InputError
from imitarm.kinematics.pose import Pose, matrix_to_quaternion
from imitarm.viewer import palette
from imitarm.viewer.geometry import Mesh, cylinder, ellipsoid, merge
from imitarm.viewer.stage import Mover, lit, node_name

Array = NDArray[np.float64]

_GONE: Final = 0.25  # [s] a person who has not been seen for longer is not drawn
_STEP: Final = 2.0**-10  # [m], [-] poses are rounded to this (1 mm): a camera is less precise
_HIPS: Final = 0.9  # [m] above the floor, used when no foot is seen
_SOLE: Final = 0.036  # [m] radius of a foot around its joint
_PALE: Final = 0.55  # fraction of white in the colour of joints that were only inferred
_BODY: Final = "#6f7a8a"
_SKIN: Final = "#c9a58c"
# from, to, radius of the bone, of the ball where it begins, of the ball where it ends [m]
_BONES: Final[tuple[tuple[str, str, float, float, float], ...]] = (
    ("neck", "head", 0.045, 0.05, 0.0),
    ("spine_shoulder", "neck", 0.05, 0.055, 0.0),
    ("spine_shoulder", "shoulder_left", 0.04, 0.055, 0.0),
    ("spine_shoulder", "shoulder_right", 0.04, 0.055, 0.0),
    ("hip_left", "hip_right", 0.085, 0.085, 0.085),
    *((f"shoulder_{side}", f"elbow_{side}", 0.042, 0.062, 0.042) for side in ("left", "right")),
    *((f"elbow_{side}", f"wrist_{side}", 0.034, 0.046, 0.034) for side in ("left", "right")),
    *((f"wrist_{side}", f"hand_{side}", 0.03, 0.037, 0.0) for side in ("left", "right")),
    *((f"hand_{side}", f"hand_tip_{side}", 0.022, 0.036, 0.022) for side in ("left", "right")),
    *((f"wrist_{side}", f"thumb_{side}", 0.012, 0.012, 0.014) for side in ("left", "right")),
    *((f"hip_{side}", f"knee_{side}", 0.065, 0.085, 0.06) for side in ("left", "right")),
    *((f"knee_{side}", f"ankle_{side}", 0.048, 0.062, 0.044) for side in ("left", "right")),
    *((f"ankle_{side}", f"foot_{side}", _SOLE, 0.044, _SOLE) for side in ("left", "right")),
)
_HEAD: Final = (0.075, 0.09, 0.115)  # [m] semi-axes: across, forward, up
_TRUNK: Final = (0.165, 0.1)  # [m] semi-axes across and forward
_TRUNK_LENGTH: Final = 0.58  # third semi-axis, relative to the length of the spine
_ARM: Final = ("shoulder", "elbow", "wrist", "hand", "hand_tip", "thumb")


@dataclass(frozen=True, eq=False)
class PersonMark:
    """The joint positions of a person in each frame, for drawing.

    Attributes:
        name: name of the person, unique in the 3-D scene.
        positions: positions of the joints :data:`imitarm.capture.skeleton.JOINTS` in the world frame, shape (n_frames,
            25, 3) [m]; NaN where lost.
        tracking: :class:`~imitarm.capture.skeleton.Tracking` of each joint, shape (n_frames, 25). Inferred joints are
            drawn in a paler colour; lost joints are not drawn.
        side: which arm is drawn in the colour of a demonstration, ``"left"`` or ``"right"``.

    Raises:
        InputError: when a shape is wrong.
    """

    name: str
    positions: Array
    tracking: NDArray[np.int8]
    side: str = "right"

    def __post_init__(self) -> None:
        n = len(self.positions)
        if np.shape(self.positions) != (n, len(JOINTS), 3) or np.shape(self.tracking) != (n, len(JOINTS)) or n == 0:
            raise InputError(
                f"PersonMark {self.name}: needs positions (n, {len(JOINTS)}, 3) and tracking (n, {len(JOINTS)}), got "
                f"{np.shape(self.positions)} and {np.shape(self.tracking)}"
            )

    def __len__(self) -> int:
        return len(self.positions)

    @classmethod
    def beside(
        cls,
        skeletons: Sequence[Skeleton],
        times: ArrayLike,
        sensor_to_base: Pose,
        *,
        side: str = "right",
        place: tuple[float, float] = (0.0, 1.5),
        floor: float = 0.0,
        name: str = "person",
    ) -> PersonMark:
        """Place a recorded person beside a robot. The person is rotated such that both move in the same directions.

        Args:
            skeletons: at least one skeleton, in the order of their times. If no skeleton follows within 0.25 s, the
                person disappears until the next skeleton. After the last skeleton, the person stands still.
            times: times of the frames to draw, counted from the first skeleton, shape (n_frames,) [s].
            sensor_to_base: pose of the sensor in the base frame; only its rotation is used.
            side: which arm the robot follows, ``"left"`` or ``"right"``.
            place: median position of the hips in the base frame: x and y [m].
            floor: height of the floor in the base frame [m].
            name: name of the person, unique in the 3-D scene.

        Raises:
            InputError: when there is no skeleton.
        """
        if not skeletons:
            raise InputError(f"PersonMark {name}: there is no skeleton to draw")
        at = np.array([skeleton.time for skeleton in skeletons]) - skeletons[0].time
        rotated = np.array([skeleton.positions for skeleton in skeletons]) @ sensor_to_base.rotation.T
        t = np.minimum(np.asarray(times, dtype=float), at[-1])
        newest = np.searchsorted(at, t + 1e-9, side="right") - 1
        tracking = np.array([skeleton.tracking for skeleton in skeletons])[newest]
        tracking[t - at[newest] > _GONE] = Tracking.LOST
        return cls(name, (rotated + _shift(rotated, place, floor))[newest], tracking, side)

    @property
    def points_to_see(self) -> Array:
        """Points that the camera must show, shape (n, 3) [m]: the median of each joint, and the path of the arm."""
        shown = np.where((self.tracking > Tracking.LOST)[..., None], self.positions, np.nan)
        seen = ~np.isnan(shown).all(axis=(0, 2))
        arm = shown[:, [JOINT[f"{part}_{self.side}"] for part in _ARM]].reshape(-1, 3)
        return np.concatenate([np.nanmedian(shown[:, seen], axis=0), arm[np.isfinite(arm).all(axis=1)]])


def _shift(joints: Array, place: tuple[float, float], floor: float) -> Array:
    """Return the displacement (3,) [m] that makes a person with joints (n, 25, 3) stand on the floor at ``place``."""
    usual = np.array([_median(joints[:, joint]) for joint in range(len(JOINTS))])
    feet = [usual[JOINT[f"{part}_{side}"], 2] for part in ("ankle", "foot") for side in ("left", "right")]
    low = np.nanmin(feet) - _SOLE if np.isfinite(feet).any() else np.nan
    known = np.flatnonzero(np.isfinite(usual).all(axis=1))
    middle = usual[JOINT["spine_base"]]
    if not np.isfinite(middle).all():
        middle = usual[known].mean(axis=0) if len(known) else np.zeros(3)
    if not np.isfinite(low):
        low = middle[2] - _HIPS
    return np.array([place[0] - middle[0], place[1] - middle[1], floor - low])


def _median(points: Array) -> Array:
    """Return the median (3,) of points (n, 3), ignoring points that are NaN; NaN if all points are NaN."""
    known = points[np.isfinite(points).all(axis=1)]
    return np.median(known, axis=0) if len(known) else np.full(3, np.nan)


@dataclass(frozen=True, eq=False)
class _Piece:
    """A rigid piece of the drawn person, and its pose in each frame.

    Attributes:
        name: name that is unique among the pieces of the person.
        mesh: mesh in the coordinate frame of the piece.
        colour: ``"#rrggbb"``.
        position: positions, shape (n_frames, 3) [m]; NaN where unknown.
        wxyz: quaternions, shape (n_frames, 4).
        tracking: tracking states, shape (n_frames,).
    """

    name: str
    mesh: Mesh
    colour: str
    position: Array
    wxyz: Array
    tracking: NDArray[np.int8]


def draw_person(server: Any, person: PersonMark) -> list[Mover]:
    """Draw a person in the pose of the first frame, and return the pieces of the drawing that change later.

    Every bone is rigid and has its median length over all frames. The pieces are separate nodes of viser's scene, not
    one batch. The browser builds a batch asynchronously, so a batch could show the person and the robot in different
    frames after a jump in time.
    """
    movers = []
    for piece in _pieces(person):
        known = (piece.tracking > Tracking.LOST) & np.isfinite(piece.position).all(axis=1)
        if not known.any():
            continue
        last = np.maximum.accumulate(np.where(known, np.arange(len(known)), int(np.argmax(known))))
        poses = {"position": _rounded(piece.position[last]), "wxyz": _rounded(piece.wxyz[last])}
        name = node_name("person", person.name, piece.name)
        frame = server.scene.add_frame(name, show_axes=False, position=poses["position"][0], wxyz=poses["wxyz"][0])
        movers.append(Mover(frame, poses))
        for look, white, state in (("seen", 0.0, Tracking.TRACKED), ("inferred", _PALE, Tracking.INFERRED)):
            visible = known & (piece.tracking == state)
            if visible.any():
                mesh = server.scene.add_mesh_simple(
                    f"{name}/{look}",
                    piece.mesh.vertices,
                    piece.mesh.faces,
                    color=lit(_paler(piece.colour, white)),
                    visible=bool(visible[0]),
                )
                movers.append(Mover(mesh, {"visible": visible}))
    return movers


def _rounded(values: Array) -> Array:
    return np.round(values / _STEP) * _STEP


def _pieces(person: PersonMark) -> Iterator[_Piece]:
    """Yield the bones, then the head and the trunk."""
    p = {name: person.positions[:, JOINT[name]] for name in JOINTS}
    t = {name: person.tracking[:, JOINT[name]] for name in JOINTS}
    for start, end, *radii in _BONES:
        along = p[end] - p[start]
        length = np.linalg.norm(along, axis=1)
        rotations = _rotations_from_z(along / np.maximum(length, 1e-9)[:, None])
        known = length[np.isfinite(length)]
        mesh = _bone(float(np.median(known)) if len(known) else 0.0, *radii)
        colour = _colour(person.side, start, end)
        yield _Piece(f"{start} {end}", mesh, colour, p[start], rotations, np.minimum(t[start], t[end]))
    across = p["shoulder_left"] - p["shoulder_right"]
    yield _Piece("head", ellipsoid(_HEAD), _SKIN, p["head"], _upright(p["head"] - p["neck"], across), t["head"])
    spine = p["spine_shoulder"] - p["spine_base"]
    lengths = np.linalg.norm(spine, axis=1)
    lengths = lengths[np.isfinite(lengths)]
    trunk = ellipsoid([*_TRUNK, _TRUNK_LENGTH * float(np.median(lengths)) if len(lengths) else 0.1])
    middle = 0.5 * (p["spine_shoulder"] + p["spine_base"])
    yield _Piece(
        "trunk", trunk, _BODY, middle, _upright(spine, across), np.minimum(t["spine_base"], t["spine_shoulder"])
    )


def _bone(length: float, radius: float, begins: float, ends: float) -> Mesh:
    """Return the mesh of a bone along z: a ball at the origin, a cylinder, and a ball at the end if ``ends`` > 0."""
    half = 0.5 * max(length, 1e-3)
    parts = [cylinder(radius, half).moved([0.0, 0.0, half], np.eye(3)), ellipsoid([begins] * 3)]
    if ends > 0.0:
        parts.append(ellipsoid([ends] * 3).moved([0.0, 0.0, 2.0 * half], np.eye(3)))
    return merge(parts)


def _upright(up: Array, across: Array) -> Array:
    """Return rotations (n, 4) with the z axis along ``up`` (n, 3) and the x axis as near to ``across`` as possible."""
    rotations = np.tile([1.0, 0.0, 0.0, 0.0], (len(up), 1))
    y = np.cross(up, across)
    known = np.linalg.norm(y, axis=1) > 1e-6  # False for NaN, too
    z = up[known] / np.linalg.norm(up[known], axis=1, keepdims=True)
    y = y[known] / np.linalg.norm(y[known], axis=1, keepdims=True)
    rotations[known] = matrix_to_quaternion(np.stack([np.cross(y, z), y, z], axis=2))
    return rotations


def _rotations_from_z(directions: Array) -> Array:
    """Return the smallest rotations (..., 4) that take the z axis to the unit vectors (..., 3)."""
    x, y, z = np.moveaxis(directions, -1, 0)
    rotations = np.stack([1.0 + z, -y, x, np.zeros_like(x)], axis=-1)
    length = np.linalg.norm(rotations, axis=-1, keepdims=True)
    back = ~(length > 1e-8)  # straight down or unknown: bones are round, so any half rotation will do
    return np.where(back, [0.0, 1.0, 0.0, 0.0], rotations / np.where(back, 1.0, length))


def _paler(colour: str, white: float) -> list[float]:
    """Return a colour mixed with a fraction ``white`` of white, as red, green and blue from 0 to 1."""
    return [(1.0 - white) * part / 255.0 + white for part in palette.rgb(colour)]


def _colour(side: str, start: str, end: str) -> str:
    """Return the colour of a bone: the demonstration's colour for the followed arm, skin colour for hands and neck."""
    followed = {f"{part}_{side}" for part in _ARM}
    if start in followed and end in followed:
        return palette.DEMONSTRATION
    bare = ("hand", "thumb", "head", "neck")
    return _SKIN if end.startswith(bare) else _BODY
