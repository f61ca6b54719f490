"""Draws as a DataTree: dimensions, units, weights kept; and diagnostics that respect the weights."""

import dataclasses

import arviz as az
import h5py
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr

from bayes_body.base.errors import InputError
from bayes_body.density.spaces import SE3, Plate, euclidean, space_from_text
from bayes_body.kernels.smc.particle_filter import build_kernel
from bayes_body.model.build import build_model
from bayes_body.results.posterior import equal_weight, equal_weight_draws, markers, mean_poses, rhat, save_posterior, stream_posterior, to_datatree
from bayes_body.results.posterior import stream as streaming
from bayes_body.results.posterior.stream import tree_on_demand
from bayes_body.results.posterior.thinning import thinning_of
from bayes_body.results.storage.frame_archive import Place
from bayes_body.results.storage.frame_files import packed
from bayes_body.runs.size import HALF_BLOCK, frame_size
from bayes_body.tracking.track import track

RUNS, FRAMES, PARTICLES = 3, 5, 400
FILTER = {
    **dict.fromkeys(("ess", "log_evidence", "lost", "evaluations"), ("chain", "frame")),
    **dict.fromkeys(("survival_rate", "inverse_temperature", "acceptance_rate"), ("chain", "frame", "layer")),
    "seen": ("frame", "camera"),
}


@pytest.fixture(scope="module")
def draws(textured_session):
    return track(jax.random.key(2), textured_session, build_model("arm", textured_session), build_kernel(), particles=PARTICLES, runs=RUNS)


def test_the_tree_holds_draws_weights_and_ancestors(draws, tmp_path):
    save_posterior(to_datatree(draws, {"seed": 2}), tmp_path / "posterior.nc")
    tree = xr.open_datatree(tmp_path / "posterior.nc")
    pose = tree["posterior"]["pose"]
    assert pose.dims == ("chain", "draw", "frame", "dof") and pose.shape == (RUNS, PARTICLES, FRAMES, 4)
    assert list(pose.dof.values) == ["shoulder_x", "shoulder_y", "shoulder_z", "elbow"] and set(pose.unit.values) == {"rad"}
    assert (pose.sel(chain=1, frame=2).values == draws.states["pose"][1, 2]).all()
    for name, values in (("log_weight", draws.log_weights), ("ancestor", draws.info.ancestors)):
        stored = tree["sample_stats"][name]
        assert stored.dims == ("chain", "draw", "frame")
        assert (stored.sel(chain=2, frame=3).values == values[2, 3]).all()
    for name, dims in FILTER.items():
        assert tree["filter"][name].dims == dims
    assert list(tree["filter"]["camera"].values) == ["a", "b"] and tree["filter"]["seen"].values.all()
    assert (tree["filter"]["evaluations"] == PARTICLES).all()
    assert tree.attrs["model"] == "arm" and tree.attrs["seed"] == 2


@pytest.mark.parametrize(("chunk_bytes", "frames"), [(1, 1), (15_000, 2), (2**20, FRAMES)])
def test_the_streamed_file_is_the_tree(draws, tmp_path, monkeypatch, chunk_bytes, frames):
    """Whatever the size of the pieces; five frames are no multiple of two."""
    monkeypatch.setattr(streaming, "CHUNK_BYTES", chunk_bytes)
    path = tmp_path / "posterior.nc"
    stream_posterior(draws, path, {"kernel": "sir", "seed": 2})
    tree = to_datatree(draws, {"kernel": "sir", "seed": 2})
    for opened in (xr.open_datatree(path), az.from_netcdf(path)):
        assert opened.identical(tree)
        for group in ("posterior", "sample_stats", "filter"):
            for name, array in tree[group].data_vars.items():
                assert opened[group][name].dtype == array.dtype and opened[group][name].values.tobytes() == array.values.tobytes()
    with h5py.File(path) as file:
        assert file["posterior/pose"].chunks == (1, PARTICLES, frames, 4)
        # Of a long recording, figures are stored in several chunks too.
        assert file["filter/seen"].chunks == (1 if chunk_bytes == 1 else FRAMES, 2)


