"""Physical consistency of a robot: finite numbers, masses that are not negative, inertias that a body can have."""

import math
import warnings
from collections.abc import Sequence
from typing import Literal, NoReturn, get_args

import torch
from torch import Tensor

from torchdq.algebra import dual_quaternion
from torchdq.algebra import quaternion as quat
from torchdq.base.checks import require_choice
from torchdq.dynamics import crba
from torchdq.dynamics.general.posed import General
from torchdq.dynamics.joints import Coordinate
from torchdq.dynamics.tree import Tree
from torchdq.errors import ArgumentError, UnphysicalError
from torchdq.findings import Finding, Severity
from torchdq.program.transforms import without_values

OnUnphysical = Literal["error", "warn", "repair", "ignore"]
TOLERANCE = 1e-6  # relative to the trace: descriptions are printed with about six digits
# Moments of inertia that are rounding, of a mass m: a ball as dense as osmium has 1e-3 m^(5/3).
POINT = 1e-14
NOTHING = 1e-30  # the same without mass [kg m^2]: a bacterium has a hundred times more
REPAIRED = "inertia.repaired"
INDEFINITE, MASSLESS, TRIANGLE = "inertia.indefinite", "inertia.massless", "inertia.triangle"
MISSHAPEN = (INDEFINITE, TRIANGLE)  # not physically consistent; a repair takes the nearest inertias that are
EXPECTED = {
    "body.finite": "mass and inertia must be finite",
    "mass.negative": "mass must not be negative",
    INDEFINITE: "inertia must be positive definite",
    MASSLESS: "it has no mass, so its inertia must be zero",
    TRIANGLE: "the largest principal moment must not exceed the sum of the others (triangle inequality)",
}
NEAREST = "on_unphysical='repair' takes the nearest inertias that bodies have"


def bodies(links: Sequence[str], mass: Tensor, inertia: Tensor) -> list[Finding]:
    """Faults of links of these masses [..., n] [kg] and inertias about their centres of mass [..., n, 3, 3] [kg m^2].

    Principal moments must not be negative, and none may exceed the sum of the other two. Equality is possible (a
    point, a rod, a plate) and is accepted. In a batch of robots a link has the fault of the first robot that has one.
    """
    mass, inertia = (x.to("cpu", torch.float64) for x in (mass[..., None, None], inertia))
    mass, inertia = torch.broadcast_tensors(mass, inertia)
    mass = mass[..., 0, 0]
    finite = mass.isfinite() & inertia.isfinite().all(-1).all(-1)
    moments = torch.linalg.eigvalsh(inertia.where(finite[..., None, None], 0.0))
    slack = (TOLERANCE * moments.abs().sum(-1)).maximum(rounding(mass))
    wrong = {
        "body.finite": ~finite,
        "mass.negative": mass < 0,
        INDEFINITE: moments[..., 0] < -slack,
        MASSLESS: (mass == 0) & (moments.abs().amax(-1) > NOTHING),
        TRIANGLE: moments[..., 2] > moments[..., 0] + moments[..., 1] + slack,
    }
    if not bool(torch.stack([*wrong.values()]).any()):
        return []
    faults: list[Finding] = []
    for i, link in enumerate(links):
        for code, mask in wrong.items():
            rows = mask[..., i].nonzero().tolist()
            if rows:
                at = tuple(rows[0])
                found = f"principal moments {_listed(moments[at][i])} kg m^2"
                if code == "body.finite":
                    found = f"mass {float(mass[at][i])} and inertia {inertia[at][i].tolist()}"
                if code == "mass.negative":
                    found = f"{float(mass[at][i]):g} kg"
                subject = f"link {link!r}{f' of robot {list(at)}' if at else ''}"
                severity: Severity = "warning" if code == TRIANGLE else "error"
                faults.append(Finding(code, subject, EXPECTED[code], found, severity=severity))
                break
    return faults


def require_body(what: str, mass: Tensor, inertia: Tensor) -> None:
    """Raise unless a body of masses [...] [kg] and inertias [..., 3, 3] [kg m^2] can be; one that is learned may pass.

    So may one whose numbers cannot be read.
    """
    if any(not x.numel() or x.requires_grad or without_values((x,)) for x in (mass, inertia)):
        return
    for fault in bodies((what,), mass.unsqueeze(-1), inertia.unsqueeze(-3)):
        raise ArgumentError(f"{what} must be physically consistent: {fault.expected}, found {fault.found}")


def _listed(moments: Tensor) -> str:
    return ", ".join(f"{x:.6g}" for x in moments.tolist())


def rounding(mass: Tensor) -> Tensor:
    """Largest moment of inertia [kg m^2] of a mass [kg] that is taken for rounding."""
    return torch.where(mass == 0, NOTHING, POINT * mass.abs() ** (5 / 3))


