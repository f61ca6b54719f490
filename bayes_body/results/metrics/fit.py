r"""Fit of the projected mean body to a frame, measured by the silhouettes, by the keypoints and by the images' frames.

With A the body's projection and B the silhouette, the overlap is $|A \cap B| / |A \cup B|$ (IoU) and the cover is
$|A \cap B| / \min(|A|, |B|)$. The cover stays near 1 if the body is only a part of the person, such as two legs, or if clothes or a shadow enlarge
the silhouette. It falls if the two lie apart. The distance to the keypoints is the median over the body's markers, divided by the person's size in
the image (the larger side of the box around the keypoints). What these figures mean is judged in results/metrics/plausibility.py.

The body's projection to a camera's image consists of the outline of every part and the silhouette of the whole body. The outline of a tapered
cylinder is the convex hull of its two end sections. The outline of a sphere is that of the circle that faces the camera.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from bayes_body.base.geometry import transforms
from bayes_body.base.geometry.camera import Camera, project
from bayes_body.base.progress import Watch, unwatched
from bayes_body.base.shapes import Configuration
from bayes_body.density.factor import State, variables
from bayes_body.model.body.solids import Body, facing_discs, part_transforms, widened
from bayes_body.model.build import Model
from bayes_body.model.unknowns.apply import Unknowns, with_changes
from bayes_body.recording.observation.covered import uncovered
from bayes_body.recording.observation.frames import Frame, bystanders_at, cameras_with_picture, covered_of, near_bodies, read_frame
from bayes_body.recording.readers.camera_path import cameras_at
from bayes_body.recording.session.session import Keypoints, Session
from bayes_body.results.posterior import markers, mean_pose
from bayes_body.results.posterior.weighted import settled
from bayes_body.tracking.draws import Draws, FrameResult

POINTS = 24


class Outline(NamedTuple):
    """A part's outline in one image: a convex polygon of (column, row) pixels."""

    part: str
    polygon: Float[np.ndarray, "corner 2"]


def outlines(model: Model, pose: Float[np.ndarray, "*shape"]) -> list[list[Outline]]:
    """Return, for each camera, the outline of every part that is entirely in front of it; pose in radians and metres."""
    pixels, visible = (np.asarray(out) for out in _project_rims(model.body, model.rig, jnp.asarray(pose)))
    return _hulls(model, pixels, visible)


def drawn_outlines(model: Model, states: Mapping[str, Float[np.ndarray, "draw *shape"]]) -> list[list[list[Outline]]]:
    """Return the outlines of each draw, with the body and the cameras as the draw has them.

    Args:
        model: the model.
        states: values of its variables, by name. Unknowns that are not among them are left at their mean.
    """
    values = {name: jnp.asarray(value) for name, value in states.items()}
    body_terms = tuple(term for term in model.unknowns if term.name in model.placing and term.name in states)
    camera_terms = tuple(term for term in model.unknowns if term.node is Camera and term.name in states)
    pixels, visible = (np.asarray(out) for out in _project_drawn_rims(model.body, model.rig, body_terms, camera_terms, values))
    return [_hulls(model, *drawn) for drawn in zip(pixels, visible, strict=True)]


def _hulls(model: Model, pixels: Float[np.ndarray, "camera part point 2"], visible: Bool[np.ndarray, "camera part point"]) -> list[list[Outline]]:
    names = model.body.topology.names
    return [
        [Outline(name, cv2.convexHull(camera[p].astype(np.float32))[:, 0]) for p, name in enumerate(names) if in_front[p].all()]
        for camera, in_front in zip(pixels, visible, strict=True)
    ]


def seen_in(model: Model, session: Session, index: int) -> Model:
    """Return the model with its cameras at their positions in a frame.

    Raises:
        InputError: a moving camera's file cannot be read.
    """
    return model.at(cameras_at(session, index)) if session.moves else model


