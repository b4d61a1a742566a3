"""Every solver says why it ended, in one structure, to everybody who listens."""

import dataclasses
import threading
import warnings

import numpy as np
import pytest
import torch

import diffsim
from diffsim import contact, copter, mesh, optim, soft, stokes
from diffsim.core.record import warn
from diffsim.identify import fit
from tests.diagnose import linear
from tests.helpers import numbers as tensor


def bar(contact=None, **options):
    box = mesh.hex_box((2, 1, 1), (0.2, 0.1, 0.1))
    return soft.SoftBody(
        box,
        dt=1e-2,
        youngs_modulus=1e5,
        poissons_ratio=0.3,
        solver=soft.SolverOptions(method="newton_cholesky", **options),
        contact=contact,
    )


def step(body):
    x = body.x_rest.clone().requires_grad_()
    body(soft.State(x, torch.zeros_like(x))).x.square().sum().backward()


def channel(**options):
    grid = stokes.Grid((8, 8), size=1.0)
    flow = stokes.StokesFlow(grid, [stokes.Inlet("x-"), stokes.Open("x+")], **options)
    phi = (0.33 - (grid.nodes[..., 1] - 0.5).abs()).requires_grad_()
    return flow(phi, tensor(1.0, 0.0))


def test_soft_steps_and_their_adjoints_are_recorded():
    with diffsim.record() as done:
        step(bar(rtol=1e-8))
    assert [s.solver for s in done.solves] == ["soft step", "adjoint of a soft step"]
    for solve in done.solves:
        assert solve.converged and solve.ended == ("converged",)
        assert solve.residual[0] <= solve.tolerance[0]
        assert isinstance(solve.details, soft.SolveStats)
    assert "soft step: converged after" in str(done.solves[0]) and " N" in str(done.solves[0])


def test_a_step_in_contact_says_so():
    ground = contact.Obstacle(contact.Plane((0.0, 0.0, 1.0), offset=-1e-4), friction=0.5)
    body = bar(rtol=1e-8, contact=soft.ContactOptions())
    with diffsim.record() as done:
        body(body.rest_state(), obstacles=[ground])
    assert [s.solver for s in done.solves] == ["soft step in contact"]


def test_fits_say_why_they_ended():
    runs = [linear.run("r1", 1), linear.run("r2", 2)]
    with diffsim.record() as done:
        found = fit(linear.model(), runs, linear.CHANNELS)
        spent = fit(linear.model(), runs, linear.CHANNELS, max_evaluations=1)
    assert found.converged and found.solve.ended == ("converged",)
    assert found.solve.residual[0] < 1e-3  # nats per standard deviation of the prior
    assert spent.solve.ended == ("budget",) and spent.solve.residual[0] > 1.0
    assert [s.ended for s in done.solves if s.solver == "fit"] == [("converged",), ("budget",)]


def test_a_spent_budget_is_told_and_the_warning_collected():
    body = bar(rtol=1e-10, max_iters=1, on_failure="warn")
    with warnings.catch_warnings(), diffsim.record() as done:
        warnings.simplefilter("ignore")
        push = torch.zeros_like(body.x_rest)
        push[-4:, 2] = -50.0
        body(body.rest_state(), external_force=push)
    (solve,) = done.failed
    assert solve.ended == ("budget",) and not solve.converged
    assert solve.residual[0] > solve.tolerance[0]
    (said,) = done.warnings
    assert isinstance(said, diffsim.ConvergenceWarning) and "residual" in str(said)


def test_a_flow_carries_why_it_ended_and_its_adjoint_is_recorded():
    with diffsim.record() as done:
        field = channel(incompressible=True)
        field.velocity.square().sum().backward()
    assert field.solve.ended == ("converged",)
    assert field.solve.residual[0] <= field.solve.tolerance[0]
    assert [s.solver for s in done.solves] == ["Stokes solve", "adjoint of the Stokes solve"]
    assert done.solves[0].residual == field.solve.residual
    direct = channel().solve
    assert 0.0 < direct.residual[0] <= direct.tolerance[0]


