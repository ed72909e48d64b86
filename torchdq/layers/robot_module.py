"""Base of all layers: the robot, the quantities that are learned, friction, and the program."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, NoReturn, get_args

import torch
from torch import Tensor, nn
from torch.nn.utils import parametrize

from torchdq.backends.call import results_of
from torchdq.backends.choice import BackendName
from torchdq.base.checks import POSITIVE, OneOf, require, require_tensor
from torchdq.effects.friction import Friction
from torchdq.effects.resistance import friction
from torchdq.errors import ArgumentError, nearest
from torchdq.functions.call import Precision, function_of, with_tensors
from torchdq.functions.catalogue import FLOATING, Function
from torchdq.functions.signature import Field
from torchdq.layers.layer_friction import layer_friction
from torchdq.layers.layer_program import Parameters, program
from torchdq.layers.parametrizations import PhysicalInertia, Positive, restored
from torchdq.program.program import Program
from torchdq.robot import Robot
from torchdq.robot.argument import require_bodies, require_robot
from torchdq.robot.fields import SHAPES
from torchdq.robot.robot import constants

# parametrisation of each constrained quantity
CONSTRAINED: dict[str, type[Positive | PhysicalInertia]] = {
    "mass": Positive,
    "armature": Positive,
    "inertia": PhysicalInertia,
    "base_mass": Positive,
    "base_inertia": PhysicalInertia,
}
INITIAL = {"armature": 1e-3, "offset": 0.0}  # initial value of what the description does not give [SI]
LAYER_TORQUES = ("friction", "offset")  # learned torques that are not those of rigid bodies
SMALLEST_SIZE = 1e-2  # least size of a body, against which `prior` measures the shift of its centre of mass [m]


class RobotModule(nn.Module):
    """Module that holds a robot and learns the quantities that `learn` names; see `InverseDynamics` for the arguments.

    A layer runs one program, which is that of its function with friction and offset (`torchdq.layers.layer_program`).
    """

    viscous: Tensor  # [n], if friction is learned
    coulomb: Tensor  # [n], if friction is learned
    offset: Tensor  # [n], if it is learned
    _function = ""  # in the catalogue, without friction and offset
    _own: tuple[str, ...] = ()  # quantities that a derived layer learns itself
    precision: Precision = "auto"
    OPTIONS: ClassVar[Mapping[str, Field]] = {
        "sign_width": Field("sign_width", kind="option", check=POSITIVE),
        "backend": Field("backend", kind="option", check=OneOf((None, *get_args(BackendName)))),
    }

    def __init__(
        self,
        robot: Robot,
        learn: Sequence[str] = (),
        backend: BackendName | None = None,
        sign_width: float = 1e-2,
        friction: Sequence[Friction] = (),
    ):
        super().__init__()
        for name, x in {"sign_width": sign_width, "backend": backend}.items():
            require(name, x, self.OPTIONS[name].check)
        if require_robot(robot).floating != self._function.startswith(FLOATING):
            kind, found, cure = ("fixed", "floating", "torchdq.nn.FloatingInverseDynamics or FloatingForwardDynamics")
            if not robot.floating:
                kind, found, cure = found, kind, "torchdq.InverseDynamics or ForwardDynamics"
            raise ArgumentError(
                f"robot of {type(self).__name__} must have a {kind} base, found {robot.name!r} with a {found} one; "
                f"use {cure}, or effects.Servo to control joints on any base"
            )
        self._robot = robot
        self.learn = learnable(robot, learn, self._own)
        self.backend = backend
        self.sign_width = float(sign_width)
        self._friction = layer_friction(robot, friction, "friction" in self.learn, self.sign_width)
        self._rigid = not (self._friction.effects or "offset" in self.learn)  # its program is that of the function
        forms = {**CONSTRAINED, **{name: self._friction.constraint(name) for name in self._friction.learned}}
        self._initial: dict[str, Tensor] = {}  # unconstrained numbers by quantity, from which `prior` measures
        for name in self.learn:
            start = self._friction.initial() if name == "friction" else {name: initial_value(robot, name)}
            for quantity, value in start.items():
                self.register_parameter(quantity, nn.Parameter(value))
                form = forms.get(quantity)
                if form is not None:
                    parametrize.register_parametrization(self, quantity, form(quantity))
                if form is not None or quantity in ("com", "base_com"):
                    self._initial[quantity] = self._unconstrained(quantity).detach().clone()

    def __setattr__(self, name: str, value: Any) -> None:
        """Assign; raises if the robot's quantity is not learned or of another shape. A parameter takes the numbers."""
        if name in (*SHAPES, "viscous", "coulomb", "offset") and "learn" in self.__dict__:
            source = "friction" if name in ("viscous", "coulomb") else name
            if source not in self.learn or (source == "friction" and name not in self._friction.learned):
                raise ArgumentError(
                    f"{name} is not learned by this layer, so assigning to it would change nothing; make the layer "
                    f"with learn={(*self.learn, source)}, or with robot.replace(...)"
                )
        made = "_initial" in self.__dict__ and isinstance(value, Tensor)
        if made and (name in self._parameters or parametrize.is_parametrized(self, name)):
            present = getattr(self, name)
            joints = value.shape[max(value.ndim - present.ndim, 0) :][:1]
            if joints != present.shape[:1] and value.ndim:
                expected = ", ".join(["...", *map(str, present.shape)])
                raise ArgumentError(f"{name} must have the shape [{expected}], found {tuple(value.shape)}")
            if not isinstance(value, nn.Parameter):
                value = value.to(present)
                if name in self._parameters and value.shape == present.shape:
                    with torch.no_grad():
                        present.copy_(value)  # an optimiser goes on with it
                    return
        super().__setattr__(name, value)

    @property
    def robot(self) -> Robot:
        """Robot with the module's present parameters."""
        return self._present()

    def _present(self) -> Robot:
        changes = {name: getattr(self, name) for name in self.learn if name in SHAPES}
        return self._robot._with(**changes) if changes else self._robot

    @property
    def friction(self) -> tuple[Friction, ...]:
        """Friction effects with the module's present coefficients, for a scene with the same friction."""
        return self._friction.present(self._coefficients())

    def _coefficients(self) -> dict[str, Tensor]:
        """Friction that is learned, by quantity."""
        return {name: getattr(self, name) for name in self._friction.learned}

    def friction_torque(self, qd: Tensor, q: Tensor | None = None, load: Tensor | None = None) -> Tensor:
        """Torque [..., n] that overcomes the friction at velocities qd [..., n], in its dtype and on its device.

        Zero without friction. A scene with the same effects exerts the opposite on its joints.

        Args:
            qd: velocities [rad/s or m/s], shape [..., n].
            q: positions [rad or m], shape [..., n], for friction that depends on them; None: zero.
            load: torques of the rigid bodies [N m or N], shape [..., n], for friction that depends on them; None: zero.

        >>> import torchdq
        >>> layer = torchdq.DQRNEA(torchdq.robots.load("two_link"), learn="friction")
        >>> layer.viscous = torch.tensor([2.0, 3.0], dtype=torch.float64)
        >>> layer.friction_torque(torch.tensor([10.0, -10.0])).detach()
        tensor([ 20.0100, -30.0100])
        """
        require_tensor("qd", qd)
        zeros = torch.zeros_like(qd)
        if not self._friction.effects:
            return zeros
        of = self._friction.parts(self._coefficients())
        return friction(of, zeros if q is None else q, qd, zeros if load is None else load, self.backend)

    def _evaluated(self, inputs: dict[str, Tensor | None], function: str = "") -> list[Tensor]:
        """Results of the layer's program, or that of another function, of the arguments of the function."""
        robot, friction, function = self.robot, self._friction, function or self._function
        if self._rigid:
            return function_of(function, robot, inputs, self.backend, (), self.precision)
        own, _ = self._own_quantities()
        what = Function(*self._computation(function)[:-1], friction.fixed.templates)
        parameters = {name: x for name, x in own.items() if name not in friction.learned}
        given = {**with_tensors(robot, inputs), **friction.parts(own).tensors, **parameters}
        return [*results_of(what, given, self.backend, self.precision == "double")[1]]

    def program(self, *wrenches: str, parameters: Parameters = "constants") -> Program:
        """Program of the layer, with learned friction and offset, for `torchdq.compile` and its `export`.

        Its arguments are those of `forward`; "f_tip" and "f_ext" are there if they are named.

        Args:
            wrenches: their names.
            parameters: "constants": all quantities have their present values. "arguments": those that are learned, and
                those that were replaced in the robot, are arguments, in SI units.

        >>> import torchdq
        >>> layer = torchdq.DQRNEA(torchdq.robots.load("two_link"), learn=("mass", "friction"))
        >>> [a.name for a in layer.program(parameters="arguments").arguments]
        ['q', 'qd', 'qdd', 'mass', 'viscous', 'coulomb']
        """
        own, learned = self._own_quantities()
        what = self._computation(self._function)
        return program(self.robot, what, wrenches, parameters, own, learned, self._friction)

    def _computation(self, function: str) -> Function:
        """Function of its rigid bodies."""
        return Function(constants(self.robot), function)

    def _own_quantities(self) -> tuple[dict[str, Tensor], list[str]]:
        """Parameters of its program that are not the robot's, and the names of those that are learned."""
        own = self._coefficients() | ({"offset": self.offset} if "offset" in self.learn else {})
        return own, list(own)

    def prior(self) -> Tensor:
        """Distance of the learned quantities from their initial values: a number >= 0 without units.

        The sum of the mean squares, over links or joints and over robots, of the logarithms of the factors of masses,
        rotor inertias and frictions; of the shifts of centres of mass, relative to the size of the body, the root of
        its second moments over its mass, at least 1 cm; and of the changes of the six unconstrained numbers of
        `torchdq.layers.parametrizations.PhysicalInertia`. Gravity, geometry, home and offset are not part of it.

        >>> import torchdq
        >>> layer = torchdq.DQRNEA(torchdq.robots.load("panda"), learn=("mass", "com", "inertia"))
        >>> layer.mass = 1.1 * layer.mass.detach()
        >>> f"{layer.prior().item():.6f}", f"{torch.tensor(1.1).log().square():.6f}"
        ('0.009084', '0.009084')
        """
        terms = []
        for quantity, initial in self._initial.items():
            present = self._unconstrained(quantity)
            square = (present - initial.to(present)).square()
            body = quantity.removeprefix("base_")
            if body == "com":
                square = square / self._sizes_squared(square, quantity.removesuffix("com")).unsqueeze(-1)
            terms.append(square.sum(-1).mean() if body in ("com", "inertia") else square.mean())
        return torch.stack(terms).sum() if terms else torch.zeros((), dtype=torch.float64)

    def _unconstrained(self, quantity: str) -> Tensor:
        """Unconstrained numbers behind a quantity."""
        if parametrize.is_parametrized(self, quantity):
            return self.parametrizations[quantity].original  # type: ignore[union-attr,index]
        return getattr(self, quantity)

    def _sizes_squared(self, like: Tensor, of: str) -> Tensor:
        """Second moments of every described body over its mass [..., n] [m^2]; those `of` the base, "base_"."""
        inertia, mass = (getattr(self._robot, of + name).detach().to(like) for name in ("inertia", "mass"))
        spread = inertia[..., (0, 2, 5)].sum(-1) / 2
        # without a mass the ratio is undefined, and the least size is as good as any
        return (spread / mass.where(mass > 0, torch.inf)).clamp(min=SMALLEST_SIZE**2)

    def __prepare_scriptable__(self) -> NoReturn:
        kind = parametrize.type_before_parametrizations(self).__name__
        raise ArgumentError(
            f"torch.jit.script cannot compile a {kind}, which runs a program that is compiled for its robot already; "
            f"use torch.compile, torch.export.export, or torch.jit.trace with example inputs"
        )

    def extra_repr(self) -> str:
        """Robot, for `print(module)`."""
        return repr(self._robot)

    def __reduce_ex__(self, protocol: Any) -> Any:
        """Parts for pickle, since torch cannot pickle a module whose class it made for its parametrizations."""
        if not parametrize.is_parametrized(self):
            return super().__reduce_ex__(protocol)
        modules = dict(self._modules)
        lists = dict(modules.pop("parametrizations").items())  # type: ignore[union-attr,operator]
        state = {**self.__dict__, "_modules": modules}
        return restored, (parametrize.type_before_parametrizations(self), state, lists)


