"""Training of models of joint torques: loop, checkpoints, and the blocks of a log that measure a network."""
