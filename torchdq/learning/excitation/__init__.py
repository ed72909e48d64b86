"""Excitation: motions whose torques tell most about an arm, within its limits."""
