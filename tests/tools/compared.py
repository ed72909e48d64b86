"""Which robots are compared with Pinocchio and MuJoCo, and how closely they agree."""

import oracles
import torch

TOLERANCE = {torch.float64: 1e-12, torch.float32: 5e-6}  # of torques, relative to the size of their terms

EIGENVALUES, TRIANGLE, MASSLESS = (
    "inertia must have positive eigenvalues",
    "inertia must satisfy",
    "larger than mjMINVAL",
)

# MuJoCo reads no link with an inertia that no body could have; torchdq does where it does not move or when told to
MUJOCO_REFUSES = {
    "alex_psyonic_hands": TRIANGLE,
    "allegro_left_hand": TRIANGLE,
    "allegro_right_hand": TRIANGLE,
    "anymal-kinova": EIGENVALUES,
    "anymal_b_simple-anymal": EIGENVALUES,
    "anymal_c_simple-anymal": TRIANGLE,
    "b1": EIGENVALUES,
    "b1-z1": EIGENVALUES,
    "finger_edu": EIGENVALUES,
    "go1": EIGENVALUES,
    "human": MASSLESS,
    "hyq_no_sensors": EIGENVALUES,
    "icub": EIGENVALUES,
    "icub_reduced": EIGENVALUES,
    "pr2": TRIANGLE,
    "romeo": MASSLESS,
    "romeo_laas_small": EIGENVALUES,
    "romeo_small": TRIANGLE,
    "tiago": EIGENVALUES,
    "tiago_dual": EIGENVALUES,
    "tiago_no_hand": EIGENVALUES,
}
READ_BY_MUJOCO = [name for name in oracles.example_robots() if name not in MUJOCO_REFUSES]
# arms and legged robots with joints of every kind, for which other readers' answers are compared in the default run
FEW = (
    *("TwoDofs", "bolt", "borinot_flying_arm_2", "double_pendulum_continuous", "hextilt_flying_arm_5", "kinova"),
    *("panda", "so101", "solo12", "tiago_no_hand", "ur10_robot", "z1"),
)
