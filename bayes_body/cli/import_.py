"""`bayes-body import`: make a session from a laboratory's files. A laboratory has a verb; the verbs share their options and one body."""

import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from bayes_body.base.errors import input_error
from bayes_body.cli.terminal import say
from bayes_body.recording.readers.file_names import composed

if TYPE_CHECKING:
    from bayes_body.recording.readers.options import Options
    from bayes_body.recording.session.session import Session

DEFAULT_MODEL = "deutscher_2005"

Target = Annotated[Path, typer.Argument(help="Folder to write session.toml and check.png into.", show_default=False)]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace an existing session.toml, including your edits in it.")]
Videos = Annotated[Path | None, typer.Option("--videos", help="Folder with CAMERA.mp4 or CAMERA/ of images, if it is not the usual one.")]
Masks = Annotated[Path | None, typer.Option("--masks", help="Folder with silhouettes in CAMERA/, numbered like the frames.")]
Background = Annotated[Path | None, typer.Option("--background", help="Folder with CAMERA.mp4, .png ... of the empty scene.")]
Truth = Annotated[Path | None, typer.Option("--truth", help="An .npz with true `markers` (frame, 15, 3), metres, and their `names`.")]
Keypoints = Annotated[
    Path | None,
    typer.Option(
        "--keypoints",
        help="Folder with OpenPose's files in CAMERA_json/, numbered like the frames, or a file of AlphaPose, MMPose, DeepLabCut or SLEAP for each "
        "camera, whose name begins with the camera's.",
    ),
]
KeypointsFirst = Annotated[
    list[str] | None,
    typer.Option(
        "--keypoints-first",
        metavar="[CAMERA=]NUMBER",
        help="Number of the keypoints that belong to the first recorded frame, if they are not numbered like the frames; may be repeated.",
    ),
]
KeypointsUnit = Annotated[
    str | None,
    typer.Option("--keypoints-unit", help="Unit of the keypoints: px, or share of the image's sides (0 to 1); pixels by default."),
]
Layout = Annotated[
    str | None,
    typer.Option("--layout", help="Order of the keypoints: BODY_25, BODY_25B, COCO_17, COCO_18, HALPE_26 or COCO_133; detected by default."),
]
Height = Annotated[float | None, typer.Option("--height", help="The subject's height, metres.")]
Model = Annotated[str, typer.Option("--model", help="Definition whose body is drawn in check.png.")]
Fps = Annotated[float | None, typer.Option("--fps", help="Frames a second, if the recording does not state it or is wrong.")]
Offset = Annotated[
    list[str] | None,
    typer.Option("--offset", metavar="CAMERA=FRAMES", help="Frame k + FRAMES of this camera is frame k of the others; may be repeated."),
]
FirstFrame = Annotated[
    int | None, typer.Option("--first-frame", help="Number of the first frame to import, as in the file names; in a video they count from 0.")
]
Frames = Annotated[int | None, typer.Option("--frames", help="Number of frames to import from the first on; all by default.")]
Rig = Annotated[
    list[str] | None,
    typer.Option(
        "--rig",
        metavar="[CAMERA=]CHANGE",
        help="Change the calibration of a camera, or of all: inverted, centres, transposed, opengl, inverted_opengl, opengl_centres, turned_90, "
        "turned_180, turned_270, exchanged_centre, half_size, double_size, scaled, distortion_64, or as_given; may be repeated.",
    ),
]
NoLengths = Annotated[bool, typer.Option("--no-lengths", help="Do not measure the lengths of the limbs on the keypoints of two or more cameras.")]
Resample = Annotated[bool, typer.Option("--resample", help="Pair the frames of videos of different rates by time, at the slowest rate.")]
Unit = Annotated[str | None, typer.Option("--unit", help="Unit of the calibration's translations: m, cm, mm or in (inches).")]
Up = Annotated[str | None, typer.Option("--up", help="The axis of the calibration's world that points up: x, y or z.")]


class Laboratory(NamedTuple):
    """What the list of verbs, a verb's help and the help of its SOURCE say, and the options that it does not have."""

    line: str
    help: str
    source: str
    omitted_options: tuple[str, ...] = ()


