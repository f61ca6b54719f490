r"""Filter responses on a person's boundary: the constants of the likelihood `edge_phase`, learned from images with known boundaries.

    python inference/learn/learn_edge_statistics.py train_05 train_07 --held-out test_06 --plot edges.png

A boundary is the outline of a trusted silhouette: a simulator's, or one that a person has checked. Filters are steered to the outline's normal at its
points. $\epsilon$ at both ends of the amplitudes, and a and b of their Beta distribution, are maximum likelihood estimates
(`likelihood.edge_density`). $\rho_{min}$ and $\rho_{max}$ contain 99 % of the amplitudes. log p_occ is half way between the mean log-density on
boundaries and the mean elsewhere (near the person, at least `ELSEWHERE_PX` from the outline, in any direction): a hidden sample is no evidence for or
against a pose.
"""

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from edge_plot import draw_edge_statistics
from jaxtyping import Array
from numpy.typing import NDArray
from scipy.optimize import minimize

import bayes_body as bb
from bayes_body.base.errors import InputError, input_error
from bayes_body.model.likelihood.edge_phase import EdgeStatistics, clipped, log_density, log_normaliser, phase_and_log_amplitude, wrapped_normal
from bayes_body.recording.evidence.edge_phase import Response
from bayes_body.recording.observation.edge_phase import displaced, elsewhere_points, outline_points, responses, sampled
from bayes_body.recording.observation.frames import read_frame
from bayes_body.recording.readers.images import read_mask
from bayes_body.recording.session.session import Session
from bayes_body.workshop.simulation.film import TRUE_MASKS, mask_pattern

# Fractions of the amplitudes below ρ_min and above ρ_max.
TAIL = 0.005
LEAST_POINTS = 200
WAVELENGTHS = "8,16"
DISPLACED_PX = (0.0, 2.0, 5.0, 10.0)


def fit(boundary: Response, elsewhere: Response) -> EdgeStatistics:
    """Fit the constants of one scale.

    Raises:
        InputError: there are too few points.
    """
    if len(boundary.even) < LEAST_POINTS or len(elsewhere.even) < LEAST_POINTS:
        problem = f"{len(boundary.even)} points on boundaries, {len(elsewhere.even)} elsewhere"
        raise input_error("edge statistics", problem, f"at least {LEAST_POINTS} of each", "give more frames")
    phase, rho = (np.asarray(feature, float) for feature in phase_and_log_amplitude(jnp.asarray(boundary.even), jnp.asarray(boundary.odd)))
    low, high = np.quantile(rho, [TAIL, 1 - TAIL])
    share = np.asarray(clipped(jnp.asarray((rho - low) / (high - low))), float)
    without = EdgeStatistics(_epsilon(phase, share), _amplitude(share), np.array([low, high]), np.array(0.0))
    half_way = (mean_log_density(boundary, without) + mean_log_density(elsewhere, without)) / 2
    return without._replace(log_occluded=np.array(half_way))


def _epsilon(phase: NDArray[np.floating], share: NDArray[np.floating]) -> NDArray[np.floating]:
    normal = np.asarray(wrapped_normal(jnp.asarray(phase)), float)

    def loss(ends: NDArray[np.floating]) -> float:
        epsilon = ends[0] + (ends[1] - ends[0]) * share
        return -float(np.mean(np.log(epsilon * normal + (1 - epsilon) / np.pi)))

    return minimize(loss, np.array([0.5, 0.8]), bounds=[(0.0, 0.999)] * 2, method="L-BFGS-B").x


def _amplitude(share: NDArray[np.floating]) -> NDArray[np.floating]:
    means = np.mean(np.log(share)), np.mean(np.log1p(-share))

    def loss(ab: Array) -> Array:
        return log_normaliser(ab[0], ab[1]) - (ab[0] - 1) * means[0] - (ab[1] - 1) * means[1]

    # The loss is too rough for optimisation in single precision.
    with jax.enable_x64(True):
        sloped = jax.jit(jax.value_and_grad(loss))
        # Below 1 the density would rise towards an end.
        optimum = minimize(lambda ab: [np.asarray(part, float) for part in sloped(ab)], [2.0, 2.0], jac=True, bounds=[(1.001, 100.0)] * 2)
    return optimum.x


class Images(NamedTuple):
    """Pairs of grey images and silhouettes with known outlines."""

    pairs: Sequence[tuple[NDArray[np.uint8], NDArray[np.bool_]]]

    def at(self, wavelength_px: float, displacements: Sequence[float | None], seed: int = 0) -> list[Response]:
        """Responses for each displacement from all outlines: displaced by that number of pixels, or elsewhere if it is None."""
        rng = np.random.default_rng(seed)
        groups: list[list[Response]] = [[] for _ in displacements]
        for grey, mask in self.pairs:
            maps, outline = responses(grey, wavelength_px), outline_points(mask)
            for place, by_px in zip(groups, displacements, strict=True):
                points = elsewhere_points(mask, len(outline.places), rng) if by_px is None else displaced(outline, by_px, rng)
                place.append(sampled(maps, points))
        return [Response(*(np.concatenate(part) for part in zip(*group, strict=True))) for group in groups]


