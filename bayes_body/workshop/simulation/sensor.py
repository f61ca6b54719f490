r"""From light to grey levels (lens blur, exposure, noise, eight bits), and silhouettes with the errors of a segmenter.

A pixel of mean level I reads $g(t)\,I + \epsilon$ with $\epsilon \sim N(0, r^2 + s\,g\,I)$: read noise and photon shot noise. The gain g is the
product of the camera's own gain, its white balance, and an exposure that drifts slowly by up to 12 grey levels at mid grey, like an automatic
exposure on a cloudy day.

A good segmenter errs by a pixel or two along the outline. A poor one leaves holes, includes shadows and adds blobs in empty regions.
"""

from functools import cache
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from bayes_body.workshop.simulation.options import Quality

# Pixels: standard deviation of the lens blur.
LENS_PX = 0.7
# Grey levels squared, and grey levels: sd 1.5 in the dark, 3 in bright areas, like an industrial camera indoors.
READ_NOISE, SHOT_NOISE = 2.0, 0.035
# Standard deviations of the cameras' gains, and of the channels of one camera.
GAIN_SD, BALANCE_SD = 0.05, 0.02
# Drift: grey levels at mid grey, and period of its shortest cycle in seconds.
DRIFT, MID_GREY, SHORTEST_CYCLE_S = 12.0, 128.0, 4.0
# Each frame has its own random stream, so the order of filming does not matter. Frames of the empty scene have negative numbers.
BEFORE = 1_000_000


class Sensor:
    """The sensor of one camera, with its own gain, colours and drift."""

    def __init__(self, key: tuple[int, ...], frames: int, fps: float, grey: bool, noise: float):
        """A random sensor.

        Args:
            key: seed and number of the camera.
            frames: number of frames in the recording.
            fps: frames per second.
            grey: whether it has no colours.
            noise: level of the noise; 0 is a perfect sensor, 1 a usual one.
        """
        rng = np.random.default_rng(key)
        self._key, self._grey, self._noise = key, grey, noise
        self._gain = (1 + noise * rng.normal(0, GAIN_SD)) * (1 + (0.0 if grey else noise) * rng.normal(0, BALANCE_SD, 3))
        self._cycle = max(frames, SHORTEST_CYCLE_S * fps)
        self._phase = rng.uniform(0, 2 * np.pi, 2)

    def drift(self, frame: int) -> float:
        """The exposure's error at mid grey, grey levels."""
        angle = 2 * np.pi * frame / self._cycle
        return self._noise * DRIFT * float(0.75 * np.sin(angle + self._phase[0]) + 0.25 * np.sin(3 * angle + self._phase[1]))

    def read(self, picture: Float[np.ndarray, "row column 3"], frame: int) -> UInt8[np.ndarray, "row column 3"]:
        """A picture (blue, green, red, grey levels) as this sensor reads it; a grey sensor returns three equal channels."""
        light = cv2.GaussianBlur(picture, (0, 0), LENS_PX)
        gain = self._gain * (1 + self.drift(frame) / MID_GREY)
        if self._grey:
            light = cv2.cvtColor(light, cv2.COLOR_BGR2GRAY)
        # OpenCV reads four numbers as one per channel, whatever the number of channels.
        level = cv2.multiply(light, np.array([*gain, 0.0])).reshape(*picture.shape[:2], -1)
        # OpenCV's sum rounds, and clips to 0 and 255.
        read = cv2.add(level, self._draw(frame, level), dtype=cv2.CV_8U).reshape(level.shape)
        return np.repeat(read, 3, axis=-1) if self._grey else read

    def _draw(self, frame: int, level: Float[np.ndarray, "row column channel"]) -> Float[np.ndarray, "row column channel"]:
        if not self._noise:
            return np.zeros_like(level)
        bank = _gaussians(1 << max(22, (2 * level.size).bit_length()))
        start = int(np.random.default_rng((*self._key, BEFORE + frame)).integers(bank.size - level.size))
        deviation = cv2.sqrt(SHOT_NOISE * level + READ_NOISE)
        noise = cv2.multiply(bank[start : start + level.size].reshape(level.shape), deviation.reshape(level.shape), scale=self._noise)
        return noise.reshape(level.shape)


@cache
def _gaussians(count: int) -> Float[np.ndarray, " value"]:
    """Standard normal values. Each frame uses a stretch from a random place: new values would take longer than the rest of the picture."""
    return np.random.Generator(np.random.SFC64(count)).standard_normal(count, dtype=np.float32)


type Levels = Float[np.ndarray, "row column"]


class Faults(NamedTuple):
    """The errors of a segmenter.

    Attributes:
        soft_px: number of pixels over which the person's edge is smoothed before thresholding.
        outline: standard deviation of the noise that is added before thresholding at one half.
        outline_px: correlation length of that noise.
        shadow: weight of a shadow as part of the person.
        holes: a slowly varying field causes a hole where it exceeds this many standard deviations.
        blobs: the same for a blob that is not there.
    """

    soft_px: float
    outline: float
    outline_px: float
    shadow: float
    holes: float
    blobs: float


FAULTS: dict[str, Faults] = {
    "good": Faults(soft_px=1.2, outline=0.35, outline_px=5, shadow=0.0, holes=np.inf, blobs=np.inf),
    "poor": Faults(soft_px=2.5, outline=0.45, outline_px=10, shadow=0.9, holes=1.6, blobs=3.0),
}
# Size in pixels of a hole and of a blob. This and all pixels here refer to a picture with 640 columns.
HOLE_PX, BLOB_PX, AT_COLUMNS = 22, 16, 640


def segment(rng: np.random.Generator, quality: Quality, coverage: Levels, shadow: Levels) -> Bool[np.ndarray, "row column"]:
    """The silhouette that a segmenter of some quality returns.

    Args:
        rng: for its errors.
        quality: `good` or `poor`.
        coverage: fraction of each pixel that the person covers.
        shadow: darkness of the person's shadow, from 0 to 1.
    """
    faults, scale = FAULTS[quality], coverage.shape[1] / AT_COLUMNS
    person = np.maximum(coverage, faults.shadow * shadow) if faults.shadow else coverage
    if np.isfinite(faults.holes):
        person = person * (_field(rng, coverage.shape, HOLE_PX * scale) < faults.holes)
    if np.isfinite(faults.blobs):
        person = np.maximum(person, _field(rng, coverage.shape, BLOB_PX * scale) > faults.blobs)
    soft = cv2.GaussianBlur(person.astype(np.float32), (0, 0), faults.soft_px * scale)
    return soft + faults.outline * _field(rng, coverage.shape, faults.outline_px * scale) * (4 * soft * (1 - soft)) > 0.5


def _field(rng: np.random.Generator, shape: tuple[int, ...], cell_px: float) -> Levels:
    """Random values with mean 0 and standard deviation near 1, correlated over `cell_px` pixels."""
    rows, columns = (int(side / cell_px) + 3 for side in shape[:2])
    coarse = rng.standard_normal((rows, columns), dtype=np.float32)
    # Cubic interpolation between cells loses some of the standard deviation.
    return 1.25 * cv2.resize(coarse, (shape[1], shape[0]), interpolation=cv2.INTER_CUBIC)
