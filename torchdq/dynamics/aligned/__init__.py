"""The form that runs: the z axis of a link frame is the joint axis, so a change of frame is a few planar rotations."""
