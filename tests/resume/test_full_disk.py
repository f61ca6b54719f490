"""A full disk is a sentence wherever it strikes, and costs nothing that was computed: status 2, or 0 where only pictures are missing."""

import re
import subprocess

import pytest

from bayes_body.cli.main import main
from bayes_body.runs.run import run
from bayes_body.runs.settings import Settings

from .conftest import command, contents

# Some 26 kB a frame.
FRAMES, OPTIONS, SMALL = 20, ("--particles", "500", "--runs", "2"), {"model": "arm", "overrides": {"particles": 500}, "runs": 2}
FRAME_BYTES = 26_000


@pytest.fixture
def disk(tmp_path):
    """`disk(size)`: a folder on a file system of so many bytes; called again it is that folder with another size."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mounted = []

    def sized(size):
        how = f"{'remount,' if mounted else ''}size={size}"
        done = subprocess.run(["mount", "-t", "tmpfs", "-o", how, "tmpfs", str(folder)], capture_output=True, text=True, check=False)
        if done.returncode:
            pytest.skip(f"no file system can be mounted here ({done.stderr.strip()}); needs root")
        mounted.append(how)
        return folder

    yield sized
    if mounted:
        subprocess.run(["umount", str(folder)], check=True)


@pytest.fixture(scope="module")
def uninterrupted(looped, tmp_path_factory):
    out = tmp_path_factory.mktemp("whole") / "run"
    run(Settings(looped(FRAMES), out, **SMALL), lambda line: None, bar=False)
    return out


def size_of(folder, *names):
    """Of the frames while the run goes on, and of files."""
    return sum(FRAMES * FRAME_BYTES if name == "frames" else (folder / name).stat().st_size for name in names)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("room_for", "said"),
    [
        ((), "frames/000002.npz: cannot be written (No space left on device)"),
        (("frames",), "posterior.nc: cannot be written"),
    ],
    ids=["frames", "posterior"],
)
def test_what_is_computed_stays(looped, disk, uninterrupted, capfd, room_for, said):
    size = size_of(uninterrupted, *room_for) + (4 * len(room_for) * FRAMES * 1024 if room_for else 0) + 3 * FRAME_BYTES
    out = disk(size) / "run"
    with pytest.raises(SystemExit) as stopped:
        main(["track", str(looped(FRAMES)), "--model", "arm", "--out", str(out), *OPTIONS])
    shown, errors = capfd.readouterr()
    assert stopped.value.code == 2
    sentences = [line for line in errors.splitlines() if "bayes-body: " in line]
    assert len(sentences) == 1 and said in sentences[0] and "Traceback" not in errors
    assert "frames are kept; the same command with --resume continues from there." in shown
    assert re.search(r"the run will not fit on the disk: it needs 1\.\d MB, and 0\.\d+ MB are free; .*--keep draws=200", shown)
    kept, lines = len(list((out / "frames").iterdir())), []
    assert kept >= 2 and not list(out.rglob(".partial-*"))
    disk(100_000_000)
    run(Settings(looped(FRAMES), out, resume=True), lines.append, bar=False)
    goes_on = f"continuing at frame {kept} of {FRAMES}" if kept < FRAMES else f"all {FRAMES} frames exist, nothing is left to track"
    assert f"{out}: {goes_on}" in lines
    assert contents(out / "posterior.nc") == contents(uninterrupted / "posterior.nc")


@pytest.mark.slow
def test_a_run_without_room_for_pictures_is_complete(looped, disk, uninterrupted, capfd):
    kept = ("frames", "posterior.nc")
    out = disk(size_of(uninterrupted, *kept) + 8 * FRAMES * 1024 + 3 * FRAME_BYTES) / "run"
    with pytest.raises(SystemExit) as stopped:
        main(["track", str(looped(FRAMES)), "--model", "arm", "--out", str(out), *OPTIONS])
    shown, errors = capfd.readouterr()
    assert stopped.value.code == 0, errors
    assert "note: no overlay: " in shown and "No space left" in shown and "with --resume tries again" in shown
    assert contents(out / "posterior.nc") == contents(uninterrupted / "posterior.nc") and (out / "summary.json").exists()
    assert not list(out.rglob(".partial-*"))
    disk(100_000_000)
    run(Settings(looped(FRAMES), out, resume=True), lambda line: None, bar=False)
    assert (out / "overlay.mp4").exists()


@pytest.mark.slow
def test_hdf5_stopped_half_way_is_a_sentence(looped, tmp_path, uninterrupted):
    """Files may not grow beyond the half of the posterior: its room is there, its writing fails."""
    most = (uninterrupted / "posterior.nc").stat().st_size // 2
    assert most > 2 * FRAME_BYTES
    limited = ["sh", "-c", f'ulimit -f {most // 512}; exec "$@"', "sh", *command(looped(FRAMES), tmp_path / "run", *OPTIONS)]
    done = subprocess.run(limited, capture_output=True, text=True, check=False)
    assert done.returncode == 2, done.stderr
    assert "posterior.nc: cannot be written (File too large)" in done.stderr and "Traceback" not in done.stderr
    assert {path.name for path in (tmp_path / "run").iterdir()} == {"run.toml", "frames", ".lock"}
    assert len(list((tmp_path / "run" / "frames").iterdir())) == FRAMES
