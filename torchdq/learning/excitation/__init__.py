"""Excitation: motions whose torques have the most information about an arm, within its limits."""