# The reader of a verb is `import_VERB` in `recording/readers/VERB.py`.
LABORATORIES = {
    "parsec": Laboratory(
        "A recording of PARSEC's bodytrack.",
        "Import cameras, images, masks, body shape and initial pose of the PARSEC suite's bodytrack.",
        "Folder of the PARSEC suite's bodytrack: CALIB, CAM1.., FG1.., BodyShapeParameters.txt, InitialPose.txt.",
        # It has the body's measures.
        omitted_options=("unit", "up", "no_lengths", "videos", "resample"),
    ),
    "pose2sim": Laboratory(
        "A Pose2Sim project: videos or images, and keypoints.",
        "Import a Pose2Sim project: cameras, videos or images, and keypoints if there are any.",
        "A Pose2Sim project: calibration/*.toml, *.qca.txt or *.xcp, videos/CAMERA.mp4, pose/CAMERA_json.",
    ),
    "opencv": Laboratory(
        "Cameras calibrated with OpenCV, EasyMocap or Anipose.",
        "Import cameras calibrated with OpenCV, EasyMocap or Anipose, and their videos or images; --unit and --up must be given.",
        "Folder with CAMERA.yml (xml, json) of each camera, or intri.yml and extri.yml, or Anipose's toml; and CAMERA.mp4 or CAMERA/.",
    ),
    "qualisys": Laboratory(
        "Video cameras of Qualisys Track Manager.",
        "Import video cameras of Qualisys Track Manager; z points up unless --up gives another axis.",
        "Folder with one *.qca.txt (or xml) of Qualisys Track Manager, and a video of each camera.",
        omitted_options=("unit",),
    ),
    "vicon": Laboratory(
        "Video cameras of Vicon.",
        "Import video cameras of Vicon; z points up unless --up gives another axis.",
        "Folder with one *.xcp of Vicon, and a video of each camera.",
        omitted_options=("unit",),
    ),
}


def _import(
    verb: str,
    source: Path,
    session: Target,
    overwrite: Overwrite = False,
    videos: Videos = None,
    masks: Masks = None,
    background: Background = None,
    truth: Truth = None,
    keypoints: Keypoints = None,
    layout: Layout = None,
    keypoints_first: KeypointsFirst = None,
    keypoints_unit: KeypointsUnit = None,
    height: Height = None,
    model: Model = DEFAULT_MODEL,
    fps: Fps = None,
    offset: Offset = None,
    first_frame: FirstFrame = None,
    frames: Frames = None,
    unit: Unit = None,
    up: Up = None,
    no_lengths: NoLengths = False,
    rig: Rig = None,
    resample: Resample = False,
) -> None:
    """Import a recording, print the remarks, and draw the picture for checking the session."""
    from bayes_body.base.config import configure
    from bayes_body.cli.models import checked_definition
    from bayes_body.recording.readers.options import Options
    from bayes_body.recording.session.read import FILE_NAME

    offsets = _numbers_by_camera("--offset", offset, "CAMERA=FRAMES, such as cam02=3", needs_camera=True)
    starts = _numbers_by_camera("--keypoints-first", keypoints_first, "[CAMERA=]NUMBER, such as 1 or cam02=440", needs_camera=False)
    options = Options(
        unit=unit,
        up=up,
        fps=fps,
        height_m=height,
        masks=masks,
        background=background,
        truth=truth,
        offsets=offsets,
        layout=layout,
        keypoints=keypoints,
        first_frame=first_frame,
        frames=frames,
        measures_lengths=not no_lengths,
        keypoints_first=starts,
        keypoints_unit=keypoints_unit,
        videos=videos,
        rig=_changes(rig),
        resample=resample,
        progress=sys.stderr.isatty(),
    )
    if (session / FILE_NAME).exists() and not overwrite:
        raise input_error(session, f"already holds a {FILE_NAME}", "a folder without one", "name another, or replace it with --overwrite")
    if model != DEFAULT_MODEL:
        # A wrong model is reported before anything is written.
        configure()
        checked_definition(model)
    reader = import_module(f"bayes_body.recording.readers.{verb}")
    recording, remarks = getattr(reader, f"import_{verb}")(source, session, options)
    for remark in remarks:
        say(f"note: {remark}")
    _compare_cameras(recording, offsets)
    _warn_of_nobody(recording)
    picture = draw_first_frame(recording, model, session / "check.png")
    say(f"{size_of(recording)}: {session / FILE_NAME}")
    _print_table(recording, source, options, getattr(reader, "POSES", None))
    say(f"Look at {picture}: the body should cover the person in every view, and the axes should stand where the world's origin is.")


def _print_table(session: "Session", source: Path, options: "Options", poses: str | None) -> None:
    """Tell the user what was read from where, and what was not used. `poses` is the name of the folder in which a program writes keypoints."""
    from bayes_body.recording.readers.import_table import describe_import

    for line in describe_import(session, source, options, None if poses is None else source / poses):
        say(line)


