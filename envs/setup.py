"""Setup of environments from their arguments: scene, task, actions, and the start of episodes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchdq.backends.choice import BackendName
from torchdq.base.checks import require_object, tensor_of
from torchdq.effects import Effect
from torchdq.envs.actions import Actions, Kind, Meaning, actuated, resolved
from torchdq.envs.loops import Loops
from torchdq.envs.pushes import Pushes
from torchdq.envs.randomization import Randomise, randomised
from torchdq.envs.reset import Reset, started
from torchdq.envs.task_names import task_of
from torchdq.envs.tasks import ROBOT, Checked, EpisodeTask
from torchdq.envs.torch_task import Functions, TorchTask
from torchdq.errors import ArgumentError, UnknownNameError
from torchdq.functions.posed import GEOMETRY
from torchdq.robot import Robot
from torchdq.robot.fields import SHAPES
from torchdq.robot.shipped import load
from torchdq.scene.defaults import default_effects, mean_robot
from torchdq.scene.integrators import Integrator, LinearlyImplicit
from torchdq.scene.scene import Scene

STARTS = 64  # that are tried to find one at which loops are closed
AnyTask = str | EpisodeTask | TorchTask


@dataclass(frozen=True)
class Simulation:
    """Settings of the simulation of environments.

    Args:
        dt: duration of a step of an environment, over which an action is constant [s]; None: 0.02 s, unless the task
            says otherwise.
        substeps: steps of the integrator within it; None: 2, unless the task says otherwise.
        integrator: method of `torchdq.scene.integrators`; None: `LinearlyImplicit()`, which stays stable with stiff
            friction and limits.
        backend: as in `torchdq.backend`.

    >>> from torchdq.envs import RobotVectorEnv, Simulation
    >>> envs = RobotVectorEnv(64, "reach", "panda", simulation=Simulation(dt=0.01, substeps=1))
    """

    dt: float | None = None
    substeps: int | None = None
    integrator: Integrator | None = None
    backend: BackendName | None = None


class Setup(NamedTuple):
    """Everything that does not change from step to step."""

    nominal: Scene  # without a row for each environment of what is drawn
    reset: Reset  # start of episodes, with the scene and the task
    meaning: Meaning  # of the actions
    scale: Tensor  # [k] size of a full action


def setup(
    task: AnyTask,
    robot: str | Path | Robot | None,
    effects: Sequence[Effect] | None,
    action: Kind | Actions | None,
    simulation: Simulation | None,
    randomise: Randomise | None,
    pushes: Mapping[str, Pushes] | None,
    like: Tensor,
) -> Setup:
    """Setup of these arguments of `RobotVectorEnv`, with the rows, the dtype and the device of a tensor."""
    timing = Simulation() if simulation is None else simulation
    require_object("simulation", timing, Simulation, "torchdq.envs", "Simulation(dt=0.02)")
    own = ROBOT if isinstance(task, TorchTask) else getattr(task_of(task), "ROBOT", ROBOT)
    robot = _robot_of(own if robot is None else robot)
    known = described(task, robot)
    actions = action if isinstance(action, Actions) else Actions(action)
    motors = [robot.joint_names[i] for i in actuated(robot, actions.joints)] if robot.closures else None
    given: dict[str, Any] = {"effects": effects, "dt": timing.dt, "substeps": timing.substeps}
    given |= {"randomise": randomise, "pushes": pushes}
    chosen: dict[str, Any] = dict(known.defaults(mean_robot(robot))) if effects is None else {}
    chosen |= {name: x for name, x in given.items() if x is not None}
    scene = Scene(
        robot,
        chosen["effects"] if "effects" in chosen else default_effects(robot, motors),
        integrator=timing.integrator or LinearlyImplicit(),
        dt=chosen.get("dt", 0.02),
        substeps=chosen.get("substeps", 2),
        backend=timing.backend,
        unroll=chosen.get("unroll"),
        objects=known.objects(mean_robot(robot)),
    )
    scene = scene.replace(robot=_within_limits(scene))
    scene, meaning, scale = resolved(actions, scene, chosen)
    pushed = chosen.get("pushes", {})
    check_scene(scene, len(like), pushed)
    nominal, simulated, drawn = randomised(scene.to(like.device), chosen.get("randomise", {}), len(like), like)
    functions = functions_of(task, scene.robot, simulated, like.device)
    checked, loops, one = Checked(known, meaning.pose), None, mean_robot(scene.robot)
    if one.closures:
        draws = (known.draws(one), 0 if functions is None else functions.task.draws)
        u = torch.rand(STARTS, sum(draws), generator=torch.Generator().manual_seed(0), dtype=torch.float64).to(like)
        u[0] = 0.5
        starts = started(checked, functions, one, (u[:, : draws[0]], u[:, draws[0] :]), scene.backend, True)
        loops = Loops.of(one.bake(), meaning.joints, starts["q"], scene.backend)
    reset = Reset(simulated, checked, drawn, pushed, functions, like.dtype, loops)
    return Setup(nominal, reset, meaning, like.new_tensor(scale))


def described(task: AnyTask, robot: Robot) -> EpisodeTask:
    """Recorded task for a robot."""
    return task_of(task.recorded_for(robot) if isinstance(task, TorchTask) else task).described(robot)


def functions_of(task: AnyTask, robot: Robot, scene: Scene, device: torch.device) -> Functions | None:
    """Functions of tensors of a task; None: it has none."""
    return Functions.of(task, robot, scene, device) if isinstance(task, TorchTask) else None


def check_scene(scene: Scene, num_envs: int, pushes: Mapping[str, Pushes]) -> None:
    """Raise if an effect takes an input that is not supplied, if pushes have no effect, or a tensor has other rows."""
    wanted = {name: type(effect).__name__ for effect in scene.effects for name in effect.inputs(scene.n)}
    for name in wanted.keys() - {"target", *pushes}:
        cure = "give it by pushes, or leave it out" if wanted[name] == "Push" else "leave it out"
        raise ArgumentError(
            f"effects: {wanted[name]} takes the input {name!r}, which an environment does not supply; {cure}"
        )
    for name, one in pushes.items():
        if "Push" not in wanted.values():
            raise ArgumentError("pushes need effects.Push() among the effects, found none")
        if wanted.get(name) != "Push":
            raise UnknownNameError("input to push", name, [known for known, kind in wanted.items() if kind == "Push"])
        require_object(f"pushes[{name!r}]", one, Pushes, "torchdq.envs", "Pushes((20.0, 20.0, 0.0, 0.0, 0.0, 0.0))")
    for name, batch in scene.batches.items():
        if batch not in ((), (1,), (num_envs,)):
            raise ArgumentError(f"{name} must be one for all or have {num_envs} rows, found the batch axes {batch}")


def _robot_of(robot: str | Path | Robot) -> Robot:
    """Robot with one geometry: a shipped one by its name, one of a URDF file, or itself."""
    if isinstance(robot, str) and not robot.lstrip().startswith("<") and Path(robot).suffix == "":
        robot = load(robot)
    found = robot if isinstance(robot, Robot) else Robot.from_urdf(robot)
    one = {name: (getattr(found, name), len(SHAPES[name])) for name in (*GEOMETRY, "home")}
    one["limits"] = (max(found.limits, key=Tensor.dim), 1)
    for name, (x, axes) in one.items():
        if x is not None and x.ndim > axes:
            raise ArgumentError(
                f"{name} of robot {found.name!r} must be one for all environments, found batch axes; give one by "
                f"robot.replace({name}=...), or make environments for each robot"
            )
    return found


def _within_limits(scene: Scene) -> Robot:
    """The scene's robot with the limits that effects simulate, which may be narrower than those described."""
    limits = scene.robot.limits
    for low, high in [bounds for effect in scene.effects if (bounds := effect.free_range()) is not None]:
        lower, upper = (tensor_of(x).detach().to(limits.lower).reshape(-1, scene.n) for x in (low, high))
        limits = limits._replace(
            lower=torch.maximum(lower.amax(0), limits.lower), upper=torch.minimum(upper.amin(0), limits.upper)
        )
    same = all(map(torch.equal, limits, scene.robot.limits))
    return scene.robot if same else scene.robot.replace(limits=limits)
