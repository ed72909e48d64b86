"""Robots as users see them: names and numbers, and everything that reads, changes, checks and writes robots."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor
from torch.compiler import is_compiling

from torchdq.algebra.inertia import six
from torchdq.base.caches import PROGRAMS, remembered
from torchdq.base.checks import frozen
from torchdq.errors import no_attribute
from torchdq.program.transforms import any_requires_grad
from torchdq.robot import loading
from torchdq.robot import tree as trees
from torchdq.robot.check import faults
from torchdq.robot.check import report as reports
from torchdq.robot.constants import Constants
from torchdq.robot.edit import combined, coupled, reduced, replaced, stacked
from torchdq.robot.mjcf import writer as mjcf_writer
from torchdq.robot.model import RobotModel, require_unchanged
from torchdq.robot.urdf import writer as urdf_writer

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

    if not TYPE_CHECKING:  # type checkers know the names

        def __getattr__(self, name: str) -> Any:
            raise no_attribute("'Robot' object", name, [*dir(Robot), *vars(self)], _ELSEWHERE, "help(torchdq.Robot)")

    from_urdf = classmethod(loading.from_urdf)
    from_xacro = classmethod(loading.from_xacro)
    from_mjcf = classmethod(loading.from_mjcf)
    from_name = classmethod(loading.from_name)
    from_screws = classmethod(loading.from_screws)
    from_dh = classmethod(loading.from_dh)
    to_urdf, to_mjcf = urdf_writer.to_urdf, mjcf_writer.to_mjcf

    replace, with_tip = replaced.replace, replaced.with_tip
    lock, subchain, couple = reduced.lock, reduced.subchain, coupled.couple
    with_payload, with_tool, attach = combined.with_payload, combined.with_tool, combined.attach
    stack = classmethod(stacked.stack)

    report, tree = reports.report, trees.tree

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

        Those of a free base come first.
        """
        bodies = [link.inertia for link in self.tree().links if link.inertia is not None]
        numbers = [x for body in bodies for x in (body.mass, *body.first, *six(body.rotational))]
        return torch.stack(torch.broadcast_tensors(*numbers), -1) if numbers else self.mass


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
