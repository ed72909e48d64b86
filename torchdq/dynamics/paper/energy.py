"""Kinetic and potential energy."""

from collections.abc import Sequence

from torchdq.algebra import dual_quaternion as dq
from torchdq.algebra import quaternion as quat
from torchdq.algebra import screw
from torchdq.algebra.dual_quaternion import DualQuaternion
from torchdq.algebra.quaternion import Number
from torchdq.algebra.screw import Screw
from torchdq.dynamics.absent import momentum
from torchdq.dynamics.tree import Mechanism


def kinetic_energy(mechanism: Mechanism, V: Sequence[Screw], qd: Sequence[Number]) -> Number:
    """Kinetic energy 1/2 sum of G_i(V_i) (.) swap(V_i), rotors included [J]."""
    twice = 0.0
    for link, V_i, qd_i in zip(mechanism.links, V, qd, strict=True):
        twice = twice + screw.power(momentum(link, V_i), V_i)
        if link.armature is not None:
            twice = twice + link.armature * (qd_i * qd_i)
    return 0.5 * twice


def potential_energy(mechanism: Mechanism, X_WB: Sequence[DualQuaternion]) -> Number:
    """Potential energy -sum of g . (m p_com) [J]; zero with every centre of mass at the base's origin."""
    if mechanism.gravity is None:
        return 0.0
    moment = None
    for link, x in zip(mechanism.links, X_WB, strict=True):
        m_p = quat.scale(link.mass, dq.translation(x))
        if link.first is not None:
            m_p = quat.add(m_p, quat.rotate(x[0], link.first))
        moment = m_p if moment is None else quat.add(moment, m_p)
    return 0.0 if moment is None else -quat.dot(mechanism.gravity, moment)
