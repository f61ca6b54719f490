"""The page's section on Markov chains: there for a kernel that runs them, with a path over the image of the frame with the worst mixing."""

import base64

import cv2
import numpy as np
import pytest

from bayes_body.model.definition import load_definition
from bayes_body.results.storage.manifest import input_digests
from bayes_body.results.storage.saved_run import load_run
from bayes_body.view.overlay import run_backdrop
from bayes_body.view.report.chains import chain_section, worst_mixed
from bayes_body.view.report.figures import style
from bayes_body.view.report.page import page, sections_of

RUNS, CHAINS, LENGTH, FRAMES = 2, 3, 20, 4
BODY = load_definition("arm").body
DOFS = tuple(dof.name for joint in BODY.joints for dof in joint.dofs)


@pytest.fixture
def chained(inspect):
    def call(dofs=DOFS, **changed):
        each = (RUNS, FRAMES, CHAINS)
        pose = 0.02 * np.random.default_rng(0).normal(size=(RUNS, CHAINS * LENGTH, FRAMES, len(dofs)))
        # A chain of its own place, in the third frame.
        pose[0, :LENGTH, 2, 1] += 0.4
        figures = {
            "markov_acceptance": np.full(each, 0.7),
            "markov_divergences": np.zeros(each, int),
            "markov_energy_fraction": np.ones(each),
            "markov_step": np.full(each, 0.2),
            "markov_ess": np.full((RUNS, FRAMES, len(dofs)), 30.0),
            "markov_length": np.full((RUNS, FRAMES), LENGTH),
        }
        units = ("rad",) * len(dofs)
        return inspect(runs=RUNS, draws=CHAINS * LENGTH, frames=FRAMES, dofs=dofs, units=units, pose=pose, **figures | changed)

    return call


def test_a_kernel_without_chains_has_no_such_section(inspect):
    assert "chains" not in [name for name, _, _ in sections_of(inspect())]


@pytest.mark.slow
def test_the_frame_that_mixed_worst_is_looked_at(chained):
    it = chained()
    assert worst_mixed(it.diagnosis.mixing) == 2
    assert "<h2>Markov chains</h2>" in page(it.run)
    with style():
        text = chain_section(it)
    assert "Frame 2, with the worst mixing" in text and "R-hat over the chains" in text
    for alt in ("Acceptance over", "Divergences over", "Effective draws over", "Energy over", "Step over", "Autocorrelation within"):
        assert f'alt="{alt} the ' in text


def test_the_path_is_drawn_from_first_to_last(chained):
    with style():
        text = chain_section(chained())
    assert "20 of 20 states of a chain" in text
    content = base64.b64decode(text.split('<img src="data:image/webp;base64,')[1].split('"')[0])
    picture = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)
    assert picture.shape[1] > 100 and picture.std() > 5


def test_the_image_is_that_of_the_run_or_none(chained):
    """A stranger's run may name any folder of this machine as that of its images."""
    it = chained()
    view = it.run.session.views[0]
    (it.run.session.folder / "a").mkdir()
    width, height = view.camera.size_px
    picture = np.random.default_rng(0).integers(0, 255, (height, width, 3), np.uint8)
    for frame in range(it.run.session.frames):
        path = it.run.session.image_path(view, frame)
        cv2.imwrite(str(path), picture)
    dark, note = run_backdrop(it.run, 0, 0)
    assert np.unique(dark).size == 1 and dark.max() < 100 and "no image" in note
    with load_run(it.run.folder) as known:
        known.inputs.update(input_digests(known.session))
        assert (run_backdrop(known, 0, 0)[0] == picture).all()


@pytest.mark.slow
def test_without_a_body_that_fits_there_is_no_path_but_all_else(chained):
    with style():
        text = chain_section(chained(dofs=("a", "b", "c", "d")))
    assert "No path is drawn" in text and "R-hat over the chains" in text


@pytest.mark.slow
def test_a_single_chain_has_no_map(chained):
    with style():
        text = chain_section(chained(markov_length=np.full((RUNS, FRAMES), CHAINS * LENGTH)))
    assert "There is no R-hat" in text and "Autocorrelation" in text