def known_pairs(session: Session, frames: int, true_masks: Callable[[str], str]) -> list[tuple[NDArray[np.uint8], NDArray[np.bool_]]]:
    """Grey images of a recording, evenly spread over its frames, with known silhouettes.

    Args:
        session: the recording.
        frames: number of frames.
        true_masks: maps a camera's name to the printf pattern of the simulator's silhouettes, relative to the session's folder. If there are none,
            the session's masks are used.
    """
    pairs = []
    for index in sorted({round(place) for place in np.linspace(0, session.frames - 1, frames)}):
        frame = read_frame(session, index)
        for view, image in zip(session.views, frame.images, strict=True):
            path = session.folder / (true_masks(view.camera.name) % index)
            if not path.is_file():
                mask_path = session.mask_path(view, index)
                if mask_path is None:
                    continue
                path = mask_path
            mask = read_mask(path, view.camera.size_px)
            if image is not None and mask.any():
                pairs.append((image, mask))
    return pairs


def mean_log_density(response: Response, statistics: EdgeStatistics) -> float:
    """The mean for one scale, nats per sample."""
    return float(np.mean(np.asarray(log_density(jnp.asarray(response.even), jnp.asarray(response.odd), statistics))))


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Learn the `likelihood.scale` tables of `edge_phase`, and print them.")
    recordings = "recordings with reliable silhouettes: from `bayes-body simulate --masks`, or masks that you have checked"
    parser.add_argument("sessions", type=Path, nargs="+", help=recordings)
    parser.add_argument("--wavelengths", default=WAVELENGTHS, help="wavelengths of the filters in pixels, separated by commas (%(default)s)")
    parser.add_argument("--frames", type=bb.whole_number(1), default=5, help="number of evenly spaced frames of each recording (%(default)s)")
    parser.add_argument("--held-out", type=Path, action="append", default=[], help="a recording for the comparison only; may be given several times")
    parser.add_argument("--plot", type=Path, help="a .png of the learned densities over the data")
    return parser.parse_args()


def main() -> None:
    arguments = parse()
    bb.configure()
    tried = wavelengths_of(arguments.wavelengths)
    images = images_of(arguments.sessions, arguments.frames)
    others = images_of(arguments.held_out, arguments.frames) if arguments.held_out else None
    asked, learned, compared = (*DISPLACED_PX, None), [], []
    for number in bb.watched("wavelengths")(range(len(tried))):
        wavelength = tried[number]
        boundary = images.at(wavelength, asked)
        learned.append((wavelength, fit(boundary[0], boundary[-1]), boundary[0]))
        compared.append([mean_log_density(response, learned[-1][1]) for response in (others.at(wavelength, asked) if others else boundary)])
    print("\n".join(scale_table(wavelength, statistics) for wavelength, statistics, _ in learned))
    whose = "held-out recordings" if others else "training recordings"
    print(f"# mean log-density per sample, nats, on the {whose}: on boundaries displaced by ... px, and elsewhere")
    print("# wavelength px " + "".join(f"{by:8g}" for by in DISPLACED_PX) + "   elsewhere")
    for (wavelength, *_), values in zip(learned, compared, strict=True):
        print(f"# {wavelength:13g} " + "".join(f"{value:8.2f}" for value in values[:-1]) + f"{values[-1]:12.2f}")
    if arguments.plot is not None:
        draw_edge_statistics(arguments.plot, learned)
        print(f"# {arguments.plot}")


def scale_table(wavelength: float, statistics: EdgeStatistics) -> str:
    def pair(values: Any) -> str:
        return f"[{values[0]:.3f}, {values[1]:.3f}]"

    rows = [
        "[[likelihood.scale]]",
        f"wavelength_px = {wavelength:.1f}",
        f"epsilon = {pair(statistics.epsilon)}",
        f"amplitude = {pair(statistics.amplitude)}",
        f"log_amplitude = {pair(statistics.log_amplitude)}",
        f"log_occluded = {float(statistics.log_occluded):.2f}",
    ]
    return "\n".join(rows) + "\n"


def images_of(sessions: list[Path], frames: int) -> Images:
    """Return the images of some frames whose silhouettes are known."""
    pairs = []
    for path in sessions:
        session = bb.load_session(path)
        recording_pairs = known_pairs(session, frames, lambda name: mask_pattern(TRUE_MASKS, name))
        if not recording_pairs:
            raise input_error(
                path, "no known silhouettes", f"a folder {TRUE_MASKS}, or masks", "simulate with --masks, or give cameras their `masks`"
            )
        pairs += recording_pairs
    return Images(pairs)


def wavelengths_of(text: str) -> list[float]:
    """Return the wavelengths, ascending."""
    try:
        wavelengths = sorted({float(word) for word in text.split(",")})
    except ValueError:
        wavelengths = []
    if not wavelengths or not all(3 <= value < float("inf") for value in wavelengths):
        raise input_error("--wavelengths", repr(text), "numbers from 3 up, separated by commas", f"give for example {WAVELENGTHS}")
    return wavelengths


if __name__ == "__main__":
    try:
        main()
    except (InputError, OSError) as error:
        print(error, file=sys.stderr)
        sys.exit(2)
