"""A run that stopped and went on ends as one that never stopped, and goes on only as what it was."""

import dataclasses
import errno
import json
import os
import shutil
import signal
import tomllib
from pathlib import Path

import cv2
import jax
import numpy as np
import pytest

from bayes_body.base.errors import InputError
from bayes_body.base.files.lock import locked
from bayes_body.cli.main import main
from bayes_body.kernels import annealed
from bayes_body.model.build import build_model
from bayes_body.recording.session.read import load_session, save_session
from bayes_body.results.storage import FrameFiles, frame_files
from bayes_body.results.storage.frame_archive import FrameArchive
from bayes_body.results.storage.frame_files import save_frame
from bayes_body.results.storage.saved_run import load_run
from bayes_body.runs.run import run
from bayes_body.runs.settings import Settings
from bayes_body.runs.smooth import SmoothSettings, smooth_run
from bayes_body.tracking.track import track
from bayes_body.view.report.head import command as command_of
from bayes_body.view.report.page import page

from .conftest import contents, digests
from .looped import link_looped

FRAMES = 6
SMALL = {"model": "arm", "overrides": {"particles": 40}, "runs": 2, "seed": 3}
LEFT = {"run.toml", "posterior.nc", "summary.json", "manifest.json", "overlay.mp4", "overlay", "frames", ".lock"}


@pytest.fixture(scope="module")
def uninterrupted(looped, tmp_path_factory):
    out = tmp_path_factory.mktemp("whole") / "run"
    run(Settings(looped(FRAMES), out, **SMALL), lambda line: None, bar=False)
    return out


@pytest.fixture
def stopping(monkeypatch):
    """`stopping(3, error)`: frame 3 is not kept, for that error."""

    def arrange(frame, error):
        save = frame_files.save_frame

        def save_or_stop(path, result, place):
            if path.name == f"{frame:06d}.npz":
                monkeypatch.setattr(frame_files, "save_frame", save)
                raise error
            return save(path, result, place)

        monkeypatch.setattr(frame_files, "save_frame", save_or_stop)

    return arrange


@pytest.mark.slow
def test_the_draws_of_a_finished_run_are_in_its_posterior_alone(uninterrupted):
    assert {path.name for path in uninterrupted.iterdir()} == LEFT
    assert [path.name for path in (uninterrupted / "frames").iterdir()] == ["index.npz"]
    assert (uninterrupted / "frames" / "index.npz").stat().st_size < 10_000


@pytest.mark.slow
@pytest.mark.parametrize("moment", ["before the index", "among the files"])
def test_a_stop_while_the_files_of_the_frames_are_removed_costs_nothing(looped, tmp_path, uninterrupted, monkeypatch, moment):
    """The second time the index and the posterior are of fewer frames than there are."""
    out, lines = tmp_path / "run", []
    for frames in (2, FRAMES):
        with monkeypatch.context() as patch:
            stop_in_archive(patch, moment)
            with pytest.raises(KeyboardInterrupt):
                run(Settings(looped(FRAMES), out, frames=frames, resume=True, **SMALL), lines.append, bar=False)
        assert len(FrameFiles(out / "frames")) == frames and any((out / "frames").glob("0*.npz"))
    run(Settings(looped(FRAMES), out, resume=True), lines.append, bar=False)
    assert f"{out}: all 6 frames exist, nothing is left to track" in lines
    assert [path.name for path in (out / "frames").iterdir()] == ["index.npz"]
    assert (out / "posterior.nc").read_bytes() == (uninterrupted / "posterior.nc").read_bytes()


def stop_in_archive(patch, moment):
    """Stop before the index is written, or after one frame's file was removed."""
    unlink = Path.unlink

    def write(archive, folder):
        raise KeyboardInterrupt

    def unlink_or_stop(path, missing_ok=False):
        unlink(path, missing_ok)
        if path.name in ("000000.npz", "000003.npz"):
            raise KeyboardInterrupt

    if moment == "before the index":
        patch.setattr(FrameArchive, "write", write)
    else:
        patch.setattr(Path, "unlink", unlink_or_stop)


KEEP = {"keep": 20}


