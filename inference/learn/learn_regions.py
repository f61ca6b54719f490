r"""Probabilities of foreground in the regions of a part, and the distances of its sides from edges: options of `regions`, from recordings with truth.

    python inference/learn/learn_regions.py train_* --model mine.toml

The body is fitted to the true markers. In the regions that its parts then have, with the likelihood's own points and the pixels that each stands for,

$$p_1 = \mathrm{mean}_{x \in \Omega_1} S_x, \qquad p_2 = \mathrm{mean}_{x \in \Omega_2} S_x, \qquad
E_0^2 = \tfrac12 \big(\mathrm{mean}_{x \in \Gamma} E_x^2 + \mathrm{mean}_{x \in B} E_x^2\big),$$

where B is the silhouette's box: a side about which nothing is known counts half way between a true one and any place near the person. $p_3$ is not
learned: Sigal et al. (2011, 5.1) set it to 0.5, because other parts may be anywhere.
"""

import argparse
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

import bayes_body as bb
from bayes_body.base.errors import InputError, input_error
from bayes_body.base.geometry.camera import Camera
from bayes_body.initial import load_model
from bayes_body.initial.retarget import retarget
from bayes_body.model.build import Model
from bayes_body.model.definition import Definition
from bayes_body.model.likelihood.regions import PartSamples, projected
from bayes_body.recording.evidence.markers import MARKERS
from bayes_body.recording.evidence.regions import BAND, EDGES, INSIDE
from bayes_body.recording.observation.frames import masks_of, read_frame
from bayes_body.recording.observation.regions import squared_edge_distance
from bayes_body.recording.session.session import Session
from bayes_body.results.metrics.fit import seen_in
from bayes_body.results.metrics.truth import no_truth, true_markers

KIND = "regions"


class RegionStatistics(NamedTuple):
    """What the regions of the parts contain.

    Attributes:
        inside: probability of foreground inside a part.
        band: probability of foreground in the band beside it.
        on_sides: mean E² on its sides.
        nearby: mean E² in the silhouette's box.
        pixels: number of pixels inside the parts.
    """

    inside: float
    band: float
    on_sides: float
    nearby: float
    pixels: float

    @property
    def edge_elsewhere(self) -> float:
        """E² of a side about which nothing is known."""
        return (self.on_sides + self.nearby) / 2


class Sums(NamedTuple):
    """For inside, band, sides and box: the sum of a quantity over pixels, and the number of pixels."""

    totals: NDArray[np.floating]
    pixels: NDArray[np.floating]


def region_statistics(sums: Sequence[Sums]) -> RegionStatistics:
    """Return the statistics of all images together.

    Raises:
        InputError: no part is in any image.
    """
    totals, pixels = np.array([image.totals for image in sums]).sum(axis=0), np.array([image.pixels for image in sums]).sum(axis=0)
    if not np.all(pixels) or not sums:
        raise input_error("regions", "no part of the body in any image", "a person in the images", "give other recordings or frames")
    inside, band, on_sides, nearby = (totals / pixels).tolist()
    return RegionStatistics(inside, band, on_sides, nearby, float(pixels[INSIDE]))


def region_sums(session: Session, definition: Definition, frames: int) -> Iterator[Sums]:
    """Yield the sums of each image of a recording that shows the person.

    Args:
        session: a recording with truth.
        definition: a model with the likelihood `regions`.
        frames: number of evenly spaced frames.

    Raises:
        InputError: the recording has no truth, or the model has no such likelihood.
    """
    term = next((likelihood for likelihood in definition.likelihoods if likelihood.kind == KIND), None)
    if term is None:
        problem = f"its likelihoods are {', '.join(likelihood.kind for likelihood in definition.likelihoods)}"
        raise input_error(f"the model '{definition.name}'", problem, f"one of the kind {KIND}", "add it")
    model, angles = fitted_to_truth(session, definition)
    for index in sorted({round(place) for place in np.linspace(0, session.frames - 1, frames)}):
        pose = jnp.asarray(angles[index], model.body.lengths.dtype)
        yield from _of_frame(seen_in(model, session, index), pose, session, index, term.observation)


