"""Measure what Poon & Fleet 2002 report: `python inference/papers/poon_fleet_2002.py --all` writes docs/papers/figures/poon_fleet_2002.json.

The experiments are functions of the programs in the folder `poon_fleet_2002`; the claims are in its `claims.toml`.
"""

import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import bayes_body as bb
from bayes_body.density.density import Density
from bayes_body.density.factor import Particles
from bayes_body.model.build import Model
from bayes_body.model.definition import Definition
from bayes_body.model.likelihood.edge_phase import PHASE_SD
from bayes_body.recording.session.session import Session
from bayes_body.results.metrics.truth import draws_against_truth, no_truth
from bayes_body.tracking.draws import Draws

sys.path.append(str(Path(__file__).with_suffix("")))
from along_frames import along
from computation_curve import curve_of, draw_curve, equal_computations
from equal_computation import at_equal_computation, figures_of, mixture_after
from five_walks import WALKS
from phase_densities import draw_densities
from ratio_plot import draw_along
from reproduce import Case, Experiment, Values, reproduce
from ten_mixtures import COST, FRAMES, MODEL, QUICK, Sizes, Study, measured
from true_mean import best_truth


def compared_frames(case: Case, key: jax.Array, frames: int, definition: Definition | None = None) -> tuple[Model, Particles, list[Density]]:
    """Return the model, the mixture before the compared frame, and the densities of this frame and those after it."""
    sizes = case.sizes
    session = case.film("side_1", sizes["frame"] + frames)
    model, keys = bb.load_model(definition or sizes["model"], session, lambda line: None), jax.random.split(key)
    draws = bb.track(keys[0], session, model, bb.kernels.sir(), particles=sizes["before"], frames=sizes["frame"])
    mixture = mixture_after(keys[1], draws, sizes["components"])
    shown = range(sizes["frame"], sizes["frame"] + frames)
    return model, mixture, [model.density(model.observe(bb.read_frame(session, frame)), mixture) for frame in shown]


def variance(case: Case) -> Mapping[str, Values]:
    """Errors of the posterior means of both samplers on one frame, at several amounts of computation (Fig. 8)."""
    sizes, keys = case.sizes, jax.random.split(jax.random.key(case.seed), 3)
    model, _, (density,) = compared_frames(case, keys[0], 1)
    options = model.definition.kernel.options.model_dump()
    equals = equal_computations(keys[1], density, options, sizes["draws"], sizes["runs"])
    truth = best_truth(keys[2], density, sizes["truth"], sizes["long"], starts=sizes["starts"])
    dofs = model.body.dof_names
    # The fewest draws are those of the definition.
    figures, curve = figures_of(dofs, equals[0], truth), curve_of(equals, truth)
    if case.pictures is not None:
        draw_curve(case.pictures / "poon_fleet_2002_variance.png", dofs, curve)
    ratios = [figures_of(dofs, equal, truth)["ratio_median"] for equal in equals]
    settings = figures["settings"]
    return {
        "variance_ratio": {
            "median over the dofs, equal evaluations": figures["ratio_median"],
            "worst dof, equal evaluations": min(ratio for ratio, _, _ in figures["per_dof"].values()),
            "median over the dofs, equal seconds": figures["equal_seconds"]["ratio_median"],
            "a run of hmc, 2000 draws": figures["seconds_hmc"],
        },
        "truth": {
            "R-hat of long chains": settings["truth_rhat"],
            "variance of a long run / error² of hmc": settings["truth_noise"],
        },
        "more_computation": {"ratio with the most draws / ratio with the fewest": ratios[-1] / ratios[0]},
    }


def one_ratio(case: Case, definition: Definition) -> dict[str, float]:
    """Return the ratios of the errors of both samplers on one frame, at equal evaluations and at equal seconds."""
    sizes, keys = case.sizes, jax.random.split(jax.random.key(case.seed), 3)
    model, _, (density,) = compared_frames(case, keys[0], 1, definition)
    options = model.definition.kernel.options.model_dump()
    equal = at_equal_computation(keys[1], density, options, sizes.get("draws") or options["particles"], sizes["runs"])
    truth = best_truth(keys[2], density, sizes["truth"], sizes["long"], starts=sizes["starts"])
    figures = figures_of(model.body.dof_names, equal, truth)
    return {
        "equal evaluations": figures["ratio_median"],
        "equal seconds": figures["equal_seconds"]["ratio_median"],
        "worst dof, equal evaluations": min(ratio for ratio, _, _ in figures["per_dof"].values()),
        "R-hat of long chains": truth.rhat,
    }


