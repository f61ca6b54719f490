"""`bayes-body simulate`: film a captured motion with simulated cameras, as a session with its truth."""

import math
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, cast

import typer

from bayes_body.base.errors import InputError, input_error, nearest
from bayes_body.cli.terminal import say

if TYPE_CHECKING:
    import numpy as np

    from bayes_body.recording.readers.rig import Rig
    from bayes_body.recording.session.session import Session
    from bayes_body.workshop.simulation.session import Bystander

    type Landmarks = Mapping[str, np.ndarray]

MOTION, PERSON, PICTURE = "Motion", "Person", "Picture"
WALK = "walk"
# Duration of the walk that ships, if no number of frames is given.
WALK_S = 2.0
# Half an hour at 60 frames a second; many more would not fit into the memory.
MOST_FRAMES = 100_000
# A place farther from where the cameras look is in no room.
FARTHEST_M = 100.0

Mocap = Annotated[str, typer.Argument(help="Motion capture: .amc, .bvh, .c3d, .trc; or `walk`, a walking cycle that ships.", show_default=False)]
Out = Annotated[Path, typer.Option("--out", help="Folder to write the session into.", show_default=False)]
RigName = Annotated[str, typer.Option("--rig", help="humaneva_7, room_4, side_1, moving_1, or a .toml: a rig, a session, Pose2Sim's.")]
Cameras = Annotated[str | None, typer.Option("--cameras", help="Only these cameras of the rig, such as C1,C2,C3.")]
Skeleton = Annotated[Path | None, typer.Option("--skeleton", help="The .asf of an .amc, if it is not beside it.", rich_help_panel=MOTION)]
Unit = Annotated[str | None, typer.Option("--unit", help="Unit of the motion's lengths, if its file does not state it.", rich_help_panel=MOTION)]
Up = Annotated[str | None, typer.Option("--up", help="Axis that points up, if it is not the usual one of its format.", rich_help_panel=MOTION)]
Frames = Annotated[int | None, typer.Option("--frames", help="Number of frames, at the rig's rate; all by default.", rich_help_panel=MOTION)]
FirstFrame = Annotated[int, typer.Option("--first-frame", help="First frame of the motion, at the rig's rate.", rich_help_panel=MOTION)]
Centre = Annotated[bool, typer.Option("--centre/--no-centre", help="Move the motion to where the cameras look.", rich_help_panel=MOTION)]
SubjectName = Annotated[
    str, typer.Option("--subject", help="The simulated person: a number or a name; each gives a different person.", rich_help_panel=PERSON)
]
Height = Annotated[
    float | None,
    typer.Option("--height", help="The person's height, metres; the motion is scaled with it. By default the motion's own.", rich_help_panel=PERSON),
]
Body = Annotated[
    str | None,
    typer.Option("--body", help="A body whose joint angles are fitted to the motion and stored with the truth.", rich_help_panel=PERSON),
]
Clutter = Annotated[float, typer.Option("--clutter", help="Amount of furniture and textures: 0 none, 1 usual.", rich_help_panel=PICTURE)]
Noise = Annotated[
    float, typer.Option("--noise", help="Amount of sensor noise, exposure drift and gain differences: 0 none, 1 usual.", rich_help_panel=PICTURE)
]
Segmentation = Annotated[
    str | None,
    typer.Option(
        "--segmentation",
        help="Silhouettes of a `good` or `poor` segmenter, instead of an empty scene.",
        rich_help_panel=PICTURE,
    ),
]
TrueMasks = Annotated[bool, typer.Option("--masks", help="Also write the true silhouettes, into true_masks.", rich_help_panel=PICTURE)]
Background = Annotated[
    Path | None, typer.Option("--background", help="Folder with CAMERA.png, .mp4 ... of your own empty scene.", rich_help_panel=PICTURE)
]
With = Annotated[
    list[str] | None,
    typer.Option(
        "--with",
        metavar="MOTION[:SUBJECT][@X,Y[,DEGREES]]",
        help="A further person: a file of motion capture or `walk`, the simulated person, the middle of the path in metres from where the cameras "
        "look, and a turn; may be repeated. Such as walk:7@0.8,0.5,180.",
        rich_help_panel=PERSON,
    ),
]
KeypointFiles = Annotated[
    bool,
    typer.Option(
        "--keypoints", help="Also write a detector's keypoints of all people, as OpenPose does, into pose/CAMERA_json.", rich_help_panel=PICTURE
    ),
]
Seed = Annotated[int, typer.Option("--seed", help="Seed of the room, noise and keypoints.", rich_help_panel=PICTURE)]


