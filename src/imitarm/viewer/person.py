"""A person in the 3-D playback: a jointed figure that stands beside the robot and moves with it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imitarm.capture.skeleton import JOINT, JOINTS, Skeleton, Tracking
from imitarm.errors import InputError
from imitarm.kinematics.pose import Pose, matrix_to_quaternion
from imitarm.viewer import palette
from imitarm.viewer.geometry import Mesh, cylinder, ellipsoid
from imitarm.viewer.nodes import Mover, lit, node_name

Array = NDArray[np.float64]

_GONE: Final = 0.25  # [s] a person not seen for longer is not drawn
_STEP: Final = 2.0**-10  # [m], [-] as nodes.STEP, coarser: a camera sees no millimetres
_HIDDEN: Final = 1e-5  # what is not to be seen is drawn as small as this
_HIPS: Final = 0.9  # [m] above the floor, where no foot is seen
_PALE: Final = 0.55  # share of white in what was only inferred
_BODY: Final = "#6f7a8a"
_SKIN: Final = "#c9a58c"
# from, to, radius [m]
_BONES: Final[tuple[tuple[str, str, float], ...]] = (
    ("neck", "head", 0.045),
    ("spine_shoulder", "neck", 0.05),
    ("spine_shoulder", "shoulder_left", 0.05),
    ("spine_shoulder", "shoulder_right", 0.05),
    ("hip_left", "hip_right", 0.085),
    *((f"shoulder_{side}", f"elbow_{side}", 0.042) for side in ("left", "right")),
    *((f"elbow_{side}", f"wrist_{side}", 0.034) for side in ("left", "right")),
    *((f"wrist_{side}", f"hand_{side}", 0.03) for side in ("left", "right")),
    *((f"hand_{side}", f"hand_tip_{side}", 0.022) for side in ("left", "right")),
    *((f"wrist_{side}", f"thumb_{side}", 0.012) for side in ("left", "right")),
    *((f"hip_{side}", f"knee_{side}", 0.065) for side in ("left", "right")),
    *((f"knee_{side}", f"ankle_{side}", 0.048) for side in ("left", "right")),
    *((f"ankle_{side}", f"foot_{side}", 0.036) for side in ("left", "right")),
)
# a ball about each end of the bones, radius [m]
_BALLS: Final = {
    "spine_shoulder": 0.055,
    **{f"shoulder_{side}": 0.056 for side in ("left", "right")},
    **{f"elbow_{side}": 0.046 for side in ("left", "right")},
    **{f"wrist_{side}": 0.037 for side in ("left", "right")},
    **{f"hand_{side}": 0.036 for side in ("left", "right")},
    **{f"hand_tip_{side}": 0.022 for side in ("left", "right")},
    **{f"thumb_{side}": 0.014 for side in ("left", "right")},
    **{f"hip_{side}": 0.085 for side in ("left", "right")},
    **{f"knee_{side}": 0.062 for side in ("left", "right")},
    **{f"ankle_{side}": 0.044 for side in ("left", "right")},
    **{f"foot_{side}": 0.036 for side in ("left", "right")},
}
_HEAD: Final = (0.075, 0.09, 0.115)  # [m] semi-axes: across, forward, up
_TRUNK: Final = (0.165, 0.1)  # [m] semi-axes across and forward; its length is that of the spine
_ARM: Final = ("shoulder", "elbow", "wrist", "hand", "hand_tip", "thumb")


@dataclass(frozen=True, eq=False)
class PersonMark:
    """A person to draw, frame by frame.

    Attributes:
        name: for the tree of drawn things.
        positions: of the joints :data:`imitarm.capture.skeleton.JOINTS` in the world frame, shape (n_frames, 25, 3)
            [m]; nan where lost.
        tracking: :class:`~imitarm.capture.skeleton.Tracking` of each, shape (n_frames, 25); what was inferred is drawn
            paler, what is lost not at all.
        side: the arm that is drawn in the colour of what was shown.

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
        """Put a recorded person beside a robot, turned as the correspondence says, so that both move alike.

        Args:
            skeletons: in the order of their times, at least one. In gaps, after a quarter of a second without a
                skeleton, nobody is drawn; after the last one the person stands still.
            times: of the frames to draw, since the first skeleton, shape (n_frames,) [s].
            sensor_to_base: only its rotation counts here.
            side: of the arm that is followed.
            place: where the hips are, on average, in the base frame: x and y [m].
            floor: where the feet stand, in the base frame [m].
            name: of the person.

        Raises:
            InputError: when there is no skeleton.
        """
        if not skeletons:
            raise InputError(f"PersonMark {name}: there is no skeleton to draw")
        at = np.array([skeleton.time for skeleton in skeletons]) - skeletons[0].time
        turned = np.array([skeleton.positions for skeleton in skeletons]) @ sensor_to_base.rotation.T
        t = np.minimum(np.asarray(times, dtype=float), at[-1])
        newest = np.searchsorted(at, t + 1e-9, side="right") - 1
        tracking = np.array([skeleton.tracking for skeleton in skeletons])[newest]
        tracking[t - at[newest] > _GONE] = Tracking.LOST
        return cls(name, (turned + _shift(turned, place, floor))[newest], tracking, side)

    @property
    def points_to_see(self) -> Array:
        """What belongs in the picture, shape (n, 3) [m]: the joints as they mostly are, and the arm wherever it is."""
        shown = np.where((self.tracking > Tracking.LOST)[..., None], self.positions, np.nan)
        seen = ~np.isnan(shown).all(axis=(0, 2))
        arm = shown[:, [JOINT[f"{part}_{self.side}"] for part in _ARM]].reshape(-1, 3)
        return np.concatenate([np.nanmedian(shown[:, seen], axis=0), arm[np.isfinite(arm).all(axis=1)]])


