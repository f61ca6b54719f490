"""Videos with known timestamps: which frames are paired, read from the pictures themselves, and what the user is told."""

import json
import struct
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from bayes_body.base.errors import InputError
from bayes_body.recording.observation.pictures import has_picture, read_greys
from bayes_body.recording.readers.check import check_session
from bayes_body.recording.readers.keypoints.openpose import LAYOUTS
from bayes_body.recording.readers.keypoints.series import read_series
from bayes_body.recording.readers.opencv import import_opencv
from bayes_body.recording.readers.options import Options
from bayes_body.recording.readers.videos.clock import clock_of
from bayes_body.recording.readers.videos.stream import Stamps
from bayes_body.recording.session.read import load_session, save_session
from bayes_body.recording.session.session import Session, Span

SIZE, BLOCK, BITS, BASE = (96, 48), 16, 12, Fraction(1, 90_000)
OPTIONS = Options(unit="m", up="z")


def picture(number: int) -> np.ndarray:
    """A number in black and white blocks, six in a row, and a third row that shows something whatever the number."""
    bits = [(number >> bit) & 1 for bit in range(BITS)] + [1, 0, 1, 0, 1, 0]
    return np.kron(np.reshape(bits, (3, 6)), np.ones((BLOCK, BLOCK))).astype(np.uint8)[..., None].repeat(3, axis=-1) * 200 + 20


