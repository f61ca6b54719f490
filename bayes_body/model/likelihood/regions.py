r"""Foreground and edges in the regions of one part, for loose-limbed bodies (Sigal et al. 2011, (8) to (10)). For a part at $X_i$, over all cameras:

$$\log \phi = \rho \sum_c \Big[ (1 - w) \Big( \sum_{x \in \Omega_1} \log \frac{p_1(S_x)}{p_3(S_x)}
  + \sum_{x \in \Omega_2} \log \frac{p_2(S_x)}{p_3(S_x)} \Big) + w \sum_{x \in \Gamma} (E_0^2 - E_x^2) \Big],$$

with the pixels $\Omega_1$ inside the part's projection, $\Omega_2$ of a band beside it, $\Gamma$ of its two long sides, the silhouette S, and the
distance E to the nearest edge. The product of (8) over the rest of the image is divided out. The sums over pixels are sums over fixed points, each of
which stands for a number of pixels; recording/observation/regions.py has the log-ratios. A part contributes 0 in a camera where it is outside the
image or not entirely in front of the lens. This is not a reward: a part on pixels about which nothing is known also contributes 0.

The factor is a plate over the parts: message passing reads it part by part, other kernels read the sum. A pixel that several parts cover is counted
for each of them, and neighbouring pixels are not independent, so the sum is too confident. $\rho$ = `precision` corrects this. Its value is for
images of 640 x 480 pixels. A larger image of the same scene tells little more: areas count as shares of the image, and lengths as the square roots of
these shares. The factor is not a distribution over images.

The fixed points of a part's projection are inside the part, in a band beside it, and on its two long sides. The ends of a solid's axis and its
half-widths there are projected, as by Sigal et al. (2011, 5.1). With the middle c and the half-width h of both ends in the image, a point at $t \in
[0, 1]$ along and s across it is

$$x(t, s) = c_0 + t\,\Delta c + s\,(h_0 + t\,\Delta h),$$

inside for $|s| \le 1$, in the band for $1 + 2a < |s| \le 1 + 2b$, from a to b outside in shares of the part's width. A point stands for the pixels
$|(\Delta c + s\,\Delta h) \times (h_0 + t\,\Delta h)|\,dt\,ds$ of its cell, or for $|\Delta c + s\,\Delta h|\,dt$ of its side. A sphere is a disc:
its half-width at t is the chord. The points of a part with several solids, such as a calf with its foot, are divided among them by their lengths.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from bayes_body.base.errors import input_error
from bayes_body.base.geometry import rigid, transforms
from bayes_body.base.geometry.camera import Camera, Pixels
from bayes_body.base.geometry.namespaces import device_array
from bayes_body.base.geometry.transforms import Transform
from bayes_body.base.registry import register
from bayes_body.base.shapes import Scalar
from bayes_body.base.toml.schema import Count, NonNegative, Positive, Schema, Share
from bayes_body.density.factor import Factor
from bayes_body.density.plate import Plate, plate_factor
from bayes_body.model.body.placed_body import require, solids_in_parts
from bayes_body.model.body.placement import LENGTHS, PARTS, WIDTHS, ByParts
from bayes_body.model.body.solids import Body, Shapes
from bayes_body.model.likelihood.patch_pixels import corner_pixels, solid_patches
from bayes_body.recording.evidence.regions import BAND, EDGES, INSIDE, RegionMaps, log_ratios_at
from bayes_body.recording.evidence.silhouette_edges import Lookup

# The corners of a solid's projection, in order.
CORNERS_T, CORNERS_S = np.array([[0.0], [1.0], [1.0], [0.0]]), np.array([[-1.0], [-1.0], [1.0], [1.0]])


class PartSamples(NamedTuple):
    """The points of every part; of one part without the first axis.

    Attributes:
        T_part_solid: the solids that the part holds, in its frame. Parts with fewer than others repeat their first one.
        shapes: what cameras see of them.
        t: place of each point along its solid.
        s: place across it.
        cell: dt ds of a point's cell, or dt of a point of a side.
        solid: the solid of each point.
    """

    T_part_solid: Transform
    shapes: Shapes
    t: Float[Array, "*part sample"]
    s: Float[Array, "*part sample"]
    cell: Float[Array, "*part sample"]
    solid: Int[Array, "*part sample"]


def part_samples(name: str, body: Body, samples: tuple[int, int, int], band: tuple[float, float]) -> tuple[PartSamples, Int[np.ndarray, " sample"]]:
    """Return the points of every part of a loose-limbed body, and which of a camera's maps each reads, the same for all parts.

    Args:
        name: the name of the term, for messages.
        body: the body.
        samples: points along a part, across it, and across the band at either side; also along each of its sides there are as many as along the part.
        band: where the band begins and ends, beside a side, as shares of the part's width.

    Raises:
        InputError: the band ends before it begins, or a part has more solids than points along it.
    """
    placement = body.placement
    assert isinstance(placement, ByParts)
    if band[0] >= band[1]:
        raise input_error(f"{name}: band", f"from {band[0]:g} to {band[1]:g} of a part's width", "a band that ends after it begins", "swap them")
    holders = np.array([placement.owners[joint] for joint in body.topology.joints])
    solids_by_part = [np.flatnonzero(holders == part) for part in range(len(placement.names))]
    (lines, columns, deep), (lengths, most) = samples, (np.asarray(body.lengths, float), max(len(solids) for solids in solids_by_part))
    if lines < most:
        remedy = f"give at least {most} points along a part"
        raise input_error(f"{name}: samples", f"{lines} points along a part with {most} solids", "at least one for each solid", remedy)
    rows = [_of_part(solids, _divided(lines, lengths[solids]), body.topology.is_sphere, (columns, deep), band) for solids in solids_by_part]
    t, s, cell, solid = (np.stack(arrays) for arrays in zip(*rows, strict=True))
    chosen = np.stack([np.concatenate([solids, np.repeat(solids[:1], most - len(solids))]) for solids in solids_by_part])
    dtype = body.lengths.dtype
    points = PartSamples(
        T_part_solid=_rows(solids_in_parts(body), chosen),
        shapes=_rows(body.shapes, chosen),
        t=device_array(t, dtype),
        s=device_array(s, dtype),
        cell=device_array(cell, dtype),
        solid=device_array(solid, jnp.int32),
    )
    return points, np.repeat([INSIDE, BAND, EDGES], [lines * columns, 2 * lines * deep, 2 * lines])


def _rows[Tree](tree: Tree, chosen: Int[np.ndarray, "part solid"]) -> Tree:
    """Return rows of all arrays, taken on the host: on the device each would be a program of its own."""
    return jax.tree.map(lambda leaf: device_array(np.asarray(leaf)[chosen], leaf.dtype), tree)


def _divided(count: int, lengths: Float[np.ndarray, " solid"]) -> Int[np.ndarray, " solid"]:
    """Return `count` points divided among solids by their lengths, at least one each: each next point where it is missed most."""
    counts = np.ones(len(lengths), int)
    while counts.sum() < count:
        counts[np.argmax(lengths / counts)] += 1
    return counts


def _of_part(
    solids: Int[np.ndarray, " solid"],
    counts: Int[np.ndarray, " solid"],
    is_sphere: tuple[bool, ...],
    counts_across: tuple[int, int],
    band: tuple[float, float],
) -> tuple[np.ndarray, ...]:
    """Return t, s, cell and solid of a part's points."""
    step = np.repeat(1 / counts, counts)
    t = np.concatenate([(np.arange(count) + 0.5) / count for count in counts])
    slot = np.repeat(np.arange(len(solids)), counts)
    sphere = np.array(is_sphere)[solids][slot]
    chord = np.where(sphere, 2 * np.sqrt(t * (1 - t)), 1.0)
    sides, (columns, deep), wide = np.array([-1.0, 1.0]), counts_across, band[1] - band[0]
    inside = chord[:, None] * ((2 * np.arange(columns) + 1) / columns - 1)
    beside = (chord[:, None, None] + 2 * (band[0] + wide * (np.arange(deep)[:, None] + 0.5) / deep)) * sides
    on_sides = chord[:, None] * sides
    cell_inside = np.broadcast_to((step * chord)[:, None] * 2 / columns, inside.shape)
    # A circle's arc over dt of the diameter is longer than dt by one over the chord.
    cells = cell_inside, np.tile((step * 2 * wide / deep)[:, None], 2 * deep), np.tile((step / chord)[:, None], 2)

    def flat(arrays: tuple[np.ndarray, ...]) -> np.ndarray:
        return np.concatenate([array.ravel() for array in arrays])

    lengthwise = tuple(np.broadcast_to(t[:, None], cell.shape) for cell in cells)
    slots = tuple(np.broadcast_to(slot[:, None], cell.shape) for cell in cells)
    return flat(lengthwise), flat((inside, beside, on_sides)), flat(cells), flat(slots)


