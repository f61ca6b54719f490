"""The posterior of one frame over a camera's image: the mean body, draws, a legend, a scale bar, and what was made of which recording.

Pictures for a paper share their formats, their style, and the line that says what was made of which recording.
"""

import textwrap
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from cv2.typing import MatLike
from jaxtyping import Float

from bayes_body.base.errors import escaped, input_error
from bayes_body.base.files.atomic import make_folder, replacing
from bayes_body.base.geometry.camera import project
from bayes_body.model.build import Model
from bayes_body.recording.readers.camera_path import cameras_at
from bayes_body.results.metrics.fit import Outline, outlines, seen_in
from bayes_body.results.posterior import CentralPose, central_pose
from bayes_body.results.posterior.blocks import pooled, pose_blocks, weights_of_runs
from bayes_body.results.posterior.central import part_ends
from bayes_body.results.posterior.resampling import RESAMPLING_SEED, systematic_resampling
from bayes_body.view.colours import GREY, INK, NAMES, OVER_IMAGE, over_image, side_of
from bayes_body.view.crop import Crop, crop_about
from bayes_body.view.overlay import run_backdrop
from bayes_body.view.report.figures import style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from bayes_body.results.storage.saved_run import SavedRun

FORMATS = (".png", ".svg", ".pdf")
# Points: letters of the small print. Mean width of a letter, as a fraction of its height.
SMALL, LETTER = 7.5, 0.53


@contextmanager
def paper_style() -> Iterator[None]:
    """Within it, plots have the report's style, and text in vector pictures stays text."""
    import matplotlib as mpl

    with style(), mpl.rc_context({"svg.fonttype": "none", "pdf.fonttype": 42, "savefig.transparent": False, "savefig.facecolor": "white"}):
        yield


def check_format(path: Path) -> None:
    """Check that a picture's file has a suffix that tells its format.

    Raises:
        InputError: it has another suffix.
    """
    if path.suffix.lower() not in FORMATS:
        raise input_error(path, f"the suffix '{path.suffix}'", ", ".join(FORMATS), "name a file with one of these suffixes by --out")


def save(figure: "Figure", path: Path, dpi: float) -> None:
    """Write a figure, completely or not at all; its suffix gives the format. The same run gives the same file.

    Raises:
        InputError: the suffix is another one, or the file cannot be written.
    """
    check_format(path)
    kind = path.suffix.lower().removeprefix(".")
    metadata = {"png": None, "svg": {"Date": None}, "pdf": {"CreationDate": None}}[kind]
    make_folder(path.parent)
    with replacing(path) as partial:
        figure.savefig(partial, format=kind, dpi=dpi, metadata=metadata)


def made_of(run: "SavedRun") -> str:
    """Return the recording, the model and the kernel, with the number of runs."""
    runs = run.tree["posterior"].sizes["chain"]
    smoothed = ", smoothed" if run.smoothed else ""
    return escaped(f"{run.session.title}. Model {run.settings['model']}, kernel {run.kernel['kind']}{smoothed}, {runs} run{'s' * (runs > 1)}")


def wrapped(text: str, width_in: float, size: float = SMALL) -> str:
    """Return the text in lines that fit into that width, inches, in letters of that height, points."""
    return "\n".join(textwrap.wrap(text, max(20, int(width_in * 72 / (LETTER * size)))))


# Inches: the longer side of the image, and room below it for a line of legend and for a line of the text.
LONGER, LEGEND, LINE = 7.0, 0.3, 0.15
# A standing person's part of an image is widened to this width / height, so that the picture shows where the person is.
LEAST_SHAPE = 0.8
# Metres that a scale bar can have, and its longest length as a fraction of the width.
BARS, LONGEST = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0), 0.3
# As in view/overlay.py: opacity of the body's inside, of its outline and of draws, whose colour moves towards white by LIGHTER. Widths in points.
INSIDE, OUTLINE, DRAW, LIGHTER = 0.15, 0.9, 0.35, 0.55
STRONG, THIN = 1.3, 0.5


class Scale(NamedTuple):
    """The scale of an image where the person is.

    Attributes:
        pixels_a_metre: across the line of sight, image pixels.
        depth_m: distance of the person along the camera's axis.
    """

    pixels_a_metre: float
    depth_m: float


