r"""Learn the noise of image motion from recordings with known truth: options of the likelihood `image_motion` (Sidenbladh, Black & Fleet 2000, 4).

    python inference/learn/learn_image_motion.py train_* --model sidenbladh_2000_walking

The body is fitted to the true markers of each frame. The points that it carries from a frame to the next have grey values that differ by $\eta$. With
the visible points of all pairs, expectation maximisation finds the $\sigma$ and $\epsilon$ that make

$$\sum \log \big[ (1 - \epsilon)\, \mathcal N(\eta; 0, (\sigma / \cos\alpha)^2) + \epsilon / 256 \big]$$

largest. The points are not independent, so their sum of logarithms is too sharp by a factor. For a true log-likelihood $\ell$, the variance of its
slope at the truth equals its mean curvature. Let v be a small random change of the pose; then

$$\rho = \frac{\sum_v 2\,\ell(0) - \ell(v) - \ell(-v)}{\sum_v \tfrac14\,(\ell(v) - \ell(-v))^2}$$

is the power of the likelihood for which both are equal in the mean over changes, frames and recordings (Pauli, Racugno & Ventura 2011).
"""

import argparse
import math
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from learn_regions import fitted_to_truth
from numpy.typing import NDArray

import bayes_body as bb
from bayes_body.base.errors import InputError, input_error
from bayes_body.density.factor import Variable
from bayes_body.model.body.placed_body import require
from bayes_body.model.body.placement import POSE
from bayes_body.model.build import Model
from bayes_body.model.definition import Definition
from bayes_body.model.likelihood.image_motion import UNIFORM, ImageMotionPotential
from bayes_body.recording.observation.frames import read_frame
from bayes_body.recording.session.session import Session

KIND = "image_motion"
# Changes of the pose for the precision: how many per pair of frames, and their standard deviations. A pixel of a usual picture is 5 mm.
CHANGES, CHANGE_M, CHANGE_RAD = 32, 0.003, math.radians(0.5)
ROUNDS = 100


class MotionNoise(NamedTuple):
    """Options of the likelihood: the noise of a grey value (levels), the share of points that are not what they were, the power of the likelihood."""

    noise_grey: float
    outlier_share: float
    precision: float


class Pair(NamedTuple):
    """What one pair of frames says.

    Attributes:
        difference: of the grey values of the visible points, levels.
        cosine: of their angles.
        potential: the likelihood, with the rig of this frame.
        data: the pictures.
        poses: in this frame and in the frame before.
    """

    difference: NDArray[np.floating]
    cosine: NDArray[np.floating]
    potential: ImageMotionPotential
    data: Any
    poses: tuple[Array, Array]


def motion_pairs(session: Session, definition: Definition, frames: int) -> Iterator[Pair]:
    """Yield evenly spaced pairs of frames of a recording.

    Args:
        session: a recording with truth.
        definition: a model with the likelihood `image_motion`, whose body is placed by angles.
        frames: number of pairs.

    Raises:
        InputError: the recording has no truth or only one frame, or the model has no such likelihood.
    """
    if all(term.kind != KIND for term in definition.likelihoods):
        problem = f"its likelihoods are {', '.join(term.kind for term in definition.likelihoods)}"
        raise input_error(f"the model '{definition.name}'", problem, f"one of the kind {KIND}", "add it")
    if session.frames < 2:
        raise input_error(session.folder, "one frame", "two or more: image motion compares a frame with the one before", "give a longer recording")
    model, angles = fitted_to_truth(session, definition)
    require(model.body, POSE, "learning image motion", 'a body with placement = "angles"')
    for index in sorted({round(place) for place in np.linspace(1, session.frames - 1, frames)}):
        yield _pair(model, session, index, angles)


def motion_noise(pairs: Sequence[Pair]) -> MotionNoise:
    """Return what all pairs together say.

    Raises:
        InputError: the pairs have no visible point, or the likelihood has no peak at the truth.
    """
    if not any(pair.difference.size for pair in pairs):
        raise input_error("image motion", "no point of the body in any pair of frames", "a person in the pictures", "give other recordings or frames")
    difference, cosine = (np.concatenate([getattr(pair, name) for pair in pairs]) for name in ("difference", "cosine"))
    noise, share = _mixture(difference, cosine)
    curvature, slope = np.sum([_curvature_and_slope(pair, noise, share, seed) for seed, pair in enumerate(pairs)], axis=0)
    if curvature <= 0:
        problem, remedy = "the likelihood is no larger at the truth than beside it", "give recordings with more texture, or with a better body"
        raise input_error("image motion", problem, "a peak at the truth", remedy)
    return MotionNoise(noise, share, float(curvature / slope))


