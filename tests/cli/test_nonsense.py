"""Recordings that cannot be tracked, with every kernel: each is refused before anything is computed, or the run says what is wrong."""

import dataclasses
import json
import shutil
from pathlib import Path

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from bench.compile import search_program
from shared_fixtures import loose_limbed

from bayes_body.base.geometry.camera import project
from bayes_body.base.registry import names
from bayes_body.model.build import build_model
from bayes_body.model.definition import load_definition
from bayes_body.recording.evidence.markers import MARKERS
from bayes_body.recording.readers.keypoints.series import KeypointSeries, write_series
from bayes_body.recording.session.read import load_session, save_session
from bayes_body.recording.session.session import CameraSpec, Session, Subject, View
from bayes_body.results.metrics.fit import fill, outlines

SIZE, FRAMES = (128, 160), 2
STANDING = {"root_z": 0.95, "l_shoulder_y": -1.4, "r_shoulder_y": 1.4, "l_hip_y": -0.25, "r_hip_y": 0.15}
STANDING |= {"l_knee": -0.2, "r_knee": -0.3, "l_elbow": -0.3, "r_elbow": -0.3}
SHIFTS = frozenset({"root_x", "root_y", "root_z"})
# The options with which each kernel is quick, and the shipped definition of a whole person that it runs.
OPTIONS = {
    "tempered": ("--particles", 40),
    "hmc": ("--particles", 20),
    "sir": ("--particles", 100),
    "annealed": ("--particles", 40, "--layers", 5),
    "particle_bp": ("--particles", 60, "--set", "samples=60", "--set", "iterations=2"),
    "laplace": ("--particles", "60"),
}
WHOLE = dict.fromkeys(OPTIONS, "silhouettes") | {"particle_bp": "loose_limbed_15"}
OFF = ("does not fit the image", "does not cover the person", "no longer covers the person", "outside of the image", "can be a person's")


def _camera(name, azimuth):
    """Three metres from the z axis, looking at it from 1 m up."""
    forward, right = np.array([-np.cos(azimuth), -np.sin(azimuth), 0.0]), np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    R, centre = np.stack([right, np.cross(forward, right), forward]), np.array([3 * np.cos(azimuth), 3 * np.sin(azimuth), 1.0])
    return CameraSpec(name, SIZE, (200.0, 200.0), (SIZE[0] / 2, SIZE[1] / 2), 0.0, (0.0,) * 5, R, -R @ centre)


def _drawn(folder, definition, initial, shift_px=0, keypoints=False):
    """A session in which four cameras see a body in its first pose, moved sideways by pixels: images, masks, empty scenes, the true pelvis."""
    views = tuple(
        View(_camera(f"c{k}", azimuth), f"c{k}/image%04d.png", f"c{k}/mask%04d.png", background=f"c{k}/empty.png")
        for k, azimuth in enumerate((0.3, 1.9, 3.4, 5.0))
    )
    session = Session(folder, "drawn", "z", 60.0, FRAMES, 0, views, Subject(height_m=1.7), initial=initial, positions=SHIFTS.intersection(initial))
    model, rng = build_model(definition, session), np.random.default_rng(0)
    pose = model.initial["pose"]
    for view, polygons in zip(views, outlines(model, np.asarray(pose)), strict=True):
        (folder / view.camera.name).mkdir(parents=True)
        empty = cv2.GaussianBlur(rng.uniform(0, 120, SIZE[::-1]), (0, 0), 3)
        image = empty.copy()
        for number, outline in enumerate(polygons):
            cv2.fillConvexPoly(image, np.round(outline.polygon * 16).astype(np.int32), 130.0 + 7 * (number % 8), shift=4)
        mask = fill(polygons, SIZE).astype(np.uint8) * 255
        _write(folder / view.background, empty)
        for frame in range(FRAMES):
            _write(session.image_path(view, frame), np.roll(image + rng.normal(0, 3, image.shape), shift_px, axis=1))
            _write(session.mask_path(view, frame), np.roll(mask, shift_px, axis=1))
    if "pelvis" in model.body.markers.names:
        truth = np.full((FRAMES, len(MARKERS), 3), np.nan)
        truth[:, MARKERS.index("pelvis")] = model.markers(pose)[model.body.markers.names.index("pelvis")]
        np.savez(folder / "truth.npz", markers=truth, names=np.array(MARKERS))
        session = dataclasses.replace(session, truth="truth.npz")
    if keypoints:
        views = tuple(_with_keypoints(folder, model, pose, number, view) for number, view in enumerate(views))
        session = dataclasses.replace(session, views=views)
    save_session(session)
    return session


