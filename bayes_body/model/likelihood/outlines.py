r"""How far image points are inside a body's projection, and the fraction of an image that the body covers.

The signed distance is in pixels, positive inside, and has a gradient by the pose. The outline of a cylinder is a quadrilateral, $d_p(x) = \min_i\,
n_i \cdot (x - x_i)$ over its sides. The outline of a sphere is an ellipse, $d_p(x) = \frac{r}{2} (1 - |M^{-1}(x - x_0)|^2)$ with its half-axes in M
and $r = \sqrt{|\det M|}$, which has the slope of the distance on the outline. The union of parts is $d(x) = \max_p d_p(x)$. Each $d_p$ is a minimum
of forms $f \cdot (1, u, v, u^2, uv, v^2)$, so one form determines d at a point. The gradient by a form's coefficients is a sum over its points; the
code below computes this sum (reverse mode only).

The covered fraction is that of the points of a coarse grid which lie in the projection of any part. The membership of a grid point in a part's
quadrilateral is soft over one step of the grid: $\prod$ of sigmoids of the distances to its four sides. Therefore the area has a gradient. The union
over parts is $1 - \prod_p (1 - m_p)$.
"""

import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bayes_body.base.geometry.camera import Camera, Pixels
from bayes_body.base.shapes import Configuration
from bayes_body.density.sharding import varying_like
from bayes_body.model.body.solids import Body, PartTopology, Samples
from bayes_body.model.likelihood.patch_pixels import corner_pixels, rig_patches, rig_pixels

# The distance, in pixels, to a part that is not completely in front of the camera.
FAR_PX = 1e6

# Parts are last, so that operations on all of them are one loop over contiguous numbers. Three coefficients (1, u, v) if no part is a sphere.
type Forms = Float[Array, "coefficient 4 part"]
type Parts = Float[Array, " part"]
type Line = Float[Array, " point"]
type Grid = Float[Array, "row column"]
# The distance inside, and the index of the form that determines it.
type Reached = tuple[Array, Array]


def outline_forms(body: Body, rig: Camera, configuration: Configuration) -> Float[Array, "camera coefficient 4 part"]:
    """The forms of every part's outline in each camera: four for a cylinder, one (repeated) for a sphere. Relative to the image's centre, pixels."""
    return forms_of(body.topology, rig, rig_patches(body, rig, configuration))


def forms_of(topology: PartTopology, rig: Camera, in_camera: Float[Array, "camera 4 part 3"]) -> Float[Array, "camera coefficient 4 part"]:
    """The same, from the parts' patches in each camera's frame."""
    is_sphere = np.array(topology.is_sphere)
    # For a cylinder, the corners of its patch in order; for a sphere, its centre and the ends of two radii.
    t = np.where(is_sphere, [[0.5], [1.0], [0.5], [0.5]], [[0.0], [1.0], [1.0], [0.0]])
    s = np.where(is_sphere, [[0.0], [0.0], [1.0], [1.0]], [[-1.0], [-1.0], [1.0], [1.0]])
    points = corner_pixels(rig, in_camera, t.astype(in_camera.dtype), s.astype(in_camera.dtype))
    centred = points._replace(u=points.u - rig.size[:, 0, None, None] / 2, v=points.v - rig.size[:, 1, None, None] / 2)
    return jax.vmap(lambda corners: _forms(corners, is_sphere))(centred)


def _forms(points: Pixels[Float[Array, "4 part"]], is_sphere: np.ndarray) -> Forms:
    u, v = list(points.u), list(points.v)
    forms = _sides(u, v)
    if is_sphere.any():
        forms = jnp.where(is_sphere, _ellipses(u, v), jnp.concatenate([forms, jnp.zeros_like(forms)]))
    nowhere = jnp.zeros_like(forms).at[0].set(-FAR_PX)
    return jnp.where(jnp.all(points.visible, axis=0), forms, nowhere)


