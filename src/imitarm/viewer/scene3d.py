"""Interactive 3-D playback in a browser, as one HTML page that needs no network.

:func:`playback_html` draws the bodies of a :class:`~imitarm.viewer.recording.Recording`, paths and Gaussian components,
and moves the bodies as recorded. The package viser draws in the reader's browser. Viser needs a server on this machine
only while the page is written.
"""

from __future__ import annotations

import socket
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import rich
from numpy.typing import NDArray

from imitarm.errors import InputError, TaskFailedError
from imitarm.kinematics.pose import matrix_to_quaternion, quaternion_to_matrix
from imitarm.viewer import palette
from imitarm.viewer.person import PersonMark, draw_person
from imitarm.viewer.recording import Prediction, Recording
from imitarm.viewer.stage import (
    STEP,
    Camera,
    Mover,
    Part,
    body_parts,
    floor_height,
    lit,
    node_name,
    points_to_see,
)

Array = NDArray[np.float64]

_REST: Final = 1.5  # [s] the last frame stays before the playback starts again
_CHI2_95: Final = 7.815  # 95 % of a 3-D Gaussian is within sqrt(7.815) sigma
# On a slow machine viser shows a warning that hides the arm, and its fade-in never ends; both are switched off.
_STYLE: Final = "<style>.mantine-Notifications-root{display:none!important}canvas{opacity:1!important}</style>"
_MANY: Final = 24  # from this many equal bodies, draw one batch: a smaller file, but it may lag on a slow machine
_PATH_POINTS: Final = 160
_BACKDROP: Final = {False: ((246, 247, 249), (221, 225, 231)), True: ((38, 42, 50), (20, 22, 27))}  # dark: top, bottom


@dataclass(frozen=True, eq=False)
class PathMark:
    """A path to draw: ``positions`` (n, 3) [m] in the world frame, and the ``thickness`` of the line [m]."""

    name: str
    positions: Array
    colour: str = palette.ADAPTED
    thickness: float = 0.005


@dataclass(frozen=True, eq=False)
class ComponentMark:
    """A Gaussian component to draw as its 95 % ellipsoid: ``mean`` (3,) [m] and ``covariance`` (3, 3) [m^2]."""

    name: str
    mean: Array
    covariance: Array
    colour: str = palette.UNMOVED
    opacity: float = 0.22


def _add_mesh(server: Any, name: str, part: Part) -> None:
    opacity = part.rgba[3]
    server.scene.add_mesh_simple(
        name,
        part.mesh.vertices,
        part.mesh.faces,
        color=lit(part.rgba),
        opacity=opacity if opacity < 1.0 else None,
        side="double" if opacity < 1.0 or not np.ptp(part.mesh.vertices, axis=0).all() else "front",
        cast_shadow=opacity >= 1.0,
    )


def _draw_bodies(server: Any, recording: Recording, parts: Mapping[int, list[Part]]) -> list[Mover]:
    """Draw every body at its first pose, and return the nodes that must move during playback.

    Many equal bodies, such as crumbs, are sent to viser as one batch, because one message for each body would make the
    page large.
    """
    positions = np.round(recording.positions / STEP) * STEP
    quaternions = np.round(recording.quaternions / STEP) * STEP
    alike: dict[tuple[bytes, tuple[float, ...]], list[int]] = {}
    for body, its_parts in parts.items():
        if len(its_parts) == 1:
            alike.setdefault((its_parts[0].mesh.vertices.tobytes(), its_parts[0].rgba), []).append(body)
    batches = [bodies for bodies in alike.values() if len(bodies) >= _MANY]
    movers = []
    for number, bodies in enumerate(batches):
        part = parts[bodies[0]][0]
        poses = {
            "batched_positions": positions[:, bodies].astype(np.float32),
            "batched_wxyzs": quaternions[:, bodies].astype(np.float32),
        }
        handle = server.scene.add_batched_meshes_simple(
            node_name("bodies", "batch", number, recording.model.body(bodies[0]).name),
            part.mesh.vertices,
            part.mesh.faces,
            poses["batched_wxyzs"][0],
            poses["batched_positions"][0],
            batched_colors=lit(part.rgba, linear=True),
            lod="off",
        )
        movers.append(Mover(handle, poses))
    for body in sorted(set(parts).difference(*batches)):
        name = node_name("bodies", body, recording.model.body(body).name)
        handle = server.scene.add_frame(name, show_axes=False, position=positions[0, body], wxyz=quaternions[0, body])
        for number, part in enumerate(parts[body]):
            _add_mesh(server, f"{name}/{number}", part)
        movers.append(Mover(handle, {"position": positions[:, body], "wxyz": quaternions[:, body]}))
    return movers


