"""Other packages on a GPU, for `benchmarks/gpu.py`: calls where they are installed, and words where they are not."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable

import torch

PACKAGES = {"MuJoCo Warp": "mujoco_warp", "bard": "bard", "adam": "adam", "GRiD": "grid_rbd"}
TIMED = ("MuJoCo Warp",)


def present(name: str) -> str:
    """Words for a package of the table: whether it is timed, and why not."""
    if importlib.util.find_spec(PACKAGES[name]) is None:
        return f"{name}: not installed"
    return f"{name}: timed" if name in TIMED else f"{name}: installed, not timed here"


def arm() -> str:
    """Arm of seven hinges in MuJoCo's format, without shapes and limits."""
    inertial = '<inertial pos="0 0 0.1" mass="2" diaginertia="0.02 0.02 0.01"/>'
    text = ""
    for axis in ("0 0 1", "0 1 0") * 3 + ("0 0 1",):
        text = f'<body pos="0 0 0.2"><joint axis="{axis}"/>{inertial}{text}</body>'
    return f'<mujoco><option integrator="Euler"/><worldbody>{text}</worldbody></mujoco>'


def mujoco_warp(batch: int, device: torch.device) -> dict[str, Callable[[], object]]:
    """Inverse and forward dynamics of MuJoCo Warp in float32, each a CUDA graph, as its authors time it."""
    import mujoco
    import mujoco_warp as mjw
    import warp as wp

    model = mujoco.MjModel.from_xml_string(arm())
    with wp.ScopedDevice(str(device)):
        m, d = mjw.put_model(model), mjw.put_data(model, mujoco.MjData(model), nworld=batch)
        for x in (d.qpos, d.qvel, d.qacc, d.qfrc_applied):
            wp.to_torch(x).uniform_(-1.0, 1.0)

        def graph(function: Callable) -> Callable[[], object]:
            function(m, d)  # compiles
            with wp.ScopedCapture() as capture:
                function(m, d)
            return lambda: wp.capture_launch(capture.graph)

        return {"inverse dynamics": graph(mjw.inverse), "forward dynamics": graph(mjw.forward)}


def calls(batch: int, device: torch.device) -> dict[str, dict[str, Callable[[], object]]]:
    """Calls in float32 of the packages that are installed, by package and task; prints why one has none."""
    if importlib.util.find_spec(PACKAGES["MuJoCo Warp"]) is None:
        return {}
    try:
        return {"MuJoCo Warp": mujoco_warp(batch, device)}
    except Exception as error:  # a package in development: its faults are its own
        print(f"MuJoCo Warp cannot be timed at a batch of {batch}: {error!r}")
        return {}