def repaired(links: Sequence[str], mass: Tensor, inertia: Tensor) -> tuple[Tensor, list[Finding]]:
    """Inertias [n, 3, 3] with inconsistent ones replaced by the nearest consistent ones, and notes of the changes.

    Nearest is meant for the second moments E = tr(I)/2 1 - I, in the Frobenius norm: negative eigenvalues become zero.
    Masses [n] are those of the links; one that cannot be is left to the faults of `bodies`.
    """
    one = torch.eye(3, dtype=torch.float64)
    new, notes = inertia.clone(), list[Finding]()
    for i, link in enumerate(links):
        if (
            not bool(inertia[i].isfinite().all())
            or not float(mass[i]) > 0
            or not bodies((link,), mass[[i]], inertia[[i]])
        ):
            continue
        E = inertia[i].trace() / 2 * one - inertia[i]
        values, axes = torch.linalg.eigh(E)
        E = axes @ torch.diag(values.clamp(min=0)) @ axes.T
        new[i] = E.trace() * one - E
        before, after = (_listed(torch.linalg.eigvalsh(I)) for I in (inertia[i], new[i]))
        part = float((new[i] - inertia[i]).norm() / inertia[i].norm())
        change = f"inertia repaired by {100 * part:.3g} %, principal moments {before} to {after} kg m^2"
        notes.append(Finding(REPAIRED, f"link {link!r}", change, severity="note", value=part))
    return new, notes


def inert_joints(names: Sequence[str], tree: Tree) -> dict[str, Finding]:
    """Faults, by name, of joints that move no inertia in any position: the mass matrix is singular everywhere.

    Args:
        names: names of the joints.
        tree: with floats as numbers; tensors of one number each would take a thousand times as long.
    """
    links, n = tree.links, len(tree.links)
    inertias, sizes = [0.0] * n, [0.0] * n
    # an inertia may vanish in one position only, so a few positions with nothing special are tried
    for seed in range(3):
        angles = [math.sin(1.0 + 12.9898 * i + 78.233 * seed) for i in range(n - 1)]
        at = General.at(tree, (), [None, *(Coordinate(x, math.cos(0.5 * x), math.sin(0.5 * x)) for x in angles)])
        composites = at.composites()
        # the same sums without signs
        spread = [0.0 if x.inertia is None else sum(abs(x.inertia.rotational[k][k]) for k in range(3)) for x in links]
        diagonal = crba.diagonal(tree, composites)
        for i in reversed(range(1, n)):
            (a,), mass, k = links[i].joint.columns, composites[i].mass, links[i].v.start
            inertias[i] = max(inertias[i], diagonal[k])
            sizes[i] = max(sizes[i], quat.norm2(a[0]) * spread[i] + quat.norm2(a[1]) * abs(mass))
            spread[links[i].parent] += spread[i] + abs(mass) * quat.norm2(dual_quaternion.translation(at.X_PB[i]))
        enough = 1e-24 * max(sizes)
        if all(inertia > max(1e-10 * size, enough) for inertia, size in zip(inertias[1:], sizes[1:], strict=True)):
            break  # most robots need one position only
    # Below this part of its terms an inertia is rounding, and below that part of the robot's it is the square of the
    # rounding of a distance. An absolute bound would reject a microrobot, or its hand on a crane.
    square = 1e-28 * max(sizes)
    return {
        name: Finding(
            "joint.inert",
            f"joint {name!r}",
            "it moves no inertia, so its acceleration is undefined",
            cure="give mass to the links beyond it",
            severity="error",
        )
        for name, inertia, size in zip(names, inertias[1:], sizes[1:], strict=True)
        if not inertia > max(1e-14 * size, square)
    }


def complain(robot: str, faults: Sequence[Finding], on_unphysical: OnUnphysical) -> None:
    """Raise, warn or do nothing about faults, those left by a repair.

    "error" and "repair" raise for those that give wrong numbers, and warn of the others.
    """
    require_choice("on_unphysical", on_unphysical, get_args(OnUnphysical))
    if not faults or on_unphysical == "ignore":
        return
    if on_unphysical != "warn" and not all(fault.code == TRIANGLE for fault in faults):
        refuse(robot, faults, repaired=on_unphysical == "repair")
    repairable = any(fault.code == TRIANGLE for fault in faults)
    advice = f"\nNumbers are those of the inertias as they are; {NEAREST}." if repairable else ""
    warnings.warn(_unphysical(robot, faults) + advice, stacklevel=4)  # where a public function was called


def refuse(robot: str, faults: Sequence[Finding], repaired: bool = False) -> NoReturn:
    """Raise for faults, with what can be done about them; `repaired`: whether inertias have been repaired."""
    if repaired:
        cure = "only inertias of bodies with mass can be repaired"
    else:
        cure = "on_unphysical='warn' uses these numbers anyway"
        cure += f", and {NEAREST}" if any(fault.code in MISSHAPEN for fault in faults) else ""
    raise UnphysicalError(f"{_unphysical(robot, faults)}\nCorrect the description; {cure}.", *faults)


def _unphysical(robot: str, faults: Sequence[Finding]) -> str:
    return "\n  ".join((f"robot {robot!r} is unphysical:", *map(str, faults)))
