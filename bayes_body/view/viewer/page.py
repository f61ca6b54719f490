"""The page: viser's record of the scene as one HTML file, with a text beside it, so small that it can be mailed."""

from collections.abc import Iterator, Sequence
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import TYPE_CHECKING

from bayes_body.base.errors import input_error
from bayes_body.base.files.atomic import check_free, has_mark, make_folder, write_text
from bayes_body.base.progress import Watch, unwatched
from bayes_body.results.posterior.diagnostics import frame_ranges
from bayes_body.view.colours import KEYPOINTS, NAMES, TRUTH, Colour, over_image, side_of
from bayes_body.view.export.motion import lost_frames
from bayes_body.view.report.markup import Markup, joined, tag
from bayes_body.view.viewer.motion import LARGEST, Budget, read_poses
from bayes_body.view.viewer.recording import Recording, read_recording
from bayes_body.view.viewer.scene import Figure, Scene, deaf_server, look_at

if TYPE_CHECKING:
    from bayes_body.results.storage.saved_run import SavedRun

FILE_NAME = "view.html"
# What tells a view from other files (`has_mark`).
MARK = b'<meta name="generator" content="bayes-body view">'
# Nothing may be loaded from anywhere. viser's page runs WebAssembly, which makes functions from texts, and shows images from blobs.
POLICY = (
    "default-src 'none'; script-src 'unsafe-inline' 'unsafe-eval'; style-src 'unsafe-inline'; img-src data: blob:; font-src data:; "
    "connect-src data: blob:; worker-src blob:"
)
CONTROLS = (
    "Drag to turn, drag with the right button to move, turn the wheel to zoom. The space bar plays and stops. The button at the lower right lists "
    "the layers: a click on an eye hides or shows one."
)
SEEKER = "There are no draws: the spread of a mode seeker's particles is not a measure of uncertainty."
MEDOID = (
    "In {count} of {frames} frames the mean is not among the draws, because the posterior has several modes or few draws. There the body is the draw "
    "in their middle, the medoid, and the label of the time says so."
)
UNREADABLE = "the page that viser makes"


def write_view(
    run: "SavedRun",
    out: Path | None = None,
    draws: int = 50,
    frames: range | None = None,
    watch: Watch = unwatched,
    overwrite: bool = False,
) -> tuple[Path, list[str]]:
    """Write the 3D scene of a run: one HTML file that opens without a network. Return its path, and sentences on what it does not show.

    Args:
        run: the run, loaded from its folder.
        out: the file; `view.html` in the run's folder by default.
        draws: number of draws of each frame.
        frames: the frames, counted from 0; all by default. If the file would be too large, every second, third, ... of them is shown.
        watch: wraps the places of the frames to show progress.
        overwrite: whether to replace a file that is not a view. An older view is always replaced.

    Raises:
        InputError: the file exists and is not a view, it cannot be written, or a file of the run or its recording cannot be used.
    """
    path = out or run.folder / FILE_NAME
    check_free(path, overwrite or has_mark(path, MARK))
    draws, frames = 0 if run.mode_seeker else draws, range(run.frames) if frames is None else frames
    recording, parts = read_recording(run), len(run.model.body.topology.names)
    budget = Budget(draws * parts, sum(recording.pictured))
    step = budget.step(len(frames))
    while True:
        shown = frames[::step]
        remarks = [*lost_sentence(run, frames), *_thinned(run, frames, step), *([SEEKER] if run.mode_seeker else []), *recording.missing]
        page = _page(run, recording, shown, draws, budget.side(len(shown)), remarks, watch)
        if len(page.encode()) < LARGEST or len(shown) == 1:
            break
        step *= 2
    make_folder(path.parent)
    write_text(path, page)
    return path, remarks


def lost_sentence(run: "SavedRun", frames: range) -> Iterator[str]:
    """Yield a sentence that names the lost frames, if there are any."""
    lost = lost_frames(run)
    if lost[frames].any():
        yield f"{frame_ranges([run.first_frame + frame for frame in frames if lost[frame]]).capitalize()}: lost, or the body is off the person."