def write_picture(
    run: "SavedRun", path: Path, number: int | None = None, camera: str | None = None, size_px: int = 2000, draws: int = 40, whole_image: bool = False
) -> None:
    """Write the posterior of a frame over a camera's image.

    Args:
        run: the run, loaded from its folder.
        path: the file: .png, .svg or .pdf. In a vector picture, bodies and text are vectors over the image.
        number: the frame's number in the recording; the run's first frame by default.
        camera: name of the camera; the first one by default.
        size_px: longer side of a .png, pixels.
        draws: number of draws; a mode seeker has none.
        whole_image: whether to show the whole image instead of the person's part of it.

    Raises:
        InputError: the run has no such frame or camera, a file of the run or its recording cannot be used, or the picture cannot be written.
    """
    first = run.first_frame
    frame = 0 if number is None else number - first
    if not 0 <= frame < run.frames:
        raise input_error("--frame", f"{number}", f"{first} to {first + run.frames - 1}: the run has {run.frames} frames", "name one of them")
    names = [view.camera.name for view in run.session.views]
    if camera is not None and camera not in names:
        raise input_error("--camera", f"no camera '{camera}'", f"one of {', '.join(names)}", "name one of them")
    c = 0 if camera is None else names.index(camera)
    model = seen_in(run.settled_model, run.session, frame)
    central, fan = _posterior(run, frame, 0 if run.mode_seeker else draws)
    image, note = run_backdrop(run, frame, c)
    strong, thin = outlines(model, central.pose)[c], [part for pose in fan for part in outlines(model, pose)[c]]
    crop = _crop(strong, thin, (image.shape[1], image.shape[0]), whole_image)
    scale = _scale(run, model, central, frame, c)
    when = f"camera {names[c]}, frame {first + frame} ({frame / run.fps:.2f} s){note.replace(chr(10), ', ')}"
    scale_note = "" if scale is None else f" Scale at the person's distance, {scale.depth_m:.2f} m from the camera."
    with paper_style():
        figure = _draw(
            image, crop, strong, thin, scale, _legend(run, central, strong, len(fan)), f"{made_of(run)}; {when}.{scale_note}", path.suffix == ".png"
        )
        save(figure, path, size_px / max(figure.get_size_inches()))


def _posterior(run: "SavedRun", frame: int, count: int) -> tuple[CentralPose, Float[np.ndarray, "draw *shape"]]:
    """Return the central pose of all runs together, and draws of equal weight."""
    (piece,) = pose_blocks(run.tree, range(frame, frame + 1), variable=run.model.body.variable)
    weights, poses = pooled(weights_of_runs(piece.log_weights))[0], pooled(piece.poses)[0]
    chosen = systematic_resampling(np.random.default_rng([RESAMPLING_SEED, frame]), weights, count)
    return central_pose(run.settled_model.body, poses, weights), poses[chosen]


def _crop(strong: list[Outline], thin: list[Outline], size_px: tuple[int, int], whole_image: bool) -> Crop:
    """Return the part of the image that the picture shows; all of it if no part of the body is in it."""
    parts = strong or thin
    if whole_image or not parts:
        return Crop(0, 0, *size_px, 1.0)
    close_crop = crop_about(np.concatenate([part.polygon for part in parts]), size_px, max(size_px))
    missing = LEAST_SHAPE * (close_crop.bottom - close_crop.top) - (close_crop.right - close_crop.left)
    if missing <= 0:
        return close_crop
    first_column = max(0, min(close_crop.left - round(missing / 2), size_px[0] - round(close_crop.right - close_crop.left + missing)))
    return close_crop._replace(left=first_column, right=min(size_px[0], first_column + round(close_crop.right - close_crop.left + missing)))


def _scale(run: "SavedRun", model: Model, central: CentralPose, frame: int, c: int) -> Scale | None:
    """Return the scale at the middle of the body; None if that is not in front of the camera."""
    spec, camera = cameras_at(run.session, frame)[c], jax.tree.map(lambda leaf: leaf[c], model.rig)
    body = model.body
    middle = np.asarray(part_ends(body, jnp.asarray(central.pose[None], body.lengths.dtype)), float)[0].mean(axis=0)
    offset = 0.05 * spec.rotation[0]
    pixels, visible = (
        np.asarray(out, float) for out in project(camera, jnp.asarray(np.stack([middle - offset, middle + offset]), body.lengths.dtype))
    )
    if not visible.all():
        return None
    return Scale(float(np.linalg.norm(pixels[1] - pixels[0])) / 0.1, float(spec.rotation[2] @ middle + spec.translation_m[2]))


