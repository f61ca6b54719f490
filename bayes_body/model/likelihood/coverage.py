r"""The fraction of an image that a body covers: of the points of a coarse grid, those in the projection of any part.

The membership of a grid point in a part's quadrilateral is soft over one step of the grid: $\prod$ of sigmoids of the distances to its four sides.
Therefore the area has a gradient. The union over parts is $1 - \prod_p (1 - m_p)$.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bayes_body.base.geometry.camera import Camera, Pixels
from bayes_body.base.shapes import Configuration, Scalar
from bayes_body.model.body.solids import Body, Samples
from bayes_body.model.likelihood.patch_pixels import rig_pixels


def projected_area(body: Body, rig: Camera, configuration: Configuration, grid: tuple[int, int]) -> Float[Array, " camera"]:
    """Return the covered fraction of each camera's image, in [0, 1]. A part with a corner that is not visible covers nothing.

    Args:
        body: the body.
        rig: cameras.
        configuration: what places the body.
        grid: columns and rows of the grid over each image.
    """
    # Corners of each part's patch. A disc's square is shrunk to the disc's area.
    shrink = np.where(np.array(body.topology.is_sphere), math.sqrt(math.pi) / 2, 1.0)[:, None]
    t = 0.5 + shrink * np.array([[-0.5, 0.5, 0.5, -0.5]])
    s = shrink * np.array([[-1.0, -1.0, 1.0, 1.0]])
    corners = rig_pixels(body, rig, Samples(jnp.asarray(t, configuration.dtype), jnp.asarray(s, configuration.dtype)), configuration)
    return jax.vmap(lambda c, size: _covered(c, size, *grid))(corners, rig.size)


def _covered(corners: Pixels[Float[Array, "part 4"]], size: Float[Array, "2"], columns: int, rows: int) -> Scalar:
    u = (jnp.arange(columns) + 0.5) / columns * size[0] - 0.5
    v = (jnp.arange(rows) + 0.5) / rows * size[1] - 0.5
    softness = size[0] / columns
    inside = jnp.ones((corners.u.shape[0], rows, columns), corners.u.dtype)
    signed_area = _signed_area(corners)
    for i in range(4):
        j = (i + 1) % 4
        along_u, along_v = corners.u[:, j] - corners.u[:, i], corners.v[:, j] - corners.v[:, i]
        length = jnp.sqrt(along_u**2 + along_v**2 + 1e-6)
        du, dv = u - corners.u[:, i, None, None], v[:, None] - corners.v[:, i, None, None]
        distance = (along_u[:, None, None] * dv - along_v[:, None, None] * du) / length[:, None, None]
        inside *= jax.nn.sigmoid(4 * jnp.sign(signed_area)[:, None, None] * distance / softness)
    inside *= jnp.all(corners.visible, axis=1)[:, None, None]
    return jnp.mean(1 - jnp.prod(1 - inside, axis=0))


def _signed_area(corners: Pixels[Float[Array, "part 4"]]) -> Float[Array, " part"]:
    return jnp.sum(corners.u * jnp.roll(corners.v, -1, axis=1) - jnp.roll(corners.u, -1, axis=1) * corners.v, axis=1)
