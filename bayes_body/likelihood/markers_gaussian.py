r"""Markers seen by cameras, as a distribution over their pixels: with the projection $\pi_c(m(s))$ of marker m in camera c,

$$p(z \mid s) = \prod_{c, m \,\text{present}} \Big[ (1 - \epsilon)\, f\big(\|z_{cm} - \pi_c(m(s))\|; \sigma_{cm}\big)
  + \frac{\epsilon}{W_c H_c} \Big],$$

where f is Gaussian, $\frac{1}{2\pi\sigma^2} e^{-r^2/2\sigma^2}$, or Student's t in two dimensions (Lange et al. 1989), which has the same constant,
$\frac{1}{2\pi\sigma^2} (1 + r^2/\nu\sigma^2)^{-(\nu+2)/2}$; $\epsilon$ is the fraction of outliers, uniform over the image, and
$\sigma_{cm} = \sigma_c / q_{cm}^a$ with the confidence q. Which markers are present, and their confidence, is given. A marker behind a camera is
expected at a fixed place far outside the image: this is unlikely but finite, and the density is still normalised.

Errors of keypoint networks are correlated between frames and cameras (a hip is always found outside and above the joint's centre). Here they are
independent, so on real keypoints the posterior is too narrow, and more so at higher frame rates.
"""

import math
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float
from pydantic import Field

from bayes_body.body.placement import placed_markers
from bayes_body.body.solids import Body
from bayes_body.density.factor import Factor, Variable, Variables
from bayes_body.errors import input_error
from bayes_body.evidence.markers import MARKERS, MarkerEvidence
from bayes_body.geometry.camera import Camera, project
from bayes_body.registry import register
from bayes_body.shapes import Configuration, Key, Scalar
from bayes_body.toml.schema import NonNegative, Positive, Schema, Share

# Where a marker behind the camera is expected: its distance from the image's centre, in diagonals of the image.
BEHIND = 2.0
Rare = Annotated[float, Field(strict=True, ge=0, lt=1)]


class Options(Schema):
    """Options of `[[likelihood]] kind = "markers_gaussian"`."""

    sd_px: Positive = 8.0
    at_diagonal_px: NonNegative = 0.0
    noise: Literal["gaussian", "student"] = "gaussian"
    degrees_of_freedom: Positive = 4.0
    outliers: Rare = 0.0
    by_confidence: NonNegative = 0.0
    least_confidence: Share = 0.3
    missing: Rare = 0.0


