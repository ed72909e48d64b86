"""Effects that a scene can simulate, each an object that belongs to one slot."""

from torchdq.effects.actuator import DeadBand, Delay, Lag, QuantisedCommand, Saturation, TorqueSpeed
from torchdq.effects.body import Contact, Drag, Push
from torchdq.effects.effect import Effect
from torchdq.effects.friction import Coulomb, Directional, LoadDependent, Quadratic, Ripple, Stribeck, Viscous
from torchdq.effects.joint import Limits, Servo, Spring
from torchdq.effects.model import Gravity, MassScale, Payload, RotorInertia
from torchdq.effects.presliding import LuGre
from torchdq.effects.residual import Residual
from torchdq.effects.sensor import Bias, Noise, QuantisedReading, ReadingDelay
from torchdq.effects.transmission import Elastic

__all__ = [
    "Bias",
    "Contact",
    "Coulomb",
    "DeadBand",
    "Delay",
    "Directional",
    "Drag",
    "Effect",
    "Elastic",
    "Gravity",
    "Lag",
    "Limits",
    "LoadDependent",
    "LuGre",
    "MassScale",
    "Noise",
    "Payload",
    "Push",
    "Quadratic",
    "QuantisedCommand",
    "QuantisedReading",
    "ReadingDelay",
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
