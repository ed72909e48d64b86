"""Checkpoints that are whole or not there, whenever the writing process is killed.

A file holds the output of `torch.save` and a hash of it: a file that was cut short or changed since is not used.
"""

import hashlib
import io
import os
import pickle
import re
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from torchdq.errors import TorchdqError

KIND, VERSION = b"checkpoint of torchdq.learning.fit", 1
HASH = 32  # length of SHA-256 [bytes]


class CheckpointError(TorchdqError, RuntimeError):
    """Checkpoint that is damaged, or of another model, other data or other settings."""


def write(path: Path, state: dict[str, Any]) -> None:
    """Write a state to a file, which holds the old state or the new one at any moment, never a part.

    The state is written to a temporary file in the same folder, flushed to disk, and renamed in one step. Temporary
    files of killed writes are removed. If writing fails, for example on a full disk, the old checkpoint stays.

    Args:
        path: the checkpoint.
        state: numbers, strings, tensors, and lists and dicts of these.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    for leftover in path.parent.iterdir():
        if re.fullmatch(rf"\.{re.escape(path.name)}\.\d+\.tmp", leftover.name):
            leftover.unlink(missing_ok=True)
    content = io.BytesIO()
    torch.save({"version": VERSION, **state}, content)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with temporary.open("wb") as file:
            file.write(content.getvalue() + _digest(content.getvalue()))
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
    folder = os.open(path.parent, os.O_RDONLY)  # the new name must reach the disk too
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


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
        raise CheckpointError(
            f"{path} is damaged, or not a checkpoint of fit; remove it to start anew, or name another file"
        )
    try:
        state = torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as fault:
        raise CheckpointError(f"{path} holds more than tensors and plain values; do not use it") from fault
    if state["version"] != VERSION:
        raise CheckpointError(
            f"checkpoint {path} has format {state['version']}, this version of torchdq reads format {VERSION}; "
            "finish the run with the version that began it, or remove the file to start anew"
        )
    return state


def _digest(content: bytes) -> bytes:
    return hashlib.sha256(KIND + content).digest()


def require_same_run(path: Path, found: dict[str, Any], expected: dict[str, Any]) -> None:
    """Refuse a checkpoint of another run, naming what differs.

    Args:
        path: the checkpoint, for the message.
        found, expected: identity of the run in the checkpoint and of this call: names and plain values.
    Raises:
        CheckpointError: they differ.
    """
    for name in (*expected, *(name for name in found if name not in expected)):
        there, here = found.get(name, "absent"), expected.get(name, "absent")
        if there != here:
            raise CheckpointError(
                f"checkpoint {path} is of another run: {name} is {there} there and {here} here; "
                "call fit as that run did, or name another file"
            )


def described(model: nn.Module) -> dict[str, Any]:
    """Identity of a model but for its weights: its repr, names and shapes of its tensors, as plain values."""
    text = re.sub(r"0x[0-9a-fA-F]+", "0x", " ".join(repr(model).split()))  # addresses differ between processes
    identity = {}
    for name, value in model.state_dict().items():
        shaped = isinstance(value, Tensor)
        found = f"{str(value.dtype).removeprefix('torch.')} {list(value.shape)}" if shaped else repr(value)
        identity[f"tensor {name!r} of the model"] = found
    return {**identity, "the model": text}
