"""The room that a run needs is said before it begins, and is about what it takes."""

import shutil
from collections import namedtuple

import pytest

from bayes_body.base.errors import InputError
from bayes_body.cli.track import draws_of
from bayes_body.model.build import build_model
from bayes_body.runs.size import LARGE, disk_lines, draws_to_keep, frame_size, megabytes, smoothing_lines

Usage = namedtuple("Usage", "total used free")


@pytest.fixture
def lines(textured_session, tmp_path, monkeypatch):
    """`lines(free, done=0, keep=None)`: what is said of 1000 frames of a model of 4 dofs, two runs of 2000 particles."""
    model = build_model("arm", textured_session)

    def call(free, done=0, keep=None):
        monkeypatch.setattr(shutil, "disk_usage", lambda folder: Usage(10**12, 0, int(free)))
        return list(disk_lines(tmp_path, model, {"particles": 2000}, 2, 1000, done, keep))

    # Four angles, a weight and an ancestor of 4 bytes each.
    assert 1 < frame_size(model, 2000, 2).stored / (2 * 2000 * 24) < frame_size(model, 2000, 2).file / (2 * 2000 * 24) < 1.1
    return call


def test_a_line_names_the_room(lines):
    expected = "disk       96 MB for 1000 frames of 0.096 MB, and 104 MB more until posterior.nc is complete; pictures come on top; 500 MB are free"
    assert lines(5e8) == [expected]
    assert lines(5e8, keep=200)[0].startswith("disk       9.9 MB for 1000 frames of 0.0099 MB")


def test_a_long_recording_is_told_of_a_thinned_run(textured_session, tmp_path):
    model = build_model("arm", textured_session)
    frames = LARGE // frame_size(model, 2000, 2).stored

    def said(count, keep=None):
        return [line for line in disk_lines(tmp_path, model, {"particles": 2000}, 2, count, 0, keep) if line.startswith("note: ")]

    (note,) = said(frames + 1)
    assert note.startswith("note: with --keep draws=200 it is 5") and not said(frames) and not said(frames + 1, keep=200)


def test_a_disk_that_is_too_small_is_a_warning_with_a_remedy(lines, textured_session, tmp_path):
    _, warning = lines(1.5e8)
    said = "the run will not fit on the disk: it needs 200 MB, and 150 MB are free; free some space, or store fewer draws with --keep draws=200."
    assert warning.startswith("warning") and warning.endswith(said)
    assert "draw fewer paths with --draws 50" in list(smoothing_lines(tmp_path, build_model("arm", textured_session), 2000, 2, 10**9, 0))[1]
    # What is stored needs no more room.
    assert len(lines(1.5e8, done=600)) == 1
    assert len(lines(1.5e8, keep=200)) == 1 and "give fewer runs or draws" in lines(1e6, keep=200)[1]


def test_small_and_large_sizes_can_be_read():
    assert [megabytes(count) for count in (85_000, 2_560_000, 12_345_678, 5_000_000_000)] == ["0.085 MB", "2.6 MB", "12 MB", "5,000 MB"]


def test_the_option_has_one_form():
    assert draws_of(None) is None and draws_of("draws=200") == 200
    for text in ("200", "draws=", "draws=19", "draws=-200", "draws=2e2", "frames=200", "draws=²00"):
        with pytest.raises(InputError, match=r"--keep: .*expected draws=N with N from 20 up"):
            draws_of(text)


def test_no_fewer_draws_than_particles_is_no_thinning():
    said = []
    assert draws_to_keep(200, {"particles": 200}, said.append) is None and "all 200 particles are stored" in said[0]
    assert draws_to_keep(200, {"particles": 201}, said.append) == 200 and draws_to_keep(None, {"particles": 5}, said.append) is None
    assert len(said) == 1
