"""`bayes-body learn smooth-motion`: standard deviations of the motion prior `constant_velocity`, from captured motion."""

from pathlib import Path

import typer

from bayes_body.cli.learned_files import motion_files
from bayes_body.cli.terminal import say


def smooth_motion(
    motions: list[Path] = typer.Argument(help="Captured motions, or folders of them, one folder a person."),
    body: str = typer.Option("sidenbladh_25", "--body", help="The body that follows the motion: its name or the path of your own .toml file."),
) -> None:
    """Learn the standard deviations of `constant_velocity`, and print its tables."""
    from bayes_body.base.config import configure

    configure()
    import math

    from bayes_body.base.progress import watched
    from bayes_body.model.definition import load_body
    from bayes_body.recording.readers.mocap import read_motion
    from bayes_body.workshop.learning.smooth_motion import FPS, smooth_noise, track_of

    schema = load_body(body)
    files = [file for path in motions for file in motion_files(path)]
    tracks = [track_of(files[k].resolve().parent.name, read_motion(files[k]), body, schema) for k in watched("retargeting")(range(len(files)))]
    noise = smooth_noise(tracks, body, schema)
    say(f"at_fps = {FPS:g}")
    for name, values in (("sd", noise.pose), ("velocity_sd", noise.velocity)):
        for unit, ending, factor in (("m", "m", 1.0), ("rad", "deg", math.degrees(1.0))):
            rows = [f'"{pattern}" = {factor * value:.2g}' for pattern, value in values.items() if noise.units[pattern] == unit]
            say("\n".join(["", f"[dynamics.{name}_{ending}]", *rows]))
