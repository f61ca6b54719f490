"""Pictures of a run: the recording with the posterior drawn over it, all cameras side by side, each cropped to the person.

The posterior mean is a translucent body with an outline (left side blue, right side orange, middle green). If no draws lie near the mean, the body is
their medoid (results/posterior/central.py), and the picture says so. Draws are thin light outlines over it; they spread where the posterior is wide.

The image of the run's recording is behind the body. A stranger's run may name any file of this machine, so only the run's own images are shown.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from cv2.typing import MatLike
from jaxtyping import Float, Int

from bayes_body.base.errors import input_error
from bayes_body.base.files.atomic import make_folder, remove_partial, replacing
from bayes_body.base.progress import Watch, unwatched
from bayes_body.model.body.solids import Body
from bayes_body.model.build import Model
from bayes_body.recording.observation.pictures import read_colour
from bayes_body.recording.session.session import Session, View
from bayes_body.results.metrics.fit import Outline, outlines, seen_in
from bayes_body.results.posterior import CentralPose, central_pose, equal_weight_poses
from bayes_body.results.posterior.weighted import settled
from bayes_body.results.storage.names import OVERLAY_FILE, OVERLAY_FOLDER
from bayes_body.tracking.draws import Draws, FrameResult
from bayes_body.view.colours import Colour, bgr, over_image
from bayes_body.view.video import h264_video
from bayes_body.view.windows import EMPTY, STILL_HEIGHT, TILE_HEIGHT, Window, grid, person_windows

if TYPE_CHECKING:
    from bayes_body.results.storage.saved_run import SavedRun

# Opacity of the mean's inside, of its outline, and of each draw; and the fraction by which the draws' colours move towards white.
INSIDE, MEAN, DRAW, LIGHTER = 0.15, 0.75, 0.3, 0.55
# How far a line may reach beyond its corners, pixels.
LINE_PX = 4
VIDEO = OVERLAY_FILE
# The most frames of the video. A frame of four cameras takes 0.1 s and 40 kB or more: 20 minutes at 60 Hz would take two hours.
MOST_PICTURES = 9000
FAN = 20
# Size of OpenCV's letters in a tile of the video.
FONT = 0.6
STILLS = 5
MEDOID = "\nmedoid, not the mean"
CAMERAS = "use fewer cameras, and check their size_px"


def draw_overlay(session: Session, draws: Draws, folder: Path, watch: Watch = unwatched) -> list[Path]:
    """Write `overlay.mp4` and up to five evenly spaced stills `overlay/frame_NNNNNN.png`, including the first and the last frame of the video.

    A still's name has the frame's number in the recording. The video has the frames `frames_drawn`, and runs at the recording's speed.

    Args:
        session: the recording.
        draws: the tracked frames.
        folder: the run's folder.
        watch: wraps the frames to show progress.

    Raises:
        InputError: the folder cannot be written, or an image of the session is missing.
    """
    frames = frames_drawn(len(draws.frames))
    stills = still_paths(folder / OVERLAY_FOLDER, frames, session.first_frame)
    remove_partial(make_folder(folder / OVERLAY_FOLDER))
    # What is known at the end about the body and the cameras, so that the windows do not jump.
    model = settled(draws.model, draws.frames[len(draws.frames) - 1])
    central = [central_of(draws.frames[index], model.body) for index in frames]
    windows = person_windows(session, model, np.stack([body.pose for body in central]), frames)
    large = [window.scaled(STILL_HEIGHT) for window in windows]
    with drawable(folder / VIDEO), replacing(folder / VIDEO) as partial, ExitStack() as video:
        write = None
        for place in watch(range(len(frames))):
            index = frames[place]
            fan = _fan(draws.frames[index], index, model.body.variable)
            picture = mosaic(session, model, index, central[place], fan, windows, place)
            write = write or video.enter_context(h264_video(partial, session.fps / frames.step, (picture.shape[1], picture.shape[0])))
            write(picture)
            if index in stills:
                write_png(stills[index], mosaic(session, model, index, central[place], fan, large, place))
    return [folder / VIDEO, *stills.values()]


def frames_drawn(frames: int) -> range:
    """Return the frames of the video of a run: all, or of a long run every second, third, ... of them, at most MOST_PICTURES."""
    return range(0, frames, -(-frames // MOST_PICTURES))


def central_of(result: FrameResult, body: Body) -> CentralPose:
    """Return the pose that stands for a frame's posterior, all runs together."""
    weights = np.exp(result.log_weights - result.log_weights.max(axis=-1, keepdims=True))
    weights /= weights.sum(axis=-1, keepdims=True)
    poses = result.states[body.variable]
    return central_pose(body, poses.reshape(-1, *poses.shape[2:]), weights.ravel())


