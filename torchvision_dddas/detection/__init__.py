"""Moving targets from a moving camera: frames to targets."""
