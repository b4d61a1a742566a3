"""PyTorch's own tools on our classes: converted modules, other devices, files of records."""

import io

import pytest
import torch
from torch import nn

from diffsim import contact, mesh, soft, stokes
from diffsim.control import MLPController
from diffsim.copter import LQR, Hover
from diffsim.core.check import require
from diffsim.core.module import Float64Module
from diffsim.ode import Ode
from diffsim.stokes import shapes
from tests.copter.flight_cases import crooked_copter, tumbling

BAR = mesh.hex_box((2, 1, 1))


def make_body() -> soft.SoftBody:
    return soft.SoftBody(BAR, dt=0.01, youngs_modulus=1e5, poissons_ratio=0.3)


class Policy(nn.Module):
    """A network with a simulator in it."""

    def __init__(self):
        super().__init__()
        self.network = nn.Linear(1, 3)
        self.body = make_body()

    def forward(self, observation):
        push = self.network(observation).double().expand_as(self.body.x_rest)
        return self.body(self.body.rest_state(), external_force=push).x


@pytest.mark.parametrize("convert", [nn.Module.float, nn.Module.half, nn.Module.bfloat16])
def test_a_converted_network_keeps_its_simulator(convert):
    policy = Policy()
    with pytest.warns(UserWarning, match="SoftBody stays in float64 on the CPU"):
        convert(policy)
    assert policy.network.weight.dtype is not torch.float64
    assert policy.body.youngs_modulus.dtype is torch.float64
    observation = torch.ones(1, dtype=policy.network.weight.dtype)
    policy(observation).sum().backward()
    assert float(policy.network.weight.grad.abs().max()) > 0.0


def test_every_layer_with_constants_stays_on_the_cpu():
    layers = [
        make_body(),
        soft.Hydrodynamics(BAR),
        soft.FirstOrderLag(0.1),
        soft.Tendon(BAR, [[0.1, 0.5, 0.5], [0.9, 0.5, 0.5]], axial_stiffness=1.0),
        contact.BodyContact(BAR, BAR, stiffness=1.0),
        Hover(weights=torch.ones(4, dtype=torch.float64)),
        LQR(torch.ones(2).double(), torch.ones(1).double()),
        shapes.Box((1.0, 1.0, 1.0)),
        stokes.StokesFlow(stokes.Grid((4, 4), size=1.0)),
    ]
    for layer in layers:
        assert isinstance(layer, Float64Module)
        with pytest.warns(UserWarning, match="meta"):
            layer.to("meta")
        assert all(t.is_cpu for t in [*layer.parameters(), *layer.buffers()])
        assert layer.double() is layer


def test_every_layer_of_ours_says_what_its_numbers_are():
    """New ones derive from Float64Module, or are networks, which may have any precision."""
    networks = {"Normalizer", "MLPController", "OpenLoop", "Critic", "Critics", "Explorer"}
    ours = {k for k in nn.Module.__subclasses__() if k.__module__.startswith("diffsim.")}
    assert {k.__name__ for k in ours} <= networks | {"Float64Module"}


def test_a_controller_of_another_precision_says_what_to_convert():
    controller = MLPController(2, 1).float()
    assert controller(torch.zeros(1, 2)).dtype is torch.float32
    with pytest.raises(TypeError, match=r"convert one of them, such as by controller.to\(torch"):
        controller(torch.zeros(1, 2, dtype=torch.float64))


def test_a_default_device_is_refused_where_tensors_enter():
    system = Ode(rates={"x": "-x"}, readings={"y": "x"})
    times, start = torch.tensor([0.0, 1.0]).double(), torch.ones(1).double()
    body, flow = make_body(), stokes.StokesFlow(stokes.Grid((4, 4), size=1.0))
    state, phi = body.rest_state(), torch.ones(5, 5).double()
    calls = [
        lambda: system.solve(times, start),  # once numbers from nowhere
        lambda: flow.report(phi),  # once a crash
        lambda: body(state),
        lambda: mesh.hex_box((1, 1, 1)),
    ]
    try:
        torch.set_default_device("meta")
        for call in calls:
            with pytest.raises(TypeError, match=r"set_default_device\('meta'\) is in effect"):
                call()
        with torch.device("cpu"):
            assert len(body(state).x) == BAR.num_nodes
    finally:
        torch.set_default_device(None)


def test_tensors_of_other_devices_are_refused():
    with pytest.raises(TypeError, match="x must be on the CPU, got device meta"):
        require("x", torch.zeros(3, dtype=torch.float64, device="meta"), (3,))

    class Elsewhere(torch.Tensor):  # as one on a processor that this machine lacks
        is_cpu, is_meta, device = False, False, torch.device("cuda:0")

    with pytest.raises(TypeError, match=r"x must be on the CPU, got device cuda:0; use x.cpu\(\)"):
        require("x", torch.zeros(3, dtype=torch.float64).as_subclass(Elsewhere), (3,))


def test_records_are_loaded_as_tensors_are():
    state = make_body().rest_state()
    records = [
        state,
        soft.rollout(make_body(), state, 1),
        soft.ActuatorState(state.x, state.v),
        make_body().physics(),
        tumbling(1, 5),
        crooked_copter(5),
        BAR,
        mesh.tet_box((1, 1, 1)),
    ]
    for record in records:
        file = io.BytesIO()
        torch.save({"kept": record}, file)
        file.seek(0)
        found = torch.load(file, weights_only=True)["kept"]
        assert type(found) is type(record)
        for name in getattr(record, "_fields", None) or vars(record):
            value = getattr(record, name)
            if isinstance(value, torch.Tensor):
                assert torch.equal(getattr(found, name), value)
