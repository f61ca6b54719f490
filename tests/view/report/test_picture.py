"""`bayes-body picture`: one frame over a camera's image, and curves, as a paper needs them; or a sentence."""

import itertools
import re

import cv2
import numpy as np
import pytest

from bayes_body.cli.main import main
from bayes_body.results.metrics.fit import Outline
from bayes_body.results.storage.saved_run import load_run
from bayes_body.view.picture.frame import BARS, LONGEST, write_picture
from bayes_body.view.picture.frame import _crop as crop_of
from bayes_body.view.picture.frame import _scale as scale_of

DOFS, RADIANS = ("shoulder_x", "shoulder_y", "shoulder_z", "elbow"), ("rad",) * 4


@pytest.fixture(scope="module")
def folder(make_run, textured_session):
    """The run of an arm, with the images of its recording and a title that is no formula."""
    return make_run(dofs=DOFS, units=RADIANS, recording=textured_session, title="an $arm$ <bends>")


@pytest.fixture
def picture(capsys):
    """`picture(folder, "--frame", 3)`: exit status, standard output and error."""

    def call(*arguments):
        capsys.readouterr()
        with pytest.raises(SystemExit) as stopped:
            main(["picture", *map(str, arguments)])
        out, err = capsys.readouterr()
        return stopped.value.code, out, re.sub(r"\x1b\[\d*m", "", err)

    return call


def test_a_frame_as_pixels_and_as_vectors(picture, folder, tmp_path):
    status, out, err = picture(folder, "--frame", 3, "--camera", "b", "--size", 900)
    path = folder / "picture_b_000003.png"
    assert (status, err) == (0, "") and out == f"{path}: {path.stat().st_size / 1e6:.1f} MB.\n"
    image = cv2.imread(str(path))
    assert max(image.shape) == 900
    # Turquoise of the body's middle on a grey image, and white paper below it.
    blue, green, red = np.moveaxis(image.astype(int), -1, 0)
    assert ((green > red + 40) & (green > blue)).sum() > 500 and (image[-3:] == 255).all()
    assert picture(folder, "--frame", 3, "--camera", "b", "--svg", "--out", tmp_path / "arm.svg")[0] == 0
    text = (tmp_path / "arm.svg").read_text(encoding="utf-8")
    shown = re.sub(r"\s+", " ", " ".join(re.findall(r"<text[^>]*>([^<]*)</text>", text)))
    assert "an $arm$ &lt;bends&gt;. Model arm, kernel" in shown and "2 runs; camera b, frame 3 (0.05 s)." in shown
    assert "posterior mean: middle" in shown and "40 draws" in shown and re.search(r"Scale at the person's distance, \d\.\d\d m", shown)
    # The bar's name is text, too.
    assert re.search(r"> ?[125]?0?(\.[125])? c?m ?<", text)
    # Two parts of the arm and the hand in 40 draws, filled and as outlines; the image is embedded.
    assert text.count("<path") > 2 * 42 and "data:image/png;base64" in text
    first = (tmp_path / "arm.svg").read_bytes()
    assert picture(folder, "--frame", 3, "--camera", "b", "--out", tmp_path / "arm.svg", "--overwrite")[0] == 0
    assert (tmp_path / "arm.svg").read_bytes() == first


def test_the_scale_is_that_of_a_pinhole_at_the_person_s_depth(folder):
    with load_run(folder) as run:
        from bayes_body.results.posterior import CentralPose

        pose = np.asarray(run.model.initial["pose"], float)
        for c, view in enumerate(run.session.views):
            scale = scale_of(run, run.model, CentralPose(pose, True), 0, c)
            markers = np.asarray(run.model.markers(run.model.initial["pose"]), float)
            depth = view.camera.rotation[2] @ markers.mean(axis=0) + view.camera.translation_m[2]
            assert abs(scale.depth_m - depth) < 0.2
            # The lens bends lines near its axis by a few per cent at most.
            assert scale.pixels_a_metre == pytest.approx(view.camera.focal_px[0] / scale.depth_m, rel=0.05)
    assert all(later / before <= 2.5 for before, later in itertools.pairwise(BARS)) and 2.5 * LONGEST < 1


def test_a_standing_person_s_picture_shows_where_the_person_is():
    tall = [Outline("torso", np.array([(600.0, 100.0), (640.0, 900.0)]))]
    near, whole = crop_of(tall, [], (1920, 1080), False), crop_of(tall, [], (1920, 1080), True)
    assert (near.right - near.left) / (near.bottom - near.top) == pytest.approx(0.8, abs=0.01) and near.left < 600 < 640 < near.right
    assert whole[:4] == crop_of([], [], (1920, 1080), False)[:4] == (0, 0, 1920, 1080)


@pytest.mark.slow
def test_curves_with_bands(picture, folder, tmp_path):
    status, out, _ = picture(folder, "--curves", "elbow,shoulder_x")
    assert status == 0 and out.startswith(f"{folder / 'curves.pdf'}: ") and (folder / "curves.pdf").read_bytes().startswith(b"%PDF")
    assert picture(folder, "--curves", "elbow", "--out", tmp_path / "elbow.svg")[0] == 0
    text = (tmp_path / "elbow.svg").read_text(encoding="utf-8")
    assert all(f">{words}<" in text for words in ("Elbow", "time, s", "angle, degrees")) and "90 % intervals" in text
    assert "FillBetween" in text or "PolyCollection" in text


def test_what_does_not_exist_is_a_sentence_with_what_does(picture, folder, tmp_path):
    def refused(*arguments):
        status, out, err = picture(folder, *arguments)
        assert status == 2 and out == "" and "Traceback" not in err
        return err

    assert "--frame: 9; expected 0 to 4: the run has 5 frames" in refused("--frame", 9)
    assert "--frame: -1; expected 0 to 4" in refused("--frame", -1)
    assert "--camera: no camera 'C1'; expected one of a, b" in refused("--camera", "C1")
    known = refused("--curves", "elbw")
    assert "no curve 'elbw'" in known and "shoulder_x" in known and "did you mean 'elbow'?" in known
    assert ".png, .svg, .pdf" in refused("--out", tmp_path / "arm.jpg")
    assert "200 to 10000 pixels" in refused("--size", 10)
    assert "leave one of them out" in refused("--svg", "--out", tmp_path / "arm.png")
    assert "make two pictures" in refused("--curves", "elbow", "--frame", 1)
    assert "expected" in refused("--curves", ",")
    (tmp_path / "mine.png").write_text("mine")
    assert "already exists" in refused("--out", tmp_path / "mine.png") and (tmp_path / "mine.png").read_text() == "mine"


def test_a_mode_seeker_has_no_draws_and_no_bands(make_run, textured_session, tmp_path):
    path = make_run(dofs=DOFS, units=RADIANS, recording=textured_session, log_evidence=np.full((2, 5), np.nan))
    (path.parent / "session" / "a" / "image0000.png").write_bytes((path.parent / "session" / "b" / "image0000.png").read_bytes())
    with load_run(path) as run:
        write_picture(run, tmp_path / "a.svg")
    text = (tmp_path / "a.svg").read_text(encoding="utf-8")
    assert "mean of the particles: middle" in text and "draws<" not in text
    # The image is not the one of the time of the run.
    assert "no image: its file is not the one" in re.sub(r"</text>\s*<text[^>]*>", " ", text)