def projected(part: PartSamples, rig: Camera, frame: Float[Array, "7"], map_index: Int[Array, " sample"]) -> tuple[Pixels[Array], Array]:
    """Return the points of one part placed at `frame`, (camera, sample), and the number of pixels of each: 0 if its solid is not entirely visible."""
    slots = part.T_part_solid.origin.shape[0]
    T_world_part = rigid.to_transform(jnp.broadcast_to(frame, (slots, 7)))
    in_camera = solid_patches(part.shapes, rig, transforms.compose(T_world_part, part.T_part_solid))
    corners = corner_pixels(
        rig, in_camera, *(np.repeat(coordinates, slots, axis=1).astype(in_camera.dtype) for coordinates in (CORNERS_T, CORNERS_S))
    )
    is_visible = jnp.all(corners.visible, axis=1)
    u, v = (_quadrilateral(part, jnp.where(is_visible[:, None], coordinates, 0.0)) for coordinates in (corners.u, corners.v))
    # sqrt of a clamped square: a side seen end-on is a point, and must have a finite gradient.
    length = jnp.sqrt(jnp.maximum(u.by_t**2 + v.by_t**2, 1e-6))
    area = jnp.abs(u.by_t * v.by_s - v.by_t * u.by_s)
    visible = _of_solids(part, is_visible)
    pixels = jnp.where(visible, part.cell * jnp.where(map_index == EDGES, length, area), 0.0)
    return Pixels(u.place, v.place, visible), pixels