def still_paths(folder: Path, frames: range, first: int = 0) -> dict[int, Path]:
    """Return the files of at most STILLS evenly spaced stills, by their frames; `first` is the number of frame 0."""
    chosen = np.unique(np.linspace(0, len(frames) - 1, min(STILLS, len(frames))).round().astype(int))
    return {frames[place]: folder / f"frame_{first + frames[place]:06d}.png" for place in chosen.tolist()}


def _fan(result: FrameResult, index: int, variable: str) -> Float[np.ndarray, "draw *shape"]:
    """Return a few draws of a frame, the same number from each run."""
    sample = equal_weight_poses(result, index, max(1, FAN // result.log_weights.shape[0]), variable=variable)
    return np.concatenate(list(sample))[:FAN]


def mosaic(
    session: Session,
    model: Model,
    index: int,
    central: CentralPose,
    fan: Float[np.ndarray, "draw *shape"],
    windows: Sequence[Window],
    place: int | None = None,
) -> MatLike:
    """Return the picture of one frame, all cameras in a grid: the central body and draws over the person's part of the images.

    Args:
        session: the recording.
        model: its body and cameras.
        index: the frame.
        central: the pose that stands for the posterior.
        fan: draws, radians and metres.
        windows: one for each camera, from `person_windows`.
        place: the place of the frame among those of the windows; `index` by default.

    Raises:
        InputError: an image of the session is missing.
    """
    model, place = seen_in(model, session, index), index if place is None else place
    drawn = [outlines(model, pose) for pose in fan]
    strong, medoid_note = outlines(model, central.pose), "" if central.is_mean else MEDOID
    tiles = []
    for c, (view, window) in enumerate(zip(session.views, windows, strict=True)):
        picture, note = backdrop(session, index, view)
        placed = [[Outline(part, window.place(polygon, place)) for part, polygon in body[c]] for body in (strong, *drawn)]
        painted = paint(window.cut(picture, place), placed[0], placed[1:])
        tiles.append(label(painted, f"{view.camera.name}  frame {session.frame_number(index)}{medoid_note}{note}"))
    return grid(tiles)


def backdrop(session: Session, index: int, view: View) -> tuple[MatLike, str]:
    """Return a camera's colour image of a frame and an empty note; without an image, a dark picture of its size and a note that says so."""
    image = read_colour(session, index, view)
    if image is not None:
        return image, ""
    width, height = view.camera.size_px
    return np.full((height, width, 3), EMPTY, np.uint8), "\nno image"


def paint(image: MatLike, strong: list[Outline], fan: Sequence[list[Outline]], ink: Colour | None = None) -> MatLike:
    """Return the colour image with a translucent body under thin outlines. Where many outlines agree, they add up to a strong line.

    Args:
        image: blue, green, red.
        strong: the body.
        fan: outlines of draws.
        ink: the one colour of the person, red, green, blue; by default parts have the colours of their sides.
    """
    picture, inks = image.copy(), colour if ink is None else lambda part: bgr(ink)
    _blend(picture, INSIDE, strong, partial(_fill, inks=inks))
    _blend(picture, MEAN, strong, partial(_draw, inks=inks, thickness=2))
    for body in fan:
        _blend(picture, DRAW, body, partial(_draw, inks=inks, thickness=1, lighter=LIGHTER))
    return picture


def _blend(picture: MatLike, opacity: float, parts: list[Outline], draw: Callable[[MatLike, list[Outline]], None]) -> None:
    """Draw parts into a picture with an opacity. Only the rectangle around them is touched: a fan is many layers."""
    if not parts:
        return
    corners = np.concatenate([outline.polygon for outline in parts])
    size = np.array(picture.shape[1::-1])
    first_column, top = np.clip(np.floor(corners.min(axis=0)) - LINE_PX, 0, size).astype(int)
    right, bottom = np.clip(np.ceil(corners.max(axis=0)) + LINE_PX, 0, size).astype(int)
    region = picture[top:bottom, first_column:right]
    if region.size:
        layer = region.copy()
        draw(layer, [Outline(outline.part, outline.polygon - (first_column, top)) for outline in parts])
        region[:] = cv2.addWeighted(layer, opacity, region, 1 - opacity, 0)


def _fill(picture: MatLike, parts: list[Outline], inks: Callable[[str], Colour]) -> None:
    for outline in parts:
        cv2.fillConvexPoly(picture, _fixed(outline), inks(outline.part), cv2.LINE_AA, shift=4)


def _draw(picture: MatLike, parts: list[Outline], inks: Callable[[str], Colour], thickness: int, lighter: float = 0.0) -> None:
    for outline in parts:
        ink = tuple(round(level + lighter * (255 - level)) for level in inks(outline.part))
        cv2.polylines(picture, [_fixed(outline)], True, ink, thickness, cv2.LINE_AA, shift=4)


def _fixed(outline: Outline) -> Int[np.ndarray, "corner 2"]:
    """Return the corners in fixed-point pixels with four fractional bits."""
    return np.round(outline.polygon * 16).astype(np.int32)


@lru_cache
def colour(part: str) -> tuple[int, int, int]:
    """Return the colour of a part's side for OpenCV, so that swapped left and right legs are visible at once."""
    return bgr(over_image(part))


def label(picture: MatLike, text: str) -> MatLike:
    """Return the picture with lines of text in its upper left corner, larger in a picture that is taller than a tile of the video."""
    scale = text_scale(picture)
    for row, line in enumerate(text.splitlines()):
        write_text(picture, line, (round(10 * scale), round((24 + 22 * row) * scale)))
    return picture


def text_scale(picture: MatLike) -> float:
    """Return how much larger text is in a picture than in a tile of the video."""
    return max(1.0, 0.7 * picture.shape[0] / TILE_HEIGHT)


def write_text(picture: MatLike, line: str, place: tuple[int, int], ink: Colour = (255, 255, 255), stroke: int = 1) -> None:
    """Write a line with a black edge into a picture; `place` is the (column, row) of its lower left corner, the ink blue, green, red."""
    scale = text_scale(picture)
    for thickness, layer_ink in ((stroke + 3, (0, 0, 0)), (stroke, ink)):
        cv2.putText(picture, line, place, cv2.FONT_HERSHEY_SIMPLEX, FONT * scale, layer_ink, round(thickness * scale), cv2.LINE_AA)


def write_png(path: Path, picture: MatLike) -> None:
    """Write a picture, completely or not at all.

    Raises:
        InputError: the picture is too large for the format, or the file system refuses the file.
    """
    # Encoded in memory, because OpenCV writes truncated files to a full disk without an error.
    with drawable(path):
        done, content = cv2.imencode(".png", picture)
    if not done:
        problem = f"{picture.shape[1]} x {picture.shape[0]} pixels cannot be written as a picture"
        raise input_error(path, problem, "at most a million pixels in width and height", CAMERAS)
    with replacing(path) as partial:
        partial.write_bytes(content.tobytes())


@contextmanager
def drawable(path: Path) -> Iterator[None]:
    """Within it, what OpenCV refuses to draw or to encode, such as a picture that is too large, is an InputError about `path`."""
    try:
        yield
    except cv2.error as error:
        problem = f"cannot be drawn ({error.err or 'OpenCV refuses it'})"
        raise input_error(path, problem, "cameras whose pictures OpenCV can draw", CAMERAS) from None


def run_backdrop(run: "SavedRun", frame: int, camera: int) -> tuple[MatLike, str]:
    """Return a camera's image of a frame and an empty note; a dark one with a note if there is none, or if it is not that of the time of the run."""
    view = run.session.views[camera]
    if not run.changed_inputs & {f"images of {view.camera.name}", f"video of {view.camera.name}"}:
        return backdrop(run.session, frame, view)
    width, height = view.camera.size_px
    return np.full((height, width, 3), EMPTY, np.uint8), "\nno image: its file is not the one of the time of the run"