def _write(path, image):
    assert cv2.imwrite(str(path), np.clip(image, 0, 255).astype(np.uint8))


def _with_keypoints(folder, model, pose, number, view):
    pixels, _ = project(jax.tree.map(lambda leaf: leaf[number], model.rig), model.markers(jnp.asarray(pose)))
    order = [model.body.markers.names.index(name) for name in MARKERS]
    points = np.concatenate([np.asarray(pixels)[order], np.full((len(MARKERS), 1), 0.9)], axis=1)
    write_series(folder / f"{view.camera.name}.npz", KeypointSeries(np.tile(points, (FRAMES, 1, 1)), MARKERS, 0))
    return dataclasses.replace(view, keypoints=f"{view.camera.name}.npz", masks=None, background=None)


def _moved(**shifts):
    return lambda session: dataclasses.replace(session, initial={**session.initial, **shifts})


def _cameras(change):
    def case(session):
        return dataclasses.replace(session, views=tuple(dataclasses.replace(view, camera=change(session, view.camera)) for view in session.views))

    return case


def _masks(change):
    def case(session):
        for view in session.views:
            for frame in range(session.frames):
                path = session.mask_path(view, frame)
                _write(path, change(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)))
        return session

    return case


def _one_place(session, camera):
    first = session.views[0].camera
    return dataclasses.replace(camera, rotation=first.rotation, translation_m=first.translation_m)


def _without_masks(images):
    """Silhouettes that come from the empty scene; `images(empty, image)` are the images."""

    def case(session):
        for view in session.views:
            for frame in range(session.frames):
                path = session.image_path(view, frame)
                _write(path, images(*(cv2.imread(str(each), cv2.IMREAD_GRAYSCALE) for each in (session.background_path(view), path))))
        return dataclasses.replace(session, views=tuple(dataclasses.replace(view, masks=None) for view in session.views))

    return case


def _nobody(session):
    return _masks(np.zeros_like)(dataclasses.replace(session, initial={}, positions=frozenset()))