def tempered_variance(case: Case) -> Mapping[str, Values]:
    """The same with the paper's own likelihood and settings, on the whole body."""
    return {"tempered_variance": one_ratio(case, bb.load_definition(case.sizes["model"]))}


def whole_body_variance(case: Case) -> Mapping[str, Values]:
    """The same on the whole body, with the likelihood and the kernel of the legs."""
    legs, sizes = bb.load_definition(case.sizes["model"]), case.sizes
    options = legs.kernel.options.model_copy(update={name: sizes[name] for name in ("burn_in", "leapfrog_steps", "starts")})
    whole = replace(bb.load_definition("poon_fleet_2002"), likelihoods=legs.likelihoods, kernel=replace(legs.kernel, options=options))
    return {"whole_body_variance": one_ratio(case, whole)}


def ten_mixtures(case: Case) -> Mapping[str, Values]:
    """Two mixtures of a walk (Fig. 8): the ratio, its worst dof, and whether the truth is known."""
    sizes, values = dict(case.sizes), dict[str, float]()
    frames, model = sizes.pop("frames"), sizes.pop("model")
    study = Study(model, 1, COST, 0, case.work / "walks", case.motions)
    (walk,) = (walk for walk in WALKS if walk.name == case.subject)
    for frame, row in zip(frames, measured(walk, frames, study, Sizes(**sizes)), strict=True):
        values |= {f"median ratio, frame {frame}": row["ratio_median"], f"worst dof, frame {frame}": row["worst_ratio"]}
        values[f"R-hat of the true mean, frame {frame}"] = row["settings"]["truth_rhat"]
        values[f"variance of a run of the truth / error² of hmc, frame {frame}"] = 100 * row["settings"]["truth_noise"]
    return {"ten_mixtures": values}


