r"""Markers seen by cameras, as a distribution over the pixels of their detections.

The likelihood is $p(z \mid s) = p(z \mid x(s))$ with the positions x of the body's markers. It is given which markers are present, and with which
confidence. If a body is placed by its parts, its markers are a plate over the parts that hold them, which message passing reads part by part.

Errors of keypoint networks are correlated between frames and cameras (a hip is always found outside and above the joint's centre). Here they are
independent, so on real keypoints the posterior is too narrow, and more so at higher frame rates.

The distribution of the detections' pixels, given points x of the world, is

$$p(z \mid x) = \prod_{c, m \,\text{present}} \Big[ (1 - \epsilon)\, f\big(\|z_{cm} - \pi_c(x_m)\|; \sigma_{cm}\big)
  + \frac{\epsilon}{W_c H_c} \Big],$$

where f is Gaussian, $\frac{1}{2\pi\sigma^2} e^{-r^2/2\sigma^2}$, or Student's t in two dimensions (Lange et al. 1989), which has the same constant,
$\frac{1}{2\pi\sigma^2} (1 + r^2/\nu\sigma^2)^{-(\nu+2)/2}$; $\epsilon$ is the fraction of outliers, uniform over the image, and
$\sigma_{cm} = \sigma_c / q_{cm}^a$ with the confidence q. A point behind a camera is expected at a fixed place far outside the image. Its detections
are then unlikely but not impossible, and the density is still normalised.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from functools import partial
from typing import Annotated, Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from pydantic import Field

from bayes_body.base.errors import InputError, input_error, nearest
from bayes_body.base.geometry import rigid, transforms
from bayes_body.base.geometry.camera import Camera
from bayes_body.base.registry import register
from bayes_body.base.shapes import Configuration, Key, Scalar
from bayes_body.base.toml.schema import NonNegative, Positive, Schema, Share
from bayes_body.density.factor import Composed, Factor, Numbered, Variable, Variables
from bayes_body.density.plate import Plate, plate_factor
from bayes_body.model.body.placed_body import placed_markers
from bayes_body.model.body.placement import LENGTHS, PARTS, ByParts
from bayes_body.model.body.solids import Body
from bayes_body.model.likelihood.candidates import candidate_log_densities
from bayes_body.model.likelihood.detections import Detections
from bayes_body.recording.evidence.markers import KEYPOINTS, CandidateEvidence, MarkerEvidence, evidence_names

Rare = Annotated[float, Field(strict=True, ge=0, lt=1)]


class Options(Schema):
    """Options of `[[likelihood]] kind = "markers_gaussian"`."""

    sd_px: Positive = 8.0
    """[pixels] standard deviation of each coordinate, or the scale of Student's t distribution."""
    sd_factors: Mapping[str, Positive] = {}
    """table: a marker's name or a pattern = factor of `sd_px`; 1 for the others."""
    at_diagonal_px: NonNegative = 0.0
    """[pixels] image diagonal to which `sd_px` applies; in other images it is scaled in proportion. With 0, `sd_px` applies to every image."""
    noise: Literal["gaussian", "student"] = "gaussian"
    """`"gaussian"`, or `"student"`, with which a wrong detection affects the pose little."""
    degrees_of_freedom: Positive = 4.0
    """ν of Student's t distribution: the smaller, the heavier the tails."""
    outliers: Rare = 0.0
    """fraction of detections that may be anywhere in the image."""
    by_confidence: NonNegative = 0.0
    """the standard deviation is divided by this power of a keypoint's confidence: 0 ignores the confidence, 0.5 takes its square root."""
    least_confidence: Share = 0.3
    """a marker with at most this confidence counts as not seen."""
    missing: Rare = 0.0
    """when frames are drawn: the fraction of markers that a camera misses."""


