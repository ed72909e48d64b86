"""Base parameters: inertial parameters regrouped so that fewer of them are not zero.

Particles on the axis of a revolute joint move with the parent as well as with the link. Mass, first and second moment
along the axis are those of such particles: they are moved from the link to its parent, and no torque and no
acceleration changes. Source: M. Gautier, W. Khalil, "Direct calculation of minimum set of inertial parameters of serial
robots", IEEE Transactions on Robotics and Automation 6 (1990).
"""

from torchdq.algebra.elementary import UNTURNED, DualAngle, Z
from torchdq.algebra.inertia import Moments
from torchdq.dynamics.aligned.placement import Step
from torchdq.dynamics.tree import Tree


def regrouped(tree: Tree) -> Tree:
    """Tree in aligned frames with base parameters, moved towards the base where possible."""
    bodies: list[Moments] = [link.inertia for link in tree.links]
    for i in reversed(range(1, len(bodies))):
        link = tree.links[i]
        if link.joint.slides or not link.joint.turns:
            continue
        bodies[i], on_axis = bodies[i].split(Z)
        moved = Step(link.placement, DualAngle(UNTURNED, link.placement.shift)).inertia_to_parent(on_axis)
        below = bodies[link.parent]
        bodies[link.parent] = moved if below is None else below.plus(moved)
    links = tuple(link._replace(inertia=body) for link, body in zip(tree.links, bodies, strict=True))
    return tree._replace(links=links)