def simulate(
    mocap: Mocap,
    out: Out,
    rig: RigName = "room_4",
    cameras: Cameras = None,
    skeleton: Skeleton = None,
    unit: Unit = None,
    up: Up = None,
    frames: Frames = None,
    first_frame: FirstFrame = 0,
    centre: Centre = True,
    subject: SubjectName = "0",
    height: Height = None,
    body: Body = None,
    with_: With = None,
    clutter: Clutter = 1.0,
    noise: Noise = 1.0,
    segmentation: Segmentation = None,
    masks: TrueMasks = False,
    background: Background = None,
    keypoints: KeypointFiles = False,
    seed: Seed = 0,
) -> None:
    """Film a motion with simulated cameras: videos, empty scenes, calibration, first keypoints and the truth, as a session."""
    from bayes_body.base.progress import watched
    from bayes_body.cli.import_ import size_of
    from bayes_body.workshop.simulation.options import Options
    from bayes_body.workshop.simulation.person import build_person
    from bayes_body.workshop.simulation.session import check_folder
    from bayes_body.workshop.simulation.session import simulate as film
    from bayes_body.workshop.simulation.staging import centred, cut, scaled, stature_m

    if frames is not None and frames > MOST_FRAMES:
        raise input_error("--frames", str(frames), f"at most {MOST_FRAMES}", "give a smaller number")
    options = Options(clutter, noise, _quality(segmentation), masks, background, keypoints=keypoints, seed=seed)
    check_folder(out)
    chosen = _rig(rig, cameras)
    if mocap == WALK:
        landmarks = _walk(chosen.fps, frames, first_frame, _seed_of(subject), height)
    else:
        landmarks = _captured(Path(mocap), chosen.fps, skeleton, unit, up)
    landmarks = cut(landmarks, first_frame, frames)
    stature = stature_m(landmarks)
    person = build_person(_seed_of(subject), stature if height is None else height)
    landmarks = scaled(landmarks, person.build.height_m / stature)
    landmarks = centred(landmarks, chosen.aim_m) if centre else landmarks
    frames = len(landmarks["pelvis"])
    bystanders = [_bystander(text, chosen, frames, _seed_of(subject) + number, number) for number, text in enumerate(with_ or [], 1)]
    truth = {} if body is None else _angles(body, landmarks, chosen.fps)
    title = f"{Path(mocap).stem}, simulated with {chosen.name}"
    session, remarks = film(landmarks, chosen, person, options, out, title=title, truth=truth, bystanders=bystanders, watch=watched("filming"))
    for remark in remarks:
        say(f"note: {remark}")
    _draw(session, out)
    company = "".join(f", and one of {bystander.person.build.height_m:.2f} m" for bystander in bystanders)
    say(f"{size_of(session)}, a person of {person.build.height_m:.2f} m{company}: {out / 'session.toml'}")


def _quality(text: str | None) -> Literal["good", "poor"] | None:
    if text not in (None, "good", "poor"):
        raise InputError(f"--segmentation: there is no segmenter '{text}'; {nearest(text, ('good', 'poor'))}")
    return cast(Literal["good", "poor"] | None, text)


def _rig(name: str, cameras: str | None) -> "Rig":
    from bayes_body.base.files.shipped import definitions_folder
    from bayes_body.model.definition import definition_names
    from bayes_body.recording.readers.rig import read_rig

    shipped = definition_names("rigs")
    path = definitions_folder() / "rigs" / f"{name}.toml" if name in shipped else Path(name)
    if not path.exists():
        raise InputError(f"--rig: '{name}' is neither a rig that ships nor a file; {nearest(name, shipped)}")
    rig = read_rig(path)
    return rig if cameras is None else rig.select([camera.strip() for camera in cameras.split(",")])


def _captured(path: Path, fps: float, skeleton: Path | None, unit: str | None, up: str | None) -> "Landmarks":
    """Return a captured motion's landmarks, resampled to a frame rate."""
    from bayes_body.recording.readers.mocap import landmarks, read_motion, resample

    return landmarks(resample(read_motion(path, skeleton, unit=unit, up=up), fps))


