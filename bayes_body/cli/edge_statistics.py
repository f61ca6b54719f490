"""`bayes-body learn edge-statistics`: statistics of filter responses on a person's boundary, from recordings with known silhouettes."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from bayes_body.base.errors import input_error
from bayes_body.cli.terminal import say
from bayes_body.cli.track import check_range

if TYPE_CHECKING:
    from bayes_body.model.likelihood.edge_phase import EdgeStatistics
    from bayes_body.workshop.learning.edge_statistics import Images

WAVELENGTHS = "8,16"
DISPLACED_PX = (0.0, 2.0, 5.0, 10.0)


def edge_statistics(
    sessions: list[Path] = typer.Argument(
        help="Recordings with reliable silhouettes: from `bayes-body simulate --masks`, or masks that you have checked."
    ),
    wavelengths: str = typer.Option(WAVELENGTHS, "--wavelengths", help="Wavelengths of the filters in pixels, separated by commas."),
    frames: int = typer.Option(5, "--frames", help="Number of evenly spaced frames of each recording."),
    held_out: list[Path] = typer.Option(
        [], "--held-out", help="A recording that is only used for the comparison, not for learning; may be given several times."
    ),
    plot: Path | None = typer.Option(None, "--plot", help="A .png of the learned densities over the data."),
) -> None:
    """Learn the `likelihood.scale` tables of `edge_phase`, and print them."""
    from bayes_body.base.config import configure

    configure()
    from bayes_body.base.progress import waiting
    from bayes_body.workshop.learning.edge_statistics import fit, mean_log_density

    check_range("--frames", frames, 1)
    tried = _numbers(wavelengths)
    with waiting("images"):
        images, others = _images(sessions, frames), _images(held_out, frames) if held_out else None
    asked, learned, compared = (*DISPLACED_PX, None), [], []
    for wavelength in tried:
        with waiting(f"wavelength {wavelength:g} px"):
            responses = images.at(wavelength, asked)
            learned.append((wavelength, fit(responses[0], responses[-1]), responses[0]))
            compared.append([mean_log_density(response, learned[-1][1]) for response in (others.at(wavelength, asked) if others else responses)])
    say("\n".join(_table(wavelength, statistics) for wavelength, statistics, _ in learned))
    whose = "held-out recordings" if others else "training recordings"
    say(f"# mean log-density per sample, nats, on the {whose}: on boundaries displaced by ... px, and elsewhere")
    say("# wavelength px " + "".join(f"{by:8g}" for by in DISPLACED_PX) + "   elsewhere")
    for (wavelength, *_), values in zip(learned, compared, strict=True):
        say(f"# {wavelength:13g} " + "".join(f"{value:8.2f}" for value in values[:-1]) + f"{values[-1]:12.2f}")
    if plot is not None:
        from bayes_body.view.edge_plot import draw_edge_statistics

        draw_edge_statistics(plot, learned)
        say(f"# {plot}")


def _table(wavelength: float, statistics: "EdgeStatistics") -> str:
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


def _images(sessions: list[Path], frames: int) -> "Images":
    """Return the images of some frames whose silhouettes are known."""
    from bayes_body.recording.session.read import load_session
    from bayes_body.workshop.learning.edge_statistics import Images, known_pairs
    from bayes_body.workshop.simulation.film import TRUE_MASKS, mask_pattern

    pairs = []
    for path in sessions:
        session = load_session(path)
        recording_pairs = known_pairs(session, frames, lambda name: mask_pattern(TRUE_MASKS, name))
        if not recording_pairs:
            raise input_error(
                path, "no known silhouettes", f"a folder {TRUE_MASKS}, or masks", "simulate with --masks, or give cameras their `masks`"
            )
        pairs += recording_pairs
    return Images(pairs)


def _numbers(text: str) -> list[float]:
    """Return the wavelengths, ascending."""
    try:
        wavelengths = sorted({float(word) for word in text.split(",")})
    except ValueError:
        wavelengths = []
    if not wavelengths or not all(3 <= value < float("inf") for value in wavelengths):
        raise input_error("--wavelengths", repr(text), "numbers from 3 up, separated by commas", f"give for example {WAVELENGTHS}")
    return wavelengths