def fitted_to_truth(session: Session, definition: Definition) -> tuple[Model, Float[np.ndarray, "frame dof"]]:
    """Return the model of a recording, and the joint angles of its body that fit the true markers best, radians and metres.

    Raises:
        InputError: the recording has no truth.
    """
    truth = true_markers(session)
    if truth is None:
        raise no_truth(session)
    model = load_model(definition, session)
    points = {name: truth[:, place] for place, name in enumerate(MARKERS)}
    return model, retarget(model.body.by_angles, points, session.fps, fit_lengths=False).angles


def _of_frame(model: Model, pose: Any, session: Session, index: int, options: Any) -> Iterator[Sums]:
    plate: Any = next(factor for factor in model.factors if factor.name.startswith(KIND)).log_potential
    parts = model.body.placement.configuration(model.body.skeleton, pose)
    places, pixels = _projected(plate.parameters, model.rig, parts, plate.log_potential.map_index)
    frame, kinds = read_frame(session, index), np.asarray(plate.log_potential.map_index)
    for camera, (image, mask) in enumerate(zip(frame.images, masks_of(frame), strict=True)):
        if image is None or mask is None or not mask.any():
            continue
        u, v = (np.rint(np.asarray(coordinates)[:, camera]) for coordinates in (places.u, places.v))
        inside = (u >= 0) & (u < mask.shape[1]) & (v >= 0) & (v < mask.shape[0])
        weights = np.where(inside, np.asarray(pixels)[:, camera], 0.0)
        indices = np.where(inside, v, 0).astype(int), np.where(inside, u, 0).astype(int)
        squares = squared_edge_distance(image, mask, options)
        values = np.where(kinds == EDGES, squares[indices], mask[indices])
        totals = [float(np.sum((weights * values)[:, kinds == kind])) for kind in (INSIDE, BAND, EDGES)]
        rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
        box = squares[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
        counts = [float(np.sum(weights[:, kinds == kind])) for kind in (INSIDE, BAND, EDGES)]
        yield Sums(np.array([*totals, float(box.sum())]), np.array([*counts, float(box.size)]))


@jax.jit
def _projected(samples: PartSamples, rig: Camera, parts: Any, map_index: Any) -> Any:
    return jax.vmap(lambda part_samples, frame: projected(part_samples, rig, frame, map_index))(samples, parts)


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Learn `inside`, `band` and `edge_elsewhere` of the likelihood `regions`, and print them.")
    parser.add_argument("sessions", type=Path, nargs="+", help="folders of recordings with their truth, such as those made by `bayes-body simulate`")
    parser.add_argument("--model", required=True, help="a definition's name or the path of your own, with the likelihood `regions`")
    parser.add_argument("--frames", type=bb.whole_number(1), default=5, help="number of evenly spaced frames of each recording (%(default)s)")
    return parser.parse_args()


def main() -> None:
    arguments = parse()
    bb.configure()
    definition, sums = bb.load_definition(arguments.model), []
    for path in arguments.sessions:
        recording = list(region_sums(bb.load_session(path), definition, arguments.frames))
        stats = region_statistics(recording)
        sums += recording
        print(f"# {path.name}: inside {stats.inside:.3f}, band {stats.band:.3f}, E² on sides {stats.on_sides:.2f}, nearby {stats.nearby:.2f}")
    stats = region_statistics(sums)
    print(f"[likelihood.observation]\ninside = {stats.inside:.2f}\nband = {stats.band:.2f}\nedge_elsewhere = {stats.edge_elsewhere:.2f}")


if __name__ == "__main__":
    try:
        main()
    except (InputError, OSError) as error:
        print(error, file=sys.stderr)
        sys.exit(2)
