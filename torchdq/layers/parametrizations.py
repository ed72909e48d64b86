"""Parametrisations for learning: positive scalars and physically consistent inertias, from unconstrained numbers.

Each is a module for `torch.nn.utils.parametrize`: `forward` maps any real numbers to physical quantities, whatever an
optimiser did to them, and `right_inverse` finds the numbers of given quantities. The numbers are without units, so that
one step width suits a crane and a finger: a change by 0.01 is one percent of a mass or of a body's size.
"""

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.utils import parametrize

from torchdq.base.checks import NOT_NEGATIVE, REAL, Interval, require_all
from torchdq.errors import ArgumentError
from torchdq.robot.arrays import second_moments

__all__ = ["Fraction", "PhysicalInertia", "Positive"]

SMALLEST = 1e-6  # positive quantity that replaces one that is not positive [SI units]
FLAT = 1e-6  # smallest second moment of a body relative to their sum; a rod or a plate gets it in its flat directions
POINT = 1e-8  # second moments of a body without extent [kg m^2]
LARGEST_LOGARITHM = 30.0  # keeps squares of exponentials, and a good deal more, within the range of float32

# Inertia of L = [a 0 0; b c 0; d e f], from the ten products in L L^T: a row each for xx xy yy xz yz zz
PRODUCTS = ("aa", "bb", "cc", "dd", "ee", "ff", "ab", "ad", "bd", "ce")
SUMS = (
    (0, 1, 1, 1, 1, 1, 0, 0, 0, 0),
    (0, 0, 0, 0, 0, 0, -1, 0, 0, 0),
    (1, 0, 0, 1, 1, 1, 0, 0, 0, 0),
    (0, 0, 0, 0, 0, 0, 0, -1, 0, 0),
    (0, 0, 0, 0, 0, 0, 0, 0, -1, -1),
    (1, 1, 1, 0, 0, 0, 0, 0, 0, 0),
)


class _Quantity(nn.Module):
    """Parametrisation of a quantity with a name, which errors state."""

    name = "value"  # until one is given

    def __init__(self, name: str = name):
        super().__init__()
        self.name = name


class Positive(_Quantity):
    """Positive numbers as exponentials of unconstrained ones, between exp(-30) and exp(30).

    Zero is not an exponential, and becomes 1e-6 (in SI units). Errors call the numbers by `name`.

    >>> form = Positive()
    >>> form(torch.tensor([-1e9, 0.0])), form(form.right_inverse(torch.tensor([0.0, 2.5])))
    (tensor([9.3576e-14, 1.0000e+00]), tensor([1.0000e-06, 2.5000e+00]))
    """

    def forward(self, x: Tensor) -> Tensor:
        """Positive numbers of the shape of `x`; beyond the bounds they are constant, and so have no gradient."""
        return _exponential(x)

    def right_inverse(self, value: Tensor) -> Tensor:
        """Unconstrained numbers of given values; raises `ArgumentError` unless they are finite and not negative."""
        require_all(self.name, value, NOT_NEGATIVE)
        return value.where(value > 0, SMALLEST).log()


class Fraction(_Quantity):
    """Numbers between 0 and 1 as logistic functions of unconstrained ones.

    Zero is none, and becomes 1e-6. Errors call the numbers by `name`.

    >>> form = Fraction()
    >>> form(torch.tensor([0.0])), form(form.right_inverse(torch.tensor([0.0, 0.25])))
    (tensor([0.5000]), tensor([1.0000e-06, 2.5000e-01]))
    """

    def forward(self, x: Tensor) -> Tensor:
        """Fractions of the shape of `x`."""
        return x.sigmoid()

    def right_inverse(self, value: Tensor) -> Tensor:
        """Unconstrained numbers of given fractions; raises `ArgumentError` unless they are at least 0 and below 1."""
        require_all(self.name, value, Interval(0.0, below=1.0))
        return value.clamp(min=SMALLEST).logit()


