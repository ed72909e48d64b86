"""Robots from files and tables: class methods of `Robot`."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from os import PathLike
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, Literal, get_args

from torchdq.base.checks import require_choice
from torchdq.base.sources import file_name
from torchdq.errors import DescriptionError
from torchdq.robot import from_dh as dh
from torchdq.robot import from_name as named
from torchdq.robot import from_screws as screws
from torchdq.robot.arrays import finite
from torchdq.robot.check import consistency, units
from torchdq.robot.check.consistency import OnUnphysical
from torchdq.robot.description import RobotDescription
from torchdq.robot.edit.replaced import with_tip
from torchdq.robot.mjcf import read as mjcf
from torchdq.robot.tree import inert_joints
from torchdq.robot.urdf import read as urdf
from torchdq.robot.urdf import xacro as xacro_file

if TYPE_CHECKING:  # checkers of types cannot bind generic class methods
    from torchdq.robot.robot import Robot

Base = Literal["fixed", "floating"]
MimicJoints = Literal["coupled", "independent"]
LONGEST_NAME = 300  # characters of a path that an error repeats
GRAVITY = (0.0, 0.0, -9.81)  # [m/s^2], in the base frame


def from_urdf(
    cls: type[Robot],
    source: str | PathLike[str] | bytes | IO[Any],
    base: Base = "fixed",
    lock: Mapping[str, float] | Sequence[str] | str | None = None,
    tip: str | None = None,
    gravity: Sequence[float] | None = GRAVITY,
    on_unphysical: OnUnphysical = "error",
    joints: Sequence[str] | str | None = None,
    mimic: MimicJoints = "coupled",
) -> Robot:
    """Robot from a URDF file.

    Links on fixed joints are merged with their parents and stay as frames; the coordinate of a continuous joint is
    its angle. Meshes are never opened. Joint friction, damping and limits are read but are not part of the rigid-body
    dynamics. Errors that are not fatal are recorded in `notes`, by code and subject; `report()` lists them. Elements
    and attributes that seem misspelt, elements given twice and mimic joints whose drivers are not in the file may
    change the dynamics: a warning names them.

    Args:
        source: path of the file, a file:// or package:// address, an open file, or the XML text itself.
        base: "fixed", or "floating": the link that no joint carries moves freely.
        lock: positions [rad or m] of joints to fix, by name or pattern ("finger*"), or names alone: at zero. Joints
            that mimic a locked one are locked too. A joint that mimics another one cannot be locked alone, unless
            `mimic` is "independent".
        tip: name of the frame of the end effector; None: the leaf of the tree, if there is only one.
        gravity: acceleration in the base frame [m/s^2]; None: none.
        on_unphysical: treatment of a body that cannot exist. A negative mass and an inertia that is not positive
            definite give wrong numbers: "error" raises, "warn" warns. An inertia that only breaks the triangle
            inequality gives the numbers of the file, as from every other reader: both warn. "ignore" only notes either.
            "repair" takes the nearest inertia that a body has: that of the second moments without negative principal
            values. Learning and identification need inertias that bodies have. `Robot.check` refuses all others. A body
            far too large for the robot, as of numbers in mm, can exist, and words that seem misspelt can be meant:
            "ignore" notes either, the others warn.
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
    with _named(source):
        description = urdf.read(source, joints, lock, base, mimic, on_unphysical == "repair")
        return _robot(cls, description, tip, gravity, on_unphysical)


def from_mjcf(
    cls: type[Robot],
    source: str | PathLike[str] | bytes | IO[Any],
    base: mjcf.MjcfBase = "file",
    lock: Mapping[str, float] | Sequence[str] | str | None = None,
    tip: str | None = None,
    gravity: Sequence[float] | Literal["file"] | None = "file",
    on_unphysical: OnUnphysical = "error",
    joints: Sequence[str] | str | None = None,
) -> Robot:
    """Robot from an MJCF file, through MuJoCo's own compiler; needs the package `mujoco`.

    Positions are MuJoCo's `qpos`, which is `ref` at home. Bodies without joints are merged with their parents and stay
    as frames, as sites do. Rotor inertia (`armature`) is part of the mass matrix; linear equality constraints between
    joints are part of the robot. Damping, friction loss and limits are read but are not part of the rigid-body
    dynamics; actuators, tendons, contacts, springs and other equality constraints are noted. `report()` lists them.
    Armature of a free joint, and `gravcomp` of some bodies only or in part, are not used: a warning says so.
    Meshes are opened only where a body's mass comes from them.

    Args:
        source: path of the file, a file:// or package:// address, an open file, or the XML text itself, whose includes
            are searched in the current folder.
        base: "file": floating if the file has a body with a free joint, otherwise fixed; "fixed": such a body is held
            where the file puts it; "floating": there must be one.
        lock: positions [rad or m] of joints to fix, by name or pattern ("finger*"), or names alone: at home. Joints
            that are coupled to a locked one are locked too. Ball and free joints are locked by names alone.
        tip: name of the body or site of the end effector; None: the leaf of the tree, if there is only one.
        gravity: acceleration in the frame of the world [m/s^2]; "file": that of the file; None: none.
        on_unphysical: treatment of a body that cannot exist, as in `from_urdf`.
        joints: names or patterns of the joints to keep, at least one; the others are locked, at home or as in `lock`.

    Raises:
        MissingLibraryError: mujoco is not installed.
        DescriptionError: MuJoCo cannot compile the file; it has ball joints, or several free bodies.
        UnphysicalError: a joint moves no inertia.
        UnknownNameError: a name in `lock`, `joints` or `tip` is not in the file.
    """
    with _named(source):
        found = mjcf.read(source, base, joints, lock, gravity)
        return _robot(cls, found.description, tip, found.gravity, on_unphysical)


