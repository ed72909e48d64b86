"""Layers: modules of torch that hold a robot, learn some of its quantities, and run one program each."""