@partial(
    jax.tree_util.register_dataclass,
    meta_fields=["noise", "markers", "places", "outliers", "by_confidence"],
    data_fields=["body", "rig", "sd_px", "degrees_of_freedom", "least_confidence"],
)
@dataclass(frozen=True)
class MarkersGaussian:
    """The log-potential as a pytree, and the distribution with that density.

    Attributes:
        noise: gaussian or student.
        markers: indices of the visible markers in the body.
        places: their indices in `MARKERS`.
        outliers: fraction of the markers that are outliers, uniform over the image.
        by_confidence: the power a of the confidence.
        body: the body.
        rig: the cameras.
        sd_px: standard deviation in each camera; the scale for Student's t.
        degrees_of_freedom: of Student's t.
        least_confidence: a marker with at most this confidence counts as not present.
    """

    noise: Literal["gaussian", "student"]
    markers: tuple[int, ...]
    places: tuple[int, ...]
    outliers: float
    by_confidence: float
    body: Body
    rig: Camera
    sd_px: Float[Array, " camera"]
    degrees_of_freedom: Scalar
    least_confidence: Scalar

    def __call__(self, values: Variables, evidence: MarkerEvidence) -> Scalar:
        """log p(z | configuration), normalised."""
        configuration = values[Variable(self.body.variable)]
        pixels, confidence = (jnp.asarray(each)[:, list(self.places)] for each in evidence)
        present = confidence > self.least_confidence
        # Absent data may be NaN. Without this, a `where` around the density would still let NaN into the gradient.
        pixels, confidence = jnp.where(present[..., None], pixels, 0.0), jnp.where(present, confidence, 1.0)
        densities = self._log_density(pixels, confidence, self.expected(configuration))
        # If a marker is behind a camera, its expected place does not depend on the configuration, which would hide a NaN.
        return jnp.where(jnp.isfinite(jnp.sum(configuration)), jnp.sum(jnp.where(present, densities, 0.0)), jnp.nan)

    def expected(self, configuration: Configuration) -> Float[Array, "camera present 2"]:
        """The expected pixels of the body's markers in each camera."""
        points = placed_markers(self.body, configuration)[list(self.markers), :]

        def of(camera: Camera) -> Float[Array, "present 2"]:
            pixels, visible = project(camera, points)
            return jnp.where(visible[:, None], pixels, camera.size / 2 - BEHIND * jnp.sqrt(jnp.sum(camera.size**2)))

        return jax.vmap(of)(self.rig)

    def _log_density(
        self, pixels: Float[Array, "camera present 2"], confidence: Float[Array, "camera present"], expected: Float[Array, "camera present 2"]
    ) -> Float[Array, "camera present"]:
        variance = self._sd(confidence) ** 2
        squares = jnp.sum((pixels - expected) ** 2, axis=-1) / variance
        nu = self.degrees_of_freedom
        fall = 0.5 * squares if self.noise == "gaussian" else 0.5 * (nu + 2) * jnp.log1p(squares / nu)
        inlier = -fall - jnp.log(2 * math.pi * variance)
        if self.outliers == 0:
            return inlier
        anywhere = jnp.where(self._inside(pixels), math.log(self.outliers) - jnp.log(jnp.prod(self.rig.size, axis=1))[:, None], -jnp.inf)
        return jnp.logaddexp(math.log1p(-self.outliers) + inlier, anywhere)

    def _sd(self, confidence: Float[Array, "camera present"]) -> Float[Array, "camera present"]:
        return self.sd_px[:, None] / confidence**self.by_confidence

    def _inside(self, pixels: Float[Array, "camera present 2"]) -> Bool[Array, "camera present"]:
        # The first pixel's centre is (0, 0), so an image begins half a pixel before it.
        return jnp.all((pixels >= -0.5) & (pixels <= self.rig.size[:, None] - 0.5), axis=-1)

    def draw(self, key: Key, configuration: Configuration) -> Float[Array, "camera present 2"]:
        """Draw pixels of the body's markers, all with confidence 1."""
        noise, spread, choice, place = jax.random.split(key, 4)
        expected = self.expected(configuration)
        shape, dtype = expected.shape[:2], expected.dtype
        off = self.sd_px[:, None, None] * jax.random.normal(noise, expected.shape, dtype)
        if self.noise == "student":
            # z / sqrt(chi2 / nu), chi2 = 2 Gamma(nu / 2).
            gamma = jax.random.gamma(spread, self.degrees_of_freedom / 2, shape, dtype)
            off *= jnp.sqrt(self.degrees_of_freedom / (2 * gamma))[..., None]
        anywhere = jax.random.uniform(place, expected.shape, dtype) * self.rig.size[:, None] - 0.5
        return jnp.where(jax.random.bernoulli(choice, self.outliers, shape)[..., None], anywhere, expected + off)


def simulate(potential: MarkersGaussian, missing: Scalar, key: Key, values: Variables) -> MarkerEvidence:
    """Draw a frame's markers at a configuration. Each is missing in a camera with the same probability, whatever the configuration."""
    draws, losses = jax.random.split(key)
    pixels = potential.draw(draws, values[Variable(potential.body.variable)])
    present = jax.random.bernoulli(losses, 1 - missing, pixels.shape[:2])
    everywhere = jnp.zeros((pixels.shape[0], len(MARKERS), 2), pixels.dtype)
    places = jnp.array(potential.places)
    return MarkerEvidence(
        everywhere.at[:, places].set(jnp.where(present[..., None], pixels, 0.0)), everywhere[..., 0].at[:, places].set(present.astype(pixels.dtype))
    )


@register("likelihood", "markers_gaussian", Options)
def build(name: str, options: Options, body: Body, rig: Camera, **_: Any) -> Factor:
    """Build the factor for one rig and body.

    Raises:
        InputError: the body has none of the markers.
    """
    known = [(number, MARKERS.index(marker)) for number, marker in enumerate(body.markers.names) if marker in MARKERS]
    if not known:
        found = f"the body '{body.name}' has the markers {', '.join(body.markers.names) or '(none)'}"
        raise input_error(name, found, f"some of {', '.join(MARKERS)}", "use these names in the body's [markers]")
    dtype = body.lengths.dtype
    diagonal = jnp.sqrt(jnp.sum(rig.size**2, axis=1))
    sd_px = options.sd_px * (diagonal / options.at_diagonal_px if options.at_diagonal_px else jnp.ones_like(diagonal))
    potential = MarkersGaussian(
        noise=options.noise,
        markers=tuple(number for number, _ in known),
        places=tuple(place for _, place in known),
        outliers=options.outliers,
        by_confidence=options.by_confidence,
        body=body,
        rig=rig,
        sd_px=jnp.asarray(sd_px, dtype),
        degrees_of_freedom=jnp.asarray(options.degrees_of_freedom, dtype),
        least_confidence=jnp.asarray(options.least_confidence, dtype),
    )
    drawn = jax.tree_util.Partial(simulate, potential, jnp.asarray(options.missing, dtype))
    return Factor(name=name, side="likelihood", scope=(Variable(body.variable),), log_potential=potential, simulate=drawn)
