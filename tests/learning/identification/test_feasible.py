"""Distance of a robot to its description: its slopes and curvature are those of differences; its minimum is found."""

import torch
from recorded_logs import ROBOT

from torchdq.learning.identification import terms
from torchdq.learning.identification.feasible import Distance, Neighbourhood
from torchdq.learning.identification.regression import Information
from torchdq.learning.identification.solution import minimum


def test_slopes_of_the_distance_to_the_description_are_those_of_differences():
    """With bodies, friction that must be positive, a number of any sign, and a fraction that is below one."""
    load, offset = next(x for x in terms.SHAPES if x.loaded), terms.OFFSET
    estimated = torch.ones(3, 2, dtype=torch.bool)
    torque, unit = torch.tensor([2.0, 5.0]).double(), torch.tensor([[1.0, 2.0], [1.0, 1.0], [0.4, 6.0]]).double()
    near = Neighbourhood(ROBOT, (terms.VISCOUS, offset, load), estimated, torque, unit)
    y = 0.3 * torch.rand(len(near.inverse), dtype=torch.float64)
    slope, curvature = near.slopes(y)
    steps = 1e-5 * torch.eye(len(y), dtype=torch.float64)
    found = torch.tensor([(near.distance(y + h) - near.distance(y - h)) / 2e-5 for h in steps]).double()
    assert float((slope - found).abs().max()) < 1e-7 * float(slope.abs().max())
    turned = torch.stack([(near.slopes(y + h)[0] - near.slopes(y - h)[0]) / 2e-5 for h in steps])
    assert float((turned - curvature).abs().max()) < 1e-7 * float(curvature.abs().max())


class Rough(Distance):
    """Distance from five positive coefficients, with slopes as if rounded to 1e-5; it counts its evaluations."""

    def __init__(self):
        super().__init__(0, torch.zeros(5, dtype=torch.bool), torch.zeros(5).double())
        self.evaluations = 0

    def distance(self, y):
        self.evaluations += 1
        return super().distance(y)

    def slopes(self, y, V=None):
        slope, curvature = super().slopes(y, V)
        return slope + 1e-5 * torch.sin(1e9 * y) @ V, curvature


def test_a_minimum_is_found_in_few_evaluations_where_slopes_are_rounded():
    """Steps that rounding alone makes short do not go on: what a rounded slope says is below the digits of the cost."""
    for seed in range(8):
        generator = torch.Generator().manual_seed(seed)
        e, w = 10.0 ** torch.arange(5).double(), torch.randn(5, generator=generator).double()
        V, near = torch.linalg.qr(torch.randn(5, 5, generator=generator).double()).Q, Rough()
        y, settled = minimum(near, Information(e, V, w, e.new_ones(1)), 1.0)
        assert settled and near.evaluations < 50
        slope = Distance.slopes(near, y)[0] + V @ (2 * e * (y @ V - w))
        assert float(slope.abs().max()) < 1e-4


def test_a_start_that_cannot_exist_is_none():
    """As one of a body at the edge of what can exist, which rounding takes beyond it."""
    generator = torch.Generator().manual_seed(0)
    e, w = 10.0 ** torch.arange(10).double(), 0.1 * torch.randn(10, generator=generator).double()
    V = torch.linalg.qr(torch.randn(10, 10, generator=generator).double()).Q
    near, facts = Distance(1, torch.zeros(0, dtype=torch.bool), torch.zeros(0).double()), Information(e, V, w, e[:1])
    start = -10 * torch.ones(10, dtype=torch.float64)
    assert near.distance(start).isinf()
    (found, settled), (plain, _) = minimum(near, facts, 1.0, start), minimum(near, facts, 1.0)
    assert settled and torch.equal(found, plain)
