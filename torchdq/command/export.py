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
from torchdq.errors import ArgumentError
from torchdq.export.c99 import Library
from torchdq.functions.catalogue import FLOATING, RECIPES
from torchdq.functions.compile import CompiledProgram, ExportLanguage, compile
from torchdq.layers.control import Control
from torchdq.layers.layer_program import WRENCHES
from torchdq.robot import Robot

PARTS = ("error_growth", "closure_gaps", "loop_step", "loop_torques")  # of solvers, which are of no use alone
FUNCTIONS = tuple(name for name in RECIPES if not name.startswith(FLOATING) and name not in PARTS)
# names that are looked for, and how their function is had
ELSEWHERE = dict.fromkeys(
    ("gravity", "gravity_torques", "gravity_compensation"), "gravity torques are inverse_dynamics --arguments q"
)


@dataclass(kw_only=True)
class ExportCommand(RobotCommand):
    """A function as C with its header and a test, for CasADi, or as a graph of torch operations.

    Functions: NAMES. The last three are control laws: their gains are arguments, and the friction of the description is
    compensated, as by the layers of torchdq.nn. All others are of the rigid bodies alone.

    Example: torchdq export arm.urdf inverse_dynamics --out controller --name arm_torques
    """

    function: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="FUNCTION")]
    """Function, see above."""
    language: ExportLanguage = "c"
    """c: .c and .h; casadi: .c for casadi.external; torch: .pt2 for torch.export.load."""
    options: tuple[str, ...] = ()
    """Frames of forward_kinematics; frame and body or world of jacobian; of a law also its axes, such as 'x y rz'."""
    arguments: tuple[str, ...] = ()
    """Names of its arguments, such as q alone, or f_tip, too; by default all but wrenches."""
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
        if self.function in ELSEWHERE:
            raise ArgumentError(f"there is no function named {self.function!r}; {ELSEWHERE[self.function]}")
        names_of("function", self.function, (*FUNCTIONS, *LAWS), "function")
        robot = self.load().robot
        with Progress(f"exporting {self.function}"):
            program = (self._law if self.function in LAWS else self._function)(robot)
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

    def _function(self, robot: Robot) -> CompiledProgram:
        """Function of the rigid bodies."""
        free = FLOATING + self.function
        chosen = free if robot.floating and free in RECIPES else self.function
        return compile(robot, chosen, self.dtype, self.arguments or None, self.options)

    def _law(self, robot: Robot) -> CompiledProgram:
        """Control law as its layer has it, friction included, with its gains as arguments."""
        law = LAWS[self.function].of_arguments(self.options).resolved(robot.bake())
        layer = Control(robot.bake(), law, tuple(law.tensors()))
        wrenches = [name for name in self.arguments if name in WRENCHES]
        program = layer.program(*wrenches, parameters="arguments")
        known = [argument.name for argument in program.arguments]
        if self.arguments and set(self.arguments) != set(known):
            raise ArgumentError(f"arguments of {self.function} must be {' '.join(known)}, found {self.arguments!r}")
        return compile(program, dtype=self.dtype)


ExportCommand.__doc__ = (ExportCommand.__doc__ or "").replace("NAMES", ", ".join((*FUNCTIONS, *LAWS)))
