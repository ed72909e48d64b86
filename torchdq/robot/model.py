"""Names and numbers of a robot: a tree of links, each carried by one joint, frozen, as float64 tensors.

Below everything that reads, checks or changes robots; `robot.Robot` adds that to it as methods.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from operator import methodcaller
from typing import Any, TypeVar

import torch
from torch import Tensor
from torch.compiler import is_compiling

from torchdq.base.checks import DTYPES, destination, require_tensor
from torchdq.dynamics.joints import KINDS, Helical, Prismatic, Revolute
from torchdq.dynamics.tree import BASE
from torchdq.errors import ArgumentError, DtypeError, UnknownNameError
from torchdq.findings import Finding
from torchdq.robot.constants import Constants, stored, version
from torchdq.robot.description import NO_MASS, NO_TIP, Closure, Frame, JointMap, Limits
from torchdq.robot.fields import BASE_BODY, DESCRIBED, INERTIAL, OPTIONAL, SHAPES, trailing


@dataclass(frozen=True, eq=False)
class RobotModel:
    """Fields of a robot, its names, and copies of it; see `Robot`."""

    name: str
    joint_names: tuple[str, ...]
    link_names: tuple[str, ...]  # names of the links that joints move
    parents: tuple[int, ...]  # parent of link i; -1: the base
    kinds: tuple[str, ...]  # "revolute", "prismatic", "helical"
    X_PB_home: Tensor  # [..., links, 8] pose of each link frame in its parent's frame at home
    screw: Tensor  # [..., links, 6] joint screw in the link frame: line of a revolute joint, eps l of a prismatic one
    mass: Tensor  # [..., links] [kg]
    com: Tensor  # [..., links, 3] centre of mass in the link frame [m]
    inertia: Tensor  # [..., links, 6] about the centre of mass, link axes: xx xy yy xz yz zz [kg m^2]
    gravity: Tensor | None  # [..., 3] gravitational acceleration in the base frame [m/s^2]; None: none
    limits: Limits
    damping: Tensor  # [n] viscous friction as described [N m s/rad or N s/m]; not part of the rigid-body dynamics
    friction: Tensor  # [n] Coulomb friction as described [N m or N]; not part of the rigid-body dynamics
    frames: tuple[Frame, ...]
    tip: str | None = None  # name of the frame of the end effector, F_{n+1}; None: not chosen
    home: Tensor | None = None  # [..., links] joint positions at home [rad or m]; None: zero
    armature: Tensor | None = None  # [..., n] rotor inertia at the joint [kg m^2 or kg]; None: none
    base_mass: Tensor | None = None  # [...] of a floating base [kg]; None: the base is fixed
    base_com: Tensor | None = None  # [..., 3] in the frame of the base [m]
    base_inertia: Tensor | None = None  # [..., 6] about its centre of mass, as `inertia` [kg m^2]
    joint_map: JointMap | None = None  # joints that follow the coordinates; None: every joint is a coordinate
    closures: tuple[Closure, ...] = ()  # frames that are held together, which close loops; see `with_closures`
    notes: tuple[Finding, ...] = ()  # faults, suspicions, and parts of the description that are not used
    _arguments: tuple[str, ...] = field(default=(), repr=False)  # see `arguments`
    _constants: Constants | None = field(default=None, repr=False)  # see `constants`; None: those of the fields
    _storages: tuple[Tensor, ...] = field(default=(), repr=False)  # storages of the constants; (): new ones
    _watched: tuple[Tensor, ...] = field(default=(), repr=False)  # constants, which must not require grad

    def __post_init__(self) -> None:
        require_shapes(self)
        batched = batches(self)  # these depend on the sample and cannot be constants
        names = tuple(name for name in present(self, SHAPES) if name in self._arguments or name in batched)
        made: dict[str, Any] = {"_arguments": names}
        kept = {name: x for name, x in values(self).items() if name not in names}
        if not self._storages:
            kept, made["_storages"] = stored(kept)
            made |= kept
        made["_watched"] = tuple([kept[name] for name in SHAPES if kept.get(name) is not None])
        if self._constants is None:
            own = {name: x for name, x in values(self).items() if name != "notes"}
            made["_constants"] = Constants.of(own, {name: len(SHAPES[name]) for name in names})
        if self.tip is not None:
            made["notes"] = tuple([note for note in self.notes if note.code != NO_TIP])
        for name, value in made.items():
            object.__setattr__(self, name, value)

    def __reduce__(self) -> tuple[Any, ...]:
        """Parts for pickle and copy: all fields but the storages, which the copy makes itself."""
        require_unchanged(self)
        return type(self), tuple(getattr(self, f.name) for f in dataclasses.fields(self)[:-2])

    # --- names ---

    @property
    def n(self) -> int:
        """Number of coordinates: of joints, less those that follow others."""
        return len(self.joint_names)

    @property
    def sizes(self) -> dict[str, int]:
        """Numbers of coordinates, "n", of "links", and of "closures", which name axes of tensors."""
        return {"n": len(self.joint_names), "links": len(self.link_names), "closures": len(self.closures)}

    @property
    def every_joint(self) -> tuple[str, ...]:
        """Names of all joints, one per link; `joint_names` are those of the coordinates."""
        return self.joint_names if self.joint_map is None else self.joint_map.joint_names

    @property
    def floating(self) -> bool:
        """Whether the base is free."""
        return self.base_mass is not None

    @property
    def joint_types(self) -> tuple[type[Revolute | Prismatic | Helical], ...]:
        """Types of the joints [n], with class attributes `turns` and `slides`.

        A coordinate has that of the joint with its name if it moves it, otherwise that of the first joint it moves.
        """
        if self.joint_map is None:
            return tuple(KINDS[kind] for kind in self.kinds)
        joints, S = self.joint_map
        moved = ([i for i, x in enumerate(column) if x] for column in S.T.tolist())
        own = ((joints.index(name) if name in joints else None) for name in self.joint_names)
        first = (k if k in among else among[0] for k, among in zip(own, moved, strict=True))
        return tuple(KINDS[self.kinds[i]] for i in first)

    @property
    def frame_names(self) -> tuple[str, ...]:
        """Names of all frames: all links of the description, those on fixed joints included."""
        return tuple(frame.name for frame in self.frames)

    def frame(self, name: str) -> Frame:
        """Frame with a name; raises `UnknownNameError` with the closest names."""
        for frame in self.frames:
            if frame.name == name:
                return frame
        raise UnknownNameError(f"frame of robot {self.name!r}", name, self.frame_names)

    def joint_index(self, name: str) -> int:
        """Position in `q` of the joint with a name; raises `UnknownNameError` with the closest names."""
        if name not in self.joint_names:
            raise UnknownNameError(f"joint of robot {self.name!r}", name, self.joint_names)
        return self.joint_names.index(name)

    def end_effector(self) -> Frame:
        """Frame of the end effector; raises `ArgumentError` if none was chosen or if it does not move."""
        if self.tip is None:
            raise ArgumentError(
                f"tip of robot {self.name!r} must be chosen for an end effector, which f_tip, reaching tasks and "
                "Contact without points need; found None; load it with tip=, or use robot.with_tip(name) with one of "
                + ", ".join(self.frame_names)
            )
        frame = self.frame(self.tip)
        if frame.link == BASE and not self.floating:
            raise ArgumentError(f"the tip {frame.name!r} of robot {self.name!r} is fixed to the base")
        return frame

    # --- copies ---

    def _with(self: AnyRobot, **changes: Any) -> AnyRobot:
        """Robot with some fields replaced, their values unchecked."""
        names = tuple(name for name in SHAPES if name in self._arguments or changes.get(name) is not None)
        freed = "base_mass" in changes and not self.floating  # and has other functions
        same = all(name in SHAPES and value is not None for name, value in changes.items()) and not freed
        kept = not any(name in DESCRIBED for name in changes)
        if any(name in INERTIAL for name in changes):
            changes["notes"] = tuple([x for x in changes.get("notes", self.notes) if x.code != NO_MASS])
        changes |= {"_constants": self._constants if same else None, "_storages": self._storages if kept else ()}
        return dataclasses.replace(self, **changes, _arguments=names)

    def bake(self: AnyRobot) -> AnyRobot:
        """Robot whose tensors, all without batch axes, are constants of its programs, which is fastest."""
        require_unchanged(self)
        for name in batches(self):
            raise ArgumentError(f"{name} of robot {self.name!r} has batch axes and cannot be a constant")
        detached = {name: getattr(self, name).detach() for name in self._arguments}
        return dataclasses.replace(self, **detached, _arguments=(), _constants=None, _storages=())

    def to(self: AnyRobot, dtype: Any = None, device: torch.device | str | None = None) -> AnyRobot:
        """Robot with all tensors converted to a dtype and moved to a device; a device may come first, as in torch."""
        require_unchanged(self)
        cast = methodcaller("to", **destination(dtype, device))
        fields = {name: getattr(self, name) for name in (*SHAPES, "damping", "friction")}
        changes: dict[str, Any] = {name: None if x is None else cast(x) for name, x in fields.items()}
        changes["limits"] = Limits(*map(cast, self.limits))
        changes["joint_map"] = self.joint_map and self.joint_map._replace(S=cast(self.joint_map.S))
        changes["frames"] = tuple(frame._replace(X_BF=cast(frame.X_BF)) for frame in self.frames)
        return dataclasses.replace(self, **changes, _constants=None, _storages=())

    def __repr__(self) -> str:
        links = len(self.link_names)
        hangs = "chain" if self.parents == tuple(range(BASE, links - 1)) else "tree"
        masses = [self.mass.sum(-1), *([] if self.base_mass is None else [self.base_mass])]
        mass = "?" if any(x.is_meta for x in masses) else f"{sum(float(x.detach().mean()) for x in masses):.4g}"
        joints = f"{self.n} joints" if links == self.n else f"{self.n} joints that move {links} links"
        free = "floating base, " if self.floating else ""
        loops = f" with {len(self.closures)} closures" if self.closures else ""
        return f"Robot({self.name!r}, {joints}, {free}{hangs}{loops}, {mass} kg, tip={self.tip!r})"


AnyRobot = TypeVar("AnyRobot", bound=RobotModel)


def values(robot: RobotModel) -> dict[str, Any]:
    """Values of the public fields of a robot, by name."""
    return {name: value for name, value in vars(robot).items() if not name.startswith("_")}


def present(robot: RobotModel, names: Collection[str]) -> dict[str, Tensor]:
    """Tensors of a robot, by name, that are among the names and are not absent."""
    tensors = {name: getattr(robot, name) for name in SHAPES if name in names}
    return {name: x for name, x in tensors.items() if x is not None}


def batches(robot: RobotModel) -> dict[str, tuple[int, ...]]:
    """Batch axes, by name, of the tensors of a robot that have some."""
    axes = {name: tuple(x.shape[: x.ndim - len(SHAPES[name])]) for name, x in present(robot, SHAPES).items()}
    return {name: batch for name, batch in axes.items() if batch}


def factors(robot: RobotModel) -> Tensor:
    """Positions of all joints per coordinate, [links, n]."""
    if robot.joint_map is not None:
        return robot.joint_map.S
    return torch.eye(robot.n, dtype=robot.screw.dtype, device=robot.screw.device)


def followed(robot: RobotModel, joint: str) -> dict[str, float]:
    """Factors of the coordinates that a joint follows, by name."""
    row = factors(robot)[robot.every_joint.index(joint)].tolist()
    return {name: x for name, x in zip(robot.joint_names, row, strict=True) if x}


def sum_of(factors: Mapping[str, float]) -> str:
    """Sum of coordinates, in words."""
    return " + ".join(f"{x:g} {name}" for name, x in factors.items()) or "nothing"


def require_shapes(robot: RobotModel) -> None:
    """Raise unless the physical tensors of a robot are tensors of their shapes and of a dtype of the package."""
    n = len(robot.joint_names)
    absent = [name for name in BASE_BODY if getattr(robot, name) is None]
    if 0 < len(absent) < 3:
        raise ArgumentError(
            f"base_mass, base_com and base_inertia of robot {robot.name!r} must be given together, for a floating "
            f"base, or all be None; {', '.join(absent)} {'is' if len(absent) == 1 else 'are'} None"
        )
    for name, axes in SHAPES.items():
        value = getattr(robot, name)
        if value is None and name in OPTIONAL:
            continue
        shape = trailing(axes, robot.sizes)
        if isinstance(value, Tensor):
            require_tensor(f"{name} of robot {robot.name!r}", value)
        if not isinstance(value, Tensor) or tuple(value.shape[value.ndim - len(shape) :]) != shape:
            found = tuple(value.shape) if isinstance(value, Tensor) else type(value).__name__
            expected = ", ".join(["...", *map(str, shape)])
            raise ArgumentError(
                f"{name} of robot {robot.name!r} must be a tensor of shape [{expected}] for its {n} joints, "
                f"found {found}"
            )
        if value.dtype not in DTYPES:
            raise DtypeError(f"{name} of robot {robot.name!r} must be float32 or float64, found {value.dtype}")


def require_unchanged(robot: RobotModel, replaced: Collection[str] = ()) -> None:
    """Raise if a constant tensor was changed in place or requires grad: programs have its numbers, not the tensor.

    Changes through `x.data` and `x.numpy()` are not seen, since torch does not count them. Tensors with the names
    `replaced` may require grad.
    """
    if is_compiling():
        return
    if any(map(version, robot._storages)):
        constant = {name: x for name, x in values(robot).items() if name not in ("notes", *robot._arguments)}
        names = robot._constants.changed(constant) or ["a tensor"]  # type: ignore[union-attr]
        raise ArgumentError(
            f"{', '.join(names)} of robot {robot.name!r} was changed in place, but its programs still have the numbers "
            f"of before; load the robot again and use robot.replace({names[0]}=...)"
        )
    for name, x in present(robot, SHAPES).items():
        if x.requires_grad and name not in (*replaced, *robot._arguments):
            raise ArgumentError(
                f"{name} of robot {robot.name!r} requires grad, but is a constant of its programs and would get no "
                f"gradient; use robot.replace({name}={name}) with a tensor that requires grad"
            )
