"""A surface as triangles, with one colour each."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int


class Mesh(NamedTuple):
    """Triangles in the world.

    Attributes:
        vertices: (vertex, 3), metres, z up.
        faces: (face, 3), indices of vertices, anticlockwise as seen from outside.
        colours: (face, 3), reflectance of blue, green, red in [0, 1].
    """

    vertices: Float[np.ndarray, "vertex 3"]
    faces: Int[np.ndarray, "face 3"]
    colours: Float[np.ndarray, "face 3"]