def _draw_stage(server: Any, lowest: float, camera: Camera, *, dark: bool) -> None:
    """Set the camera, the background and a grid on the floor, at height ``lowest`` [m]."""
    view = server.initial_camera
    view.position, view.look_at, view.fov = camera.position, camera.look_at, camera.field_of_view
    top, bottom = (np.array(colour, dtype=float) for colour in _BACKDROP[dark])
    shade = top + np.linspace(0.0, 1.0, 128)[:, None] * (bottom - top)
    server.scene.set_background_image(np.repeat(np.round(shade).astype(np.uint8)[:, None], 2, axis=1), format="png")
    line = (70, 76, 88) if dark else (196, 201, 209)
    server.scene.add_grid(
        "/floor",
        width=6.0,
        height=6.0,
        cell_size=0.25,
        section_size=1.0,
        cell_color=line,
        section_color=line,
        cell_thickness=0.6,
        section_thickness=1.0,
        fade_distance=9.0,
        fade_from="origin",
        shadow_opacity=0.25,
        position=(0.0, 0.0, lowest),
    )


def _draw_paths(server: Any, paths: Sequence[PathMark]) -> None:
    for path in paths:
        points = np.asarray(path.positions, dtype=float)
        points = points[np.unique(np.linspace(0, len(points) - 1, min(len(points), _PATH_POINTS)).round().astype(int))]
        server.scene.add_line_segments(
            node_name("paths", path.name),
            np.stack([points[:-1], points[1:]], axis=1),
            palette.rgb(path.colour),
            thickness=path.thickness,
        )


def _draw_components(server: Any, components: Sequence[ComponentMark]) -> None:
    for component in components:
        variances, axes = np.linalg.eigh(np.asarray(component.covariance, dtype=float))
        axes[:, 0] *= np.linalg.det(axes)  # make it a rotation, not a reflection
        semi_axes = np.sqrt(_CHI2_95 * np.maximum(variances, 0.0))
        server.scene.add_icosphere(
            node_name("components", component.name),
            1.0,
            palette.rgb(component.colour),
            opacity=component.opacity,
            scale=tuple(
                np.maximum(semi_axes, 1e-3).tolist()
            ),  # the components of a planar task are flat: keep them visible
            position=np.asarray(component.mean, dtype=float),
            wxyz=matrix_to_quaternion(axes),
            cast_shadow=False,
            receive_shadow=False,
        )


def _draw_predictions(server: Any, predictions: Sequence[Prediction]) -> list[Mover]:
    """Draw each predicted obstacle as an ellipsoid; return the nodes that must move.

    The semi-axes are the half extents of the obstacle plus its 95 % uncertainty along the axes of its local frame.
    """
    movers = []
    for number, prediction in enumerate(predictions):
        seen = np.asarray(np.isfinite(prediction.positions).all(axis=1))
        turns = prediction.quaternions
        turns = np.tile([1.0, 0.0, 0.0, 0.0], (len(seen), 1)) if turns is None else turns
        axes = quaternion_to_matrix(turns)  # the axes of the local frame, shape (n_frames, 3, 3)
        variances = np.einsum("nji,njk,nki->ni", axes, prediction.covariances, axes)
        deviations = np.sqrt(np.maximum(variances, 0.0))
        scale = np.round((prediction.extent + np.sqrt(_CHI2_95) * deviations) / STEP) * STEP
        positions = np.round(np.nan_to_num(prediction.positions) / STEP) * STEP
        handle = server.scene.add_icosphere(
            node_name("predictions", number, prediction.name),
            1.0,
            palette.rgb(palette.PREDICTED),
            opacity=0.45,
            scale=tuple(scale[0].tolist()),
            position=positions[0],
            wxyz=turns[0],
            visible=bool(seen[0]),
            cast_shadow=False,
            receive_shadow=False,
        )
        movers.append(Mover(handle, {"position": positions, "wxyz": turns, "scale": scale, "visible": seen}))
    return movers


