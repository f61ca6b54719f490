r"""Silhouettes and edge proximity (Darby, Li & Costen 2008, (8) and (9)), any number of cameras:

$$-\log p(z \mid s) = \rho \sum_c \Big[ \frac{1}{W_c\,|\xi|} \sum_{\xi \in \text{surface}} (1 - V^{\text{silhouette}}_c(\xi))^2
  + \frac{1}{|\xi|} \sum_{\xi \in \text{outline}} (1 - V^{\text{edge}}_c(\xi))^2 \Big]$$

$$W_c = \Big(1 - \frac{|g_z - g_x|}{\max(g_z, g_x)}\Big)^\gamma, \qquad g = \text{foreground pixels} / \text{background pixels}.$$

(9) alone is best where the body vanishes: a body that is far away lies within the silhouette, its error is 0, and 0 divided by a small W is 0. So
`least_error`, the error of a pose that agrees, is added to the error before it is divided by W; the paper adds none. A body has no clothes, and often
no hands and feet. At the true pose it covers a share of the silhouette, `body_share`, by which the foreground is multiplied in g_z; 1 as printed.

These terms ignore the silhouette that the body leaves uncovered: where clothes are full of edges, all limbs may fold into the torso's silhouette. A
third term, "cover", is not in the paper and tests the other direction (Sminchisescu & Telea 2002). For points x spread over the silhouette's
foreground, d is their distance outside the body's projection (model/likelihood/outlines.py; 0 inside). With h = `cover_soft_px`, it adds to the
bracket

$$\frac{1}{|x|} \sum_x \big(1 - e^{-d(x)^2 / 2h^2}\big)^2.$$

The maps hold $(1 - V)^2$ (recording/observation/silhouette_edges.py). The paper gives the left side up to a constant: $\rho$ is `precision`, 1 as
printed. It matters for a posterior sampler, but not for an annealing kernel that chooses its own powers. The edges' sum is multiplied by
`edge_weight`, 1 as printed. This is a sum of squares, not a distribution over images: the posterior can be sampled, but images cannot be simulated.
"""

from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from pydantic import Field

from bayes_body.base.geometry.camera import Camera
from bayes_body.base.geometry.namespaces import device_array
from bayes_body.base.registry import register
from bayes_body.base.shapes import Configuration, Scalar
from bayes_body.base.toml.schema import Count, NonNegative, Positive, Schema
from bayes_body.density.factor import Factor, Variable, Variables
from bayes_body.model.body.solids import Body, Samples, outline_samples, surface_samples
from bayes_body.model.likelihood.outlines import forms_of, point_distance, projected_area
from bayes_body.model.likelihood.patch_pixels import rig_patches, sample_pixels
from bayes_body.recording.evidence.silhouette_edges import EDGES, SILHOUETTE, Lookup, SilhouetteEdgeMaps, look_up


class Options(Schema):
    """Options of `[[likelihood]] kind = "silhouette_edges"`."""

    precision: Positive = 1.0
    """ρ, the power of the likelihood. It sets the width of the posterior; an annealing kernel chooses its own powers."""
    gamma: NonNegative = 0.0
    """weight of the agreement in area, (9); 0 omits it."""
    least_error: NonNegative = 0.0
    """with `gamma` above 0: error of a pose that agrees, added before the division by W. Without it, a body that is far away and lies within the
    silhouette agrees best. The paper adds none."""
    body_share: Annotated[float, Field(strict=True, gt=0, le=1)] = 1.0
    """with `gamma` above 0: share of the silhouette that the body covers at the true pose; it has no clothes."""
    terms: Annotated[tuple[Literal["silhouette", "edges", "cover"], ...], Field(min_length=1)] = ("silhouette", "edges")
    """the terms to use. `"silhouette"` asks whether the body lies on the silhouette. `"cover"`, which is not in the paper, asks the converse: whether
    the body covers every part of the silhouette."""
    lookup: Lookup = "bilinear"
    """how maps are interpolated: `"bilinear"`, which has gradients, or `"nearest"`, which has none."""
    surface_samples: tuple[Count, Count] = (6, 4)
    """[samples] per part and camera, on the surface: along, across."""
    outline_samples: Count = 12
    """[samples] on each side of a part's outline."""
    area_grid: tuple[Count, Count] = (80, 60)
    """[cells] columns and rows of the grid on which the projected area is measured if `gamma` is above 0."""
    cover_points: Count = 32
    """[points] per silhouette, checked by `"cover"`; a limb gets points in proportion to its length."""
    cover_soft_px: Positive = 3.0
    """[pixels] standard deviation of the Gaussian with which agreement decreases outside the body's outline."""
    edge_weight: Positive = 1.0
    """factor of the sum over the edges. With a value below 1, edges inside clothes attract the limbs less."""