@partial(jax.tree_util.register_dataclass, meta_fields=["markers", "places"], data_fields=["body", "detections", "camera_steps", "log_scale"])
@dataclass(frozen=True)
class MarkersGaussian:
    """The distribution of the pixels of a whole body's markers, as a pytree.

    Attributes:
        markers: indices of the visible markers in the body.
        places: their indices in `KEYPOINTS`.
        body: the body.
        detections: the density of each marker.
        camera_steps: what the configuration changes by until each camera sees it; None if all cameras see it at the same time.
        log_scale: log of a factor of each camera's standard deviation; None for 1.
    """

    markers: tuple[int, ...]
    places: tuple[int, ...]
    body: Body
    detections: Detections
    camera_steps: Float[Array, "camera dof"] | None = None
    log_scale: Float[Array, " camera"] | None = None

    @property
    def log_potential(self) -> Composed:
        """log p(z | configuration), normalised."""
        axes = (Numbered("camera", tuple(range(self.detections.rig.focal.shape[0]))), Numbered("marker", self.markers))
        return Composed(jax.tree_util.Partial(_expected, self), jax.tree_util.Partial(_log_densities, self), axes)

    def expected(self, configuration: Configuration) -> Float[Array, "camera present entry"]:
        """Return the expected pixels of the body's markers, and the log of a factor of their noise if there is one."""
        # If a marker is behind a camera, its expected place does not depend on the configuration, which would hide a NaN.
        pixels = _nan_with(configuration, self.detections.expected(self._points(configuration)))
        if self.log_scale is None:
            return pixels
        return jnp.concatenate([pixels, jnp.broadcast_to(self.log_scale[:, None, None], (*pixels.shape[:2], 1))], axis=-1)

    def _points(self, configuration: Configuration) -> Float[Array, "*camera present 3"]:
        if self.camera_steps is None:
            return placed_markers(self.body, configuration)[list(self.markers), :]
        return jax.vmap(lambda step: placed_markers(self.body, configuration + step)[list(self.markers), :])(self.camera_steps)

    def draw(self, key: Key, configuration: Configuration) -> Float[Array, "camera present 2"]:
        """Draw pixels of the body's markers, all with confidence 1."""
        return self.detections.draw_about(key, self.expected(configuration))

    def by_parts(self) -> Plate:
        """The same log-potential as a plate over the parts that hold visible markers; for a body that is placed by parts."""
        placement = self.body.placement
        assert isinstance(placement, ByParts)
        markers = np.array(self.markers)
        joints = np.array(self.body.markers.joints)[markers]
        owners = np.array(placement.owners)[joints]
        parts = sorted(set(owners.tolist()))
        most = int(np.bincount(owners).max())
        # Shorter lists of markers repeat their first one, which is then not counted.
        lists = [np.flatnonzero(owners == part) for part in parts]
        chosen = np.stack([np.concatenate([indices, np.repeat(indices[:1], most - len(indices))]) for indices in lists])
        counted = np.stack([np.arange(most) < len(indices) for indices in lists])
        offsets = _offsets(placement, self.body.markers.offsets, joints[chosen].astype(np.int32), markers[chosen].astype(np.int32))
        detections = self.detections
        if detections.factors is not None:
            everywhere = jnp.ones(len(KEYPOINTS), detections.sd_px.dtype)
            detections = replace(detections, factors=everywhere.at[jnp.array(self.places)].set(detections.factors))
        parameters = PartMarkers(offsets, jnp.asarray(np.array(self.places)[chosen]), jnp.asarray(counted))
        potential, resize = jax.tree_util.Partial(_of_part, detections), {LENGTHS: jax.tree_util.Partial(_stretched)}
        return Plate(PARTS, tuple((part,) for part in parts), potential, parameters, resize=resize)


def _expected(potential: MarkersGaussian, values: Variables) -> Float[Array, "camera present entry"]:
    return potential.expected(values[Variable(potential.body.variable)])


def _log_densities(
    potential: MarkersGaussian, expected: Float[Array, "camera present entry"], evidence: MarkerEvidence | CandidateEvidence
) -> Float[Array, "camera present"]:
    return _at_points(potential.detections, expected, evidence, list(potential.places))


def _at_points(
    detections: Detections, expected: Float[Array, "camera point entry"], evidence: MarkerEvidence | CandidateEvidence, places: Any
) -> Float[Array, "camera point"]:
    """Return the log-densities of the markers at `places` in the evidence."""
    if isinstance(evidence, CandidateEvidence):
        pixels, confidence = (jnp.asarray(array)[:, :, places] for array in (evidence.pixels, evidence.confidence))
        return candidate_log_densities(detections, expected, CandidateEvidence(pixels, confidence, evidence.shares))
    pixels, confidence = (jnp.asarray(array)[:, places] for array in evidence)
    return detections.log_densities(expected, pixels, confidence)


class PartMarkers(NamedTuple):
    """The markers that a part holds: positions in its frame, metres, indices in `KEYPOINTS`, and whether each counts."""

    offsets: Float[Array, "*part marker 3"]
    places: Int[Array, "*part marker"]
    counted: Bool[Array, "*part marker"]


@jax.jit
def _offsets(
    placement: ByParts, offsets: Float[Array, "marker 3"], joints: Int[Array, "part chosen"], markers: Int[Array, "part chosen"]
) -> Float[Array, "part chosen 3"]:
    """The chosen markers, each on its joint, in the frames of the parts that hold them."""
    return transforms.apply(jax.tree.map(lambda leaf: leaf[joints], placement.T_part_joint), offsets[markers])


