"""Identification: physical robots with friction that explain recorded torques, with a selection among models."""
