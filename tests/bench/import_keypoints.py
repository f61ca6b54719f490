"""How long the import of keypoints takes, and how much memory: `python tests/bench/import_keypoints.py [--frames N] [--profile FILE]`.

Four cameras of the room `room_4`, halved in size to keep the videos small, film a person who walks to and fro. Each has a video and a file of
keypoints (COCO_17, 2 pixels of noise) for each frame, as OpenPose writes them. The command is the user's, in a process of its own; the figures are
its seconds, those of its processor, its largest memory, and whether a bar was shown after at most two seconds.
"""

import argparse
import json
import os
import pty
import re
import resource
import select
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import av
import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
from keypoint_walks import RIG, person_of, shipped_walk

from bayes_body.base.files.shipped import definitions_folder
from bayes_body.recording.evidence.markers import MARKERS
from bayes_body.recording.readers.keypoints.openpose import LAYOUTS
from bayes_body.recording.readers.rig import read_rig

# Frames that the walk lasts before the person turns back.
WALK, NOISE_PX, SMALLER = 240, 2.0, 2
BAR = re.compile("[━╸╺]{5}")


def write_project(folder: Path, frames: int) -> None:
    """A project of Pose2Sim."""
    rig, rng = read_rig(definitions_folder() / "rigs" / f"{RIG}.toml"), np.random.default_rng(0)
    order = LAYOUTS["COCO_17"]
    points = person_of(shipped_walk(WALK, 0), known=False).markers
    names = [name if name in MARKERS else "head" for name in order]
    body = points[:, [list(MARKERS).index(name) for name in names]] + rng.normal(0, 0.02, (1, len(order), 3)) * [[[name == "head"] for name in names]]
    to_and_fro = np.concatenate([np.arange(WALK), np.arange(WALK)[::-1]])
    lines = []
    for camera in rig.cameras:
        width, height = (side // SMALLER for side in camera.size_px)
        (fx, fy), (cx, cy) = (tuple(value / SMALLER for value in pair) for pair in (camera.focal_px, camera.centre_px))
        K, turn = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), cv2.Rodrigues(camera.rotation)[0][:, 0]
        pixels = cv2.projectPoints(body.reshape(-1, 3), turn, camera.translation_m, K, np.array(camera.distortion))[0].reshape(WALK, len(order), 2)
        fields = {"name": json.dumps(camera.name), "size": [width, height], "matrix": K.tolist(), "distortions": list(camera.distortion[:4])}
        fields |= {"rotation": turn.tolist(), "translation": np.asarray(camera.translation_m).tolist()}
        lines += [f"[{camera.name}]", *(f"{key} = {value}" for key, value in fields.items())]
        place = folder / "pose" / f"{camera.name}_json"
        place.mkdir(parents=True)
        for k in range(frames):
            row = pixels[to_and_fro[k % (2 * WALK)]] + rng.normal(0, NOISE_PX, (len(order), 2))
            person = np.column_stack([row, np.full(len(order), 0.8)]).round(3).ravel().tolist()
            (place / f"{camera.name}_{k:06d}.json").write_text(json.dumps({"version": 1.3, "people": [{"pose_keypoints_2d": person}]}))
        write_video(folder / "videos" / f"{camera.name}.mp4", frames, (width, height), rig.fps)
    (folder / "calibration").mkdir()
    (folder / "calibration" / "Calib.toml").write_text("\n".join(lines))


def write_video(path: Path, frames: int, size: tuple[int, int], fps: float) -> None:
    """A textured room without a person."""
    path.parent.mkdir(parents=True, exist_ok=True)
    room = np.asarray(cv2.resize(np.random.default_rng(1).integers(60, 130, (12, 16, 3), np.uint8), size), np.uint8)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=round(fps), options={"preset": "ultrafast", "crf": "30"})
        stream.width, stream.height, stream.pix_fmt = *size, "yuv420p"
        for _ in range(frames):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(room, "bgr24")))
        container.mux(stream.encode())


def run(command: list[str]) -> tuple[str, float | None]:
    """What a command prints on a terminal, and the seconds until it showed a bar."""
    terminal, other_end = pty.openpty()
    began, text, bar_s = time.monotonic(), "", None
    process = subprocess.Popen(command, stdout=other_end, stderr=other_end, stdin=other_end)
    os.close(other_end)
    while True:
        ready = select.select([terminal], [], [], 0.05)[0]
        try:
            text += os.read(terminal, 65_536).decode(errors="replace") if ready else ""
        except OSError:
            break
        if bar_s is None and BAR.search(text):
            bar_s = time.monotonic() - began
        if process.poll() is not None and not ready:
            break
    process.wait()
    os.close(terminal)
    if process.returncode:
        raise SystemExit(text)
    return text, bar_s


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--frames", type=int, default=10_000)
    parser.add_argument("--project", type=Path, help="where the project is written, and found by a later run; a temporary folder by default")
    parser.add_argument("--profile", type=Path, help="file for the profile of the import, as `python -m pstats` reads it")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        project, session = options.project or Path(temporary) / "project", Path(temporary) / "session"
        if not project.exists():
            write_project(project, options.frames)
        profiler = ["-m", "cProfile", "-o", str(options.profile)] if options.profile else []
        command = [sys.executable, *profiler, "-m", "bayes_body.cli.main", "import", "pose2sim", str(project), str(session), "--up", "z"]
        began = time.monotonic()
        text, bar_s = run(command)
        used = resource.getrusage(resource.RUSAGE_CHILDREN)
        shutil.rmtree(session)
    print(text)
    print(f"{time.monotonic() - began:.1f} s, {used.ru_utime + used.ru_stime:.1f} s of the processor, {used.ru_maxrss / 2**20:.2f} GiB")
    print("no bar" if bar_s is None else f"a bar after {bar_s:.1f} s")


if __name__ == "__main__":
    main()
