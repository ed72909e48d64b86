"""Learned residual torques as a joint effect."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import torch
from torch import Tensor, nn

from torchdq.base.checks import require_count, require_tensor
from torchdq.dynamics.posed import Row
from torchdq.effects.effect import TENSOR, Inputs
from torchdq.effects.joint import Impedance, JointEffect
from torchdq.errors import ArgumentError
from torchdq.program.transforms import without_values
from torchdq.robot import Robot

NAME = "residual"  # row of the torques in the programs of a scene
BLOCK = 512  # rows that are solved at once, so that their arrays fit into the processor's cache
CHANGE = 1e-3  # relative change in the last iteration that gives a warning; the error is much smaller


@dataclass(frozen=True)
class Residual(JointEffect):
    """Learned residual torques: the opposite of the torque that a model predicts beyond rigid bodies.

        tau = -r(q, qd, qdd)

    torch evaluates the model once per step, in the state at its start. Its torque is held over the step and all
    substeps, for every integrator, like a commanded torque. So the simulation is of first order in `dt`, and a torque
    that changes fast, such as stiff friction, needs short steps: use `Viscous` and `Coulomb` for friction, which are
    integrated implicitly. Gradients flow to the model's parameters and to the state.

    The torque r of a `torchdq.ResidualDynamics` depends on the acceleration, which depends on r. So Newton's method,
    from r = 0, solves r = residual(q, qd, a - W r), with the acceleration a of the scene without it and W = -dqdd/dr.
    This is accurate also for a network that has learned a missing rotor that is heavier than its link. Gradients are
    exact if the iteration has converged. The rigid-body torque among the features is that of the robot of the
    `ResidualDynamics`, without external wrenches, as in training without `f_ext`.

    Args:
        model: a `torchdq.ResidualDynamics`, of which network and learned offset act; its `effects()` are this one and
            those of its other learned parameters. Or a function or module of (q, qd) that returns torques [..., n],
            without iteration; a module computes in the dtype of its parameters.
        iterations: number of Newton iterations per step for a `ResidualDynamics`; one suffices for a network that is
            linear in the acceleration. The last of several reuses the derivatives of the one before.

    >>> import torch, torchdq
    >>> from torchdq.envs import Scene, effects
    >>> scene = Scene(torchdq.robots.load("two_link"), (effects.Residual(lambda q, qd: 0.1 * qd),))
    >>> scene.step(scene.start(torch.zeros(3, 2), torch.ones(3, 2))).qd.shape
    torch.Size([3, 2])
    """

    ONCE: ClassVar[str] = "their torques are one row; give a function that adds them"
    model: Any
    iterations: int = 3

    def described(self, robot: Robot) -> Self:
        """The effect; raises if its model does not return torques of the robot's joints."""
        require_count("iterations of Residual", self.iterations)
        has_robot = isinstance(getattr(self.model, "robot", None), Robot)
        if isinstance(self.model, type) or not callable(self.model) or (has_robot and not self._learns_accelerations):
            raise ArgumentError(
                f"model of Residual must be a torchdq.ResidualDynamics, or a function or module of (q, qd) that "
                f"returns torques [..., n], found {_named(self.model)}"
                + ("; it is a class, call it" if isinstance(self.model, type) else "")
                + ("; its torques are those of all bodies, make a ResidualDynamics of it" if has_robot else "")
            )
        if has_robot and self.model.robot.n != robot.n:
            raise ArgumentError(
                f"model of Residual must have the {robot.n} joints of robot {robot.name!r}, found {self.model.robot.n}"
            )
        return self

    @property
    def _learns_accelerations(self) -> bool:
        """True for a `ResidualDynamics`, whose torques depend on the acceleration."""
        return callable(getattr(self.model, "unmodelled", None))

    def template(self) -> Self:
        """Copy without the model, because programs do not depend on it."""
        return replace(self, model=TENSOR, iterations=1)

    def computed(self, n: int) -> dict[str, int]:
        """The torques [n]."""
        return {NAME: n}

    def outside(self) -> str:
        """Description of the model, with the size of its network."""
        kind, model = "function", self.model
        if isinstance(model, nn.Module):
            network: Any = model.network if self._learns_accelerations else model
            kind = f"network of {sum(x.numel() for x in network.parameters())} numbers in a {type(model).__name__}"
        return f"a {kind}, run by torch once per step, adds to the joint torques of the rigid bodies and other effects"

    def impedances(self, q: Row, qd: Row, inputs: Inputs) -> Sequence[Impedance]:
        """Impedances of a constant force."""
        return [Impedance(force=x) for x in inputs.get(NAME, (0.0,) * len(q))]

    def torques(self, q: Tensor, qd: Tensor, accelerations: Callable[[Tensor | None], Tensor]) -> Tensor:
        """Torques [..., n] of the model in a state; the opposite acts on the joints.

        Args:
            q, qd: positions and velocities [..., n].
            accelerations: function from additional torques [..., n], or None, to accelerations [..., n].
        """
        if not self._learns_accelerations:
            return self._of_state(q, qd)
        free, n = accelerations(None), q.shape[-1]
        units = torch.eye(n, dtype=q.dtype, device=q.device).reshape(n, *[1] * (free.ndim - 1), n)
        W = (free - accelerations(units)).movedim(0, -1)  # accelerations are linear in the torques
        gradients = torch.is_grad_enabled() or without_values((q,))
        r, before, *factors = self._solved(q.detach(), qd.detach(), free.detach(), W.detach(), gradients)
        if self.iterations > 1 and not without_values((q,)):
            self._warn_unless_converged(before, r)
        if not gradients:
            return r
        # derivatives of the solution: J^-1 times those of the residual at fixed r
        r = r.detach()
        change = self._of_joints(self.model.unmodelled(q, qd, free - (W @ r.unsqueeze(-1)).squeeze(-1)), q)
        return r + _solution(factors, change - change.detach())

    @torch.no_grad()
    def _solved(self, q: Tensor, qd: Tensor, free: Tensor, W: Tensor, gradients: bool) -> Sequence[Tensor]:
        """Torques [..., n] after all iterations, those before the last, and the factors for the gradients."""
        batch = free.shape[:-1]
        if without_values((q,)) or batch.numel() <= BLOCK:
            return self._iterated(gradients, q, qd, free, W)
        given = (q.expand(free.shape), qd.expand(free.shape), free, W.expand(*free.shape, -1))
        blocks = zip(*(x.flatten(0, len(batch) - 1).split(BLOCK) for x in given), strict=True)
        found = zip(*(self._iterated(gradients, *rows) for rows in blocks), strict=True)
        return [torch.cat(parts).unflatten(0, batch) for parts in found]

    def _iterated(self, gradients: bool, q: Tensor, qd: Tensor, free: Tensor, W: Tensor) -> Sequence[Tensor]:
        """`_solved` for all rows at once."""
        line, r, before = self.model.line(q, qd, free, W), torch.zeros_like(free), free
        factors: list[Tensor] = []
        for k in range(self.iterations):
            before = r
            if k == 0 or k < self.iterations - 1:
                found, *factors = self._linearised(line, r)
            else:  # with the factors of the iteration before
                found = self._of_joints(line.torques(r), q)
            r = r + _solution(factors, found - r)
        if gradients:
            _, *factors = self._linearised(line, r)
        return r, before, *factors

    def _linearised(self, line: Any, r: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Torques at r, and the factors of J = 1 - their derivative by r."""
        found, J = line.linearised(r)
        # a row without a solution becomes NaN or infinite, without effect on the others
        factors, pivots, _ = torch.linalg.lu_factor_ex(J)
        return self._of_joints(found, r), factors, pivots

    def _warn_unless_converged(self, before: Tensor, after: Tensor) -> None:
        """Warn about rows whose torques still changed in the last iteration."""
        change = (after - before).abs() / (1.0 + after.abs())
        rows = (change > CHANGE).any(-1)
        if bool(rows.any()):
            most = int(change.nan_to_num(posinf=0.0).reshape(-1, change.shape[-1]).amax(0).argmax())
            warnings.warn(
                f"{int(rows.sum())} of {rows.numel()} rows of Residual still changed in the last of {self.iterations} "
                f"iterations, most at joint {self.model.robot.joint_names[most]!r}; give Residual(model, iterations="
                f"{2 * self.iterations}), learn 'armature' in the model, so that no network has to imitate a rotor "
                f"behind a light link, or train the network near these motions: one whose torque falls with the "
                f"acceleration has several solutions or none",
                stacklevel=2,
            )

    def _of_state(self, q: Tensor, qd: Tensor) -> Tensor:
        """Torques of a function or module of (q, qd)."""
        like = next(self.model.parameters(), q) if isinstance(self.model, nn.Module) else q
        found = self._of_joints(self.model(q.to(like.dtype), qd.to(like.dtype)), q)
        return found.to(q.dtype) if isinstance(self.model, nn.Module) else found

    def _of_joints(self, found: Any, q: Tensor) -> Tensor:
        """Torques returned by a model; raises unless they have the shape of the joints."""
        require_tensor("what model of Residual returns", found)
        if found.shape[-1:] != q.shape[-1:] or found.ndim < q.ndim:
            raise ArgumentError(
                f"model of Residual must return torques of the shape {tuple(q.shape)} for positions of that shape, "
                f"found {tuple(found.shape)}"
            )
        return found


def _solution(factors: Sequence[Tensor], x: Tensor) -> Tensor:
    """J^-1 x for vectors x [..., n] and the factors of matrices J [..., n, n]."""
    return torch.linalg.lu_solve(factors[0], factors[1], x.unsqueeze(-1)).squeeze(-1)


def _named(model: Any) -> str:
    """Name of a model in an error."""
    return repr(model) if isinstance(model, type | Tensor) or not isinstance(model, nn.Module) else type(model).__name__
