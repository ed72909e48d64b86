"""Distance of a robot to its description: its slopes and curvature are those of differences."""

import torch
from recorded_logs import ROBOT

from torchdq.learning.identification import terms
from torchdq.learning.identification.feasible import Neighbourhood


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
