"""Limbs from colour blobs in pairs of views."""

import cv2
import numpy as np
from initial.detection.people import PERSON, SIZE, mask, ring, scene

from bayes_body.initial.detection.limbs import blobs, detect_limbs

COLOURS = [(40, 40, 200), (90, 160, 210), (200, 60, 60), (90, 160, 210), (200, 60, 60), (90, 160, 210)]
COLOURS += [(60, 60, 60), (150, 90, 30), (30, 30, 90), (60, 60, 60), (150, 90, 30), (30, 30, 90)]


def painted(spec):
    """The person with a colour for each part, on grey."""
    picture = np.full((SIZE[1], SIZE[0], 3), 120, np.uint8)
    for part, colour in zip(PERSON, COLOURS, strict=True):
        picture[mask(spec, (part,))] = colour
    return cv2.GaussianBlur(picture, (3, 3), 0)


def test_an_ellipse_of_one_colour_is_a_blob_with_its_ends():
    picture = np.full((240, 320, 3), 30, np.uint8)
    inside = np.zeros((240, 320), np.uint8)
    cv2.ellipse(inside, (150, 120), (60, 14), 30, 0, 360, 1, cv2.FILLED)
    picture[inside > 0] = (200, 80, 40)
    cv2.circle(inside, (60, 200), 45, 1, cv2.FILLED)
    found = blobs(picture, inside > 0)
    middle, axis = np.array([150, 120]), 60 * np.array([np.cos(np.pi / 6), np.sin(np.pi / 6)])
    assert any(np.abs(np.sort(each.ends, axis=0) - (middle - axis, middle + axis)).max() < 8 for each in found)


def test_the_forearms_of_a_painted_person_are_found():
    cameras = ring(5)
    found = detect_limbs(scene(cameras, [mask(each) for each in cameras], pictures=[painted(each) for each in cameras]))
    forearms, axis = found.parts["l_forearm"], np.array([0, 0.24, -0.18]) / 0.3
    distances = np.linalg.norm(forearms.positions - [0, 0.55, 1.10], axis=1)
    assert distances.min() < 0.08
    assert forearms.rotations[distances.argmin(), :, 2] @ axis > 0.85
    assert (forearms.sd_rad[:, 2] > 1.5).all()


def test_calves_weigh_more_near_the_floor_than_forearms_do():
    cameras = ring(5)
    parts = detect_limbs(scene(cameras, [mask(each) for each in cameras], pictures=[painted(each) for each in cameras])).parts
    assert parts["l_calf"].weights @ parts["l_calf"].positions[:, 2] < 0.5 < parts["l_forearm"].weights @ parts["l_forearm"].positions[:, 2]


def test_without_silhouettes_there_are_no_limbs_and_it_is_said():
    assert "silhouettes" in detect_limbs(scene(ring(2), None)).notices[0]
    cameras = ring(3)
    empty = [np.zeros((480, 640), bool)] * 3
    assert detect_limbs(scene(cameras, empty)).notices == ("no limb was found in any pair of views",)
