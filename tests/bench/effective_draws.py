"""Independent draws a second of each posterior sampler on the real recording: `python tests/bench/effective_draws.py [--json F]`.

A particle's weight does not tell that particles share ancestors: what counts here is the spread of independent runs' means against the posterior's
own variance, in the last frame, by dof: n = variance / Var(mean). Sharper likelihoods (a larger `precision`) are harder for the prediction to hit.
"""

import argparse
import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import bayes_body as bb

bb.configure()

import jax  # noqa: E402
import numpy as np  # noqa: E402
from case import recording  # noqa: E402

from bayes_body.base.registry import find  # noqa: E402
from bayes_body.model.definition import Definition, load_definition  # noqa: E402
from bayes_body.tracking.track import Draws, track  # noqa: E402

# What, kernel, options, particles.
SAMPLERS: tuple[tuple[str, str, dict[str, Any], int], ...] = (
    ("sir", "sir", {}, 20_000),
    ("tempered, HMC", "tempered", {}, 1000),
    ("tempered, HMC, waste-free", "tempered", {"waste_free": True, "moves": 4}, 2000),
    ("tempered, random walk", "tempered", {"move": "random_walk", "moves": 20}, 1000),
)


def sharpened(definition: Definition, precision: float) -> Definition:
    (term,) = definition.likelihoods
    return replace(definition, likelihoods=(replace(term, options=term.options.model_copy(update={"precision": precision})),))


def independent_draws(draws: Draws) -> tuple[float, float]:
    """Median and least over the dofs of the last frame."""
    log_weights, states = (np.asarray(values, float) for values in (draws.log_weights[:, -1], draws.states["pose"][:, -1]))
    weights = np.exp(log_weights - log_weights.max(axis=1, keepdims=True))[..., None]
    weights /= weights.sum(axis=1, keepdims=True)
    means = (weights * states).sum(axis=1)
    variance = (weights * (states - means[:, None]) ** 2).sum(axis=1).mean(axis=0) + means.var(axis=0)
    number = variance / means.var(axis=0, ddof=1)
    return float(np.median(number)), float(number.min())


def figures(what: str, precision: float, draws: Draws) -> Mapping[str, Any]:
    runs, frames = np.shape(draws.info.ess)
    seconds = (draws.timing.total - draws.timing.compile) / frames / runs
    median, least = independent_draws(draws)
    evidence = np.asarray(draws.info.log_evidence, float).sum(axis=1)
    return {
        "precision": precision,
        "sampler": what,
        "seconds_a_frame": seconds,
        "independent_draws": median,
        "independent_draws_least": least,
        "independent_draws_a_second": median / seconds,
        "particle_ess_least": float(np.min(draws.info.ess)),
        "log_evidence_sd": float(evidence.std(ddof=1)),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--precisions", type=float, nargs="+", default=[30.0, 100.0, 300.0, 1000.0])
    parser.add_argument("--runs", type=int, default=8)
    parser.add_argument("--json", type=Path, help="write the figures there, too")
    options = parser.parse_args()
    session, rows = recording(), []
    print(f"{'precision':>9} {'':28} {'s/frame':>8} {'draws':>7} {'least':>6} {'draws/s':>8} {'least ESS':>9} {'sd log Z':>8}")
    for precision in options.precisions:
        model = bb.load_model(sharpened(load_definition("silhouettes"), precision), session)
        for what, kind, given, particles in SAMPLERS:
            term = find("kernel", kind)
            kernel = term.build(options=term.options(**given))
            row = figures(what, precision, track(jax.random.key(0), session, model, kernel, particles=particles, runs=options.runs))
            rows.append(row)
            print("{:9.0f} {:28} {:8.3f} {:7.1f} {:6.1f} {:8.1f} {:9.0f} {:8.2f}".format(*_in_order(row)), flush=True)
    if options.json:
        options.json.write_text(json.dumps(rows, indent=2))


def _in_order(row: Mapping[str, Any]) -> list[Any]:
    keys = ("precision", "sampler", "seconds_a_frame", "independent_draws", "independent_draws_least", "independent_draws_a_second")
    return [row[key] for key in (*keys, "particle_ess_least", "log_evidence_sd")]


if __name__ == "__main__":
    main()