class PhysicalInertia(_Quantity):
    """Inertias [..., 6] about the centre of mass (xx xy yy xz yz zz) that are physically consistent.

    A positive mass distribution is one whose second moments Sigma = tr(I)/2 1 - I are positive definite, which is that
    I is, and that no principal moment exceeds the sum of the others (P. M. Wensing, S. Kim, J.-J. E. Slotine, "Linear
    matrix inequalities for physically-consistent inertial parameter identification", IEEE Robotics and Automation
    Letters 3 (2018)). Every such Sigma has one Cholesky factor L, Sigma = L L^T, with a positive diagonal. The
    unconstrained numbers [..., 6] are its lower triangle row by row: the logarithms of the diagonal, and the others in
    units of the norm of the diagonal. With any positive mass and any centre of mass this covers the bodies that can
    exist; points, rods and plates are its limits.

    >>> form = PhysicalInertia()
    >>> rod = torch.tensor([0.0, 0.0, 1.0, 0.0, 0.0, 1.0])
    >>> form(form.right_inverse(rod))[..., (0, 2, 5)]  # the thin rod gets a thickness
    tensor([2.0000e-06, 1.0000e+00, 1.0000e+00])
    """

    diagonal: Tensor
    pairs: Tensor
    sums: Tensor

    def __init__(self, name: str = "inertia"):
        super().__init__(name)
        # whole numbers, which follow the device but not the dtype of a module
        with torch.device("cpu"):  # as the numbers of a robot are
            diagonal = torch.tensor([1, 0, 1, 0, 0, 1], dtype=torch.bool)
            pairs = torch.tensor([["abcdef".index(x) for x in pair] for pair in PRODUCTS])
            sums = torch.tensor(SUMS, dtype=torch.int8)
        self.register_buffer("diagonal", diagonal, persistent=False)
        self.register_buffer("pairs", pairs, persistent=False)
        self.register_buffer("sums", sums, persistent=False)

    def forward(self, x: Tensor) -> Tensor:
        """Inertias [..., 6] in the units of Sigma; the diagonal of L stays between exp(-30) and exp(30)."""
        pivots = _exponential(x)
        size = (pivots * pivots * self.diagonal).sum(-1, keepdim=True).sqrt()
        entries = torch.where(self.diagonal, pivots, x * size)
        first, second = self.pairs.unbind(-1)
        products = entries.index_select(-1, first) * entries.index_select(-1, second)
        return (products.unsqueeze(-2) * self.sums).sum(-1)

    def right_inverse(self, value: Tensor) -> Tensor:
        """Unconstrained numbers [..., 6] of given inertias [..., 6].

        Principal second moments below 1e-6 of their sum are lifted to that: a thin rod or plate gets a thickness, and
        an inertia that is not physically consistent becomes a consistent one close to it. With no inertia at all they
        become 1e-8 kg m^2.

        Raises:
            ArgumentError: a value is not finite.
        """
        require_all(self.name, value, REAL)
        if value.shape[-1:] != (6,):
            raise ArgumentError(
                f"{self.name} must have the shape [..., 6], xx xy yy xz yz zz, found {tuple(value.shape)}"
            )
        second = second_moments(value.to(torch.float64))
        moments, axes = torch.linalg.eigh(second)
        floor = (FLAT * moments.clamp(min=0).sum(-1, keepdim=True)).where(moments[..., -1:] > 0, POINT)
        lifted = (axes * moments.maximum(floor).unsqueeze(-2)) @ axes.mT
        second = second.where((moments >= floor).all(-1)[..., None, None], lifted)
        L = torch.linalg.cholesky(second)
        row, column = torch.tril_indices(3, 3, device=L.device).unbind(0)
        entries, pivots = L[..., row, column], L.diagonal(dim1=-2, dim2=-1)
        size = pivots.square().sum(-1, keepdim=True).sqrt()
        return torch.where(self.diagonal.to(L.device), entries.clamp(min=0).log(), entries / size).to(value.dtype)


def _exponential(x: Tensor) -> Tensor:
    return x.clamp(-LARGEST_LOGARITHM, LARGEST_LOGARITHM).exp()


def restored(
    kind: type[nn.Module], state: dict[str, Any], lists: dict[str, parametrize.ParametrizationList]
) -> nn.Module:
    """Module of that kind with its parametrizations, to the last bit."""
    module = kind.__new__(kind)
    module.__setstate__(state)
    for name, forms in lists.items():
        module.register_parameter(name, nn.Parameter(forms().detach()))
        for form in forms:
            parametrize.register_parametrization(module, name, form, unsafe=forms.unsafe)
        module.parametrizations[name] = forms  # type: ignore[index,operator,assignment]
    return module
