"""``python -m tests.known.renew [NAME ...]``: known numbers anew, of all populations or of some.

Everything is computed twice, the second time in a process whose libraries use another arithmetic:
what rounding moves, and what holds the name of a folder, is left out.
"""

import json
import os
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from tests.known.fingerprint import fingerprint, is_close
from tests.known.populations import POPULATIONS

PLACE = Path(__file__).with_name("numbers.json")
OTHER_ARITHMETIC = {
    "ATEN_CPU_CAPABILITY": "default",
    "OPENBLAS_CORETYPE": "Prescott",  # what no machine of today picks by itself
    "MKL_CBWR": "COMPATIBLE",
    "PYTHONHASHSEED": "5",
}
MARGIN = 10.0  # between two arithmetics here, and what a third may differ by
Numbers = dict[str, dict[str, list[float]]]


def found_of(name: str, folder: Path) -> dict[str, list[float]]:
    """Fingerprints of a population, by the names of its values."""
    return {part: fingerprint(value) for part, value in POPULATIONS[name].make(folder).items()}


def read(path: Path = PLACE) -> Numbers:
    """What is known."""
    return dict(json.loads(path.read_text("utf-8"))) if path.is_file() else {}


def _computed(names: list[str]) -> Numbers:
    out = {}
    for name in names:
        with TemporaryDirectory() as folder:
            out[name] = found_of(name, Path(folder))
    return out


def _computed_otherwise(names: list[str]) -> Numbers:
    with TemporaryDirectory() as folder:
        place = Path(folder) / "numbers.json"
        command = [sys.executable, "-m", "tests.known.renew", "--once", str(place), *names]
        subprocess.run(command, env=os.environ | OTHER_ARITHMETIC, check=True)
        return read(place)


def _write(numbers: Numbers, place: Path) -> None:
    rows = (
        f'"{name}": {{\n'
        + ",\n".join(f"{json.dumps(part)}: {json.dumps(row)}" for part, row in values.items())
        + "\n}"
        for name, values in sorted(numbers.items())
    )
    place.write_text("{\n" + ",\n".join(rows) + "\n}\n", "utf-8")


def main(given: list[str]) -> None:
    """Write what is found."""
    if given[:1] == ["--once"]:
        return _write(_computed(given[2:]), Path(given[1]))
    names = given or list(POPULATIONS)
    here, there = _computed(names), _computed_otherwise(names)
    known = {name: rows for name, rows in read().items() if name in POPULATIONS}
    for name in names:
        share = POPULATIONS[name].share / MARGIN
        steady = {
            k: row
            for k, row in here[name].items()
            if is_close(there[name].get(k, [-1.0]), row, share)
        }
        known[name] = steady
        print(f"{name}: {len(steady)} of {len(here[name])} values are kept")
    return _write(known, PLACE)


if __name__ == "__main__":
    main(sys.argv[1:])
