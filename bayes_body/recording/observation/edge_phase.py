r"""A bank of orientation-tuned band-pass filters in quadrature, computed on the host while the device works on the previous frame.

Log-Gabor in radius, $\exp(-\ln^2(f\lambda) / 2 \ln^2 \beta)$ for the wavelength $\lambda$ (Field 1987); in direction, the even and odd windows of
`bayes_body.recording.evidence.edge_phase`. A wave with the filter's wavelength and direction gives a response with the wave's amplitude, in grey
levels. A step edge gives an odd response, with the phase π/2 or −π/2.
"""

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import fft

from bayes_body.base.errors import input_error
from bayes_body.base.registry import register
from bayes_body.base.toml.schema import Schema
from bayes_body.recording.evidence.edge_phase import ODD, PhaseMaps, pack, unseen
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
        nothing = np.stack([unseen(frame.largest)] * len(wavelengths)), np.ones(len(wavelengths), np.float32)
        maps = [nothing if image is None else maps_of(image, frame.largest) for image in frame.images]
        words, levels = zip(*maps, strict=True)
        return PhaseMaps(np.stack(words), np.stack(levels), np.array(frame.seen, np.float32))

    return observe


def _check_size(shape: tuple[int, ...], wavelength_px: float) -> None:
    least = int(np.ceil(2 * SUPPORT * wavelength_px))
    if min(shape) < least:
        problem = f"images of {shape[1]} x {shape[0]} pixels under a filter of wavelength {wavelength_px:g} px"
        raise input_error("edge_phase", problem, f"at least {least} pixels a side", "use a shorter `wavelength_px`, or larger images")
