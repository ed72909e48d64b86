"""Identification: physical robots with friction that explain recorded torques, from a ladder of models."""
