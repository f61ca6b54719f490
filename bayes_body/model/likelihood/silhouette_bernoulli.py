r"""Whole silhouettes, as a distribution over binary images: each pixel x of a grid is foreground, independently of the others, with

$$p(z_x = 1 \mid s) = \alpha + (1 - \alpha - \mu)\, c(x; s), \qquad c(x; s) = \frac{1}{1 + e^{-d(x; s) / h}},$$

$\alpha$ = `false_alarm`, $\mu$ = `miss`, h = `soft_px`, and d the distance of the pixel's centre inside the union of the body's projected parts
(model/likelihood/outlines.py). The log-likelihood is the sum of the pixels' Bernoulli terms, normalised, over all cameras that saw the frame. A pixel
that another person covers is no datum.

The pixels of a real silhouette are not independent: a hand that the body model lacks, a shadow or a hole changes many at once. On real images the
posterior is therefore too narrow. A coarser grid counts fewer pixels.
"""

from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float
from pydantic import Field

from bayes_body.base.errors import input_error
from bayes_body.base.geometry.camera import Camera
from bayes_body.base.registry import register
from bayes_body.base.shapes import Configuration, Key, Scalar
from bayes_body.base.toml.schema import Count, Positive, Schema
from bayes_body.density.factor import Factor, Variable, Variables
from bayes_body.model.body.solids import Body
from bayes_body.model.likelihood.outlines import Forms, outline_forms, signed_distance
from bayes_body.recording.evidence.silhouettes import GRID, SilhouetteEvidence

Unlikely = Annotated[float, Field(strict=True, gt=0, lt=0.5)]


class Options(Schema):
    """Options of `[[likelihood]] kind = "silhouette_bernoulli"`."""

    grid: tuple[Count, Count] = GRID
    """[pixels] columns and rows of the grid of pixels used in each image."""
    false_alarm: Unlikely = 0.02
    """probability of foreground far outside the body."""
    miss: Unlikely = 0.05
    """probability of background deep inside it."""
    soft_px: Positive = 4.0
    """[pixels] width of the transition between the two at the outline. Kernels that need a gradient need at least about half a step of the grid."""


@partial(jax.tree_util.register_dataclass, meta_fields=["grid"], data_fields=["body", "rig", "false_alarm", "miss", "soft_px"])
@dataclass(frozen=True)
class SilhouetteBernoulli:
    """The log-potential as a pytree, and the distribution with that density.

    Attributes:
        grid: columns and rows of the grid over each image.
        body: the body.
        rig: the cameras.
        false_alarm: probability of foreground far outside the body.
        miss: probability of background deep inside it.
        soft_px: width of the transition between the two, pixels.
    """

    grid: tuple[int, int]
    body: Body
    rig: Camera
    false_alarm: Scalar
    miss: Scalar
    soft_px: Scalar

    def __call__(self, values: Variables, evidence: SilhouetteEvidence) -> Scalar:
        """log p(z | configuration), normalised.

        Raises:
            InputError: the data have another grid.
        """
        rows, columns = evidence.foreground.shape[1:]
        if (columns, rows) != self.grid:
            problem = f"silhouettes on a grid of {columns} x {rows}"
            raise input_error(
                "silhouette_bernoulli", problem, f"{self.grid[0]} x {self.grid[1]}, the likelihood's", "observe the frame with the same grid"
            )
        configuration = values[Variable(self.body.variable)]
        p = self.foreground(configuration)
        logs = jnp.log(jnp.where(evidence.foreground, p, 1 - p))
        if evidence.uncovered is not None:
            logs = jnp.where(evidence.uncovered, logs, 0.0)
        terms = jnp.sum(logs, axis=(1, 2))
        # A part that no camera sees would hide a NaN.
        return jnp.where(jnp.isfinite(jnp.sum(configuration)), jnp.sum(jnp.where(evidence.has_image, terms, 0.0)), jnp.nan)

    def foreground(self, configuration: Configuration) -> Float[Array, "camera row column"]:
        """The probability of foreground at each grid point."""
        columns, rows = self.grid

        def camera_foreground(size: Float[Array, "2"], forms: Forms) -> Float[Array, "row column"]:
            u, v = (_centres(count, size[axis]) for axis, count in ((0, columns), (1, rows)))
            return jax.nn.sigmoid(signed_distance(self.body.topology, forms, u, v) / self.soft_px)

        # `forms` is an argument of the map: as a closure it would be recomputed for every point.
        forms = jax.lax.optimization_barrier(outline_forms(self.body, self.rig, configuration))
        return self.false_alarm + (1 - self.false_alarm - self.miss) * jax.vmap(camera_foreground)(self.rig.size, forms)

    def draw(self, key: Key, configuration: Configuration) -> Bool[Array, "camera row column"]:
        """Draw silhouettes at a configuration."""
        return jax.random.bernoulli(key, self.foreground(configuration))


def _centres(count: int, extent: Scalar) -> Float[Array, " point"]:
    """The centres of the pixels that contain the grid points, relative to the image's centre, as in recording/observation/silhouette_bernoulli.py."""
    return jnp.floor((2 * jnp.arange(count) + 1) * extent / (2 * count)) - extent / 2


def simulate(potential: SilhouetteBernoulli, key: Key, values: Variables) -> SilhouetteEvidence:
    """Draw a frame's silhouettes from the likelihood at a configuration; every camera sees it."""
    foreground = potential.draw(key, values[Variable(potential.body.variable)])
    return SilhouetteEvidence(foreground, jnp.ones(foreground.shape[0], bool))


@register("likelihood", "silhouette_bernoulli", Options, reads=("silhouettes",))
def build(name: str, options: Options, body: Body, rig: Camera, **_: Any) -> Factor:
    """Build the factor for one rig and body."""
    rates = (jnp.asarray(value, body.lengths.dtype) for value in (options.false_alarm, options.miss, options.soft_px))
    potential = SilhouetteBernoulli(options.grid, body, rig, *rates)
    return Factor(
        name=name, side="likelihood", scope=(Variable(body.variable),), log_potential=potential, simulate=jax.tree_util.Partial(simulate, potential)
    )