def _sides(u: list[Parts], v: list[Parts]) -> Forms:
    following = (1, 2, 3, 0)
    area = sum((u[k] * v[n] - u[n] * v[k] for k, n in enumerate(following)), jnp.zeros_like(u[0]))
    rows = []
    for k, n in enumerate(following):
        along_u, along_v = u[n] - u[k], v[n] - v[k]
        # The orientation of the corners. A side of length zero (a cone's tip) must have a finite gradient.
        scale = jnp.where(area < 0, -1.0, 1.0) * jax.lax.rsqrt(along_u**2 + along_v**2 + 1e-6)
        nu, nv = -along_v * scale, along_u * scale
        rows.append((-(nu * u[k] + nv * v[k]), nu, nv))
    return jnp.stack([jnp.stack(coefficients) for coefficients in zip(*rows, strict=True)])


def _ellipses(u: list[Parts], v: list[Parts]) -> Forms:
    (u0, au, bu), (v0, av, bv) = ((x[0], x[1] - x[0], x[2] - x[0]) for x in (u, v))
    # |M^-1 (x - x0)|^2 = (x - x0)' A (x - x0), A = (M M')^-1.
    square = jnp.maximum((au * bv - av * bu) ** 2, 1e-6)
    uu, uv, vv = (av * av + bv * bv) / square, -(au * av + bu * bv) / square, (au * au + bu * bu) / square
    half = 0.5 * square**0.25
    constant = 1 - (uu * u0 * u0 + 2 * uv * u0 * v0 + vv * v0 * v0)
    form = half * jnp.stack([constant, 2 * (uu * u0 + uv * v0), 2 * (uv * u0 + vv * v0), -uu, -2 * uv, -vv])
    return jnp.broadcast_to(form[:, None], (6, 4, half.shape[0]))


def signed_distance(topology: PartTopology, forms: Forms, u: Float[Array, " column"], v: Float[Array, " row"]) -> Grid:
    """d of one camera at the columns u and rows v, relative to the image's centre, pixels."""
    return _distance(topology.is_sphere, forms, u[None, :], v[:, None])


def point_distance(topology: PartTopology, forms: Forms, u: Line, v: Line) -> Line:
    """d of one camera at single points, relative to the image's centre, pixels."""
    return _distance(topology.is_sphere, forms, u, v)


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def _distance(is_sphere: tuple[bool, ...], forms: Forms, columns: Array, rows: Array) -> Array:
    return _search(is_sphere, forms, columns, rows)[0]


def _search(is_sphere: tuple[bool, ...], forms: Forms, columns: Array, rows: Array) -> Reached:
    """The distance at columns and rows (broadcast), and the index of the form that determines it."""
    cylinders, parts = np.flatnonzero(~np.array(is_sphere)), len(is_sphere)

    def farthest(reached: Reached, part: tuple[Array, Array]) -> tuple[Reached, None]:
        (best, form_index), (number, sides) = reached, part
        inside, side = jnp.full_like(best, jnp.inf), jnp.zeros_like(form_index)
        for k in range(4):
            distance = sides[0, k] + sides[1, k] * columns + sides[2, k] * rows
            side = jnp.where(distance < inside, k, side)
            inside = jnp.minimum(inside, distance)
        return (jnp.maximum(best, inside), jnp.where(inside > best, parts * side + number, form_index)), None

    # A loop, because compiling unrolled code takes ten times as long.
    shape = jnp.broadcast_shapes(columns.shape, rows.shape)
    start = varying_like((jnp.full(shape, -jnp.inf, forms.dtype), jnp.zeros(shape, jnp.int32)), forms)
    (best, form_index), _ = jax.lax.scan(farthest, start, (jnp.asarray(cylinders, jnp.int32), jnp.moveaxis(forms[:3, :, cylinders], 2, 0)))
    for part in np.flatnonzero(is_sphere):
        f = forms[:, 0, part]
        inside = f[0] + f[1] * columns + f[2] * rows + f[3] * columns**2 + f[4] * columns * rows + f[5] * rows**2
        form_index = jnp.where(inside > best, int(part), form_index)
        best = jnp.maximum(best, inside)
    return best, form_index


def _forward(is_sphere: tuple[bool, ...], forms: Forms, columns: Array, rows: Array) -> tuple[Array, tuple[Array, ...]]:
    best, form_index = _search(is_sphere, forms, columns, rows)
    return best, (form_index, forms, columns, rows)


