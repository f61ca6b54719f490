r"""Learn the noise of smooth motion from captured motion: options of the motion prior `constant_velocity` (Sidenbladh, Black & Fleet 2000, 5).

    python inference/learn/learn_smooth_motion.py WALKS --body BODY

Each motion is retargeted to a body. With the velocity $v_t = (s_{t+1} - s_{t-1}) / (2 \Delta t)$ of an angle or a position,

$$\sigma = \mathrm{rms}\,(s_t - s_{t-1} - v_{t-1}\,\Delta t), \qquad \sigma_v = \mathrm{rms}\,(v_t - v_{t-1}).$$

Both sides of the body have the same noise. Every person has the same weight.
"""

import argparse
import math
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

import bayes_body as bb
from bayes_body.base.errors import InputError, input_error
from bayes_body.cli.learned_files import motion_files
from bayes_body.initial.retarget import retarget
from bayes_body.model.body.build import build_body
from bayes_body.model.body.schema import BodySchema
from bayes_body.model.definition import load_body
from bayes_body.recording.readers.mocap import read_motion, resample
from bayes_body.recording.readers.mocap.motion import Motion
from bayes_body.workshop.learning.walking_angles import FPS, settled_frames

FEWEST = 5


class SmoothNoise(NamedTuple):
    """Standard deviations per frame at FPS, of the pose (rad, m) and of its velocity (rad/s, m/s), by patterns of dofs."""

    pose: Mapping[str, float]
    velocity: Mapping[str, float]
    units: Mapping[str, str]


class Track(NamedTuple):
    """A person, and the dofs of a body that follows a captured motion, radians and metres."""

    subject: str
    dofs: Float[np.ndarray, "frame dof"]


def track_of(subject: str, motion: Motion, body: str, schema: BodySchema) -> Track:
    """Retarget a captured motion to a body, at FPS.

    Raises:
        InputError: the motion lacks points of the body, or is too short.
    """
    start = build_body(body, schema)
    fit = retarget(start, resample(motion, FPS), schema=schema)
    if len(fit.angles) < FEWEST:
        raise input_error(f"a motion of {subject}", f"{len(fit.angles)} frames at {FPS:g} fps", f"{FEWEST} or more", "leave it out")
    return Track(subject, settled_frames(fit.body, fit.angles))


def smooth_noise(tracks: Sequence[Track], body: str, schema: BodySchema) -> SmoothNoise:
    """Return the noise that the tracks have in the mean."""
    topology = build_body(body, schema).skeleton.topology
    people = sorted({track.subject for track in tracks})
    squares = np.mean([np.mean([_squares(t.dofs) for t in tracks if t.subject == person], axis=0) for person in people], axis=0)
    patterns = [f"?_{name[2:]}" if name[:2] in ("l_", "r_") else name for name in topology.dof_names]
    units = dict(zip(patterns, topology.dof_units, strict=True))

    def pooled(mean_squares: Float[np.ndarray, " dof"]) -> dict[str, float]:
        dof_patterns = np.array(patterns)
        return {pattern: float(np.sqrt(mean_squares[dof_patterns == pattern].mean())) for pattern in units}

    return SmoothNoise(pooled(squares[0]), pooled(squares[1]), units)


def _squares(dofs: Float[np.ndarray, "frame dof"]) -> Float[np.ndarray, "2 dof"]:
    """Return the mean squares of the pose's noise and of the velocity's."""
    velocity = (dofs[2:] - dofs[:-2]) * FPS / 2
    residual = dofs[2:-1] - dofs[1:-2] - velocity[:-1] / FPS
    return np.stack([np.mean(residual**2, axis=0), np.mean(np.diff(velocity, axis=0) ** 2, axis=0)])


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Learn the standard deviations of `constant_velocity`, and print its tables.")
    parser.add_argument("motions", type=Path, nargs="+", help="captured motions, or folders of them, one folder a person")
    parser.add_argument("--body", default="sidenbladh_25", help="the body that follows the motion: a name or a .toml file (%(default)s)")
    return parser.parse_args()


def main() -> None:
    arguments = parse()
    bb.configure()
    schema = load_body(arguments.body)
    files = [file for path in arguments.motions for file in motion_files(path)]
    motions = bb.watched("retargeting")(range(len(files)))
    tracks = [track_of(files[number].resolve().parent.name, read_motion(files[number]), arguments.body, schema) for number in motions]
    noise = smooth_noise(tracks, arguments.body, schema)
    print(f"at_fps = {FPS:g}")
    for name, values in (("sd", noise.pose), ("velocity_sd", noise.velocity)):
        for unit, ending, factor in (("m", "m", 1.0), ("rad", "deg", math.degrees(1.0))):
            rows = [f'"{pattern}" = {factor * value:.2g}' for pattern, value in values.items() if noise.units[pattern] == unit]
            print("\n".join(["", f"[dynamics.{name}_{ending}]", *rows]))


if __name__ == "__main__":
    try:
        main()
    except (InputError, OSError) as error:
        print(error, file=sys.stderr)
        sys.exit(2)