def _free_port() -> int:
    """Return a free port of this machine; raise TaskFailedError if there is none, because viser would wait forever."""
    try:
        with socket.create_server(("127.0.0.1", 0)) as listener:
            return int(listener.getsockname()[1])
    except OSError as error:
        raise TaskFailedError(
            f"3-D playback: cannot open a port on 127.0.0.1 ({error}); allow local connections"
        ) from error


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence the package ``rich``, with which viser prints the address of its temporary server."""
    console = rich.get_console()
    before, console.quiet = console.quiet, True
    try:
        yield
    finally:
        console.quiet = before


@contextmanager
def _server() -> Iterator[Any]:
    """Run a viser server that only this machine can reach, and stop it afterwards."""
    try:
        import viser  # noqa: PLC0415 (heavy, and an extra)
    except ImportError as error:
        raise InputError(
            "3-D playback needs viser, which is not installed; install it with: pip install 'imitarm[report]'"
        ) from error
    with _quiet():
        server = viser.ViserServer(host="127.0.0.1", port=_free_port(), verbose=False)
    try:
        yield server
    finally:
        with _quiet():
            server.stop()


def playback_html(
    recording: Recording,
    *,
    paths: Sequence[PathMark] = (),
    components: Sequence[ComponentMark] = (),
    persons: Sequence[PersonMark] = (),
    camera: Camera | None = None,
    dark: bool = False,
) -> str:
    """Draw a recording and return one self-contained HTML page that plays it.

    Args:
        recording: the model and the recorded poses of its bodies. Only shapes (geoms) in groups 0 to 2 are drawn. The
            predicted positions of obstacles are drawn as translucent ellipsoids.
        paths: lines to draw.
        components: Gaussian components to draw as translucent ellipsoids.
        persons: people to draw; each must have as many frames as the recording.
        camera: the initial view; None: a view of the whole model.
        dark: whether controls and background are dark.

    Returns:
        The text of the page. The saved page opens without a network and can be shown in an iframe.

    Raises:
        InputError: when viser is not installed, or a person does not have as many frames as the recording.
        TaskFailedError: when no port of this machine can be opened.
    """
    for person in persons:
        if len(person) != len(recording):
            raise InputError(
                f"3-D playback: {person.name} has {len(person)} frames, but the recording has {len(recording)}"
            )
    parts = body_parts(recording.model)
    near = [*(path.positions for path in paths), *(person.points_to_see for person in persons)]
    view = camera or Camera.around(points_to_see(recording, parts, near))
    with _server() as server:
        _draw_stage(server, floor_height(recording, parts), view, dark=dark)
        movers = _draw_bodies(server, recording, parts)
        for person in persons:
            movers += draw_person(server, person)
        movers += _draw_predictions(server, recording.predictions)
        _draw_paths(server, paths)
        _draw_components(server, components)
        serializer = server.get_scene_serializer()
        for frame in range(1, len(recording)):
            serializer.insert_sleep(float(recording.times[frame] - recording.times[frame - 1]))
            for mover in movers:
                mover.show(frame)
        serializer.insert_sleep(_REST if len(recording) > 1 else 0.0)
        page: str = serializer.as_html(dark_mode=dark)
    return page.replace("</head>", _STYLE + "</head>", 1)
