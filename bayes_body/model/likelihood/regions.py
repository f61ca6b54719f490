r"""Foreground and edges in the regions of one part, for loose-limbed bodies (Sigal et al. 2011, (8) to (10)). For a part at $X_i$, over all cameras:

$$\log \phi = \rho \sum_c \Big[ (1 - w) \Big( \sum_{x \in \Omega_1} \log \frac{p_1(S_x)}{p_3(S_x)}
  + \sum_{x \in \Omega_2} \log \frac{p_2(S_x)}{p_3(S_x)} \Big) + w \sum_{x \in \Gamma} (E_0^2 - E_x^2) \Big],$$

with the pixels $\Omega_1$ inside the part's projection, $\Omega_2$ of a band beside it, $\Gamma$ of its two long sides, the silhouette S, and the
distance E to the nearest edge. The product of (8) over the rest of the image is divided out. The sums over pixels are sums over fixed points, each of
which stands for a number of pixels (model/likelihood/region_samples.py); recording/observation/regions.py has the log-ratios. A part counts 0 in a
camera where it is outside the image or not entirely in front of the lens. It is not rewarded for that: 0 is what a part on pixels about which nothing
is known counts.

It is a plate over the parts: message passing reads it part by part, other kernels read the sum. A pixel that several parts cover is counted for each
of them, and neighbouring pixels are not independent, so the sum is too sure. $\rho$ = `precision` corrects it. It holds for images of 640 x
480 pixels. A larger image of the same scene tells little more: areas count as shares of the image, and lengths as the square roots of these shares.
It is not a distribution over images.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from bayes_body.base.geometry.camera import Camera
from bayes_body.base.geometry.namespaces import device_array
from bayes_body.base.registry import register
from bayes_body.base.shapes import Scalar
from bayes_body.base.toml.schema import Count, NonNegative, Positive, Schema, Share
from bayes_body.density.factor import Factor
from bayes_body.density.plate import Plate, plate_factor
from bayes_body.model.body.placement import PARTS
from bayes_body.model.body.solids import Body
from bayes_body.model.body.world import require
from bayes_body.model.likelihood.region_samples import PartSamples, part_samples, projected
from bayes_body.recording.evidence.regions import EDGES, RegionMaps, log_ratios_at
from bayes_body.recording.evidence.silhouette_edges import Lookup

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
    return plate_factor(name, "likelihood", Plate(PARTS, rows, potential, samples), has_gradient=options.lookup != "nearest")