def _draw(
    image: MatLike, crop: Crop, strong: list[Outline], thin: list[Outline], scale: Scale | None, legend: list[Any], text: str, smooth: bool
) -> "Figure":
    from matplotlib.figure import Figure

    shown = cv2.cvtColor(np.ascontiguousarray(image[crop.top : crop.bottom, crop.left : crop.right]), cv2.COLOR_BGR2RGB)
    height, width = shown.shape[:2]
    inches = LONGER * np.array([width, height]) / max(width, height)
    lines = wrapped(text, inches[0] - 0.1)
    below = LEGEND + LINE * (lines.count("\n") + 1) + 0.08
    figure = Figure(figsize=(inches[0], inches[1] + below))
    axes = figure.add_axes((0, below / (inches[1] + below), 1, inches[1] / (inches[1] + below)))
    # Integer coordinates are the centres of pixels. A vector picture holds the pixels as they are.
    axes.imshow(shown, extent=(crop.left - 0.5, crop.right - 0.5, crop.bottom - 0.5, crop.top - 0.5), interpolation="bicubic" if smooth else "none")
    axes.axis("off")
    _bodies(axes, thin, DRAW, THIN, LIGHTER)
    _bodies(axes, strong, INSIDE, 0.0)
    _bodies(axes, strong, OUTLINE, STRONG)
    if scale is not None:
        _bar(axes, crop, scale, strong)
    axes.set(xlim=(crop.left - 0.5, crop.right - 0.5), ylim=(crop.bottom - 0.5, crop.top - 0.5))
    figure.legend(
        handles=legend, loc="upper left", bbox_to_anchor=(0, below / (inches[1] + below)), ncols=len(legend), borderaxespad=0.3, handlelength=1.3,
        columnspacing=1.1, handletextpad=0.5, labelcolor=INK,
    )  # fmt: skip
    figure.text(0.05 / inches[0], 0.05 / (inches[1] + below), lines, fontsize=SMALL, va="bottom", color=INK, linespacing=1.3)
    return figure


def _bodies(axes: "Axes", parts: list[Outline], opacity: float, width: float, lighter: float = 0.0) -> None:
    """Draw outlines of that width, points; a width of 0 fills them."""
    from matplotlib.collections import PolyCollection

    inks = [tuple((level + lighter * (255 - level)) / 255 for level in over_image(part)) for part, _ in parts]
    style = {"facecolors": "none", "edgecolors": inks, "linewidths": width} if width else {"facecolors": inks, "edgecolors": "none"}
    axes.add_collection(PolyCollection([polygon for _, polygon in parts], alpha=opacity, **style), autolim=False)


def _bar(axes: "Axes", crop: Crop, scale: Scale, body: list[Outline]) -> None:
    """Draw the scale bar in that lower corner of the picture that is farther from the body."""
    width, height = crop.right - crop.left, crop.bottom - crop.top
    metres = max((bar for bar in BARS if bar * scale.pixels_a_metre <= LONGEST * width), default=BARS[0])
    length, edge = metres * scale.pixels_a_metre, 0.03 * max(width, height)
    middle = np.mean([polygon[:, 0].mean() for _, polygon in body]) if body else crop.right
    start = crop.left + edge if middle > crop.left + width / 2 else crop.right - edge - length
    row = crop.bottom - edge
    for ink, points in (("black", 5.0), ("white", 2.6)):
        axes.plot([start, start + length], [row, row], color=ink, linewidth=points, solid_capstyle="butt")
    text = f"{metres:g} m" if metres >= 0.1 else f"{100 * metres:g} cm"
    # An edge around the letters would turn them into shapes in a vector picture.
    style = {"ha": "center", "va": "bottom", "fontsize": 10, "bbox": {"facecolor": "black", "edgecolor": "none", "alpha": 0.5, "pad": 1.5}}
    axes.annotate(text, (start + length / 2, row), xytext=(0, 5), textcoords="offset points", color="white", **style)


def _legend(run: "SavedRun", central: CentralPose, parts: list[Outline], draws: int) -> list[Any]:
    """Return the legend's entries: the sides of the central body, and draws."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    meaning = ("mean of the particles" if run.mode_seeker else "posterior mean") if central.is_mean else "medoid of the draws"
    sides = {side_of(part) for part, _ in parts}
    entries: list[Any] = []
    for side, name in NAMES.items():
        if side in sides:
            red, green, blue = (level / 255 for level in OVER_IMAGE[side])
            label = name if entries else f"{meaning}: {name}"
            entries.append(Patch(facecolor=(red, green, blue, 0.35), edgecolor=(red, green, blue), label=label))
    if draws:
        entries.append(Line2D([], [], color=GREY, linewidth=0.8, label=f"{draws} draws"))
    return entries