def learnable(robot: Robot, learn: Any, own: Sequence[str] = ()) -> tuple[str, ...]:
    """Names in `learn`, each once; raises unless all are the layer's own or quantities that the robot has."""
    described = [field for field in SHAPES if getattr(robot, field) is not None or field == "armature"]
    known = [*own, *described, *LAYER_TORQUES]
    names = (learn,) if isinstance(learn, str) else learn
    wrong = [name for name in names if name not in known] if isinstance(names, Sequence) else [learn]
    if wrong:
        expected = f"learn must be among {', '.join(known)} for robot {robot.name!r}"
        raise ArgumentError(f"{expected}, found {wrong[0]!r}{_cure(wrong[0], known)}")
    if "inertia" in names:
        require_bodies(robot, "learning inertias")
    return tuple(dict.fromkeys(names))


def _cure(wrong: Any, known: Sequence[str]) -> str:
    """Cure for a value that is not a learnable quantity."""
    if isinstance(wrong, Mapping):
        return "; it takes names alone, and starts from the numbers of the robot: give others by robot.replace(...)"
    if not isinstance(wrong, str):
        return ""
    if wrong in ("damping", "viscous", "coulomb", "stribeck"):
        return "; 'friction' learns viscous and Coulomb friction, from the damping and the friction of the robot on"
    if wrong in ("kp", "kd"):
        return "; gains are those of controllers, such as torchdq.ComputedTorque"
    close = nearest(wrong, known)
    return f"; did you mean {' or '.join(map(repr, close))}?" if close else ""


def initial_value(robot: Robot, name: str) -> Tensor:
    """Initial value of a quantity, but for friction."""
    if name == "offset" or getattr(robot, name) is None:
        return torch.full_like(robot.damping, INITIAL[name])
    return getattr(robot, name).detach().clone()
