"""Frames on disk: what was kept comes back bit for bit, half a file is no frame, and damage is noticed."""

import dataclasses
import errno
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest

from bayes_body.base.errors import InputError
from bayes_body.base.files import atomic
from bayes_body.base.files.atomic import PARTIAL
from bayes_body.density.kernel import FilterInfo
from bayes_body.results.storage import FrameFiles
from bayes_body.results.storage.entries import Entries, Entry, entries_of
from bayes_body.results.storage.frame_files import Place, load_frame, save_frame
from bayes_body.tracking.draws import FrameResult, Frames, FrameStore, ThinningStore

RUNS, PARTICLES, DOFS, LAYERS, CAMERAS = 2, 7, 3, 2, 4


def result(seed: int) -> FrameResult:
    rng = np.random.default_rng(seed)
    by_layer = rng.random((RUNS, LAYERS), np.float32)
    by_layer[0, 1] = np.nan
    info = FilterInfo(
        ancestors=rng.integers(0, PARTICLES, (RUNS, PARTICLES), np.int32),
        ess=rng.random(RUNS, np.float32),
        survival_rate=by_layer,
        inverse_temperatures=by_layer,
        log_evidence=np.array([-np.inf, np.nan], np.float32),
        lost=np.array([True, False]),
        acceptance_rate=by_layer,
        evaluations=np.array([7, 14], np.int32),
        markov={"acceptance": rng.random((RUNS, 2), np.float32), "divergences": rng.integers(0, 3, (RUNS, 2), np.int32)},
        messages={"belief_ess": rng.random((RUNS, 3), np.float32), "samples": np.full(RUNS, 50, np.int32)},
        joint={"converged": np.array([True, False]), "near_limit": rng.random((RUNS, DOFS)) < 0.5},
        modes={"attempt": rng.integers(0, 3, RUNS, np.int32), "pareto_k": rng.random(RUNS, np.float32)},
    )
    states = {"pose": rng.normal(size=(RUNS, PARTICLES, DOFS)).astype(np.float32), "phase": rng.normal(size=(RUNS, PARTICLES))}
    return FrameResult(states, rng.normal(size=(RUNS, PARTICLES)), info, rng.random(CAMERAS) < 0.5, rng.random(), rng.random())


def leaves(frame: FrameResult) -> dict[str, np.ndarray]:
    found = {f"states.{name}": values for name, values in frame.states.items()} | frame.info._asdict()
    for mapping in ("markov", "messages", "modes", "joint"):
        found |= {f"{mapping}.{name}": values for name, values in found.pop(mapping).items()}
    return {name: np.asarray(values) for name, values in (found | {"w": frame.log_weights, "seen": frame.seen}).items()}


def same(a: FrameResult, b: FrameResult) -> bool:
    x, y = leaves(a), leaves(b)
    arrays = x.keys() == y.keys() and all(x[name].dtype == y[name].dtype and x[name].tobytes() == y[name].tobytes() for name in x)
    return arrays and (a.seconds, a.seconds_ready) == (b.seconds, b.seconds_ready)


@pytest.fixture
def kept(tmp_path):
    """Files of four frames."""
    files = FrameFiles(tmp_path / "frames", "this")
    for seed in range(4):
        files.append(result(seed))
    return files


def files(kept):
    """The same files, opened again."""
    return FrameFiles(kept.folder, "this")


def test_they_are_frames_like_a_list(kept):
    assert isinstance(kept, FrameStore) and isinstance([], FrameStore)
    assert isinstance((result(0),), Frames) and not isinstance((result(0),), FrameStore)


def test_what_was_kept_comes_back(kept):
    again = files(kept)
    assert len(again) == 4
    assert all(same(frame, result(seed)) for seed, frame in enumerate(again))
    assert same(again[-1], result(3))
    for outside in (4, -5):
        with pytest.raises(IndexError):
            again[outside]