def _stretched(markers: PartMarkers, log_length: Scalar) -> PartMarkers:
    return markers._replace(offsets=jnp.exp(log_length) * markers.offsets)


def _of_part(detections: Detections, markers: PartMarkers, frame: Float[Array, "7"], *, data: MarkerEvidence | CandidateEvidence) -> Scalar:
    """The log-potential of one part, placed at `frame`. Where there are several people, each part has a sum over the candidates for itself."""
    if detections.factors is not None:
        detections = replace(detections, factors=detections.factors[markers.places])
    points = jnp.asarray(rigid.apply(frame[None], markers.offsets))
    is_counted = markers.counted
    if isinstance(data, CandidateEvidence):
        pixels, confidence = (jnp.asarray(array)[:, :, markers.places] for array in (data.pixels, data.confidence))
        candidates = CandidateEvidence(pixels, jnp.where(is_counted, confidence, -jnp.inf), data.shares)
        return _nan_with(frame, jnp.sum(candidate_log_densities(detections, detections.expected(points), candidates)))
    pixels, confidence = (jnp.asarray(array)[:, markers.places] for array in data)
    return _nan_with(frame, detections.log_density(points, pixels, jnp.where(is_counted, confidence, -jnp.inf)))


def _nan_with(configuration: Configuration, value: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    return jnp.where(jnp.isfinite(jnp.sum(configuration)), value, jnp.nan)


def simulate(potential: MarkersGaussian, missing: Scalar, key: Key, values: Variables) -> MarkerEvidence:
    """Draw a frame's markers at a configuration. Each is missing in a camera with the same probability, whatever the configuration."""
    draws, losses = jax.random.split(key)
    pixels = potential.draw(draws, values[Variable(potential.body.variable)])
    present = jax.random.bernoulli(losses, 1 - missing, pixels.shape[:2])
    everywhere = jnp.zeros((pixels.shape[0], len(evidence_names(potential.body.markers.names)), 2), pixels.dtype)
    places = jnp.array(potential.places)
    return MarkerEvidence(
        everywhere.at[:, places].set(jnp.where(present[..., None], pixels, 0.0)), everywhere[..., 0].at[:, places].set(present.astype(pixels.dtype))
    )


@register("likelihood", "markers_gaussian", Options, reads=("keypoints",))
def build(name: str, options: Options, body: Body, rig: Camera, **_: Any) -> Factor:
    """Build the factor for one rig and body.

    Raises:
        InputError: the body has none of the markers, or a key of a table matches none.
    """
    shared_markers = [(number, KEYPOINTS.index(marker)) for number, marker in enumerate(body.markers.names) if marker in KEYPOINTS]
    if not shared_markers:
        problem = f"the body '{body.name}' has the markers {', '.join(body.markers.names) or '(none)'}"
        raise input_error(name, problem, f"some of {', '.join(KEYPOINTS)}", "use these names in the body's [markers]")
    dtype = body.lengths.dtype
    diagonal = jnp.sqrt(jnp.sum(rig.size**2, axis=1))
    sd_px = options.sd_px * (diagonal / options.at_diagonal_px if options.at_diagonal_px else jnp.ones_like(diagonal))
    detections = Detections(
        noise=options.noise,
        outliers=options.outliers,
        by_confidence=options.by_confidence,
        rig=rig,
        sd_px=jnp.asarray(sd_px, dtype),
        degrees_of_freedom=jnp.asarray(options.degrees_of_freedom, dtype),
        least_confidence=jnp.asarray(options.least_confidence, dtype),
        factors=_factors(name, options, tuple(body.markers.names[number] for number, _ in shared_markers), dtype),
    )
    potential = MarkersGaussian(tuple(number for number, _ in shared_markers), tuple(place for _, place in shared_markers), body, detections)
    drawn = jax.tree_util.Partial(simulate, potential, jnp.asarray(options.missing, dtype))
    if body.variable == PARTS:
        return plate_factor(name, "likelihood", potential.by_parts(), simulate=drawn)
    return Factor(name=name, side="likelihood", scope=(Variable(body.variable),), log_potential=potential.log_potential, simulate=drawn)


def _factors(name: str, options: Options, markers: tuple[str, ...], dtype: Any) -> Float[Array, " point"] | None:
    """Return the factor of each marker's standard deviation, that of the first pattern that matches; None if no marker has one."""
    table = options.sd_factors
    for pattern in table:
        if not any(fnmatchcase(marker, pattern) for marker in markers):
            raise InputError(f"{name}: sd_factors.{pattern}: matches no marker of the body; {nearest(pattern, markers)}")
    factors = [next((factor for pattern, factor in table.items() if fnmatchcase(marker, pattern)), 1.0) for marker in markers]
    return jnp.asarray(factors, dtype) if table else None
