"""Scenes as users see them: a robot and the effects that are simulated, stepped, rolled out, checked and described.

A scene assumes nothing: a bare one has no gravity, no friction and no limits. Every effect is named, belongs to one
slot, and costs what it adds to the one program that a step is recorded into.
"""

from torchdq.base.checks import frozen
from torchdq.scene import describe as descriptions
from torchdq.scene import linearize as derivatives
from torchdq.scene import rollout as rollouts
from torchdq.scene import stability
from torchdq.scene.model import SceneModel


@frozen
class Scene(SceneModel):
    """A robot, the effects that are simulated, and how time passes.

        state = scene.start(q)
        state = scene.step(state, torque)

    A step is one program: controller, actuators, forces, forward dynamics, integrator and sensors. It is differentiable
    in the state, the inputs, and every parameter that is a tensor.

    Args:
        robot: its gravity and rotor inertia only act if `effects.Gravity()` and `effects.RotorInertia()` are there.
        effects: simulated effects; see `torchdq.effects`. Actuators and sensors act in their order.
        controller: turns the input `reference` into torques; None: the given torques act alone.
        integrator: see `torchdq.scene.integrators`. The default holds damping, friction, springs, servos and limits of
            joints at any step; `check` says which steps an explicit one holds.
        dt: duration of a step [s]; torques are constant over it.
        substeps: steps of the integrator within a step, any number.
        backend: as in `torchdq.backend`.
        precision: "auto": in the dtype of the state; a sample whose mass matrix would cost float32 half of its digits
            takes that step in float64, one whose mass matrix is singular becomes NaN. "double": a float32 state, and
            everything computed in float64.
        unroll: whether the substeps are one program, or a loop over one of a single substep, which compiles faster, but
            is not part of the loop that a rollout is; None: one program of up to 150 000 operations.

    >>> import torch, torchdq
    >>> from torchdq import Scene, effects
    >>> scene = Scene(
    ...     torchdq.robots.load("two_link"), (effects.Gravity(), effects.Viscous(0.1)), dt=0.01
    ... )
    >>> state = scene.start(torch.zeros(3, 2))
    >>> scene.step(state, torque=torch.zeros(2)).q.shape
    torch.Size([3, 2])
    """

    rollout, linearize = rollouts.rollout, derivatives.linearize
    check, describe = stability.check, descriptions.describe
