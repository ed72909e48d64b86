"""Checkpoints that are whole or not there, whenever the writing process is killed.

A file holds the output of `torch.save` and a hash of it: a file that was cut short or changed since is not used. The
hash has no secret, so that it tells damage, not trust: what is read is checked, entry by entry, before it is used.
"""

import hashlib
import io
import itertools
import math
import pickle
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from torchdq.base.files import write_atomically
from torchdq.errors import TorchdqError
from torchdq.learning.training.attributes import attributes

KIND, VERSION = b"checkpoint of torchdq.learning.fit", 2
HASH = 32  # length of SHA-256 [bytes]
CURE = "remove it to start anew, or name another file"
CHANGES = "changed by the run"  # in place of a value that tells nothing about the model at its start


class CheckpointError(TorchdqError, RuntimeError):
    """Checkpoint that is damaged, or of another model, other data or other settings."""


def write(path: Path, state: dict[str, Any]) -> None:
    """Write a state to a file, which holds the old state or the new one at any moment, never a part.

    Parts that killed writes left are removed. If writing fails, for example on a full disk, the old checkpoint stays.

    Args:
        path: the checkpoint.
        state: numbers, strings, tensors, and lists and dicts of these.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    content = io.BytesIO()
    torch.save({"version": VERSION, **state}, content)
    write_atomically({path: content.getvalue() + _digest(content.getvalue())})


def read(path: Path) -> dict[str, Any]:
    """State in a checkpoint, its tensors on the CPU.

    Only tensors and plain values are unpickled, so that a file from elsewhere cannot run anything.

    Raises:
        CheckpointError: the file is damaged, or not a checkpoint of `fit`.
        OSError: it cannot be opened.
    """
    content = path.read_bytes()
    content, digest = content[:-HASH], content[-HASH:]
    if digest != _digest(content):
        raise CheckpointError(f"{path} is damaged, or not a checkpoint of fit; {CURE}")
    try:
        state = torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as fault:
        raise CheckpointError(f"{path} holds more than tensors and plain values; do not use it") from fault
    except Exception as fault:  # torch raises errors of many kinds on bytes that it has not written
        raise CheckpointError(f"{path} is not a checkpoint of fit; {CURE}") from fault
    if not isinstance(state, dict) or not _is_count(state.get("version")):
        raise CheckpointError(f"{path} is not a checkpoint of fit; {CURE}")
    if state["version"] != VERSION:
        raise CheckpointError(
            f"checkpoint {path} has format {state['version']}, this version of torchdq reads format {VERSION}; "
            "finish the run with the version that began it, or remove the file to start anew"
        )
    return state


def _digest(content: bytes) -> bytes:
    return hashlib.sha256(KIND + content).digest()


def require_same_run(path: Path, state: dict[str, Any], expected: dict[str, Any]) -> None:
    """Refuse a checkpoint of another run, naming what differs.

    Args:
        path: the checkpoint, for the message.
        state: the checkpoint's.
        expected: identity of this call: names and plain values.
    Raises:
        CheckpointError: they differ, or the checkpoint has no identity.
    """
    found = state.get("identity")
    if not isinstance(found, dict) or not all(isinstance(x, str | int | float | None) for x in found.values()):
        raise CheckpointError(f"checkpoint {path}: identity must be names and plain values; {CURE}")
    for name in (*expected, *(name for name in found if name not in expected)):
        there, here = found.get(name, "absent"), expected.get(name, "absent")
        if there not in (here, CHANGES):
            raise CheckpointError(
                f"checkpoint {path} is of another run: {name} is {there} there and {here} here; "
                "call fit as that run did, or name another file"
            )


def described(model: nn.Module) -> dict[str, Any]:
    """Identity of a model but for its weights: names and shapes of its tensors, its attributes and its repr."""
    text = re.sub(r"0x[0-9a-fA-F]+", "0x", " ".join(repr(model).split()))  # addresses differ between processes
    identity = {}
    for name, value in model.state_dict().items():
        shaped = isinstance(value, Tensor)
        found = f"{str(value.dtype).removeprefix('torch.')} {list(value.shape)}" if shaped else repr(value)
        identity[f"tensor {name!r} of the model"] = found
    own = {f"attribute {name!r} of the model": found for name, found in attributes(model).items()}
    return {**identity, "the model": text, **own}


def still(identity: dict[str, Any], model: nn.Module) -> dict[str, Any]:
    """Identity of a run, without the values of attributes that the run has changed since, such as counters."""
    now = described(model)
    return {name: CHANGES if now.get(name, x) != x else x for name, x in {**dict.fromkeys(now), **identity}.items()}


def same_torques(then: Tensor, now: Tensor, model: Mapping[str, Any]) -> bool:
    """Whether the torques [N, n] of a model, of which `model` is the state dict, differ by rounding at most."""
    if (then.shape, then.dtype) != (now.shape, now.dtype):
        return False
    tensors = [now, *(x for x in model.values() if isinstance(x, Tensor) and x.is_floating_point())]
    share = 1e-6 if all(x.dtype == torch.float64 for x in tensors) else 1e-3
    largest = now.abs().amax(0)  # a joint without load has nothing but rounding
    return bool(((now - then).abs() <= share * largest.clamp(min=1e-3 * float(largest.max()))).all())


# --- entries of a checkpoint -----------------------------------------------------------------------------------------


def require_whole(path: Path, state: dict[str, Any], model: Mapping[str, Any], learned: list[str], last: int) -> None:
    """Refuse a checkpoint with an entry that is missing, of another kind or shape, or not finite.

    Args:
        path: the checkpoint, for the message.
        state: the checkpoint's.
        model: state dict of the model.
        learned: names of the fitted parameters in it, in the order of the optimiser; they must be finite.
        last: steps of the whole run.
    Raises:
        CheckpointError: an entry is not what `fit` writes.
    """
    history = state.get("history")
    seen = isinstance(history, dict) and bool(history.get("valid"))  # the model was tried on the validation data

    def is_momentum(x: Any, like: Tensor) -> bool:
        if not isinstance(x, dict) or not {"step", "exp_avg", "exp_avg_sq"} <= x.keys():
            return False
        shapes = x["step"], torch.empty(()), x["exp_avg"], like, x["exp_avg_sq"], like
        return all(map(_is_finite, shapes[::2], shapes[1::2])) and bool((x["exp_avg_sq"] >= 0).all())

    def is_optimiser(x: Any) -> bool:
        momenta = x.get("state") if isinstance(x, dict) else None
        if not isinstance(momenta, dict) or momenta.keys() != set(range(len(learned))):
            return False
        return all(is_momentum(momenta[i], model[name]) for i, name in enumerate(learned))

    def is_model(x: Any) -> bool:
        if not isinstance(x, dict) or x.keys() != model.keys():
            return False
        tensors = {name: like for name, like in model.items() if isinstance(like, Tensor)}
        alike = (
            isinstance(x[k], Tensor) and (x[k].shape, x[k].dtype) == (y.shape, y.dtype) for k, y in tensors.items()
        )
        return all(alike) and all(_is_finite(x[name], model[name]) for name in learned)

    entries: dict[str, tuple[str, Callable[[Any], bool]]] = {
        "history": ("equally many steps, in order, and finite errors", _is_history),
        "step": (f"a step of the run, up to {last}", lambda x: _is_count(x) and 0 < x <= last),
        "model": ("the tensors of the model, its parameters finite", is_model),
        "probe": ("finite torques", lambda x: isinstance(x, Tensor) and _is_finite(x, x)),
        "optimiser": ("finite momenta of all parameters", is_optimiser),
        "generator": ("the state of a generator", _is_bytes),
        "random": ("states of generators", lambda x: isinstance(x, list) and len(x) > 0 and all(map(_is_bytes, x))),
        "best": ("weights of the model, finite, or None without valid", lambda x: is_model(x) if seen else x is None),
        "best_error": ("an error", lambda x: isinstance(x, float) and x >= 0 and math.isfinite(x) == seen),
        "waited": ("a count", _is_count),
    }
    for name, (expected, sound) in entries.items():
        if name not in state or not sound(state[name]):
            found = "another value" if name in state else "nothing"
            raise CheckpointError(f"checkpoint {path}: {name} must be {expected}, found {found}; {CURE}")


@contextmanager
def loading(path: Path) -> Iterator[None]:
    """Context in which a checkpoint is put to use; what torch does not take is a CheckpointError."""
    try:
        yield
    except (RuntimeError, ValueError, TypeError, LookupError) as fault:
        raise CheckpointError(f"checkpoint {path} cannot be used ({fault}); {CURE}") from fault


def _is_count(x: Any) -> bool:
    return isinstance(x, int) and not isinstance(x, bool) and x >= 0


def _is_bytes(x: Any) -> bool:
    return isinstance(x, Tensor) and x.dtype == torch.uint8 and x.ndim == 1


def _is_finite(x: Any, like: Tensor) -> bool:
    return isinstance(x, Tensor) and x.is_floating_point() and x.shape == like.shape and bool(x.isfinite().all())


def _is_history(x: Any) -> bool:
    """Whether x holds the fields of a `History`, without a number that cannot be."""
    if not isinstance(x, dict) or x.keys() != {"step", "train", "valid", "best_step", "stopped_early"}:
        return False
    step, errors = x["step"], [x["train"], x["valid"]]
    return (
        all(isinstance(column, list) for column in (step, *errors))
        and len(step) > 0
        and all(_is_count(one) for one in (*step, x["best_step"]))
        and all(earlier < later for earlier, later in itertools.pairwise(step))
        and all(isinstance(error, float) and math.isfinite(error) for column in errors for error in column)
        and len(x["train"]) == len(step)
        and len(x["valid"]) in (0, len(step))
        and isinstance(x["stopped_early"], bool)
    )