def test_an_iterative_flow_that_stops_early_says_budget():
    options = stokes.SolverOptions(method="iterative", max_iters=2, on_failure="warn")
    with pytest.warns(diffsim.ConvergenceWarning), diffsim.record() as done:
        field = channel(solver=options)
    assert field.solve.ended == ("budget",) and field.solve.residual[0] > field.solve.tolerance[0]
    assert len(done.failed) == len(done.warnings) == 1


def quad(limit):
    force = torch.zeros(3, 4, dtype=torch.float64)
    force[2] = -1.0
    torque = tensor([1.0, -1.0, -1.0, 1.0], [1.0, 1.0, -1.0, -1.0], [0.1, -0.1, 0.1, -0.1])
    return copter.hover_thrusts(
        force, torque, tensor(9.0).squeeze(), limit * torch.ones(4).double()
    )


def test_hovers_say_why_they_ended():
    with diffsim.record() as done:
        good, bad = quad(10.0), quad(1.0)
    assert good.solve.ended == ("converged",) and good.solve.residual[0] <= good.solve.tolerance[0]
    assert bad.solve.ended == ("infeasible",) and bad.solve.residual[0] > bad.solve.tolerance[0]
    assert [s.ended for s in done.solves] == [("converged",), ("infeasible",)]


def test_riccati_equations_say_why_they_ended():
    A, B = tensor([0.0, 1.0], [0.0, 0.0]), tensor([0.0], [1.0])
    Q, R = torch.eye(2).double(), torch.eye(1).double()
    with diffsim.record() as done:
        copter.lqr(A, B, Q, R)
    (solve,) = done.solves
    assert solve.solver == "Riccati equation" and solve.ended == ("converged",)
    assert solve.residual[0] <= solve.tolerance[0]
    assert copter.lqr_stats(A, B, Q, R).solve.ended == ("converged",)
    with pytest.raises(copter.RiccatiError), diffsim.record() as done:
        copter.lqr(A, tensor([0.0], [0.0]), Q, R)
    assert not done.solves[0].converged


def test_a_search_says_why_it_ended():
    def bowl(x):
        return float(x @ x), 2.0 * x

    found = optim.minimize(bowl, np.array([1.0, 2.0]))
    assert found.solve.ended == ("converged",) and found.solve.residual[0] < 1e-4
    spent = optim.Options(budget=optim.Budget(1))
    assert optim.minimize(bowl, np.array([3.0, 2.0]), options=spent).solve.ended == ("budget",)


def test_each_thread_records_its_own_solves():
    counts, ready = {}, threading.Barrier(2)

    def work(name, number):
        with diffsim.record() as done, soft.record_stats() as figures:
            ready.wait()
            for _ in range(number):
                step(bar(rtol=1e-8))
        counts[name] = (len(done.solves), len(figures))

    threads = [threading.Thread(target=work, args=a) for a in (("a", 2), ("b", 5))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert counts == {"a": (4, 4), "b": (10, 10)}


def test_blocks_nest_and_end():
    with diffsim.record() as outer:
        with diffsim.record() as inner:
            step(bar())
        step(bar())
    step(bar())
    assert len(inner.solves) == 2 and len(outer.solves) == 4


def test_warnings_are_collected_even_where_python_hides_them():
    with warnings.catch_warnings(), diffsim.record() as done:
        warnings.simplefilter("ignore")
        warn("thin", UserWarning)
        warn("thin", UserWarning)
    assert [str(w) for w in done.warnings] == ["thin", "thin"]


def test_a_solve_cannot_be_changed():
    solve = diffsim.Solve(
        solver="s", ended=("converged",), residual=(0.0,), tolerance=(1.0,), num_iters=(1,)
    )
    with pytest.raises(dataclasses.FrozenInstanceError):
        solve.residual = (1.0,)
    with pytest.raises(ValueError, match="ended must be of"):
        dataclasses.replace(solve, ended=("fine",))
    with pytest.raises(ValueError, match="one for each of ended"):
        dataclasses.replace(solve, residual=())


def test_a_warning_names_the_line_that_it_is_about():
    def checks(stacklevel):
        warn("said", stacklevel=stacklevel)  # 1: this line

    first = checks.__code__.co_firstlineno
    for stacklevel in (1, 2):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            checks(stacklevel)  # 2: this line
        assert caught[0].filename == __file__
        assert caught[0].lineno == first + (1 if stacklevel == 1 else 7)
