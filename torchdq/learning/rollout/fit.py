"""Parameters of a scene from recorded motions: positions and commands, no torques and no accelerations.

The scene is simulated through the recordings (`shooting`), and its parameters and the states at which the segments
start are those of the greatest likelihood (`problem`), by Gauss-Newton. A step is accepted if, compared with each of
those accepted before, it closes the defects between the nodes or raises the likelihood (R. Fletcher, S. Leyffer,
"Nonlinear programming without a penalty function", Mathematical Programming 91 (2002)).
"""

import warnings
from collections.abc import Iterable, Iterator, Sequence

import numpy as np
import torch

from torchdq.base.checks import require_count, require_number
from torchdq.base.progress import Progress
from torchdq.effects.actuator import Actuator
from torchdq.errors import ArgumentError
from torchdq.learning.logs.errors import LogWarning
from torchdq.learning.rollout import shooting
from torchdq.learning.rollout.problem import Change, End, Iterate, Problem
from torchdq.learning.rollout.recordings import CheckedRecording, Recording, checked
from torchdq.learning.rollout.result import RolloutFit, result
from torchdq.learning.rollout.shooting import Linear
from torchdq.learning.rollout.unknowns import Unknowns, changed, unknowns
from torchdq.learning.threads import one_thread
from torchdq.robot import Robot
from torchdq.scene.integrators import Integrator, LinearlyImplicit, RungeKutta4
from torchdq.scene.recording import Stage
from torchdq.scene.scene import Scene

CLOSED = 1e-9  # defects between nodes that count as none, relative to the motion
MARGIN = 1e-3  # part of a defect by which an accepted step must be better
SETTLED = 1e-2  # length of a step that ends the search, in standard deviations of all measurements together
STILL = 1e-6  # length of a step that does so too, relative to the parameters: for measurements without noise
GAIN = 0.02  # gain of a step that ends the search, in the logarithm of the likelihood
ACCURATE = 0.1  # shift of the parameters by shorter steps that counts as none, in standard errors
NEARLY = 1e-5  # defects before a last step
FINER = (4, 16, 64, 256)  # substeps that are tried one after the other
APART = (
    "the scene does not move as recorded, so nothing is identifiable and all values are NaN; check signs, units and "
    "order of positions and inputs; take shorter segments, as sharp friction needs, or start from a nearer scene"
)


@one_thread()
def fit_rollout(
    scene: Scene,
    logs: Recording | Sequence[Recording],
    learn: str | Sequence[str],
    segment: float | None = 1.0,
    iterations: int = 100,
    integrator: Integrator | None = None,
) -> RolloutFit:
    """Scene with the parameters under which it moves as recorded.

    A recording is of continuous time, so the scene is simulated by Runge-Kutta steps that are short enough: a quarter
    of their length moves no parameter by a tenth of its standard error. The scene that is returned has this integrator.
    The search starts from the scene as it is, whose parameters are also the scale of what is large: a friction to be
    estimated must be in the scene, and may be ten times too small or too large.

    Args:
        scene: of a robot with a fixed base, without sensors; its `dt` need not be that of the recordings.
        logs: positions and commands of one motion or several; see `Recording`.
        learn: names or patterns: "Viscous.coefficient", "Servo.*", "RotorInertia.inertia", "Payload.mass"; "mass",
            "com" and "inertia" of the links; "delay" [s] of all inputs. A name is that of an effect's or controller's
            class and of its parameter; the second of two effects of a class is "Viscous2". An unknown name raises an
            error with all.
        segment: time after which a motion starts again from an unknown state [s], so that errors of the scene do not
            add up; None: the motion of every recording is one.
        iterations: most of them.
        integrator: None: as above. One that is given is taken as it is, for recordings of another simulator with the
            same steps, or for parameters with which a scene of coarse steps follows a robot.
    Raises:
        ArgumentError: a name cannot be learned, by its kind or because no torque goes through that actuator, or
            recordings do not fit the scene.
        LogError: a recording has a number that is not finite, or time that does not increase.
    Warns:
        LogWarning: it ended before it had found the best parameters, residuals are correlated over more than two rows,
            or no step is short enough.

    >>> import torchdq
    >>> from torchdq import Scene, effects
    >>> two_link = torchdq.robots.load("two_link")
    >>> t = 0.01 * torch.arange(201.0, dtype=torch.float64)
    >>> torque = 5 * torch.stack([(5 * t).sin(), (7 * t).cos()], -1)
    >>> scene = Scene(two_link, (effects.Gravity(), effects.Viscous(0.5)), dt=0.01)
    >>> start = scene.start(torch.zeros(2, dtype=torch.float64))
    >>> q = torch.cat([start.q[None], scene.rollout(start, torque[:-1]).q])
    >>> guess = Scene(two_link, (effects.Gravity(), effects.Viscous(0.1)), dt=0.01)
    >>> log = Recording(t, q, {"torque": torque})
    >>> # by which it was made
    >>> found = fit_rollout(guess, log, "Viscous.coefficient", integrator=scene.integrator)
    >>> [round(x, 6) for x in found.values["Viscous.coefficient"].tolist()]
    [0.5, 0.5]
    """
    if not isinstance(scene, Scene):
        cure = "; torchdq.Scene(robot, effects) makes one" if isinstance(scene, Robot) else ""
        raise ArgumentError(f"scene must be a torchdq.Scene, found {type(scene).__name__}{cure}")
    if segment is not None:
        require_number("segment", segment, positive=True)
    require_count("iterations", iterations)
    variables = unknowns(scene, learn)
    data = checked(logs, scene.n, scene.inputs)
    if variables.delayed and not data[0].inputs:
        raise ArgumentError("delay cannot be learned: the recordings have no inputs that could come late")
    _require_driven(scene, variables, data)
    whole = changed(scene, variables.parameters(variables.start))
    _require_derivatives(whole, data[0].inputs)
    pieces = shooting.segments(data, scene.dt, segment)
    finer = FINER if integrator is None else ()
    whole = whole.replace(integrator=integrator or _rule(scene), **({"substeps": 1} if finer else {}))
    problem = Problem(whole, variables, data, pieces, not (finer or whole.looped))
    named = ", ".join(part.name for part in variables.parts)
    # a trial step may diverge: its numbers are not finite then
    with torch.no_grad(), np.errstate(all="ignore"), Progress(f"fitting {named}") as notice:
        end = _search(problem, finer, iterations, notice)
        followed = end.at.defect <= NEARLY
        warning = (end.reason or end.problem.correlated(end.at)) if followed else f"{end.reason}; {APART}"
        found = result(end, warning, followed)
    if warning:
        warnings.warn(f"the parameters may not be the best: {warning}", LogWarning, stacklevel=2)
    return found


