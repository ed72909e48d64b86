"""Learning from recordings: read logs of real arms, identify robots from them, and train models of their torques.

    motion = smooth(read_log("log.csv"))               # checked, zero-phase filtered, with accelerations
    # columns of other names: Layout(columns={"time": "stamp", "q": "position_{0}", "tau": ["shoulder", "elbow"]})
    # arrays: read_log({"time": t, "q": q, "qd": None, "tau": tau}); None: not recorded, smooth differentiates positions
    train, test = train_test_split(motion, 0.6)
    found = identify(robot, train)                     # masses, inertias, friction, with errors
    print(evaluate(robot, found, test))                # a table, and a verdict
    fit(model, stack_samples(train), steps=2000)       # a network or a layer, by gradients
    fit_rollout(scene, Recording(time, q, {"torque": tau}), "Viscous.coefficient")  # parameters of a scene

Nothing here is imported by `import torchdq`; scipy is imported by the functions that need it.
"""

from torchdq.learning.bodies.payload import IdentifiedPayload, identify_payload
from torchdq.learning.bodies.posterior import PosteriorSamples, posterior_samples
from torchdq.learning.evaluate import Evaluation, Verdict, evaluate
from torchdq.learning.excitation.limits import HalfSpace, MotionLimits
from torchdq.learning.excitation.trajectory import Excitation, excitation_trajectory
from torchdq.learning.fit import History, TrainingError, fit
from torchdq.learning.identification.identified import Identified
from torchdq.learning.identification.identify import identify
from torchdq.learning.identification.model import Model
from torchdq.learning.logs.errors import LogError, LogWarning, MissingLogError
from torchdq.learning.logs.layouts import Layout
from torchdq.learning.logs.motions import Motion, smooth, stack_samples, train_test_split
from torchdq.learning.logs.read import Log, read_log
from torchdq.learning.logs.samples import Samples
from torchdq.learning.plots import plot_torques
from torchdq.learning.rollout.fit import fit_rollout
from torchdq.learning.rollout.recordings import Recording
from torchdq.learning.rollout.result import RolloutFit

__all__ = [
    "Evaluation",
    "Excitation",
    "HalfSpace",
    "History",
    "Identified",
    "IdentifiedPayload",
    "Layout",
    "Log",
    "LogError",
    "LogWarning",
    "MissingLogError",
    "Model",
    "Motion",
    "MotionLimits",
    "PosteriorSamples",
    "Recording",
    "RolloutFit",
    "Samples",
    "TrainingError",
    "Verdict",
    "evaluate",
    "excitation_trajectory",
    "fit",
    "fit_rollout",
    "identify",
    "identify_payload",
    "plot_torques",
    "posterior_samples",
    "read_log",
    "smooth",
    "stack_samples",
    "train_test_split",
]
