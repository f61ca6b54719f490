"""Whether the cameras of a rig agree on what they see, and by which change they would."""
