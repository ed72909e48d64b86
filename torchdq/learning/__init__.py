"""Learning from recordings: read logs of real arms, and train models of their torques.

    motion = smooth(read("log.csv"))                    # `logs`: checked, filtered without delay, with accelerations
    # columns of other names: Layout(columns={"time": "stamp", "q": "position_{0}", "tau": ["shoulder", "elbow"]})
    # arrays: read({"time": t, "q": q, "qd": None, "tau": tau}); None: not recorded, smooth differentiates the positions
    train, test = (samples(part) for part in cut(motion, 0.6))
    fit(model, train, steps=2000, checkpoint="run.pt")  # `training`: a plain loop that survives being killed
    fit_rollout(scene, Recording(time, q, {"torque": tau}), "Viscous.coefficient")  # parameters of a scene, by shooting

Nothing here is imported by `import torchdq`; scipy is imported by the functions that need it.
"""

from torchdq.learning.bodies.payload import IdentifiedPayload, identify_payload
from torchdq.learning.bodies.posterior import PosteriorSamples, posterior_samples
from torchdq.learning.evaluation.diagnostics import LogWarning
from torchdq.learning.excitation.limits import Box, HalfSpace, MotionLimits
from torchdq.learning.excitation.trajectory import Excitation, excitation_trajectory
from torchdq.learning.identification.identified import Identified, Prediction
from torchdq.learning.identification.identify import identify
from torchdq.learning.identification.model_selection import Ladder, Rung
from torchdq.learning.logs.layouts import Layout, LogError, MissingLogError
from torchdq.learning.logs.motions import Motion, cut, directions, hold_out, samples, smooth
from torchdq.learning.logs.read import Log, read
from torchdq.learning.logs.samples import Samples
from torchdq.learning.plots import plot_torques
from torchdq.learning.rollout.fit import fit_rollout
from torchdq.learning.rollout.recordings import Recording
from torchdq.learning.rollout.result import RolloutFit
from torchdq.learning.training.fit import CheckpointError, History, fit
from torchdq.learning.training.loop import TrainingError
from torchdq.learning.with_residual import IdentifiedWithResidual

__all__ = [
    "Box",
    "CheckpointError",
    "Excitation",
    "HalfSpace",
    "History",
    "Identified",
    "IdentifiedPayload",
    "IdentifiedWithResidual",
    "Ladder",
    "Layout",
    "Log",
    "LogError",
    "LogWarning",
    "MissingLogError",
    "Motion",
    "MotionLimits",
    "PosteriorSamples",
    "Prediction",
    "Recording",
    "RolloutFit",
    "Rung",
    "Samples",
    "TrainingError",
    "cut",
    "directions",
    "excitation_trajectory",
    "fit",
    "fit_rollout",
    "hold_out",
    "identify",
    "identify_payload",
    "plot_torques",
    "posterior_samples",
    "read",
    "samples",
    "smooth",
]
