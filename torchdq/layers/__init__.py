"""Machinery of the layers: parameters that stay physical, friction, recorded programs."""
