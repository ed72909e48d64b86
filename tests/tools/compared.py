"""Which robots are compared with Pinocchio and MuJoCo, and how closely they agree."""

import oracles
import torch

TOLERANCE = {torch.float64: 1e-12, torch.float32: 5e-6}  # of torques, relative to the size of their terms

EIGENVALUES, TRIANGLE = "inertia must have positive eigenvalues", "inertia must satisfy"
MASSLESS = "larger than mjMINVAL"

# MuJoCo reads no link with an inertia that no body could have; torchdq does where it does not move or when told to
MUJOCO_REFUSES = {
    **dict.fromkeys(("alex_psyonic_hands", "allegro_left_hand", "allegro_right_hand", "pr2", "romeo_small"), TRIANGLE),
    **dict.fromkeys(("anymal-kinova", "anymal_b_simple-anymal", "b1", "b1-z1", "finger_edu", "go1"), EIGENVALUES),
    **dict.fromkeys(("hyq_no_sensors", "icub", "icub_reduced", "romeo_laas_small"), EIGENVALUES),
    **dict.fromkeys(("tiago", "tiago_dual", "tiago_no_hand"), EIGENVALUES),
    **{"anymal_c_simple-anymal": TRIANGLE, "human": MASSLESS, "romeo": MASSLESS},
}
READ_BY_MUJOCO = [name for name in oracles.example_robots() if name not in MUJOCO_REFUSES]
# arms and legged robots with joints of every kind, for which other readers' answers are compared in the default run
FEW = (
    *("TwoDofs", "bolt", "borinot_flying_arm_2", "double_pendulum_continuous", "hextilt_flying_arm_5", "kinova"),
    *("panda", "so101", "solo12", "tiago_no_hand", "ur10_robot", "z1"),
)