class _Coordinate(NamedTuple):
    """Columns or rows of the points, with the derivatives by t and by s: (camera, sample)."""

    place: Array
    by_t: Array
    by_s: Array


def _quadrilateral(part: PartSamples, corners: Float[Array, "camera 4 solid"]) -> _Coordinate:
    middles, halves = (corners[:, 3] + corners[:, 0], corners[:, 2] + corners[:, 1]), (corners[:, 3] - corners[:, 0], corners[:, 2] - corners[:, 1])
    c0, to_c1, h0, to_h1 = (
        _of_solids(part, 0.5 * coordinates) for coordinates in (middles[0], middles[1] - middles[0], halves[0], halves[1] - halves[0])
    )
    by_s = h0 + part.t * to_h1
    return _Coordinate(c0 + part.t * to_c1 + part.s * by_s, to_c1 + part.s * to_h1, by_s)


def _of_solids(part: PartSamples, values: Array) -> Array:
    """The values (camera, solid) at each point's solid: (camera, sample)."""
    point_values = values[:, :1]
    # Not a gather, which XLA does not vectorise.
    for slot in range(1, values.shape[1]):
        point_values = jnp.where(part.solid == slot, values[:, slot, None], point_values)
    return point_values


# Pixels of an image for which `precision` holds.
IMAGE_PX = 640 * 480


