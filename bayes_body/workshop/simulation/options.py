"""The options of a simulated recording, apart from the motion, the cameras and the person."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from bayes_body.base.errors import input_error

type Quality = Literal["good", "poor"]
# With larger levels nothing looks like a room, or like a picture.
LARGEST_LEVEL = 5.0


@dataclass(frozen=True)
class Options:
    """Levels are factors: 0 switches an effect off, 1 is usual.

    Attributes:
        clutter: amount of furniture, and strength of the textures on floor and walls.
        noise: noise of the sensor, drift of its exposure and differences between the cameras' gains.
        segmentation: quality of the segmenter whose silhouettes are written; None: no silhouettes, so that they are computed from an empty scene.
        true_masks: whether to write the true silhouettes too.
        background: a folder with an image or a video of the empty scene for each camera, instead of the drawn room.
        keypoint_sd_px: standard deviation of a detector's keypoints in the first frame.
        keypoints: whether to write a detector's keypoints of all people in all frames.
        seed: the seed of everything random except the person.
    """

    clutter: float = 1.0
    noise: float = 1.0
    segmentation: Quality | None = None
    true_masks: bool = False
    background: Path | None = None
    keypoint_sd_px: float = 3.0
    keypoints: bool = False
    seed: int = 0

    def __post_init__(self) -> None:
        """Refuse impossible levels.

        Raises:
            InputError: a level is negative, not finite or far beyond the usual.
        """
        for name, value in (("--clutter", self.clutter), ("--noise", self.noise)):
            if not 0 <= value <= LARGEST_LEVEL:
                raise input_error(name, f"{value:g}", f"0 to {LARGEST_LEVEL:g}", "0 switches it off, 1 is usual")
        if not 0 <= self.keypoint_sd_px <= 100:
            raise input_error("--keypoint-noise", f"{self.keypoint_sd_px:g}", "0 to 100 pixels", "3 is usual")
        if self.seed < 0:
            raise input_error("--seed", f"{self.seed}", "0 or above", "give another seed")