@pytest.mark.parametrize("keep", [None, 50])
def test_a_frame_takes_the_room_that_is_said_before_the_run(draws, tmp_path, keep):
    thin = thinning_of(draws.model.transition, keep)
    frames = draws.frames if thin is None else [thin(frame, number) for number, frame in enumerate(draws.frames)]
    expected = frame_size(draws.model, keep or PARTICLES, RUNS, keep is not None)
    stream_posterior(dataclasses.replace(draws, frames=frames), tmp_path / "posterior.nc")
    with h5py.File(tmp_path / "posterior.nc") as file:
        stored = sum(file[group][name].id.get_storage_size() for group in ("posterior", "sample_stats", "filter") for name in file[group]) / FRAMES
    content, _ = packed(frames[0], Place(RUNS * "0123456789abcdef", 0, 64 * "0"))
    assert stored == pytest.approx(expected.stored, rel=0.1) and len(content) + HALF_BLOCK == pytest.approx(expected.file, rel=0.1)


def test_the_file_is_the_same_whenever_it_is_made(draws, tmp_path):
    slower = [dataclasses.replace(frame, seconds=9.0 + frame.seconds) for frame in draws.frames]
    stream_posterior(draws, tmp_path / "a.nc")
    stream_posterior(dataclasses.replace(draws, frames=slower), tmp_path / "b.nc")
    assert (tmp_path / "a.nc").read_bytes() == (tmp_path / "b.nc").read_bytes()


def test_a_second_variable_is_kept_with_dimensions_of_its_own(draws, tmp_path):
    """What a prior of second order remembers."""
    frames = [dataclasses.replace(frame, states=frame.states | {"velocity": 2 * frame.states["pose"][..., :2]}) for frame in draws.frames]
    more = dataclasses.replace(draws, frames=frames)
    stream_posterior(more, tmp_path / "posterior.nc")
    stored = xr.open_datatree(tmp_path / "posterior.nc")
    assert stored.identical(to_datatree(more))
    assert stored["posterior"]["velocity"].dims == ("chain", "draw", "frame", "velocity_dim_0")


def test_parts_are_kept_with_their_names_and_units(draws, tmp_path):
    space = Plate(("torso", "head"), SE3("coordinate"), "part")
    points = np.random.default_rng(0).normal(size=(FRAMES, RUNS, PARTICLES, 2, 7)).astype(np.float32)
    frames = [dataclasses.replace(frame, states={"parts": own}) for frame, own in zip(draws.frames, points, strict=True)]
    transition = dataclasses.replace(draws.model.transition, spaces=(("parts", space),))
    loose = dataclasses.replace(draws, frames=frames, model=dataclasses.replace(draws.model, transition=transition))
    stream_posterior(loose, tmp_path / "posterior.nc")
    stored = xr.open_datatree(tmp_path / "posterior.nc")
    assert stored.identical(to_datatree(loose))
    parts = stored["posterior"]["parts"]
    assert parts.dims == ("chain", "draw", "frame", "part", "coordinate") and space_from_text(parts.attrs["space"]) == space
    assert (parts.sel(part="head", coordinate="qx", frame=3, chain=1) == points[3, 1, :, 1, 4]).all()
    assert list(parts.sel(coordinate=["x", "qw"]).coordinate_unit.values) == ["m", "1"]


def test_figures_of_messages_are_kept_by_part(draws, tmp_path):
    rng, space = np.random.default_rng(1), Plate(("torso", "head"), SE3("coordinate"), "part")
    own = {
        "samples": np.full(RUNS, 50, np.int32),
        "belief_ess": rng.random((RUNS, 2)),
        "message_change": rng.random((RUNS, 4, 2)),
        "belief_sd": rng.random((RUNS, 4, 2, 6)),
        "proposal_shares": rng.random((RUNS, 2, 4)),
    }
    parts = np.zeros((RUNS, PARTICLES, 2, 7), np.float32)
    frames = [dataclasses.replace(frame, states={"parts": parts}, info=frame.info._replace(messages=own)) for frame in draws.frames]
    transition = dataclasses.replace(draws.model.transition, spaces=(("parts", space),))
    loose = dataclasses.replace(draws, frames=frames, model=dataclasses.replace(draws.model, transition=transition))
    stream_posterior(loose, tmp_path / "posterior.nc")
    stored = xr.open_datatree(tmp_path / "posterior.nc")
    assert stored.identical(to_datatree(loose))
    group = stored["filter"]
    assert group["samples"].dims == ("chain", "frame") and group["belief_sd"].dims == ("chain", "frame", "iteration", "part", "tangent")
    assert group["message_change"].sel(part="head", iteration=4, frame=0, chain=1) == own["message_change"][1, 3, 1]
    assert (group["belief_sd"].sel(tangent="rx", part="torso", frame=2, chain=0) == own["belief_sd"][0, :, 0, 3]).all()
    assert list(group["tangent_unit"].values) == ["m"] * 3 + ["rad"] * 3
    assert group["proposal_shares"].sel(proposal="fit", part="head", frame=1, chain=2) == own["proposal_shares"][2, 1, 3]


