"""Effects that a scene can simulate, each an object that belongs to one slot."""

from torchdq.effects.actuator import DeadBand, Delay, Lag, QuantisedCommand, Saturation, TorqueSpeed
from torchdq.effects.body import Contact, Drag, Push
from torchdq.effects.effect import Effect
from torchdq.effects.joint import Coulomb, Limits, Servo, Spring, Stribeck, Viscous
from torchdq.effects.model import Gravity, MassScale, Payload, RotorInertia
from torchdq.effects.residual import Residual
from torchdq.effects.sensor import Bias, Noise, QuantisedReading, ReadingDelay
from torchdq.effects.transmission import Elastic

__all__ = [
    "Bias",
    "Contact",
    "Coulomb",
    "DeadBand",
    "Delay",
    "Drag",
    "Effect",
    "Elastic",
    "Gravity",
    "Lag",
    "Limits",
    "MassScale",
    "Noise",
    "Payload",
    "Push",
    "QuantisedCommand",
    "QuantisedReading",
    "ReadingDelay",
    "Residual",
    "RotorInertia",
    "Saturation",
    "Servo",
    "Spring",
    "Stribeck",
    "TorqueSpeed",
    "Viscous",
]
