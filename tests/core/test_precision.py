"""Simulators for callers in float32: float64 inside, the caller's precision outside."""

import pytest
import torch

import diffsim
from diffsim import copter, mesh, ode, soft, stokes

BAR = mesh.hex_box((3, 1, 1), (0.1, 0.03, 0.03))
BODY = soft.SoftBody(
    BAR,
    dt=0.01,
    youngs_modulus=1e5,
    poissons_ratio=0.4,
    fixed=BAR.nodes_where(lambda x: x[:, 0] < 1e-6),
)
GRID = stokes.Grid((8, 6), spacing=1.0 / 6)
FLOW = stokes.StokesFlow(GRID, [stokes.Inlet("x-"), stokes.Open("x+")])
SPRING = ode.Ode(rates={"x": "v", "v": "-k * x"}, readings={"x": "x"}, parameters=["k"])
DESIGN = copter.load_design("pentacopter")
VEHICLE = DESIGN.multicopter(DESIGN.values)


def moved(force):
    return BODY(BODY.rest_state(), external_force=force.expand(BAR.num_nodes, 3)).x


def flown(speed):
    return FLOW(0.4 - (GRID.nodes[..., 1] - 0.5).abs(), inlet=speed).velocity


def swung(stiffness):
    t = torch.linspace(0.0, 1.0, 11, dtype=torch.float64)
    return SPRING.solve(t, torch.tensor([1.0, 0.0], dtype=torch.float64), None, stiffness)[0]


def flew(thrusts):
    start = copter.FlightState.at_rest(torch.zeros(1, 3, dtype=torch.float64))
    return copter.fly(VEHICLE, start, thrusts.expand(1, 20, -1), dt=0.01).state.position


CASES = {
    "soft": (moved, torch.tensor([0.0, 0.125, -0.3])),
    "stokes": (flown, torch.tensor([1.0, 0.25])),
    "ode": (swung, torch.tensor([4.0])),
    "flight": (flew, torch.full((VEHICLE.num_rotors,), 4.0)),
}


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_results_and_gradients_are_those_of_float64_rounded(name, dtype):
    function, value = CASES[name]
    exact = value.double().clone().requires_grad_()
    expected = function(exact)
    expected.square().sum().backward()

    given = value.to(dtype).clone().requires_grad_()
    found = diffsim.in_float64(function)(given)
    assert found.dtype == given.dtype and torch.equal(found, expected.to(dtype))
    diffsim.in_float64(lambda x: function(x).square().sum())(given).backward()
    assert given.grad.dtype == dtype and torch.equal(given.grad, exact.grad.to(dtype))


def test_forward_mode():
    ahead = diffsim.in_float64(moved)
    force, along = torch.tensor([0.0, 0.125, -0.3]), torch.tensor([0.0, 0.0, 1.0])
    _, rate = torch.func.jvp(ahead, (force,), (along,))
    _, expected = torch.func.jvp(moved, (force.double(),), (along.double(),))
    assert rate.dtype == torch.float32 and torch.equal(rate, expected.float())


def test_what_is_converted():
    seen = []

    def keep(*args, **named):
        seen.extend([args, named])
        return {"all": [args[0], (args[1],)], "state": args[2], "text": "kept"}

    keep32, state = diffsim.in_float64(keep), BODY.rest_state()
    mask, one = torch.tensor([True]), torch.ones(2)
    out = keep32(one, mask, state, more={"a": [one, 3]})
    (x, flag, same), named = seen
    assert x.dtype == named["more"]["a"][0].dtype == torch.float64
    assert flag.dtype == torch.bool and same is state and named["more"]["a"][1] == 3
    assert out["all"][0].dtype == torch.float32 and out["all"][1][0].dtype == torch.bool
    assert out["state"] is state and out["text"] == "kept"
    assert keep32.__name__ == "keep"


def test_nothing_to_go_by_leaves_float64():
    assert (
        diffsim.in_float64(lambda n: torch.ones(n, dtype=torch.float64))(2).dtype == torch.float64
    )


def test_two_precisions_are_refused():
    with pytest.raises(
        TypeError, match=r"one precision and device, got torch.float32 on cpu, torch.float64 on cpu"
    ):
        diffsim.in_float64(torch.add)(torch.ones(1), torch.ones(1, dtype=torch.float64))


def test_without_it_float32_and_other_devices_are_refused():
    with pytest.raises(TypeError, match=r"external_force must be torch.float64, got torch.float32"):
        moved(torch.zeros(3))
    with pytest.raises(TypeError, match=r"external_force must be on the CPU, got device meta"):
        moved(torch.zeros(3, dtype=torch.float64, device="meta"))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_cuda_tensors_come_back():
    force = torch.tensor([0.0, 0.125, -0.3], device="cuda", requires_grad=True)
    x = diffsim.in_float64(moved)(force)
    x.square().sum().backward()
    assert x.is_cuda and x.dtype == force.grad.dtype == torch.float32 and force.grad.is_cuda