def _require_derivatives(scene: Scene, inputs: Iterable[str]) -> None:
    """Raise unless a step with these inputs is a single differentiable program of joint positions."""
    found = ["a floating base"] if scene.robot.floating else []
    found += [type(e).__name__ for e in scene.effects if e.SLOT == "sensor" or e.computed(scene.n)]
    found += [f"batch axes of {name}" for name, batch in scene.batches.items() if batch]
    if found:
        raise ArgumentError(f"scene must be without {found[0]}, for derivatives of a step")
    Stage(scene.spec, "step").check(dict.fromkeys((*scene.spec.state, *inputs), torch.zeros(1)))


def _require_driven(scene: Scene, variables: Unknowns, data: Sequence[CheckedRecording]) -> None:
    """Raise if a learned actuator never transmits a torque: its memory would follow the noise."""
    commanded = any(bool((log.inputs["torque"].values != 0).any()) for log in data if "torque" in log.inputs)
    if commanded or scene.controller is not None:
        return
    actuators = {str(owner) for owner, _ in scene.spec.of(Actuator)}
    for part in variables.parts:
        if part.key.partition(".")[0] in actuators:
            cause = "the recordings command no torque, and the scene has no controller"
            raise ArgumentError(f"{part.name} cannot be learned: {cause}, so that nothing goes through its actuator")


def _rule(scene: Scene) -> Integrator:
    """Integrator for a scene."""
    return LinearlyImplicit() if any(e.IMPLICIT for e in scene.effects) else RungeKutta4()


def _search(problem: Problem, finer: Sequence[int], iterations: int, notice: Progress) -> End:
    """Best iterate by Gauss-Newton, with the first steps that the next shorter ones confirm."""
    at, count, shift = problem.first(), 0, 0.0
    linear, tried = problem.linearised(at), [at]
    try:
        while True:
            done = f"iteration {count + 1} of at most {iterations}"
            notice.at(f"{done}, residuals {np.linalg.norm(at.spread):.3g}, defects {at.defect:.2g}")
            step = problem.step(at, linear, 0.0)
            relative = abs(step.values / problem.unknowns.each("sizes", at.values)).max()
            # the next step, much smaller than this one, would not matter
            last = bool(at.defect <= NEARLY and (step.length < SETTLED or relative < STILL))
            if count == iterations:
                return End(problem, at, linear, count, "" if last else f"{iterations} iterations were not enough")
            trials, reason = _trials(problem, at, linear, step), ""
            after = next((one for one in trials if all(_better(one, other) for other in tried)), None)
            if after is None:
                last, reason = True, "" if at.defect <= CLOSED else "no step closes the defects between the states"
            else:
                last = last or (after.defect <= NEARLY and 0 <= at.cost - after.cost < GAIN)
                at, count = after, count + 1
            if last:
                shift = problem.shift(at, linear, finer[0]) if finer else 0.0
                if shift <= ACCURATE or len(finer) < 2:
                    long = f"steps a quarter as long still move the parameters, by {shift:.2g} standard errors"
                    return End(problem, at, linear, count, reason or (long if shift > ACCURATE else ""), shift)
                problem, finer = problem.by(finer[0]), finer[1:]
                # unstable steps may have led anywhere
                at = problem.at(at.values, at.motions.nodes) if at.defect <= NEARLY else problem.first()
                tried = [at]
            else:
                tried = [other for other in tried if other.defect < at.defect or other.cost < at.cost] + [at]
            linear = problem.linearised(at)
    except KeyboardInterrupt:
        return End(problem, at, linear, count, f"interrupted after {count} iterations", shift)


def _trials(problem: Problem, at: Iterate, linear: Linear, step: Change) -> Iterator[Iterate]:
    """Iterates after shorter and shorter steps: linearised, then simulated from the starts of the blocks.

    Where friction is stiff, linearised steps do not close the defects, but simulation from the starts does.
    """
    for k in range(16):
        if k:
            step = problem.step(at, linear, 1e-6 * 10.0 ** (k - 1))
        values = problem.unknowns.each("moved", at.values, 0.5**k * step.values)
        after = problem.at(values, at.motions.nodes + 0.5**k * step.nodes)
        yield after
        yield problem.simulated(after)


def _better(one: Iterate, other: Iterate) -> bool:
    """Whether an iterate has smaller defects than another, or less cost."""
    defect = max(other.defect, CLOSED)
    return max(one.defect, CLOSED) <= (1 - MARGIN) * defect or one.cost < other.cost - MARGIN * min(one.defect, 1.0)
