"""The form that runs: link frames with the joint axis along z, so that a change of frame is a few planar turns."""