def projected_masks(model: Model, pose: Float[np.ndarray, "*shape"], session: Session) -> list[Bool[np.ndarray, "row column"]]:
    """Return the silhouette of a posed body in each camera's image; moving cameras are where the model has them (`seen_in`)."""
    return [fill(polygons, view.camera.size_px) for polygons, view in zip(outlines(model, pose), session.views, strict=True)]


def frame_near(model: Model, poses: Float[np.ndarray, "run *shape"], session: Session, frame: Frame) -> Frame:
    """Return a frame without the figures that a body at any of these poses does not explain, if the session asks for that (`[segmentation] figures`).

    Raises:
        InputError: a silhouette cannot be computed.
    """
    if session.segmentation.figures != "near_body" or frame.masks is None:
        return frame
    by_run = [projected_masks(model, pose, session) for pose in poses]
    return near_bodies(frame, [np.logical_or.reduce(views) for views in zip(*by_run, strict=True)])


def fill(polygons: list[Outline], size_px: tuple[int, int]) -> Bool[np.ndarray, "row column"]:
    """Return the union of outlines as a mask of an image of `size_px` (width, height)."""
    mask = np.zeros(size_px[::-1], np.uint8)
    # Fixed-point pixels with four fractional bits, so that small parts do not jump by whole pixels.
    for outline in polygons:
        cv2.fillConvexPoly(mask, np.round(outline.polygon * 16).astype(np.int32), 1, shift=4)
    return mask.astype(bool)


def intersection_over_union(a: Bool[np.ndarray, "row column"], b: Bool[np.ndarray, "row column"]) -> float:
    """Return |a ∩ b| / |a ∪ b|; NaN if both are empty."""
    union = np.count_nonzero(a | b)
    return np.count_nonzero(a & b) / union if union else float("nan")


@jax.jit
def _project_rims(body: Body, rig: Camera, pose: Configuration) -> tuple[Array, Array]:
    T_world_part, shaped = part_transforms(body, pose), widened(body, pose)
    return jax.vmap(lambda camera: project(camera, _rims(shaped, T_world_part, camera)))(rig)


@jax.jit
def _project_drawn_rims(body: Body, rig: Camera, body_terms: Unknowns, camera_terms: Unknowns, states: State) -> tuple[Array, Array]:
    def projected(state: State) -> tuple[Array, Array]:
        changed, cameras = with_changes(body_terms, body, variables(state)), with_changes(camera_terms, rig, variables(state))
        return _project_rims(changed, cameras, state[body.variable])

    return jax.vmap(projected)(states)


def _rims(body: Body, T_world_part: transforms.Transform, camera: Camera) -> Float[Array, "part point 3"]:
    angle = jnp.arange(POINTS) * (2 * jnp.pi / POINTS)
    cos, sin = jnp.cos(angle)[:, None], jnp.sin(angle)[:, None]
    ends = []
    for end in (0, 1):
        centre = T_world_part.origin + end * body.lengths[:, None] * T_world_part.z
        across_x = (body.outline_radii[:, end] * body.sections[:, 0])[:, None] * T_world_part.x
        across_y = (body.outline_radii[:, end] * body.sections[:, 1])[:, None] * T_world_part.y
        ends.append(centre[:, None] + cos * across_x[:, None] + sin * across_y[:, None])
    cylinders = jnp.concatenate(ends, axis=1)
    facing = facing_discs(body, T_world_part, camera.viewpoint)
    disc = facing.centre[:, None] + body.outline_radii[:, :1, None] * (cos * facing.right[:, None] + sin * facing.up[:, None])
    is_sphere = jnp.array(body.topology.is_sphere)[:, None, None]
    return jnp.where(is_sphere, jnp.concatenate([disc, disc], axis=1), cylinders)


# Keypoints with lower confidence are not used, and neither are cameras with fewer keypoints.
LEAST_CONFIDENCE, FEWEST_POINTS = 0.3, 4
# Distances are cut at this value. A marker behind the camera has no distance and gets this value.
FARTHEST = 10.0
# A body with these markers is a whole one.
WHOLE = frozenset({"head", "l_ankle", "r_ankle"})


