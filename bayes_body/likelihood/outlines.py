r"""How far inside of a body's projection points of the image are, pixels: a signed distance, positive inside, with a gradient by the pose.

A part's outline on a cylinder is a quadrilateral, $d_p(x) = \min_i\, n_i \cdot (x - x_i)$ over its sides; of a sphere it is an ellipse,
$d_p(x) = \frac{r}{2} (1 - |M^{-1}(x - x_0)|^2)$ with its half-axes in M and $r = \sqrt{|\det M|}$, which on the outline has the distance's slope.
The union of parts is $d(x) = \max_p d_p(x)$. Each $d_p$ is a minimum of forms $f \cdot (1, u, v, u^2, uv, v^2)$: a point belongs to one form, and the
gradient by a form's coefficients is a sum over the points that belong to it, which is how it is written below (reverse mode only).
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bayes_body.body.solids import Body, PartTopology, Samples
from bayes_body.camera import Camera, Pixels
from bayes_body.likelihood.patch_pixels import rig_pixels
from bayes_body.shapes import Pose

# In place of the distance to a part that is not wholly before the camera, pixels.
FAR_PX = 1e6

type Forms = Float[Array, "part 4 6"]
type Line = Float[Array, " point"]
type Grid = Float[Array, "row column"]
# How far inside, and the number of the form that says so.
type Reached = tuple[Array, Array]


def corner_samples(body: Body) -> Samples:
    """Four points a part that determine its outline: corners of a cylinder's patch, in order; of a sphere the centre, and the ends of two radii."""
    spheres = np.array(body.topology.is_sphere)[:, None]
    t = np.where(spheres, [0.5, 1.0, 0.5, 0.5], [0.0, 1.0, 1.0, 0.0])
    s = np.where(spheres, [0.0, 0.0, 1.0, 1.0], [-1.0, -1.0, 1.0, 1.0])
    return Samples(jnp.asarray(t, body.lengths.dtype), jnp.asarray(s, body.lengths.dtype))


def outline_forms(body: Body, rig: Camera, pose: Pose) -> Float[Array, "camera part 4 6"]:
    """The forms of every part's outline in each camera: four of a cylinder, the first alone of a sphere. From the image's middle on, pixels."""
    return forms_of(body.topology, rig, rig_pixels(body, rig, corner_samples(body), pose))


def forms_of(topology: PartTopology, rig: Camera, corners: Pixels[Float[Array, "camera part 4"]]) -> Float[Array, "camera part 4 6"]:
    """The same, of the pixels of `corner_samples`."""
    centred = corners._replace(u=corners.u - rig.size[:, 0, None, None] / 2, v=corners.v - rig.size[:, 1, None, None] / 2)
    return jax.vmap(lambda each: _forms(each, np.array(topology.is_sphere)))(centred)


def _forms(points: Pixels[Float[Array, "part 4"]], is_sphere: np.ndarray) -> Forms:
    forms = _sides(points)
    if is_sphere.any():
        forms = jnp.where(is_sphere[:, None, None], _ellipses(points), forms)
    nowhere = jnp.array([-FAR_PX, 0, 0, 0, 0, 0], forms.dtype)
    return jnp.where(jnp.all(points.visible, axis=1)[:, None, None], forms, nowhere)


def _sides(corners: Pixels[Float[Array, "part 4"]]) -> Forms:
    u, v = corners.u, corners.v
    along_u, along_v = jnp.roll(u, -1, axis=1) - u, jnp.roll(v, -1, axis=1) - v
    area = jnp.sum(u * jnp.roll(v, -1, axis=1) - jnp.roll(u, -1, axis=1) * v, axis=1, keepdims=True)
    # Which way round the corners go; a side without a length (a cone's tip) keeps a finite gradient.
    scale = jnp.where(area < 0, -1.0, 1.0) * jax.lax.rsqrt(along_u**2 + along_v**2 + 1e-6)
    nu, nv = -along_v * scale, along_u * scale
    zero = jnp.zeros_like(u)
    return jnp.stack([-(nu * u + nv * v), nu, nv, zero, zero, zero], axis=-1)