def _walk(fps: float, frames: int | None, first: int, seed: int, height: float | None) -> "Landmarks":
    """Return the landmarks of the walk that ships, with enough frames, in the subject's own gait."""
    from bayes_body.workshop.learning.walking_cycle import load_cycle, walk

    count = round(WALK_S * fps) if frames is None else frames
    cycle = load_cycle()
    return walk(cycle, max(first + count, 1) / fps, fps, seed=seed, height_m=cycle.height_m if height is None else height)


def _bystander(text: str, rig: "Rig", frames: int, seed: int, number: int) -> "Bystander":
    """Return the person of `--with`, the first of which has number 1."""
    from bayes_body.workshop.simulation.person import build_person
    from bayes_body.workshop.simulation.session import Bystander
    from bayes_body.workshop.simulation.staging import cut, put, stature_m

    motion, subject, place = _parts(text, number)
    seed = seed if subject is None else _seed_of(subject)
    tracks = (
        _walk(rig.fps, frames, 0, seed, build_person(seed).build.height_m) if motion == WALK else _captured(Path(motion), rig.fps, None, None, None)
    )
    length = len(tracks["pelvis"])
    if length < frames:
        problem = f"{length} frames at the rig's rate"
        raise input_error(f"--with {text}", problem, f"at least the film's {frames}", "lower --frames, or choose a longer motion")
    landmarks = put(cut(tracks, 0, frames), rig.aim_m, place)
    return Bystander(landmarks, build_person(seed, stature_m(landmarks)))


def _parts(text: str, number: int) -> tuple[str, str | None, tuple[float, float, float]]:
    """Return the motion, the subject, and the place (metres, degrees) in a value of `--with`."""
    expected, remedy = "MOTION[:SUBJECT][@X,Y[,DEGREES]]", "write it like walk:7@0.8,0.5,180"
    person, sign, place = text.rpartition("@")
    try:
        numbers = [float(value) for value in place.split(",")] if sign else [0.0, float(number), 0.0]
    except ValueError:
        raise input_error(f"--with {text}", f"'{place}' is not a place", expected, remedy) from None
    if len(numbers) not in (2, 3) or not all(map(math.isfinite, numbers)) or max(map(abs, numbers[:2])) > FARTHEST_M:
        raise input_error(f"--with {text}", f"'{place}' is not a place", f"{expected}, at most {FARTHEST_M:g} m away", remedy)
    x, y, degrees = [*numbers, 0.0][:3]
    motion, colon, subject = (person if sign else text).rpartition(":")
    # In a path of Windows, a folder follows the colon.
    if not colon or "\\" in subject or "/" in subject:
        motion, subject = (person if sign else text), None
    if not motion or subject == "":
        raise input_error(f"--with {text}", "no motion" if not motion else "no subject after the colon", expected, remedy)
    return motion, subject, (x, y, degrees)


def _seed_of(subject: str) -> int:
    """Return the subject's seed: a number is used directly, and a name always gives the same seed."""
    return int(subject) if subject.isdecimal() and len(subject) < 10 else zlib.crc32(subject.encode())


def _angles(name: str, landmarks: "Landmarks", fps: float) -> dict[str, "np.ndarray"]:
    """Return the joint angles of a body fitted to the person's motion, with their names."""
    import numpy as np

    from bayes_body.base.config import configure
    from bayes_body.base.progress import waiting
    from bayes_body.initial.retarget import retarget
    from bayes_body.model.body.build import build_body
    from bayes_body.model.definition import load_body

    schema = load_body(name)
    configure()
    with waiting(f"fitting {name} to the motion"):
        fit = retarget(build_body(name, schema), landmarks, fps, schema=schema)
    residual = fit.residual()
    say(f"{name} follows the motion to within {residual.mean_mm:.0f} mm on average, {residual.most_mm:.0f} mm for 95 % of its markers.")
    for remark in fit.remarks:
        say(f"note: {remark}.")
    lengths = list(fit.lengths_m.items())
    return {
        "angles": fit.angles,
        "dof_names": np.array(fit.body.dof_names),
        "body": np.array(name),
        "length_names": np.array([key for key, _ in lengths]),
        "lengths_m": np.array([value for _, value in lengths]),
    }


def _draw(session: "Session", folder: Path) -> None:
    from bayes_body.cli.import_ import DEFAULT_MODEL, draw_first_frame

    picture = draw_first_frame(session, DEFAULT_MODEL, folder / "check.png")
    say(f"Look at {picture}: the fitted body should cover the person in every view.")