def _pair(model: Model, session: Session, index: int, angles: Float[np.ndarray, "frame dof"]) -> Pair:
    frame = read_frame(session, index, with_before=True)
    factor = next(candidate for candidate in model.at(frame.cameras).factors if isinstance(candidate.log_potential, ImageMotionPotential))
    potential = cast(ImageMotionPotential, factor.log_potential)
    data = jax.tree.map(jnp.asarray, model.observe(frame)[factor.name])
    pose, before = (jnp.asarray(angles[number], model.body.lengths.dtype) for number in (index, index - 1))
    compared = _compared(potential, pose, before, data)
    shown = np.asarray(compared.visibility) * np.asarray(data.has_both_frames)[:, None, None] > 0
    return Pair(np.asarray(compared.difference)[shown], np.asarray(compared.cosine)[shown], potential, data, (pose, before))


@jax.jit
def _compared(potential: ImageMotionPotential, pose: Array, before: Array, data: Any) -> Any:
    return potential.compared(pose, before, data)


def _mixture(difference: NDArray[np.floating], cosine: NDArray[np.floating]) -> tuple[float, float]:
    """Return σ and ε by expectation maximisation."""
    scaled = (difference * cosine).astype(float)
    sd, share = float(np.median(np.abs(scaled))) / 0.6745 + 1e-3, 0.1
    for _ in range(ROUNDS):
        normal = (1 - share) * cosine / (sd * np.sqrt(2 * np.pi)) * np.exp(-0.5 * (scaled / sd) ** 2)
        belongs = normal / (normal + share * UNIFORM)
        sd, share = float(np.sqrt(np.sum(belongs * scaled**2) / np.sum(belongs))) + 1e-6, float(np.clip(1 - belongs.mean(), 1e-4, 1 - 1e-4))
    return sd, share


def _curvature_and_slope(pair: Pair, noise: float, share: float, seed: int) -> tuple[float, float]:
    """Return the sums over changes of the curvature and of the squared slope of one pair's log-likelihood."""
    body, pose = pair.potential.body, pair.poses[0]
    sizes = np.where(np.array(body.skeleton.topology.dof_units) == "m", CHANGE_M, CHANGE_RAD)
    changes = jnp.asarray(np.random.default_rng(seed).normal(size=(CHANGES, pose.size)) * sizes, pose.dtype)
    noise_grey, outlier_share, precision = (jnp.asarray(value, pose.dtype) for value in (noise, share, 1.0))
    potential = replace(pair.potential, noise_grey=noise_grey, outlier_share=outlier_share, precision=precision)
    middle, ahead, behind = _log_likelihoods(potential, *pair.poses, changes, pair.data)
    return float(np.sum(2 * middle - ahead - behind)), float(np.sum((ahead - behind) ** 2)) / 4


@jax.jit
def _log_likelihoods(potential: ImageMotionPotential, centre: Array, before: Array, changes: Array, data: Any) -> tuple[Array, Array, Array]:
    """Return the log-likelihood at the pose, and at both sides of it for each change."""

    def log_likelihood(pose: Array) -> Array:
        return potential({Variable(POSE): pose, Variable(POSE, -1): before}, data)

    ahead, behind = (jax.lax.map(lambda change, sign=sign: log_likelihood(centre + sign * change), changes) for sign in (1, -1))
    return log_likelihood(centre), ahead, behind


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Learn `noise_grey`, `outlier_share` and `precision` of the likelihood `image_motion`.")
    parser.add_argument("sessions", type=Path, nargs="+", help="folders of recordings with their truth, such as those made by `bayes-body simulate`")
    parser.add_argument("--model", required=True, help="a definition's name or the path of your own, with the likelihood `image_motion`")
    parser.add_argument("--frames", type=bb.whole_number(1), default=10, help="evenly spaced pairs of frames of each recording (%(default)s)")
    return parser.parse_args()


def main() -> None:
    arguments = parse()
    bb.configure()
    definition, pairs = bb.load_definition(arguments.model), []
    for path in arguments.sessions:
        recording = list(motion_pairs(bb.load_session(path), definition, arguments.frames))
        noise = motion_noise(recording)
        pairs += recording
        figures = f"noise_grey {noise.noise_grey:.2f}, outlier_share {noise.outlier_share:.3f}, precision {noise.precision:.3f}"
        print(f"# {path.name}: {figures}, {sum(pair.difference.size for pair in recording):,} points")
    noise = motion_noise(pairs)
    print(f"noise_grey = {noise.noise_grey:.2f}\noutlier_share = {noise.outlier_share:.3f}\nprecision = {noise.precision:.3f}")


if __name__ == "__main__":
    try:
        main()
    except (InputError, OSError) as error:
        print(error, file=sys.stderr)
        sys.exit(2)
