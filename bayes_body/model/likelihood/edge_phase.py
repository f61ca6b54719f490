r"""Edges by phase (Poon & Fleet 2002, 3.2): band-pass filters steered to the normals of the parts' occluding boundaries,

$$\log L(s) = \sum_c \sum_j \frac{1}{n_j} \sum_i \log L_{ij}, \qquad
L_{ij} = \prod_{\text{scales}} p(\phi_{ij} \mid \rho_{ij}, s)\, p(\rho_{ij} \mid s) \ \text{if visible, else}\ p_{occ},$$

with the densities below and the samples of `boundaries`. A partly hidden sample (soft visibility) has the mixture of both. A sample outside the
image, or in a camera that did not see the frame, counts as hidden.

The factor $1/n_j$ is the paper's (8). It tempers the posterior: n measurements count as one, which "accounts for the lack of a background model" and
broadens the likelihood; it does not depend on how many of them are independent. Without it (`normalise_by_samples = false`) all count as independent,
which neighbours along a boundary are not. The constant p_occ is not a density of the image either, so this likelihood cannot be simulated.

A filter is steered to the normal of a boundary. Its response there has this density (Nestares & Fleet 2001; Poon & Fleet 2002, (5) and (6)). With the
phase $\phi \in [0, \pi)$, the logarithm $\rho$ of the amplitude and $\rho' = (\rho - \rho_{min}) / (\rho_{max} - \rho_{min})$,

$$p(\phi \mid \rho) = \epsilon(\rho)\, \mathcal{N}(\phi; \pi/2, \sigma^2) + (1 - \epsilon(\rho)) / \pi, \qquad
p(\rho') \propto c(\rho')^{a-1} (1 - c(\rho'))^{b-1},$$

$\epsilon$ is linear in $\rho'$. The phase is that of a step edge with either side brighter, so it is folded modulo $\pi$. The normal distribution is
wrapped around that circle, so it is normalised, and smooth where the phase wraps. The paper's distribution of $\rho'$ is Beta(a, b). Here $c$ clips
it to $[\delta, 1 - \delta]$, softly: with a hard clip the density would have slopes of $(a - 1) / \delta$, which would force short steps on
Hamiltonian Monte Carlo. It is normalised over $[\rho_{min}, \rho_{max}]$. For a response outside this range, which the paper leaves open, the value
at the nearer end is used.
"""

import math
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from pydantic import Field, model_validator

from bayes_body.base.geometry.camera import Camera
from bayes_body.base.registry import register
from bayes_body.base.shapes import Scalar
from bayes_body.base.toml.schema import Count, Finite, Positive, Schema, Share
from bayes_body.density.factor import Factor, Variable, Variables
from bayes_body.model.body.solids import Body
from bayes_body.model.likelihood.boundaries import Boundaries, Contour, Visibility, boundaries, contour
from bayes_body.model.likelihood.patch_pixels import rig_patches, sample_slopes
from bayes_body.recording.evidence.edge_phase import PhaseMaps, look_up

# σ, radians.
PHASE_SD = 0.15 * math.pi
# δ: with a, b above 1, a Beta density would be zero at both ends.
NEAREST = 0.01
# The fraction of the range of ρ' over which the soft clip bends.
BEND = 0.05
# Nodes of the integral over ρ'.
QUADRATURE = 64
# Added to the square of an amplitude in grey levels, because zero has no logarithm.
FLOOR = 1e-6


class EdgeStatistics(NamedTuple):
    """The constants of one scale or, with a leading axis, of several.

    Attributes:
        epsilon: ε at ρ' = 0 and at ρ' = 1.
        amplitude: a and b.
        log_amplitude: ρ_min and ρ_max; amplitudes in grey levels.
        log_occluded: log p_occ, for a hidden sample.
    """

    epsilon: Float[Array | np.ndarray, "*scale 2"]
    amplitude: Float[Array | np.ndarray, "*scale 2"]
    log_amplitude: Float[Array | np.ndarray, "*scale 2"]
    log_occluded: Float[Array | np.ndarray, " *scale"]


def phase_and_log_amplitude(even: Array, odd: Array) -> tuple[Array, Array]:
    """φ − π/2, in [−π/2, π/2], and ρ."""
    sign = jnp.where(odd < 0, -1.0, 1.0)
    # For a response of zero any phase will do, as long as its gradient is finite.
    is_zero = (even == 0) & (odd == 0)
    phase = jnp.arctan2(jnp.where(is_zero, 0.0, even * sign), jnp.where(is_zero, 1.0, odd * sign))
    return phase, 0.5 * jnp.log(even * even + odd * odd + FLOOR)


