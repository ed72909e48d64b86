"""Physical consistency of a robot: finite numbers, masses that are not negative, inertias that a body can have."""

import math
import warnings
from collections.abc import Sequence
from typing import Literal, get_args

import torch
from torch import Tensor

from torchdq.algebra import dual_quaternion
from torchdq.algebra import quaternion as quat
from torchdq.checks import require_choice
from torchdq.dynamics import crba
from torchdq.dynamics.joints import Coordinate
from torchdq.dynamics.paper.posed import Paper
from torchdq.dynamics.tree import Tree
from torchdq.errors import UnphysicalError

OnUnphysical = Literal["error", "warn", "ignore"]
TOLERANCE = 1e-6  # relative to the trace: descriptions are printed with about six digits


def bodies(links: Sequence[str], mass: Tensor, inertia: Tensor) -> list[str]:
    """Faults of links of these masses [..., n] [kg] and inertias about their centres of mass [..., n, 3, 3] [kg m^2].

    Principal moments must not be negative, and none may exceed the sum of the other two. Equality is possible (a
    point, a rod, a plate) and is accepted. In a batch of robots a link has the fault of the first robot that has one.
    """
    batch = torch.broadcast_shapes(mass.shape[:-1], inertia.shape[:-3])
    mass, inertia = mass.double().expand(*batch, -1), inertia.double().expand(*batch, -1, -1, -1)
    finite = mass.isfinite() & inertia.isfinite().all(-1).all(-1)
    moments = torch.linalg.eigvalsh(inertia.where(finite[..., None, None], 0.0))
    slack = TOLERANCE * moments.abs().sum(-1)
    wrong = {
        "mass and inertia must be finite, found mass {mass} and inertia {inertia}": ~finite,
        "mass must not be negative, found {mass:g} kg": mass < 0,
        "it has no mass, so its inertia must be zero, found principal moments {shown} kg m^2": (mass == 0)
        & (slack > 0),
        "inertia must be positive definite, found principal moments {shown} kg m^2": moments[..., 0] < -slack,
        "the largest principal moment must not exceed the sum of the others (triangle inequality), "
        "found {shown} kg m^2": moments[..., 2] > moments[..., 0] + moments[..., 1] + slack,
    }
    if not bool(torch.stack([*wrong.values()]).any()):
        return []
    faults = []
    for i, link in enumerate(links):
        for words, mask in wrong.items():
            rows = mask[..., i].nonzero().tolist()
            if rows:
                at = tuple(rows[0])
                shown = ", ".join(f"{x:.6g}" for x in moments[at][i].tolist())
                found = words.format(mass=float(mass[at][i]), inertia=inertia[at][i].tolist(), shown=shown)
                faults.append(f"link {link!r}{f' of robot {list(at)}' if at else ''}: {found}")
                break
    return faults


def body(link: str, mass: float, inertia: Tensor) -> list[str]:
    """Faults of a link of that mass [kg] and inertia about its centre of mass [kg m^2], [3, 3]."""
    return bodies((link,), torch.tensor([mass], dtype=torch.float64), inertia.unsqueeze(0))


def inert_joints(names: Sequence[str], tree: Tree) -> list[str]:
    """Faults of joints that move no inertia in any position: the mass matrix is singular whatever the robot does.

    Args:
        names: names of the joints.
        tree: with floats as numbers; tensors of one number each would take a thousand times as long.
    """
    links, n = tree.links, len(tree.links)
    inertias, sizes = [0.0] * n, [0.0] * n
    # an inertia may vanish in one position only, so a few positions with nothing special are tried
    for seed in range(3):
        angles = [math.sin(1.0 + 12.9898 * i + 78.233 * seed) for i in range(n - 1)]
        at = Paper.at(tree, (), [None, *(Coordinate(x, math.cos(0.5 * x), math.sin(0.5 * x)) for x in angles)])
        composites = at.composites()
        # the same sums without signs
        spread = [0.0 if x.inertia is None else sum(abs(x.inertia.rotational[k][k]) for k in range(3)) for x in links]
        diagonal = crba.diagonal(tree, composites)
        for i in reversed(range(1, n)):
            (a,), mass, k = links[i].joint.columns, composites[i].mass, links[i].v.start
            inertias[i] = max(inertias[i], diagonal[k])
            sizes[i] = max(sizes[i], quat.norm2(a[0]) * spread[i] + quat.norm2(a[1]) * abs(mass))
            spread[links[i].parent] += spread[i] + abs(mass) * quat.norm2(dual_quaternion.translation(at.X_PB[i]))
    # Below this part of its terms an inertia is rounding, and below that part of the robot's it is the square of the
    # rounding of a distance. An absolute bound would reject a microrobot, or its hand on a crane.
    square = 1e-28 * max(sizes)
    return [
        f"joint {name!r}: it moves no inertia, so its acceleration is undefined; give the links beyond it mass"
        for name, inertia, size in zip(names, inertias[1:], sizes[1:], strict=True)
        if not inertia > max(1e-14 * size, square)
    ]


def complain(robot: str, faults: Sequence[str], on_unphysical: OnUnphysical, stacklevel: int = 4) -> None:
    """Raise, warn or do nothing about faults; `stacklevel` as in `warnings.warn`."""
    require_choice("on_unphysical", on_unphysical, get_args(OnUnphysical))
    if not faults or on_unphysical == "ignore":
        return
    message = f"robot {robot!r} is unphysical:\n  " + "\n  ".join(faults)
    if on_unphysical == "error":
        raise UnphysicalError(f"{message}\nCorrect the description, or pass on_unphysical='warn'.")
    warnings.warn(message, stacklevel=stacklevel)
