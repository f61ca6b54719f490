"""The distribution of the pixels at which cameras detect points: Gaussian or Student's t, with outliers and confidences (`markers_gaussian`)."""

import math
from dataclasses import dataclass
from functools import partial
from typing import Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from bayes_body.base.geometry.camera import Camera, project
from bayes_body.base.shapes import Key, Scalar

# Where a point behind the camera is expected: its distance from the image's centre, in diagonals of the image.
BEHIND = 2.0


@partial(
    jax.tree_util.register_dataclass,
    meta_fields=["noise", "outliers", "by_confidence"],
    data_fields=["rig", "sd_px", "degrees_of_freedom", "least_confidence", "factors"],
)
@dataclass(frozen=True)
class Detections:
    """The distribution of the pixels at which cameras detect points of the world.

    Attributes:
        noise: gaussian or student.
        outliers: fraction of the markers that are outliers, uniform over the image.
        by_confidence: the power a of the confidence.
        rig: the cameras.
        sd_px: standard deviation in each camera; the scale for Student's t.
        degrees_of_freedom: of Student's t.
        least_confidence: a marker with at most this confidence counts as not present.
        factors: factor of the standard deviation of each point; None for 1.
    """

    noise: Literal["gaussian", "student"]
    outliers: float
    by_confidence: float
    rig: Camera
    sd_px: Float[Array, " camera"]
    degrees_of_freedom: Scalar
    least_confidence: Scalar
    factors: Float[Array, " point"] | None = None

    def log_density(
        self, points: Float[Array, "point 3"], pixels: Float[Array, "camera point 2"], confidence: Float[Array, "camera point"]
    ) -> Scalar:
        """Return the sum of the present points' log-densities, normalised."""
        return jnp.sum(self.log_densities(self.expected(points), pixels, confidence))

    def log_densities(
        self,
        expected: Float[Array, "camera point entry"],
        pixels: Float[Array, "camera point 2"],
        confidence: Float[Array, "camera point"],
    ) -> Float[Array, "camera point"]:
        """Return the log-density of each point's pixels, normalised, given the expected pixels; 0 for a point that is not present.

        A third entry of `expected` is the log of a factor of the standard deviation.
        """
        present = confidence > self.least_confidence
        # Absent data may be NaN. Without this, a `where` around the density would still let NaN into the gradient.
        pixels, confidence = jnp.where(present[..., None], pixels, 0.0), jnp.where(present, confidence, 1.0)
        return jnp.where(present, self._log_densities(pixels, confidence, expected), 0.0)

    def expected(self, points: Float[Array, "*camera point 3"]) -> Float[Array, "camera point 2"]:
        """Return the expected pixels of points in each camera; the points may differ between cameras."""

        def pixels_of(camera: Camera, points: Float[Array, "point 3"]) -> Float[Array, "point 2"]:
            pixels, visible = project(camera, points)
            return jnp.where(visible[:, None], pixels, camera.size / 2 - BEHIND * jnp.sqrt(jnp.sum(camera.size**2)))

        return jax.vmap(pixels_of, (0, 0 if points.ndim == 3 else None))(self.rig, points)

    def _log_densities(
        self, pixels: Float[Array, "camera point 2"], confidence: Float[Array, "camera point"], expected: Float[Array, "camera point entry"]
    ) -> Float[Array, "camera point"]:
        variance = self._sd(confidence) ** 2
        if expected.shape[-1] > 2:
            variance = variance * jnp.exp(2 * expected[..., 2])
        squares = jnp.sum((pixels - expected[..., :2]) ** 2, axis=-1) / variance
        nu = self.degrees_of_freedom
        fall = 0.5 * squares if self.noise == "gaussian" else 0.5 * (nu + 2) * jnp.log1p(squares / nu)
        inlier = -fall - jnp.log(2 * math.pi * variance)
        if self.outliers == 0:
            return inlier
        anywhere = jnp.where(self._inside(pixels), math.log(self.outliers) - jnp.log(jnp.prod(self.rig.size, axis=1))[:, None], -jnp.inf)
        return jnp.logaddexp(math.log1p(-self.outliers) + inlier, anywhere)

    def _sd(self, confidence: Float[Array, "camera point"]) -> Float[Array, "camera point"]:
        sd = self.sd_px[:, None] / confidence**self.by_confidence
        return sd if self.factors is None else self.factors * sd

    def _inside(self, pixels: Float[Array, "camera point 2"]) -> Bool[Array, "camera point"]:
        # The first pixel's centre is (0, 0), so an image begins half a pixel before it.
        return jnp.all((pixels >= -0.5) & (pixels <= self.rig.size[:, None] - 0.5), axis=-1)

    def draw(
        self, key: Key, points: Float[Array, "*camera point 3"], confidence: Float[Array, "camera point"] | None = None
    ) -> Float[Array, "camera point 2"]:
        """Draw pixels of points, which may differ between cameras, with the given confidence, by default 1."""
        return self.draw_about(key, self.expected(points), confidence)

    def draw_about(
        self, key: Key, expected: Float[Array, "camera point entry"], confidence: Float[Array, "camera point"] | None = None
    ) -> Float[Array, "camera point 2"]:
        """Draw pixels about the expected ones, which are as in `log_densities`."""
        noise, spread, choice, place = jax.random.split(key, 4)
        shape, dtype = expected.shape[:2], expected.dtype
        sd = self._sd(jnp.ones(shape, dtype) if confidence is None else confidence)
        if expected.shape[-1] > 2:
            sd = sd * jnp.exp(expected[..., 2])
        expected = expected[..., :2]
        off = sd[..., None] * jax.random.normal(noise, expected.shape, dtype)
        if self.noise == "student":
            # z / sqrt(chi2 / nu), chi2 = 2 Gamma(nu / 2).
            gamma = jax.random.gamma(spread, self.degrees_of_freedom / 2, shape, dtype)
            off *= jnp.sqrt(self.degrees_of_freedom / (2 * gamma))[..., None]
        anywhere = jax.random.uniform(place, expected.shape, dtype) * self.rig.size[:, None] - 0.5
        return jnp.where(jax.random.bernoulli(choice, self.outliers, shape)[..., None], anywhere, expected + off)
