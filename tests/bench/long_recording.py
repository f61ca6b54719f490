"""What a long recording needs: `python tests/bench/long_recording.py --frames 2000 8000 [--folder F] [--only report view]`.

The keypoints of a simulated walk, forwards and backwards until there are N frames, tracked with the model `keypoints`. Each command is the user's, in
a process of its own. For each: the largest memory of the process (VmHWM), seconds of the processor, and the size of what it wrote. `--folder` keeps
sessions and runs: what exists there is not computed again, so a later call measures single commands.
"""

import argparse
import dataclasses
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import av
import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
from keypoint_walks import Network, person_of, shipped_walk, walk_session

from bayes_body.recording.readers.keypoints.series import read_series, write_series
from bayes_body.recording.session.read import save_session

# Frames of the walk before the person turns back.
WALK = 240
# Runs a command, and writes its largest memory, kilobytes, to a file.
MEASURED = """
import atexit, sys
from pathlib import Path

def write_peak(path=sys.argv[1]):
    (line,) = [line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM")]
    Path(path).write_text(line.split()[1])

atexit.register(write_peak)
sys.argv = ["bayes-body", *sys.argv[2:]]
from bayes_body.cli.main import main
main()
"""
TRACKED, SMOOTHED = "tracked", "smoothed"
FORMATS = ("trc", "mot", "c3d", "bvh", "csv", "npz")


def write_session(folder: Path, frames: int) -> None:
    """A session of so many frames: those of a walk, to and fro."""
    session, _ = walk_session(folder, person_of(shipped_walk(WALK, 0), known=True), Network())
    write_room(folder / "room.mp4", frames, session.views[0].camera.size_px, session.fps)
    for view in session.views:
        (folder / f"{view.camera.name}.mp4").hardlink_to(folder / "room.mp4")
    rows = np.resize(np.concatenate([np.arange(WALK), np.arange(WALK)[::-1]]), frames)
    for view in session.views:
        path = session.keypoints_path(view)
        series = read_series(path)
        write_series(path, series._replace(keypoints=series.keypoints[rows]))
    truth = dict(np.load(session.truth_path))
    np.savez(session.truth_path, **truth | {"markers": truth["markers"][rows]})
    views = tuple(dataclasses.replace(view, images=None, video=f"{view.camera.name}.mp4") for view in session.views)
    save_session(dataclasses.replace(session, frames=frames, views=views))


def write_room(path: Path, frames: int, size: tuple[int, int], fps: float) -> None:
    """A video of a textured room without a person. One piece of it is encoded, and repeated."""
    room = np.asarray(cv2.resize(np.random.default_rng(1).integers(60, 130, (12, 16, 3), np.uint8), size), np.uint8)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=round(fps), options={"preset": "ultrafast", "crf": "30", "bf": "0"})
        stream.width, stream.height, stream.pix_fmt = *size, "yuv420p"
        packets = [packet for _ in range(WALK) for packet in stream.encode(av.VideoFrame.from_ndarray(room, "bgr24"))] + stream.encode()
        pieces = [(bytes(packet), packet.is_keyframe) for packet in packets]
        step = packets[1].pts - packets[0].pts
        for number in range(frames):
            content, is_keyframe = pieces[number % WALK]
            packet = av.Packet(content)
            packet.pts = packet.dts = number * step
            packet.duration, packet.is_keyframe, packet.stream, packet.time_base = step, is_keyframe, stream, packets[0].time_base
            container.mux(packet)


def commands(folder: Path, particles: int, draws: int) -> dict[str, tuple[list[str], list[Path]]]:
    """The commands by name, each with the files and folders that it writes."""
    tracked, smoothed = folder / TRACKED, folder / SMOOTHED
    track = ["track", str(folder / "session"), "--out", str(tracked), "--model", "keypoints", "--kernel", "laplace", "--runs", "2"]
    track += ["--particles", str(particles), "--keep", f"draws={draws}", "--no-pictures"]
    smooth = ["smooth", str(tracked), "--out", str(smoothed), "--draws", str(draws), "--no-pictures"]
    # What was stopped goes on.
    track, smooth = (command + (["--resume"] if out.exists() else []) for command, out in ((track, tracked), (smooth, smoothed)))
    table = {"track": (track, [tracked]), "smooth": (smooth, [smoothed])}
    for name, run in (("tracked", tracked), ("smoothed", smoothed)):
        table[f"report, {name}"] = (["report", str(run), "--overwrite"], [run / "report.html"])
        table[f"view, {name}"] = (["view", str(run), "--overwrite"], [run / "view.html"])
    for kind in FORMATS:
        out = smoothed / f"motion.{kind}"
        table[f"export {kind}"] = (["export", str(smoothed), "--to", kind, "--out", str(out), "--overwrite"], [out])
    table["gait"] = (["gait", str(smoothed), "--overwrite"], [smoothed / "gait.csv"])
    pictures = [word for word in track if word not in ("--no-pictures", "--resume")]
    table["pictures, tracked"] = ([*pictures, "--resume"], [tracked / "overlay.mp4", tracked / "overlay"])
    return table


def size_mb(paths: list[Path]) -> float:
    """The size of files and folders on the disk, 10⁶ bytes."""
    files = [file for path in paths for file in ([path] if path.is_file() else path.rglob("*"))]
    return sum(file.stat().st_size for file in files if file.is_file()) / 1e6


def measure(name: str, command: list[str], outputs: list[Path], frames: int) -> None:
    """Run a command, and print its figures."""
    with tempfile.TemporaryDirectory() as temporary:
        peak = Path(temporary) / "peak"
        before = os.times()
        done = subprocess.run([sys.executable, "-c", MEASURED, str(peak), *command], capture_output=True, text=True, check=False)
        after = os.times()
        seconds = after.children_user + after.children_system - before.children_user - before.children_system
        if done.returncode:
            print(f"{frames:7d}  {name:18s} failed: {(done.stderr or done.stdout).strip()[-2000:]}", flush=True)
            return
        memory_mb = int(peak.read_text()) * 1024 / 1e6
    print(f"{frames:7d}  {name:18s} {memory_mb:8.0f} MB {seconds:9.1f} s {size_mb(outputs):10.2f} MB written", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--frames", type=int, nargs="+", default=[2000, 8000])
    parser.add_argument("--particles", type=int, default=100)
    parser.add_argument("--draws", type=int, default=20)
    parser.add_argument("--folder", type=Path, help="where sessions and runs are written, and stay")
    parser.add_argument("--only", nargs="+", default=[], help="beginnings of the names of the commands to run; all by default, but no pictures")
    options = parser.parse_args()
    print(" frames  command              memory   processor     output")
    with tempfile.TemporaryDirectory() as temporary:
        for frames in options.frames:
            folder = (options.folder or Path(temporary)) / str(frames)
            if not (folder / "session").exists():
                write_session(folder / "session", frames)
            for name, (command, outputs) in commands(folder, options.particles, options.draws).items():
                chosen = name.startswith(tuple(options.only)) if options.only else not name.startswith("pictures")
                computed = name in ("track", "smooth") and (outputs[0] / "posterior.nc").exists()
                if chosen and not computed:
                    measure(name, command, outputs, frames)


if __name__ == "__main__":
    main()
