"""Open a run's exported files with readers of other projects, and print the largest differences from the CSV file, in mm, degrees and seconds.

    python tests/bench/foreign_readers.py walk_run

All files are exported with y up, and pandas reads the CSV file. The joints of a BVH file are compared with those of the body at the mean angles of
the CSV file. The mean of some angles of the pelvis and that of others are not the same rotation: its orientation in MOT differs by what the spread of
the draws does to a mean.
"""

import argparse
import contextlib
import tempfile
import warnings
from collections.abc import Iterator
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation

from bayes_body.model.body.placed_body import joint_transforms
from bayes_body.results.storage.saved_run import load_run
from bayes_body.view.export.formats import export_formats
from bayes_body.view.export.mot import mot_files
from bayes_body.view.export.trc import trc_files

FORMATS = ("csv", "npz", "trc", "c3d", "mot", "bvh")
MOMENTS = ("mean", "sd", "q05", "q95")
MILLIMETRES = 1000.0
# OpenSim's names of the clinical angles that are the same quantity.
COORDINATES = {
    "hip_flexion": "hip_flexion",
    "hip_adduction": "hip_adduction",
    "hip_rotation": "hip_rotation",
    "knee_angle": "knee_flexion",
    "ankle_angle": "ankle_dorsiflexion",
    "arm_flex": "arm_flexion",
    "arm_add": "arm_adduction",
    "arm_rot": "arm_rotation",
    "elbow_flex": "elbow_flexion",
    "pro_sup": "forearm_pronation",
    "wrist_flex": "wrist_flexion",
}
MIDDLE = ("lumbar_extension", "lumbar_bending", "lumbar_rotation")
TRANSFORMS = jax.jit(jax.vmap(joint_transforms, (None, 0)))


class Difference(NamedTuple):
    """The largest differences of a quantity in each unit; NaN if it has none of the unit. `seconds` are those of the frames' times."""

    format: str
    reader: str
    quantity: str
    mm: float = np.nan
    degrees: float = np.nan
    seconds: float = np.nan


class Table:
    """The columns of a CSV file."""

    def __init__(self, path):
        self.columns = pd.read_csv(path)
        names = [name.removesuffix("_x_mean_m") for name in self.columns if name.endswith("_x_mean_m")]
        self.markers = [name for name in names if name != "root" and not name.startswith("part_")]

    def late(self, seconds):
        """The largest difference of the frames' times, seconds."""
        return largest(np.asarray(seconds), self.columns["time_s"])

    def late_by(self, period_s):
        """The largest difference of the frames' times, if one begins every `period_s`."""
        return self.late(period_s * np.arange(len(self.columns)))

    def points(self, moment="mean", markers=None):
        """(frame, marker, 3), mm."""
        return MILLIMETRES * np.stack([self.vectors(marker, moment) for marker in markers or self.markers], axis=1)

    def vectors(self, name, moment="mean"):
        """(frame, 3), metres."""
        return self.columns[[f"{name}_{axis}_{moment}_m" for axis in "xyz"]].to_numpy()

    def degrees(self, name, moment="mean"):
        return self.columns[f"{name}_{moment}_deg"].to_numpy()

    def pose(self, names, units):
        """(frame, dof), radians and metres."""
        pairs = zip(names, units, strict=True)
        return np.stack([np.radians(self.degrees(name)) if unit == "deg" else self.columns[f"{name}_mean_m"] for name, unit in pairs], axis=1)


def largest(a, b):
    return float(np.abs(a - b).max())


def turn(a, b):
    """The largest angle between rotations, degrees."""
    return float(np.degrees((a.inv() * b).magnitude()).max())


def npz_by_numpy(path, table):
    with np.load(path) as arrays:
        markers, names = list(arrays["marker_names"]), list(arrays["angle_names"])
        mm = max(largest(MILLIMETRES * arrays[f"marker_{moment}_m"], table.points(moment, markers)) for moment in MOMENTS)
        angles = [(names, "angle")] + ([(list(arrays["clinical_names"]), "clinical")] if "clinical_names" in arrays else [])
        pairs = [(arrays[f"{kind}_{m}_deg"][:, k], table.degrees(name, m)) for many, kind in angles for k, name in enumerate(many) for m in MOMENTS]
        yield Difference("npz", "numpy", "markers, angles", mm, max(largest(*pair) for pair in pairs), table.late(arrays["time_s"]))


def trc_by_pandas(path, table):
    """As Pose2Sim reads it: names of every third column of line 4, numbers from line 5 on."""
    mm = 0.0
    for moment, file in trc_files(path).items():
        names = file.read_text(encoding="utf-8").splitlines()[3].split("\t")[2::3]
        columns = pd.read_csv(file, sep="\t", skiprows=4).to_numpy()
        mm = max(mm, largest(columns[:, 2:].reshape(len(columns), -1, 3), table.points(moment, [name for name in names if name])))
    yield Difference("trc", "pandas", "markers", mm, seconds=table.late(columns[:, 1]))


