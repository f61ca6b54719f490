"""Tools that make and test models: the simulator, learning, calibration and the benchmark."""
