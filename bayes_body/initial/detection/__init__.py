"""Part detectors: weighted 3D proposals for landmarks and parts of the person in one frame. They are never factors of a density."""
