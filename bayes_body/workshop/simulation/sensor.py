r"""From light to grey levels: lens blur, exposure, noise, eight bits.

A pixel of mean level I reads $g(t)\,I + \epsilon$ with $\epsilon \sim N(0, r^2 + s\,g\,I)$: read noise and photon shot noise. The gain g is the
product of the camera's own gain, its white balance, and an exposure that drifts slowly by up to 12 grey levels at mid grey, like an automatic
exposure on a cloudy day.
"""

from functools import cache

import cv2
import numpy as np
from jaxtyping import Float, UInt8

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