def effective_particles(case: Case) -> Mapping[str, Values]:
    """Effective particles of the particle filter on one frame."""
    keys = jax.random.split(jax.random.key(case.seed))
    _, mixture, (density,) = compared_frames(case, keys[0], 1)
    count = case.sizes["particles"]
    many = Particles(
        jax.tree.map(lambda leaf: jnp.repeat(leaf, count // len(leaf), axis=0), dict(mixture.states)), jnp.full(count, -jnp.log(float(count)))
    )
    info = jax.jit(bb.kernels.sir().function)(keys[1], many, density)[1]
    return {"effective": {"effective particles": float(info.ess), "share of the particles": float(info.ess) / count}}


def along_frames(case: Case) -> Mapping[str, Values]:
    """Errors along the frames, where each filter continues from its own draws (Fig. 9)."""
    sizes, keys = case.sizes, jax.random.split(jax.random.key(case.seed))
    model, mixture, densities = compared_frames(case, keys[0], sizes["frames"])
    options, draws = model.definition.kernel.options.model_dump(), sizes["draws"]
    filters = {f"hmc, {carry}": (bb.kernels.hmc(**options | {"carry": carry}), draws) for carry in ("means", "draws")}
    filters["sir"] = bb.kernels.sir(), sizes["particles"]
    figures = along(keys[1], densities, mixture, filters, sizes["runs"], sizes["long"])
    if case.pictures is not None:
        draw_along(case.pictures / "poon_fleet_2002_frames.png", figures)
    means = {name: {part: float(np.mean(figures[name][part])) for part in ("error", "variance")} for name in filters}
    return {
        "along_frames": {
            "variance of sir / hmc, means": means["sir"]["variance"] / means["hmc, means"]["variance"],
            "variance of sir / hmc, draws": means["sir"]["variance"] / means["hmc, draws"]["variance"],
            "error² of sir / hmc, means": means["sir"]["error"] / means["hmc, means"]["error"],
            "error² of sir / hmc, draws": means["sir"]["error"] / means["hmc, draws"]["error"],
        }
    }


def tracks(session: Session, name: str, particles: int, seed: int) -> tuple[Draws, Draws]:
    """Return tracks of a recording by the definition's own kernel, and by a particle filter."""
    model, key = bb.load_model(name, session, lambda line: None), jax.random.key(seed)
    return bb.track(key, session, model), bb.track(key, session, model, bb.kernels.sir(), particles=particles)


def error_mm(session: Session, draws: Draws) -> float:
    """Return the mean error of the markers of the mean body over all frames.

    Raises:
        InputError: the session has no truth.
    """
    against = draws_against_truth(session, draws)
    if against is None:
        raise no_truth(session)
    return 1000 * float(against.plain.frame_error.mean())


def legs(case: Case) -> Mapping[str, Values]:
    """Legs of a walker seen from the side (Fig. 6), with the paper's settings."""
    session = case.film("side_1", case.sizes["frames"])
    hmc, sir = tracks(session, "poon_fleet_2002_legs", case.sizes["particles"], case.seed)
    acceptance = float(np.mean([np.mean(frame.info.markov["acceptance"]) for frame in hmc.frames]))
    seconds = (hmc.timing.total - hmc.timing.compile) / len(hmc.frames)
    return {
        "legs": {"hmc": error_mm(session, hmc), "particle filter": error_mm(session, sir)},
        "rejection": {"rejected trajectories": 100 * (1 - acceptance)},
        "legs_seconds": {"hmc": seconds, "particle filter": (sir.timing.total - sir.timing.compile) / len(sir.frames)},
    }


def whole_body(case: Case) -> Mapping[str, Values]:
    """The whole body of a walker who comes nearer to one camera (Fig. 7), with the paper's settings."""
    session = case.film("room_4", case.sizes["frames"], cameras=1)
    hmc, sir = tracks(session, "poon_fleet_2002", case.sizes["particles"], case.seed)
    return {"whole_body": {"hmc": error_mm(session, hmc), "particle filter": error_mm(session, sir)}}


def densities(case: Case) -> Mapping[str, Values]:
    """Densities of amplitude and phase on the outlines of people (Fig. 3)."""
    definition = bb.load_definition("poon_fleet_2002_legs")
    options = definition.likelihoods[0].options
    if case.pictures is not None:
        draw_densities(case.pictures / "poon_fleet_2002_densities.png", options)
    return {"densities": {"standard deviation of the phase": PHASE_SD}}


# `before` is the number of particles of the track up to the frame.
ONE_FRAME = {"model": "legs_by_phase", "frame": 20, "components": 1, "before": 20_000}
QUICK_FRAME = {"frame": 2, "before": 500, "runs": 2, "truth": 1000, "long": 20, "starts": 1000}
EXPERIMENTS = (
    Experiment(
        ("variance_ratio", "truth", "more_computation"),
        variance,
        ONE_FRAME | {"draws": [2000, 6000, 18_000], "runs": 12, "truth": 400_000, "long": 3000, "starts": 200_000},
        QUICK_FRAME | {"draws": [50]},
        costly=True,
    ),
    Experiment(
        ("tempered_variance",),
        tempered_variance,
        ONE_FRAME | {"model": "poon_fleet_2002", "components": 10, "runs": 10, "truth": 400_000, "long": 600, "starts": 20_000},
        QUICK_FRAME,
        costly=True,
    ),
    Experiment(
        ("whole_body_variance",),
        whole_body_variance,
        ONE_FRAME | {"burn_in": 64, "leapfrog_steps": 15, "runs": 10, "truth": 100_000, "long": 1000, "starts": 4000},
        QUICK_FRAME | {"burn_in": 8, "leapfrog_steps": 2, "draws": 64},
        costly=True,
    ),
    Experiment(
        ("ten_mixtures",),
        ten_mixtures,
        {"model": MODEL, "frames": list(FRAMES)} | QUICK._asdict(),
        {"frames": [2, 3], "runs": 2, "truth": 1000, "long": 20, "groups": 4, "particles": 64},
        pairs=[(walk.name, walk.seed) for walk in WALKS],
    ),
    Experiment(("effective",), effective_particles, ONE_FRAME | {"particles": 20_000}, {"frame": 2, "before": 500, "particles": 2000}),
    Experiment(
        ("along_frames",),
        along_frames,
        ONE_FRAME | {"frames": 4, "draws": 2000, "particles": 60_000, "runs": 5, "long": 1600},
        {"frame": 2, "before": 500, "frames": 2, "draws": 100, "particles": 500, "runs": 2, "long": 100},
        costly=True,
    ),
    Experiment(("legs", "rejection", "legs_seconds"), legs, {"frames": 20, "particles": 20_000}, {"frames": 2, "particles": 500}),
    Experiment(("whole_body",), whole_body, {"frames": 20, "particles": 36_000}, {"frames": 2, "particles": 500}),
    Experiment(("densities",), densities, facts=True),
)

if __name__ == "__main__":
    reproduce("poon_fleet_2002", EXPERIMENTS)
