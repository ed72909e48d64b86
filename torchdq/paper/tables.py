"""Tables 2, 3 and 4 of the paper: its operations as formulas on counted numbers, with the costs it prints.

A cost is multiplications, additions, and the numbers an operation reads (storage); the rules are those of
`torchdq.numbers.count`.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

from torchdq.algebra import dual_quaternion as dq
from torchdq.algebra import quaternion as quat
from torchdq.algebra import screw
from torchdq.algebra.inertia import Inertia
from torchdq.numbers.count import Cost, Counted, cost, executed
from torchdq.paper import printed


class Entry(NamedTuple):
    """Row of a table."""

    operation: str
    printed: Cost | None  # None: the row is not in the paper
    formula: Callable[[], Any]
    whole: bool = False  # whether results that are not used count as well

    @property
    def remark(self) -> str:
        """Reason for a difference."""
        return REMARKS.get(self.operation, "")

    @property
    def counted(self) -> Cost:
        """Cost of the formula."""
        return executed(self.formula) if self.whole else cost(self.formula())

    @property
    def verdict(self) -> str:
        """Verdict on the printed entry."""
        if self.printed is None:
            return self.remark or "not in the paper"
        kinds = zip(("multiplications", "additions", "storage"), self.printed, self.counted, strict=True)
        wrong = [name for name, theirs, ours in kinds if theirs != ours]
        verb = "differs" if wrong == ["storage"] else "differ"
        found = f"{' and '.join(wrong)} {verb}" if wrong else "as printed"
        return f"{found}: {self.remark}" if self.remark else found


def markdown(rows: Sequence[Sequence[str]]) -> str:
    """Table in Markdown; the first row holds the headings."""
    headings, *lines = (f"| {' | '.join(row)} |" for row in rows)
    return "\n".join([headings, "|" + "---|" * len(rows[0]), *lines])


# --- operands --------------------------------------------------------------------------------------------------------


def several(count: int, make: Callable[[], Any] = Counted) -> Any:
    """Tuple of counted numbers, or of other operands."""
    return tuple(make() for _ in range(count))


number = Counted
vector = partial(several, 3)
quaternion = partial(several, 4)
dual_quaternion = partial(several, 2, quaternion)
motion = partial(several, 2, vector)  # screw
tensor = partial(several, 3, vector)  # rotational inertia by its rows
operator = partial(several, 2, tensor)  # columns A_P and A_D


def body() -> Inertia:
    """Inertia about the centre of mass."""
    return Inertia(number(), None, tensor())


# --- tables ----------------------------------------------------------------------------------------------------------

TABLE_2 = (
    Entry("addition", Cost(0, 4, 8), lambda: quat.add(quaternion(), quaternion())),
    Entry("multiplication by scalar", Cost(4, 0, 5), lambda: quat.scale(number(), quaternion())),
    Entry("quaternion multiplication (1)", Cost(16, 12, 8), lambda: quat.mul(quaternion(), quaternion())),
    Entry("quaternion cross product (4)", Cost(9, 5, 6), lambda: quat.cross(vector(), vector())),
    Entry("(ab - ba)/2 by two products", None, lambda: printed.cross(vector(), vector()), whole=True),
    Entry("quaternion inner product (3)", Cost(3, 2, 6), lambda: quat.dot(vector(), vector())),
    Entry(
        "matrix linear transformation T4 (20)", Cost(16, 12, 20), lambda: quat.t4(several(4, quaternion), quaternion())
    ),
    Entry(
        "Hamilton operator applied (23)",
        Cost(16, 12, 8),
        lambda: quat.t4(quat.hamilton_left(quaternion()), quaternion()),
    ),
    Entry(
        "quaternion adjoint transformation",
        Cost(20, 28, 7),
        lambda: quat.im(quat.mul(quat.mul(x := quaternion(), (0.0, *vector())), quat.conj(x))),
        whole=True,
    ),
    Entry("by two cross products", None, lambda: quat.rotate(quaternion(), vector())),
)

TABLE_3 = (
    Entry("addition", Cost(0, 8, 16), lambda: dq.add(dual_quaternion(), dual_quaternion())),
    Entry("multiplication by scalar", Cost(8, 0, 9), lambda: dq.scale(number(), dual_quaternion())),
    Entry("dual quaternion multiplication", Cost(48, 40, 16), lambda: dq.mul(dual_quaternion(), dual_quaternion())),
    Entry("cross product (6)", Cost(18, 12, 12), lambda: screw.cross(motion(), motion())),
    Entry("inner product (16)", Cost(6, 5, 12), lambda: screw.inner(motion(), motion())),
    Entry("double geodesic product (7)", Cost(6, 5, 12), lambda: screw.double_geodesic(motion(), motion())),
    Entry(
        "linear transformation T8 (21)", Cost(64, 56, 72), lambda: dq.t8(several(8, dual_quaternion), dual_quaternion())
    ),
    Entry(
        "Hamilton operator applied (24)",
        Cost(48, 48, 28),
        lambda: printed.hamilton(dual_quaternion(), dual_quaternion()),
    ),
    Entry(
        "construction of A_P and A_D (34), (35)",
        Cost(108, 72, 12),
        lambda: printed.columns(dual_quaternion()),
        whole=True,
    ),
    Entry("by p x A_P", None, lambda: screw.columns(dual_quaternion())),
    Entry("adjoint from them (36)", Cost(27, 30, 30), lambda: screw.ad(operator(), motion())),
    Entry("by x m x* (33)", None, lambda: printed.ad(dual_quaternion(), motion())),
)

TABLE_4 = (
    Entry(
        "(39), D-H",
        Cost(144, 120, 24),
        lambda: printed.denavit_hartenberg(several(2), several(2), number(), number(), number(), number()),
        whole=True,
    ),
    Entry(
        "(39), D-H, zeros known", None, lambda: printed.denavit_hartenberg(several(2), several(2), number(), number())
    ),
    Entry("(39), screws", Cost(48, 40, 8), lambda: dq.mul(dual_quaternion(), dual_quaternion())),
    Entry("(38), revolute", None, lambda: dq.mul(dual_quaternion(), screw.exp_revolute(motion(), number(), number()))),
    Entry("(34), (35)", Cost(108, 72, 12), lambda: printed.columns(dual_quaternion()), whole=True),
    Entry("(40)", Cost(33, 36, 37), lambda: screw.add(screw.scale(number(), motion()), screw.ad(operator(), motion()))),
    Entry(
        "(44)",
        Cost(57, 54, 44),
        lambda: printed.accelerated(motion(), number(), number(), operator(), motion(), motion()),
    ),
    Entry("(45)", Cost(42, 30, 22), lambda: printed.net_wrench(body(), motion(), motion())),
    Entry("(46)", Cost(27, 36, 36), lambda: screw.add(motion(), screw.ad(operator(), motion()))),
    Entry("(48)", Cost(6, 5, 12), lambda: screw.power(motion(), motion())),
)

# reasons for a difference from the printed cost, and notes on rows that the paper does not have
REMARKS = {
    "quaternion cross product (4)": "6 and 3 by components; (ab - ba)/2 to the letter is the next row",
    "(ab - ba)/2 by two products": "neither form gives the printed 9 and 5",
    "quaternion adjoint transformation": "the printed columns are exchanged",
    "by two cross products": "as in this package",
    "inner product (16)": "the printed numbers are those of the next row; (16) is a dual number",
    "Hamilton operator applied (24)": "three T4 are 48 and 36, and joining them 4; it reads two dual quaternions",
    "construction of A_P and A_D (34), (35)": "it reads 8 numbers and makes 24, of which 6 are never used",
    "by p x A_P": "as in this package: the rotation matrix, the position, and three cross products",
    "adjoint from them (36)": "three products of 3x3 matrices and vectors, one sum; 24 numbers with vectors as columns",
    "by x m x* (33)": "two products",
    "(39), D-H": "three dense products make the local transform only; chaining it is a fourth",
    "(39), D-H, zeros known": "the local transform, without its chaining product",
    "(39), screws": "one product of two dual quaternions, which are 16 numbers",
    "(38), revolute": "left out in the paper: the recursion needs (38), and (39) only for the pose of the end effector",
    "(34), (35)": "as in Table 3",
    "(40)": "inherits the additions of (36)",
    "(44)": "inherits the additions of (36)",
    "(46)": "inherits the additions of (36)",
}

TABLES = {
    "Table 2, quaternions": TABLE_2,
    "Table 3, dual quaternions": TABLE_3,
    "Table 4, the algorithm per joint": TABLE_4,
}
PER_JOINT = ("(39), screws", "(34), (35)", "(40)", "(44)", "(45)", "(46)", "(48)")  # rows of Table 4 that are summed
