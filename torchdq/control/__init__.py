"""Control laws, each declared once: function, layer, controller of a scene and program follow from it."""

from torchdq.control.frames import CartesianImpedance, OperationalSpaceControl
from torchdq.control.joints import PD, ComputedTorque
from torchdq.control.law import Law

__all__ = ["PD", "CartesianImpedance", "ComputedTorque", "Law", "OperationalSpaceControl"]

LAWS = {law.NAME: law for law in (ComputedTorque, OperationalSpaceControl, CartesianImpedance)}  # by their function