@partial(
    jax.tree_util.register_dataclass,
    meta_fields=["lookup", "gamma", "least_error", "body_share", "area_grid", "covers"],
    data_fields=["body", "rig", "samples", "map_index", "weights", "precision", "soft_px"],
)
@dataclass(frozen=True)
class SilhouetteEdges:
    """The log-potential as a pytree. Static attributes determine the program, arrays do not.

    Attributes:
        lookup: nearest or bilinear.
        gamma: the exponent in (9).
        least_error: error of a pose that agrees, added before the division by W.
        body_share: share of the silhouette that the body covers at the true pose.
        area_grid: columns and rows of the grid on which the projected area is measured.
        covers: whether the term "cover" is used.
        body: the body.
        rig: the cameras.
        samples: surface samples, then outline samples, so that all are projected at once.
        map_index: for each sample, the map that it reads.
        weights: (term, sample): 1/|ξ| if the sample belongs to the term; for edges, times `edge_weight`.
        precision: ρ.
        soft_px: h of "cover", pixels.
    """

    lookup: Lookup
    gamma: float
    least_error: float
    body_share: float
    area_grid: tuple[int, int]
    covers: bool
    body: Body
    rig: Camera
    samples: Samples
    map_index: Int[Array, " sample"]
    weights: Float[Array, "2 sample"]
    precision: Scalar
    soft_px: Scalar

    def __call__(self, values: Variables, maps: SilhouetteEdgeMaps) -> Scalar:
        """log p(z | configuration), up to a constant."""
        configuration = values[Variable(self.body.variable)]
        in_camera = rig_patches(self.body, self.rig, configuration)
        pixels = sample_pixels(self.rig, in_camera, self.samples)
        errors = look_up(maps.errors, self.map_index, self.lookup, self.rig, pixels)
        if self.gamma == 0:
            error = jnp.sum(errors * (self.weights[SILHOUETTE] + self.weights[EDGES]))
        else:
            silhouette, edges = (jnp.sum(errors * weight, axis=(1, 2)) for weight in self.weights)
            error = jnp.sum((silhouette + self.least_error) / self._area_agreement(maps, configuration) + edges)
        if self.covers:
            error = error + self._uncovered(maps, in_camera)
        # A nearest look-up would turn NaN into pixel 0 and hide it.
        return jnp.where(jnp.isfinite(jnp.sum(configuration)), -self.precision * error, jnp.nan)

    def _uncovered(self, maps: SilhouetteEdgeMaps, in_camera: Float[Array, "camera 4 part 3"]) -> Scalar:
        """The term "cover", summed over the cameras that saw the frame."""
        # `forms` is an argument of the map: as a closure it would be recomputed for every point.
        forms = jax.lax.optimization_barrier(forms_of(self.body.topology, self.rig, in_camera))
        points = jnp.asarray(maps.points, forms.dtype)
        inside = jax.vmap(partial(point_distance, self.body.topology))(forms, points[..., 0], points[..., 1])
        outside = jnp.maximum(-inside, 0) / self.soft_px
        errors = jnp.mean(jnp.square(1 - jnp.exp(-0.5 * outside * outside)), axis=1)
        return jnp.sum(jnp.where(maps.foreground > 0, errors, 0.0))

    def matched_to(self, maps: SilhouetteEdgeMaps, configuration: Configuration) -> "SilhouetteEdges":
        """Return the potential whose `body_share` is that of a body whose pose is known: both areas agree there.

        Of several cameras it is the mean. No camera with a silhouette leaves it as it is.
        """
        foreground, share = np.asarray(maps.foreground), np.asarray(self._projected_share(maps, configuration))
        seen = foreground > 0
        return replace(self, body_share=float(np.mean(share[seen] / foreground[seen]))) if seen.any() else self

    def _projected_share(self, maps: SilhouetteEdgeMaps, configuration: Configuration) -> Float[Array, " camera"]:
        """The fraction of each camera's image that the body covers, of what no other person covers."""
        return projected_area(self.body, self.rig, configuration, self.area_grid, maps.uncovered)

    def _area_agreement(self, maps: SilhouetteEdgeMaps, configuration: Configuration) -> Float[Array, " camera"]:
        """W of (9), at least 1e-3, since a body that a camera does not see would divide by zero; 1 if the camera did not see the frame.

        Both areas are those of what no other person covers.
        """
        share = self._projected_share(maps, configuration)
        foreground, projected = (jnp.clip(s, 1e-6, 1 - 1e-6) / (1 - jnp.clip(s, 1e-6, 1 - 1e-6)) for s in (self.body_share * maps.foreground, share))
        agreement = 1 - jnp.abs(foreground - projected) / jnp.maximum(foreground, projected)
        return jnp.where(maps.foreground >= 0, jnp.maximum(agreement**self.gamma, 1e-3), 1.0)


def _reads(options: Options) -> tuple[str, ...]:
    silhouettes = {"silhouette", "cover"} & set(options.terms)
    return (*(("silhouettes",) if silhouettes else ()), *(("edges",) if "edges" in options.terms else ()))


@register("likelihood", "silhouette_edges", Options, reads=_reads)
def build(name: str, options: Options, body: Body, rig: Camera, **_: Any) -> Factor:
    """Build the factor for one rig and body."""
    surface, outline = surface_samples(body, *options.surface_samples), outline_samples(body, options.outline_samples)
    counts = (surface.t.shape[1], outline.t.shape[1])
    parts = len(body.topology.names)
    weights = np.zeros((2, sum(counts)))
    weights[SILHOUETTE, : counts[0]] = ("silhouette" in options.terms) / (parts * counts[0])
    weights[EDGES, counts[0] :] = options.edge_weight * ("edges" in options.terms) / (parts * counts[1])
    potential = SilhouetteEdges(
        lookup=options.lookup,
        gamma=options.gamma,
        least_error=options.least_error,
        body_share=options.body_share,
        area_grid=options.area_grid,
        covers="cover" in options.terms,
        body=body,
        rig=rig,
        samples=Samples(*(jnp.concatenate(pair, axis=1) for pair in zip(surface, outline, strict=True))),
        map_index=device_array(np.repeat([SILHOUETTE, EDGES], counts), int),
        weights=device_array(weights, body.lengths.dtype),
        precision=jnp.asarray(options.precision, body.lengths.dtype),
        soft_px=jnp.asarray(options.cover_soft_px, body.lengths.dtype),
    )
    return Factor(name=name, side="likelihood", scope=(Variable(body.variable),), log_potential=potential, has_gradient=options.lookup != "nearest")