class Fit(NamedTuple):
    """The fit of a frame; NaN for a camera without silhouette or keypoints.

    Attributes:
        overlap: IoU of the body and the silhouette.
        cover: their intersection, divided by the smaller of the two; NaN if the silhouette is empty.
        distance: median distance of the markers from the keypoints, as a fraction of the person's size in the image.
        body: share of the image that the body covers.
        silhouette: share of the image that the silhouette covers.
        is_whole: whether the body is one from head to feet, so that a right pose covers most of the silhouette.
        distance_px: median distance of the markers from the keypoints, pixels.
    """

    overlap: Float[np.ndarray, "run camera"]
    cover: Float[np.ndarray, "run camera"]
    distance: Float[np.ndarray, "run camera"]
    body: Float[np.ndarray, "run camera"]
    silhouette: Float[np.ndarray, " camera"]
    is_whole: bool = False
    distance_px: Float[np.ndarray, "run camera"] = np.zeros((0, 0))


def silhouette_overlap(session: Session, draws: Draws, watch: Watch = unwatched) -> Float[np.ndarray, "run frame camera"]:
    """Return the overlap (IoU) of the projected mean body of each run with the silhouettes; NaN where the session has none."""
    frames = watch(range(len(draws.frames)))
    return np.stack([result_fit(session, draws.model, draws.frames[index], index).overlap for index in frames], axis=1)


def result_fit(session: Session, model: Model, result: FrameResult, index: int, to_judge: bool = False) -> Fit:
    """Return the fit of each run's mean pose to the frame that was tracked; `to_judge` as in `frame_fit`."""
    # The factors matter to no fit, and it would take longer to settle them than all else.
    model = settled(replace(model, factors=()), result)
    return frame_fit(session, model, mean_pose(result, model), index, np.asarray(result.seen).tolist(), to_judge)


def frame_fit(
    session: Session,
    model: Model,
    poses: Float[np.ndarray, "run *shape"],
    index: int,
    visibility: Sequence[bool] | None = None,
    to_judge: bool = False,
) -> Fit:
    """Return the fit of poses (radians and metres) to frame `index`.

    Args:
        session: the recording.
        model: its body and cameras.
        poses: one for each run.
        index: the frame.
        visibility: which cameras see the frame, if that is known. Pictures that nothing asks for are not read then.
        to_judge: whether the fit is only for `plausibility.judge`, which needs no silhouettes where keypoints tell: they are NaN then.
    """
    if visibility is None and not model.reads_pictures:
        visibility = cameras_with_picture(session, index)
    frame, model = read_frame(session, index, seen=visibility), seen_in(model, session, index)
    shape = (len(poses), len(session.views))
    distance, distance_px = _distances(model, poses, frame)
    if to_judge and np.isfinite(distance).any():
        frame = frame._replace(masks=None, foreground=None)
    frame = frame_near(model, poses, session, frame)
    overlap, cover, area = (np.full(shape, np.nan) for _ in range(3))
    masks = [None] * shape[1] if frame.masks is None else [frame.masks[c] for c in range(shape[1])]
    covered = [None] * shape[1] if frame.masks is None else covered_of(frame)
    for run, pose in enumerate(poses):
        for c, (body, person, region) in enumerate(zip(projected_masks(model, pose, session), masks, covered, strict=True)):
            area[run, c] = _share(body)
            visible = uncovered(body, region)
            # Of a body that others cover wholly, this camera tells nothing.
            if person is not None and (visible is body or visible.any() or not body.any()):
                figure = uncovered(person, region)
                overlap[run, c], cover[run, c] = intersection_over_union(visible, figure), cover_of(visible, figure)
    return Fit(overlap, cover, distance, area, silhouette_shares(frame), set(model.body.markers.names) >= WHOLE, distance_px)


