"""Hard cases of rigid-body dynamics: what is difficult about each, and what has to hold.

`test_catalogue.py` requires that every one is held by a test marked with its id, or named here as one that this package
has no counterpart of. `python tests/claims/hard_cases/catalogue.py` writes them into docs/hard-cases.md.
"""

import re
from functools import cache
from pathlib import Path

TESTS = Path(__file__).resolve().parents[2]

PAGE = TESTS.parent / "docs" / "hard-cases.md"
BEGIN, END = (
    "<!-- tests/claims/hard_cases/catalogue.py begins -->\n",
    "<!-- tests/claims/hard_cases/catalogue.py ends -->",
)

CASES: dict[str, str] = {
    # maps and group operations
    "G1": "the identity with gradients: value, gradient and Hessian finite, the Hessian of w is -1",
    "G2": "angles whose squares underflow",
    "G3": "small angles: exp within 4 ulp, log within 8",
    "G4": "both sides of every change of formula, to the second derivative",
    "G5": "half a turn, and just below and above it",
    "G6": "just below a full turn: the error is the condition's",
    "G7": "more than a full turn: the error grows with the angle only",
    "G8": "pure translations",
    "G9": "x and -x are one pose",
    "G10": "a million chained products",
    "G11": "normalising what has no direction",
    "G12": "interpolation between equal, opposite and nearly equal poses, and outside its ends",
    "G13": "frames ten kilometres away",
    "G14": "axes that are not unit vectors, are zero, or have a moment along themselves",
    "G15": "the adjoint respects products and inverses",
    # bodies
    "I1": "bodies without mass: allowed between joints, an error where a joint moves nothing",
    "I2": "point masses, rods and laminas",
    "I3": "inertias that are not physically consistent",
    "I4": "learned inertias stay those of bodies",
    "I5": "mass ratios of 1e8, heavy at the tip and heavy at the base",
    "I6": "a pivot that is rounding: an error, never a huge finite acceleration",
    "I7": "robots of a millimetre and of a kilometre",
    "I8": "rotor inertia in every form of the dynamics",
    # dynamics
    "D1": "chains of 1 to 1000 joints",
    "D2": "forward dynamics: the residual is small always, the error within the condition",
    "D3": "mass matrices that are singular or indefinite in single precision: flagged or mended by sample",
    "D4": "singular configurations",
    "D5": "velocities up to 1e6 rad/s, and infinite ones",
    "D6": "the mass matrix is symmetric and positive definite to rounding",
    "D7": "the closed form of long chains",
    "D8": "Mdot - 2C is skew",
    "D9": "inverse and forward dynamics undo each other",
    "D10": "wrenches, base acceleration and free fall",
    "D11": "gradients of inverse dynamics",
    "D12": "gradients of forward dynamics, beside a singular sample too",
    # time and effects
    "T1": "orders of convergence",
    "T2": "energy over long times",
    "T3": "reversibility, and conserved momenta",
    "T4": "the pose of a floating base stays a unit dual quaternion",
    "T5": "adaptive steps in single precision, and tolerances that cannot be met",
    "T6": "adaptive steps of a sample do not depend on the others",
    "T7": "gradients through adaptive steps",
    "T8": "gradients through a thousand steps",
    "T9": "stiff servos",
    "T10": "dry friction: at rest, creeping, and steep",
    "T11": "stiff joint limits",
    "T12": "a body that tumbles about its middle axis",
    "T13": "a state that stops being finite",
    "T14": "effects that are absent, or zero",
    # tensors
    "P1": "empty batches and robots without joints",
    "P2": "strided, expanded and broadcast inputs",
    "P3": "vmap, jacrev, jacfwd, hessian and functional_call",
    "P4": "torch.compile, with any batch",
    "P5": "autocast and half precision",
    "P7": "integers",
    "P8": "mixed dtypes",
    "P9": "rows that are not finite",
    "P10": "subnormal numbers, kept or flushed",
    "P11": "gradients of gradients at the home position",
    "P12": "state dicts, pickles and copies",
    "P13": "the number of threads",
    "P14": "shapes that broadcasting would hide",
    # descriptions
    "U1": "links without an inertial element",
    "U2": "numbers that are negative, not finite, or no numbers",
    "U3": "graphs that are not trees: all defects in one message",
    "U4": "mimic joints",
    "U5": "joints of kinds that are not simulated, and fixed joints that merge",
    "U6": "axes that are missing, zero, or not unit vectors",
    "U7": "limits that are missing or reversed",
    "U8": "hostile files: entities, depth, size, encodings",
    "U9": "gimbal lock and tiny numbers",
    "U10": "trees",
}

WITHOUT_COUNTERPART: dict[str, str] = {"P6": "TensorFloat-32: no matrix product enters, all arithmetic is elementwise"}
GROUPS = {
    "G": "Maps and group operations",
    "I": "Bodies",
    "D": "Dynamics",
    "T": "Time and effects",
    "P": "Tensors",
    "U": "Descriptions",
}


@cache
def held() -> dict[str, list[str]]:
    """Names of the test files of each case, by its id."""
    found: dict[str, set[str]] = {}
    for path in TESTS.rglob("test_*.py"):
        for ids in re.findall(r"pytest\.mark\.case\((.*?)\)", path.read_text(encoding="utf-8")):
            for id in re.findall('"(.*?)"', ids):
                found.setdefault(id, set()).add(path.name)
    return {id: sorted(names) for id, names in found.items()}


def table() -> str:
    """All cases, group by group, as on the page."""
    lines = []
    for letter, title in GROUPS.items():
        lines += [f"## {title}", "", "| case | requirement | tests |", "|---|---|---|"]
        ids = [id for id in CASES if id.startswith(letter)]
        lines += [f"| {id} | {CASES[id]} | {', '.join(f'`{name}`' for name in held()[id])} |" for id in ids]
        lines.append("")
    lines += ["Not applicable:", ""]
    return "\n".join([*lines, *(f"* {id}, {why}." for id, why in WITHOUT_COUNTERPART.items())])


def shown() -> str:
    """The table on the page."""
    return PAGE.read_text(encoding="utf-8").split(BEGIN)[1].split(END)[0].strip()


if __name__ == "__main__":
    before, rest = PAGE.read_text(encoding="utf-8").split(BEGIN)
    PAGE.write_text(f"{before}{BEGIN}{table()}\n{END}{rest.split(END)[1]}", encoding="utf-8")
