"""Frozen description of a robot: a tree of links, each carried by one joint, as float64 tensors."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from operator import methodcaller
from os import PathLike
from typing import IO, Any, Literal

import torch
from torch import Tensor
from torch.compiler import is_compiling

from torchdq.algebra.inertia import six
from torchdq.caches import PROGRAMS, remembered
from torchdq.checks import destination, frozen
from torchdq.dynamics.joints import KINDS, Helical, Prismatic, Revolute
from torchdq.dynamics.tree import BASE, Tree
from torchdq.errors import ArgumentError, UnknownNameError
from torchdq.program.transforms import any_requires_grad
from torchdq.robot import consistency, from_dh, from_screws, reduced, units, urdf
from torchdq.robot.arrays import finite
from torchdq.robot.changes import check, faults_of, require_fields, require_unchanged, stacked, values
from torchdq.robot.consistency import OnUnphysical
from torchdq.robot.constants import Constants, hold, stored
from torchdq.robot.description import Frame, Limits, RobotDescription
from torchdq.robot.fields import DESCRIBED, SHAPES, batches, present, require_shapes
from torchdq.robot.report import Report
from torchdq.robot.tree import general_tree, plain, unbound

GRAVITY = (0.0, 0.0, -9.81)  # [m/s^2], in the base frame


@frozen
@dataclass(frozen=True, eq=False)
class Robot:
    """Robot with n one-degree-of-freedom joints, each carrying one link.

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
    link_names: tuple[str, ...]
    parents: tuple[int, ...]  # parent of link i; -1: the base
    kinds: tuple[str, ...]  # "revolute", "prismatic", "helical"
    X_PB_home: Tensor  # [..., n, 8] pose of each link frame in its parent's frame at home
    screw: Tensor  # [..., n, 6] joint screw in the link frame: line of a revolute joint, eps l of a prismatic one
    mass: Tensor  # [..., n] [kg]
    com: Tensor  # [..., n, 3] centre of mass in the link frame [m]
    inertia: Tensor  # [..., n, 6] about the centre of mass, link axes: xx xy yy xz yz zz [kg m^2]
    gravity: Tensor | None  # [..., 3] gravitational acceleration in the base frame [m/s^2]; None: none
    limits: Limits
    damping: Tensor  # [n] viscous friction as described [N m s/rad or N s/m]; not part of the rigid-body dynamics
    friction: Tensor  # [n] Coulomb friction as described [N m or N]; not part of the rigid-body dynamics
    frames: tuple[Frame, ...]
    tip: str | None = None  # name of the frame of the end effector, F_{n+1}; None: not chosen
    home: Tensor | None = None  # [..., n] joint positions at home [rad or m]; None: zero
    armature: Tensor | None = None  # [..., n] rotor inertia at the joint [kg m^2 or kg]; None: none
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
        for name, value in made.items():
            object.__setattr__(self, name, value)

    def __reduce__(self) -> tuple[Any, ...]:
        """Parts for pickle and copy: all fields but the storages, which the copy makes anew."""
        require_unchanged(self)
        return Robot, tuple(getattr(self, f.name) for f in dataclasses.fields(self)[:-2])

    # --- sources ---

    @classmethod
    def from_urdf(
        cls,
        source: str | PathLike[str] | bytes | IO[Any],
        base: Literal["fixed"] = "fixed",
        lock: Mapping[str, float] | Sequence[str] | str | None = None,
        tip: str | None = None,
        gravity: Sequence[float] | None = GRAVITY,
        on_unphysical: OnUnphysical = "error",
        joints: Sequence[str] | str | None = None,
    ) -> Robot:
        """Robot from a URDF file.

        Links on fixed joints are merged with their parents and stay as frames; the coordinate of a continuous joint is
        its angle; mimic joints are independent joints. Meshes are never opened. Joint friction, damping and limits are
        read but are not part of the rigid-body dynamics; `report()` lists them.

        Args:
            source: path of the file, a file:// or package:// address, an open file, or the XML text itself.
            base: "fixed", the only kind of base so far.
            lock: positions [rad or m] of joints to fix, by name or pattern ("finger*"), or names alone: at zero. Joints
                that mimic a locked one are locked too.
            tip: name of the frame of the end effector; None: the leaf of the tree, if there is only one.
            gravity: acceleration in the base frame [m/s^2]; None: none.
            on_unphysical: treatment of a body that cannot exist: "error" raises, "warn" warns, "ignore" only notes it.
                One far too large for the robot, as of numbers in mm, can exist: the first two warn, the last notes it.
            joints: names or patterns of the joints to keep, at least one; the others are locked, at 0 or as in `lock`.

        Raises:
            DescriptionError: the text is not a usable URDF; every fault found is named.
            UnphysicalError: a link cannot exist, or a joint moves no inertia.
            UnknownNameError: a name in `lock`, `joints` or `tip` is not in the file.
        """
        if not isinstance(base, str) or base != "fixed":
            raise ArgumentError(f"base must be 'fixed', found {base!r}")
        return cls._finish(*urdf.read(source, joints, lock), tip, gravity, on_unphysical)

    @classmethod
    def from_screws(
        cls,
        joint_screws: Any,
        mass: Any,
        com: Any,
        inertia: Any,
        link_poses: Any = None,
        tip_pose: Any = None,
        parents: Sequence[int] | None = None,
        home: Any = None,
        joint_names: Sequence[str] | None = None,
        link_names: Sequence[str] | None = None,
        gravity: Sequence[float] | None = GRAVITY,
        name: str = "robot",
        on_unphysical: OnUnphysical = "error",
    ) -> Robot:
        """Robot from joint screws given in the base frame at the home position, as in section 5.1 of the paper.

        Args:
            joint_screws: s_i, shape [n, 6]. A unit line (l | p x l) is a revolute joint, (0 | l) a prismatic one,
                (l | p x l + h l) a helical one of pitch h [m/rad].
            mass: [kg], shape [n].
            com: centres of mass [m], shape [n, 3], in the link frames.
            inertia: about the centres of mass [kg m^2], shape [n, 3, 3] or [n, 6] (xx xy yy xz yz zz), link axes.
            link_poses: delta_i^0, pose of each link frame in the base frame at home, shape [n, 8]; None: all link
                frames coincide with the base frame at home.
            tip_pose: delta_{n+1}^0, pose of the end effector in the base frame at home, shape [8], on the last link.
            parents: index of the parent of each link, -1 for the base, shape [n]; None: a serial chain.
            home: joint positions at home [rad or m], shape [n]; None: zero.
            joint_names, link_names, name: names; None: joint1, link1, ...
            gravity, on_unphysical: as in `from_urdf`.
        """
        bodies = dict(mass=mass, com=com, inertia=inertia, home=home, link_names=link_names, name=name)
        found = from_screws.read(joint_screws, link_poses, tip_pose, parents, joint_names, **bodies)
        return cls._finish(*found, None, gravity, on_unphysical)

    @classmethod
    def from_dh(
        cls,
        a: Sequence[float],
        alpha: Sequence[float],
        d: Sequence[float],
        theta: Sequence[float],
        mass: Any,
        com: Any,
        inertia: Any,
        convention: Literal["standard", "modified"] = "standard",
        kinds: Sequence[str] | None = None,
        tip_pose: Any = None,
        joint_names: Sequence[str] | None = None,
        link_names: Sequence[str] | None = None,
        gravity: Sequence[float] | None = GRAVITY,
        name: str = "robot",
        on_unphysical: OnUnphysical = "error",
    ) -> Robot:
        """Robot from Denavit-Hartenberg parameters; link frame i is DH frame i of the convention.

            standard   frame i in frame i-1: Rot_z(theta + q) Trans_z(d) Trans_x(a) Rot_x(alpha)
            modified   frame i in frame i-1: Rot_x(alpha) Trans_x(a) Rot_z(theta + q) Trans_z(d)

        Args:
            a, d: lengths [m], shape [n]; in the modified convention a is a_{i-1}.
            alpha, theta: angles [rad], shape [n]; in the modified convention alpha is alpha_{i-1}; theta is the offset
                at q = 0. The coordinate of a prismatic joint is added to d.
            mass, com, inertia: as in `from_screws`, in the DH frames.
            kinds: "revolute" or "prismatic" per joint; None: all revolute.
            tip_pose: pose of the end effector in the last DH frame, shape [8]; None: that frame.
            joint_names, link_names, name, gravity, on_unphysical: as in `from_screws`.
        """
        bodies = dict(mass=mass, com=com, inertia=inertia, link_names=link_names, name=name)
        found = from_dh.read(a, alpha, d, theta, convention, kinds, tip_pose, joint_names, **bodies)
        return cls._finish(*found, None, gravity, on_unphysical)

    @classmethod
    def _finish(
        cls,
        description: RobotDescription,
        faults: list[str],
        tip: str | None,
        gravity: Sequence[float] | None,
        on_unphysical: OnUnphysical,
    ) -> Robot:
        g = None if gravity is None else finite("gravity", gravity)
        robot = cls(**vars(description), gravity=g)
        if tip is not None:
            robot = robot.with_tip(tip)
        faults = faults + consistency.inert_joints(robot.joint_names, general_tree(robot, partial(plain, robot)))
        consistency.complain(robot.name, faults, on_unphysical)
        doubts = units.doubts(robot, quiet=on_unphysical == "ignore")
        return robot._with(notes=(*faults, *doubts, *robot.notes))

    # --- names ---

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.joint_names)

    @property
    def joint_types(self) -> tuple[type[Revolute | Prismatic | Helical], ...]:
        """Types of the joints, with class attributes `turns` and `slides`."""
        return tuple(KINDS[kind] for kind in self.kinds)

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
        `from_urdf`; batches, and tensors that require grad or are inside a transform, only by `check`. Writing in place
        into a replaced tensor changes the robot, into a constant it is refused at the next call; not so through
        `x.data[...]` or `x.numpy()[...]`, which torch does not count: programs keep the numbers of before.

        Raises:
            UnknownNameError, ArgumentError, DtypeError: there is no such field, or a value does not fit the robot.
            UnphysicalError: a body cannot exist, or a friction or a limit is negative.

        >>> import torchdq
        >>> robot = torchdq.robots.load("two_link")
        >>> heavier = robot.replace(mass=robot.mass * torch.tensor([[1.0], [1.1], [1.2]], dtype=torch.float64))
        >>> heavier.mass.shape  # three robots
        torch.Size([3, 2])
        """
        require_fields(self, changes)
        robot = self._with(**changes)
        if any(hold(self._storages, x) for x in changes.values()):  # whose changes in place are not the robot's
            robot = dataclasses.replace(robot, _storages=())
        faults = faults_of(robot, changes)
        consistency.complain(self.name, faults, on_unphysical, stacklevel=3)
        return robot._with(notes=(*faults, *robot.notes)) if faults else robot

    def _with(self, **changes: Any) -> Robot:
        """Robot with some fields replaced, their values unchecked."""
        names = tuple(name for name in SHAPES if name in self._arguments or changes.get(name) is not None)
        same = all(name in SHAPES and value is not None for name, value in changes.items())
        kept = not any(name in DESCRIBED for name in changes)
        changes |= {"_constants": self._constants if same else None, "_storages": self._storages if kept else ()}
        return dataclasses.replace(self, **changes, _arguments=names)

    def check(self) -> None:
        """Raise unless the robot can exist, and warn of other units: a file's checks on all values, batches included.

        >>> import torchdq
        >>> torchdq.robots.load("two_link").check()  # raises nothing: this robot can exist
        """
        check(self)

    @classmethod
    def stack(cls, robots: Sequence[Robot]) -> Robot:
        """Batch of robots with equal trees, as one robot with a new leading axis.

        Tensors that are equal in all robots stay as they are. The name is that of the first robot.

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

    def end_effector(self) -> Frame:
        """Frame of the end effector; raises `ArgumentError` if none was chosen or if it does not move."""
        if self.tip is None:
            raise ArgumentError(
                f"tip of robot {self.name!r} must be chosen for an end effector, which f_tip and reaching tasks need; "
                f"found None; load it with tip=, or use robot.with_tip(name) with one of {', '.join(self.frame_names)}"
            )
        frame = self.frame(self.tip)
        if frame.link == BASE:
            raise ArgumentError(f"the tip {frame.name!r} of robot {self.name!r} is fixed to the base")
        return frame

    def to(self, dtype: Any = None, device: torch.device | str | None = None) -> Robot:
        """Robot with all tensors converted to a dtype and moved to a device; a device may come first, as in torch."""
        require_unchanged(self)
        cast = methodcaller("to", **destination(dtype, device))
        fields = {name: getattr(self, name) for name in (*SHAPES, "damping", "friction")}
        changes: dict[str, Any] = {name: None if x is None else cast(x) for name, x in fields.items()}
        changes["limits"] = Limits(*map(cast, self.limits))
        changes["frames"] = tuple(frame._replace(X_BF=cast(frame.X_BF)) for frame in self.frames)
        return dataclasses.replace(self, **changes, _constants=None, _storages=())

    # --- numbers for the algorithms ---

    def tree(self) -> Tree:
        """Tree of the robot, with numbers that are tensors of the batch axes."""
        require_unchanged(self)
        return general_tree(self, partial(unbound, self))

    @property
    def inertial_parameters(self) -> Tensor:
        """Inertial parameters pi [..., 10 n] of the links about their frames, in the order of the regressor."""
        bodies = [link.inertia for link in self.tree().links[1:]]
        numbers = [x for body in bodies for x in (body.mass, *body.first, *six(body.rotational))]
        return torch.stack(torch.broadcast_tensors(*numbers), -1) if numbers else self.mass

    def report(self) -> Report:
        """Report of what is used and not used of the description, and of unphysical bodies; `print` it."""
        return Report.of(self)

    def __repr__(self) -> str:
        hangs = "chain" if self.parents == tuple(range(BASE, self.n - 1)) else "tree"
        mass = float(self.mass.sum(-1).mean())
        return f"Robot({self.name!r}, {self.n} joints, {hangs}, {mass:.4g} kg, tip={self.tip!r})"


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
