"""Controllers: control laws that see the readings once per step of a scene and hold their torques over it.

The input `reference` of a scene has the rows of a law's goal one after the other.
"""

from torchdq.control import PD, CartesianImpedance, ComputedTorque, Law, OperationalSpaceControl

__all__ = ["PD", "CartesianImpedance", "ComputedTorque", "Law", "OperationalSpaceControl"]