@pytest.mark.slow
def test_a_thinned_run_has_the_figures_of_all_particles(looped, tmp_path, uninterrupted, stopping):
    out, lines = tmp_path / "run", []
    stopping(3, KeyboardInterrupt())
    with pytest.raises(KeyboardInterrupt):
        run(Settings(looped(FRAMES), out, **SMALL, **KEEP), lines.append, bar=False)
    # All particles of the last frame are there, and of the next one, whose draws could not be stored.
    names = ["000000.npz", "000001.npz", "000002.npz", "last_000002.npz", "last_000003.npz"]
    assert [path.name for path in sorted((out / "frames").iterdir())] == names
    with pytest.raises(InputError, match="--keep was draws=20 and is now draws=30"):
        run(Settings(looped(FRAMES), out, resume=True, keep=30), lines.append, bar=False)
    summary = run(Settings(looped(FRAMES), out, resume=True), lines.append, bar=False)
    assert [path.name for path in sorted((out / "frames").iterdir())] == ["index.npz", "last_000005.npz"]
    whole = json.loads((uninterrupted / "summary.json").read_text())
    exact = ("particles", "ess_min", "ess_median", "log_evidence", "iou_median", "marker_disagreement_mm", "rhat_max", "rhat_share", "pareto_k_max")
    exact += ("independent_draws_min", "ancestors_min", "log_evidence_sd", "warnings")
    for name in exact:
        assert summary[name] == pytest.approx(whole[name], rel=1e-6) if isinstance(whole[name], float) else summary[name] == whole[name], name
    with load_run(out) as few, load_run(uninterrupted) as all_of_them:
        assert few.tree["posterior"].sizes["draw"] == 20 and few.tree.attrs["thinned_from"] == 40
        # Every draw is a particle of the same frame of the whole run.
        particles = all_of_them.tree["posterior"]["pose"].values
        for chain, draw, frame in np.ndindex(2, 20, FRAMES):
            assert (few.tree["posterior"]["pose"].values[chain, draw, frame] == particles[chain, :, frame]).all(axis=-1).any()
        weights = np.exp(all_of_them.tree["sample_stats"]["log_weight"].values)[..., None]
        np.testing.assert_allclose(few.tree["filter"]["all_mean_pose"], (weights * particles).sum(axis=1), rtol=1e-4, atol=1e-6)
        assert "--keep draws=20" in command_of(few) and 'id="filter"' in page(few)


@pytest.mark.slow
def test_a_thinned_run_goes_on_with_all_particles_of_its_last_frame(looped, tmp_path):
    out, lines = tmp_path / "run", []
    run(Settings(looped(FRAMES), tmp_path / "whole", **SMALL, **KEEP), lines.append, bar=False)
    run(Settings(looped(FRAMES), out, frames=2, **SMALL, **KEEP), lines.append, bar=False)
    run(Settings(looped(FRAMES), out, frames=FRAMES, resume=True), lines.append, bar=False)
    assert (out / "posterior.nc").read_bytes() == (tmp_path / "whole" / "posterior.nc").read_bytes()
    # It is smoothed from the draws that it has, along which no ancestors are known.
    smooth_run(SmoothSettings(out, tmp_path / "smoothed", {"draws": 30}), lines.append, bar=False)
    assert any("20 of 40 particles of a frame are stored" in line for line in lines)
    with pytest.raises(InputError, match=r"only 20 of 40 particles of a frame are stored; expected .* --start ensemble"):
        smooth_run(SmoothSettings(out, tmp_path / "other", {"draws": 30, "start": "particles"}), lines.append, bar=False)
    (out / "frames" / "last_000005.npz").unlink()
    with pytest.raises(InputError, match=r"last_000005\.npz: missing; .*start again in another folder"):
        FrameFiles(out / "frames").last  # noqa: B018


@pytest.mark.parametrize("options", [pytest.param(SMALL, id="the same command", marks=pytest.mark.slow), pytest.param({}, id="--resume alone")])
def test_an_interrupted_run_goes_on_to_the_same_end(looped, tmp_path, uninterrupted, stopping, options):
    out, lines = tmp_path / "run", []
    stopping(3, KeyboardInterrupt())
    with pytest.raises(KeyboardInterrupt):
        run(Settings(looped(FRAMES), out, **SMALL), lines.append, bar=False)
    assert lines[-1] == f"{out}: 3 frames are kept; the same command with --resume continues from there."
    assert {path.name for path in out.iterdir()} == {"run.toml", "frames", ".lock"}
    summary = run(Settings(looped(FRAMES), out, resume=True, **options), lines.append, bar=False)
    assert f"{out}: continuing at frame 3 of 6" in lines
    assert {path.name for path in out.iterdir()} == LEFT
    assert contents(out / "posterior.nc") == contents(uninterrupted / "posterior.nc")
    assert (out / "posterior.nc").read_bytes() == (uninterrupted / "posterior.nc").read_bytes()
    timed = {"seconds_total", "seconds_compile", "seconds_per_frame", "evaluations_per_second", "peak_memory_mb"}
    before = json.loads((uninterrupted / "summary.json").read_text())
    assert {key: value for key, value in summary.items() if key not in timed} == {key: value for key, value in before.items() if key not in timed}
    frames = list(FrameFiles(out / "frames"))
    assert summary["seconds_total"] == pytest.approx(sum(frame.seconds + frame.seconds_ready for frame in frames))
    assert [frame.seconds_ready > 0 for frame in frames] == [True, False, False, True, False, False]