def test_several_frames_are_stored_as_one_by_one(kept, tmp_path, monkeypatch):
    together = FrameFiles(tmp_path / "together", "this")
    together.extend([result(0)])
    together.extend([result(seed) for seed in range(1, 4)])
    for seed in range(4):
        assert together.path(seed).read_bytes() == kept.path(seed).read_bytes()
    assert len(together) == 4 and together.last_digest == kept.last_digest and together.mend() == ""
    together.extend([])

    def refuse(path):
        raise OSError(errno.ENOSPC, "no space")

    monkeypatch.setattr(atomic, "_sync", refuse)
    with pytest.raises(InputError, match=r"000004\.npz: cannot be written \(No space left on device\)"):
        together.extend([result(4), result(5)])
    assert len(together) == len(list(together.folder.iterdir())) == 4


def test_a_folder_that_is_not_there_has_no_frames_and_is_not_made(tmp_path):
    files = FrameFiles(tmp_path / "frames")
    assert (len(files), list(files), files.mend()) == (0, [], "")
    assert not files.folder.exists()


def test_half_a_file_is_no_frame(kept):
    half = kept.folder / f"{PARTIAL}0123456789abcdef.npz"
    half.write_bytes(kept.path(0).read_bytes()[:100])
    again = files(kept)
    assert len(again) == 4
    assert again.mend() == "" and not half.exists()


def test_frames_behind_a_gap_do_not_count(kept):
    kept.path(1).unlink()
    assert len(files(kept)) == 1


