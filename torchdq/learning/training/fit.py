"""Fitting a model of joint torques to samples by gradients.

    history = fit(model, train, valid, steps=2000)

A plain loop in one process. A model of torchdq is a `torch.nn.Module`, which any trainer takes where checkpoints,
several processes or curves are wanted.
"""

import warnings
from collections.abc import Sequence

import torch
from torch import nn
from torch.nn.utils import parametrize

from torchdq.base.checks import require_count, require_number
from torchdq.base.progress import Progress
from torchdq.errors import ArgumentError
from torchdq.layers.residual import ResidualDynamics
from torchdq.learning.evaluation.diagnostics import diagnose
from torchdq.learning.logs.errors import LogWarning
from torchdq.learning.logs.samples import Samples, of_motions, torque_variance, validated
from torchdq.learning.training.loop import History, Training, descend, seeded
from torchdq.learning.training.residual import fit_residual
from torchdq.nn import ComputedTorque, ForwardDynamics, InverseDynamics
from torchdq.robot import Robot
from torchdq.robot.model import batches


def fit(
    model: nn.Module,
    train: Samples | Sequence[Samples],
    valid: Samples | None = None,
    *,
    steps: int,
    batch: int = 256,
    rate: float = 1e-3,
    decay: float = 0.0,
    prior: float = 0.0,
    seed: int = 0,
) -> History:
    """History of a fit of a model's parameters, which are changed in place.

    The loss is the mean over joints of squared torque error / variance of the joint's torque in `train`, plus
    `prior` * `model.prior()` if the model has a prior. AdamW, its rate falling to zero along half a cosine; every epoch
    goes through all rows in a new order. With `valid`, the model has the weights of the least error on it in the end,
    of those after every 100 steps.

    Of a `ResidualDynamics` the network alone is trained, on top of the physics as they are: fit those first, by
    `identify` or by `fit(model.model, ...)`. It is then measured on blocks of `valid`; or on blocks of `train` that
    copies of it are trained without, five at most, and four more without regions of the states where there are fewer
    than three motions. A joint
    keeps the network only if its squared error falls by more than two standard errors on these rows, and if they are as
    informative as two independent ones for each block. `History.residual` holds the gains, and a `LogWarning` names
    joints where it does not help.

    Args:
        model: called as model(q, qd, qdd), returns tau [N, n] [N m]; lies on the device to compute on.
        train: samples to fit, [N, n], or one for each motion. Their order means something for a `ResidualDynamics`
            alone: that of time, of which contiguous blocks are held out, or whole motions if there are three.
        valid: samples of another motion to choose by.
        steps: number of batches to train on.
        batch: rows per step.
        rate: first learning rate.
        decay: weight decay of AdamW; it pulls parameters to zero, which suits networks, not masses.
        prior: weight of `model.prior()`.
        seed: seed of the order of the rows, and of torch's generators while the model runs.
    Raises:
        ArgumentError: an argument has the wrong shape or value, or the model has nothing to learn.
        TrainingError: the loss or a gradient is not finite.

    >>> import torchdq
    >>> from torchdq.nn import InverseDynamics
    >>> robot = torchdq.robots.load("two_link")
    >>> q, qd, qdd = torch.randn(3, 64, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    >>> train = Samples(q, qd, qdd, torchdq.inverse_dynamics(robot, q, qd, qdd))
    >>> model = InverseDynamics(robot.replace(mass=1.2 * robot.mass), learn=("mass",))
    >>> history = fit(model, train, steps=100, batch=32, rate=0.02)
    >>> bool((model.robot.mass / robot.mass - 1).abs().max() < 0.01)
    True
    """
    device = _device_of(model)
    train, lengths = of_motions("train", train)
    valid = None if valid is None else validated("valid", valid)
    if valid is not None and valid.q.shape[1] != train.q.shape[1]:
        raise ArgumentError(f"valid must have the {train.q.shape[1]} joints of train, found {valid.q.shape[1]}")
    for name, count, least in (("steps", steps, 1), ("batch", batch, 1), ("seed", seed, 0)):
        require_count(name, count, least=least)
    require_number("rate", rate, positive=True)
    for name, weight in {"decay": decay, "prior": prior}.items():
        require_number(name, weight, least=0)
    training = Training(steps, batch, float(rate), float(decay), seed)
    train, valid = train.to(device), None if valid is None else valid.to(device)
    was_training = model.training
    try:
        with seeded(device, seed), Progress("fitting") as progress:
            _warn_of(model, train)
            if isinstance(model, ResidualDynamics):
                return fit_residual(model, train, lengths, valid, training, progress)
            weigh = getattr(model, "prior", None) if prior else None
            penalty = None if weigh is None else lambda: prior * weigh()
            return descend(model, model, train, valid, torque_variance(train.tau), training, progress.at, penalty)
    finally:
        model.train(was_training)


def _device_of(model: nn.Module) -> torch.device:
    """Device of the parameters to fit; raises unless the model has some, and may return torques."""
    if not isinstance(model, nn.Module):
        cure = '; torchdq.InverseDynamics(robot, learn=("mass",)) is one' if isinstance(model, Robot) else ""
        raise ArgumentError(f"model must be a torch module of torques, found {type(model).__name__}{cure}")
    kind = parametrize.type_before_parametrizations(model).__name__
    if isinstance(model, ForwardDynamics | ComputedTorque):
        raise ArgumentError(
            f"model must return the torques of motions (q, qd, qdd), found a {kind}; fit an InverseDynamics or a "
            f"ResidualDynamics, and make the {kind} of its `robot`"
        )
    trained = model.network if isinstance(model, ResidualDynamics) else model
    if not (parameters := [p for p in trained.parameters() if p.requires_grad]):
        raise ArgumentError("model has no parameters to fit; name tensors of the robot in its learn=(...)")
    return parameters[0].device


@torch.no_grad()
def _warn_of(model: nn.Module, train: Samples) -> None:
    """Warn of samples that the robot in a model, if there is one, does not explain."""
    rigid = next((part for part in model.modules() if isinstance(part, InverseDynamics)), None)
    if rigid is None or any(batches(rigid.robot).values()) or rigid.robot.n != train.q.shape[1]:
        return
    model.eval()
    if findings := diagnose(rigid.robot, rigid, train, rigid.sign_width):
        warnings.warn(LogWarning(*findings), stacklevel=4)  # no_grad is a level, too
