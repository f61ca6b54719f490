"""Pictures of a run: the recording with the posterior drawn over it, all cameras side by side.

The posterior mean is a strong outline (left side blue, right side orange, middle green); draws are a fan of thin ones, so that where the posterior
is wide the fan is too.
"""

from pathlib import Path

import cv2
import numpy as np
from cv2.typing import MatLike
from jaxtyping import Float

from bayes_body.errors import wrong
from bayes_body.files import make_folder
from bayes_body.model import Model
from bayes_body.observation.frames import Frame, read_frame
from bayes_body.posterior import equal_weight_draws, mean_poses
from bayes_body.session import Session
from bayes_body.tracking import Draws
from bayes_body.view.progress import Watch, unwatched
from bayes_body.view.silhouette import Outline, outlines

# BGR, as OpenCV has it.
LEFT, RIGHT, MIDDLE, INK = (255, 160, 40), (30, 130, 255), (90, 220, 60), (255, 255, 255)
TILE_HEIGHT = 480
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
    frames = draws.log_weights.shape[1]
    stills = set(np.unique(np.linspace(0, frames - 1, min(STILLS, frames)).round().astype(int)))
    means, fans = mean_poses(draws).mean(axis=0), _fans(draws)
    written, video = [], None
    make_folder(folder / "overlay")
    try:
        for index in watch(range(frames)):
            picture = mosaic(session, draws.model, read_frame(session, index), means[index], fans[index])
            video = video or _open_video(folder / "overlay.mp4", session.fps, picture)
            video.write(picture)
            if index in stills:
                written.append(_write(folder / "overlay" / f"frame_{index:06d}.png", picture))
    finally:
        if video:
            video.release()
    return [folder / "overlay.mp4", *written]


def _fans(draws: Draws) -> Float[np.ndarray, "frame draw dof"]:
    """A few draws a frame, from all runs alike."""
    runs = draws.log_weights.shape[0]
    sample = equal_weight_draws(draws, max(1, FAN // runs))
    return np.concatenate(list(sample), axis=1)[:, :FAN]


def mosaic(session: Session, model: Model, frame: Frame, mean: Float[np.ndarray, " dof"], fan: Float[np.ndarray, "draw dof"]) -> MatLike:
    """One frame, all cameras in a grid: the mean body and a fan of draws over the images."""
    drawn = [outlines(model, pose) for pose in fan]
    strong = outlines(model, mean)
    tiles = [
        label(fit(paint(image, strong[c], [each[c] for each in drawn])), f"{view.camera.name}  frame {frame.index}")
        for c, (image, view) in enumerate(zip(frame.images, session.views, strict=True))
    ]
    return grid(tiles)


def paint(image: MatLike, strong: list[Outline], fan: list[list[Outline]]) -> MatLike:
    """A grey image in colours, with thin outlines half transparent under strong ones."""
    picture = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
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
    """The picture with a line of text in its upper left corner."""
    for thickness, ink in ((4, (0, 0, 0)), (1, INK)):
        cv2.putText(picture, text, (10, 24), cv2.FONT_HERSHEY_SIMPLEX, 0.6, ink, thickness, cv2.LINE_AA)
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
        raise wrong(path, "cannot be written as a video", "a folder that can be written", "check its permissions and free space")
    return video


def _write(path: Path, picture: MatLike) -> Path:
    if not cv2.imwrite(str(path), picture):
        raise wrong(path, "cannot be written", "a folder that can be written", "check its permissions and free space")
    return path