def test_the_same_axis_has_the_same_labels(draws):
    both = (("pose", euclidean(("a",) * 4, ("m",) * 4, "dof")), ("other", euclidean(("b",) * 4, ("m",) * 4, "dof")))
    frames = [dataclasses.replace(frame, states=frame.states | {"other": frame.states["pose"]}) for frame in draws.frames]
    transition = dataclasses.replace(draws.model.transition, spaces=both)
    with pytest.raises(ValueError, match="the axis 'dof' of the variable 'other' has other labels"):
        to_datatree(dataclasses.replace(draws, frames=frames, model=dataclasses.replace(draws.model, transition=transition)))


def test_a_flipped_bit_is_noticed_by_whoever_reads_the_file(draws, tmp_path):
    """All arrays have checksums, which HDF5 verifies."""
    path = tmp_path / "posterior.nc"
    stream_posterior(draws, path)
    with h5py.File(path) as file:
        arrays = [file[f"{group}/{name}"] for group in ("posterior", "sample_stats", "filter") for name in file[group] if file[group][name].chunks]
        assert {"pose", "log_weight", "ess", "seen"} <= {array.name.split("/")[-1] for array in arrays} and all(array.fletcher32 for array in arrays)
        place = file["posterior/pose"].id.get_chunk_info(0).byte_offset
    content = bytearray(path.read_bytes())
    content[place + 9] ^= 1
    path.write_bytes(content)
    with xr.open_datatree(path) as tree, pytest.raises(OSError, match="filter returned failure"):
        tree["posterior"]["pose"].load()


def test_a_posterior_without_room_is_refused_before_it_is_begun(draws, tmp_path, monkeypatch):
    monkeypatch.setattr(streaming.shutil, "disk_usage", lambda path: type("Usage", (), {"free": 1000})())
    with pytest.raises(InputError, match=r"posterior\.nc: cannot be written \(0\.0 MB are free\); expected 0\.1 MB of free space"):
        stream_posterior(draws, tmp_path / "posterior.nc")
    assert not list(tmp_path.iterdir())


class Watched:
    """Frames that note which of them are read."""

    def __init__(self, frames):
        self.frames, self.read = frames, []

    def __len__(self):
        return len(self.frames)

    def __getitem__(self, index):
        self.read.append(index)
        return self.frames[index]

    def __iter__(self):
        return iter(self.frames)


def test_a_tree_on_demand_is_the_tree_and_reads_what_is_asked_for(draws):
    watched = Watched(draws.frames)
    tree = tree_on_demand(dataclasses.replace(draws, frames=watched), {"seed": 2})
    watched.read.clear()
    pose = tree["posterior"]["pose"]
    assert pose.shape == (RUNS, PARTICLES, FRAMES, 4) and watched.read == []
    np.testing.assert_array_equal(pose.isel(frame=slice(1, 3), chain=1, dof=-1), draws.states["pose"][1, 1:3, :, -1].T)
    np.testing.assert_array_equal(tree["sample_stats"]["log_weight"].isel(frame=4), draws.log_weights[:, 4])
    assert watched.read == [1, 2, 4]
    assert tree.identical(to_datatree(draws, {"seed": 2}))


def test_arviz_takes_it(draws):
    tree = to_datatree(draws).sel(frame=1)
    assert "bayes_body.equal_weight" in tree.attrs["weights"] and "weights" not in equal_weight(tree).attrs
    equal, weighted = az.summary(equal_weight(tree), var_names=["pose"], kind="stats", round_to="none"), mean_poses(draws)[:, 1].mean(axis=0)
    assert "pose" in equal.index[0]
    pose = draws.states["pose"][:, 1].reshape(-1, 4)
    error = np.abs(equal["mean"] - weighted)
    # The error of systematic resampling, far below that of a mean that ignores the weights.
    assert (error < 4 * pose.std(axis=0) / np.sqrt(RUNS * PARTICLES)).all() and error.max() < 0.2 * np.abs(pose.mean(axis=0) - weighted).max()


