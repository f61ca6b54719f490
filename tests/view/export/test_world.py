"""`--up`: the root is turned with the world, and files say about which axes its angles are. SciPy places it again, from the files alone."""

import csv
import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bayes_body.model.body.build import build_body
from bayes_body.model.body.placed_body import placed_markers
from bayes_body.model.body.skeleton import preset_rotation
from bayes_body.model.definition import load_body
from bayes_body.results.posterior.moments import Moments
from bayes_body.results.storage.saved_run import load_run
from bayes_body.view.export.formats import export
from bayes_body.view.export.motion import read_motion
from bayes_body.view.export.world import stated_axes, turned_body, turned_dofs

PLACED = jax.jit(jax.vmap(placed_markers, (None, 0)))
ANGLES = ("root_yaw", "root_roll", "root_pitch")
ORDERS = {"z": [0, 1, 2], "y": [1, 2, 0], "x": [2, 0, 1]}


@pytest.fixture
def run(make_run):
    """A run of a person whose draws are the same: the angles of the mean are the mean of the angles."""
    poses = np.random.default_rng(3).uniform(-0.6, 0.6, (5, 31))
    poses[:, 2] += 0.9
    return make_run(model="deutscher_2005", pose=np.broadcast_to(poses, (2, 30, 5, 31)))


def placed(angle, axes, position, points):
    """Points of the root's frame in the world: the rotations in their order, each about its axis as the ones before turn it."""
    R = Rotation.identity()
    for name in ANGLES:
        R = R * Rotation.from_rotvec(np.radians(angle(name))[:, None] * axes[name])
    # The zero pose stands with its x, y and z along the axes of roll, pitch and yaw.
    rest = np.stack([axes[name] for name in ("root_roll", "root_pitch", "root_yaw")], axis=1)
    return np.einsum("fij,fkj->fki", R.as_matrix() @ rest, points) + position[:, None]


def back(angle, axes, position, points):
    """The inverse of `placed`."""
    R = placed(angle, axes, np.zeros_like(position), np.broadcast_to(np.eye(3), (len(position), 3, 3)))
    return np.einsum("fij,fkj->fki", R, points - position[:, None])


def root_of(path):
    """The root of a csv or npz file, and its markers."""
    if path.suffix == ".npz":
        with np.load(path) as arrays:
            angles, shifts = list(arrays["angle_names"]), list(arrays["shift_names"])
            degrees, axes = arrays["angle_mean_deg"], {name: arrays["angle_axes"][angles.index(name)] for name in ANGLES}
            # A position is along the axis that its name says.
            assert shifts == ["root_x", "root_y", "root_z"] and np.array_equal(arrays["shift_axes"], np.eye(3))
            return (lambda name: degrees[:, angles.index(name)]), axes, arrays["shift_mean_m"], arrays["marker_mean_m"]
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    columns = {name: np.array([float(row[name]) for row in rows]) for name in rows[0]}
    axes = {name: np.array([columns[f"{name}_axis_{axis}_1"][0] for axis in "xyz"]) for name in ANGLES}
    assert not np.ptp([columns[f"{name}_axis_{axis}_1"] for name in ANGLES for axis in "xyz"], axis=1).any()
    position = np.stack([columns[f"root_{axis}_mean_m"] for axis in "xyz"], axis=-1)
    names = [name.removesuffix("_x_sd_m") for name in columns if name.endswith("_x_sd_m") and name != "root_x_sd_m"]
    markers = np.stack([np.stack([columns[f"{name}_{axis}_mean_m"] for axis in "xyz"], axis=-1) for name in names], axis=1)
    return (lambda name: columns[f"{name}_mean_deg"]), axes, position, markers


@pytest.mark.parametrize(("suffix", "close"), [("csv", 3e-6), ("npz", 2e-6)])
def test_the_root_of_a_file_places_its_markers(run, tmp_path, suffix, close):
    paths = {up: tmp_path / f"walk_{up}.{suffix}" for up in ORDERS}
    with load_run(run) as saved:
        for up, path in paths.items():
            export(saved, suffix, path, up=up)
    *root, markers = root_of(paths["z"])
    local = back(*root, markers)
    for up, path in paths.items():
        angle, axes, position, turned = root_of(path)
        assert np.argmax(axes["root_yaw"]) == "xyz".index(up)
        assert np.abs(turned - markers[..., ORDERS[up]]).max() < close
        assert np.abs(placed(angle, axes, position, local) - turned).max() < close


@pytest.mark.parametrize("up", ORDERS)
def test_the_turned_body_stands_where_the_markers_are(run, up):
    with load_run(run) as saved:
        motion = read_motion(saved, up=up)
    poses = motion.dofs.mean * np.where(np.array(motion.dof_units) == "deg", np.pi / 180, 1)
    assert np.abs(np.asarray(PLACED(motion.body, jnp.asarray(poses))) - motion.markers.mean).max() < 2e-6


@pytest.mark.parametrize("preset", [[], ["x90", "z180"], ["y270"]])
@pytest.mark.parametrize("sign", [1, -1, 0])
def test_a_root_with_axes_of_its_own(preset, sign):
    """A root that lies on its side, and whose y points the other way: positions, and quantiles, which exchange their places with the sign.

    Without its y (sign 0), it has not all three positions: the others keep their values, and their axes are stated.
    """
    body = build_body("deutscher_31", load_body("deutscher_31"))
    topology = body.skeleton.topology
    motions = (tuple(m._replace(sign=sign) if m.dof == 1 else m for m in topology.motions[0]), *topology.motions[1:])
    presets = jnp.asarray(np.concatenate([preset_rotation(preset)[None], np.array(body.skeleton.presets[1:])]))
    body = dataclasses.replace(
        body, skeleton=dataclasses.replace(body.skeleton, topology=dataclasses.replace(topology, motions=motions), presets=presets)
    )
    draws = np.random.default_rng(6).uniform(-0.7, 0.7, (4, 21, 31))
    moments = Moments(draws.mean(1), draws.std(1), np.quantile(draws, 0.05, 1), np.quantile(draws, 0.95, 1))
    for order in ((1, 2, 0), (2, 0, 1)):
        turned = turned_dofs(moments, body, order)
        assert [dof for dof, _ in stated_axes(turned_body(body, order))] == ([3, 4, 5] if sign else [0, 2, 3, 4, 5])
        assert (turned.q05 < turned.q95).all() and np.array_equal(np.sort(turned.sd), np.sort(moments.sd))
        expected = np.asarray(PLACED(body, jnp.asarray(moments.mean)))[..., list(order)]
        assert np.abs(np.asarray(PLACED(turned_body(body, order), jnp.asarray(turned.mean))) - expected).max() < 2e-6
        # The quantile of a coordinate is that of its draws, turned.
        moved = np.stack([turned_dofs(Moments(*[draw] * 4), body, order).mean for draw in np.swapaxes(draws, 0, 1)], axis=1)
        assert np.abs(turned.q05 - np.quantile(moved, 0.05, 1)).max() < 1e-12