@pytest.mark.slow
def test_more_frames_may_be_asked_for(looped, tmp_path, uninterrupted):
    out = tmp_path / "run"
    run(Settings(looped(FRAMES), out, frames=2, **SMALL), lambda line: None, bar=False)
    assert contents(out / "posterior.nc") != contents(uninterrupted / "posterior.nc")
    summary = run(Settings(looped(FRAMES), out, frames=FRAMES, resume=True), lambda line: None, bar=False)
    assert summary["frames"] == FRAMES
    assert contents(out / "posterior.nc") == contents(uninterrupted / "posterior.nc")
    assert {path.name for path in (out / "overlay").iterdir()} == {path.name for path in (uninterrupted / "overlay").iterdir()}
    with pytest.raises(InputError, match="--frames: 3; expected at least the 6 frames that the run has"):
        run(Settings(looped(FRAMES), out, frames=3, resume=True), lambda line: None, bar=False)


@pytest.mark.slow
def test_without_its_posterior_a_finished_run_is_computed_again(looped, tmp_path, uninterrupted):
    shutil.copytree(uninterrupted, tmp_path / "run")
    (tmp_path / "run" / "posterior.nc").unlink()
    lines = []
    run(Settings(looped(FRAMES), tmp_path / "run", resume=True), lines.append, bar=False)
    assert any(line.endswith("It is computed again.") and "posterior.nc: missing; expected the draws of frame 0" in line for line in lines)
    assert (tmp_path / "run" / "posterior.nc").read_bytes() == (uninterrupted / "posterior.nc").read_bytes()


@pytest.mark.parametrize("missing", ["summary.json", "overlay.mp4", "overlay/frame_000000.png"])
def test_what_is_missing_of_a_finished_run_is_made_again(looped, tmp_path, uninterrupted, missing):
    before = {path: path.stat().st_mtime_ns for path in uninterrupted.rglob("*") if path.is_file()}
    (uninterrupted / missing).unlink()
    lines = []
    run(Settings(looped(FRAMES), uninterrupted, resume=True), lines.append, bar=False)
    assert f"{uninterrupted}: all 6 frames exist, nothing is left to track" in lines
    assert (uninterrupted / missing).exists()
    made = {path for path, time in before.items() if path.stat().st_mtime_ns != time}
    pictures = {path for path in before if "overlay" in str(path.relative_to(uninterrupted))}
    assert made - {uninterrupted / name for name in (".lock", "run.toml", "manifest.json")} == (
        pictures if "overlay" in missing else {uninterrupted / missing}
    )


def test_a_damaged_frame_is_said_and_computed_again(looped, tmp_path, uninterrupted, stopping):
    out, lines = tmp_path / "run", []
    stopping(4, InputError("stopped"))
    with pytest.raises(InputError, match="stopped"):
        run(Settings(looped(FRAMES), out, **SMALL), lines.append, bar=False)
    path = out / "frames" / "000002.npz"
    path.write_bytes(path.read_bytes()[:-100])
    run(Settings(looped(FRAMES), out, resume=True), lines.append, bar=False)
    assert any("000002.npz: " in line and line.endswith("It is computed again.") for line in lines)
    assert f"{out}: continuing at frame 2 of 6" in lines
    assert contents(out / "posterior.nc") == contents(uninterrupted / "posterior.nc")


