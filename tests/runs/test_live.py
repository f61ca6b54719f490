"""A run that tracks frames as they come: its posterior is that of the same files after the recording, bit for bit; its page, and its errors."""

import json
import os
import signal
import threading
import time
import urllib.error
import urllib.request
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr
from pose_estimator import PoseEstimator

from bayes_body.base.errors import InputError
from bayes_body.model.build import build_model
from bayes_body.recording.readers.keypoints import arriving
from bayes_body.recording.session.read import load_session, save_session
from bayes_body.results.storage import FrameFiles
from bayes_body.results.storage.saved_run import load_run
from bayes_body.runs.live import run_live
from bayes_body.runs.run import run
from bayes_body.runs.settings import LiveSettings, Settings, check_live
from bayes_body.tracking.track import Progress
from bayes_body.view.live import LivePage, served

FRAMES, STOPPED_AT, PARTICLES, RUNS = 5, 3, 40, 2
# Seconds: longer than any test, so that no outcome depends on the clock.
ENDLESS_S = 1e4
MODEL = {"model": "arm_markers", "overrides": {"particles": PARTICLES}, "runs": RUNS}


def contents(path):
    """Every array of a posterior's file, as bytes."""
    with xr.open_datatree(path) as tree:
        return {f"{group.path}/{name}": array.values.tobytes() for group in tree.subtree for name, array in group.data_vars.items()}


def interrupt_after(path, frames):
    """Press Ctrl-C when so many frames are in the file of delays."""
    while not path.exists() or len(path.read_text().splitlines()) <= frames:
        time.sleep(0.01)
    os.kill(os.getpid(), signal.SIGINT)


@pytest.fixture(scope="module")
def recorded(textured_session, tmp_path_factory):
    """A recording of five frames, tracked while it was recorded, and stopped and continued on the way."""
    if threading.current_thread() is not threading.main_thread():
        pytest.skip("only the main thread receives signals")
    folder = tmp_path_factory.mktemp("live")
    session, out, lines, summaries = folder / "session", folder / "run", [], []
    session.mkdir()
    for view in textured_session.views:
        (session / view.camera.name).symlink_to(textured_session.folder / view.camera.name)
    estimator = PoseEstimator(textured_session, folder / "pose")
    estimator.write(range(1))
    save_session(estimator.imported(session, 1))
    live = LiveSettings(estimator.folder, ENDLESS_S)
    # A shell that starts the tests in the background lets them ignore Ctrl-C.
    ignored = signal.signal(signal.SIGINT, signal.default_int_handler)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(arriving, "LATE_S", ENDLESS_S)
        for frames, others in (
            (range(1, STOPPED_AT), [threading.Thread(target=interrupt_after, args=(out / "live.csv", STOPPED_AT))]),
            (range(STOPPED_AT, FRAMES), []),
        ):
            threads = [threading.Thread(target=estimator.write, args=(frames,)), *others]
            for thread in threads:
                thread.start()
            limit = None if others else FRAMES
            summaries.append(run_live(Settings(session, out, **MODEL, frames=limit, resume=not others, live=live), lines.append, bar=False))
            for thread in threads:
                thread.join()
    signal.signal(signal.SIGINT, ignored)
    return SimpleNamespace(session=session, out=out, lines=lines, summaries=summaries, pose=estimator.folder)


def test_the_posterior_is_that_of_the_same_files_after_the_recording(recorded, tmp_path):
    first, last = recorded.summaries
    assert (first["frames"], last["frames"]) == (STOPPED_AT, FRAMES)
    assert (first["live"]["end"], last["live"]["end"]) == ("it was stopped", f"{FRAMES} frames were asked for")
    assert last["live"]["frames"] == FRAMES - STOPPED_AT and last["live"]["missing"] == {}
    assert load_session(recorded.session).frames == FRAMES
    run(Settings(recorded.session, tmp_path / "run", **MODEL, pictures=False), lambda _: None, bar=False)
    assert contents(recorded.out / "posterior.nc") == contents(tmp_path / "run" / "posterior.nc")
    # It has everything, so that what reads a run reads it, and the pictures can still be drawn.
    lines = []
    summary = run(Settings(recorded.session, recorded.out, resume=True), lines.append, bar=False)
    assert f"{recorded.out}: all {FRAMES} frames exist, nothing is left to track" in lines
    assert (recorded.out / "overlay.mp4").exists() and summary["live"] == last["live"]