def number_of(grey: np.ndarray) -> int:
    middles = grey[BLOCK // 2 :: BLOCK, BLOCK // 2 :: BLOCK].ravel()[:BITS]
    return sum(1 << bit for bit, value in enumerate(middles) if value > 120)


def film(path: Path, numbers, times_s) -> None:
    """A video of pictures of these numbers with these times of presentation."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=30, options={"preset": "ultrafast", "crf": "18"})
        stream.width, stream.height, stream.pix_fmt = *SIZE, "yuv420p"
        stream.codec_context.time_base = BASE
        for number, time in zip(numbers, times_s, strict=True):
            frame = av.VideoFrame.from_ndarray(picture(int(number)), "bgr24")
            frame.time_base, frame.pts = BASE, round(float(time) / BASE)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def laboratory(folder: Path, cameras: dict[str, tuple]) -> Path:
    """Calibrated cameras and their videos, each of numbers and times."""
    folder.mkdir()
    for i, (name, (numbers, times)) in enumerate(cameras.items()):
        file = cv2.FileStorage(str(folder / f"{name}.yml"), cv2.FILE_STORAGE_WRITE)
        R = cv2.Rodrigues(np.array([0.0, 0.6 * i, 0.0]))[0] @ np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
        lens = np.array([[90.0, 0, 48], [0, 90, 24], [0, 0, 1]])
        for key, value in (("K", lens), ("dist", np.zeros(5)), ("R", R), ("T", np.array([0.0, 0.9, 4.0]))):
            file.write(key, value)
        file.release()
        film(folder / f"{name}.mp4", numbers, times)
    return folder


def shown(session: Session) -> list[list[int | None]]:
    """For each camera the number in the picture of each frame; None where it has no picture."""
    rows = []
    for view in session.views:
        greys = [read_greys(session, frame, view) for frame in range(session.frames)]
        assert [grey is not None for grey in greys] == [has_picture(session, frame, view) for frame in range(session.frames)]
        rows.append([None if grey is None else number_of(grey) for grey in greys])
    return rows


def clock_remarks(remarks: list[str]) -> list[str]:
    return [remark for remark in remarks if "no masks" not in remark and "different numbers of frames" not in remark]


K = np.arange(30)
LOST = np.delete(np.arange(45), range(12, 27))
ALTERNATING = K // 2 / 120 + K % 2 / 300
EVEN = K, K / 30
# Cameras' videos, further options, the rate, the frames in which camera b has no picture, and beginnings of the remarks.
CASES = {
    "even": ({"a": EVEN, "b": EVEN}, {}, 30, (), []),
    "variable": ({"a": (K, ALTERNATING), "b": (K, ALTERNATING)}, {}, 240, (), ["The frame rate varies: frames of a, b are 3.33 to 5 ms apart"]),
    "wander": ({"a": (K, K / 30 + 0.004 * np.sin(K)), "b": EVEN}, {}, 30, (), []),
    "gap": ({"a": (np.arange(45), np.arange(45) / 30), "b": (LOST, LOST / 30)}, {}, 30, range(12, 27), ["camera 'b' lost 15 frames after frame 11:"]),
    "gap of another rate": (
        {"a": (np.arange(45), np.arange(45) / 30), "b": (LOST, LOST / 30)},
        {"fps": 60.0},
        60,
        range(12, 27),
        ["--fps 60 overrides the videos' rates (a 30, b 30).", "camera 'b' lost 15 frames after frame 11:"],
    ),
    "gap of every camera": (
        {"a": (LOST, LOST / 30), "b": (np.delete(K, [3, 9, 10]), np.delete(K, [3, 9, 10]) / 30)},
        {},
        30,
        (3, 9, 10),
        ["camera 'a' lost 15 frames after frame 11:", "camera 'b' lost 3 frames in 2 places: 1 frame after frame 2, 2 frames after frame 7:"],
    ),
    "drop": ({"a": EVEN, "b": (np.delete(K, 17), np.delete(K, 17) / 30)}, {}, 30, (17,), ["camera 'b' lost 1 frame after frame 16:"]),
    "late": ({"a": EVEN, "b": (K, K / 30 + 0.2)}, {}, 30, (), ["camera 'b': its first timestamp is 0.2 s"]),
    "late by an offset": ({"a": EVEN, "b": (K[6:], K[6:] / 30)}, {"offsets": {"b": -6}}, 30, (), ["The session starts 6 frames into"]),
    "high speed": ({"a": (K, K / 1500), "b": (K, K / 1500)}, {}, 1500, (), ["1500 frames per second, by the timestamps of a, b, are improbable"]),
    "high speed, stated": ({"a": (K, K / 1500), "b": (K, K / 1500)}, {"fps": 1500.0}, 1500, (), []),
    "time lapse": ({"a": (K, K / 2), "b": (K, K / 2)}, {}, 2, (), ["2 frames per second, by the timestamps of a, b, are improbable"]),
}


@pytest.mark.parametrize("case", CASES)
def test_frames_are_paired_as_filmed(tmp_path, case):
    cameras, fields, fps, unseen, beginnings = CASES[case]
    session, remarks = import_opencv(laboratory(tmp_path / "lab", cameras), tmp_path / "session", replace(OPTIONS, **fields))
    assert session.fps == pytest.approx(fps, abs=1e-6)
    a, b = shown(session)
    start = 6 if case == "late by an offset" else 0
    lost = set(range(12, 27)) if case == "gap of every camera" else set()
    assert a == [None if k in lost else k + start for k in range(session.frames)]
    assert b == [None if k in unseen else k + start for k in range(session.frames)]
    said = clock_remarks(remarks)
    assert len(said) == len(beginnings) and all(remark.startswith(beginning) for remark, beginning in zip(said, beginnings, strict=True)), said
    assert load_session(save_session(session)) == session
    # A run's check names the frames that a camera does not see, and nothing else.
    assert [remark.split(" (")[0] for remark in check_session(session)] == [
        f"camera '{name}': {len(gone)} of {session.frames} frames {'is' if len(gone) == 1 else 'are'} missing"
        for name, gone in (("a", lost & set(range(session.frames))), ("b", unseen))
        if gone
    ]


def test_different_rates_are_paired_by_time_on_request(tmp_path):
    # NTSC's rate beside 30: after 500 frames they are half a frame apart. The third camera is twice as fast, and loses ten frames.
    count = 530
    k, fast = np.arange(count), np.delete(np.arange(2 * count), range(300, 310))
    rates = {"a": 30_000 / 1001, "b": 30.0, "c": 60.0}
    source = laboratory(tmp_path / "lab", {"a": (k, k / rates["a"]), "b": (k, k / rates["b"]), "c": (fast, fast / rates["c"])})
    with pytest.raises(InputError, match=r"frame rate: cameras differ: a 29.97, b 30, c 60; expected one rate; give --resample"):
        import_opencv(source, tmp_path / "session", OPTIONS)
    session, remarks = import_opencv(source, tmp_path / "session", replace(OPTIONS, resample=True))
    assert session.fps == pytest.approx(rates["a"], abs=1e-6) and session.frames > count - 3
    # Every camera shows the frame that was filmed nearest to the instant: where two are equally near, either.
    instants_s, gone = np.arange(session.frames) / rates["a"], [150, 151, 152, 153, 154]
    for name, filmed, numbers in zip("abc", (k, k, fast), shown(session), strict=True):
        unseen = gone if name == "c" else []
        assert [frame for frame, number in enumerate(numbers) if number is None] == unseen
        apart = abs(np.delete(np.array(numbers, float), unseen) / rates[name] - np.delete(instants_s, unseen))
        nearest = abs(filmed[:, None] / rates[name] - instants_s).min(axis=0)
        assert apart == pytest.approx(np.delete(nearest, unseen), abs=1e-6)
    lost, resampling = clock_remarks(remarks)
    assert lost.startswith("camera 'c' lost 10 frames after frame 299:")
    assert "a 29.97, b 30, c 60; --resample: at each instant of the slowest camera the nearest frames are paired; the largest" in resampling
    assert "17 ms (0.5 of a frame)" in resampling
    assert [remark.split(" (")[0] for remark in check_session(session, decode=False)] == [f"camera 'c': 5 of {session.frames} frames are missing"]
    # The user's rate says that all cameras filmed at it. The difference is said.
    (tmp_path / "lab" / "c.mp4").unlink()
    (tmp_path / "lab" / "c.yml").unlink()
    session, remarks = import_opencv(source, tmp_path / "third", replace(OPTIONS, fps=30.0))
    assert not any(view.spans for view in session.views)
    overriding, drift = clock_remarks(remarks)
    assert overriding == "--fps 30 overrides the videos' rates (a 29.97)." and "'b' and 'a' are 0.53 frames apart at the end; --resample" in drift


def test_what_is_numbered_by_the_videos_frames_follows(tmp_path):
    source = laboratory(tmp_path / "lab", {"a": (np.arange(45), np.arange(45) / 30), "b": (LOST, LOST / 30)})
    body = np.random.default_rng(0).uniform(5, 40, (len(LAYOUTS["COCO_17"]), 2))
    for frame, instant in enumerate(LOST):
        # The person moves with the instant, in files that are numbered by the video's frames, from 1.
        rows = np.column_stack([body + np.array([0.5 * instant, 0]), np.full(len(body), 0.9)])
        place = tmp_path / "pose" / "b_json"
        place.mkdir(parents=True, exist_ok=True)
        (place / f"{frame + 1:04d}.json").write_text(json.dumps({"people": [{"pose_keypoints_2d": rows.ravel().tolist()}]}))
    options = replace(OPTIONS, keypoints=tmp_path / "pose", keypoints_first={"": 1}, layout="COCO_17", first_frame=10)
    session, remarks = import_opencv(source, tmp_path / "session", options)
    assert not any("missing there" in remark for remark in remarks)
    view = session.views[1]
    assert view.spans == (Span(0, 0, 12), Span(27, 12, 18))
    path = session.keypoints_path(view)
    assert path is not None
    series = read_series(path)
    columns = [series.frame(session.number(view, frame)).get("nose", (np.nan,))[0] for frame in range(session.frames)]
    expected = [np.nan if 12 <= instant < 27 else body[0, 0] + 0.5 * instant for instant in range(10, 45)]
    assert columns == pytest.approx(expected, abs=1e-3, nan_ok=True)
    masked = replace(session, views=(replace(view, masks="%02d.png"),))
    assert [masked.mask_path(masked.views[0], frame) for frame in (1, 2, 17)] == [
        tmp_path / "session" / "11.png",
        None,
        tmp_path / "session" / "12.png",
    ]


def test_a_session_that_counts_over_a_gap_is_noticed(tmp_path):
    session, remarks = import_opencv(laboratory(tmp_path / "lab", {"a": EVEN, "b": (LOST, LOST / 30)}), tmp_path / "session", OPTIONS)
    old = replace(session, views=tuple(replace(view, spans=()) for view in session.views))
    (remark,) = check_session(old)
    assert "b.mp4: its timestamps show that 15 frames were lost, the first after frame 11" in remark and "import the recording again" in remark
    assert any("(a 30, b 45 with those that it lacks): the session has the 30 that all have" in remark for remark in remarks)
    path = tmp_path / "session" / "session.toml"
    path.write_text(path.read_text().replace("[27, 12, 18]", "[27, 11, 18]"))
    with pytest.raises(InputError, match=r"spans: \[0, 0, 12\] reaches into \[27, 11, 18\]; expected \[instant, frame, count\], ascending"):
        load_session(path)


def test_frames_that_an_edit_list_hides_are_not_counted(tmp_path):
    source = laboratory(tmp_path / "lab", {"a": EVEN, "b": EVEN})
    content = bytearray((source / "b.mp4").read_bytes())
    place = content.index(b"elst") + 12
    # Frames 5 to 24 are shown: the list's duration is in units of 1 ms or of the stream, its start in those of the stream, seconds / 90 000.
    duration, start, rate = struct.unpack_from(">IiI", content, place)
    struct.pack_into(">IiI", content, place, duration * 20 // 30, start + round(5 / 30 / BASE), rate)
    (source / "b.mp4").write_bytes(bytes(content))
    session, _ = import_opencv(source, tmp_path / "session", OPTIONS)
    assert shown(session) == [list(range(20)), list(range(5, 25))] and not any(view.spans for view in session.views)


def stamps(times, unit_s=1 / 90_000, fps=0.0, average_fps=0.0, frames=0) -> Stamps:
    times = np.round(np.asarray(times, float) / unit_s) * unit_s
    return Stamps(times, unit_s, fps, average_fps, max(frames, len(times)))


L = np.arange(1000)
NOISE = np.random.default_rng(0).normal(0, 0.003, 1000)
# Timestamps, the rate, and the number of lost frames.
CLOCKS = {
    "milliseconds at 240": (stamps(L / 240, 1e-3), 240.0, 0),
    "milliseconds at 29.97": (stamps(L * 1.001 / 30, 1e-3), 30 / 1.001, 0),
    "600 a second at 240": (stamps(L / 240, 1 / 600), 240.0, 0),
    "a header that counts over the end": (stamps((L / 30 + 0.004 * np.sin(L))[:30], average_fps=30.0799), 30.0, 0),
    "a rate of its own": (stamps(L / 29.83, fps=30.0), 29.83, 0),
    "noise": (stamps(np.sort(L / 30 + NOISE)), 30.0, 0),
    "noise and ten lost frames": (stamps(np.delete(L / 30 + NOISE, range(50, 950, 90))), 30.0, 10),
    "a gap of half a frame": (stamps(L / 30 + (L > 500) / 60), 30.0, 1),
    "two frames": (stamps([0, 0.04]), 25.0, 0),
    "one frame": (stamps([0.0], fps=25.0), 25.0, 0),
    "no times": (stamps([], fps=25.0, frames=20), 25.0, 0),
    "times that stand still": (stamps(np.zeros(20), fps=25.0), 25.0, 0),
    "a header that counts more frames": (stamps(L[:20] / 25, frames=30), 25.0, 0),
    "nothing known": (stamps([], frames=20), 0.0, 0),
}


@pytest.mark.parametrize("case", CLOCKS)
def test_rates_and_lost_frames(case):
    read, fps, lost = CLOCKS[case]
    clock = clock_of(read)
    assert clock.fps == pytest.approx(fps, rel=1e-5)
    assert len(clock.instants) == read.frames
    assert clock.instants[-1] - (read.frames - 1) == lost and (np.diff(clock.instants) > 0).all()
