"""Robots from and to MJCF."""
