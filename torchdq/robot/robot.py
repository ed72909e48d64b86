"""Frozen description of a robot: a tree of links, each carried by one joint, as float64 tensors."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from operator import methodcaller
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor
from torch.compiler import is_compiling

from torchdq.algebra.inertia import six
from torchdq.base.caches import PROGRAMS, remembered
from torchdq.base.checks import destination, frozen
from torchdq.dynamics.joints import KINDS, Helical, Prismatic, Revolute
from torchdq.dynamics.tree import BASE, Tree
from torchdq.errors import ArgumentError, UnknownNameError, no_attribute
from torchdq.program.transforms import any_requires_grad
from torchdq.robot import loading
from torchdq.robot.check.changes import check, complaints, repaired, require_fields, require_unchanged, stacked, values
from torchdq.robot.check.consistency import OnUnphysical
from torchdq.robot.check.report import Report
from torchdq.robot.constants import Constants, hold, stored
from torchdq.robot.description import NO_TIP, Frame, JointMap, Limits
from torchdq.robot.edit import combined, coupled, reduced
from torchdq.robot.fields import DESCRIBED, SHAPES, batches, present, require_shapes
from torchdq.robot.mjcf import writer as mjcf_writer
from torchdq.robot.tree import general_tree, unbound
from torchdq.robot.urdf import writer as urdf_writer

# names in other libraries
_ELSEWHERE = {
    **dict.fromkeys(("dof", "dofs", "ndof", "nq", "nv", "nu", "njoints", "num_joints", "num_dofs", "n_joints"), "n"),
    **dict.fromkeys(("joints", "joint_list", "actuated_joint_names"), "joint_names"),
    **dict.fromkeys(("links", "bodies", "body_names"), "link_names"),
    **dict.fromkeys(("joint_limits", "q_min", "q_max", "lower", "upper", "qlim"), "limits, with lower and upper"),
    **dict.fromkeys(("effort", "velocity", "torque_limits", "effort_limits"), "limits, with effort and velocity"),
    **dict.fromkeys(("ee", "ee_link", "end_effector_name", "tool"), "tip, and end_effector() is that frame"),
    **dict.fromkeys(("rnea", "inverse_dynamics", "id"), "torchdq.inverse_dynamics(robot, q, qd, qdd)"),
    **dict.fromkeys(("aba", "forward_dynamics", "fd"), "torchdq.forward_dynamics(robot, q, qd, tau)"),
    **dict.fromkeys(("crba", "mass_matrix", "M"), "torchdq.mass_matrix(robot, q)"),
    **dict.fromkeys(("fk", "fkine", "forward_kinematics"), "torchdq.forward_kinematics(robot, q, frame)"),
    **dict.fromkeys(("jacobian", "jacob0", "jacobe"), "torchdq.jacobian(robot, q, frame)"),
}


@frozen
@dataclass(frozen=True, eq=False)
class Robot:
    """Robot of links, each carried by a joint of one degree of freedom, and n coordinates that move the joints.

    Every joint is a coordinate, unless a `joint_map` says which joints follow which coordinates. The base is fixed, or
    free if it has a mass; see `torchdq.floating`.

    Link i's frame B_i is the frame of its joint (of its URDF link, of its DH frame), not its centre of mass. Every
    parent comes before its children. Physical tensors may carry leading batch axes, which broadcast against the
    batch axes of `q`: a batch of different robots is one robot with a batch axis. Change one with `replace`.

    >>> import torchdq
    >>> robot = torchdq.robots.load("two_link")
    >>> robot.n, robot.joint_names
    (2, ('joint1', 'joint2'))
    """

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
    base_mass: Tensor | None = None  # [...] of a free base [kg]; None: the base is fixed
    base_com: Tensor | None = None  # [..., 3] in the frame of the base [m]
    base_inertia: Tensor | None = None  # [..., 6] about its centre of mass, as `inertia` [kg m^2]
    joint_map: JointMap | None = None  # joints that follow the coordinates; None: every joint is a coordinate
    notes: tuple[str, ...] = ()  # faults, and parts of the description that are not used or are used differently
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
            made["notes"] = tuple([note for note in self.notes if NO_TIP not in note])
        for name, value in made.items():
            object.__setattr__(self, name, value)

    def __reduce__(self) -> tuple[Any, ...]:
        """Parts for pickle and copy: all fields but the storages, which the copy makes anew."""
        require_unchanged(self)
        return Robot, tuple(getattr(self, f.name) for f in dataclasses.fields(self)[:-2])

    from_urdf = classmethod(loading.from_urdf)
    from_xacro = classmethod(loading.from_xacro)
    from_mjcf = classmethod(loading.from_mjcf)
    from_name = classmethod(loading.from_name)
    from_screws = classmethod(loading.from_screws)
    from_dh = classmethod(loading.from_dh)

    if not TYPE_CHECKING:  # type checkers know the names

        def __getattr__(self, name: str) -> Any:
            raise no_attribute("'Robot' object", name, [*dir(Robot), *vars(self)], _ELSEWHERE, "help(torchdq.Robot)")

    # --- names ---

    @property
    def n(self) -> int:
        """Number of coordinates: of joints, less those that follow others."""
        return len(self.joint_names)

    @property
    def sizes(self) -> dict[str, int]:
        """Numbers of coordinates, "n", and of "links", which name axes of tensors."""
        return {"n": len(self.joint_names), "links": len(self.link_names)}

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

    # --- changed copies ---

    def replace(self, *, on_unphysical: OnUnphysical = "error", **changes: Any) -> Robot:
        """Robot with some fields replaced; the other fields are shared.

        A replaced physical tensor becomes an argument of the programs, so new values, batches and gradients need no new
        program; `bake` makes it a constant again. New values are checked as a file's are, with `on_unphysical` as in
        `from_urdf`, where "repair" repairs all links of a single robot; batches, and tensors that require grad or are
        inside a transform, only by `check`. Writing in place into a replaced physical tensor changes the robot.
        Damping, friction, limits and frames are copied: writing into the given tensor changes nothing. Writing into a
        copy or a constant is refused at the next call; not so through `x.data[...]` or `x.numpy()[...]`, which torch
        does not count: programs keep the numbers of before.

        Raises:
            UnknownNameError, ArgumentError, DtypeError: there is no such field, or a value does not fit the robot.
            UnphysicalError: a body would give wrong numbers, a friction or a limit is negative, or a link is left with
                inertia and no mass. A file's link may have that, which is noted; a new mass of zero needs an inertia
                of zero.

        >>> import torchdq
        >>> robot = torchdq.robots.load("two_link")
        >>> heavier = robot.replace(mass=robot.mass * torch.tensor([[1.0], [1.1], [1.2]], dtype=torch.float64))
        >>> heavier.mass.shape  # three robots
        torch.Size([3, 2])
        """
        require_fields(self, changes)
        robot = self._with(**changes)
        if on_unphysical == "repair":
            changed, notes = repaired(robot)
            robot = robot._with(**changed, notes=notes) if changed else robot
        if any(hold(self._storages, x) for x in changes.values()):  # whose changes in place are not the robot's
            robot = dataclasses.replace(robot, _storages=())
        faults = complaints(robot, changes, on_unphysical)
        return robot._with(notes=(*faults, *robot.notes)) if faults else robot

    def _with(self, **changes: Any) -> Robot:
        """Robot with some fields replaced, their values unchecked."""
        names = tuple(name for name in SHAPES if name in self._arguments or changes.get(name) is not None)
        freed = "base_mass" in changes and not self.floating  # and has other functions
        same = all(name in SHAPES and value is not None for name, value in changes.items()) and not freed
        kept = not any(name in DESCRIBED for name in changes)
        changes |= {"_constants": self._constants if same else None, "_storages": self._storages if kept else ()}
        return dataclasses.replace(self, **changes, _arguments=names)

    def check(self) -> None:
        """Raise unless the robot can exist, and warn of other units: a file's checks on all values, batches included.

        It is strict: inertias that break the triangle inequality, of which files are only warned, are refused, too.

        >>> import torchdq
        >>> torchdq.robots.load("two_link").check()  # raises nothing: this robot can exist
        """
        check(self)

    @classmethod
    def stack(cls, robots: Sequence[Robot]) -> Robot:
        """Batch of robots with equal trees, as one robot with a new leading axis.

        Tensors that are equal in all robots stay as they are; if all are equal, the masses have the new axis. The name
        is that of the first robot.

        >>> import torchdq
        >>> robot = torchdq.robots.load("two_link")
        >>> torchdq.Robot.stack([robot, robot.replace(mass=2 * robot.mass)]).mass
        tensor([[1., 1.],
                [2., 2.]], dtype=torch.float64)
        """
        return stacked(cls, robots)

    def bake(self) -> Robot:
        """Robot whose tensors, all without batch axes, are constants of its programs, which is fastest."""
        require_unchanged(self)
        for name in batches(self):
            raise ArgumentError(f"{name} of robot {self.name!r} has batch axes and cannot be a constant")
        detached = {name: getattr(self, name).detach() for name in self._arguments}
        return dataclasses.replace(self, **detached, _arguments=(), _constants=None, _storages=())

    def with_tip(self, name: str | None) -> Robot:
        """Robot whose end effector is the frame with a name; None: no end effector."""
        return self.replace(tip=None if name is None else self.frame(name).name)

    lock, subchain = reduced.lock, reduced.subchain
    to_urdf, to_mjcf = urdf_writer.to_urdf, mjcf_writer.to_mjcf
    couple = coupled.couple
    with_payload, with_tool, attach = combined.with_payload, combined.with_tool, combined.attach

    def end_effector(self) -> Frame:
        """Frame of the end effector; raises `ArgumentError` if none was chosen or if it does not move."""
        if self.tip is None:
            raise ArgumentError(
                f"tip of robot {self.name!r} must be chosen for an end effector, which f_tip and reaching tasks need; "
                f"found None; load it with tip=, or use robot.with_tip(name) with one of {', '.join(self.frame_names)}"
            )
        frame = self.frame(self.tip)
        if frame.link == BASE and not self.floating:
            raise ArgumentError(f"the tip {frame.name!r} of robot {self.name!r} is fixed to the base")
        return frame

    def to(self, dtype: Any = None, device: torch.device | str | None = None) -> Robot:
        """Robot with all tensors converted to a dtype and moved to a device; a device may come first, as in torch."""
        require_unchanged(self)
        cast = methodcaller("to", **destination(dtype, device))
        fields = {name: getattr(self, name) for name in (*SHAPES, "damping", "friction")}
        changes: dict[str, Any] = {name: None if x is None else cast(x) for name, x in fields.items()}
        changes["limits"] = Limits(*map(cast, self.limits))
        changes["joint_map"] = self.joint_map and self.joint_map._replace(S=cast(self.joint_map.S))
        changes["frames"] = tuple(frame._replace(X_BF=cast(frame.X_BF)) for frame in self.frames)
        return dataclasses.replace(self, **changes, _constants=None, _storages=())

    # --- numbers for the algorithms ---

    def tree(self) -> Tree:
        """Tree of the robot, with numbers that are tensors of the batch axes."""
        require_unchanged(self)
        return general_tree(self, partial(unbound, self), self.floating)

    @property
    def inertial_parameters(self) -> Tensor:
        """Inertial parameters pi [..., 10 links] about the link frames, in the order of the regressor.

        Those of a free base come first.
        """
        bodies = [link.inertia for link in self.tree().links if link.inertia is not None]
        numbers = [x for body in bodies for x in (body.mass, *body.first, *six(body.rotational))]
        return torch.stack(torch.broadcast_tensors(*numbers), -1) if numbers else self.mass

    def report(self) -> Report:
        """Report of what is used and not used of the description, and of unphysical bodies; `print` it."""
        return Report.of(self)

    def __repr__(self) -> str:
        links = len(self.link_names)
        hangs = "chain" if self.parents == tuple(range(BASE, links - 1)) else "tree"
        masses = [self.mass.sum(-1), *([] if self.base_mass is None else [self.base_mass])]
        mass = "?" if any(x.is_meta for x in masses) else f"{sum(float(x.detach().mean()) for x in masses):.4g}"
        joints = f"{self.n} joints" if links == self.n else f"{self.n} joints that move {links} links"
        free = "free base, " if self.floating else ""
        return f"Robot({self.name!r}, {joints}, {free}{hangs}, {mass} kg, tip={self.tip!r})"


# --- constants and arguments of programs -----------------------------------------------------------------------------


def arguments(robot: Robot) -> tuple[str, ...]:
    """Names of the tensors that are arguments of programs; the others are constants."""
    return robot._arguments


def constants(robot: Robot) -> Constants:
    """Constants of the programs of a robot, if they are still its numbers; replaced tensors are arguments."""
    # every call of a function comes here, so the look is short
    if not is_compiling():
        for x in robot._storages:
            if x._version or any_requires_grad(*robot._watched):
                require_unchanged(robot)
    return robot._constants  # type: ignore[return-value]


@remembered(PROGRAMS)
def recorded(constants: Constants) -> Robot:
    """Robot from which programs with these constants are recorded."""
    return Robot(**constants.tensors(), _constants=constants)
