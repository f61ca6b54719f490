r"""Filter responses on a person's boundary: the constants of the likelihood `edge_phase`, learned from images with known boundaries.

A boundary is the outline of a trusted silhouette: a simulator's, or one that a person has checked. Filters are steered to the outline's normal at its
points. $\epsilon$ at both ends of the amplitudes, and a and b of their Beta distribution, are maximum likelihood estimates
(`likelihood.edge_density`). $\rho_{min}$ and $\rho_{max}$ contain 99 % of the amplitudes. log p_occ is half way between the mean log-density on
boundaries and the mean elsewhere (near the person, at least `ELSEWHERE_PX` from the outline, in any direction): a hidden sample is no evidence for or
against a pose.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from numpy.typing import NDArray
from scipy.optimize import minimize

from bayes_body.base.errors import input_error
from bayes_body.model.likelihood.edge_phase import EdgeStatistics, clipped, log_density, log_normaliser, phase_and_log_amplitude, wrapped_normal
from bayes_body.recording.evidence.edge_phase import Response
from bayes_body.recording.observation.edge_phase import displaced, elsewhere_points, outline_points, responses, sampled
from bayes_body.recording.observation.frames import read_frame
from bayes_body.recording.readers.images import read_mask
from bayes_body.recording.session.session import Session

# Fractions of the amplitudes below ρ_min and above ρ_max.
TAIL = 0.005
LEAST_POINTS = 200


def fit(boundary: Response, elsewhere: Response) -> EdgeStatistics:
    """Fit the constants of one scale.

    Raises:
        InputError: there are too few points.
    """
    if len(boundary.even) < LEAST_POINTS or len(elsewhere.even) < LEAST_POINTS:
        problem = f"{len(boundary.even)} points on boundaries, {len(elsewhere.even)} elsewhere"
        raise input_error("edge statistics", problem, f"at least {LEAST_POINTS} of each", "give more frames")
    phase, rho = (np.asarray(feature, float) for feature in phase_and_log_amplitude(jnp.asarray(boundary.even), jnp.asarray(boundary.odd)))
    low, high = np.quantile(rho, [TAIL, 1 - TAIL])
    share = np.asarray(clipped(jnp.asarray((rho - low) / (high - low))), float)
    without = EdgeStatistics(_epsilon(phase, share), _amplitude(share), np.array([low, high]), np.array(0.0))
    half_way = (mean_log_density(boundary, without) + mean_log_density(elsewhere, without)) / 2
    return without._replace(log_occluded=np.array(half_way))


def _epsilon(phase: NDArray[np.floating], share: NDArray[np.floating]) -> NDArray[np.floating]:
    normal = np.asarray(wrapped_normal(jnp.asarray(phase)), float)

    def loss(ends: NDArray[np.floating]) -> float:
        epsilon = ends[0] + (ends[1] - ends[0]) * share
        return -float(np.mean(np.log(epsilon * normal + (1 - epsilon) / np.pi)))

    return minimize(loss, np.array([0.5, 0.8]), bounds=[(0.0, 0.999)] * 2, method="L-BFGS-B").x


def _amplitude(share: NDArray[np.floating]) -> NDArray[np.floating]:
    means = np.mean(np.log(share)), np.mean(np.log1p(-share))

    def loss(ab: Array) -> Array:
        return log_normaliser(ab[0], ab[1]) - (ab[0] - 1) * means[0] - (ab[1] - 1) * means[1]

    # The loss is too rough for optimisation in single precision.
    with jax.enable_x64(True):
        sloped = jax.jit(jax.value_and_grad(loss))
        # Below 1 the density would rise towards an end.
        optimum = minimize(lambda ab: [np.asarray(part, float) for part in sloped(ab)], [2.0, 2.0], jac=True, bounds=[(1.001, 100.0)] * 2)
    return optimum.x


class Images(NamedTuple):
    """Pairs of grey images and silhouettes with known outlines."""

    pairs: Sequence[tuple[NDArray[np.uint8], NDArray[np.bool_]]]

    def at(self, wavelength_px: float, displacements: Sequence[float | None], seed: int = 0) -> list[Response]:
        """Responses for each displacement from all outlines: displaced by that number of pixels, or elsewhere if it is None."""
        rng = np.random.default_rng(seed)
        groups: list[list[Response]] = [[] for _ in displacements]
        for grey, mask in self.pairs:
            maps, outline = responses(grey, wavelength_px), outline_points(mask)
            for place, by_px in zip(groups, displacements, strict=True):
                points = elsewhere_points(mask, len(outline.places), rng) if by_px is None else displaced(outline, by_px, rng)
                place.append(sampled(maps, points))
        return [Response(*(np.concatenate(part) for part in zip(*group, strict=True))) for group in groups]


def known_pairs(session: Session, frames: int, true_masks: Callable[[str], str]) -> list[tuple[NDArray[np.uint8], NDArray[np.bool_]]]:
    """Grey images of a recording, evenly spread over its frames, with known silhouettes.

    Args:
        session: the recording.
        frames: number of frames.
        true_masks: maps a camera's name to the printf pattern of the simulator's silhouettes, relative to the session's folder. If there are none,
            the session's masks are used.
    """
    pairs = []
    for index in sorted({round(place) for place in np.linspace(0, session.frames - 1, frames)}):
        frame = read_frame(session, index)
        for view, image in zip(session.views, frame.images, strict=True):
            path = session.folder / (true_masks(view.camera.name) % index)
            if not path.is_file():
                mask_path = session.mask_path(view, index)
                if mask_path is None:
                    continue
                path = mask_path
            mask = read_mask(path, view.camera.size_px)
            if image is not None and mask.any():
                pairs.append((image, mask))
    return pairs


def mean_log_density(response: Response, statistics: EdgeStatistics) -> float:
    """The mean for one scale, nats per sample."""
    return float(np.mean(np.asarray(log_density(jnp.asarray(response.even), jnp.asarray(response.odd), statistics))))
