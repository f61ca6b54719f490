r"""Posterior predictive check of silhouettes: the silhouettes of drawn bodies against the seen ones, by their overlap and by their areas.

With A the silhouette of a drawn body and B the seen one, the overlap is $|A \cap B| / |A \cup B|$ (IoU) and the difference of the areas is
$(|A| - |B|) / |B|$. A likelihood that is a distribution over silhouettes, `silhouette_bernoulli`, also draws silhouettes B' around each drawn body.
The same two figures of A and B' are what the model expects (Gelman, Meng & Stern 1996); then all are compared on the likelihood's grid.
`silhouette_edges` and `regions` are no such distributions.
"""

from typing import NamedTuple

import cv2
import jax
import numpy as np
from cv2.typing import MatLike
from jaxtyping import Array, Bool, Float, PRNGKeyArray, Shaped
from numpy.typing import NDArray

from bayes_body.base.shapes import Key
from bayes_body.model.build import Model
from bayes_body.model.likelihood.silhouette_bernoulli import SilhouetteBernoulli
from bayes_body.recording.observation.frames import Frame
from bayes_body.recording.observation.silhouette_bernoulli import sample_mask
from bayes_body.recording.session.session import Session
from bayes_body.results.metrics.fit import Outline, fill, intersection_over_union, outlines

# Silhouettes are compared at no more than this width, pixels.
WIDTH = 320
ENDS = (5, 95)


class SilhouetteCheck(NamedTuple):
    """The comparison of one frame's silhouettes; NaN for a camera without one.

    Attributes:
        overlap: IoU of the silhouette of each draw and the seen one.
        area: difference of the two areas, as a fraction of the seen one; positive if the body is larger.
        expected_overlap: the 5 % and 95 % quantiles of the overlap with silhouettes drawn from the likelihood; NaN if it is not a distribution.
        expected_area: the same of the difference of the areas.
    """

    overlap: Float[np.ndarray, "camera draw"]
    area: Float[np.ndarray, "camera draw"]
    expected_overlap: Float[np.ndarray, "camera end"]
    expected_area: Float[np.ndarray, "camera end"]


def reads_silhouettes(model: Model) -> bool:
    """Whether a likelihood of the model compares the body with silhouettes."""
    return "silhouettes" in model.reads


def silhouette_likelihood(model: Model) -> SilhouetteBernoulli | None:
    """Return the model's likelihood that is a distribution over silhouettes; None if it has none."""
    for factor in model.factors:
        if isinstance(factor.log_potential, SilhouetteBernoulli):
            return factor.log_potential
    return None


def silhouette_check(model: Model, session: Session, frame: Frame, poses: Float[np.ndarray, "draw *shape"], key: Key) -> SilhouetteCheck:
    """Compare a frame's silhouettes with those of draws of the pose.

    Args:
        model: the model, with its cameras where they are in this frame.
        session: the recording.
        frame: the frame.
        poses: draws of equal weight, radians and metres.
        key: random key of the likelihood's noise.
    """
    cameras = len(session.views)
    overlap, area = (np.full((cameras, len(poses)), np.nan) for _ in range(2))
    expected_overlap, expected_area = (np.full((cameras, 2), np.nan) for _ in range(2))
    # A single pose, the mean of a mode seeker, has no predictive distribution.
    likelihood, masks = silhouette_likelihood(model) if len(poses) > 1 else None, body_masks(model, session, poses)
    drawn = None if likelihood is None else np.asarray(_drawn(likelihood, jax.random.split(key, len(poses)), poses.astype(np.float32)))
    for c, bodies in enumerate(masks):
        silhouette = seen_mask(frame, c)
        if silhouette is None:
            continue
        if likelihood is None or drawn is None:
            overlap[c], area[c] = _figures(bodies, [smaller(silhouette)] * len(bodies))
            continue
        # The same comparison for the seen silhouette and for drawn ones: on the likelihood's grid.
        on_grid = [sample_mask(body, *likelihood.grid) for body in bodies]
        overlap[c], area[c] = _figures(on_grid, [sample_mask(silhouette, *likelihood.grid)] * len(bodies))
        expected_overlap[c], expected_area[c] = (np.nanpercentile(values, ENDS) for values in _figures(on_grid, list(drawn[:, c])))
    return SilhouetteCheck(overlap, area, expected_overlap, expected_area)


def body_masks(model: Model, session: Session, poses: Float[np.ndarray, "draw *shape"]) -> list[list[Bool[np.ndarray, "row column"]]]:
    """Return for each camera the silhouettes of the posed bodies, at no more than WIDTH pixels."""
    by_pose = [outlines(model, pose) for pose in poses]
    masks = []
    for c, view in enumerate(session.views):
        size = _small(view.camera.size_px)
        scale = np.array(size) / view.camera.size_px
        # Integers are the centres of pixels, at every size.
        masks.append([fill([Outline(part, (polygon + 0.5) * scale - 0.5) for part, polygon in pose_outlines[c]], size) for pose_outlines in by_pose])
    return masks


def seen_mask(frame: Frame, camera: int) -> NDArray[np.bool_] | None:
    """Return the seen silhouette; None if there is none, or if it is empty."""
    mask = None if frame.masks is None else frame.masks[camera]
    return mask if mask is not None and mask.any() else None


def smaller(mask: NDArray[np.bool_]) -> Bool[np.ndarray, "row column"]:
    """Return the silhouette at no more than WIDTH pixels."""
    levels: MatLike = mask.astype(np.float32)
    return cv2.resize(levels, _small((mask.shape[1], mask.shape[0])), interpolation=cv2.INTER_AREA) > 0.5


def _small(size_px: tuple[int, int]) -> tuple[int, int]:
    scale = min(1.0, WIDTH / size_px[0])
    return max(round(size_px[0] * scale), 1), max(round(size_px[1] * scale), 1)


def _figures(
    bodies: list[Bool[np.ndarray, "row column"]], silhouettes: list[Bool[np.ndarray, "row column"]]
) -> tuple[Float[np.ndarray, " draw"], Float[np.ndarray, " draw"]]:
    """Return the overlap of each pair and the difference of their areas."""
    overlap = [intersection_over_union(body, mask) for body, mask in zip(bodies, silhouettes, strict=True)]
    areas = [(np.count_nonzero(body), np.count_nonzero(mask)) for body, mask in zip(bodies, silhouettes, strict=True)]
    return np.array(overlap), np.array([(body - mask) / mask if mask else np.nan for body, mask in areas])


@jax.jit
def _drawn(
    likelihood: SilhouetteBernoulli, keys: Shaped[PRNGKeyArray, " draw"], poses: Float[Array, "draw *shape"]
) -> Bool[Array, "draw camera row column"]:
    return jax.vmap(likelihood.draw)(keys, poses)
