"""What image motion knows of an arm's twist while the arm is straight, and when it has bent (Sidenbladh, Black & Fleet 2000, 7, arm tracking).

    python inference/papers/sidenbladh_2000/bending_arm.py --out RUN --json figures.json

While the arm is straight, nothing says how it is twisted; when it bends, the forearm does. A standing person is filmed from the side. One arm follows
given angles: it swings a little, and after STRAIGHT frames the elbow bends by BEND_DEG, as smoothly as people move (minimum jerk, Flash & Hogan
1985). The rest stands still. The filter begins with every twist.
"""

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

import bayes_body as bb
from bayes_body.base.errors import InputError, input_error
from bayes_body.base.files.shipped import definitions_folder
from bayes_body.base.progress import Watch, unwatched
from bayes_body.model.body.build import Shape, build_body
from bayes_body.model.body.kinematics import marker_positions
from bayes_body.model.build import Model, build_model
from bayes_body.model.definition import load_body, load_definition
from bayes_body.recording.readers.rig import read_rig
from bayes_body.recording.session.session import Session
from bayes_body.results.posterior.moments import weighted_quantiles
from bayes_body.tracking.draws import Draws
from bayes_body.workshop.simulation.options import Options
from bayes_body.workshop.simulation.person import build_person
from bayes_body.workshop.simulation.session import simulate
from bayes_body.workshop.simulation.staging import Landmarks, scaled, stature_m

sys.path.append(str(Path(__file__).parents[1]))
from filmed_walk import FPS, captured_walk

MODEL, TWIST = "sidenbladh_2000_arm", "shoulder_z"
FRAMES, STRAIGHT, BENDING, BEND_DEG = 60, 20, 30, 75.0
# Errors of the first angles; the twist is uniform.
FIRST_SD_DEG, LEVEL = 3.0, 0.9
# A wider interval says that the twist is unknown, a narrower one that it is known.
WIDE_DEG, NARROW_DEG = 120.0, 60.0


class FilmedArm(NamedTuple):
    """The recording, and the true angles of the arm, radians."""

    session: Session
    angles: Float[np.ndarray, "frame 4"]


class TwistInterval(NamedTuple):
    """The ends of the 90 % interval of the twist in each frame, and the truth, degrees; effective particles in the median frame."""

    low: Float[np.ndarray, " frame"]
    high: Float[np.ndarray, " frame"]
    true: float
    ess: float

    @property
    def before_deg(self) -> float:
        """The width of the narrowest interval of the last five frames before the arm bends."""
        return float((self.high - self.low)[STRAIGHT - 5 : STRAIGHT].min())

    @property
    def after_deg(self) -> float:
        """The width of the widest interval from the end of the bending on."""
        return float((self.high - self.low)[STRAIGHT + BENDING :].max())

    @property
    def holds(self) -> bool:
        """Whether all intervals from the end of the bending on hold the truth."""
        after = slice(STRAIGHT + BENDING, None)
        return bool(((self.low[after] <= self.true) & (self.true <= self.high[after])).all())

    @property
    def passes(self) -> bool:
        """Whether nothing was known of the twist before, and the truth is known after."""
        return self.before_deg > WIDE_DEG and self.after_deg < NARROW_DEG and self.holds


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Track an arm that bends by image motion.")
    parser.add_argument("--out", type=Path, required=True, help="folder for the recording")
    parser.add_argument("--json", type=Path, required=True, help="file for the figures")
    parser.add_argument("--motion", type=Path, help="a captured walk; by default the walking cycle that ships")
    parser.add_argument("--model", default="sidenbladh_2000_arm", help="a definition of the arm (%(default)s)")
    parser.add_argument("--twist", type=float, default=20.0, help="the true twist of the upper arm, degrees (%(default)s)")
    parser.add_argument("--particles", type=bb.whole_number(1), default=40_000, help="particles (%(default)s)")
    parser.add_argument("--runs", type=bb.whole_number(1), default=10, help="independent filters (%(default)s)")
    parser.add_argument("--seed", type=bb.whole_number(0), default=0, help="seed of the person and the room (%(default)s)")
    parser.add_argument("--quick", action="store_true", help="one filter with 500 particles: a trial")
    return parser.parse_args()