def test_each_frame_has_its_delay(recorded):
    header, *rows = (recorded.out / "live.csv").read_text().splitlines()
    assert header == "frame,delay_s,waiting" and [int(row.split(",")[0]) for row in rows] == list(range(FRAMES))
    assert all(float(row.split(",")[1]) > 0 and int(row.split(",")[2]) >= 0 for row in rows)
    assert any("shows the last second" in line for line in recorded.lines)
    assert any(line.startswith("delay      median") for line in recorded.lines)


def ask(address, path="", host=None, method="GET"):
    request = urllib.request.Request(address + path, method=method, headers={"Host": host} if host else {})
    try:
        with urllib.request.urlopen(request, timeout=60) as answer:
            return answer.status, answer.headers, answer.read().decode()
    except urllib.error.HTTPError as answer:
        return answer.code, answer.headers, ""


def test_the_page_shows_the_last_second_to_this_machine_only(recorded):
    with load_run(recorded.out) as saved:
        results = list(FrameFiles(recorded.out / "frames", saved.id))
        page = LivePage(saved.model, saved.session)
        assert json.loads(page.json())["frames"] == []
        for frame, result in enumerate(results):
            page.add(Progress(frame + 1, FRAMES, 0.1, 1.0, 1.0, False, result), {"delay_s": 0.1 * frame, "waiting": 2, "frames_per_second": 30.0})
        names = list(saved.model.body.dof_names)
        with served(page) as address:
            port = address.rstrip("/").rpartition(":")[2]
            assert address.startswith("http://127.0.0.1:")
            status, headers, html = ask(address)
            assert status == 200 and "default-src 'none'" in headers["Content-Security-Policy"]
            # Nothing is loaded from elsewhere.
            assert "http" not in html.replace("http://www.w3.org", "")
            status, headers, text = ask(address, "state.json", f"localhost:{port}")
            assert status == 200 and headers["Content-Type"].startswith("application/json") and "Access-Control-Allow-Origin" not in headers
            refusals = [ask(address, "state.json", host)[0] for host in ("evil.example", f"evil.example:{port}", "127.0.0.1")]
            assert refusals == [421, 421, 421] and ask(address, "../run.toml")[0] == 404 and ask(address, method="POST")[0] == 501
            with pytest.raises(InputError, match=rf"--port: {port} cannot be used"), served(page, int(port)):
                pass
    state = json.loads(text)
    assert (state["dofs"], state["number"], state["waiting"], state["draws"]) == (names, FRAMES - 1, 2, PARTICLES)
    # The last frame that is shown is the last one; its mean and interval are those of its draws, up to the error of resampling them.
    result = results[-1]
    degrees, weights = np.degrees(result.states["pose"]).reshape(-1, len(names)), np.exp(result.log_weights).ravel()
    mean = np.average(degrees, axis=0, weights=weights)
    sd = np.sqrt(np.average((degrees - mean) ** 2, axis=0, weights=weights))
    shown = {name: np.array(values) for name, values in state["frames"][-1].items() if name != "ago_s"}
    assert (np.abs(shown["mean"] - mean) <= sd + 1e-3).all() and (shown["low"] <= shown["high"]).all()
    parts = np.array(state["parts"]["mean"])
    lengths = np.linalg.norm(parts[:, 1] - parts[:, 0], axis=-1)
    assert parts.shape == (len(state["sides"]), 2, 3) and (lengths <= np.asarray(saved.model.body.lengths) + 1e-3).all()


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"model": "arm_silhouette"}, "--live: the model 'arm_silhouette' reads silhouettes; expected a model that reads only the keypoints"),
        ({"recover": True}, "--live: a lost run would look for the person in pictures"),
        ({"first_frame": 99}, "frame 99 did not come: no new file came for 0.2 s"),
    ],
)
def test_what_cannot_be_tracked_live_is_refused(recorded, tmp_path, changes, problem):
    settings = {"model": "arm_markers"} | changes
    # Only the case that waits in vain waits for a short time.
    live = LiveSettings(recorded.pose, 0.2 if "first_frame" in changes else ENDLESS_S)
    with pytest.raises(InputError) as refused:
        run_live(Settings(recorded.session, tmp_path / "run", **settings, live=live), lambda _: None, bar=False)
    assert problem in str(refused.value)


def test_a_first_pose_that_only_pictures_give_is_refused(textured_session):
    model = build_model("arm_markers", textured_session)
    with pytest.raises(InputError, match="--live: frame 0 has too few keypoints for a first pose, or --init auto looks for it in pictures"):
        check_live(model, textured_session, "searched", False)
    check_live(model, textured_session, "fitted", False)
