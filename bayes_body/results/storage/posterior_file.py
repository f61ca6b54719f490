"""`posterior.nc` of a run, opened as carefully as a stranger's file deserves.

It is opened only if it is the file that the manifest lists, and only if it is plain: all arrays in the file itself, no links, right checksums.
"""

from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

from bayes_body.base.errors import escaped, input_error
from bayes_body.results.storage.hdf5_screen import screened
from bayes_body.results.storage.manifest import Manifest, check_result, sha256_of
from bayes_body.results.storage.names import POSTERIOR_FILE

if TYPE_CHECKING:
    import xarray as xr

GROUPS = ("posterior", "sample_stats", "filter")
AGAIN = "write it again from the run's frames with `bayes-body track SESSION --out RUN --resume`"


def open_posterior(folder: Path, manifest: Manifest) -> "xr.DataTree":
    """Return the tree of a run's `posterior.nc`; arrays are read on demand.

    Raises:
        InputError: the file has changed since it was written, is not a plain HDF5 file, or lacks a group.
    """
    import xarray as xr

    path = folder / POSTERIOR_FILE
    _check_plain(path, check_result(folder, manifest, POSTERIOR_FILE).sha256)
    try:
        tree = xr.open_datatree(path, engine="h5netcdf")
    # A file of another kind can raise any exception in the reader, from OSError to KeyError.
    except Exception as error:
        problem = f"cannot be read ({escaped(str(error).splitlines()[0]) if str(error) else type(error).__name__})"
        raise input_error(path, problem, "a posterior", AGAIN) from None
    missing = [name for name in GROUPS if name not in tree.children]
    if missing:
        tree.close()
        raise input_error(path, f"no group {', '.join(missing)} in it", f"the groups {', '.join(GROUPS)}", AGAIN)
    return tree


def check_plain(path: Path) -> None:
    """Check that a file is a plain HDF5 file whose checksums are right, by a process of its own.

    Raises:
        InputError: it is not.
    """
    _check_plain(path, sha256_of(path))


def _check_plain(path: Path, sha256: str) -> None:
    fault = _fault(path, sha256)
    if fault:
        raise input_error(path, escaped(fault), "a posterior, all in one file", AGAIN)


@lru_cache(64)
def _fault(path: Path, sha256: str) -> str:
    """Return what is wrong with the file that has this digest. The digest is there for the cache: a file is looked at once in a process."""
    return screened(path)
