r"""The density of keypoints where a camera sees several people, of whom at most one is the subject: association is summed out, not decided.

$$\log p(z_c \mid x) = \log \Big[ \pi_{c0} + \sum_k \pi_{ck} \prod_m \frac{p(z_{ckm} \mid x)}{b(z_{ckm})} \Big] + \text{const},$$

over the candidates k of camera c and the markers m that each shows. b is the density of a detection that is not the subject's, uniform over the
image. The prior shares $\pi$ come with the data: what another person explains has a small one. $\pi_{c0}$ is the probability that no candidate is the
subject's. A person who is detected twice counts once, since both detections divide one share.

The slope of the logarithm is the mean of the candidates' slopes, weighted by their responsibilities

$$r_{ck} = \frac{\pi_{ck} \prod_m p/b}{\pi_{c0} + \sum_j \pi_{cj} \prod_m p/b}.$$

Searches of a mode need second derivatives, row by row, where a row is a marker in a camera. They take the responsibilities as constants. This leaves
out the covariance of the candidates' slopes, which is 0 where one candidate is the subject's beyond doubt.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from bayes_body.base.geometry.camera import Camera
from bayes_body.model.likelihood.detections import Detections
from bayes_body.recording.evidence.markers import CandidateEvidence


def candidate_log_densities(
    detections: Detections, expected: Float[Array, "camera point entry"], evidence: CandidateEvidence
) -> Float[Array, "camera point"]:
    """Return rows whose sum over the points of a camera is log p of all its candidates, relative to people anywhere.

    Args:
        detections: the density of a point's pixels.
        expected: the expected pixels of the subject's points, and the log of a factor of the standard deviation if there is a third entry.
        evidence: of these points.
    """
    shares = jnp.asarray(evidence.shares)
    ratios = jax.vmap(lambda pixels, confidence: _log_ratios(detections, expected, pixels, confidence), (1, 1), 1)(
        jnp.asarray(evidence.pixels), jnp.asarray(evidence.confidence)
    )
    nobody = jnp.maximum(1 - jnp.sum(shares, axis=1, keepdims=True), 0.0)
    terms = jnp.concatenate([_log(nobody), _log(shares) + jnp.sum(ratios, axis=2)], axis=1)
    responsibilities = jax.lax.stop_gradient(jax.nn.softmax(terms, axis=1)[:, 1:])
    rows = jnp.sum(responsibilities[..., None] * ratios, axis=1)
    difference = jax.scipy.special.logsumexp(terms, axis=1) - jnp.sum(rows, axis=1)
    return rows + jax.lax.stop_gradient(difference / rows.shape[1])[:, None]


def _log_ratios(
    detections: Detections,
    expected: Float[Array, "camera point entry"],
    pixels: Float[Array, "camera point 2"],
    confidence: Float[Array, "camera point"],
) -> Float[Array, "camera point"]:
    """Return log p / b of each point of a candidate; 0 for a point that is not present."""
    present = confidence > detections.least_confidence
    return detections.log_densities(expected, pixels, confidence) + jnp.where(present, _log_area(detections.rig)[:, None], 0.0)


def _log_area(rig: Camera) -> Float[Array, " camera"]:
    return jnp.log(jnp.prod(rig.size, axis=1))


def _log(shares: Float[Array, "camera share"]) -> Float[Array, "camera share"]:
    """Return the logarithm; -inf for 0, without a warning."""
    return jnp.where(shares > 0, jnp.log(jnp.where(shares > 0, shares, 1.0)), -jnp.inf)
