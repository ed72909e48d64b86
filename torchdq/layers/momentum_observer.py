"""Momentum observer as a layer: torques of contacts from the motion and the torques of the motors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from torchdq.algebra.quaternion import Number
from torchdq.backends.call import common_batch
from torchdq.base.checks import require_number, require_object, require_tensor
from torchdq.dynamics.observer import step
from torchdq.errors import ArgumentError
from torchdq.functions.call import gain, with_options
from torchdq.functions.catalogue import Function
from torchdq.functions.parametric import Parametric
from torchdq.functions.signature import parameter
from torchdq.layers import layer_program
from torchdq.layers.dynamics import InverseDynamics
from torchdq.layers.layer_friction import described
from torchdq.numbers.functions import exp
from torchdq.program.program import Argument, Program, record, replay, results
from torchdq.robot import Robot
from torchdq.robot.argument import require_motors, require_robot
from torchdq.robot.robot import constants

FUNCTION = "joint_momentum"
GAP = 1.5  # times the median step from which rows are missing


class ObserverState(NamedTuple):
    """State of an observer, [..., n] each."""

    r: Tensor  # estimate of the external torques [N m or N]
    momentum: Tensor  # p = M qd [N m s or N s]
    rate: Tensor  # u, its rate without the motors: dT/dq - g - friction - offset [N m or N]


@dataclass(frozen=True)
class Observer(Parametric):
    """Parameters of an observer, checked as parameters of effects and control laws are."""

    gain: Any = field(metadata=parameter("n"))


class MomentumObserver(nn.Module):
    """Observer of external torques: `forward(q, qd, tau, state)` returns the next state, whose `r` is the estimate.

        r' = K (tau_ext - r),   tau_ext = p' - tau - u
        p = M qd,   u = dT/dq - g - friction(q, qd) - offset

    A constant torque shows as tau_ext (1 - exp(-K t)). Neither accelerations nor a Coriolis matrix are needed, since
    C^T qd = dT/dq. The balance over a step takes the mean of u at its ends, so the error falls with dt^2.

    Args:
        model: the robot, with the friction of its description; or an `InverseDynamics` with its friction and offset.
        gain: K [1/s], a number or shape [n]: larger is faster and noisier.
        dt: step [s].

    Raises:
        ArgumentError: the model is neither, the gain is not real, finite and not negative, or dt is not positive.

    Source: De Luca and Mattone, Sensorless robot collision detection and hybrid force/motion control, 2005.

    >>> import torch, torchdq
    >>> observer = torchdq.nn.MomentumObserver(
    ...     torchdq.robots.load("two_link"), gain=50.0, dt=0.01
    ... )
    >>> q = torch.tensor([-1.5708, 0.0])  # hanging down
    >>> # at rest against the motor
    >>> state = observer(q, 0 * q, q.new_tensor([0.0, 1.0]), observer.start(q, 0 * q))
    >>> [round(x, 2) + 0.0 for x in state.r.tolist()]
    [0.0, -0.39]
    """

    gain: Tensor

    def __init__(self, model: Robot | InverseDynamics, gain: Tensor | float, dt: float):
        super().__init__()
        if not isinstance(model, InverseDynamics):
            model = InverseDynamics(model, friction=described(require_robot(model), 1e-2).effects)
        require_number("dt", dt, positive=True)
        self.model, self.dt = model, float(dt)
        known = Observer(gain).resolved(model.robot).gain
        self.register_buffer("gain", torch.as_tensor(known, dtype=torch.float64).detach().clone())
        if self.gain.ndim > 1:
            raise ArgumentError(f"gain must be a number or have the shape [n], found {tuple(self.gain.shape)}")

    @property
    def robot(self) -> Robot:
        """Robot with the present parameters of the model."""
        return self.model.robot

    def start(self, q: Tensor, qd: Tensor) -> ObserverState:
        """State before the first step at q, qd [..., n], with r zero."""
        p, u = self.model._evaluated({"q": q, "qd": qd, "tau": torch.zeros_like(q)}, FUNCTION)
        return ObserverState(torch.zeros_like(p), p, u)

    def forward(
        self, q: Tensor, qd: Tensor, tau: Tensor, state: ObserverState, dt: Tensor | float | None = None
    ) -> ObserverState:
        """State after a step.

        Args:
            q, qd: positions [rad or m] and velocities [rad/s or m/s] at its end, [..., n].
            tau: torques of the motors in it [N m or N], [..., n]; of samples at both ends, their mean.
            state: that before it.
            dt: the step [s], if it is another than that of the observer: a number or shape [..., 1].
        """
        h = self.dt if dt is None else dt
        require_object("state", state, ObserverState, "torchdq.nn", "observer.start(q, qd)")
        given = [("q", q, (self.model.robot.n,), False)]
        given += [(f"state.{name}", x, given[0][2], False) for name, x in state._asdict().items()]
        if not isinstance(h, Tensor):
            require_number("dt", h, positive=True)
        elif h.ndim:
            given.append(("dt", h, (1,), False))
        common_batch(given, f" for robot {self.model.robot.name!r}")
        p, rate = self.model._evaluated({"q": q, "qd": qd, "tau": tau}, FUNCTION)
        u = rate - tau
        r = step(state.r, (state.momentum, p), (state.rate, u), tau, h, torch.exp(-self.gain.to(q) * h))
        return ObserverState(r, p, u)

    def series(self, q: Tensor, qd: Tensor, tau: Tensor, dt: Tensor | None = None) -> Tensor:
        """Estimates r [steps, ..., n] along a motion, those of so many calls of `forward`, all steps at once.

        Args:
            q, qd: positions and velocities, [steps + 1, ..., n].
            tau: torques in every step, [steps, ..., n].
            dt: steps [s], shape [steps]; None: those of the observer.
        """
        given = {"q": q, "qd": qd, "tau": tau, **({} if dt is None else {"dt": dt})}
        for name, x in given.items():
            require_tensor(name, x)
        rows = q.ndim == qd.ndim == tau.ndim > 1 and len(q) == len(qd) == len(tau) + 1
        if not rows or (dt is not None and dt.shape != tau.shape[:1]):
            raise ArgumentError(
                "q and qd must be [steps + 1, ..., n], tau [steps, ..., n] and dt [steps], those between rows of q, "
                f"found {', '.join(f'{name} {tuple(x.shape)}' for name, x in given.items())}; of torques that were "
                "sampled like q, give the means of neighbours"
            )
        h = q.new_tensor(self.dt) if dt is None else dt.reshape(-1, *[1] * (q.ndim - 1)).to(q)
        before = torch.cat((torch.zeros_like(tau[:1]), tau))
        p, rate = self.model._evaluated({"q": q, "qd": qd, "tau": before}, FUNCTION)
        u, keep = rate - before, torch.exp(-self.gain.to(q) * h).expand(p[1:].shape)
        r, back = step(0.0, (p[:-1], p[1:]), (u[:-1], u[1:]), tau, h, keep), 1
        while back < len(r):  # every r knows `back` steps, and learns of as many before them from the r there
            r = torch.cat((r[:back], r[back:] + keep[back:] * r[:-back]))
            keep = torch.cat((keep[:back], keep[back:] * keep[:-back]))
            back *= 2
        return r

    def threshold(self, motion: Any, margin: float = 1.5) -> Tensor:
        """Torques [n] that |r| does not reach in a motion without contacts, with a margin for others.

        Args:
            motion: what `torchdq.learning.read_log` returns, as fast as the motions to be watched, with rests if those
                rest. Motions of `smooth` have none: the estimate starts again from zero after each gap.
            margin: factor of the largest |r| in it.
        """
        require_number("margin", margin, positive=True)
        signals = {name: getattr(motion, name, None) for name in ("time", "q", "qd", "tau")}
        for name, x in signals.items():
            if x is None:
                cure = "torchdq.learning.smooth differentiates q where qd was not recorded"
                raise ArgumentError(f"motion must have time, q, qd and tau, found no {name}; {cure}")
        layout = getattr(motion, "layout", motion)
        require_motors(self.model.robot, layout.coupling)
        if not np.all(layout.known_gains):
            raise ArgumentError("motion must have torques, found efforts of unknown gains; give Layout(gain=...)")
        rows = [torch.as_tensor(x) for x in signals.values()]
        step = rows[0].diff()
        gaps = (torch.nonzero(step > GAP * step.median())[:, 0] + 1).tolist()
        parts = zip(*(torch.tensor_split(x, gaps) for x in rows), strict=True)
        r = [self.series(q, qd, 0.5 * (tau[1:] + tau[:-1]), t.diff()) for t, q, qd, tau in parts if len(t) > 1]
        return margin * torch.cat(r).abs().amax(0)

    def force(
        self,
        q: Tensor,
        r: Tensor,
        frame: str | None = None,
        expressed: str = "body",
        axes: str | Sequence[str] = "pose",
        damping: float = 1e-2,
    ) -> tuple[Tensor, Tensor]:
        """Force F [..., m] at a frame with J^T F = r, by damped least squares, and the part of each component it shows.

        The part [..., m] is 1 where the torques determine a component. Where it is less, in singular configurations
        or with fewer joints than axes, components mix, and the least force is returned.

        Args:
            q, r: positions [rad or m] and external torques [N m or N], [..., n].
            frame, expressed, axes: as in `torchdq.task_space`, (moment, force); more axes than joints are allowed. A
                contact that transmits no moment has axes="position".
            damping: d of least |J^T F - r|^2 + d^2 |F|^2, where components count by their mean effect on the joints.

        >>> import torch, torchdq
        >>> observer = torchdq.nn.MomentumObserver(
        ...     torchdq.robots.load("two_link"), gain=50.0, dt=1e-3
        ... )
        >>> F, part = observer.force(torch.zeros(2), torch.tensor([2.0, 1.0]), axes="position")
        >>> # a straight arm shows no force along itself
        >>> [round(x, 3) for x in (*F.tolist(), *part.tolist())]
        [0.0, 1.0, 0.0, 0.0, 1.0, 0.0]
        """
        given = {"q": q, "r": r, "damping": gain("damping", damping, q)}
        F, part = with_options("contact_force", self.robot, given, self.model.backend, frame, expressed, axes)
        return F, part

    def program(self) -> Program:
        """Program of one step, which takes q, qd, tau, and returns and takes a state, for `torchdq.compile`."""
        own, _ = self.model._own_quantities()
        inner = layer_program.program(
            self.robot, Function(constants(self.robot), FUNCTION), (), "constants", own, (), self.model._friction
        )
        gains = self.gain.tolist()

        def algorithm(*rows: Sequence[Number]) -> dict[str, Sequence[Number]]:
            tau, r, p, u = rows[2:]
            after, rate = results(inner, replay(inner, rows[:3])).values()
            ends = [a - t for a, t in zip(rate, tau, strict=True)]
            found = [
                step(r[i], (p[i], after[i]), (u[i], ends[i]), tau[i], self.dt, exp(-gain * self.dt))
                for i, gain in enumerate(gains)
            ]
            return {"r": found, "momentum": after, "rate": ends}

        taken = [*inner.arguments, *[Argument(name, self.robot.n) for name in ObserverState._fields]]
        found = record(f"momentum_observer_{self.robot.name}", taken, algorithm)
        return replace(found, about=(*inner.about, f"gain: {gains}", f"dt: {self.dt}"))

    def task(self) -> Observing:
        """The observer as the task of a rollout: its row "r" is the estimate after every step, from the readings.

        >>> import torch, torchdq
        >>> scene = torchdq.Scene(torchdq.robots.load("two_link"), dt=1e-3)
        >>> observer = torchdq.nn.MomentumObserver(scene.robot, 50.0, scene.dt)
        >>> start = scene.start(torch.zeros(2))
        >>> carry = torch.cat(observer.start(start.q, start.qd), -1)
        >>> scene.rollout(start, steps=9, task=observer.task(), carry=carry)[1]["r"].shape
        torch.Size([9, 2])
        """
        return Observing(self.program())


@dataclass(frozen=True)
class Observing:
    """Task of a scene that observes external torques."""

    program: Program

    def inputs(self, n: int) -> dict[str, int]:
        """The observer's state."""
        return {"carry": 3 * n}

    def rows(self, view: Any) -> dict[str, Sequence[Number]]:
        """The estimate, and the state."""
        n, state = len(view.q), view.inputs["carry"]
        given = (view.reading[:n], view.reading[n:], view.torque, state[:n], state[n : 2 * n], state[2 * n :])
        found = results(self.program, replay(self.program, given))
        return {"r": found["r"], "carry": [x for row in found.values() for x in row]}
