"""What kernels are built from: resampling, weights, moves, mass matrices, batching."""
