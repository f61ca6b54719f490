"""Pictures that are kept: made once, given back as they were, within bounds, and those of one owner only."""

import numpy as np
import pytest

from bayes_body.recording.observation.pictures import PictureCache


def picture(seed):
    return np.random.default_rng(seed).integers(0, 255, (30, 40), np.uint8)


class Maker:
    """Makes pictures, and counts them."""

    def __init__(self):
        self.made = 0

    def __call__(self, seed):
        def make():
            self.made += 1
            return None if seed is None else picture(seed)

        return make


@pytest.fixture
def maker():
    return Maker()


def test_a_picture_is_made_once_and_stays_what_it_is(maker):
    shelf = PictureCache(1 << 20)
    for _ in range(3):
        np.testing.assert_array_equal(shelf.get("a", 1, maker(1)), picture(1))
        assert shelf.get("a", 2, maker(None)) is None
    assert maker.made == 2


def test_a_full_shelf_keeps_its_first_pictures(maker):
    # Noise does not pack: two pictures of 1200 pixels, and no third.
    shelf = PictureCache(2500)
    for _ in range(2):
        for seed in range(4):
            np.testing.assert_array_equal(shelf.get("a", seed, maker(seed)), picture(seed))
    assert maker.made == 4 + 2


def test_another_owners_take_their_place(maker):
    shelf = PictureCache(2500)
    for owner in ("a", "b", "b", "a"):
        for seed in range(2):
            shelf.get(owner, seed, maker(seed))
    assert maker.made == 2 + 2 + 0 + 2
