"""What `image_motion` compares: the picture of a frame, that of the frame before as it was and as the background carries it, and the cameras then."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Bool, Float

from bayes_body.recording.evidence.silhouette_edges import Packed

# The order of a camera's three pictures.
NOW, BEFORE, BACKGROUND = range(3)
# Grey levels per unit of a picture's value.
LEVELS = 255.0


class ImageMotion(NamedTuple):
    """The pictures of each camera, packed: this frame, the frame before, and the frame before as if everything had moved with the background.

    `rotation` and `translation` are the cameras' extrinsics in the frame before. `places` are the points of every part that are compared, t from 0
    to 1 along its axis and s from -1 to 1 across it. `has_both_frames` says which cameras saw both frames; in the first frame it is false for all.
    """

    pictures: Packed
    rotation: Float[Array | np.ndarray, "camera 3 3"]
    translation: Float[Array | np.ndarray, "camera 3"]
    places: Float[Array | np.ndarray, "sample 2"]
    has_both_frames: Bool[Array | np.ndarray, " camera"]


def stratified(count_t: int, count_s: int) -> Float[np.ndarray, "sample 2"]:
    """Return places at the middles of the cells of a grid."""
    t, s = np.meshgrid((np.arange(count_t) + 0.5) / count_t, (2 * np.arange(count_s) + 1) / count_s - 1, indexing="ij")
    return np.stack([t.ravel(), s.ravel()], axis=1)


def random_places(count_t: int, count_s: int, seed: int) -> Float[np.ndarray, "sample 2"]:
    """Return as many uniform places."""
    return np.random.default_rng(seed).uniform((0.0, -1.0), (1.0, 1.0), (count_t * count_s, 2))
