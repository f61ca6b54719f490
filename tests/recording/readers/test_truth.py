"""True markers: reordered by name, and refused in a sentence where they cannot be used."""

import numpy as np
import pytest

from bayes_body.base.errors import InputError
from bayes_body.recording.evidence.markers import MARKERS
from bayes_body.recording.readers.truth import read_truth


@pytest.fixture
def markers() -> np.ndarray:
    """Six frames, one position unknown."""
    positions = np.random.default_rng(0).normal(size=(6, 15, 3))
    positions[2, 4] = np.nan
    return positions


def save(folder, markers, names=MARKERS, **more):
    np.savez(folder / "truth.npz", markers=markers, names=np.array(names), **more)
    return folder / "truth.npz"


def test_names_are_those_of_the_bodies():
    from bayes_body.model.definition import load_definition

    assert set(load_definition("deutscher_2005").body.markers) == set(MARKERS)


def test_order_does_not_matter(tmp_path, markers):
    np.testing.assert_array_equal(read_truth(save(tmp_path, markers), 6), markers)
    order = np.random.default_rng(1).permutation(15)
    path = save(tmp_path, markers[:, order].astype(np.float32), np.array(MARKERS)[order], remark="taken in the morning")
    np.testing.assert_allclose(read_truth(path, 6), markers, atol=1e-6)


def test_fortran_order_and_compression(tmp_path, markers):
    np.savez_compressed(tmp_path / "a.npz", markers=np.asfortranarray(markers), names=np.array(MARKERS))
    np.testing.assert_array_equal(read_truth(tmp_path / "a.npz", 6), markers)


def test_a_session_may_be_shorter(tmp_path, markers):
    np.testing.assert_array_equal(read_truth(save(tmp_path, markers), 4), markers[:4])
    with pytest.raises(InputError, match="markers: 6 frames; expected 7, as the session has"):
        read_truth(save(tmp_path, markers), 7)


def test_refused(tmp_path, markers):
    def says(sentence, *arguments):
        with pytest.raises(InputError, match=f"^{tmp_path}.*{sentence}") as error:
            read_truth(save(tmp_path, *arguments), 3)
        assert len(str(error.value).splitlines()) == 1

    says("missing: head; unknown: crown", markers, (*MARKERS[:-1], "crown"))
    says("names: .* \\(14 names\\)", markers[:, :14], MARKERS[:14])
    says("names: not a list of strings", markers, np.arange(15))
    says(r"markers: float64 of shape \(6, 14, 3\); expected numbers of shape \(frame, 15, 3\)", markers[:, :14])
    says(r"markers: .* of shape \(6, 15, 3\)", markers.astype(str))
    says("it looks like millimetres, divide by 1000", 1000 * markers)
    says("an infinite position", np.where(np.isnan(markers), np.inf, markers))


def test_no_pickles(tmp_path, markers):
    np.savez(tmp_path / "a.npz", markers=markers.astype(object), names=np.array(MARKERS))
    with pytest.raises(InputError, match=r"markers: .* bytes of object"):
        read_truth(tmp_path / "a.npz", 3)


def test_no_such_archive(tmp_path, markers):
    (tmp_path / "text.npz").write_text("hello")
    np.savez(tmp_path / "other.npz", positions=markers)
    whole = save(tmp_path, markers).read_bytes()
    (tmp_path / "cut.npz").write_bytes(whole[: len(whole) // 2])
    np.save(tmp_path / "single.npy", markers)
    for name, found in {
        "none.npz": "no such file",
        "text.npz": "not such an archive",
        "other.npz": "no `markers`",
        "cut.npz": "damaged",
        "": "a folder",
    }.items():
        with pytest.raises(InputError, match=f"{name}: .*{found}"):
            read_truth(tmp_path / name, 3)
