"""The joint posterior of all frames of a recording as one Gaussian."""
