"""How many frames a page shows, and how large their images are, so that it stays small."""

import math
from typing import NamedTuple

# Bytes of a page: small enough to be mailed. Of them, for the draws and for the images.
LARGEST, DRAWS, IMAGES = 10_000_000, 4_800_000, 3_800_000
# The most frames.
FRAMES = 300
# Bytes in the page, measured: of a part's axis in a draw, of the mean body and the points of a frame, and of a pixel of an image.
AXIS, FRAME, PIXEL = 20.0, 1500.0, 0.13
# Shortest and longest of an image's longer side, pixels.
SIDES = (96, 400)
# Height / width of a usual image.
SHAPE = 0.7


class Budget(NamedTuple):
    """What is to be shown.

    Attributes:
        axes: number of lines of a frame: draws times parts.
        cameras: number of cameras with images.
    """

    axes: int
    cameras: int

    def step(self, frames: int) -> int:
        """Return the step between the frames that are shown."""
        most = min(FRAMES, int(DRAWS / (FRAME + AXIS * self.axes)))
        return math.ceil(frames / max(most, 1))

    def side(self, frames: int) -> int:
        """Return the longer side of the images, pixels, if so many frames are shown."""
        image_bytes = IMAGES / max(frames * self.cameras, 1)
        return int(min(max(math.sqrt(image_bytes / (PIXEL * SHAPE)), SIDES[0]), SIDES[1]))
