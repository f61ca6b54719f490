r"""Log-ratios of the foreground and of edges, for the likelihood `regions` (Sigal et al. 2011, (8) and (9)).

With S the silhouette, smoothed a little so that it has a gradient, the log-ratio of region k to the rest of the image is

$$S \log \frac{p_k}{p_3} + (1 - S) \log \frac{1 - p_k}{1 - p_3},$$

where $p_1$ = `inside`, $p_2$ = `band` and $p_3$ = `elsewhere` are the probabilities of foreground. The log-ratio of a pixel of a part's side is
$E_0^2 - E^2$: E is the distance to the nearest edge, at most `edge_limit_px`, divided by `edge_scale_px`; $E_0^2$ = `edge_elsewhere` is what to
expect of a pixel about which nothing is known. The paper has $E_0 = 0$, with which leaving the picture would be the best fit. Where another person
covers the image, all log-ratios are 0.

The defaults of `inside`, `band` and `edge_elsewhere` are means over four simulated walks, five frames of each in four views, with the likelihood's
default band. The paper learned 0.8 and 0.3, from silhouettes with more holes. With MODEL a model with `regions`, the commands

    bayes-body simulate 05/05_01.amc --subject 105 --seed 1 --first-frame 60 --frames 20 --out train_05
    bayes-body simulate 07/07_01.amc --subject 107 --seed 2 --frames 20 --out train_07
    bayes-body simulate 08/08_01.amc --subject 108 --seed 3 --frames 20 --out train_08
    bayes-body simulate 16/16_15.amc --subject 116 --seed 4 --first-frame 30 --frames 20 --out train_16
    python inference/learn/learn_regions.py train_05 train_07 train_08 train_16 --model MODEL

gave 0.982 to 0.987 inside and 0.32 to 0.35 in the band for single walks, and E² of 1.2 to 3.0 on the true sides, 3.2 to 5.2 near the person.
"""

import math
from collections.abc import Callable
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from bayes_body.base.registry import register
from bayes_body.base.toml.schema import NonNegative, Positive, Schema
from bayes_body.recording.evidence.regions import NEUTRAL, RegionMaps, nats_of, quantised_log_ratios, unseen
from bayes_body.recording.evidence.silhouette_edges import Levels, hide, pack
from bayes_body.recording.observation.covered import uncovered
from bayes_body.recording.observation.frames import Frame, covered_of, masks_of
from bayes_body.recording.observation.silhouette_edges import distance_to, edges, smooth_silhouette

Probability = Annotated[float, Field(strict=True, gt=0, lt=1)]


class Options(Schema):
    """Options of `[likelihood.observation]` of `regions`."""

    inside: Probability = 0.98
    """probability that a pixel inside a part is foreground."""
    band: Probability = 0.34
    """the same for a pixel in the band beside it."""
    elsewhere: Probability = 0.5
    """the same for any other pixel, because other parts may be anywhere."""
    smooth_px: Positive = 1.5
    """[pixels] standard deviation of the Gaussian that smooths the mask."""
    edge_threshold: Positive = 20.0
    """[grey levels per pixel] gradient above which a pixel is an edge."""
    edges_within_px: NonNegative = 4.0
    """[pixels] edges farther from the silhouette belong to the room and do not count."""
    edge_scale_px: Positive = 4.0
    """[pixels] unit of the distance to the nearest edge."""
    edge_limit_px: Positive = 12.0
    """[pixels] largest distance that counts: one missing edge does not decide."""
    edge_elsewhere: NonNegative = 3.15
    """squared distance, in units of `edge_scale_px`, of a side about which nothing is known."""


@register("observation", "regions", Options)
def build(options: Options, **_: Any) -> Callable[[Frame], RegionMaps]:
    """Compute the likelihood's maps from a frame's images and masks."""
    foreground = [_log_odds(p, options.elsewhere) for p in (options.inside, options.band)]
    farthest = (options.edge_limit_px / options.edge_scale_px) ** 2
    largest = [*(max(abs(log_odds) for log_odds in pair) for pair in foreground), max(options.edge_elsewhere, farthest - options.edge_elsewhere)]

    def maps_of(image: NDArray[np.uint8], figures: NDArray[np.bool_], covered: NDArray[np.bool_] | None, shape: tuple[int, int]) -> Levels:
        mask = uncovered(figures, covered)
        S = smooth_silhouette(mask, options.smooth_px, covered)
        ratios: list[NDArray[np.floating]] = [S * np.float32(if_seen) + (1 - S) * np.float32(if_not) for if_seen, if_not in foreground]
        ratios.append(np.float32(options.edge_elsewhere) - squared_edge_distance(image, mask, options, covered))
        levels = np.stack([quantised_log_ratios(ratio, most, shape) for ratio, most in zip(ratios, largest, strict=True)])
        return hide(levels, covered, NEUTRAL)

    def observe(frame: Frame) -> RegionMaps:
        empty_maps = np.stack([unseen(frame.largest)] * 3)
        views = zip(frame.images, masks_of(frame), covered_of(frame), strict=True)
        stacks = [empty_maps if image is None or mask is None else maps_of(image, mask, covered, frame.largest) for image, mask, covered in views]
        return RegionMaps(pack(np.stack(stacks)), np.array([nats_of(most) for most in largest], np.float32))

    return observe


def squared_edge_distance(
    image: NDArray[np.uint8], mask: NDArray[np.bool_], options: Options, covered: NDArray[np.bool_] | None = None
) -> NDArray[np.float32]:
    """E² at each pixel (row, column) of an image with a silhouette. Edges of other people, in what they cover, do not count."""
    edge_pixels = uncovered(edges(image, options.edge_threshold) & (distance_to(mask) <= options.edges_within_px), covered)
    return np.square(np.minimum(distance_to(edge_pixels), np.float32(options.edge_limit_px)) / np.float32(options.edge_scale_px))


def _log_odds(probability: float, elsewhere: float) -> tuple[float, float]:
    """The log-ratios of foreground and of background."""
    return math.log(probability / elsewhere), math.log((1 - probability) / (1 - elsewhere))
