"""Model of an arm's torques: the parameters that `identify` estimates besides those of the bodies."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from torchdq.base.checks import require_choice
from torchdq.effects.friction import Friction
from torchdq.errors import ArgumentError
from torchdq.learning.identification.terms import COULOMB, OFFSET, ROTOR, SHAPES, VISCOUS, Term, terms_of
from torchdq.robot import Robot


@dataclass(frozen=True)
class Model:
    """Parameters that `identify` estimates besides those of the bodies.

    Args:
        friction: "auto": viscous and Coulomb friction, and of other shapes what improves the prediction of blocks left
            out; None: the joints have none. Or friction effects, whose coefficients are estimated, whatever they are
            there; their other numbers hold.
        offset: "auto": estimate a constant torque of the joints whose prediction improves on blocks left out; True: of
            every joint; False: of none.
        armature: "auto": estimate the rotor inertia of the joints whose prediction improves on blocks left out, and
            leave that of others as described; True: of every joint; False: of none.
        gains: estimate the torque per unit of effort of every joint, where `tau` is a current, or a torque by gains
            that are not trusted: 1 with a standard deviation of 0.3 before the samples, and unknown at joints for which
            the layout of the log has no gain. One factor of all gains comes from the described masses.
        memory: whether friction may have a memory, as `torchdq.effects.LuGre` has: scenes simulate it, layers do not.

    Raises:
        ArgumentError: offset or friction has another value than those above.

    >>> from torchdq import effects
    >>> Model(friction=(effects.Viscous(), effects.Coulomb()), offset=False).armature
    'auto'
    """

    friction: Literal["auto"] | Friction | Sequence[Friction] | None = "auto"
    offset: bool | Literal["auto"] = "auto"
    armature: bool | Literal["auto"] = "auto"
    gains: bool = False
    memory: bool = True

    def __post_init__(self) -> None:
        if isinstance(self.friction, str | bool) and self.friction != "auto":
            expected = "None, 'auto', or a sequence of friction effects, such as (effects.Viscous(), effects.Coulomb())"
            raise ArgumentError(f"friction must be {expected}, found {self.friction!r}")
        for name in ("offset", "armature"):
            require_choice(name, getattr(self, name), (True, False, "auto"))

    def fixed(self, robot: Robot, sign_width: float) -> list[Term]:
        """Terms that every joint has."""
        friction = [VISCOUS, COULOMB]
        if self.friction != "auto":
            friction = [*terms_of(self.friction, robot, sign_width)] if self.friction is not None else []
        if not self.memory and any(term.bristles for term in friction):
            cure = "give other friction, or memory=True"
            raise ArgumentError(f"friction must have no memory if memory=False, found LuGre; {cure}")
        return [ROTOR] * (self.armature is True) + friction + [OFFSET] * (self.offset is True)

    def candidates(self) -> list[Term]:
        """Terms that a joint has if they improve its prediction: rotors, offsets, and friction of other shapes."""
        shapes = [term for term in SHAPES if self.memory or not term.bristles] if self.friction == "auto" else []
        return [ROTOR] * (self.armature == "auto") + [OFFSET] * (self.offset == "auto") + shapes

    def of_motors(self, robot: Robot) -> list[Term]:
        """Terms with which gains are estimated; the drives' currents move the rotors, too."""
        rotor = [ROTOR] * (self.armature is not False or robot.armature is not None)
        return rotor + [VISCOUS, COULOMB] * (self.friction is not None) + [OFFSET] * (self.offset is True)