def test_a_folder_with_frames_is_refused_without_resume(looped, tmp_path, stopping):
    out = tmp_path / "run"
    stopping(3, InputError("stopped"))
    with pytest.raises(InputError, match="stopped"):
        run(Settings(looped(FRAMES), out, **SMALL), lambda line: None, bar=False)
    said = "holds a run that has 3 frames; .*; continue it with --resume, or name another folder"
    with pytest.raises(InputError, match=said):
        run(Settings(looped(FRAMES), out, **SMALL), lambda line: None, bar=False)
    (out / "run.toml").unlink()
    with pytest.raises(InputError, match="holds frames, which a run would replace"):
        run(Settings(looped(FRAMES), out, resume=True), lambda line: None, bar=False)


@pytest.mark.parametrize("name", ["overlay", "overlay.mp4", "posterior.nc", "manifest.json", "frames"])
@pytest.mark.parametrize("resume", [False, True])
def test_what_a_user_has_in_the_folder_is_not_touched(looped, tmp_path, name, resume):
    """A session's folder as the folder of the run, say, with pictures of one's own in overlay/."""
    own = tmp_path / name / "mine.png" if "." not in name else tmp_path / name
    own.parent.mkdir(exist_ok=True)
    own.write_text("mine")
    with pytest.raises(InputError, match=f"holds {name}, which a run would replace; .*; name another with --out"):
        run(Settings(looped(FRAMES), tmp_path, **SMALL, resume=resume), lambda line: None, bar=False)
    assert own.read_text() == "mine" and {path.name for path in tmp_path.iterdir()} <= {name, ".lock"}


def test_a_settings_file_of_somebody_else_is_not_replaced(looped, tmp_path):
    (tmp_path / "run.toml").write_text("[mine]\n")
    with pytest.raises(InputError, match="written by another version"):
        run(Settings(looped(FRAMES), tmp_path, **SMALL), lambda line: None, bar=False)
    assert (tmp_path / "run.toml").read_text() == "[mine]\n"


@pytest.mark.parametrize("name", ["overlay", "frames", "posterior.nc", "run.toml"])
def test_a_link_in_the_folder_of_a_run_leads_no_writer_elsewhere(looped, tmp_path, uninterrupted, name):
    shutil.copytree(uninterrupted, tmp_path / "run")
    (tmp_path / "run" / name).rename(tmp_path / name)
    (tmp_path / "run" / name).symlink_to(tmp_path / name)
    before = digests(tmp_path / name)
    with pytest.raises(InputError, match=f"{name}: a link to elsewhere"):
        run(Settings(looped(FRAMES), tmp_path / "run", resume=True), lambda line: None, bar=False)
    assert digests(tmp_path / name) == before


@pytest.mark.slow
def test_pictures_of_a_user_in_the_overlay_stay(looped, tmp_path):
    out = tmp_path / "run"
    run(Settings(looped(FRAMES), out, frames=2, **SMALL), lambda line: None, bar=False)
    mine = [out / "overlay" / name for name in ("frame_000099.png", ".partial-mine.png")]
    for path in mine:
        path.write_text("mine")
    run(Settings(looped(FRAMES), out, frames=FRAMES, resume=True), lambda line: None, bar=False)
    assert all(path.read_text() == "mine" for path in mine)


def test_a_folder_that_another_process_works_on(looped, uninterrupted):
    with locked(uninterrupted), pytest.raises(InputError, match=rf"process {os.getpid()} works on it"):
        run(Settings(looped(FRAMES), uninterrupted, resume=True), lambda line: None, bar=False)


@pytest.mark.slow
def test_resume_of_nothing_begins(looped, tmp_path, uninterrupted):
    run(Settings(looped(FRAMES), tmp_path / "run", resume=True, **SMALL), lambda line: None, bar=False)
    assert contents(tmp_path / "run" / "posterior.nc") == contents(uninterrupted / "posterior.nc")


CHANGES = {
    "seed": ({"seed": 4}, "--seed was 3 and is now 4"),
    "runs": ({"runs": 1}, "--runs was 2 and is now 1"),
    "particles": ({"overrides": {"particles": 41}}, "kernel.particles was 40 and is now 41"),
    "kernel": ({"kernel": "annealed"}, "kernel.kind was sir and is now annealed"),
    "model": ({"model": "arm_edges", "kernel": "sir"}, "--model was arm and is now arm_edges"),
}


@pytest.mark.parametrize("change", CHANGES)
def test_another_run_is_not_continued(looped, uninterrupted, change):
    settings, said = CHANGES[change]
    before = {path: path.stat().st_mtime_ns for path in uninterrupted.rglob("*") if path.is_file() and path.name != ".lock"}
    with pytest.raises(InputError, match=f"cannot be continued: .*{said}"):
        run(Settings(looped(FRAMES), uninterrupted, resume=True, **settings), lambda line: None, bar=False)
    assert before == {path: path.stat().st_mtime_ns for path in before}