def main() -> None:
    arguments = parse()
    bb.configure()
    particles, runs = (500, 1) if arguments.quick else (arguments.particles, arguments.runs)
    filmed = film_arm(arguments.out / "recording", arguments.twist, arguments.seed, arguments.motion, bb.watched("filming"))
    rows = []
    for seed in bb.watched("filters")(range(runs)):
        twist = twist_interval(filmed, particles, seed, arguments.model)
        row = {"before_deg": twist.before_deg, "after_deg": twist.after_deg, "holds": twist.holds, "passes": twist.passes, "effective": twist.ess}
        rows.append(row | {"low_deg": twist.low.tolist(), "high_deg": twist.high.tolist()})
        print(f"filter {seed}: 90 % interval {twist.before_deg:.0f} degrees wide before, {twist.after_deg:.0f} after, ", end="")
        print(f"{twist.low[-1]:.0f} to {twist.high[-1]:.0f} in the last frame; truth {twist.true:.0f}")
    passed = sum(row["passes"] for row in rows)
    arguments.json.write_text(json.dumps({"twist_deg": arguments.twist, "passed": passed, "runs": rows}, indent=2) + "\n", encoding="utf-8")
    print(f"{passed} of {runs} filters knew nothing before and the truth after")


def arm_angles(twist_deg: float) -> Float[np.ndarray, "frame 4"]:
    """Return the angles of the arm in each frame, in the order of the body's dofs, radians."""
    frames = np.arange(FRAMES)
    done = np.clip((frames - STRAIGHT) / BENDING, 0.0, 1.0)
    bend = 10 * done**3 - 15 * done**4 + 6 * done**5
    aside, ahead = (centre + size * (1 - np.cos(2 * np.pi * frames / period)) for centre, size, period in ((-35, 6, 40), (-25, 8, 50)))
    return np.radians(np.stack([aside, ahead, np.full(FRAMES, twist_deg), -3 - BEND_DEG * bend], axis=1))


def film_arm(folder: Path, twist_deg: float = 20.0, seed: int = 0, motion: Path | None = None, watch: Watch = unwatched) -> FilmedArm:
    """Film a standing person whose left arm swings and bends, with one camera, and write the session.

    Args:
        folder: the session's folder.
        twist_deg: of the upper arm, the same in all frames.
        seed: of the person, the room and the noise.
        motion: a captured walk, in whose first frame the person stands; by default the walking cycle that ships.
        watch: wraps the frames to show progress.

    Raises:
        InputError: the twist is outside the shoulder's limits, the folder already holds a session, or the motion cannot be read.
    """
    rig = replace(read_rig(definitions_folder() / "rigs" / "side_1.toml"), fps=FPS)
    still = {name: np.repeat(np.asarray(way, float)[:1], FRAMES, axis=0) for name, way in captured_walk(motion, 2.0, seed).items()}
    person = build_person(seed, stature_m(still))
    still = scaled(still, person.build.height_m / stature_m(still))
    body = build_body("arm_4", load_body("arm_4"), Shape(person.build.height_m))
    low, high = (np.degrees(float(side[body.dof_names.index(TWIST)])) for side in (body.skeleton.low, body.skeleton.high))
    if not low <= twist_deg <= high:
        raise input_error("the twist", f"{twist_deg:g} degrees", f"{low:g} to {high:g}", "give one within the shoulder's limits")
    angles = arm_angles(twist_deg)
    places = jax.vmap(lambda pose: marker_positions(body.skeleton, body.markers, pose))(jnp.asarray(angles, body.lengths.dtype))
    filmed = with_arm(still, dict(zip(body.markers.names, np.moveaxis(np.asarray(places, float), 1, 0), strict=True)))
    return FilmedArm(simulate(filmed, rig, person, Options(seed=seed), folder, title="an arm that bends", watch=watch)[0], angles)


