"""Brightness: the line that made an image is found again, whatever stands in the way."""

import cv2
import numpy as np
import pytest

from bayes_body.recording.observation.exposure import fit_exposure


@pytest.fixture
def scene() -> np.ndarray:
    """An empty room of blobs, 30 to 200 grey levels."""
    field = cv2.GaussianBlur(np.random.default_rng(3).normal(size=(90, 120, 3)).astype(np.float32), (0, 0), 5)
    return 30 + 170 * (field - field.min()) / np.ptp(field)


def photograph(scene: np.ndarray, gain, offset) -> np.ndarray:
    noise = np.random.default_rng(8).normal(size=scene.shape)
    return np.clip(np.asarray(gain) * scene + offset + noise, 0, 255).astype(np.uint8)


@pytest.mark.parametrize(("gain", "offset"), [(1.0, 0.0), (0.7, 5.0), (1.15, 10.0), ((1.1, 1.0, 0.9), (0.0, 12.0, -6.0))])
def test_a_global_change_is_found_behind_a_person(scene, gain, offset):
    image = photograph(scene, gain, offset)
    image[20:80, 40:70] = (250, 20, 140)
    exposure = fit_exposure(image, scene.astype(np.float32))
    assert exposure is not None
    found = exposure.gain * scene + exposure.offset
    rest = np.abs(found - (np.asarray(gain) * scene + offset))
    # Half a grey level is lost by rounding down.
    assert np.median(rest) < 1.0
    assert np.percentile(rest, 99) < 5


def test_what_varies_slowly_is_found(scene):
    rows, columns = np.mgrid[-1:1:90j, -1:1:120j]
    glare = (10 + 8 * columns - 6 * rows * columns + 5 * rows**2)[..., None]
    exposure = fit_exposure(photograph(scene, 1.0, glare), scene.astype(np.float32))
    assert exposure is not None
    assert np.abs(exposure.offset + exposure.gain * scene - scene - glare).mean() < 1.5


@pytest.mark.parametrize("level", [0, 3, 255])
def test_a_black_or_overexposed_image_is_no_image_of_the_scene(scene, level):
    assert fit_exposure(np.full(scene.shape, level, np.uint8), scene.astype(np.float32)) is None


def test_another_scene_is_none(scene):
    other = np.random.default_rng(5).integers(0, 256, scene.shape).astype(np.uint8)
    assert fit_exposure(other, scene.astype(np.float32)) is None


@pytest.mark.parametrize("level", [0, 120, 255])
def test_a_scene_of_one_colour(level):
    scene = np.full((60, 80, 3), level, np.float32)
    image = scene.astype(np.uint8)
    image[10:40, 20:35] = (90, 200, 30)
    exposure = fit_exposure(image, scene)
    assert exposure is not None
    np.testing.assert_allclose(exposure.gain * scene + exposure.offset, scene, atol=1.0)