def distance_from_bystanders(session: Session, model: Model, pose: Float[np.ndarray, "*shape"], index: int) -> Float[np.ndarray, " camera"]:
    """Return the distance of a pose (radians and metres) from the keypoints of the other person who is nearest in each camera, in a frame.

    It is measured as `Fit.distance`, and NaN where no other person is detected.

    Raises:
        InputError: unreadable keypoints.
    """
    people, cameras = bystanders_at(session, index), range(len(session.views))
    frame = Frame(index, (None,) * len(people), None, have_image=(True,) * len(people))
    distances = np.full((max(map(len, people), default=0), len(people)), np.nan)
    for number in range(len(distances)):
        keypoints = tuple(people[c][number] if number < len(people[c]) else None for c in cameras)
        distances[number] = _distances(seen_in(model, session, index), pose[None], frame._replace(keypoints=keypoints))[0][0]
    return np.fmin.reduce(distances, axis=0) if len(distances) else np.full(len(people), np.nan)


def _share(mask: Bool[np.ndarray, "row column"]) -> float:
    # Many times as fast as the mean, and the same number.
    return np.count_nonzero(mask) / mask.size


def silhouette_shares(frame: Frame) -> Float[np.ndarray, " camera"]:
    """Return the share of the image that each camera's silhouette covers; NaN for a camera that did not see the frame, and without silhouettes.

    What other people cover does not count.
    """
    shares = np.full(len(frame.images), np.nan)
    for c, has_image in enumerate(frame.seen):
        if has_image and frame.masks is not None:
            mask = frame.masks[c]
            if mask is not None:
                shares[c] = _share(uncovered(mask, covered_of(frame)[c]))
            elif frame.images[c] is not None:
                # The image could not be compared with the background.
                shares[c] = 0.0
    return shares


def cover_of(body: Bool[np.ndarray, "row column"], person: Bool[np.ndarray, "row column"]) -> float:
    """Return |body ∩ person| / min(|body|, |person|); 0 if the body is outside of the image, NaN if the person is."""
    areas = np.count_nonzero(body), np.count_nonzero(person)
    if not areas[1]:
        return float("nan")
    return np.count_nonzero(body & person) / min(areas) if areas[0] else 0.0


def _distances(
    model: Model, poses: Float[np.ndarray, "run *shape"], frame: Frame
) -> tuple[Float[np.ndarray, "run camera"], Float[np.ndarray, "run camera"]]:
    """Return the median distance of the markers from the keypoints, as a fraction of the person's size in the image, and in pixels."""
    names = model.body.markers.names
    relative, pixels = np.full((2, len(poses), len(frame.seen)), np.nan)
    if frame.keypoints is None or not names:
        return relative, pixels
    places_px, visible = (np.asarray(out) for out in _projected(model.rig, jnp.asarray(markers(model, poses))))
    for c, keypoints in enumerate(frame.keypoints):
        places = _usable(keypoints, names)
        if len(places) >= FEWEST_POINTS:
            points = np.array(list(places.values()))
            chosen = list(places)
            size_px = max(float(np.ptp(points, axis=0).max()), 1.0)
            distances = np.linalg.norm(places_px[:, c, chosen] - points, axis=-1) / size_px
            relative[:, c] = np.median(np.where(visible[:, c, chosen], np.minimum(distances, FARTHEST), FARTHEST), axis=-1)
            pixels[:, c] = size_px * relative[:, c]
    return relative, pixels


def _usable(keypoints: Keypoints | None, names: Sequence[str]) -> dict[int, tuple[float, float]]:
    """Return the pixels of the usable keypoints, by the index of their marker."""
    points = {name: point for name, point in (keypoints or {}).items() if name in names and point[2] >= LEAST_CONFIDENCE}
    return {names.index(name): (point[0], point[1]) for name, point in points.items()}


@jax.jit
def _projected(rig: Camera, places: Float[Array, "run marker 3"]) -> tuple[Float[Array, "run camera marker 2"], Bool[Array, "run camera marker"]]:
    return jax.vmap(lambda marker_places: jax.vmap(lambda camera: project(camera, marker_places))(rig))(places)
