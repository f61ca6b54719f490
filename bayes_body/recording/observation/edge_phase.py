r"""A bank of orientation-tuned band-pass filters in quadrature, computed on the host while the device works on the previous frame.

Log-Gabor in radius, $\exp(-\ln^2(f\lambda) / 2 \ln^2 \beta)$ for the wavelength $\lambda$ (Field 1987); in direction, the even and odd windows of
`bayes_body.recording.evidence.edge_phase`. A wave with the filter's wavelength and direction gives a response with the wave's amplitude, in grey
levels. A step edge gives an odd response, with the phase π/2 or −π/2.

The responses can also be read at points on the outline of a silhouette, beside it and elsewhere.
"""

from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import cv2
import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray
from scipy import fft
from scipy.ndimage import map_coordinates

from bayes_body.base.errors import input_error
from bayes_body.base.registry import register
from bayes_body.base.toml.schema import Schema
from bayes_body.recording.evidence.edge_phase import ODD, PhaseMaps, Response, pack, steer, unseen
from bayes_body.recording.observation.frames import Frame

# β: the filter's standard deviation over the logarithm of frequency, as a ratio; 0.65 is a band of one and a half octaves.
RATIO = 0.65
# A filter's response vanishes beyond this many wavelengths from its centre.
SUPPORT = 1.5


class Options(Schema):
    """Options of `[likelihood.observation]` of `edge_phase`. There are none; the wavelengths are the likelihood's scales."""


def responses(grey: NDArray[np.uint8], wavelength_px: float) -> NDArray[np.float32]:
    """The seven response maps of one scale: (map, row, column), in the order of `bayes_body.recording.evidence.edge_phase`, grey levels.

    Args:
        grey: image (row, column).
        wavelength_px: the filter's wavelength, pixels.
    """
    margin = int(np.ceil(2 * SUPPORT * wavelength_px))
    rows, columns = grey.shape
    # Reflect the image at its border, since a black border would be an edge.
    wide = cv2.copyMakeBorder(grey, margin, margin, margin, margin, cv2.BORDER_REFLECT_101).astype(np.float32)
    shape = tuple(fft.next_fast_len(extent, real=True) for extent in wide.shape)
    spectrum = fft.rfft2(wide, shape, workers=-1)
    maps = np.empty((7, rows, columns), np.float32)
    for number, window in enumerate(_windows(shape, wavelength_px)):
        filtered = np.asarray(fft.irfft2(spectrum * window, shape, workers=-1))
        maps[number] = filtered[margin : margin + rows, margin : margin + columns]
    return maps


@lru_cache(maxsize=8)
def _windows(shape: tuple[int, int], wavelength_px: float) -> NDArray[np.complex64]:
    """The seven filters in the frequencies of a real transform: (map, row, column)."""
    fy, fx = fft.fftfreq(shape[0])[:, None], fft.rfftfreq(shape[1])[None, :]
    radius = np.hypot(fx, fy)
    radius[0, 0] = 1.0
    radial = np.exp(-(np.log(radius * wavelength_px) ** 2) / (2 * np.log(RATIO) ** 2))
    radial[0, 0] = 0.0
    direction = (fx + 1j * fy) / radius
    double, triple = direction**2, direction**3
    even = [np.ones_like(radius), double.real, double.imag]
    odd = [ODD[0] * direction.real, ODD[0] * direction.imag, ODD[1] * triple.real, ODD[1] * triple.imag]
    return np.stack([0.5 * radial * window for window in even] + [1j * radial * window for window in odd]).astype(np.complex64)


