"""Arguments of models, designs and robots: what stands on the layers; see ``examples``."""

from functools import partial
from typing import Any

import numpy as np
import torch

from diffsim import copter, envs, identify, sim_to_real, soft, stokes
from diffsim.copter import codesign, fabrication, simulator
from diffsim.copter.airframe import Airframe
from diffsim.data.study import Channel, Run, Study
from diffsim.envs.soft_tasks import Advance
from diffsim.stokes import devices
from diffsim.systems import flow_network, robots
from diffsim.systems.soft_body import SoftModel
from tests.derivatives.examples import (
    CALL,
    FACTORIES,
    LATER,
    MAKE,
    crooked_copter,
    noise,
    real,
    small_flow,
)
from tests.diagnose import linear
from tests.envs.cases import block
from tests.systems.soft_body.bars import model_of, released_bar
from tests.systems.test_soft_body import make_run

# --- designs of multicopters

QUAD = copter.load_design("x_quadcopter")


def _values() -> dict[str, Any]:
    return {"s": QUAD.values}


CALL |= {
    f"Design.{name}": _values
    for name in (
        *("all_values", "bill_of_materials", "center_of_mass", "cost", "extent", "mass"),
        *("meshes", "multicopter", "size", "with_values"),
    )
}
CALL |= {
    "Design.value": lambda: {"name": QUAD.names[0], **_values()},
    "Design.with_directions": lambda: {"directions": QUAD.multicopter().directions},
    "Design.with_spins": lambda: {"spins": QUAD.multicopter().spins},
    "ArmSpace.cost": lambda: {"s": real(0.3, 0.4)},
    "ArmSpace.size": lambda: {"s": real(0.3, 0.4)},
    "ArmSpace.multicopter": lambda: {"s": real(0.3, 0.4)},
    "plan": _values,
}
MAKE |= {
    copter.Design: dict,
    codesign.ArmSpace: lambda: {"airframe": Airframe(num_pairs=2)},
}
FACTORIES |= {copter.Design: lambda: QUAD, "plan": partial(fabrication.plan, QUAD)}


# --- the flight simulator

VEHICLE = QUAD.multicopter()
ROTORS = [copter.rotor_model("kde2814_10in")] * 4
CALL |= {
    "MotorOutputs.command": lambda: {"wanted": real([4.0] * 4), "voltage": real(14.8)},
    "MotorOutputs.limits": lambda: {"voltage": real(14.8)},
    "MotorOutputs.power": lambda: {"thrusts": real([4.0] * 4)},
    "MotorOutputs.thrusts": lambda: {"pwm": real([1500.0] * 4), "voltage": real(14.8)},
    "flight_rotors": lambda: {"vehicle": VEHICLE},
    "with_payload": lambda: {"vehicle": crooked_copter(5), "payload": 0.2},
}
MAKE |= {
    simulator.MotorOutputs: lambda: {"rotors": ROTORS, "max_thrusts": real([9.0] * 4)},
}


# --- fits of a linear model

RUN = linear.run("r1", 1)
EFFECT = linear.line("bump")
POINT = {"run": RUN, "q": real(0.2, -0.3), "sizes": {EFFECT: real([0.4])}}
POINTS = {"run": RUN, "q": noise(3, 2), "sizes": {EFFECT: noise(3, 1)}}
CALL |= {
    "SimModel.predict": lambda: POINT,
    "SimModel.scene": lambda: POINT,
    "SimModel.predict_many": lambda: POINTS,
    "ExtendedModel.predict": lambda: {**POINT, "q": noise(3)},

    "ExtendedModel.predict_many": lambda: {**POINTS, "q": noise(3, 3)},

    "SimModel.simulate_many": lambda: POINTS,
    "Effect.act": lambda: {
        "scene": linear.LinearScene(noise(linear.NUM_SAMPLES, 2)), "size": real([0.4]),
        "run": RUN, "values": {"mass": real(1.0)},
    },
    "Parameter.value_at": lambda: {"q": real(0.3)},
    "Problem.predict": lambda: {"run": RUN, "x": noise(3)},
    "Problem.predict_many": lambda: {"run": RUN, "points": list(noise(3, 3))},
    "Problem.sizes_at": lambda: {"x": noise(3)},
}  # fmt: skip
MAKE |= dict.fromkeys(
    (identify.SimModel, identify.Problem, identify.Effect, identify.ExtendedModel), dict
)
MAKE[identify.Parameter] = lambda: {"name": "m", "value": 0.3, "sd": 0.1, "unit": "kg"}
FACTORIES |= {
    identify.SimModel: linear.model,
    identify.ExtendedModel: lambda: identify.ExtendedModel(
        linear.model(),
        [linear.line("sag")],
        [*linear.model().base, identify.Parameter("sag.size", 0.1, 0.2, "N")],
    ),
    identify.Problem: lambda: linear.problem([EFFECT]),
    identify.Effect: lambda: EFFECT,
}


# --- fluidic devices

AMPLIFIER = devices.amplifier(0.25)
AMPLIFIER_X = AMPLIFIER.sample(torch.Generator().manual_seed(0))


def _field() -> stokes.FlowField:
    flow = small_flow(2)
    phi = 0.31 - (flow.grid.nodes[..., 1] - 0.5).abs()
    return flow(phi, inlet=torch.ones(2, dtype=torch.float64))


