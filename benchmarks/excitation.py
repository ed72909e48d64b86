"""Standard errors from `excitation_trajectory` compared with those from recorded motions of a Panda and a UR10e.

    python benchmarks/excitation.py [--quick] [--data FOLDER] [--json FILE]

Standard errors of all base parameters, friction included (and rotor inertia on the UR10e, whose torques are those of
motors), that 20 s at 100 Hz leave, of each recorded motion and of the one that `excitation_trajectory` finds within 90
% of the limits of the robot and above the table, for the same noise, 1 % of the greatest torques. Some errors cannot be
halved: dry friction acts in every motion, and gravity on a body is no larger than it is. Those are counted which would
not be half the recorded motion's even if every sample were as good as the best of many random states within the limits.
The search takes one thread, and its processor time is given, which other work on the machine does not change.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import sys
import time
import warnings
from pathlib import Path

import report
import torch

import torchdq
from torchdq.learning import Excitation, HalfSpace, LogError, MotionLimits, excitation_trajectory, read_log, smooth
from torchdq.learning.excitation.information import BaseParameters

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "examples"))
from recordings import LAYOUTS

SECONDS, RATE = 20.0, 100.0
TABLE = HalfSpace("tip", (0, 0, 1), 0.1)
ARMS = {
    "panda": ("panda_gaz2019", "panda_exciting_traj1.csv", False),
    "ur10e": ("ur10e_innopolis", "ur-20_02*.csv", True),
}


def errors(parameters: BaseParameters, q: torch.Tensor, qd: torch.Tensor, qdd: torch.Tensor) -> torch.Tensor:
    """Standard errors that samples as these leave, as many as `SECONDS` at `RATE` have."""
    return parameters.errors(q, qd, qdd) * (len(q) / (SECONDS * RATE)) ** 0.5


def least(found: Excitation) -> torch.Tensor:
    """Standard errors if every sample were as good as the best of random states, and nothing else unknown."""
    generator = torch.Generator().manual_seed(0)
    u = 2 * torch.rand(3, 20_000, found.q.shape[1], dtype=torch.float64, generator=generator) - 1
    bounds, parameters = found.bounds, found.parameters
    middle, reach = (bounds.upper + bounds.lower) / 2, (bounds.upper - bounds.lower) / 2
    states = (middle + reach * u[0], bounds.velocity * u[1], found.qdd.abs().amax(0) * u[2])
    most = parameters.columns(*states).square().sum(1).amax(0)
    return 1 / (most * SECONDS * RATE).sqrt()


def main() -> None:
    """Tables of the motions of both arms."""
    parser = report.parser(__doc__, "an eighth of the restarts", page=False)
    parser.add_argument("--data", type=Path, default=os.environ.get("TORCHDQ_DATA", "data"), help="folder of the logs")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    results = []
    for name, (folder, pattern, rotors) in ARMS.items():
        robot = torchdq.robots.load(name)
        limits = MotionLimits(workspace=(TABLE,))
        excitation_trajectory(robot, SECONDS, limits, restarts=1, armature=rotors)  # compiles the programs
        start = time.process_time()
        found = excitation_trajectory(robot, SECONDS, limits, restarts=32 if arguments.quick else 256, armature=rotors)
        seconds = time.process_time() - start
        own, bound = errors(found.parameters, found.q, found.qd, found.qdd), least(found)
        print(f"\n{found!r}: {seconds:.1f} s of one thread, condition number {found.condition:.0f}")
        print("standard errors over those of a recorded motion, for the same time and noise:")
        print("motion                             mean  median   most  above half, of these cannot be halved")
        for file in sorted((arguments.data / folder).glob(pattern)):
            try:
                motion = smooth(read_log(file, LAYOUTS[name]))
            except LogError as error:
                print(f"{file.name:32}  not read: {str(error)[:60]} ...")
                continue
            recorded = errors(found.parameters, *(torch.as_tensor(x) for x in (motion.q, motion.qd, motion.qdd)))
            ratio = own / recorded
            above = ratio > 0.5
            stuck = above & (bound > recorded / 2)
            row = (float(ratio.log().mean().exp()), float(ratio.median()), float(ratio.max()))
            counts = int(above.sum()), int(stuck.sum())
            numbers = "  ".join(f"{x:.3f}" for x in row)
            print(f"{file.name:32}  {numbers}  {counts[0]:3d} of {len(ratio)}, {counts[1]}")
            results.append((name, file.name, *row, *counts, len(ratio)))
            worst = [i for i in ratio.argsort(descending=True).tolist() if above[i] and not stuck[i]]
            if worst:
                print("  ", ", ".join(f"{found.base_names[i]} {float(ratio[i]):.2f}" for i in worst))
    report.into_json(arguments.json, results=results)


if __name__ == "__main__":
    main()