@register("observation", "edge_phase", Options)
def build(options: Options, likelihood: Any = None, **_: Any) -> Callable[[Frame], PhaseMaps]:
    """Compute the filter responses of a frame's images, as NumPy arrays.

    Args:
        options: none.
        likelihood: the options of the likelihood that reads the responses; its scales are used.
    """
    del options
    wavelengths = [scale.wavelength_px for scale in likelihood.scale]

    def maps_of(image: NDArray[np.uint8], shape: tuple[int, int]) -> tuple[NDArray[np.uint32], NDArray[np.float32]]:
        _check_size(image.shape, max(wavelengths))
        words, levels = zip(*(pack(responses(image, wavelength), shape) for wavelength in wavelengths), strict=True)
        return np.stack(words), np.array(levels, np.float32)

    def observe(frame: Frame) -> PhaseMaps:
        empty_maps = np.stack([unseen(frame.largest)] * len(wavelengths)), np.ones(len(wavelengths), np.float32)
        maps = [empty_maps if image is None else maps_of(image, frame.largest) for image in frame.images]
        words, levels = zip(*maps, strict=True)
        return PhaseMaps(np.stack(words), np.stack(levels), np.array(frame.seen, np.float32))

    return observe


def _check_size(shape: tuple[int, ...], wavelength_px: float) -> None:
    least = int(np.ceil(2 * SUPPORT * wavelength_px))
    if min(shape) < least:
        problem = f"images of {shape[1]} x {shape[0]} pixels under a filter of wavelength {wavelength_px:g} px"
        raise input_error("edge_phase", problem, f"at least {least} pixels a side", "use a shorter `wavelength_px`, or larger images")


# Distance in pixels between two points along an outline, and between an outline and points elsewhere.
SPACING_PX, ELSEWHERE_PX = 4, 12
# The outline of a pixel mask has corners; normals are computed after smoothing by this standard deviation.
SMOOTH_PX = 2.5


class Points(NamedTuple):
    """Points in an image: column and row, and the unit vectors along which filters are steered."""

    places: Float[np.ndarray, "point 2"]
    normals: Float[np.ndarray, "point 2"]


def outline_points(mask: NDArray[np.bool_]) -> Points:
    """The outline of a silhouette (row, column), sampled every few pixels on pixel edges; parts on the image border are left out."""
    smooth = cv2.GaussianBlur(mask.astype(np.float32), (0, 0), SMOOTH_PX)
    slope = np.stack([cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1)], axis=-1)
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    pixels = np.concatenate([contour[::SPACING_PX, 0] for contour in contours] or [np.zeros((0, 2), int)])
    rows, columns = mask.shape
    margin = np.ceil(3 * SMOOTH_PX)
    inside = np.all((pixels >= margin) & (pixels < np.array([columns, rows]) - margin), axis=1)
    pixels = pixels[inside]
    outward = -slope[pixels[:, 1], pixels[:, 0]]
    length = np.linalg.norm(outward, axis=1)
    has_length = length > 1e-6
    normals = outward[has_length] / length[has_length, None]
    # A contour follows the last pixels inside: the edge is half a pixel further out.
    return Points(pixels[has_length] + 0.5 * normals, normals)


def elsewhere_points(mask: NDArray[np.bool_], number: int, rng: np.random.Generator) -> Points:
    """Random points near a person but not on the outline, with random directions; none if there is no person."""
    if not mask.any():
        return Points(np.zeros((0, 2)), np.zeros((0, 2)))
    distance = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 5) + cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 5)
    height = np.ptp(np.nonzero(mask.any(axis=1))[0])
    rows, columns = np.nonzero((distance >= ELSEWHERE_PX) & (distance <= max(height / 3, 2 * ELSEWHERE_PX)))
    chosen = rng.choice(len(rows), min(number, len(rows)), replace=False) if len(rows) else np.zeros(0, int)
    angle = rng.uniform(0, np.pi, len(chosen))
    return Points(np.stack([columns[chosen], rows[chosen]], axis=1).astype(float), np.stack([np.cos(angle), np.sin(angle)], axis=1))


def displaced(points: Points, by_px: float, rng: np.random.Generator) -> Points:
    """The points moved along their normals, each to a random side."""
    sides = rng.choice([-1.0, 1.0], len(points.places))
    return points._replace(places=points.places + by_px * sides[:, None] * points.normals)


def sampled(maps: Float[np.ndarray, "map row column"], points: Points) -> Response:
    """The responses in one image at the points, interpolated bilinearly as in the likelihood."""
    coordinates = points.places.T[::-1]
    values = [map_coordinates(response_map, coordinates, order=1, mode="nearest") for response_map in maps]
    return steer(values, points.normals[:, 0], points.normals[:, 1])
