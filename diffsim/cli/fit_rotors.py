"""``python -m diffsim.cli.fit_rotors``: write the rotor models that come with the package."""

from __future__ import annotations

import argparse
from pathlib import Path

from diffsim.copter import rotors
from diffsim.copter.fit_rotor import fit_rotor, write_rotor
from diffsim.copter.rotor_table import read_rotor_bench
from diffsim.core.paths import data_folder


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, help="folder that holds rotor_bench")
    parser.add_argument("--output", type=Path, default=Path(rotors.__file__).parent)
    parser.add_argument("--figures", type=Path, help="also draw every fit here")
    args = parser.parse_args()
    data = args.data or data_folder()
    if data is None:
        parser.error("no data folder found; give --data or set DIFFSIM_DATA")
    for table in read_rotor_bench(data / "rotor_bench").values():
        fit = fit_rotor(table)
        path = write_rotor(fit, args.output)
        thrust = fit.curves["thrust"]
        error = thrust.standard_errors["exponent"]
        print(
            f"{path.name:32s} thrust ~ speed^{thrust.values['exponent']:.3f} +- {error:.3f}, rms "
            f"{thrust.rms:.3f} N, speed rms {fit.curves['speed'].rms:.1f} rad/s"
        )
        if args.figures:
            from diffsim.viz.rotors import rotor_fit  # matplotlib is optional

            args.figures.mkdir(parents=True, exist_ok=True)
            rotor_fit(fit).savefig(args.figures / f"{table.name}.png", dpi=110)


if __name__ == "__main__":
    main()