def _backward(is_sphere: tuple[bool, ...], saved: tuple[Array, ...], cotangent: Array) -> tuple[Forms, Array, Array]:
    form_index, forms, u, v = saved
    columns, rows = jnp.broadcast_arrays(u, v)
    basis = [jnp.ones_like(columns), columns, rows]
    basis += [columns * columns, columns * rows, rows * rows] if any(is_sphere) else []
    # A scatter: summing form by form, each over all points, is a fifth slower even with fifty points.
    sums = jnp.stack([jax.ops.segment_sum((cotangent * monomial).ravel(), form_index.ravel(), 4 * len(is_sphere)) for monomial in basis])
    # The grid's position is not inferred.
    return sums.reshape(forms.shape), jnp.zeros_like(u), jnp.zeros_like(v)


_distance.defvjp(_forward, _backward)


def projected_area(
    body: Body,
    rig: Camera,
    configuration: Configuration,
    grid: tuple[int, int],
    uncovered: Float[Array | np.ndarray, "camera row column"] | None = None,
) -> Float[Array, " camera"]:
    """Return the covered fraction of each camera's image, in [0, 1]. A part with a corner that is not visible covers nothing.

    Args:
        body: the body.
        rig: cameras.
        configuration: what places the body.
        grid: columns and rows of the grid over each image.
        uncovered: the fraction of each cell that counts; all of it by default.
    """
    # Corners of each part's patch. A disc's square is shrunk to the disc's area.
    shrink = np.where(np.array(body.topology.is_sphere), math.sqrt(math.pi) / 2, 1.0)[:, None]
    t = 0.5 + shrink * np.array([[-0.5, 0.5, 0.5, -0.5]])
    s = shrink * np.array([[-1.0, -1.0, 1.0, 1.0]])
    corners = rig_pixels(body, rig, Samples(jnp.asarray(t, configuration.dtype), jnp.asarray(s, configuration.dtype)), configuration)
    if uncovered is None:
        return jax.vmap(lambda c, size: jnp.mean(_covered(c, size, *grid)))(corners, rig.size)
    counted = jnp.asarray(uncovered, corners.u.dtype)
    areas = jax.vmap(lambda c, size, cells: jnp.sum(cells * _covered(c, size, *grid)))(corners, rig.size, counted)
    return areas / jnp.maximum(jnp.sum(counted, axis=(1, 2)), 1e-3)


def _covered(corners: Pixels[Float[Array, "part 4"]], size: Float[Array, "2"], columns: int, rows: int) -> Float[Array, "row column"]:
    """The fraction of each cell that the parts cover."""
    u = (jnp.arange(columns) + 0.5) / columns * size[0] - 0.5
    v = (jnp.arange(rows) + 0.5) / rows * size[1] - 0.5
    steepness = 4 * columns / size[0]

    def uncover(uncovered: Grid, part: tuple[Array, ...]) -> tuple[Grid, None]:
        corner_u, corner_v, side, visible = part
        inside = visible * jnp.ones_like(uncovered)
        for i in range(4):
            j = (i + 1) % 4
            along_u, along_v = corner_u[j] - corner_u[i], corner_v[j] - corner_v[i]
            scale = side * steepness * jax.lax.rsqrt(along_u**2 + along_v**2 + 1e-6)
            distance = scale * along_u * (v[:, None] - corner_v[i]) - scale * along_v * (u - corner_u[i])
            inside = inside * jax.nn.sigmoid(distance)
        return uncovered * (1 - inside), None

    # A loop: XLA's CPU backend makes one vectorised pass over the cells of each part. Of arrays (part, row, column) it took 19 times as long.
    parts = corners.u, corners.v, jnp.sign(_signed_area(corners)), jnp.all(corners.visible, axis=1).astype(corners.u.dtype)
    start = varying_like(jnp.ones((rows, columns), corners.u.dtype), corners.u)
    return 1 - jax.lax.scan(uncover, start, parts)[0]


def _signed_area(corners: Pixels[Float[Array, "part 4"]]) -> Float[Array, " part"]:
    return jnp.sum(corners.u * jnp.roll(corners.v, -1, axis=1) - jnp.roll(corners.u, -1, axis=1) * corners.v, axis=1)
