"""Learning from recordings: read logs of real arms, and train models of their torques.

    motion = smooth(read("log.csv"))                    # `logs`: checked, filtered without delay, with accelerations
    train, test = (samples(part) for part in cut(motion, 0.6))
    fit(model, train, epochs=100, checkpoint="run.pt")  # `training`: a plain loop that survives being killed

Nothing here is imported by `import torchdq`; scipy, rich and tensorboard are imported by the functions that need them.
"""

from torchdq.learning.checkpoint import CheckpointError
from torchdq.learning.identify import Identified, identify
from torchdq.learning.logs import LAYOUTS, Layout, Log, LogError, Motion, cut, hold_out, read, samples, smooth
from torchdq.learning.training import History, Samples, TrainingError, fit

__all__ = [
    "LAYOUTS",
    "CheckpointError",
    "History",
    "Identified",
    "Layout",
    "Log",
    "LogError",
    "Motion",
    "Samples",
    "TrainingError",
    "cut",
    "fit",
    "hold_out",
    "identify",
    "read",
    "samples",
    "smooth",
]
