"""Learning from recordings: read logs of real arms, and train models of their torques.

    motion = smooth(read("log.csv"))                    # `logs`: checked, filtered without delay, with accelerations
    # columns of other names: Layout(columns={"time": "stamp", "q": "position_{0}", "tau": ["shoulder", "elbow"]})
    # arrays: read({"time": t, "q": q, "qd": None, "tau": tau}); None: not recorded, smooth differentiates the positions
    train, test = (samples(part) for part in cut(motion, 0.6))
    fit(model, train, epochs=100, checkpoint="run.pt")  # `training`: a plain loop that survives being killed
    fit_rollout(scene, Recording(time, q, {"torque": tau}), "Viscous.coefficient")  # parameters of a scene, by shooting

Nothing here is imported by `import torchdq`; scipy, rich and tensorboard are imported by the functions that need them.
"""

from torchdq.learning.checkpoint import CheckpointError
from torchdq.learning.data import Samples
from torchdq.learning.excitation import Excitation, excite
from torchdq.learning.identification import identify
from torchdq.learning.identified import Identified, Prediction
from torchdq.learning.ladder import Ladder, Rung
from torchdq.learning.layouts import Layout, LogError, MissingLogError
from torchdq.learning.logs import Log, read
from torchdq.learning.motion_limits import Box, HalfSpace, MotionLimits
from torchdq.learning.motions import Motion, cut, directions, hold_out, samples, smooth
from torchdq.learning.payload import IdentifiedPayload, identify_payload
from torchdq.learning.pictures import plot_torques
from torchdq.learning.plausibility import LogWarning
from torchdq.learning.posterior import Sampled, sample
from torchdq.learning.recordings import Recording
from torchdq.learning.rollout_fit import fit_rollout
from torchdq.learning.rollout_result import RolloutFit
from torchdq.learning.run import History, TrainingError
from torchdq.learning.training import fit

__all__ = [
    "Box",
    "CheckpointError",
    "Excitation",
    "HalfSpace",
    "History",
    "Identified",
    "IdentifiedPayload",
    "Ladder",
    "Layout",
    "Log",
    "LogError",
    "LogWarning",
    "MissingLogError",
    "Motion",
    "MotionLimits",
    "Prediction",
    "Recording",
    "RolloutFit",
    "Rung",
    "Sampled",
    "Samples",
    "TrainingError",
    "cut",
    "directions",
    "excite",
    "fit",
    "fit_rollout",
    "hold_out",
    "identify",
    "identify_payload",
    "plot_torques",
    "read",
    "sample",
    "samples",
    "smooth",
]
