"""``diffsim fly``: a simulated flight."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from diffsim.copter.design.design import Design
    from diffsim.copter.simulator.controllers import Pilot
    from diffsim.copter.simulator.flight_simulator import FlightSimulator, Observer
    from diffsim.copter.simulator.pacing import Pacer
    from diffsim.copter.vehicle.vehicle_record import FlyingVehicle

HELP = "fly a multicopter in simulation"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``diffsim fly``."""
    parser.add_argument(
        "design",
        metavar="DESIGN",
        help="a shipped design, a design or vehicle file (YAML), MJCF with motors at sites, or SDF "
        "with Gazebo's motor models",
    )
    pilot = parser.add_mutually_exclusive_group()
    pilot.add_argument(
        "--mission", default="hover", help="a shipped one or a YAML file (default: %(default)s)"
    )
    pilot.add_argument("--sticks", type=Path, metavar="FILE", help="recorded sticks (CSV)")
    pilot.add_argument("--input", metavar="DEVICE", help="keyboard or gamepad (needs pygame)")
    parser.add_argument(
        "--stick-mode", default="position", help="position or attitude (default: %(default)s)"
    )
    parser.add_argument("--controller", default="lqr", help="lqr or pid (default: %(default)s)")
    parser.add_argument(
        "--model",
        type=Path,
        metavar="FILE",
        help="fly as a diagnosis of this design's flights found: its extended_model.yaml or folder",
    )
    parser.add_argument("--payload", type=float, default=0.0, metavar="KG", help="load carried")
    parser.add_argument(
        "--pwm-max", type=float, default=1800.0, metavar="US", help="clamp (default: %(default)g)"
    )
    parser.add_argument("--seconds", type=float, help="end after that long")
    parser.add_argument(
        "--speed",
        type=float,
        help="of the simulation per wall clock, 0: as fast as possible (default: 1 with --view or "
        "--input, else 0)",
    )
    parser.add_argument("--seed", type=int, default=0, help="of the sensors' noise")
    parser.add_argument("--out", type=Path, default=Path("runs/fly"), help="default: %(default)s")
    parser.add_argument("--view", action="store_true", help="watch it in the rerun viewer")


def command(args: argparse.Namespace) -> None:
    """Fly as the arguments say; errors are raised, what was flown is kept."""
    from diffsim.copter.simulator.flight_simulator import FlightSimulator
    from diffsim.copter.simulator.pacing import Pacer

    flown = _load_design_or_vehicle(args.design)
    simulator = FlightSimulator(
        flown,
        controller=args.controller,
        payload=args.payload,
        pwm_max=args.pwm_max,
        seed=args.seed,
        **_options_of_model(flown, args.model),
    )
    pilot = _pilot(args)
    live = args.view or args.input is not None
    speed = (1.0 if live else 0.0) if args.speed is None else args.speed
    pacer = Pacer(speed)
    observers = [_viewer(flown, args.payload)] if args.view else []
    print(f"{flown.name}, {float(simulator.vehicle.mass):.3f} kg, controller {args.controller}")
    try:
        simulator.run(pilot, seconds=args.seconds, pacer=pacer, observers=observers)
    finally:
        if simulator.log.samples:
            _report(simulator, pacer)
            _save(simulator, flown, args.payload, args.out)
    if simulator.log.outcome == "interrupted" and args.input is None:
        raise KeyboardInterrupt  # a pilot's Escape ends a flight; Ctrl-C breaks a mission off


def _load_design_or_vehicle(name: str) -> Design | FlyingVehicle:
    """A design of parts, or a vehicle of numbers: they differ by the key ``parts``."""
    from diffsim.copter.design.design_file import load_design
    from diffsim.copter.exchange.vehicle_file import is_vehicle_file, load_vehicle

    if not is_vehicle_file(name):
        return load_design(name)
    vehicle = load_vehicle(name)
    if vehicle.assumed:
        print(f"assumed, as usual for its size: {', '.join(vehicle.assumed)}")
    return vehicle


def _options_of_model(flown: Design | FlyingVehicle, model: Path | None) -> dict[str, Any]:
    """How the vehicle flies, where a diagnosis says so."""
    if model is None:
        return {}
    from diffsim.copter.design.design import Design
    from diffsim.systems.multicopter import ExtendedCopter

    vehicle = flown.multicopter() if isinstance(flown, Design) else flown.vehicle
    copter = ExtendedCopter.read(model, vehicle)
    saved = copter.sizes.saved
    print(f"as {saved.path} says: {', '.join(saved.components) or 'no cause'}")
    return {"flies": copter.stepwise}


def _pilot(args: argparse.Namespace) -> Pilot:
    from diffsim.copter.simulator.live_input import HELP as KEYS
    from diffsim.copter.simulator.live_input import LiveSticks
    from diffsim.copter.simulator.mission import load_mission
    from diffsim.copter.simulator.sticks import StickPilot, load_sticks

    if args.input is not None:
        sticks = LiveSticks(args.input)
        print(KEYS if args.input == "keyboard" else "Escape ends the flight")
        return StickPilot(sticks, mode=args.stick_mode)
    if args.sticks is not None:
        return StickPilot(load_sticks(args.sticks), mode=args.stick_mode)
    return load_mission(args.mission)


def _viewer(design: Design | FlyingVehicle, payload: float) -> Observer:
    from diffsim.viz.flight_scene import live_scene

    return live_scene(design, payload=payload).frame


def _report(simulator: FlightSimulator, pacer: Pacer) -> None:
    for name, value in simulator.log.summary().items():
        shown = f"{value:.4g}" if isinstance(value, float) else value
        print(f"{name:<26} {shown}")
    if pacer.max_lag > simulator.dt:
        print(
            f"{pacer.num_late} of {pacer.num_steps} steps came late, by up to "
            f"{1e3 * pacer.max_lag:.0f} ms: this machine does not keep up at speed {pacer.speed:g}"
        )


def _save(
    simulator: FlightSimulator, design: Design | FlyingVehicle, payload: float, out: Path
) -> None:
    log = simulator.log
    log.save(out)
    written = ["flight.csv", "flight.yaml"]
    try:
        from diffsim.viz.flight_figures import motor_outputs, save_png
        from diffsim.viz.flight_scene import write_flight

        save_png(motor_outputs([(design.name, log)], columns=1), out / "motor_outputs.png")
        written.append("motor_outputs.png")
        write_flight(out / "flight.rrd", log, design, payload=payload)
        written.append("flight.rrd")
    except ImportError as error:
        print(f"no picture or scene: {error}", file=sys.stderr)
    try:
        from diffsim.viz.flight_page import flight_page
        from diffsim.viz.report import write

        write(flight_page(log, design, payload=payload), out / "flight.html")
        written.append("flight.html")
    except ImportError as error:
        print(f"no page: {error}", file=sys.stderr)
    print(f"written to {out}: {', '.join(written)}")