def _cut(content: bytes) -> bytes:
    return content[: len(content) // 2]


def _flip(content: bytes) -> bytes:
    """One bit of a pose."""
    place = content.index(b"states.pose") + 250
    return content[:place] + bytes([content[place] ^ 1]) + content[place + 1 :]


DAMAGE = {"cut short": _cut, "one bit": _flip, "empty": lambda content: b"", "something else": lambda content: b"no frame at all"}


@pytest.mark.parametrize("damage", DAMAGE)
def test_damage_is_noticed_and_the_frames_before_it_stay(kept, damage):
    path = kept.path(2)
    path.write_bytes(DAMAGE[damage](path.read_bytes()))
    with pytest.raises(InputError, match=r"000002\.npz: .*compute it again with --resume"):
        load_frame(path)
    again = files(kept)
    assert "000002.npz" in again.mend() and len(again) == 2
    again.append(result(2))
    assert same(again[2], result(2))
    # The one behind it was never damaged, and its digest of the one before it is right again: a run that stops here goes on after it.
    assert files(kept).mend() == "" and len(files(kept)) == 4


def test_python_objects_are_neither_written_nor_read(tmp_path):
    with pytest.raises(ValueError, match="allow_pickle"):
        save_frame(tmp_path / "000000.npz", dataclasses.replace(result(0), states={"pose": np.array([{}], object)}), Place("this", 0, ""))
    assert not list(tmp_path.iterdir())
    np.savez(tmp_path / "000000.npz", pose=np.array([{}], object))
    with pytest.raises(InputError, match="bytes of object"):
        load_frame(tmp_path / "000000.npz")


def test_a_full_disk_leaves_the_frames_before(kept, monkeypatch):
    def full(path, content):
        with path.open("wb") as file:
            file.write(content[: len(content) // 2])
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(InputError, match=r"000004\.npz: cannot be written \(No space left on device\)"):
        kept.append(result(4))
    assert len(kept) == len(files(kept)) == len(list(kept.folder.iterdir())) == 4


def _exchange(kept):
    one, two = kept.path(1).read_bytes(), kept.path(2).read_bytes()
    kept.path(1).write_bytes(two)
    kept.path(2).write_bytes(one)


def _copy(kept):
    kept.path(1).write_bytes(kept.path(0).read_bytes())


def _another_before(kept):
    """The same run and number, after another frame: two runs that were mixed."""
    save_frame(kept.path(1), result(9), Place("this", 1, load_frame(kept.path(1)).place.before))


@pytest.mark.parametrize(("mix", "first"), [(_exchange, 1), (_copy, 1), (_another_before, 2)])
def test_a_frame_in_the_wrong_place_is_noticed(kept, mix, first):
    mix(kept)
    again = files(kept)
    assert f"{first:06d}.npz: was stored as frame" in again.mend() and len(again) == first


def test_a_frame_of_another_run_is_refused_and_stays(kept):
    save_frame(kept.path(2), result(2), Place("that", 2, load_frame(kept.path(1)).digest))
    content = kept.path(2).read_bytes()
    with pytest.raises(
        InputError, match=r"000002\.npz: belongs to another run \('that'\); expected a frame of this run \('this'\); move the file away"
    ):
        files(kept).mend()
    with pytest.raises(InputError, match="belongs to another run"):
        files(kept)[2]
    assert kept.path(2).read_bytes() == content


@pytest.mark.parametrize("kind", ["states.pose", "seconds", "number"])
def test_a_changed_array_in_a_sound_archive_is_noticed(kept, kind):
    with np.load(kept.path(1)) as file:
        arrays = dict(file)
    np.savez(kept.path(1), **(arrays | {kind: arrays[kind] + 1}))
    with pytest.raises(InputError, match=r"000001\.npz: was changed since it was written"):
        load_frame(kept.path(1))


def test_a_header_that_promises_too_much_is_a_sentence(kept):
    """10^14 numbers."""
    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (100000000000000,), }\n"
    with zipfile.ZipFile(kept.path(1), "w") as file:
        file.writestr("log_weights.npy", b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header)
    with pytest.raises(InputError, match=r"000001\.npz.*compute it again"):
        load_frame(kept.path(1))


def few(frame: FrameResult, number: int) -> FrameResult:
    """The first three particles."""
    states = {name: values[:, :3] for name, values in frame.states.items()}
    return dataclasses.replace(frame, states=states, log_weights=frame.log_weights[:, :3], figures={"particles": np.full(RUNS, PARTICLES)})


@pytest.fixture
def thinned(tmp_path):
    """Files of four frames, of which some particles are stored."""
    files = FrameFiles(tmp_path / "frames", "this", few)
    for seed in range(4):
        files.append(result(seed))
    return files


def test_of_a_thinned_run_the_last_frame_has_all_its_particles(thinned):
    names = {"000000.npz", "000001.npz", "000002.npz", "000003.npz", "last_000003.npz"}
    assert {path.name for path in thinned.folder.iterdir()} == names
    # A stop before the last file was removed leaves one more.
    (thinned.folder / "last_000002.npz").write_bytes(b"of no use")
    again = FrameFiles(thinned.folder, "this", few)
    assert isinstance(again, ThinningStore) and again.mend() == "" and {path.name for path in thinned.folder.iterdir()} == names
    assert same(again.last, result(3)) and same(again[3], few(result(3), 3)) and again[3].figures["particles"].tolist() == [PARTICLES] * RUNS
    # Without thinning the last frame is what is stored.
    (thinned.folder / "last_000003.npz").write_bytes((thinned.folder / "000003.npz").read_bytes()[:-9])
    with pytest.raises(InputError, match=r"last_000003\.npz: .*damaged"):
        _ = again.last


def test_a_damaged_frame_of_a_thinned_run_costs_the_run_but_not_what_is_computed_again(thinned):
    thinned.path(1).write_bytes(b"damaged")
    again = FrameFiles(thinned.folder, "this", few)
    assert "000001.npz" in again.mend() and len(again) == 0
    for seed in range(2):
        again.append(dataclasses.replace(result(seed), seconds=9.0))
    # It stops here: the next frame is one of before, and the run goes on after the second one.
    again = FrameFiles(thinned.folder, "this", few)
    assert "after another frame" in again.mend() and len(again) == 2 and again.last.seconds == 9.0


def test_entries_of_many_frames_take_few_bytes():
    def entries(frames):
        columns = Entries()
        for number in range(frames):
            columns.append(Entry(f"{number:064x}", 0.5, 0.0, np.array([number % 2, 1], bool)[: number % 3]))
        return columns

    tracemalloc.start()
    many = entries(10_000)
    held = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    # An object a frame, with a text and an array, would take some 500.
    assert held < 100 * len(many) == 1_000_000
    few = entries_of(entries(7).arrays())
    assert [(entry.digest, entry.seconds, entry.restarted.tolist()) for entry in few] == [
        (f"{number:064x}", 0.5, [bool(number % 2), True][: number % 3]) for number in range(7)
    ]
    with pytest.raises(ValueError, match="hexadecimal"):
        few.append(few[0]._replace(digest="no digest"))
