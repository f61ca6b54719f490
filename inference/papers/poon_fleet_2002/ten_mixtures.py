"""Measure the headline of Poon & Fleet 2002 (Fig. 8) on ten prediction mixtures: five walks, and two frames of each.

    python inference/papers/poon_fleet_2002/ten_mixtures.py --mocap CMU --out WALKS --json ten.json --plot ten.png

For each mixture: how much larger error² of the particle filter's means is than that of the hybrid Monte Carlo filter's, at equal evaluations of the
likelihood. CMU is a folder with 07/07_01.amc and the like. Each mixture is written to the file of figures when it is measured. The same command
after an interruption measures only the missing ones.
"""

import argparse
import json
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
from equal_computation import at_equal_computation, figures_of, mixture_after
from five_walks import WALKS, Walk, chosen, filmed
from ten_plot import draw_mixtures
from true_mean import LARGEST_NOISE, LARGEST_RHAT, Truth, best_truth, true_mean_by_tempering

import bayes_body as bb
from bayes_body.base.errors import InputError, input_error
from bayes_body.base.files.atomic import replacing
from bayes_body.base.shapes import Key
from bayes_body.density.density import Density

# Particles that track a walk up to the frames.
MODEL, TRACKED = "legs_by_phase", 5000
# The frames after the mixtures, and the number of frames of a film.
FRAMES, LENGTH = (10, 20), 22
# Of a gradient, in evaluations: 1.2 to 2.3 on two busy cores. More favours the particle filter, which gets as many particles more.
COST = 2.0


class Sizes(NamedTuple):
    """How much is computed for a mixture.

    Attributes:
        runs: runs of each sampler.
        truth: particles of each run of the true mean.
        long: draws of each of its chains.
        groups: runs of tempered SMC, if those chains disagree.
        particles: particles of each.
    """

    runs: int
    truth: int
    long: int
    groups: int
    particles: int


class Study(NamedTuple):
    """What is common to all mixtures.

    Attributes:
        model: a definition's name or path, whose kernel is `hmc`.
        components: of a mixture.
        gradient_cost: cost of a gradient, in evaluations of the likelihood.
        seed: of the samplers; a walk adds its own.
        walks: folder for the filmed walks.
        mocap: folder with captured walks; None: only the cycle that ships.
    """

    model: str
    components: int
    gradient_cost: float
    seed: int
    walks: Path
    mocap: Path | None


FULL, QUICK = Sizes(50, 4_000_000, 6000, 24, 4096), Sizes(10, 50_000, 1000, 12, 2048)


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Estimator variance of hybrid Monte Carlo and of a particle filter after ten mixtures.")
    parser.add_argument("--out", type=Path, required=True, help="folder for the filmed walks")
    parser.add_argument("--json", type=Path, required=True, help="file for all figures; mixtures that it holds are not measured again")
    parser.add_argument("--plot", type=Path, help="a .png with the ratios of all mixtures")
    parser.add_argument("--mocap", type=Path, default=_mocap(), help="folder with walks of the CMU database (BAYES_BODY_DATA/cmu_mocap)")
    parser.add_argument("--model", default=MODEL, help="a definition's name or the path of your own (%(default)s)")
    parser.add_argument("--walks", nargs="+", choices=[walk.name for walk in WALKS], help="only these walks")
    parser.add_argument("--frames", nargs="+", type=bb.whole_number(1), default=list(FRAMES), help="frames of each walk, counted from 0 (10 20)")
    parser.add_argument("--components", type=bb.whole_number(1), default=1, help="components of a mixture (%(default)s)")
    parser.add_argument("--runs", type=bb.whole_number(2), help=f"runs of each sampler ({FULL.runs}; {QUICK.runs} with --quick)")
    parser.add_argument("--gradient-cost", type=float, default=COST, help="cost of a gradient, in evaluations of the likelihood (%(default)s)")
    parser.add_argument("--seed", type=bb.whole_number(0), default=0, help="random seed (%(default)s)")
    parser.add_argument("--quick", action="store_true", help="fewer runs, and a rougher true mean")
    return parser.parse_args()


def _mocap() -> Path | None:
    data = os.environ.get("BAYES_BODY_DATA")
    return Path(data) / "cmu_mocap" if data else None


def main() -> None:
    arguments = parse()
    bb.configure()
    sizes = QUICK if arguments.quick else FULL
    sizes = sizes._replace(runs=arguments.runs or sizes.runs)
    study = Study(arguments.model, arguments.components, arguments.gradient_cost, arguments.seed, arguments.out, arguments.mocap)
    settings = sizes._asdict() | {name: getattr(study, name) for name in ("model", "components", "gradient_cost", "seed")}
    rows = finished(arguments.json, settings)
    done = {(row["walk"], row["frame"]) for row in rows}
    for walk in chosen(arguments.walks):
        frames = [frame for frame in arguments.frames if (walk.name, frame) not in done]
        for row in measured(walk, frames, study, sizes) if frames else ():
            rows.append(row)
            save(arguments, settings, rows)
    print(table(rows))
    if arguments.plot:
        draw_mixtures(arguments.plot, rows)