def _shift(turned: Array, place: tuple[float, float], floor: float) -> Array:
    """Return by how much joints (n, 25, 3) are moved so that the person stands at a place on the floor, (3,) [m]."""
    usual = np.array([_median(turned[:, joint]) for joint in range(len(JOINTS))])
    feet = [usual[JOINT[f"{part}_{side}"], 2] for part in ("ankle", "foot") for side in ("left", "right")]
    low = np.nanmin(feet) - _BALLS["foot_left"] if np.isfinite(feet).any() else np.nan
    known = np.flatnonzero(np.isfinite(usual).all(axis=1))
    middle = usual[JOINT["spine_base"]]
    if not np.isfinite(middle).all():
        middle = usual[known].mean(axis=0) if len(known) else np.zeros(3)
    if not np.isfinite(low):
        low = middle[2] - _HIPS
    return np.array([place[0] - middle[0], place[1] - middle[1], floor - low])


def _median(points: Array) -> Array:
    """Return the median of points (n, 3) that are known; nan when none is."""
    known = points[np.isfinite(points).all(axis=1)]
    return np.median(known, axis=0) if len(known) else np.full(3, np.nan)


def draw_person(server: Any, person: PersonMark) -> list[Mover]:
    """Draw a person as in the first frame, and return what moves: the bones and the balls at their ends.

    All bones are one batch of cylinders and all balls one of spheres: a frame is two messages.
    """
    poses = (_bones(person), _balls(person))
    meshes = (cylinder(1.0, 0.5), ellipsoid([1.0, 1.0, 1.0]))
    return [
        Mover(_add_batch(server, node_name("person", person.name, kind), mesh, pose), pose)
        for kind, mesh, pose in zip(("bones", "balls"), meshes, poses, strict=True)
    ]


def _add_batch(server: Any, name: str, mesh: Mesh, poses: dict[str, NDArray[Any]]) -> Any:
    first = {key: values[0] for key, values in poses.items()}
    return server.scene.add_batched_meshes_simple(name, mesh.vertices, mesh.faces, lod="off", **first)


def _bones(person: PersonMark) -> dict[str, NDArray[Any]]:
    """Return poses, scales and colours of the bones, frame by frame."""
    begins, ends = [JOINT[bone[0]] for bone in _BONES], [JOINT[bone[1]] for bone in _BONES]
    start, end = person.positions[:, begins], person.positions[:, ends]
    tracking = np.minimum(person.tracking[:, begins], person.tracking[:, ends])
    along = end - start
    length = np.linalg.norm(along, axis=2)
    radius = np.broadcast_to([bone[2] for bone in _BONES], length.shape)
    colours = [_colour(person.side, bone[0] if "spine" not in bone[0] else bone[1], bone[1]) for bone in _BONES]
    return _batch(
        0.5 * (start + end),
        _turns_from_z(along / np.maximum(length, 1e-9)[..., None]),
        np.stack([radius, radius, length], axis=2),
        tracking,
        colours,
    )


def _balls(person: PersonMark) -> dict[str, NDArray[Any]]:
    """Return poses, scales and colours of the balls at the bones' ends, of the head and of the trunk."""
    n = len(person)
    index = [JOINT[name] for name in _BALLS]
    upright = np.broadcast_to([1.0, 0.0, 0.0, 0.0], (n, len(index), 4))
    radii = np.broadcast_to(np.array(list(_BALLS.values()))[:, None], (n, len(index), 3))
    body, body_tracking = _body(person)
    return _batch(
        np.concatenate([person.positions[:, index], body[0]], axis=1),
        np.concatenate([upright, body[1]], axis=1),
        np.concatenate([radii, body[2]], axis=1),
        np.concatenate([person.tracking[:, index], body_tracking], axis=1),
        [*(_colour(person.side, name, name) for name in _BALLS), _SKIN, _BODY],
    )