def test_another_session_is_not_continued(looped, tmp_path, uninterrupted):
    text = (looped(FRAMES) / "session.toml").read_text(encoding="utf-8")
    assert "fps = 60.0" in text
    (tmp_path / "session.toml").write_text(text.replace("fps = 60.0", "fps = 30.0"), encoding="utf-8")
    with pytest.raises(InputError, match=r"session\.toml: fps was 60\.0 and is now 30\.0"):
        run(Settings(tmp_path, uninterrupted, resume=True), lambda line: None, bar=False)


def _exchange(folder):
    """Two images of a camera."""
    first, last = folder / "view0" / "image000000.png", folder / "view0" / "image000005.png"
    one, other = first.resolve(), last.resolve()
    for path, target in ((first, other), (last, one)):
        path.unlink()
        path.symlink_to(target)


def _other_images(folder):
    """The same number of files with other pictures."""
    for path in sorted(folder.glob("view0/image*")):
        picture = cv2.imread(str(path))
        path.unlink()
        cv2.imwrite(str(path), picture[::-1])


def _one_is_gone(folder):
    (folder / "view1" / "image000003.png").unlink()


CHANGED = {_exchange: "images of a", _other_images: "images of a", _one_is_gone: "images of b"}


@pytest.mark.parametrize("change", CHANGED)
def test_another_recording_is_not_continued(textured_session, tmp_path, change):
    session, out = link_looped(textured_session, tmp_path / "session", FRAMES), tmp_path / "run"
    run(Settings(session, out, frames=2, **SMALL), lambda line: None, bar=False)
    change(session)
    before = digests(out)
    with pytest.raises(InputError, match=rf"cannot be continued: the recording has changed \({CHANGED[change]}\)"):
        run(Settings(session, out, frames=FRAMES, resume=True), lambda line: None, bar=False)
    assert digests(out) == before


def test_frames_of_another_seed_are_not_adopted(looped, tmp_path, uninterrupted, stopping):
    out = tmp_path / "run"
    stopping(2, InputError("stopped"))
    with pytest.raises(InputError, match="stopped"):
        run(Settings(looped(FRAMES), out, **{**SMALL, "seed": 4}), lambda line: None, bar=False)
    foreign = FrameFiles(uninterrupted / "frames")._stored(2)
    save_frame(out / "frames" / "000002.npz", foreign.result, foreign.place)
    before = digests(out)
    with pytest.raises(InputError, match=r"000002\.npz: belongs to another run"):
        run(Settings(looped(FRAMES), out, resume=True), lambda line: None, bar=False)
    assert digests(out) == before


