r"""Posterior predictive check of silhouettes: the silhouettes of drawn bodies against the seen ones, by their overlap and by their areas.

With A the silhouette of a drawn body and B the seen one, the overlap is $|A \cap B| / |A \cup B|$ (IoU) and the difference of the areas is
$(|A| - |B|) / |B|$. A likelihood that is a distribution over silhouettes, `silhouette_bernoulli`, also draws silhouettes B' around each drawn body.
The same two figures of A and B' are what the model expects (Gelman, Meng & Stern 1996); then all are compared on the likelihood's grid.
`silhouette_edges` and `regions` are no such distributions.
"""

from collections.abc import Mapping
from typing import NamedTuple

import cv2
import jax
import numpy as np
from cv2.typing import MatLike
from jaxtyping import Array, Bool, Float, PRNGKeyArray, Shaped
from numpy.typing import NDArray

from bayes_body.base.shapes import Key
from bayes_body.density.factor import State, variables
from bayes_body.model.build import Model
from bayes_body.model.likelihood.silhouette_bernoulli import SilhouetteBernoulli
from bayes_body.model.unknowns.apply import Unknowns, node_of, with_changes
from bayes_body.recording.observation.covered import uncovered
from bayes_body.recording.observation.frames import Frame, covered_of
from bayes_body.recording.observation.silhouette_bernoulli import sample_mask
from bayes_body.recording.session.session import Session
from bayes_body.results.metrics.fit import Outline, drawn_outlines, fill, intersection_over_union

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


class SilhouetteDistribution(NamedTuple):
    """A likelihood that is a distribution over silhouettes.

    Attributes:
        likelihood: as the session has it.
        terms: the unknowns that change it.
    """

    likelihood: SilhouetteBernoulli
    terms: Unknowns


def silhouette_likelihood(model: Model) -> SilhouetteDistribution | None:
    """Return the model's likelihood that is a distribution over silhouettes; None if it has none."""
    for factor in model.factors:
        likelihood = node_of(factor, SilhouetteBernoulli)
        if likelihood is not None:
            return SilhouetteDistribution(likelihood, tuple(term for term in model.unknowns if term.concerns(factor)))
    return None


def silhouette_check(
    model: Model, session: Session, frame: Frame, states: Mapping[str, Float[np.ndarray, "draw *shape"]], key: Key
) -> SilhouetteCheck:
    """Compare a frame's silhouettes with those of draws of the pose.

    Args:
        model: the model, with its cameras where they are in this frame.
        session: the recording.
        frame: the frame.
        states: draws of equal weight of the model's variables, by name.
        key: random key of the likelihood's noise.
    """
    cameras, draws = len(session.views), len(states[model.body.variable])
    overlap, area = (np.full((cameras, draws), np.nan) for _ in range(2))
    expected_overlap, expected_area = (np.full((cameras, 2), np.nan) for _ in range(2))
    # A single pose, the mean of a mode seeker, has no predictive distribution.
    distribution, masks = silhouette_likelihood(model) if draws > 1 else None, body_masks(model, session, states)
    drawn = None if distribution is None else _silhouettes_about(distribution, states, jax.random.split(key, draws))
    for c, bodies in enumerate(masks):
        silhouette = seen_mask(frame, c)
        if silhouette is None:
            continue
        covered = covered_of(frame)[c]
        if distribution is None or drawn is None:
            region = None if covered is None else smaller(covered)
            overlap[c], area[c] = _figures([uncovered(body, region) for body in bodies], [smaller(silhouette)] * len(bodies))
            continue
        # The same comparison for the seen silhouette and for drawn ones: on the likelihood's grid.
        grid = distribution.likelihood.grid
        region = None if covered is None else sample_mask(covered, *grid)
        on_grid = [uncovered(sample_mask(body, *grid), region) for body in bodies]
        overlap[c], area[c] = _figures(on_grid, [sample_mask(silhouette, *grid)] * len(bodies))
        expected = _figures(on_grid, [uncovered(mask, region) for mask in drawn[:, c]])
        expected_overlap[c], expected_area[c] = (np.nanpercentile(values, ENDS) for values in expected)
    return SilhouetteCheck(overlap, area, expected_overlap, expected_area)


def body_masks(model: Model, session: Session, states: Mapping[str, Float[np.ndarray, "draw *shape"]]) -> list[list[Bool[np.ndarray, "row column"]]]:
    """Return for each camera the silhouettes of the bodies that draws place, at no more than WIDTH pixels."""
    by_draw = drawn_outlines(model, states)
    masks = []
    for c, view in enumerate(session.views):
        size = _small(view.camera.size_px)
        scale = np.array(size) / view.camera.size_px
        # Integers are the centres of pixels, at every size.
        masks.append([fill([Outline(part, (polygon + 0.5) * scale - 0.5) for part, polygon in drawn[c]], size) for drawn in by_draw])
    return masks


def seen_mask(frame: Frame, camera: int) -> NDArray[np.bool_] | None:
    """Return the seen silhouette, without what other people cover; None if there is none, or if it is empty."""
    mask = None if frame.masks is None else frame.masks[camera]
    visible = None if mask is None else uncovered(mask, covered_of(frame)[camera])
    return visible if visible is not None and visible.any() else None


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


def _silhouettes_about(
    distribution: SilhouetteDistribution, states: Mapping[str, Float[np.ndarray, "draw *shape"]], keys: Shaped[PRNGKeyArray, " draw"]
) -> Bool[np.ndarray, "draw camera row column"]:
    terms = tuple(term for term in distribution.terms if term.name in states)
    values = {name: value.astype(np.float32) for name, value in states.items()}
    return np.asarray(_drawn(distribution.likelihood, terms, keys, values))


@jax.jit
def _drawn(
    likelihood: SilhouetteBernoulli, terms: Unknowns, keys: Shaped[PRNGKeyArray, " draw"], states: State
) -> Bool[Array, "draw camera row column"]:
    def draw(key: Key, state: State) -> Bool[Array, "camera row column"]:
        changed = with_changes(terms, likelihood, variables(state))
        return changed.draw(key, state[changed.body.variable])

    return jax.vmap(draw)(keys, states)