def _thinned(run: "SavedRun", frames: range, step: int) -> Iterator[str]:
    if step > 1:
        first = run.first_frame + frames.start
        part = f"{first}-{first + max(len(frames) // step, 1) - 1}"
        yield (
            f"One frame in {step} of {len(frames):,} is shown, so that the file stays small. Fewer draws leave room for more frames. "
            f"A part of the recording has all its frames: --frames {part}, for one."
        )


def _page(run: "SavedRun", recording: Recording, frames: range, draws: int, side: int, remarks: Sequence[str], watch: Watch) -> str:
    """Return the page's HTML."""
    body, fps, up = run.settled_model.body, run.fps, run.session.up
    # The first look needs the whole path. The budget keeps all of this small.
    poses = list(read_poses(run, frames, draws))
    figure = Figure(body)
    with deaf_server() as server:
        scene = Scene(server.scene, up, look := look_at(poses, [view.camera for view in recording.session.views], up))
        camera = server.initial_camera
        camera.position, camera.look_at, camera.fov = look.eye, look.middle, look.fov
        record = server.get_scene_serializer()
        has_truth = has_keypoints = False
        for place in watch(range(len(frames))):
            evidence = recording.frame(frames[place], side)
            has_truth, has_keypoints = has_truth or bool(len(evidence.truth)), has_keypoints or bool(len(evidence.keypoints))
            medoid_note = "" if poses[place].is_mean else ", medoid"
            scene.show([(figure, poses[place])], evidence, f"frame {run.first_frame + frames[place]}, {frames[place] / fps:.2f} s{medoid_note}")
            if len(frames) > 1:
                record.insert_sleep(frames.step / fps)
        html = record.as_html()
    medoids = sum(not pose.is_mean for pose in poses)
    sentences = [MEDOID.format(count=medoids, frames=len(poses))] if medoids else []
    text = _text(run, draws, has_truth, has_keypoints, [*sentences, *remarks])
    return filled(html, f"{run.folder.resolve().name} in 3D", text)


def _text(run: "SavedRun", draws: int, has_truth: bool, has_keypoints: bool, remarks: Sequence[str]) -> Markup:
    sides = {side_of(name): over_image(name) for name in run.model.body.topology.names}
    layers = [
        *(tag("li", dot(sides[side]), f"mean body, {name}{' side' if side else ''}") for side, name in NAMES.items() if side in sides),
        *([tag("li", f"Lines: {draws} draws from the posterior of each frame. A line is the axis of a part.")] if draws else []),
        *([tag("li", dot(TRUTH), "true markers")] if has_truth else []),
        *([tag("li", dot(KEYPOINTS), "keypoints, triangulated")] if has_keypoints else []),
    ]
    made = f"{run.session.title}: model {run.settings['model']}, kernel {run.kernel['kind']}"
    axes = "World axes: x red, y green, z blue. Tiles of the floor: 1 m."
    return joined([tag("p", made), tag("ul", *layers, tag("li", axes)), *(tag("p", remark) for remark in remarks), tag("p", CONTROLS, class_="soft")])


def dot(ink: Colour) -> Markup:
    """Return a disc of a colour."""
    return tag("i", style=f"background: rgb{ink}")


def filled(html: str, title: str, text: Markup) -> str:
    """Return viser's page with its mark, its policy and its title at the top, and the text at the end.

    Raises:
        InputError: viser's page has another form.
    """
    policy = tag("meta", content=POLICY, **{"http-equiv": "Content-Security-Policy"}).removesuffix("</meta>")
    head = f"<head>\n{MARK.decode()}\n{policy}"
    template = Template(files(__package__).joinpath("page.html").read_text(encoding="utf-8"))
    beside = template.substitute(title=joined([title]), text=text)
    for old, new in (("<head>", head), ("<title>Viser</title>", tag("title", title)), ("</body>", f"{beside}</body>")):
        start, separator, end = html.partition(old) if old != "</body>" else html.rpartition(old)
        if not separator:
            raise input_error(UNREADABLE, f"no {old}", "a page of viser 1.1", "install the version of viser that bayes-body asks for")
        html = f"{start}{new}{end}"
    return html
