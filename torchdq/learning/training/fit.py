"""Fitting a model of joint torques to samples: a training loop that a killed process can resume.

    history = fit(model, train, valid, epochs=200, patience=10, checkpoint="run.pt", progress=True)

A run that is killed at any moment and called again with the same arguments continues from its last checkpoint; on a CPU
the weights come out the same to the last bit. Started by `torchrun`, the same call shares every batch among the
processes.
"""

import inspect
import math
import os
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import nn
from torch.nn.utils import parametrize

from torchdq.base.checks import require_choice, require_count, require_number
from torchdq.base.findings import Finding
from torchdq.errors import ArgumentError
from torchdq.layers.residual import ResidualDynamics
from torchdq.learning.evaluation.diagnostics import diagnose
from torchdq.learning.logs.errors import LogWarning
from torchdq.learning.logs.samples import Samples, of_motions, validated
from torchdq.learning.training import checkpoint as checkpoints
from torchdq.learning.training import cross_validation as left_out
from torchdq.learning.training.distributed import team
from torchdq.learning.training.progress import Progress
from torchdq.learning.training.run import History, Run
from torchdq.nn import DQRNEA, ComputedTorque, ForwardDynamics
from torchdq.robot import Robot
from torchdq.robot.robot import batches


def fit(
    model: nn.Module,
    train: Samples | Sequence[Samples],
    valid: Samples | None = None,
    *,
    steps: int | None = None,
    epochs: int | None = None,
    batch: int = 256,
    rate: float = 1e-3,
    decay: float = 0.0,
    prior: float = 0.0,
    seed: int = 0,
    patience: int | None = None,
    every: int | None = None,
    checkpoint: str | Path | None = None,
    tensorboard: str | Path | None = None,
    progress: bool | None = None,
) -> History:
    """History of a fit of a model's parameters, which are changed in place.

    The loss is the mean over joints of squared torque error / variance of the joint's torque in `train`, plus
    `prior` * `model.prior()` if the model has a prior. AdamW, its rate falling to zero along half a cosine; every epoch
    goes through all rows in a new order. Under `torchrun` every process calls this with the same arguments: each takes
    its share of every batch, and all end with the weights that one process would find, but for rounding.

    The network of a `ResidualDynamics` is then measured on rows that it was not trained on: `valid`, or blocks of
    `train` that copies of it are trained without, and regions of the states where there are fewer than three motions.
    There are at most nine copies. Where the network may act, with what weight at each joint, and the errors of
    `predict` follow from that. A joint gets no weight unless its squared error falls by more than one standard error,
    on rows that say as much as two independent ones for each block. `History.residual` tells, a `LogWarning` names
    joints where it helps little and those with too few rows.

    Args:
        model: called as model(q, qd, qdd), returns tau [N, n] [N m]; lies on the device to compute on, which under
            `torchrun` is another one for every process.
        train: samples to fit, [N, n], or one for each motion. Their order means something for a `ResidualDynamics`
            alone: that of time, of which contiguous blocks are left out, or whole motions if there are three.
        valid: samples to choose by: the model is left with the weights of the least error on them.
        steps, epochs: length of the run, one of the two.
        batch: rows per step, over all processes.
        rate: first learning rate.
        decay: weight decay of AdamW; it pulls parameters to zero, which suits networks, not masses.
        prior: weight of `model.prior()`.
        seed: seed of the order of the rows, and of torch's generators while the model runs.
        patience: evaluations without a better `valid` after which to stop; None: never.
        every: steps from one evaluation on `valid` and one checkpoint to the next; None: an epoch.
        checkpoint: file to save the run in, and to resume it from if it is there.
        tensorboard: folder to log the losses and the rate to, for TensorBoard.
        progress: show a progress bar; None: lines on stderr once the run takes more than two seconds; False: nothing.
    Raises:
        ArgumentError: an argument has the wrong shape or value, or the model has nothing to learn.
        TrainingError: the loss or a gradient is not finite; the checkpoint is left as it was.
        CheckpointError: the checkpoint is damaged, or of another model, other data or other settings.

    >>> import torchdq
    >>> from torchdq.nn import DQRNEA
    >>> robot = torchdq.robots.load("two_link")
    >>> q, qd, qdd = torch.randn(3, 64, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    >>> train = Samples(q, qd, qdd, torchdq.inverse_dynamics(robot, q, qd, qdd))
    >>> model = DQRNEA(robot.replace(mass=1.2 * robot.mass), learn=("mass",))
    >>> history = fit(model, train, steps=100, batch=32, rate=0.02)
    >>> bool((model.robot.mass / robot.mass - 1).abs().max() < 0.01)
    True
    """
    if not isinstance(model, nn.Module):
        cure = '; torchdq.DQRNEA(robot, learn=("mass",)) is one' if isinstance(model, Robot) else ""
        raise ArgumentError(f"model must be a torch module of torques, found {type(model).__name__}{cure}")
    train, lengths = of_motions("train", train)
    valid = None if valid is None else validated("valid", valid)
    parameters = {name: p for name, p in model.named_parameters() if p.requires_grad}
    if not parameters:
        raise ArgumentError("model has no parameters to fit; name tensors of the robot in its learn=(...)")
    _require_torques(model)
    if valid is not None and valid.q.shape[1] != train.q.shape[1]:
        raise ArgumentError(f"valid must have the {train.q.shape[1]} joints of train, found {valid.q.shape[1]}")
    if valid is None and patience is not None:
        raise ArgumentError("patience needs samples in valid to wait for; found none")
    require_count("batch", batch)
    require_count("seed", seed, least=0)
    for name, count in {"steps": steps, "epochs": epochs, "patience": patience, "every": every}.items():
        if count is not None:
            require_count(name, count)
    require_number("rate", rate, positive=True)
    for name, weight in {"decay": decay, "prior": prior}.items():
        require_number(name, weight, least=0)
    rate, decay, prior = float(rate), float(decay), float(prior)  # checkpoints hold no numbers of numpy
    require_choice("progress", progress, (None, True, False))
    if (steps is None) == (epochs is None):
        raise ArgumentError(f"one of steps and epochs must be given, found steps={steps} and epochs={epochs}")
    per_epoch = -(-len(train.q) // batch)
    last, every = steps or (epochs or 0) * per_epoch, every or per_epoch

    device = next(iter(parameters.values())).device
    train, valid = train.to(device), None if valid is None else valid.to(device)
    path = _checkpoint(checkpoint)
    identity: dict[str, Any] = {}
    if path is not None:
        identity = checkpoints.described(model)
        identity |= {"train": train.fingerprint(), "valid": valid and valid.fingerprint(), "steps": last}
        identity |= {"batch": batch, "rate": rate, "decay": decay, "prior": prior, "seed": seed}
        identity |= {"patience": patience, "every": every}

    residual = model if isinstance(model, ResidualDynamics) else None
    if residual is not None:
        residual.open()
    was_training = model.training
    try:
        with team(device) as ours, _own_randomness(device, seed), torch.enable_grad():
            run = Run(model, parameters, train, ours, path, batch, prior, decay, seed)
            if ours.leads and (findings := _diagnosed(model, train)):
                warnings.warn(LogWarning(*findings), stacklevel=2)
            run.resume(identity, last)
            if residual is not None and not any(p.requires_grad for p in residual.model.parameters()):
                run.known = left_out.beside_fixed_physics(residual, train)
            bar = progress if ours.leads else False
            with Progress(last, run.step, tensorboard if ours.leads else None, bar) as shown, _stoppable(run, last):
                while run.step < last and not run.history.stopped_early:
                    rate_now = rate / 2 * (1 + math.cos(math.pi * run.step / last))
                    run.advance(rate_now)
                    if run.step % every == 0 or run.step == last:
                        run.evaluate(valid, patience)
                        if path is not None and ours.leads:
                            checkpoints.write(path, {"identity": checkpoints.still(identity, model), **run.state()})
                        shown.evaluation(run.history, rate_now)
                    shown.step(run.step)
            if run.best is not None:
                model.load_state_dict(run.best)
            if residual is not None:
                how = left_out.Training(run.step, batch, rate, decay, seed)
                worth = left_out.measure(residual, train, lengths, valid, how) if ours.leads else None
                state = residual.state_dict() if ours.size > 1 else None
                run.history.residual, state = ours.broadcast((worth, state))
                if state is not None:
                    residual.load_state_dict(state)
    finally:
        model.train(was_training)
    if run.history.residual is not None and ours.leads:
        left_out.tell(run.history.residual)
    return run.history


def _require_torques(model: nn.Module) -> None:
    """Raise unless a model takes motions and may return torques."""
    kind = parametrize.type_before_parametrizations(model).__name__
    if isinstance(model, ForwardDynamics | ComputedTorque):
        raise ArgumentError(
            f"model must return the torques of motions (q, qd, qdd), found a {kind}; fit a DQRNEA or a "
            f"ResidualDynamics, and make the {kind} of its `robot`"
        )
    try:
        taken = inspect.signature(model.forward)
    except (TypeError, ValueError):  # a script has none
        return
    try:
        taken.bind("q", "qd", "qdd")
    except TypeError as error:
        raise ArgumentError(
            f"model must be called as model(q, qd, qdd), found {kind}, whose forward takes {taken}; "
            "torchdq.ResidualDynamics(robot, ...) holds a network for torques"
        ) from error


@torch.no_grad()
def _diagnosed(model: nn.Module, train: Samples) -> list[Finding]:
    """Findings about samples that a robot in the model does not explain; none without a robot."""
    rigid = next((part for part in model.modules() if isinstance(part, DQRNEA)), None)
    if rigid is None or any(batches(rigid.robot).values()) or rigid.robot.n != train.q.shape[1]:
        return []
    model.eval()
    return diagnose(rigid.robot, rigid, train, rigid.friction_width)


def _checkpoint(path: Any) -> Path | None:
    """Path of the checkpoint; raises unless it is one, and no folder's."""
    if path is not None and not isinstance(path, str | os.PathLike):
        raise ArgumentError(f"checkpoint must be a path, found {type(path).__name__}")
    if path is not None and Path(path).is_dir():
        raise ArgumentError(f"checkpoint must be a file, found the folder {path}; name a file in it")
    return None if path is None else Path(path)


@contextmanager
def _stoppable(run: Run, last: int) -> Iterator[None]:
    """Context in which Ctrl-C says what is left of a run."""
    try:
        yield
    except KeyboardInterrupt as stop:
        kept = "; with checkpoint=..., the same call would go on"
        if run.path is not None:
            found = "goes on from its last evaluation" if run.path.exists() else "begins anew: none was written yet"
            kept = f"; with the checkpoint {run.path}, the same call {found}"
        stop.add_note(f"fit stopped at step {run.step} of {last}: the model has the weights of that step{kept}")
        raise


@contextmanager
def _own_randomness(device: torch.device, seed: int) -> Iterator[None]:
    """Torch's own generators, which dropout uses, seeded; the caller's states come back afterwards."""
    with torch.random.fork_rng([device] if device.type == "cuda" else []):
        torch.manual_seed(seed)
        yield
