"""Motion capture files (asf/amc, bvh, c3d, trc) as one kind of motion, in metres."""
