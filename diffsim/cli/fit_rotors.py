"""``diffsim fit-rotors``: write the rotor models that come with the package."""

from __future__ import annotations

import argparse
import importlib.resources
from pathlib import Path

HELP = "fit rotor models to the bench tables, and write those that come with the package"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``diffsim fit-rotors``."""
    parser.add_argument("--data", type=Path, help="folder that holds rotor_bench")
    parser.add_argument("--output", type=Path, help="default: the package's own folder")
    parser.add_argument("--figures", type=Path, help="also draw every fit here")


def command(args: argparse.Namespace) -> None:
    """Fit every table, write its model, and print how well it fits.

    Raises:
        FileNotFoundError: no folder of data.
    """
    from diffsim.copter.vehicle.fit_rotor import fit_rotor, write_rotor
    from diffsim.copter.vehicle.rotor_table import read_rotor_bench
    from diffsim.core.files import replacing
    from diffsim.core.optional import ask_for
    from diffsim.core.paths import data_folder

    if args.figures:
        ask_for(["matplotlib"], purpose="--figures")
    data = args.data or data_folder()
    if data is None:
        raise FileNotFoundError("no data folder found; give --data or set DIFFSIM_DATA")
    output = args.output or Path(str(importlib.resources.files("diffsim.copter.vehicle.rotors")))
    for table in read_rotor_bench(data / "rotor_bench").values():
        fit = fit_rotor(table)
        path = write_rotor(fit, output)
        thrust = fit.curves["thrust"]
        error = thrust.standard_errors["exponent"]
        print(
            f"{path.name:32s} thrust ~ speed^{thrust.values['exponent']:.3f} +- {error:.3f}, rms "
            f"{thrust.rms:.3f} N, speed rms {fit.curves['speed'].rms:.1f} rad/s"
        )
        if args.figures:
            from diffsim.viz.rotors import rotor_fit  # matplotlib is optional

            with replacing(args.figures / f"{table.name}.png", ".png") as drawn:
                rotor_fit(fit).savefig(drawn, dpi=110)