class Options(Schema):
    """Options of `[[likelihood]] kind = "regions"`."""

    # From `learn likelihood-scale` on two simulated walks in four views (train_05 and train_08 of recording/observation/regions.py), 6 frames of
    # each, 200 particles, the joints of loose_limbed_10: 90 % intervals contain 91, 92, 87 and 79 % of the true coordinates at 0.001, 0.002, 0.003
    # and 0.01.
    precision: Positive = 0.0024
    """ρ, the power of the likelihood. It is a sum over pixels, which are not independent. It holds for images of 640 × 480 pixels; pixels of larger
    images count less, in proportion to the area."""
    edge_share: Share = 0.1
    """w, the share of the edges, between 0 and 1."""
    band: tuple[NonNegative, Positive] = (0.1, 0.5)
    """where the band beside a part begins and ends, as shares of the part's width."""
    samples: tuple[Count, Count, Count] = (8, 3, 1)
    """[samples] per part and camera: along the part and along each side, across the part, across the band on each side."""
    lookup: Lookup = "bilinear"
    """how maps are interpolated: `"bilinear"`, which has gradients, or `"nearest"`, which has none."""


@partial(jax.tree_util.register_dataclass, meta_fields=["lookup"], data_fields=["rig", "map_index", "weights"])
@dataclass(frozen=True)
class Regions:
    """The log-potential of one part as a pytree.

    Attributes:
        lookup: nearest or bilinear.
        rig: the cameras.
        map_index: for each point, the map that it reads.
        weights: for each point of each camera, ρ times the share of its region, times what a pixel of this camera counts.
    """

    lookup: Lookup
    rig: Camera
    map_index: Int[Array, " sample"]
    weights: Float[Array, "camera sample"]

    def __call__(self, part: PartSamples, frame: Float[Array, "7"], *, data: RegionMaps) -> Scalar:
        """Return log φ of a part at `frame`."""
        places, pixels = projected(part, self.rig, frame, self.map_index)
        total = jnp.sum(self.weights * pixels * log_ratios_at(data, self.map_index, self.lookup, self.rig, places))
        # A part that no camera sees would hide a NaN.
        return jnp.where(jnp.isfinite(jnp.sum(frame)), total, jnp.nan)


def _stretched(part: PartSamples, log_length: Scalar) -> PartSamples:
    factor = jnp.exp(log_length)
    placed = part.T_part_solid._replace(origin=factor * part.T_part_solid.origin)
    return part._replace(T_part_solid=placed, shapes=part.shapes._replace(lengths=factor * part.shapes.lengths))


def _widened(part: PartSamples, log_width: Scalar) -> PartSamples:
    return part._replace(shapes=part.shapes._replace(radii=jnp.exp(log_width) * part.shapes.radii))


@register("likelihood", "regions", Options, reads=("silhouettes",))
def build(name: str, options: Options, body: Body, rig: Camera, **_: Any) -> Factor:
    """Build the plate of a loose-limbed body.

    Raises:
        InputError: the body is placed by angles, the band ends before it begins, or a part has more solids than points along it.
    """
    require(body, PARTS, "likelihood 'regions'", "likelihood 'silhouette_edges'")
    samples, map_index = part_samples(name, body, options.samples, options.band)
    shares = IMAGE_PX / np.prod(np.asarray(rig.size, float), axis=1, keepdims=True)
    weights = options.precision * np.where(map_index == EDGES, options.edge_share * np.sqrt(shares), (1 - options.edge_share) * shares)
    potential = Regions(options.lookup, rig, device_array(map_index, jnp.int32), device_array(weights, body.lengths.dtype))
    rows = tuple((part,) for part in range(len(samples.t)))
    resize = {LENGTHS: jax.tree_util.Partial(_stretched), WIDTHS: jax.tree_util.Partial(_widened)}
    return plate_factor(name, "likelihood", Plate(PARTS, rows, potential, samples, resize=resize), has_gradient=options.lookup != "nearest")