def opensim_in(folder):
    """The package OpenSim, quiet. It opens its log in the working directory while it is imported."""
    with contextlib.chdir(folder):
        import opensim
    opensim.Logger.setLevelString("Warn")
    return opensim


def trc_by_opensim(path, table):
    opensim = opensim_in(path.parent)
    mm, older = 0.0, 0.0
    for moment, file in trc_files(path).items():
        vectors = opensim.TimeSeriesTableVec3(str(file))
        # OpenSim's matrix is a view of the table, which must live as long.
        flat = vectors.flatten()
        points = flat.getMatrix().to_numpy().reshape(vectors.getNumRows(), -1, 3)
        mm = max(mm, largest(points, table.points(moment, list(vectors.getColumnLabels()))))
        data = opensim.MarkerData(str(file))
        data.convertToUnits(opensim.Units("mm"))
        frames = [data.getFrame(f) for f in range(data.getNumFrames())]
        points = np.array([[[frame.getMarker(m)[a] for a in range(3)] for m in range(data.getNumMarkers())] for frame in frames])
        names = [data.getMarkerNames().get(m) for m in range(data.getNumMarkers())]
        older = max(older, largest(points, table.points(moment, names)))
    yield Difference("trc", "opensim, TimeSeriesTableVec3", "markers", mm, seconds=table.late(vectors.getIndependentColumn()))
    yield Difference("trc", "opensim, MarkerData", "markers", older, seconds=table.late_by(1 / data.getDataRate()))


def c3d_points(path):
    """Labels, (frame, point, 5) with mm, residual in mm (-1: missing) and cameras, and frames a second, by the package `c3d`."""
    import c3d

    with path.open("rb") as file, warnings.catch_warnings():
        # No analog data; and ezc3d's block of zeros at the end.
        warnings.filterwarnings("ignore", message="No analog data|incomplete reading of data blocks")
        reader = c3d.Reader(file)
        return [label.strip() for label in reader.point_labels], np.stack([points for _, points, _ in reader.read_frames()]), reader.point_rate


def c3d_by_c3d(path, table):
    labels, points, rate = c3d_points(path)
    yield Difference("c3d", "c3d", "markers", _labelled(labels, points, table), seconds=table.late_by(1 / rate))
    count = len(table.markers)
    sd = np.sqrt((table.points("sd", labels[:count]) ** 2).mean(axis=-1))
    yield Difference("c3d", "c3d", "residuals of means (sd)", largest(points[:, :count, 3], sd))


def c3d_by_ezc3d(path, table):
    import ezc3d

    content = ezc3d.c3d(str(path))
    point = content["parameters"]["POINT"]
    mm = _labelled(point["LABELS"]["value"], content["data"]["points"].transpose(2, 1, 0), table)
    yield Difference("c3d", "ezc3d", "markers", mm, seconds=table.late_by(1 / point["RATE"]["value"][0]))


def _labelled(labels, points, table):
    count, mm = len(table.markers), 0.0
    for k, moment in enumerate(MOMENTS):
        part = slice(k * count, (k + 1) * count)
        mm = max(mm, largest(points[:, part, :3], table.points(moment, [label.removesuffix(f"_{moment}") for label in labels[part]])))
    return mm


def mot_by_opensim(path, table):
    opensim = opensim_in(path.parent)
    degrees, mm, pairs = 0.0, 0.0, ()
    for moment, file in mot_files(path).items():
        if moment == "q50":
            continue
        storage = opensim.TimeSeriesTable(str(file))
        assert storage.getTableMetaDataAsString("inDegrees") == "yes"
        names = list(storage.getColumnLabels())
        columns = {name: storage.getDependentColumn(name).to_numpy() for name in names}
        pairs = tuple(_coordinates(names, table))
        degrees = max(degrees, *(largest(columns[name], table.degrees(angle, moment)) for name, angle in pairs))
        position = np.stack([columns[f"pelvis_t{axis}"] for axis in "xyz"], axis=1)
        mm = max(mm, MILLIMETRES * largest(position, table.vectors("root", moment)))
        if moment == "mean":
            tilt = Rotation.from_euler("ZXY", np.stack([columns[f"pelvis_{name}"] for name in ("tilt", "list", "rotation")], axis=1), degrees=True)
            yield Difference("mot", "opensim", "orientation of the pelvis (mean)", degrees=turn(tilt, _pelvis(table)))
    yield Difference("mot", "opensim", f"position of the pelvis, {len(pairs)} angles", mm, degrees, table.late(storage.getIndependentColumn()))


