"""The nodes of a run's scene in viser: the floor, the mean body (or the medoid), draws, cameras, points, and the time.

The first frame makes a node, and each later frame changes it. The page lists the names of the nodes as layers.

viser records a scene through its server. The server used here never listens: no port of this machine is opened, and nothing is printed.
"""

import io
import math
from collections.abc import AsyncIterator, Iterator, Sequence
from contextlib import asynccontextmanager, contextmanager, redirect_stdout
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, Literal, NamedTuple
from unittest.mock import patch

import numpy as np
from jaxtyping import Float

from bayes_body.base.errors import escaped
from bayes_body.base.geometry import rotations
from bayes_body.model.body.solids import Body
from bayes_body.recording.observation.pictures import Colours
from bayes_body.recording.session.session import CameraSpec
from bayes_body.view.colours import CAMERAS, FLOOR, KEYPOINTS, TRUTH, Colour, over_image
from bayes_body.view.report.inspection import spoken
from bayes_body.view.viewer.motion import Pose
from bayes_body.view.viewer.recording import Seen
from bayes_body.view.viewer.solids import part_mesh

if TYPE_CHECKING:
    from viser import SceneApi, ViserServer

# Metres: thickness of a draw's lines, size of points, size of a camera's pyramid, length of the world's axes, and floor around the path.
LINE, POINT, PYRAMID, AXES, AROUND = 0.003, 0.035, 0.35, 0.4, 4.0
# The mean is translucent, so that draws and markers inside it are seen. Draws are darker than the mean, by this factor.
OPACITY, DARKER = 0.6, 0.7
# JPEG's quality, up to 100.
QUALITY = 60
# The first look: metres to the path's box, and radians from the next camera, at most, and above the horizon.
DISTANCE, BESIDE, ABOVE = 2.3, math.radians(60), math.radians(15)
# Metres in front of the path's middle, where the time stands.
FRONT = 0.7
# Metres from the origin of the highest part to a person's name.
ABOVE_HEAD = 0.4


class Look(NamedTuple):
    """What the scene is about, metres.

    Attributes:
        middle: the middle of the body's path.
        size: the longest side of the box around the path.
        eye: from where the scene is seen at first.
        fov: height of what is seen, radians.
    """

    middle: Float[np.ndarray, "3"]
    size: float
    eye: Float[np.ndarray, "3"]
    fov: float = math.radians(50)


def look_at(poses: Sequence[Pose], cameras: Sequence[CameraSpec], up: str) -> Look:
    """Return the first look at the path of the mean body, a little from above, and from where no camera stands in the way."""
    points, axis = np.concatenate([pose.origins for pose in poses]), "xyz".index(up)
    low, high = points.min(axis=0), points.max(axis=0)
    middle, size = (low + high) / 2, float((high - low).max())
    # The horizontal axes, such that a positive angle turns from the first to the second about the upward axis.
    first, second = (axis + 1) % 3, (axis + 2) % 3
    places = [-camera.rotation.T @ camera.translation_m - middle for camera in cameras]
    angles = np.sort([math.atan2(place[second], place[first]) for place in places] or [0.0])
    gaps = np.diff(angles, append=angles[0] + 2 * math.pi)
    angle = angles[gaps.argmax()] + min(gaps.max() / 2, BESIDE)
    towards = np.zeros(3)
    towards[[first, second, axis]] = math.cos(ABOVE) * math.cos(angle), math.cos(ABOVE) * math.sin(angle), math.sin(ABOVE)
    return Look(middle, size, middle + (DISTANCE + size) * towards)


class Figure(NamedTuple):
    """A body of the scene.

    Attributes:
        body: its shape.
        name: the person's name; empty if there is only one person.
        colour: the person's one colour; None: the parts have the colours of their sides.
    """

    body: Body
    name: str = ""
    colour: Colour | None = None

    @property
    def parts(self) -> list[Colour]:
        """The colours of the parts."""
        return [over_image(name) if self.colour is None else self.colour for name in self.body.topology.names]

    def layer(self, name: str) -> str:
        """Return the name of a layer of the page that belongs to the person."""
        return f"/{self.name[:1].upper()}{self.name[1:]}, {name.lower()}" if self.name else f"/{name}"