def _places() -> dict[str, Any]:
    return {"points": 1e-3 * torch.rand(6, 2, generator=torch.Generator().manual_seed(1)).double()}


CALL |= {
    "area": lambda: {"field": _field(), "faces": ["x+"]},
    "mean_velocity": lambda: {"field": _field(), "faces": ["x+"]},
    "Device.level_set": lambda: {"x": AMPLIFIER_X},
    "Device.loss": lambda: {"x": AMPLIFIER_X},
    "Device.solve": lambda: {"x": AMPLIFIER_X},
    "Device.value": lambda: {"x": AMPLIFIER_X},
    "Device.value_and_gradient": lambda: {"x": AMPLIFIER_X},
    "ChannelDevice.level_set": _places,
    "ChannelDevice.local_width": _places,
    "ChannelDevice.throat": lambda: {"branch": 0, **_places()},
}
MAKE |= {devices.Device: dict, flow_network.ChannelDevice: dict}
FACTORIES[devices.Device] = lambda: AMPLIFIER


# --- robots

ROBOT = block(water=True)
STATE = soft.State(ROBOT.body.x_rest, 0.1 * noise(12, 3))
MAKE[robots.SoftRobot] = dict
FACTORIES[robots.SoftRobot] = lambda: ROBOT
CALL |= {
    "SoftRobot.activation": lambda: {"command": 0.3 * noise(len(ROBOT.command_names))},
    "SoftRobot.attitude": lambda: {"x": STATE.x},
    "SoftRobot.center": lambda: {"x": STATE.x},
    "SoftRobot.force": lambda: {"state": STATE},
    "SoftRobot.step": lambda: {"state": STATE, "command": 0.3 * noise(len(ROBOT.command_names))},
}


# --- tasks

TASK = Advance(ROBOT, 5, substeps=2)


def _acted() -> dict[str, Any]:
    state = TASK.start(1, np.random.default_rng(0))
    state["v"] = 0.1 * noise(*state["v"].shape, seed=2)  # drag has a kink at rest
    return {"state": state, "action": 0.6 * noise(1, TASK.num_actions).tanh()}


MAKE |= dict.fromkeys((envs.Task, envs.TaskEnv, envs.TaskVectorEnv), dict)
FACTORIES |= {
    envs.Task: lambda: TASK,
    envs.TaskEnv: lambda: envs.TaskEnv(TASK),
    envs.TaskVectorEnv: lambda: envs.TaskVectorEnv(TASK, 1),
}
CALL |= dict.fromkeys(
    ("Task.step", "Task.step_terms", "TaskEnv.differentiable_step",
     "TaskVectorEnv.differentiable_step"),
    _acted,
)  # fmt: skip
CALL["Task.failed"] = lambda: {"state": _acted()["state"]}


# --- soft bodies as a study describes them

BAR = model_of(released_bar(cells=(2, 1, 1), rtol=1e-11), make_run(0.03))
SOFT = {"run": make_run(0.03), "q": 0.1 * noise(len(BAR.base))}
MAKE[SoftModel] = dict
FACTORIES[SoftModel] = lambda: BAR
CALL |= {
    "SoftModel.predict": lambda: SOFT,
    "SoftModel.predict_many": lambda: {**SOFT, "q": SOFT["q"].expand(2, -1).clone()},
    "SoftModel.simulate_many": lambda: {**SOFT, "q": SOFT["q"].expand(2, -1).clone(), "sizes": {}},
    "SoftModel.scene": lambda: SOFT,
}

# --- commands that are sought for a diagnosed system

COURSE = sim_to_real.Tracking(
    seconds=0.2,
    every=0.05,
    knots=3,
    commands={"force": {"least": -1.0, "most": 2.0}},
    wanted={"place": {"course": "0.3*t", "miss": 0.1}},
)
ONE_RUN = Run("run", np.arange(3.0), np.zeros((3, 1)), {"force": np.zeros(3)}, "run")
FOLLOWED = COURSE.for_study(Study("cart", "ode", (Channel("place", "m", "position"),), (ONE_RUN,)))
MAKE[sim_to_real.TrackingTask] = dict
FACTORIES[sim_to_real.TrackingTask] = lambda: FOLLOWED
CALL |= {
    "TrackingTask.commands": lambda: {"knots": 0.5 + 0.1 * noise(3)},
    "TrackingTask.calm": lambda: {"knots": 0.5 + 0.1 * noise(3)},
    "TrackingTask.misses": lambda: {"channels": noise(2, 5, 1)},
    "TrackingTask.score": lambda: {"channels": noise(2, 5, 1)},
}
LATER += [
    r"systems\.Twin\.|sim_to_real\.(best_command|worth)",  # of a file: tests/systems/test_twin.py
    r"shape_(at|of)$|prepared_at$|picture$|factor$",  # no tensors, or what others go through
    r"systems\.multicopter\.",  # initial states are fitted away, which leaves terms out
    r"systems\.outside\.",
    r"causes\.Scene\.with_clock|Problem\.sizes_of",  # tests/systems/kinds.py takes slopes of them
    r"systems\.flow_network\.Network|soft_body\.SoftScene\.",
    r"identify\.(Jacobian\.|NumericalEffect\.|ExtendedModel\.(scene|simulate_many)$)",
    r"codesign\.codesign$|devices\.optimize$",
    r"simulator\.(Ground|LqrController|PidFlightController|FlightSimulator|payload_limit)",
]