def test_draws_of_equal_weight_are_resampled_frame_by_frame(draws):
    tree = to_datatree(draws)
    equal = equal_weight(tree, count=500, seed=3)
    assert equal["posterior"]["pose"].sizes == {"chain": RUNS, "draw": 500, "frame": FRAMES, "dof": 4}
    assert equal["posterior"]["pose"].attrs == tree["posterior"]["pose"].attrs and equal["filter"].identical(tree["filter"])
    np.testing.assert_allclose(equal["sample_stats"]["log_weight"], -np.log(500), rtol=1e-6)
    # A pose with its ancestor; a frame's draws are the same without the other frames.
    pose, ancestor = draws.states["pose"][2, 3], draws.info.ancestors[2, 3]
    place = [int(np.flatnonzero((pose == one).all(axis=1))[0]) for one in equal["posterior"]["pose"].sel(chain=2, frame=3).values]
    assert (equal["sample_stats"]["ancestor"].sel(chain=2, frame=3).values == ancestor[place]).all()
    for frame in (3, [3], [1, 3]):
        assert equal_weight(tree.sel(frame=frame), count=500, seed=3).identical(equal.sel(frame=frame))
    assert not equal_weight(tree, count=500, seed=4).identical(equal)
    # Draws that have equal weights already, such as those of Markov chains, keep their order.
    assert equal_weight(equal).identical(equal)


def test_a_tree_without_weights_has_nothing_to_resample(draws):
    tree = to_datatree(draws)
    with pytest.raises(InputError, match="equal_weight: tree: no sample_stats/log_weight; expected a tree with weighted draws"):
        equal_weight(xr.DataTree.from_dict({"posterior": tree["posterior"].to_dataset()}))
    with pytest.raises(InputError, match="count: 0; expected a whole number from 1 up"):
        equal_weight(tree, count=0)


def test_equal_weight_draws_have_the_weighted_mean(draws):
    sample = equal_weight_draws(draws, 20_000)
    mcse = sample.std(axis=2) / np.sqrt(20_000)
    assert (np.abs(sample.mean(axis=2) - mean_poses(draws)) < 4 * mcse + 1e-6).all()


def test_weights_are_not_forgotten(draws):
    plain = draws.states["pose"].mean(axis=2)
    assert np.abs(plain - mean_poses(draws)).max() > 1e-3


def _fake(draws, states, log_weights):
    """Draws of these poses (run, frame, particle, dof) and log-weights."""
    frames = [
        dataclasses.replace(draws.frames[0], states={"pose": states[:, frame]}, log_weights=log_weights[:, frame]) for frame in range(states.shape[1])
    ]
    return dataclasses.replace(draws, frames=frames)


def test_rhat_sees_runs_that_disagree_and_counts_weights(draws):
    rng = np.random.default_rng(0)
    states = rng.normal(size=(4, 1, 2000, 2))
    equal = np.full((4, 1, 2000), -np.log(2000))
    assert rhat(_fake(draws, states, equal)).max() < 1.01
    moved = states.copy()
    moved[0, 0, :, 1] += 2.0
    apart = rhat(_fake(draws, moved, equal))
    assert apart[0, 0] < 1.01 and apart[0, 1] > 1.1
    # The same particles, weighted so that one run stands elsewhere: only the weights tell.
    tilted = equal.copy()
    tilted[0, 0] += 2.0 * states[0, 0, :, 0]
    assert rhat(_fake(draws, states, tilted))[0, 0] > 1.1


def test_rhat_of_one_run_is_nan(draws):
    assert np.isnan(rhat(_fake(draws, draws.states["pose"][:1], draws.log_weights[:1]))).all()


def test_markers_are_computed_on_demand(draws):
    poses = mean_poses(draws)
    positions = markers(draws.model, poses)
    assert positions.shape == (RUNS, FRAMES, 3, 3)
    assert np.allclose(positions[1, 2], draws.model.markers(jnp.asarray(poses[1, 2])), atol=1e-5)