def _ellipses(points: Pixels[Float[Array, "part 4"]]) -> Forms:
    u, v = points.u[:, 0], points.v[:, 0]
    (au, av), (bu, bv) = ((points.u[:, k] - u, points.v[:, k] - v) for k in (1, 2))
    # |M^-1 (x - x0)|^2 = (x - x0)' A (x - x0), A = (M M')^-1.
    square = jnp.maximum((au * bv - av * bu) ** 2, 1e-6)
    uu, uv, vv = (av * av + bv * bv) / square, -(au * av + bu * bv) / square, (au * au + bu * bu) / square
    half = 0.5 * square**0.25
    constant = 1 - (uu * u * u + 2 * uv * u * v + vv * v * v)
    form = half[:, None] * jnp.stack([constant, 2 * (uu * u + uv * v), 2 * (uv * u + vv * v), -uu, -2 * uv, -vv], axis=-1)
    return jnp.broadcast_to(form[:, None], (*form.shape[:1], 4, 6))


def signed_distance(topology: PartTopology, forms: Forms, u: Float[Array, " column"], v: Float[Array, " row"]) -> Grid:
    """d of one camera at the columns u and rows v, from the image's middle on, pixels."""
    return _distance(topology.is_sphere, forms, u[None, :], v[:, None])


def point_distance(topology: PartTopology, forms: Forms, u: Line, v: Line) -> Line:
    """d of one camera at single points, from the image's middle on, pixels."""
    return _distance(topology.is_sphere, forms, u, v)


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def _distance(is_sphere: tuple[bool, ...], forms: Forms, columns: Array, rows: Array) -> Array:
    return _search(is_sphere, forms, columns, rows)[0]


def _search(is_sphere: tuple[bool, ...], forms: Forms, columns: Array, rows: Array) -> Reached:
    """The distance at columns and rows broadcast against each other, and the number of the form that it is the value of."""
    cylinders = np.flatnonzero(~np.array(is_sphere))

    def farthest(reached: Reached, part: tuple[Array, Array]) -> tuple[Reached, None]:
        (best, which), (number, sides) = reached, part
        inside, side = jnp.full_like(best, jnp.inf), jnp.zeros_like(which)
        for k in range(4):
            other = sides[k, 0] + sides[k, 1] * columns + sides[k, 2] * rows
            side = jnp.where(other < inside, k, side)
            inside = jnp.minimum(inside, other)
        return (jnp.maximum(best, inside), jnp.where(inside > best, 4 * number + side, which)), None

    # A loop hands on what differs from device to device where the forms do: so must what it starts from.
    nothing = jnp.broadcast_to(0 * forms[0, 0, 0], jnp.broadcast_shapes(columns.shape, rows.shape))
    # A loop: written out part by part the compiler works on it ten times as long.
    start = nothing - jnp.inf, nothing.astype(jnp.int32)
    (best, which), _ = jax.lax.scan(farthest, start, (jnp.asarray(cylinders, jnp.int32), forms[cylinders]))
    for part in np.flatnonzero(is_sphere):
        f = forms[part, 0]
        inside = f[0] + f[1] * columns + f[2] * rows + f[3] * columns**2 + f[4] * columns * rows + f[5] * rows**2
        which = jnp.where(inside > best, 4 * int(part), which)
        best = jnp.maximum(best, inside)
    return best, which


def _forward(is_sphere: tuple[bool, ...], forms: Forms, columns: Array, rows: Array) -> tuple[Array, tuple[Array, ...]]:
    best, which = _search(is_sphere, forms, columns, rows)
    return best, (which, forms, columns, rows)


def _backward(is_sphere: tuple[bool, ...], saved: tuple[Array, ...], cotangent: Array) -> tuple[Forms, Array, Array]:
    which, forms, u, v = saved
    columns, rows = jnp.broadcast_arrays(u, v)
    basis = [jnp.ones_like(columns), columns, rows]
    basis += [columns * columns, columns * rows, rows * rows] if any(is_sphere) else []
    sums = jax.ops.segment_sum(jnp.stack([cotangent * each for each in basis], axis=-1).reshape(-1, len(basis)), which.ravel(), 4 * len(is_sphere))
    back = jnp.zeros((4 * len(is_sphere), 6), forms.dtype).at[:, : len(basis)].set(sums)
    # Where the grid stands is not inferred.
    return back.reshape(forms.shape), jnp.zeros_like(u), jnp.zeros_like(v)


_distance.defvjp(_forward, _backward)
