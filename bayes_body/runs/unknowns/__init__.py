"""`bayes-body fit`: lengths, cameras and keypoint offsets from the keypoints of some frames, and the session with what was inferred."""