def log_density(even: Array, odd: Array, statistics: EdgeStatistics) -> Array:
    """log p(φ | ρ) + log p(ρ) of responses; the statistics are broadcast against them (`epsilon[0]` is ε at ρ' = 0, and so on)."""
    phase, rho = phase_and_log_amplitude(even, odd)
    share = share_of(rho, statistics)
    epsilon = statistics.epsilon[0] + (statistics.epsilon[1] - statistics.epsilon[0]) * share
    return jnp.log(epsilon * wrapped_normal(phase) + (1 - epsilon) / math.pi) + amplitude_log_density(share, statistics)


def amplitude_log_density(share: Array, statistics: EdgeStatistics) -> Array:
    """log p(ρ), for clipped shares ρ'."""
    (low, high), (a, b) = statistics.log_amplitude, jnp.asarray(statistics.amplitude)
    return (a - 1) * jnp.log(share) + (b - 1) * jnp.log1p(-share) - log_normaliser(a, b) - jnp.log(high - low)


def share_of(rho: Array, statistics: EdgeStatistics) -> Array:
    """ρ', clipped."""
    low, high = statistics.log_amplitude
    return clipped((rho - low) / (high - low))


def clipped(share: Array) -> Array:
    """ρ' clipped to [δ, 1 − δ]: nearly ρ' itself well inside, and smooth everywhere."""
    above, below = (0.5 * (x + jnp.sqrt(x * x + (2 * BEND) ** 2)) for x in (share, 1 - share))
    return NEAREST + (1 - 2 * NEAREST) * above / (above + below)


def log_normaliser(a: Array, b: Array) -> Array:
    """log of the integral of c^(a-1) (1-c)^(b-1) over ρ' in [0, 1]; without the clip it is log B(a, b)."""
    middles = clipped((jnp.arange(QUADRATURE, dtype=jnp.result_type(float)) + 0.5) / QUADRATURE)
    logs = (a[..., None] - 1) * jnp.log(middles) + (b[..., None] - 1) * jnp.log1p(-middles)
    return jax.nn.logsumexp(logs, axis=-1) - math.log(QUADRATURE)


def wrapped_normal(phase: Array) -> Array:
    """The normal density with mean 0 and standard deviation `PHASE_SD`, wrapped on a circle of length π."""
    images = sum(jnp.exp(-0.5 * ((phase + turn * math.pi) / PHASE_SD) ** 2) for turn in (-1, 0, 1))
    return jnp.asarray(images) / (PHASE_SD * math.sqrt(2 * math.pi))


AboveOne = Annotated[float, Field(strict=True, gt=1, allow_inf_nan=False)]


class Scale(Schema):
    """A `[[likelihood.scale]]`: a filter's wavelength and the statistics of its responses on boundaries (inference/learn)."""

    wavelength_px: Annotated[float, Field(strict=True, ge=3, allow_inf_nan=False)]
    """[pixels] wavelength of the filter, at least 3."""
    epsilon: tuple[Share, Share]
    """fraction of boundary samples with the phase of a step edge, at the smallest and at the largest amplitude."""
    amplitude: tuple[AboveOne, AboveOne]
    """the two parameters of the Beta distribution of the amplitude's logarithm, each above 1."""
    log_amplitude: tuple[Finite, Finite]
    """[log of grey levels] the smallest and the largest logarithm of the amplitude."""
    log_occluded: Finite
    """log-density of a hidden sample."""

    @model_validator(mode="after")
    def _check_range(self) -> "Scale":
        low, high = self.log_amplitude
        if not low < high:
            raise ValueError(f"log_amplitude = [{low:g}, {high:g}]: the first is not below the second; give the smallest, then the largest")
        return self


class Options(Schema):
    """Options of `[[likelihood]] kind = "edge_phase"`."""

    scale: Annotated[tuple[Scale, ...], Field(min_length=1)]
    """tables `[[likelihood.scale]]`, one per wavelength."""
    samples: Count = 10
    """[samples] on each side of a part's outline."""
    visibility: Visibility = "soft"
    """how a sample behind another part is treated. `"hard"`, as in the paper: it is either hidden or visible. `"soft"`: it fades gradually, so that
    the density does not jump."""
    normalise_by_samples: Annotated[bool, Field(strict=True)] = True
    """true divides by the number of samples, as in the paper: all samples of a part count as one, which tempers the posterior. With false, each
    sample counts."""
    precision: Positive = 1.0
    """power of the likelihood."""