class Scene:
    """A scene to which frames are shown, one after the other."""

    def __init__(self, scene: "SceneApi", up: Literal["x", "y", "z"], look: Look, keypoints: Colour = KEYPOINTS) -> None:
        self.scene, self.up, self.keypoint_colour = scene, "xyz".index(up), keypoints
        self.nodes: dict[str, Any] = {}
        self.radii: dict[str, np.ndarray] = {}
        scene.set_up_direction(np.eye(3)[self.up])
        # The time stands on the floor before the person.
        forward = (look.eye - look.middle) * (np.arange(3) != self.up)
        self.time_place = look.middle + FRONT * forward / np.linalg.norm(forward)
        self.time_place[self.up] = 0.0
        self._floor(look)

    def _floor(self, look: Look) -> None:
        """Draw tiles of one metre at height 0 under the path, and the world's axes at its origin."""
        place = np.round(look.middle)
        place[self.up] = 0.0
        size = 2 * float(np.ceil(look.size / 2 + AROUND))
        plane: Literal["yz", "xz", "xy"] = ("yz", "xz", "xy")[self.up]
        style: dict[str, Any] = {"cell_color": FLOOR, "section_color": FLOOR, "cell_size": 1.0, "section_size": 1.0, "shadow_opacity": 0.2}
        self.scene.add_grid("/Floor, tiles of 1 m", size, size, plane=plane, position=place, **style)
        axes = self.scene.world_axes
        axes.axes_length, axes.axes_radius, axes.visible = AXES, 0.008, True

    def show(self, poses: Sequence[tuple[Figure, Pose | None]], evidence: Seen, time: str) -> None:
        """Show a frame: the bodies with their poses, None for a person who is not there, and the label of the time."""
        for figure, pose in poses:
            if pose is None:
                self._hide(figure)
            else:
                self._show(figure, pose)
        for number, (camera, image) in enumerate(zip(evidence.cameras, evidence.images, strict=True), 1):
            self._camera(f"{number} {_named(camera.name)}", camera, image)
        self._points("/True markers", evidence.truth, TRUTH)
        self._points("/Triangulated keypoints", evidence.keypoints, self.keypoint_colour)
        self._label("/Time", time, self.time_place)

    def _show(self, figure: Figure, pose: Pose) -> None:
        for part in range(len(figure.parts)):
            self._part(figure, part, pose)
        if len(pose.draws):
            self._draws(figure, pose.draws)
        if figure.name:
            # Above the highest part.
            highest = pose.origins[pose.origins[:, self.up].argmax()]
            self._label(f"/Names/{_named(figure.name)}", escaped(figure.name), highest + ABOVE_HEAD * np.eye(3)[self.up])
            _make_visible(self.nodes[f"/Names/{_named(figure.name)}"])

    def _hide(self, figure: Figure) -> None:
        names = [self._part_name(figure, part) for part in range(len(figure.parts))]
        for name in (*names, figure.layer("Draws"), f"/Names/{_named(figure.name)}"):
            if node := self.nodes.get(name):
                node.visible = False

    def _part_name(self, figure: Figure, part: int) -> str:
        return f"{figure.layer('Mean body')}/{part + 1} {_named(spoken(figure.body.topology.names[part]))}"

    def _part(self, figure: Figure, part: int, pose: Pose) -> None:
        name = self._part_name(figure, part)
        radii, node = pose.radii[part], self.nodes.get(name)
        if node is None:
            vertices, faces = part_mesh(figure.body, part, radii)
            node = self.nodes[name] = self.scene.add_mesh_simple(name, vertices, faces, color=figure.parts[part], opacity=OPACITY)
        elif not np.array_equal(radii, self.radii[name]):
            node.vertices = part_mesh(figure.body, part, radii).vertices
        self.radii[name] = radii
        node.position, node.wxyz = pose.origins[part], pose.quaternions[part]
        _make_visible(node)

    def _draws(self, figure: Figure, draws: Float[np.ndarray, "draw part 2 3"]) -> None:
        # Whole tenths of a millimetre, so that the file compresses.
        lines, name = np.round(draws.reshape(-1, 2, 3), 4).astype(np.float32), figure.layer("Draws")
        if node := self.nodes.get(name):
            node.points = lines
            _make_visible(node)
            return
        dark = (DARKER * np.array(figure.parts)).astype(np.uint8)
        colours = np.broadcast_to(dark[None, :, None], draws.shape).reshape(-1, 2, 3)
        self.nodes[name] = self.scene.add_line_segments(name, lines, colours, thickness=LINE)

    def _camera(self, last: str, camera: CameraSpec, image: Colours | None) -> None:
        (width, height), (fx, fy), name = camera.size_px, camera.focal_px, f"/Cameras/{last}"
        place, turn = -camera.rotation.T @ camera.translation_m, np.asarray(rotations.from_matrix(camera.rotation.T))
        node = self.nodes.get(name)
        if node is None:
            style: dict[str, Any] = {"scale": PYRAMID, "color": CAMERAS, "thickness": 0.008, "cast_shadow": False, "jpeg_quality": QUALITY}
            fov, aspect = 2 * math.atan(height / (2 * fy)), width * fy / (height * fx)
            node = self.nodes[name] = self.scene.add_camera_frustum(name, fov, aspect, format="jpeg", image=image, **style)
        else:
            node.image = image
        node.position, node.wxyz = place, turn
        self._label(f"/Camera names/{last}", escaped(camera.name), place + PYRAMID * np.eye(3)[self.up])

    def _points(self, name: str, points: Float[np.ndarray, "point 3"], colour: Colour) -> None:
        """Show points; without any in this frame the node is hidden."""
        node = self.nodes.get(name)
        if node is not None:
            node.visible = bool(len(points))
            if len(points):
                node.points = points.astype(np.float32)
        elif len(points):
            style: dict[str, Any] = {"point_size": POINT, "point_shape": "circle", "precision": "float32"}
            self.nodes[name] = self.scene.add_point_cloud(name, points, colour, **style)

    def _label(self, name: str, text: str, place: Float[np.ndarray, "3"]) -> None:
        node = self.nodes.get(name)
        if node is None:
            self.nodes[name] = self.scene.add_label(name, text, position=place, anchor="top-center")
        else:
            node.text, node.position = text, place


def _make_visible(node: Any) -> None:
    """Show a node that was hidden; nothing is recorded for one that is shown."""
    if not node.visible:
        node.visible = True


def _named(text: str) -> str:
    """Return a text as the last part of a node's name, in which / would begin another part."""
    return escaped(text).replace("/", "∕")


@contextmanager
def deaf_server() -> Iterator["ViserServer"]:
    """Yield the server of an empty scene, and stop it at the end."""
    import websockets.asyncio.server
    from viser import ViserServer

    with redirect_stdout(io.StringIO()), patch.object(websockets.asyncio.server, "serve", _nothing):
        server = ViserServer(host="127.0.0.1", port=0, verbose=False)
        try:
            yield server
        finally:
            server.stop()


@asynccontextmanager
async def _nothing(*arguments: Any, **options: Any) -> AsyncIterator[SimpleNamespace]:
    """Stand in for the function of `websockets` that opens a port."""
    del arguments, options
    yield SimpleNamespace(server=SimpleNamespace(sockets=()))
