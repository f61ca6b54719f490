"""Read motion capture files (asf/amc, bvh, c3d, trc) as one kind of motion, in metres."""

from bayes_body.recording.readers.mocap.landmarks import landmarks
from bayes_body.recording.readers.mocap.motion import Motion
from bayes_body.recording.readers.mocap.read import read_motion
from bayes_body.recording.readers.mocap.resample import resample

__all__ = ["Motion", "landmarks", "read_motion", "resample"]