def from_xacro(
    cls: type[Robot],
    path: str | PathLike[str],
    arguments: Mapping[str, Any] | None = None,
    packages: Mapping[str, str | PathLike[str]] | None = None,
    **options: Any,
) -> Robot:
    """Robot from a xacro file; needs the package `xacrodoc`, but no ROS.

    A xacro file is a program: expand only files that you trust.

    Args:
        path: path of the file, or a file:// or package:// address.
        arguments: values of the file's `<xacro:arg>` by name, as in {"hand": True, "prefix": "left_"}; others have the
            file's defaults.
        packages: folders of the packages that `$(find name)` names, by name. Others are searched around the file, and
            where ROS lists them.
        options: arguments of `from_urdf`.

    Raises:
        MissingLibraryError: xacrodoc is not installed.
        DescriptionError: the file cannot be expanded, or it expands to no usable URDF.
        UnknownNameError: the file has no such argument, or as `from_urdf`.
    """
    with _named(path):
        return from_urdf(cls, xacro_file.expanded(path, arguments, packages), **options)


def from_name(cls: type[Robot], name: str, **options: Any) -> Robot:
    """Robot from a description that the package `robot_descriptions` has a name for, as in "panda_description".

    Its repository is cloned on first use. Names that end in "_mj_description" are MJCF files, the others URDF or xacro.

    Args:
        name: name of the description; https://github.com/robot-descriptions/robot_descriptions.py lists them.
        options: arguments of `from_urdf`, `from_xacro` or `from_mjcf`, whichever reads the file.

    Raises:
        MissingLibraryError: robot_descriptions is not installed, or what reads the file.
        UnknownNameError: there is no description of that name.
        DescriptionError: the description cannot be fetched, or as the function that reads the file.
    """
    file = named.file_of(name)
    if file.format == "mjcf":
        return from_mjcf(cls, file.path, **options)
    if file.format == "urdf":
        return from_urdf(cls, file.path, **options)
    arguments, packages = options.pop("arguments", None), file.packages | dict(options.pop("packages", None) or {})
    return from_urdf(cls, xacro_file.expanded(file.path, arguments, packages, file.arguments), **options)


def from_screws(
    cls: type[Robot],
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
        link_poses: delta_i^0, pose of each link frame in the base frame at home, unit dual quaternions, shape [n, 8];
            None: all link frames coincide with the base frame at home.
        tip_pose: delta_{n+1}^0, pose of the end effector in the base frame at home, a unit dual quaternion [8], on the
            last link; None: the frame of that link.
        parents: index of the parent of each link, -1 for the base, shape [n]; None: a serial chain.
        home: joint positions at home [rad or m], shape [n]; None: zero.
        joint_names, link_names, name: names; None: joint1, link1, ...
        gravity, on_unphysical: as in `from_urdf`.
    """
    bodies = dict(mass=mass, com=com, inertia=inertia, home=home, link_names=link_names, name=name)
    bodies["repair"] = on_unphysical == "repair"
    description = screws.read(joint_screws, link_poses, tip_pose, parents, joint_names, **bodies)
    return _robot(cls, description, None, gravity, on_unphysical)


def from_dh(
    cls: type[Robot],
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
        tip_pose: pose of the end effector in the last DH frame, a unit dual quaternion [8]; None: that frame.
        joint_names, link_names, name, gravity, on_unphysical: as in `from_screws`.
    """
    bodies = dict(mass=mass, com=com, inertia=inertia, link_names=link_names, name=name)
    bodies["repair"] = on_unphysical == "repair"
    description = dh.read(a, alpha, d, theta, convention, kinds, tip_pose, joint_names, **bodies)
    return _robot(cls, description, None, gravity, on_unphysical)


@contextmanager
def _named(source: Any) -> Iterator[None]:
    """Context in which errors of a description name its file, if it is from one."""
    try:
        yield
    except DescriptionError as error:
        name = file_name(source)
        if not 0 < len(name) <= LONGEST_NAME or Path(name).name in str(error):
            raise
        raise type(error)(f"{name}: {error}", *error.findings) from error


def _robot(
    cls: type[Robot],
    description: RobotDescription,
    tip: str | None,
    gravity: Sequence[float] | None,
    on_unphysical: OnUnphysical,
) -> Robot:
    """Robot of a description, whose faults are raised or warned of, and its suspicions warned of."""
    g = None if gravity is None else finite("gravity", gravity)
    robot = cls(**vars(description), gravity=g)
    if tip is not None:
        robot = with_tip(robot, tip)
    faults = [x for x in description.notes if x.severity == "error" or x.code == consistency.TRIANGLE]
    consistency.complain(robot.name, faults, on_unphysical)
    warned = [x for x in description.notes if x.severity == "warning" and x not in faults]
    suspicions = [*(x for x in warned if x.code.startswith("units.")), *units.diagnostics(robot)]
    if on_unphysical != "ignore":
        units.warn(f"robot {robot.name!r}", suspicions, stacklevel=3)
        if ignored := "\n  ".join(str(x) for x in warned if x not in suspicions):
            what = f"robot {robot.name!r}: the file contains elements that are ignored but may affect the dynamics"
            warnings.warn(f"{what}:\n  {ignored}", stacklevel=3)
    # torques and poses need no inertia; accelerations raise
    notes = (*faults, *inert_joints(robot), *suspicions, *robot.notes)
    return dataclasses.replace(robot, notes=tuple(dict.fromkeys(notes)))
