"""The catalogue of public functions, and the checks of what is given to them."""

import torch
from helpers import all_in_one, random
from messages import refused

import torchdq
from torchdq import ArgumentError
from torchdq.functions.call import check
from torchdq.functions.catalogue import RECIPES

PANDA = torchdq.robots.load("panda")


@all_in_one([{}, {"mass": PANDA.mass, "gravity": PANDA.gravity}])
def test_derivatives_and_mass_matrix_are_one_program_that_shares_what_depends_on_q_alone(replaced):
    robot, q, qd, qdd = PANDA.replace(**replaced), *random(3, 4, 7)
    slopes, inertia, both = (
        torchdq.compile(robot, name) for name in ("inverse_dynamics_jacobian", "mass_matrix", "dynamics_jacobian")
    )
    alone = slopes.count().total + inertia.count().total
    assert both.count().total < alone and both.count().sines == slopes.count().sines
    dtau_dq, dtau_dqd, M = torchdq.dynamics_jacobian(robot, q, qd[0], qdd)
    assert torch.equal(M, torchdq.mass_matrix(robot, q)) and dtau_dq.shape == dtau_dqd.shape == M.shape
    expected = torch.func.vmap(
        torch.func.jacrev(lambda q, qd, qdd: torchdq.inverse_dynamics(robot, q, qd, qdd), (0, 1))
    )
    for found, slope in zip((dtau_dq, dtau_dqd), expected(q, qd[:1].expand(4, 7), qdd), strict=True):
        torch.testing.assert_close(found, slope, rtol=1e-11, atol=1e-11 * float(slope.abs().max()))


def test_every_recipe_names_its_arguments_once():
    for recipe in RECIPES.values():
        names = [field.name for field in recipe.fields]
        assert len(set(names)) == len(names) and names[0] in ("q", "X_WB")


def test_quantities_and_a_robot_have_common_batch_axes():
    q = random(4, 7)
    assert check(PANDA, q=q, qd=q[0]) == (4,)
    assert check(PANDA.replace(mass=PANDA.mass.expand(3, 1, 7)), ("f_tip",), q=q, f_tip=None) == (3, 4)
    with refused(ArgumentError):
        check(PANDA, q=q, qd=q[:, :6])
    with refused(ArgumentError):
        check(PANDA, ("f_tip",), q=q, qd=None, f_tip=None)
    inertia = torch.tensor([1.0, 0.0, 1.0, 0.0, 0.0, 1.0])
    free = PANDA.replace(base_mass=torch.tensor(1.0), base_com=torch.zeros(3), base_inertia=inertia)
    with refused(ArgumentError):
        check(free, q=q)
