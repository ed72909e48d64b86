"""Layers: modules of torch that hold a robot, learn some of its quantities, and run one program each.

inverse_dynamics, forward_dynamics, computed_torque   one layer each, public in `torchdq.nn`
residual          inverse dynamics and a network for the residual torques
robot_module      what all layers share: learned quantities, friction, program, prior
layer_friction    friction effects of a layer, and which of their coefficients it learns
layer_program     the program that a layer runs and exports: rigid bodies, friction and offset together
learnable         names of quantities that may be learned, and their initial values
parametrizations  unconstrained numbers behind physical quantities
"""