@pytest.mark.slow
@pytest.mark.parametrize("name", ["posterior.nc", "summary.json", "manifest.json"])
def test_a_changed_result_is_made_again_from_the_frames(looped, tmp_path, uninterrupted, name):
    out = shutil.copytree(uninterrupted, tmp_path / "run")
    content = bytearray((out / name).read_bytes())
    content[len(content) // 2] ^= 1
    (out / name).write_bytes(content)
    run(Settings(looped(FRAMES), out, resume=True), lambda line: None, bar=False)
    assert (out / "posterior.nc").read_bytes() == (uninterrupted / "posterior.nc").read_bytes()
    with load_run(out) as run_again:
        assert run_again.summary["seed"] == 3


def test_the_run_file_keeps_the_session_s_text(looped, uninterrupted):
    record = tomllib.loads((uninterrupted / "run.toml").read_text(encoding="utf-8"))
    assert record["session"]["text"] == (looped(FRAMES) / "session.toml").read_text(encoding="utf-8")


@pytest.mark.parametrize("kept", [0, 1, 4])
def test_frames_that_are_kept_are_not_computed_again(textured_session, kept):
    """In memory, of a kernel with layers: what is there already is taken as it is, and the end is the same."""
    model, key, kernel = build_model("arm", textured_session), jax.random.key(5), annealed(layers=2)
    whole = track(key, textured_session, model, kernel, particles=40, runs=2)
    store, told = list(whole.frames)[:kept], []
    again = track(key, textured_session, model, kernel, particles=40, runs=2, on_frame=told.append, into=store)
    assert again.frames is store and all(a is b for a, b in zip(store[:kept], whole.frames, strict=False))
    assert [(progress.frame, progress.frames) for progress in told] == [(frame, 5) for frame in range(kept + 1, 6)]
    for name in ("ancestors", "survival_rate", "evaluations"):
        assert np.array_equal(getattr(again.info, name), getattr(whole.info, name))
    assert again.states["pose"].tobytes() == whole.states["pose"].tobytes()
    assert again.log_weights.tobytes() == whole.log_weights.tobytes()


@pytest.mark.parametrize(
    ("sizes", "said"), [({"particles": 41}, "particles: 41; expected the 40"), ({"runs": 1}, "runs: 1"), ({"frames": 2}, "frames: 2; .* the 5")]
)
def test_frames_of_another_size_are_not_continued(textured_session, sizes, said):
    model, key, kernel = build_model("arm", textured_session), jax.random.key(5), annealed(layers=2)
    whole = track(key, textured_session, model, kernel, particles=40, runs=2)
    with pytest.raises(InputError, match=said):
        track(key, textured_session, model, kernel, **{"particles": 40, "runs": 2, **sizes}, into=list(whole.frames))


@pytest.mark.slow
@pytest.mark.parametrize("what", ["posterior", "summary"])
def test_what_fails_after_the_last_frame_is_made_by_the_next_one(looped, tmp_path, uninterrupted, monkeypatch, what):
    """A disk that is full once the frames are kept."""
    out, lines = tmp_path / "run", []

    def full(*arguments, **options):
        raise InputError(f"{what}: {errno.ENOSPC}")

    name = {"posterior": "stream_posterior", "summary": "summarise"}[what]
    with monkeypatch.context() as patch:
        patch.setattr(f"bayes_body.runs.finish.{name}", full)
        with pytest.raises(InputError, match=what):
            run(Settings(looped(FRAMES), out, **SMALL), lines.append, bar=False)
    assert "6 frames are kept" in lines[-1]
    run(Settings(looped(FRAMES), out, resume=True), lines.append, bar=False)
    assert {path.name for path in out.iterdir()} == LEFT
    assert contents(out / "posterior.nc") == contents(uninterrupted / "posterior.nc")


@pytest.mark.slow
def test_a_run_whose_pictures_cannot_be_drawn_is_complete_each_time(looped, tmp_path, uninterrupted, monkeypatch):
    out, lines = tmp_path / "run", []

    def refuse(*arguments, **options):
        raise InputError("overlay.mp4: the encoder refuses it.")

    with monkeypatch.context() as patch:
        patch.setattr("bayes_body.runs.finish.draw_overlay", refuse)
        for settings in (Settings(looped(FRAMES), out, **SMALL), Settings(looped(FRAMES), out, resume=True)):
            lines.clear()
            assert run(settings, lines.append, bar=False)["frames"] == FRAMES
            assert "note: no overlay: overlay.mp4: the encoder refuses it. The run is complete; the same command with --resume" in "\n".join(lines)
    assert {path.name for path in out.iterdir()} == LEFT - {"overlay.mp4", "overlay"}
    assert contents(out / "posterior.nc") == contents(uninterrupted / "posterior.nc")


@pytest.mark.slow
def test_a_video_that_plays_at_another_rate_is_said(looped, tmp_path, uninterrupted):
    session, lines = tmp_path / "fast", []
    save_session(dataclasses.replace(load_session(looped(FRAMES)), folder=session, fps=70_000.0))
    for folder in looped(FRAMES).iterdir():
        if folder.is_dir():
            (session / folder.name).symlink_to(folder)
    run(Settings(session, tmp_path / "run", **SMALL), lines.append, bar=False)
    assert "note: overlay.mp4 plays 1000 frames a second: players do not show the session's 70000." in lines
    assert {path.name for path in (tmp_path / "run").iterdir()} == LEFT


def test_a_run_that_is_terminated_says_how_to_go_on(looped, tmp_path, monkeypatch, capsys):
    append = FrameFiles.append

    def terminated(frames, result):
        append(frames, result)
        if len(frames) == 2:
            os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setattr(FrameFiles, "append", terminated)
    with pytest.raises(SystemExit) as stopped:
        main(["track", str(looped(FRAMES)), "--model", "arm", "--out", str(tmp_path / "run"), "--particles", "40"])
    out, err = capsys.readouterr()
    assert stopped.value.code == 143
    assert "2 frames are kept; the same command with --resume continues from there." in out
    assert err.splitlines()[-1] == "bayes-body: terminated."
