"""Physical effects of a scene, each an object that belongs to one slot."""

from torchdq.effects.actuator import CommandDelay, DeadBand, FirstOrderLag, QuantisedCommand, Saturation, TorqueSpeed
from torchdq.effects.body import Drag, PointSpring, Push
from torchdq.effects.closures import Closures
from torchdq.effects.contact import Contact
from torchdq.effects.effect import Effect
from torchdq.effects.friction import Coulomb, Directional, LoadDependent, LuGre, Quadratic, Ripple, Stribeck, Viscous
from torchdq.effects.joint import JointLimits, Servo, Spring
from torchdq.effects.model import Gravity, MassScale, Payload, RotorInertia
from torchdq.effects.residual import Residual
from torchdq.effects.sensor import Bias, MeasurementDelay, Noise, QuantisedReading
from torchdq.effects.surface import HeightMap
from torchdq.effects.transmission import Elastic

__all__ = [
    "Bias",
    "Closures",
    "CommandDelay",
    "Contact",
    "Coulomb",
    "DeadBand",
    "Directional",
    "Drag",
    "Effect",
    "Elastic",
    "FirstOrderLag",
    "Gravity",
    "HeightMap",
    "JointLimits",
    "LoadDependent",
    "LuGre",
    "MassScale",
    "MeasurementDelay",
    "Noise",
    "Payload",
    "PointSpring",
    "Push",
    "Quadratic",
    "QuantisedCommand",
    "QuantisedReading",
    "Residual",
    "Ripple",
    "RotorInertia",
    "Saturation",
    "Servo",
    "Spring",
    "Stribeck",
    "TorqueSpeed",
    "Viscous",
]
