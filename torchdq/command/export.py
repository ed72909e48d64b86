"""Command `export`: a function of a robot as files that need no Python, or as a graph of torch."""

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
import tyro

from torchdq.base.checks import names_of
from torchdq.base.files import write_atomically
from torchdq.base.progress import Progress
from torchdq.command.command import Dtype, RobotCommand
from torchdq.command.outcome import Grid, Outcome
from torchdq.control import LAWS
from torchdq.errors import ArgumentError
from torchdq.export.c99 import Library
from torchdq.functions.catalogue import FLOATING, RECIPES
from torchdq.functions.compile import CompiledProgram, compile
from torchdq.nn import ForwardDynamics, InverseDynamics
from torchdq.robot import Robot

FUNCTIONS = tuple(name for name in RECIPES if not name.startswith(FLOATING) and name != "error_growth")
LAYERS = {"inverse_dynamics": InverseDynamics, "forward_dynamics": ForwardDynamics}  # functions that torch.export takes


@dataclass(kw_only=True)
class ExportCommand(RobotCommand):
    """A function as C with its header and a test, for CasADi, or as a graph of torch operations.

    Functions: inverse_dynamics, forward_dynamics, mass_matrix, closed_form, regressor, forward_kinematics, jacobian,
    kinetic_energy, potential_energy, dynamics_jacobian, inverse_dynamics_jacobian,
    computed_torque, frame_motion, operational_space, operational_space_control, cartesian_impedance, manipulability,
    coriolis_matrix, differential_inverse_kinematics, inverse_kinematics_step, inverse_kinematics_newton.

    Example: torchdq export arm.urdf inverse_dynamics --out controller --name arm_torques
    """

    function: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="FUNCTION")]
    """Function, see above."""
    language: Literal["c", "casadi", "torch"] = "c"
    """c: .c and .h; casadi: .c for casadi.external; torch: .pt2 for torch.export.load."""
    options: tuple[str, ...] = ()
    """Frames of forward_kinematics; frame and body or world of jacobian; frame, body or world, and axes of a law."""
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
        with Progress(f"exporting {self.function}"):
            if self.language == "torch":
                files, function = [self._graph(robot)], self.function
            else:
                program = self._program(robot)
                done = program.export(
                    *(self.out, self.name, self.sines, self.language), batch=self.batch, knots=self.knots
                )
                function, *rest = done
                files = [path for path in rest if isinstance(path, Path)]
        text = (
            f"{function} of {robot.name}, {self.language}, {self.dtype}",
            Grid((), [("wrote", str(x)) for x in files]),
        )
        data = {"robot": robot.name, "function": function, "language": self.language, "files": files}
        return Outcome(text, data)

    def _program(self, robot: Robot) -> CompiledProgram:
        """Compiled function, or control law whose gains are arguments, one number for all joints or axes."""
        if self.function not in LAWS:
            return compile(robot, FLOATING * robot.floating + self.function, self.dtype, options=self.options)
        names = ("frame", "expressed", "axes")
        if len(self.options) > len(names):
            raise ArgumentError(f"options of a law must be at most {', '.join(names)}, found {self.options}")
        where: Any = dict(zip(names, self.options, strict=False))
        gain = torch.ones((), dtype=torch.float64)
        return compile(robot, LAWS[self.function](gain, gain, **where), self.dtype)

    def _graph(self, robot: Robot) -> Path:
        """File of a layer's graph, for any number of samples."""
        names_of("function", self.function, LAYERS, "function that has a layer")
        if Path(self.name).name != self.name:
            raise ArgumentError(f"name must be that of a file, without folders, found {self.name!r}; out is the folder")
        if robot.floating:
            raise ArgumentError("base must be 'fixed' for torch, found a robot with a floating base; export it as c")
        dtype = torch.float64 if self.dtype == "float64" else torch.float32
        layer = LAYERS[self.function](robot).to(dtype)
        sample = tuple(torch.zeros(2, robot.n, dtype=dtype) for _ in range(3))
        self.out.mkdir(parents=True, exist_ok=True)
        path = self.out / f"{self.name or f'{self.function}_{robot.name}'}.pt2"
        graph = torch.export.export(layer, sample, dynamic_shapes=({0: torch.export.Dim("batch")},) * 3)
        content = io.BytesIO()
        torch.export.save(graph, content)
        write_atomically({path: content.getvalue()})
        return path