# What is known before anything is computed, and the sentence.
REFUSED = {
    "behind all cameras": (_moved(root_z=40.0), "behind every camera or outside of its image"),
    "100 m beside": (_moved(root_y=-100.0), "behind every camera or outside of its image"),
    "cameras in one place": (_cameras(_one_place), "all 4 cameras stand in one place, (2.87, 0.887, 1) m in the world"),
    "cameras without a place": (
        _cameras(lambda _, camera: dataclasses.replace(camera, translation_m=np.zeros(3))),
        "stand in one place, (0, 0, 0) m",
    ),
    "masks black": (_masks(np.zeros_like), "no camera's silhouette can be a person's: they cover 0, 0, 0, 0 % of the images"),
    "masks white": (_masks(lambda mask: mask * 0 + 255), "they cover 100, 100, 100, 100 % of the images"),
    "masks inverted": (_masks(lambda mask: 255 - mask), "no camera's silhouette can be a person's: they cover"),
    "scene empty": (_without_masks(lambda empty, _: empty), "no camera's silhouette can be a person's: they cover 0, 0, 0, 0 % of the images"),
    "height 0.3 m": (lambda session: dataclasses.replace(session, subject=Subject(height_m=0.3)), "subject.height_m: 0.3; expected metres"),
    "no [initial], nobody": (_nobody, "no first pose, and no person was detected in frame 0"),
}
# What only the result tells.
TOLD = {
    "1 m aside": _moved(root_x=1.0),
    "100 m away": _moved(root_x=100.0),
    "half the height": lambda session: dataclasses.replace(session, subject=Subject(height_m=0.5)),
    "masks half inverted": _masks(lambda mask: np.where(np.arange(SIZE[0]) < SIZE[0] // 2, 255 - mask, mask)),
}


@pytest.fixture(scope="module")
def person(tmp_path_factory):
    return _drawn(tmp_path_factory.mktemp("person") / "session", "silhouettes", STANDING)


@pytest.fixture
def changed(person, tmp_path):
    """`changed(case)`: the folder of a copy of the person's session to which a case was done."""

    def call(case):
        folder = tmp_path / "session"
        shutil.copytree(person.folder, folder)
        save_session(case(load_session(folder)))
        return folder

    return call


def _track(cli, folder, out, kernel, model):
    return cli("track", folder, "--model", model, "--kernel", kernel, *OPTIONS[kernel], "--out", out)


def _said_off(outcome, out: Path) -> list[str]:
    """The warnings of a run that its body is not on the person: the same in its summary and on the terminal."""
    assert outcome.status == 0, outcome.err
    warnings = [each for each in json.loads((out / "summary.json").read_text(encoding="utf-8"))["warnings"] if any(words in each for words in OFF)]
    assert all(f"warning     {each}" in outcome.out for each in warnings)
    return warnings


def test_every_kernel_is_here():
    assert set(OPTIONS) == set(names("kernel"))


@pytest.mark.parametrize("kernel", [pytest.param(name, marks=[] if name == "sir" else [pytest.mark.slow]) for name in OPTIONS])
@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_is_refused_before_anything_is_computed(cli, changed, tmp_path, case, kernel):
    change, sentence = REFUSED[case]
    _track(cli, changed(change), tmp_path / "run", kernel, WHOLE[kernel]).refuses(sentence)
    assert not (tmp_path / "run").exists()


@pytest.fixture(scope="module")
def arms(tmp_path_factory):
    """An arm where it is said to be, and one beside it."""
    folder, initial = tmp_path_factory.mktemp("arms"), {"shoulder_x": -0.6, "elbow": -0.7}
    return {name: _drawn(folder / name, "arm", initial, shift).folder for name, shift in (("good", 0), ("aside", 40))}


@pytest.fixture(scope="module")
def loose_arm(tmp_path_factory):
    path = tmp_path_factory.mktemp("model") / "loose_arm.toml"
    text = loose_limbed(load_definition("arm").text)
    path.write_text(text.replace("[[likelihood]]", '[[potential]]\nkind = "kinematic"\n\n[[likelihood]]', 1), encoding="utf-8")
    return path


# One sampler by default, and the mode seeker among the slow tests: what is told does not depend on the kernel, and the others compile for long.
@pytest.mark.parametrize(
    "kernel",
    [pytest.param(name, marks={"sir": [], "annealed": [pytest.mark.slow]}.get(name, [pytest.mark.long])) for name in OPTIONS],
)
def test_a_body_beside_the_person_is_told_and_one_on_the_person_is_not(cli, arms, loose_arm, tmp_path, kernel):
    model = loose_arm if kernel == "particle_bp" else "arm"
    for name, told in (("good", False), ("aside", True)):
        outcome = _track(cli, arms[name], tmp_path / name, kernel, model)
        warnings = _said_off(outcome, tmp_path / name)
        assert len(warnings) == 2 * told, warnings
    if kernel == "annealed":
        assert cli("report", tmp_path / "aside").status == 0
        page = (tmp_path / "aside" / "report.html").read_text(encoding="utf-8")
        assert "rom the first frame to the last the body does not cover the person" in page


@pytest.mark.long
@pytest.mark.parametrize("kernel", OPTIONS)
def test_whatever_the_case_each_kernel_tells_it(cli, person, changed, tmp_path, kernel):
    good = tmp_path / "good"
    assert _said_off(_track(cli, person.folder, good, kernel, WHOLE[kernel]), good) == []
    for case, change in TOLD.items():
        out = tmp_path / case
        assert _said_off(_track(cli, changed(change), out, kernel, WHOLE[kernel]), out), case
        shutil.rmtree(tmp_path / "session")


@pytest.mark.slow
def test_the_search_for_a_first_pose_obeys_its_annotations(person):
    # Traced, not compiled, which takes longer than all else. Whole searches are long tests.
    search, arguments = search_program("person search", person.folder)
    drawn = jax.eval_shape(search, *arguments)
    assert drawn.log_evidence.shape == () and drawn.parts.shape[0] == drawn.log_weights.shape[0]


@pytest.mark.long
@pytest.mark.parametrize("kernel", OPTIONS)
def test_without_a_first_pose_the_person_is_found_or_the_run_tells_that_it_is_not(cli, changed, tmp_path, kernel):
    out = tmp_path / "run"
    outcome = _track(cli, changed(lambda session: dataclasses.replace(session, initial={}, positions=frozenset())), out, kernel, WHOLE[kernel])
    if outcome.status:
        assert outcome.refusals
    else:
        summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
        assert summary["error_mm_by_marker"]["pelvis"] < 250 or _said_off(outcome, out)


@pytest.mark.long
def test_keypoints_tell_it_too(cli, tmp_path):
    session = _drawn(tmp_path / "session", "silhouettes", STANDING, keypoints=True)
    for case, told in ((lambda session: session, False), (_moved(root_x=1.0), True)):
        save_session(case(session))
        out = tmp_path / f"run_{told}"
        warnings = _said_off(_track(cli, session.folder, out, "tempered", "keypoints"), out)
        assert bool(warnings) == told
        assert all("away from the keypoints" in each for each in warnings)
