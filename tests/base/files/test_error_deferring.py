"""The file for HDF5: like any other while there is room, and still consistent to its writer once there is none."""

import errno
import os

import h5py
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bayes_body.base.files.atomic import ErrorDeferringFile

ACTIONS = st.lists(
    st.one_of(
        st.tuples(st.just("write"), st.integers(0, 60), st.binary(max_size=30)),
        st.tuples(st.just("truncate"), st.integers(0, 80), st.just(b"")),
    ),
    max_size=20,
)


def _act(file, actions):
    for kind, place, data in actions:
        if kind == "write":
            file.seek(place)
            file.write(data)
        else:
            file.truncate(place)
    file.seek(0)
    return file.read()


@given(ACTIONS, st.integers(0, 20))
def test_it_reads_as_a_file_reads_whatever_the_disk_refuses(tmp_path_factory, actions, taken):
    """Only growth by truncation, which brings zeros, is left out once writes are refused: HDF5 truncates when all is written."""
    folder = tmp_path_factory.mktemp("steady")
    writes = [action for action in actions if action[0] == "write"]
    with (folder / "plain").open("w+b") as plain, ErrorDeferringFile(folder / "steady") as steady:
        assert _act(steady, actions) == _act(plain, actions)
    real, left = os.pwrite, [taken]

    def pwrite(handle, data, place):
        left[0] -= 1
        if left[0] < 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        return real(handle, data, place)

    with pytest.MonkeyPatch.context() as patch, (folder / "plain").open("w+b") as plain, ErrorDeferringFile(folder / "refused") as steady:
        patch.setattr(os, "pwrite", pwrite)
        assert _act(steady, writes) == _act(plain, writes)
        assert (steady.error is not None) == (sum(1 for _, _, data in writes if data) > taken)


@pytest.mark.parametrize("taken", [0, 1, 5, 20])
def test_hdf5_closes_on_a_disk_that_is_full(tmp_path, monkeypatch, taken):
    real, left = os.pwrite, [taken]

    def pwrite(handle, data, place):
        left[0] -= 1
        if left[0] < 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        return real(handle, data, place)

    monkeypatch.setattr(os, "pwrite", pwrite)
    with ErrorDeferringFile(tmp_path / "file.h5") as steady:
        with h5py.File(steady, "w") as file:
            for number in range(30):
                values = np.full((40, 1000), float(number))
                file.create_dataset(f"array{number}", data=values, chunks=(10, 1000))
                assert (file[f"array{number}"][:] == values).all()
        assert steady.error.errno == errno.ENOSPC