@partial(
    jax.tree_util.register_dataclass,
    meta_fields=["visibility"],
    data_fields=["body", "rig", "contour", "statistics", "weight", "frequencies"],
)
@dataclass(frozen=True)
class EdgePhase:
    """The log-potential as a pytree.

    Attributes:
        visibility: hard or soft.
        body: the body.
        rig: the cameras.
        contour: the positions of the samples.
        statistics: the statistics of the scales.
        weight: the weight of a sample: 1/n_j or 1, times the precision.
        frequencies: the filters' frequencies, radians per pixel.
    """

    visibility: Visibility
    body: Body
    rig: Camera
    contour: Contour
    statistics: EdgeStatistics
    weight: Scalar
    frequencies: Float[Array, " scale"]

    def __call__(self, values: Variables, maps: PhaseMaps) -> Scalar:
        """log p(z | configuration), up to a constant."""
        configuration = values[Variable(self.body.variable)]
        edges = boundaries(self.body, self.rig, self.contour, rig_patches(self.body, self.rig, configuration), self.visibility)
        total = jnp.sum(self.sample_log_densities(maps, edges))
        # Clipping coordinates would hide an invalid configuration.
        return jnp.where(jnp.isfinite(jnp.sum(configuration)), self.weight * total, jnp.nan)

    def sample_log_densities(self, maps: PhaseMaps, edges: Boundaries) -> Float[Array, "camera part sample"]:
        """log L_ij."""
        response = look_up(maps, self.rig, edges.pixels, edges.normals)
        statistics = jax.tree.map(lambda leaf: leaf[..., None, None, None], _by_scale(self.statistics))
        shown_log = jnp.sum(log_density(response.even, response.odd, statistics), axis=0)
        hidden_log = jnp.sum(self.statistics.log_occluded)
        visible = edges.visible * jnp.asarray(maps.has_image, edges.visible.dtype)[:, None, None]
        if self.visibility == "hard":
            return jnp.where(visible > 0, shown_log, hidden_log)
        tiny = jnp.finfo(visible.dtype).tiny
        return jnp.logaddexp(jnp.log(jnp.maximum(visible, tiny)) + shown_log, jnp.log(jnp.maximum(1 - visible, tiny)) + hidden_log)

    def curvature(self, values: Variables, maps: PhaseMaps) -> dict[str, Float[Array, "dof dof"]]:
        r"""Approximate minus second derivatives by the dofs: only the Gaussian part of the phase, whose gradient is the filter's frequency (22).

        The sum is over all visible samples. The paper uses the middle of each side, and its formula is the diagonal.
        """
        pose = values[Variable("pose")]
        edges = boundaries(self.body, self.rig, self.contour, rig_patches(self.body, self.rig, pose), self.visibility)
        along_u, along_v = sample_slopes(self.body, self.rig, self.contour.samples, pose)
        visible = edges.visible * jnp.asarray(maps.has_image, pose.dtype)[:, None, None]
        slopes = (jnp.sqrt(visible) * (along_u * edges.normals[0] + along_v * edges.normals[1])).reshape(len(pose), -1)
        phase = jnp.sum(self.frequencies**2) / PHASE_SD**2
        return {"pose": self.weight * phase * (slopes @ slopes.T)}


def _curvature(potential: EdgePhase, values: Variables, maps: PhaseMaps) -> dict[str, Float[Array, "dof dof"]]:
    return potential.curvature(values, maps)


def _by_scale(statistics: EdgeStatistics) -> EdgeStatistics:
    """Move the axis of the pairs to the front, as `log_density` expects."""
    return EdgeStatistics(statistics.epsilon.T, statistics.amplitude.T, statistics.log_amplitude.T, statistics.log_occluded)


@register("likelihood", "edge_phase", Options, note="it reads grey levels; colour images are converted", reads=("edges",))
def build(name: str, options: Options, body: Body, rig: Camera, **_: Any) -> Factor:
    """Build the factor for one rig and body."""
    dtype = body.lengths.dtype
    scales = options.scale
    statistics = EdgeStatistics(
        epsilon=jnp.asarray([scale.epsilon for scale in scales], dtype),
        amplitude=jnp.asarray([scale.amplitude for scale in scales], dtype),
        log_amplitude=jnp.asarray([scale.log_amplitude for scale in scales], dtype),
        log_occluded=jnp.asarray([scale.log_occluded for scale in scales], dtype),
    )
    weight = options.precision / (2 * options.samples if options.normalise_by_samples else 1)
    frequencies = jnp.asarray([2 * math.pi / scale.wavelength_px for scale in scales], dtype)
    potential = EdgePhase(options.visibility, body, rig, contour(body, options.samples), statistics, jnp.asarray(weight, dtype), frequencies)
    # By parts, the kernels take differences of gradients instead.
    curvature = jax.tree_util.Partial(_curvature, potential) if body.variable == "pose" else None
    return Factor(name=name, side="likelihood", scope=(Variable(body.variable),), log_potential=potential, curvature=curvature)
