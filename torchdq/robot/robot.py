"""Robots as users see them: names and numbers, and everything that reads, changes, checks and writes robots."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from inspect import signature
from os import PathLike
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, Literal, get_args

import torch
from torch import Tensor
from torch.compiler import is_compiling

from torchdq.algebra.inertia import six
from torchdq.base.caches import PROGRAMS, remembered
from torchdq.base.checks import frozen, require_choice
from torchdq.base.sources import file_name
from torchdq.errors import ArgumentError, DescriptionError, UnknownNameError, no_attribute
from torchdq.program.transforms import any_requires_grad
from torchdq.robot import from_dh as dh
from torchdq.robot import from_name as named
from torchdq.robot import from_screws as screws
from torchdq.robot import tree as trees
from torchdq.robot.arrays import finite
from torchdq.robot.check import consistency, faults, units
from torchdq.robot.check import report as reports
from torchdq.robot.check.consistency import OnUnphysical
from torchdq.robot.constants import Constants
from torchdq.robot.contact_points import contact_points
from torchdq.robot.description import Base, RobotDescription
from torchdq.robot.edit import closed, combined, coupled, reduced, replaced, rods, stacked
from torchdq.robot.mjcf import read as mjcf
from torchdq.robot.mjcf import writer as mjcf_writer
from torchdq.robot.model import RobotModel, require_unchanged
from torchdq.robot.urdf import read as urdf
from torchdq.robot.urdf import writer as urdf_writer
from torchdq.robot.urdf import xacro as xacro_file

MimicJoints = Literal["coupled", "independent"]
LONGEST_NAME = 300  # characters of a path that an error repeats
GRAVITY = (0.0, 0.0, -9.81)  # [m/s^2], in the base frame

# names of other libraries
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
class Robot(RobotModel):
    """Robot: links, each carried by a joint of one degree of freedom, and n coordinates that move the joints.

        # or from_mjcf, from_xacro, from_dh, from_screws, torchdq.robots.load
        robot = Robot.from_urdf("arm.urdf")
        print(robot.report())  # what the file asks for, what is used, and what looks wrong
        robot = robot.with_payload(mass=2.0)  # a copy; also with_tool, lock, attach, replace

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

    if not TYPE_CHECKING:  # type checkers know the names and the fields

        def __new__(cls, *args: Any, **fields: Any) -> Robot:
            if len(args) == 1 and not fields:
                given = f"{args[0]!r:.{LONGEST_NAME}}"
                raise ArgumentError(
                    f"Robot must have all of its fields, found {given} alone; to read a file, use "
                    f"Robot.from_urdf({given}), or robots.load for a robot that comes with the package"
                )
            return super().__new__(cls)

        def __getattr__(self, name: str) -> Any:
            raise no_attribute("'Robot' object", name, [*dir(Robot), *vars(self)], _ELSEWHERE, "help(torchdq.Robot)")

    @classmethod
    def from_urdf(
        cls,
        source: str | PathLike[str] | bytes | IO[Any],
        base: Base = "file",
        lock: Mapping[str, float] | Sequence[str] | str | None = None,
        tip: str | None = None,
        gravity: Sequence[float] | None = GRAVITY,
        on_unphysical: OnUnphysical = "error",
        joints: Sequence[str] | str | None = None,
        mimic: MimicJoints = "coupled",
    ) -> Robot:
        """Robot from a URDF file.

        Links on fixed joints are merged with their parents and stay as frames; the coordinate of a continuous joint is
        its angle. Meshes are only opened to be drawn. Joint friction, damping and limits are read but are not part of
        the rigid-body dynamics. Errors that are not fatal are recorded in `notes`, by code and subject; `report()`
        lists them. Warnings name what may change the dynamics: elements and attributes that seem misspelt, elements
        given twice, mimic joints without drivers, and impossible limits ("lower" above "upper"), which are ignored.

        Args:
            source: path of the file, a file:// or package:// address, an open file, or the XML text itself.
            base: "file": floating if the file has a floating joint, otherwise fixed; "fixed": such a joint is held at
                its origin; "floating": its child link is the base, or without such a joint the root link. The parent of
                a floating joint is fixed to the world: poses of the base, `X_WB`, are in the frame of the root link,
                whatever the joint's origin is.
            lock: positions [rad or m] of joints to fix, by name or pattern ("finger*"), or names alone: at zero. Joints
                that mimic a locked one are locked too. A joint that mimics another one cannot be locked alone, unless
                `mimic` is "independent".
            tip: name of the frame of the end effector; None: the leaf of the tree, if there is only one.
            gravity: acceleration in the base frame [m/s^2]; None: none.
            on_unphysical: treatment of impossible bodies. A negative mass and an inertia that is not positive definite
                give wrong numbers: "error" raises, "warn" warns. An inertia that only violates the triangle inequality
                gives the numbers of the file, as from every other reader: both warn. "ignore" only notes either.
                "repair" takes the nearest physically consistent inertia: that of the second moments without negative
                principal values. It changes no mass and no link without one. Learning and identification need
                physically consistent inertias; `Robot.check` refuses all others. Suspected units, as of numbers in mm,
                and words that seem misspelt are only noted with "ignore"; the others warn.
            joints: names or patterns of the joints to keep, at least one; the others are locked, at 0 or as in `lock`.
            mimic: treatment of joints that follow others by <mimic>: "coupled", they follow and have no coordinates of
                their own, or "independent".

        Raises:
            DescriptionError: the text is not a usable URDF; every fault found is named.
            UnphysicalError: the mass or the inertia of a link would give wrong numbers.
            UnknownNameError: a name in `lock`, `joints` or `tip` is not in the file.
        """
        require_choice("base", base, get_args(Base))
        require_choice("mimic", mimic, get_args(MimicJoints))
        with naming(source):
            description = urdf.read(source, joints, lock, base, mimic, on_unphysical == "repair")
            return cls._of(description, tip, gravity, on_unphysical)

    @classmethod
    def from_mjcf(
        cls,
        source: str | PathLike[str] | bytes | IO[Any],
        base: Base = "file",
        lock: Mapping[str, float] | Sequence[str] | str | None = None,
        tip: str | None = None,
        gravity: Sequence[float] | Literal["file"] | None = "file",
        on_unphysical: OnUnphysical = "error",
        joints: Sequence[str] | str | None = None,
    ) -> Robot:
        """Robot from an MJCF file, through MuJoCo's own compiler; needs the package `mujoco`.

        Positions are MuJoCo's `qpos`, which is `ref` at home. Bodies without joints are merged with their parents and
        stay as frames, as sites do. Rotor inertia (`armature`) is part of the mass matrix; linear equality constraints
        between joints are part of the robot, and `connect` and `weld` between bodies its `closures`. A ball joint
        NAME is three hinges NAME_x, NAME_y, NAME_z, with a warning, as NAME_y must stay below 70 degrees. Damping,
        friction loss and limits are read but are not part of the rigid-body dynamics; actuators, tendons, contacts and
        springs are noted. `report()` lists them. Armature of a free joint, `gravcomp` of some bodies only or in part,
        and all other equality constraints are ignored with a warning. Meshes are opened to be drawn, and where a
        body's mass comes from them.

        Args:
            source: path of the file, a file:// or package:// address, an open file, or the XML text itself, whose
                includes are searched in the current folder.
            base: "file": floating if the file has a body with a free joint, otherwise fixed; "fixed": such bodies are
                held where the file puts them, and `objects.from_mjcf` reads them as objects of scenes; "floating":
                there must be one.
            lock: positions [rad or m] of joints to fix, by name or pattern ("finger*"), or names alone: at home. Joints
                that are coupled to a locked one are locked too. Free joints are locked by names alone.
            tip: name of the body or site of the end effector; None: the leaf of the tree, if there is only one.
            gravity: acceleration in the frame of the world [m/s^2]; "file": that of the file; None: none.
            on_unphysical: treatment of a body that cannot exist, as in `from_urdf`.
            joints: names or patterns of the joints to keep, at least one; the others are locked, at home or as in
                `lock`.

        Raises:
            MissingLibraryError: mujoco is not installed.
            DescriptionError: MuJoCo cannot compile the file; it has several free bodies.
            UnphysicalError: a joint moves no inertia.
            UnknownNameError: a name in `lock`, `joints` or `tip` is not in the file.
        """
        with naming(source):
            found = mjcf.read(source, base, joints, lock, gravity)
            return cls._of(found.description, tip, found.gravity, on_unphysical)

    @classmethod
    def from_xacro(
        cls,
        path: str | PathLike[str],
        arguments: Mapping[str, Any] | None = None,
        packages: Mapping[str, str | PathLike[str]] | None = None,
        **options: Any,
    ) -> Robot:
        """Robot from a xacro file; needs the package `xacrodoc`, but no ROS.

        A xacro file is a program: expand only files that you trust.

        Args:
            path: path of the file, or a file:// or package:// address.
            arguments: values of the file's `<xacro:arg>` by name, as in {"hand": True, "prefix": "left_"}; others have
                the file's defaults.
            packages: folders of the packages that `$(find name)` names, by name. Others are searched around the file,
                and where ROS lists them.
            options: arguments of `from_urdf`.

        Raises:
            MissingLibraryError: xacrodoc is not installed.
            DescriptionError: the file cannot be expanded, or it expands to no usable URDF.
            UnknownNameError: the file or `from_urdf` has no such argument, or as `from_urdf`.
        """
        _require_options("from_xacro", options, cls.from_xacro, cls.from_urdf)
        with naming(path):
            return cls.from_urdf(xacro_file.expanded(path, arguments, packages), **options)

    @classmethod
    def from_name(cls, name: str, **options: Any) -> Robot:
        """Robot from a description that the package `robot_descriptions` has a name for, as in "panda_description".

        Its repository is cloned on first use. Names that end in "_mj_description" are MJCF files, the others URDF or
        xacro.

        Args:
            name: name of the description; https://github.com/robot-descriptions/robot_descriptions.py lists them.
            options: arguments of `from_urdf`, `from_xacro` or `from_mjcf`, whichever reads the file.

        Raises:
            MissingLibraryError: robot_descriptions is not installed, or what reads the file.
            UnknownNameError: there is no description of that name, or no such argument.
            DescriptionError: the description cannot be fetched, or as the function that reads the file.
        """
        file = named.file_of(name)
        reader: Callable[..., Robot] = getattr(cls, f"from_{file.format}")
        _require_options("from_name", options, reader, *([cls.from_urdf] if file.format == "xacro" else []))
        if file.format == "mjcf":
            return cls.from_mjcf(file.path, **options)
        if file.format == "urdf":
            return cls.from_urdf(file.path, **options)
        arguments, packages = options.pop("arguments", None), file.packages | dict(options.pop("packages", None) or {})
        return cls.from_urdf(xacro_file.expanded(file.path, arguments, packages, file.arguments), **options)

    @classmethod
    def from_screws(
        cls,
        joint_screws: Any,
        mass: Any = None,
        com: Any = None,
        inertia: Any = None,
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
            mass: [kg], shape [n]; None, with `com` and `inertia`: kinematics only, until `with_rods` or `replace` gives
                the links bodies.
            com: centres of mass [m], shape [n, 3], in the link frames.
            inertia: about the centres of mass [kg m^2], shape [n, 3, 3] or [n, 6] (xx xy yy xz yz zz), link axes.
            link_poses: delta_i^0, pose of each link frame in the base frame at home, unit dual quaternions, shape [n,
                8]; None: all link frames coincide with the base frame at home.
            tip_pose: delta_{n+1}^0, pose of the end effector in the base frame at home, a unit dual quaternion [8], on
                the last link; None: the frame of that link.
            parents: index of the parent of each link, -1 for the base, shape [n]; None: a serial chain.
            home: joint positions at home [rad or m], shape [n]; None: zero.
            joint_names, link_names, name: names; None: joint1, link1, ...
            gravity, on_unphysical: as in `from_urdf`.
        """
        bodies = dict(mass=mass, com=com, inertia=inertia, home=home, link_names=link_names, name=name)
        description = screws.read(joint_screws, link_poses, tip_pose, parents, joint_names, **bodies)
        return cls._of(description, None, gravity, on_unphysical, mass is None)

    @classmethod
    def from_dh(
        cls,
        a: Sequence[float],
        alpha: Sequence[float],
        d: Sequence[float],
        theta: Sequence[float],
        mass: Any = None,
        com: Any = None,
        inertia: Any = None,
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
            tip_pose: pose of the end effector in the last DH frame, a unit dual quaternion [8]; None: that frame.
            joint_names, link_names, name, gravity, on_unphysical: as in `from_screws`.
        """
        bodies = dict(mass=mass, com=com, inertia=inertia, link_names=link_names, name=name)
        description = dh.read(a, alpha, d, theta, convention, kinds, tip_pose, joint_names, **bodies)
        return cls._of(description, None, gravity, on_unphysical, mass is None)

    @classmethod
    def _of(
        cls,
        description: RobotDescription,
        tip: str | None,
        gravity: Sequence[float] | None,
        on_unphysical: OnUnphysical,
        kinematics: bool = False,
    ) -> Robot:
        """Robot of a description, of kinematics only on request; faults are raised or warned of, as suspicions are."""
        g = None if gravity is None else finite("gravity", gravity)
        robot = cls(**vars(description), gravity=g)
        if tip is not None:
            robot = robot.with_tip(tip)
        if on_unphysical == "repair":
            inertias, notes = replaced.repaired(robot)
            robot = dataclasses.replace(robot, **inertias, notes=notes, _constants=None, _storages=())
        wrong = [x for x in robot.notes if x.severity == "error" or x.code == consistency.TRIANGLE]
        consistency.complain(robot.name, wrong, on_unphysical)
        warned = [x for x in robot.notes if x.severity == "warning" and x not in wrong]
        suspicions = [*(x for x in warned if x.code.startswith("units.")), *units.diagnostics(robot)]
        if on_unphysical != "ignore":
            units.warn(f"robot {robot.name!r}", suspicions, stacklevel=3)
            if ignored := "\n  ".join(str(x) for x in warned if x not in suspicions):
                what = "elements that are ignored or read differently, which may affect the dynamics"
                warnings.warn(f"robot {robot.name!r}: the file contains {what}:\n  {ignored}", stacklevel=3)
        inert = trees.inert_joints(robot)  # accelerations raise, and all dynamics where no mass moves
        if on_unphysical != "ignore" and trees.MASSLESS in inert and not kinematics:
            warnings.warn(f"robot {robot.name!r}: {trees.MASSLESS}", stacklevel=3)
        notes = (*wrong, *inert, *suspicions, *robot.notes)
        return dataclasses.replace(robot, notes=tuple(dict.fromkeys(notes)))

    to_urdf, to_mjcf = urdf_writer.to_urdf, mjcf_writer.to_mjcf

    replace, with_tip = replaced.replace, replaced.with_tip
    lock, subchain, couple = reduced.lock, reduced.subchain, coupled.couple
    with_closures = closed.with_closures
    with_payload, with_tool, attach = combined.with_payload, combined.with_tool, combined.attach
    with_rods = rods.with_rods
    stack = classmethod(stacked.stack)

    report, tree, contact_points = reports.report, trees.tree, contact_points

    def check(self) -> None:
        """Raise unless the robot can exist, and warn of other units: a file's checks on all values, batches included.

        It is strict: inertias that break the triangle inequality, of which files are only warned, are refused, too.

        >>> import torchdq
        >>> torchdq.robots.load("two_link").check()  # raises nothing: this robot can exist
        """
        faults.check(self)

    @property
    def inertial_parameters(self) -> Tensor:
        """Inertial parameters pi [..., 10 links] about the link frames, in the order of the regressor.

        Those of a floating base come first.
        """
        bodies = [link.inertia for link in self.tree().links if link.inertia is not None]
        numbers = [x for body in bodies for x in (body.mass, *body.first, *six(body.rotational))]
        return torch.stack(torch.broadcast_tensors(*numbers), -1) if numbers else self.mass


def _require_options(caller: str, options: Mapping[str, Any], *readers: Callable[..., Robot]) -> None:
    """Raise, by the name of the function that was called, unless the functions that read the file take the options."""
    known = [x for reader in readers for x in signature(reader).parameters if x not in ("source", "path", "options")]
    for name in [name for name in options if name not in known]:
        raise UnknownNameError(f"argument of Robot.{caller}", name, known)


@contextmanager
def naming(source: Any) -> Iterator[None]:
    """Context in which errors of a description name its file, if it is from one."""
    try:
        yield
    except DescriptionError as error:
        name = file_name(source)
        if not 0 < len(name) <= LONGEST_NAME or Path(name).name in str(error):
            raise
        raise type(error)(f"{name}: {error}", *error.findings) from error


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