def _command(verb: str, laboratory: Laboratory) -> Callable[..., None]:
    """Return the function of a verb. Typer reads from its signature the arguments: those of `_import`, less the omitted ones."""
    written = signature(_import)
    source = Annotated[Path, typer.Argument(help=laboratory.source, show_default=False)]
    parameters = written.parameters | {"source": written.parameters["source"].replace(annotation=source)}
    omitted = ("verb", *laboratory.omitted_options)

    def command(**arguments: Any) -> None:
        _import(verb, **arguments)

    shown: Any = command
    shown.__signature__ = written.replace(parameters=[parameter for name, parameter in parameters.items() if name not in omitted])
    return command


app = typer.Typer(help="Make a session from a laboratory's files.", no_args_is_help=True)
for name, laboratory in LABORATORIES.items():
    app.command(name, help=laboratory.help, short_help=laboratory.line)(_command(name, laboratory))


def _numbers_by_camera(option: str, texts: list[str] | None, expected: str, needs_camera: bool) -> dict[str, int]:
    """Return the whole number that an option gives for each camera; under an empty name that of all cameras."""
    numbers: dict[str, int] = {}
    for text in texts or []:
        name, separator, number = composed(text).rpartition("=")
        try:
            value = int(number)
        except ValueError:
            value = None
        if value is None or abs(value) > 10**9 or (needs_camera and not name) or (separator and not name):
            raise input_error(option, f"'{text}'", expected, "give a camera's name and a whole number")
        if name in numbers:
            raise input_error(option, f"camera '{name}' twice" if name else "two numbers for all cameras", expected, "leave one of them out")
        numbers[name] = value
    return numbers


def _changes(texts: list[str] | None) -> dict[str, str]:
    """Return the name of the change of each camera's calibration; under an empty name that of all cameras."""
    changes: dict[str, str] = {}
    for text in texts or []:
        name, _, change = text.rpartition("=")
        if name in changes:
            problem = f"camera '{name}' twice" if name else "two changes of all cameras"
            raise input_error("--rig", problem, "one change of each", "leave one of them out")
        changes[name] = change
    return changes


def _compare_cameras(session: "Session", offsets: Mapping[str, int]) -> None:
    """Tell the user how well the cameras fit each other, if they have keypoints, and which one does not."""
    from bayes_body.recording.readers.agreement.camera_sentences import describe_errors, warn_of_cameras
    from bayes_body.recording.readers.agreement.cameras import camera_agreement
    from bayes_body.view.figures_text import warning_line

    cameras = camera_agreement(session)
    if cameras:
        say(f"note: {describe_errors(cameras)}")
    for sentence in warn_of_cameras(cameras, offsets):
        say(warning_line(sentence))


def _warn_of_nobody(session: "Session") -> None:
    """Tell the user if nobody is in the first frame. Without masks the background is learned first, which takes some seconds."""
    from bayes_body.base.config import configure
    from bayes_body.base.progress import waiting

    configure()
    from bayes_body.initial.search.automatic import nobody_first
    from bayes_body.view.figures_text import warning_line

    with waiting("looking for the person in the first frame", sys.stderr.isatty()):
        sentence = nobody_first(session)
    if sentence:
        say(warning_line(sentence))


def size_of(session: "Session") -> str:
    """Return the size of a recording in words."""
    cameras = len(session.views)
    numbers = f" ({session.first_frame} to {session.frame_number(session.frames - 1)})" if session.recorded else ""
    return f"{cameras} camera{'s' if cameras > 1 else ''}, {session.frames} frames{numbers} at {session.fps:g} frames a second"


def draw_first_frame(session: "Session", name: str, path: Path) -> Path:
    """Draw a body in its first pose into the first picture of every camera, and print the remarks of the fit."""
    from bayes_body.base.config import configure

    configure()
    from bayes_body.initial import apply_first_pose, first_pose, first_pose_source
    from bayes_body.model.build import build_model
    from bayes_body.view.rig_check import draw_check

    model = build_model(name, session)
    # A search would take too long for a picture: where it is needed, the body is drawn at the origin.
    source = first_pose_source(model, session)
    if source == "fitted":
        estimate = first_pose(model, session, source)
        for remark in estimate.remarks:
            say(f"note: first pose: {remark}")
        model = apply_first_pose(model, session, estimate)
    return draw_check(session, model, path)
