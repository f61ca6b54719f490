"""What a user may say about a simulated recording beyond the motion, the cameras and the person."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from bayes_body.errors import input_error

type Quality = Literal["good", "poor"]
# Beyond it nothing looks like a room, or like a picture.
LARGEST_LEVEL = 5.0


@dataclass(frozen=True)
class Options:
    """Levels are factors: 0 switches off, 1 is usual.

    Attributes:
        clutter: how much furniture, and how strong the textures of floor and walls.
        noise: of the sensor, of its exposure's drift and of the cameras' differing gains.
        segmentation: whether silhouettes are written as a segmenter of that quality would give them; None leaves them to be told from an empty scene.
        true_masks: whether the true silhouettes are written too.
        background: a folder with an image or a video of the empty scene for each camera, which takes the place of the drawn room.
        keypoint_sd_px: standard deviation of a detector's keypoints in the first frame.
        seed: of everything that is drawn at random, the person excepted.
    """

    clutter: float = 1.0
    noise: float = 1.0
    segmentation: Quality | None = None
    true_masks: bool = False
    background: Path | None = None
    keypoint_sd_px: float = 3.0
    seed: int = 0

    def __post_init__(self) -> None:
        """Refuse levels that cannot be.

        Raises:
            InputError: one is negative, not finite or far beyond the usual.
        """
        for name, value in (("--clutter", self.clutter), ("--noise", self.noise)):
            if not 0 <= value <= LARGEST_LEVEL:
                raise input_error(name, f"{value:g}", f"0 to {LARGEST_LEVEL:g}", "0 switches it off, 1 is usual")
        if not 0 <= self.keypoint_sd_px <= 100:
            raise input_error("--keypoint-noise", f"{self.keypoint_sd_px:g}", "0 to 100 pixels", "3 is usual")
        if self.seed < 0:
            raise input_error("--seed", f"{self.seed}", "0 or above", "give another")
