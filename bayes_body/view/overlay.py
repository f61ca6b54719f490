"""Pictures of a run: the recording with the posterior drawn over it, all cameras side by side.

The posterior mean is a strong outline (left side blue, right side orange, middle green); draws are a fan of thin ones, so that where the posterior
is wide the fan is too.
"""

from pathlib import Path

import cv2
import numpy as np
from cv2.typing import MatLike
from jaxtyping import Float

from bayes_body.errors import input_error
from bayes_body.files.atomic import make_folder, replacing
from bayes_body.model.build import Model
from bayes_body.observation.pictures import read_colour
from bayes_body.posterior import equal_weight_poses, mean_pose
from bayes_body.session.session import Session, View
from bayes_body.tracking.draws import Draws, FrameResult
from bayes_body.view.progress import Watch, unwatched
from bayes_body.view.silhouette import Outline, outlines, seen_in

# BGR, as OpenCV has it.
LEFT, RIGHT, MIDDLE, INK = (255, 160, 40), (30, 130, 255), (90, 220, 60), (255, 255, 255)
UNSEEN = 30
TILE_HEIGHT = 480
VIDEO = "overlay.mp4"
FAN = 20
STILLS = 5


def draw_overlay(session: Session, draws: Draws, folder: Path, watch: Watch = unwatched) -> list[Path]:
    """Write `overlay.mp4` and up to five stills `overlay/frame_NNNNNN.png`, evenly spaced, the first and the last among them.

    Args:
        session: the recording.
        draws: what was tracked.
        folder: of the run.
        watch: takes the frames and gives them back, as a bar does.

    Raises:
        InputError: the folder cannot be written, or an image of the session is gone.
    """
    frames = len(draws.frames)
    stills = _stills(folder, frames)
    video = None
    make_folder(folder / "overlay")
    with replacing(folder / VIDEO) as partial:
        try:
            for index in watch(range(frames)):
                result = draws.frames[index]
                picture = mosaic(session, draws.model, index, mean_pose(result).mean(axis=0), _fan(result, index))
                video = video or _open_video(partial, session.fps, picture)
                video.write(picture)
                if index in stills:
                    _write(stills[index], picture)
        finally:
            if video:
                video.release()
        # OpenCV says nothing of a disk that is full.
        if _frames_in(partial) != frames:
            raise input_error(folder / VIDEO, "cannot be written whole", "a folder with room", "free some space")
    for path in set((folder / "overlay").glob("frame_*.png")) - set(stills.values()):
        path.unlink()
    return [folder / VIDEO, *stills.values()]


def is_drawn(folder: Path, frames: int) -> bool:
    """Whether a folder holds the overlay of a run of so many frames."""
    return all(path.exists() for path in _stills(folder, frames).values()) and _frames_in(folder / VIDEO) == frames


def _stills(folder: Path, frames: int) -> dict[int, Path]:
    chosen = np.unique(np.linspace(0, frames - 1, min(STILLS, frames)).round().astype(int))
    return {int(index): folder / "overlay" / f"frame_{index:06d}.png" for index in chosen}


def _frames_in(video: Path) -> int:
    """0 where there is none, or it is not whole."""
    if not video.exists():
        return 0
    reader = cv2.VideoCapture(str(video))
    try:
        return int(reader.get(cv2.CAP_PROP_FRAME_COUNT))
    finally:
        reader.release()


def _fan(result: FrameResult, index: int) -> Float[np.ndarray, "draw dof"]:
    """A few draws of a frame, from all runs alike."""
    sample = equal_weight_poses(result, index, max(1, FAN // result.log_weights.shape[0]))
    return np.concatenate(list(sample))[:FAN]


def mosaic(session: Session, model: Model, index: int, mean: Float[np.ndarray, " dof"], fan: Float[np.ndarray, "draw dof"]) -> MatLike:
    """One frame, all cameras in a grid: the mean body and a fan of draws over the images, or over a dark tile where a camera did not see."""
    model = seen_in(model, session, index)
    drawn = [outlines(model, pose) for pose in fan]
    strong = outlines(model, mean)
    tiles = []
    for c, view in enumerate(session.views):
        picture, note = backdrop(session, index, view)
        tiles.append(label(fit(paint(picture, strong[c], [each[c] for each in drawn])), f"{view.camera.name}  frame {index}{note}"))
    return grid(tiles)


def backdrop(session: Session, index: int, view: View) -> tuple[MatLike, str]:
    """A camera's image of a frame, in colours, and nothing to add; or a plain dark picture of its size, and that it did not see."""
    image = read_colour(session, index, view)
    if image is not None:
        return image, ""
    width, height = view.camera.size_px
    return np.full((height, width, 3), UNSEEN, np.uint8), "\nnot seen"


def paint(image: MatLike, strong: list[Outline], fan: list[list[Outline]]) -> MatLike:
    """The image, in colours, with thin outlines half transparent under strong ones."""
    picture = image.copy()
    thin = picture.copy()
    for each in fan:
        _draw(thin, each, 1)
    picture = cv2.addWeighted(thin, 0.5, picture, 0.5, 0)
    _draw(picture, strong, 2)
    return picture


def _draw(picture: MatLike, parts: list[Outline], thickness: int) -> None:
    for outline in parts:
        points = np.round(outline.polygon * 16).astype(np.int32)
        cv2.polylines(picture, [points], True, colour(outline.part), thickness, cv2.LINE_AA, shift=4)


def colour(part: str) -> tuple[int, int, int]:
    """By side, so that a left leg taken for a right one is seen at once."""
    return LEFT if part.startswith("l_") else RIGHT if part.startswith("r_") else MIDDLE


def fit(picture: MatLike) -> MatLike:
    """The picture scaled to the height of a tile."""
    height, width = picture.shape[:2]
    if height == TILE_HEIGHT:
        return picture
    return cv2.resize(picture, (round(width * TILE_HEIGHT / height), TILE_HEIGHT), interpolation=cv2.INTER_AREA)


def label(picture: MatLike, text: str) -> MatLike:
    """The picture with lines of text in its upper left corner."""
    for row, line in enumerate(text.splitlines()):
        for thickness, ink in ((4, (0, 0, 0)), (1, INK)):
            cv2.putText(picture, line, (10, 24 + 22 * row), cv2.FONT_HERSHEY_SIMPLEX, 0.6, ink, thickness, cv2.LINE_AA)
    return picture


def grid(tiles: list[MatLike]) -> MatLike:
    """Tiles of one height in rows of about equal width, even-sized as video codecs want it."""
    columns = int(np.ceil(np.sqrt(len(tiles))))
    rows = [np.hstack(tiles[i : i + columns]) for i in range(0, len(tiles), columns)]
    width = max(row.shape[1] for row in rows)
    width += width % 2
    return np.vstack([cv2.copyMakeBorder(row, 0, 0, 0, width - row.shape[1], cv2.BORDER_CONSTANT) for row in rows])


def _open_video(path: Path, fps: float, picture: MatLike) -> cv2.VideoWriter:
    video = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), fps, picture.shape[1::-1])
    if not video.isOpened():
        raise input_error(path, "cannot be written as a video", "a folder that can be written", "check its permissions and free space")
    return video


def _write(path: Path, picture: MatLike) -> None:
    # Encoded in memory: OpenCV's own files are cut short on a full disk without a word.
    with replacing(path) as partial:
        partial.write_bytes(cv2.imencode(".png", picture)[1].tobytes())
