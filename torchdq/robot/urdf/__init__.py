"""Robots from and to URDF and xacro."""
