"""Gains, friction, delay and payload of an arm, from a log that has positions and commands and no torques.

    python examples/16_positions_only.py

The simulated arm is a UR10e with position servos: commands are sent every 10 ms, and positions are measured with the
resolution of an encoder. Its servo gains, Coulomb friction, delay and payload are unknown. `fit_rollout` estimates them
from one motion, and the fitted scene is tested on the positions of another motion.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
import tyro
from pictures import BLUE, ORANGE, panels, prepare, save
from torch import Tensor

import torchdq
from torchdq import Scene, effects
from torchdq.learning import Recording, RolloutFit, fit_rollout
from torchdq.scene import integrators

STEP, EVERY = 0.002, 5  # [s] of the simulation, and its steps from command to command
DELAY, PAYLOAD, NOISE = 0.014, 2.4, 5e-5  # [s], [kg], [rad]
KP = (9e3, 9e3, 6e3, 2e3, 2e3, 1.5e3)  # [N m/rad]
KD = (900.0, 900.0, 500.0, 120.0, 120.0, 90.0)  # [N m s/rad]
FRICTION = (25.0, 30.0, 18.0, 6.0, 5.0, 4.0)  # [N m]
ROTORS = (4.0, 4.0, 3.0, 0.6, 0.6, 0.6)  # [kg m^2], from a data sheet
LEARN = ("Servo.kp", "Servo.kd", "Coulomb.coulomb", "Payload.mass", "delay")


@dataclass
class Args:
    seconds: float = 8.0
    """Duration of each of the two motions."""
    seed: int = 0
    quick: bool = False
    """Three seconds instead."""
    out: Path = Path("out")
    """Folder of the picture."""


class Result(NamedTuple):
    """Results that the test of this example looks at."""

    found: RolloutFit
    true: Tensor  # parameters in the order of `found.names`
    before: Tensor  # [n] root mean square of the position errors in the test motion, as guessed [rad]
    after: Tensor  # [n] the same, as found


def arm(kp: object, kd: object, coulomb: object, payload: float) -> Scene:
    """The arm behind its servos."""
    drives = (effects.RotorInertia(ROTORS), effects.Servo(kp, kd), effects.Coulomb(coulomb, 0.02))
    parts = (effects.Gravity(), *drives, effects.Payload(payload))
    return Scene(torchdq.robots.load("ur10e"), parts, integrator=integrators.RungeKutta4(), dt=STEP)


def commands(seconds: float, generator: np.random.Generator) -> tuple[Tensor, Tensor]:
    """Times of the commands, and sums of sinusoids around an upright arm [rows, n]."""
    time = np.arange(round(seconds / STEP / EVERY)) * STEP * EVERY
    phase = generator.uniform(0, 2 * np.pi, (6, 3))
    rate = 2 * np.pi * generator.uniform(0.1, 0.6, (6, 3))
    waves = 0.25 * np.sin(rate * time[:, None, None] + phase).sum(-1)
    return torch.from_numpy(time), torch.from_numpy(waves + np.array([0, -1.3, 1.2, -1.4, -1.5, 0]))


def simulated(scene: Scene, target: Tensor, delay: float, start: Tensor) -> Tensor:
    """Positions [rows, n] when every command arrives."""
    step = torch.arange((len(target) - 1) * EVERY)
    held = ((step - round(delay / STEP)) // EVERY).clamp(min=0)
    states = scene.rollout(scene.start(start), steps=len(step), target=target[held])
    return torch.cat([start[None], states.q[EVERY - 1 :: EVERY]])


def draw(time: Tensor, errors: dict[str, Tensor], path: Path) -> None:
    """Position errors over time, a panel for each joint."""
    figure, grid = panels(6, 2, 1.6)
    for k, panel in enumerate(grid):
        panel.set_title(torchdq.robots.load("ur10e").joint_names[k])
        for (name, error), colour in zip(errors.items(), (ORANGE, BLUE), strict=True):
            panel.plot(time, 1e3 * error[:, k], color=colour, label=name)
    figure.supylabel("measured less predicted position [mrad]", fontsize=11)
    figure.supxlabel("time [s]", fontsize=11)
    figure.legend(*grid[0].get_legend_handles_labels(), loc="outside upper center", ncols=2)
    save(figure, path)


def main(args: Args) -> Result:
    """Parameters that are found, and how well they predict another motion."""
    torch.set_num_threads(1)
    seconds = 3.0 if args.quick else args.seconds
    generator = np.random.default_rng(args.seed)
    real = arm(KP, KD, FRICTION, PAYLOAD)
    guess = arm(5e3, 300.0, 10.0, 0.5)
    logs = []
    for _ in range(2):
        time, target = commands(seconds, generator)
        q = simulated(real, target, DELAY, target[0])
        logs.append(Recording(time, q + torch.from_numpy(generator.normal(0, NOISE, q.shape)), {"target": target}))
    log, test = logs
    found = fit_rollout(guess, log, LEARN)
    print(found)

    start, target = torch.as_tensor(test.q)[0], torch.as_tensor(test.inputs["target"])
    errors = {
        "as guessed": test.q - simulated(guess, target, 0.0, start),
        "as found from positions and commands": test.q - simulated(found.scene, target, found.delay, start),
    }
    before, after = (x.square().mean(0).sqrt() for x in errors.values())
    sizes = f"{1e3 * before.mean():.3g} as guessed, {1e3 * after.mean():.3g} as found"
    print(f"\nposition errors in another motion [mrad]: {sizes}")
    draw(torch.as_tensor(test.time), errors, args.out / "positions_only.png")
    true = torch.tensor([*KP, *KD, *FRICTION, PAYLOAD, DELAY], dtype=torch.float64)
    return Result(found, true, before, after)


if __name__ == "__main__":
    prepare()
    main(tyro.cli(Args))