def _coordinates(names, table) -> Iterator[tuple[str, str]]:
    # With a talus the ankle's angle is another one.
    other = ("ankle_angle",) if "subtalar_angle_r" in names else ()
    pairs = [(f"{name}_{side}", f"{angle}_{side}") for name, angle in COORDINATES.items() for side in "rl" if name not in other]
    pairs += [(name, name) for name in MIDDLE]
    yield from ((name, angle) for name, angle in pairs if name in names and f"{angle}_mean_deg" in table.columns)


def _pelvis(table):
    """The orientation of the pelvis by the root's angles and their axes: x forward, y up, z to the right."""
    axes = {name: table.columns[[f"root_{name}_axis_{a}_1" for a in "xyz"]].to_numpy()[0] for name in ("yaw", "roll", "pitch")}
    R = Rotation.identity()
    for name, axis in axes.items():
        R = R * Rotation.from_rotvec(np.radians(table.degrees(f"root_{name}"))[:, None] * axis)
    # At rest the body's x is forward, its y to the left, and its z up.
    return R * Rotation.from_matrix(np.stack([axes["roll"], axes["yaw"], -axes["pitch"]], axis=1))


def bvh_by_bvhio(path, table, motion):
    import bvhio

    content = bvhio.readAsBvh(str(path))
    root = bvhio.convertBvhToHierarchy(content.Root).loadRestPose(recursive=True)
    joints = {joint.Name: joint for joint, _, _ in root.layout()}
    names = [name.replace(" ", "_") for name in motion.body.skeleton.topology.joint_names]
    poses = table.pose(motion.dof_names, motion.dof_units)
    at = TRANSFORMS(motion.body, jnp.asarray(np.vstack([poses, np.zeros_like(poses[:1])])))
    origins, R = np.asarray(at.origin, float), np.asarray(at.rotation, float)
    mm = degrees = 0.0
    for frame in range(len(poses)):
        root.loadPose(frame)
        places = np.array([list(joints[name].PositionWorld) for name in names])
        mm = max(mm, largest(10 * places, MILLIMETRES * origins[frame]))
        # bvhio gives joints a rotation at rest of its own; the file has none.
        turned = Rotation.from_quat([list(joints[name].RotationWorld) for name in names], scalar_first=True) * _at_rest(joints, names).inv()
        degrees = max(degrees, turn(turned, Rotation.from_matrix(R[frame] @ np.swapaxes(R[-1], -1, -2))))
    yield Difference("bvh", "bvhio", "joints (mean)", mm, degrees, table.late_by(content.FrameTime))


def _at_rest(joints, names):
    """The rotations that bvhio gives the joints at rest: those of the bones from the y axis."""
    rests = []
    for name in names:
        R, joint = Rotation.identity(), joints[name]
        while joint is not None:
            R = Rotation.from_quat(list(joint.RestPose.Rotation), scalar_first=True) * R
            joint = joint.Parent
        rests.append(R.as_quat(scalar_first=True))
    return Rotation.from_quat(rests, scalar_first=True)


def exported(run, folder):
    """The motions by format, and the paths of the files, of which all have y up."""
    paths = {name: folder / f"walk.{name}" for name in FORMATS}
    with load_run(run) as saved:
        written = export_formats(saved, paths, up="y", spread=True)
        return {name: motion.in_memory for name, motion in written.items()}, paths


def differences(run, folder):
    """All rows but those of OpenSim."""
    motions, paths = exported(run, folder)
    table = Table(paths["csv"])
    yield from npz_by_numpy(paths["npz"], table)
    yield from trc_by_pandas(paths["trc"], table)
    yield from c3d_by_c3d(paths["c3d"], table)
    yield from c3d_by_ezc3d(paths["c3d"], table)
    yield from bvh_by_bvhio(paths["bvh"], table, motions["bvh"])


def differences_by_opensim(run, folder):
    """The rows of OpenSim."""
    _, paths = exported(run, folder)
    table = Table(paths["csv"])
    yield from trc_by_opensim(paths["trc"], table)
    yield from mot_by_opensim(paths["mot"], table)


def printed(rows):
    print("| format | reader | quantity | mm | degrees | seconds |\n|---|---|---|---|---|---|")
    for row in rows:
        package = row.reader.partition(",")[0]
        reader = row.reader.replace(package, f"{package} {version(package)}", 1)
        print(f"| {row.format} | {reader} | {row.quantity} | {' | '.join('' if np.isnan(value) else f'{value:.6f}' for value in row[3:])} |")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path, help="folder of a run of a body that is placed by its angles and has a pelvis")
    run = parser.parse_args().run
    opensim = find_spec("opensim") is not None
    with tempfile.TemporaryDirectory() as first, tempfile.TemporaryDirectory() as second:
        printed([*differences(run, Path(first)), *(differences_by_opensim(run, Path(second)) if opensim else ())])
    if not opensim:
        print("opensim is not installed: it did not read trc and mot.")


if __name__ == "__main__":
    main()
