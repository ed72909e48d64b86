"""Command `export`: a function of a robot as files that need no Python, or as a graph of torch."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from torchdq.base.checks import names_of
from torchdq.base.progress import Progress
from torchdq.command.command import Dtype, RobotCommand
from torchdq.command.outcome import Grid, Outcome
from torchdq.control import LAWS
from torchdq.export.c99 import Library
from torchdq.functions.catalogue import FLOATING, RECIPES
from torchdq.functions.compile import ExportLanguage, compile

FUNCTIONS = tuple(name for name in RECIPES if not name.startswith(FLOATING) and name != "error_growth")


@dataclass(kw_only=True)
class ExportCommand(RobotCommand):
    """A function as C with its header and a test, for CasADi, or as a graph of torch operations.

    Functions: inverse_dynamics, forward_dynamics, mass_matrix, closed_form, regressor, forward_kinematics, jacobian,
    kinetic_energy, potential_energy, dynamics_jacobian, inverse_dynamics_jacobian, dynamics_hessian,
    forward_dynamics_hessian, mass_matrix_derivative, computed_torque, frame_motion, operational_space,
    operational_space_control, cartesian_impedance, manipulability, coriolis_matrix, distances,
    differential_inverse_kinematics, inverse_kinematics_step, inverse_kinematics_newton.

    Example: torchdq export arm.urdf inverse_dynamics --out controller --name arm_torques
    """

    function: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="FUNCTION")]
    """Function, see above."""
    language: ExportLanguage = "c"
    """c: .c and .h; casadi: .c for casadi.external; torch: .pt2 for torch.export.load."""
    options: tuple[str, ...] = ()
    """Frames of forward_kinematics; frame and body or world of jacobian; of a law also its axes, such as 'x y rz'."""
    name: str = ""
    """Name of the function; by default its own and the robot's."""
    dtype: Dtype = "float64"
    """Dtype."""
    sines: Annotated[Library, tyro.conf.arg(name="library")] = "math.h"
    """Sine, cosine and roots of C: math.h, or own."""
    batch: bool = False
    """A function for many samples, too (c)."""
    knots: int = 0
    """Columns of a call; 0: one (casadi)."""
    out: Path = Path(".")
    """Folder of the files."""

    def outcome(self) -> Outcome:
        """Names of the files."""
        names_of("function", self.function, (*FUNCTIONS, *LAWS), "function")
        robot = self.load().robot
        free = FLOATING + self.function
        with Progress(f"exporting {self.function}"):
            chosen = free if robot.floating and free in RECIPES else self.function
            program = compile(robot, chosen, self.dtype, options=self.options)
            function, *rest = program.export(
                *(self.out, self.name, self.sines, self.language), batch=self.batch, knots=self.knots
            )
        files = [path for path in rest if path is not None]
        text = (
            f"{function} of {robot.name}, {self.language}, {self.dtype}",
            Grid((), [("wrote", str(x)) for x in files]),
        )
        data = {"robot": robot.name, "function": function, "language": self.language, "files": files}
        return Outcome(text, data)
