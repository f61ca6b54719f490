"""The kernel `laplace`: a Gaussian about the mode of a frame's posterior, corrected by importance weights and slopes."""