def finished(path: Path, settings: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the mixtures that a file of figures holds.

    Raises:
        InputError: it is no such file, or its mixtures were measured with other settings.
    """
    if not path.exists():
        return []
    try:
        stored = json.loads(path.read_text(encoding="utf-8"))
        rows, old = stored["mixtures"], stored["settings"]
    except (json.JSONDecodeError, UnicodeDecodeError, KeyError, TypeError):
        raise input_error(path, "not a file of this program", "a new file, or one that this program has written", "name another --json") from None
    changed = [f"{name} = {old.get(name)}" for name, value in settings.items() if old.get(name) != value]
    if changed:
        raise input_error(path, f"measured with {', '.join(changed)}", "the settings of this run", "name another --json, or use those settings")
    return rows


def measured(walk: Walk, frames: Sequence[int], study: Study, sizes: Sizes, length: int = LENGTH) -> Iterator[dict[str, Any]]:
    """Yield the rows of a walk's mixtures. It is tracked once, up to the last of the frames.

    Args:
        walk: the walk.
        frames: the frames before which the mixtures are.
        study: what is common to all mixtures.
        sizes: how much is computed.
        length: least number of frames of the film.

    Raises:
        InputError: the walk cannot be filmed, or the model cannot track it.
    """
    session = filmed(walk, study.walks, study.mocap, max(length, max(frames) + 2), bb.watched(f"filming {walk.name}"))
    model = bb.load_model(study.model, session)
    if model.definition.kernel.kind != "hmc":
        raise input_error(study.model, f'the kernel is "{model.definition.kernel.kind}"', 'a model whose kernel is "hmc"', "name another --model")
    options, key = model.definition.kernel.options.model_dump(), jax.random.fold_in(jax.random.key(study.seed), walk.seed)
    before = bb.track(key, session, model, bb.kernels.sir(), particles=TRACKED, frames=max(frames))
    for frame in frames:
        print(f"walk {walk.name}, frame {frame}", file=sys.stderr, flush=True)
        keys = jax.random.split(jax.random.fold_in(key, frame), 3)
        mixture = mixture_after(keys[0], before, study.components, frame - 1)
        density = model.density(model.observe(bb.read_frame(session, frame)), mixture)
        equal = at_equal_computation(keys[1], density, options, options["particles"], sizes.runs, True, study.gradient_cost)
        truth, figures = _known_truth(keys[2], density, sizes, partial(figures_of, model.body.dof_names, equal))
        yield row_of(walk, frame, figures) | {"truth_sd": truth.sd.tolist()}


def _known_truth(key: Key, density: Density, sizes: Sizes, judge: Callable[[Truth], dict[str, Any]]) -> tuple[Truth, dict[str, Any]]:
    """Return the truth by particles or by long chains, or by tempered SMC if long chains disagree; and the figures with it."""
    keys = jax.random.split(key)
    truth = best_truth(keys[0], density, sizes.truth, sizes.long, True)
    figures = judge(truth)
    # Chains that agree but are too short need more draws, not other starts.
    if truth.converged:
        return truth, figures
    tempered = true_mean_by_tempering(keys[1], density, sizes.particles, sizes.groups, bb.watched("runs of tempered SMC"))
    best = tempered if tempered.converged else max(truth, tempered, key=lambda estimate: estimate.effective)
    return best, judge(best) | {"first_truth": figures["settings"]}


def is_truth_known(settings: Mapping[str, Any]) -> bool:
    """Whether the true mean is known well enough: its chains agree, and its noise is small beside the errors."""
    return settings["truth_converged"] and settings["truth_noise"] <= LARGEST_NOISE


def row_of(walk: Walk, frame: int, figures: Mapping[str, Any]) -> dict[str, Any]:
    """Return a mixture's figures: the ratio's median and worst dof, and how well the truth is known."""
    worst = min(figures["per_dof"], key=lambda dof: figures["per_dof"][dof][0])
    ratio, low, high = figures["per_dof"][worst]
    return {
        "walk": walk.name,
        "held_out": walk.held_out,
        "frame": frame,
        "ratio_median": figures["ratio_median"],
        "ratio_interval": list(figures["ratio_interval"]),
        "worst_dof": worst,
        "worst_ratio": ratio,
        "worst_interval": [low, high],
        "truth_known": is_truth_known(figures["settings"]),
        **figures,
    }


def save(arguments: argparse.Namespace, settings: Mapping[str, Any], rows: Sequence[Mapping[str, Any]]) -> None:
    with replacing(arguments.json) as partial:
        partial.write_text(json.dumps({"settings": settings, "mixtures": rows}, indent=2, default=str) + "\n", encoding="utf-8")


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return the rows as a table, and what they say together."""
    lines = ["walk    frame  median ratio (95 %)      worst dof (95 %)                        truth by   R-hat  noise  known"]
    for row in rows:
        (low, high), (worst_low, worst_high), settings = row["ratio_interval"], row["worst_interval"], row["settings"]
        median, worst = f"{row['ratio_median']:.3g} ({low:.3g}-{high:.3g})", f"{row['worst_ratio']:.3g} ({worst_low:.3g}-{worst_high:.3g})"
        name = row["walk"] + ("*" if row["held_out"] else "")
        truth = f"{settings['truth_by']:<10} {settings['truth_rhat']:<6.3f} {settings['truth_noise']:<6.1%}"
        lines.append(f"{name:<8}{row['frame']:<7}{median:<25}{row['worst_dof'] + ' ' + worst:<40}{truth} {'yes' if row['truth_known'] else 'no'}")
    sure = [row for row in rows if row["truth_known"]]
    lines += ["* nothing was learned from this walk or tuned on it", f"the truth is known in {len(sure)} of {len(rows)}: {_criterion()}"]
    if sure:
        medians, worst = sorted(row["ratio_median"] for row in sure), min(row["worst_ratio"] for row in sure)
        lines.append(f"there the median ratio is {medians[0]:.3g} to {medians[-1]:.3g}, and the worst dof's {worst:.3g}")
    return "\n".join(lines)


def _criterion() -> str:
    return f"R-hat at most {LARGEST_RHAT}, and the variance of a run at most {LARGEST_NOISE:.0%} of hmc's error²"


if __name__ == "__main__":
    try:
        main()
    except (InputError, OSError) as error:
        print(error, file=sys.stderr)
        sys.exit(2)