def _body(person: PersonMark) -> tuple[tuple[Array, Array, Array], NDArray[np.int8]]:
    """Return centres, rotations and semi-axes of head and trunk, (n, 2, ...), and how they are known."""
    p = {name: person.positions[:, JOINT[name]] for name in JOINTS}
    t = {name: person.tracking[:, JOINT[name]] for name in JOINTS}
    across = p["shoulder_left"] - p["shoulder_right"]
    spine, nod = p["spine_shoulder"] - p["spine_base"], p["head"] - p["neck"]
    length = np.linalg.norm(spine, axis=1)
    half = np.stack([np.full(len(person), _TRUNK[0]), np.full(len(person), _TRUNK[1]), 0.58 * length], axis=1)
    poses = (
        np.stack([p["head"], 0.5 * (p["spine_shoulder"] + p["spine_base"])], axis=1),
        np.stack([_upright(nod, across), _upright(spine, across)], axis=1),
        np.stack([np.broadcast_to(_HEAD, half.shape), half], axis=1),
    )
    return poses, np.stack([t["head"], np.minimum(t["spine_base"], t["spine_shoulder"])], axis=1)


def _upright(up: Array, across: Array) -> Array:
    """Return rotations (n, 4) with z along ``up`` (n, 3) and x as near to ``across`` (n, 3) as it can be."""
    turns = np.tile([1.0, 0.0, 0.0, 0.0], (len(up), 1))
    y = np.cross(up, across)
    known = np.linalg.norm(y, axis=1) > 1e-6  # not nan either
    z = up[known] / np.linalg.norm(up[known], axis=1, keepdims=True)
    y = y[known] / np.linalg.norm(y[known], axis=1, keepdims=True)
    matrices = np.stack([np.cross(y, z), y, z], axis=2)
    turns[known] = matrix_to_quaternion(matrices)
    return turns


def _turns_from_z(directions: Array) -> Array:
    """Return the smallest rotations (..., 4) that take z to unit vectors (..., 3)."""
    x, y, z = np.moveaxis(directions, -1, 0)
    turns = np.stack([1.0 + z, -y, x, np.zeros_like(x)], axis=-1)
    length = np.linalg.norm(turns, axis=-1, keepdims=True)
    back = ~(length > 1e-4)  # straight down, or not known: any half turn does for what is round
    return np.where(back, [0.0, 1.0, 0.0, 0.0], turns / np.where(back, 1.0, length))


def _batch(
    positions: Array, quaternions: Array, scales: Array, tracking: NDArray[np.int8], colours: Sequence[str]
) -> dict[str, NDArray[Any]]:
    """Return what viser needs to draw a batch, frame by frame; what is lost stays where it was, too small to see."""
    known = (tracking > Tracking.LOST) & np.isfinite(positions).all(axis=2) & np.isfinite(scales).all(axis=2)
    last = np.maximum.accumulate(np.where(known, np.arange(len(known))[:, None], 0), axis=0)
    column = np.arange(known.shape[1])
    shown = {
        "batched_positions": np.nan_to_num(positions[last, column]),
        "batched_wxyzs": quaternions[last, column],
        "batched_scales": np.where(known[..., None], np.nan_to_num(scales), _HIDDEN),
    }
    rounded = {name: np.round(values / _STEP) * _STEP for name, values in shown.items()}
    rounded["batched_scales"] = np.maximum(rounded["batched_scales"], _HIDDEN)
    sure, pale = (np.array([_rgb(colour, share) for colour in colours]) for share in (0.0, _PALE))
    held = tracking[last, column]
    return {
        **{name: values.astype(np.float32) for name, values in rounded.items()},
        "batched_colors": np.where((held == Tracking.INFERRED)[..., None], pale, sure).astype(np.uint8),
    }


def _rgb(colour: str, white: float) -> Array:
    share = (1.0 - white) * np.array(palette.rgb(colour)) / 255.0 + white
    return np.round(255.0 * np.array(lit(share.tolist(), linear=True)))


def _colour(side: str, start: str, end: str) -> str:
    """Return the colour of a bone or a ball: the followed arm stands out, hands and head are skin."""
    followed = {f"{part}_{side}" for part in _ARM}
    if start in followed and end in followed:
        return palette.DEMONSTRATION
    bare = ("hand", "thumb", "head", "neck")
    return _SKIN if start.startswith(bare) or end.startswith(bare) else _BODY
