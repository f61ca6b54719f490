"""`bayes-body picture`: write a picture of a run for a paper."""

import re
from pathlib import Path

import typer

from bayes_body.base.errors import input_error
from bayes_body.cli.plugin_option import Plugins, own_terms
from bayes_body.cli.terminal import say

SIZES, MOST_DRAWS = (200, 10_000), 1000


def picture(
    run: Path = typer.Argument(help="Folder of a run made by `bayes-body track`."),
    frame: int | None = typer.Option(None, "--frame", help="Number of the frame in the recording; by default the run's first."),
    camera: str | None = typer.Option(None, "--camera", help="Name of the camera; the first one by default."),
    curves: str | None = typer.Option(None, "--curves", help="Curves over time instead: angles such as l_knee,r_knee, or knee for both sides."),
    size: int = typer.Option(2000, "--size", help=f"Longer side of a .png, pixels, {SIZES[0]} to {SIZES[1]}."),
    draws: int = typer.Option(40, "--draws", help=f"Draws from the posterior, 0 to {MOST_DRAWS}."),
    whole_image: bool = typer.Option(False, "--whole", help="Show the whole image, not only the person's part of it."),
    svg: bool = typer.Option(False, "--svg", help="Write .svg, in which bodies and text are vectors."),
    out: Path | None = typer.Option(None, "--out", help="The file: .png, .svg or .pdf; in the run's folder by default."),
    overwrite: bool = typer.Option(False, "--overwrite", help="Replace an existing file that --out names."),
    plugin: Plugins = None,
) -> None:
    """Write the posterior of one frame over a camera's image, with legend, scale and name; or curves of angles with their 90 % bands."""
    from bayes_body.base.config import configure

    configure()
    from bayes_body.base.files.atomic import check_free
    from bayes_body.results.storage.run_file import check_plugins
    from bayes_body.results.storage.saved_run import load_run
    from bayes_body.view.picture import write_curves, write_picture
    from bayes_body.view.picture.frame import check_format

    if not SIZES[0] <= size <= SIZES[1]:
        raise input_error("--size", f"{size}", f"{SIZES[0]} to {SIZES[1]} pixels", "give another number")
    if not 0 <= draws <= MOST_DRAWS:
        raise input_error("--draws", f"{draws}", f"a number from 0 to {MOST_DRAWS}", "give another number")
    if svg and out is not None and out.suffix.lower() != ".svg":
        raise input_error("--svg", f"with --out {out}", "a file with the suffix .svg", "leave one of them out")
    if curves is not None and (frame is not None or camera is not None or whole_image):
        raise input_error("--curves", "with --frame, --camera or --whole", "curves of all frames, or a picture of one", "make two pictures")
    if out is not None:
        check_format(out)
        check_free(out, overwrite)
    with own_terms(plugin), load_run(run) as saved:
        check_plugins(saved.folder, saved.plugins)
        if curves is not None:
            path = out or saved.folder / f"curves.{'svg' if svg else 'pdf'}"
            write_curves(saved, path, [name.strip() for name in curves.split(",") if name.strip()], size)
        else:
            shown = saved.session.views[0].camera.name if camera is None else camera
            number = saved.first_frame if frame is None else frame
            path = out or saved.folder / f"picture_{re.sub(r'[^A-Za-z0-9.-]', '_', shown)}_{number:06d}.{'svg' if svg else 'png'}"
            write_picture(saved, path, frame, camera, size, draws, whole_image)
    say(f"{path}: {path.stat().st_size / 1e6:.1f} MB.")
