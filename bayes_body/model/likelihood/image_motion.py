r"""Image motion: the body carries the picture of the frame before to this frame (Sidenbladh, Black & Fleet 2000, (3), (10) to (12)).

A point of a part that the camera sees now was somewhere in the frame before, because the part is rigid. The grey values at both places are the same
but for noise. With $\eta$ their difference, $\epsilon$ = `outlier_share`, $\sigma$ = `noise_grey` and q the visibility of the point, the
log-likelihood is

$$\rho \sum_{\text{cameras}} \sum_{\text{points}} \log \Big[ q \Big( (1 - \epsilon)\, \mathcal N\big(\eta; 0, (\sigma / \cos\alpha)^2\big)
  + \frac{\epsilon}{256} \Big) + \frac{1 - q}{256} \Big] - \log b.$$

- Points: `plane` takes the patch through the axis that faces the camera, as the paper does; $\alpha$ is the angle between the axis and the image
  plane. `cylinder` takes the surface itself; $\alpha$ is the angle between its normal and the view.
- $q = \cos\alpha$. It is 0 for a point that a nearer part covers, and for one that is outside a picture in either frame: what is not seen counts as
  much as any grey value, so nothing is gained by hiding.
- b says how well the background explains the same pixel. It is what the first logarithm is of, with the difference from the frame before as the
  background carries it, and $\sigma$ instead of $\sigma / \cos\alpha$. With it, the whole picture has a density, and the pixels beside the body are
  a constant factor. A limb that is put on a wall gains nothing from the wall, although the wall stands as still as a limb can. The ratio is that of
  Sidenbladh & Black 2001 (Learning image statistics for Bayesian tracking). `background = false` sets b = 1, as in the paper of 2000.
- `mixture = "limb"` is the paper's (10) to (12) as printed: one mixture for all points of a part, with the mean of their visibilities.

The factor reads the configuration of the frame before (offset -1): each particle is compared with its own past. Where no camera saw the frame before
it is 0. Points are not pixels, and neighbours are not independent; $\rho$ = `precision` corrects that.
"""

from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from pydantic import Field

from bayes_body.base.geometry.camera import Camera, Pixels
from bayes_body.base.registry import register
from bayes_body.base.shapes import Configuration, Scalar
from bayes_body.base.toml.schema import Positive, Schema
from bayes_body.density.factor import Factor, Variable, Variables
from bayes_body.model.body.solids import Body, part_transforms
from bayes_body.model.likelihood.surface_points import carried_points
from bayes_body.recording.evidence.image_motion import BACKGROUND, BEFORE, LEVELS, NOW, ImageMotion
from bayes_body.recording.evidence.silhouette_edges import look_up

type Mapping = Literal["plane", "cylinder"]
type Mixing = Literal["pixel", "limb"]
type Unlikely = Annotated[float, Field(strict=True, gt=0, lt=1)]

# The density of a grey value about which nothing is known.
UNIFORM = 1 / 256


class Compared(NamedTuple):
    """What is compared at each point.

    `difference` is that of its grey values in both frames (levels), `background_difference` that of its pixel's grey value and the background's
    before, `cosine` that of its angle, and `visibility` is q.
    """

    difference: Float[Array, "camera part sample"]
    background_difference: Float[Array, "camera part sample"]
    cosine: Float[Array, "camera part sample"]
    visibility: Float[Array, "camera part sample"]


class Options(Schema):
    """Options of `[[likelihood]] kind = "image_motion"`."""

    noise_grey: Positive = 8.0
    """[grey levels] standard deviation of the difference of the two pictures on a surface that faces the camera."""
    outlier_share: Unlikely = 0.1
    """share of points whose grey value is arbitrary."""
    precision: Positive = 1.0
    """ρ, the power of the likelihood. It is a sum over points, which are not independent."""
    mapping: Mapping = "plane"
    """where the points of a part are: `"plane"`, on the patch through the axis that faces the camera, as in the paper; `"cylinder"`, on the
    surface."""
    mixture: Mixing = "pixel"
    """`"pixel"`: each point may be an outlier, or covered; `"limb"`: the paper's formulas as printed, with one such choice for a whole part."""
    background: bool = True
    """whether the background's motion must explain a pixel worse than the body's does; false: the body's alone, as in the paper."""