def with_arm(still: Landmarks, arm: dict[str, Float[np.ndarray, "frame 3"]]) -> Landmarks:
    """Return the person with the left shoulder where the arm's is, facing as the arm does, and the arm's elbow and wrist."""
    # The arm bends towards -x; a walker faces +x.
    right = still["r_hip"][0] - still["l_hip"][0]
    facing = np.arctan2(right[0], -right[1])
    c, s = np.cos(np.pi - facing), np.sin(np.pi - facing)
    turned = {name: np.asarray(way) @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) for name, way in still.items()}
    shift = arm["l_shoulder"] - turned["l_shoulder"]
    # Fingers are unknown; the hand follows the forearm.
    others = {name: way + shift for name, way in turned.items() if not name.startswith("l_") or not any(part in name for part in ("hand", "finger"))}
    return others | {name: arm[name] for name in ("l_elbow", "l_wrist")}


def model_of_arm(filmed: FilmedArm, particles: int, seed: int = 0, name: str = MODEL) -> Model:
    """Return the model of the arm, which begins with errors of FIRST_SD_DEG and with every twist.

    Raises:
        InputError: the definition cannot be used.
    """
    model = build_model(load_definition(name), replace(filmed.session, initial={}, initial_markers={}, initial_keypoints={}))
    low, high = (np.asarray(side, float) for side in (model.body.skeleton.low, model.body.skeleton.high))
    rng, twist = np.random.default_rng(seed), model.body.dof_names.index(TWIST)
    first = filmed.angles[0] + rng.normal(0.0, np.radians(FIRST_SD_DEG), (particles, len(low)))
    first = np.where(first > high, 2 * high - first, first)
    first[:, twist] = rng.uniform(low[twist], high[twist], particles)
    return model.beginning_at(jnp.asarray(filmed.angles[0]), jnp.asarray(first))


def twist_interval(filmed: FilmedArm, particles: int, seed: int = 0, name: str = MODEL) -> TwistInterval:
    """Track the arm with the particle filter, and return what is known of the twist.

    Args:
        filmed: the recording and its truth.
        particles: number of particles.
        seed: of the first pose and the filter.
        name: the definition.

    Raises:
        InputError: the definition cannot be used.
    """
    return interval_of(filmed, track_arm(filmed, particles, seed, name))


def track_arm(filmed: FilmedArm, particles: int, seed: int = 0, name: str = MODEL) -> Draws:
    """Track the arm with the particle filter; the arguments are those of `twist_interval`.

    Raises:
        InputError: the definition cannot be used.
    """
    model = model_of_arm(filmed, particles, seed, name)
    return bb.track(jax.random.key(seed), filmed.session, model, bb.kernels.sir(), particles=particles)


def interval_of(filmed: FilmedArm, draws: Draws) -> TwistInterval:
    """Return what the draws of a tracked arm say of its twist."""
    twist = draws.model.body.dof_names.index(TWIST)
    values = np.degrees([np.asarray(frame.states["pose"])[0, :, twist] for frame in draws.frames])
    weights = np.exp([np.asarray(frame.log_weights)[0] for frame in draws.frames])
    low, high = weighted_quantiles(values[:, :, None], weights, ((1 - LEVEL) / 2, (1 + LEVEL) / 2))[:, :, 0]
    true = float(np.degrees(filmed.angles[0, twist]))
    return TwistInterval(low, high, true, float(np.median([frame.info.ess for frame in draws.frames])))


if __name__ == "__main__":
    try:
        main()
    except (InputError, OSError) as error:
        print(error, file=sys.stderr)
        sys.exit(2)