@partial(
    jax.tree_util.register_dataclass,
    meta_fields=["mapping", "mixture", "background"],
    data_fields=["body", "rig", "noise_grey", "outlier_share", "precision"],
)
@dataclass(frozen=True)
class ImageMotionPotential:
    """The log-potential as a pytree; the fields are the options, the body and the rig."""

    mapping: Mapping
    mixture: Mixing
    background: bool
    body: Body
    rig: Camera
    noise_grey: Scalar
    outlier_share: Scalar
    precision: Scalar

    def __call__(self, values: Variables, data: ImageMotion) -> Scalar:
        """Return the log-likelihood of two configurations."""
        configuration, previous = (values[Variable(self.body.variable, offset)] for offset in (0, -1))
        compared = self.compared(configuration, previous, data)
        mixed = self._by_pixel if self.mixture == "pixel" else self._by_limb
        terms = mixed(compared.difference, compared.cosine, compared.visibility)
        if self.background:
            terms = terms - mixed(compared.background_difference, jnp.ones_like(compared.cosine), compared.visibility)
        # One sum over all axes: with few optimisations, XLA's CPU backend computed a sum over parts of sums over points wrongly (jaxlib 0.12.0).
        total = self.precision * jnp.sum(jnp.where(data.has_both_frames[:, None], terms, 0.0))
        # A part that no camera sees would hide a NaN.
        return jnp.where(jnp.isfinite(jnp.sum(configuration) + jnp.sum(previous)), total, jnp.nan)

    def compared(self, configuration: Configuration, previous: Configuration, data: ImageMotion) -> Compared:
        """Return what is compared, given the configurations in this frame and in the frame before."""
        placed = part_transforms(self.body, configuration), part_transforms(self.body, previous)
        rigs = self.rig, replace(self.rig, rotation=jnp.asarray(data.rotation), translation=jnp.asarray(data.translation))
        points = carried_points(self.body, rigs, placed, jnp.asarray(data.places), self.mapping == "cylinder")
        count = points.pixels.u.shape[-1]

        def grey(number: int, pixels: Pixels[Array]) -> Array:
            return look_up(data.pictures, jnp.full(count, number, jnp.int32), "bilinear", self.rig, pixels)

        intensity = grey(NOW, points.pixels)
        in_view = self._inside(points.pixels) & self._inside(points.previous_pixels)
        background = grey(BACKGROUND, points.pixels) if self.background else intensity
        visibility = jnp.where(in_view & ~points.covered, points.cosine, 0.0)
        return Compared(LEVELS * (intensity - grey(BEFORE, points.previous_pixels)), LEVELS * (intensity - background), points.cosine, visibility)

    def _inside(self, pixels: Pixels[Array]) -> Bool[Array, "camera part sample"]:
        width, height = (self.rig.size[:, axis, None, None] for axis in (0, 1))
        return pixels.visible & (pixels.u >= 0) & (pixels.u <= width - 1) & (pixels.v >= 0) & (pixels.v <= height - 1)

    def _by_pixel(self, difference: Array, cosine: Array, q: Array) -> Float[Array, "camera part"]:
        matched = (1 - self.outlier_share) * jnp.exp(_log_normal(difference, self.noise_grey / cosine)) + self.outlier_share * UNIFORM
        return jnp.sum(jnp.log(q * matched + (1 - q) * UNIFORM), axis=-1)

    def _by_limb(self, difference: Array, cosine: Array, q: Array) -> Float[Array, "camera part"]:
        """(10) to (12) as printed: the exponential is of the sum over the limb's points, and so is the mixture."""
        sd = self.noise_grey / jnp.mean(cosine, axis=-1)
        squares = jnp.sum(jnp.square(difference), axis=-1) / (2 * sd * sd)
        image = self.outlier_share * UNIFORM + (1 - self.outlier_share) * jnp.exp(-squares) / (jnp.sqrt(2 * jnp.pi) * sd)
        visible = jnp.mean(q, axis=-1)
        return jnp.log(visible * image + (1 - visible) * UNIFORM)


def _log_normal(value: Array, sd: Array) -> Array:
    return -0.5 * jnp.square(value / sd) - jnp.log(sd) - 0.5 * np.log(2 * np.pi)


@register("likelihood", "image_motion", Options, reads=("image motion",))
def build(name: str, options: Options, body: Body, rig: Camera, **_: Any) -> Factor:
    """Build the factor for one rig and body."""
    noise, share, precision = (jnp.asarray(value, body.lengths.dtype) for value in (options.noise_grey, options.outlier_share, options.precision))
    potential = ImageMotionPotential(options.mapping, options.mixture, options.background, body, rig, noise, share, precision)
    return Factor(name=name, side="likelihood", scope=(Variable(body.variable), Variable(body.variable, -1)), log_potential=potential)
