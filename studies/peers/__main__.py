"""Install each package of the page "who else does it" by itself, ask it for one beam, print the table.

``python -m studies.peers FOLDER`` makes one virtual environment a package in FOLDER and keeps it.
"""

import json
import os
import subprocess
import sys
import venv
from pathlib import Path
from typing import NamedTuple

HERE = Path(__file__).parent


class Peer(NamedTuple):
    """A package, and how it is asked.

    Attributes:
        name: as the page calls it
        packages: what pip installs, with versions; none: this library, by this Python
        command: script and its arguments
    """

    name: str
    packages: tuple[str, ...]
    command: tuple[str, ...]


TORCH = ("torch==2.13.0", "--extra-index-url", "https://download.pytorch.org/whl/cpu")
PEERS = (
    Peer("this library, a step to 1e-10", (), ("this_library.py",)),
    Peer(
        "torch-diffsim, implicit",
        ("torch-diffsim[ipc]==0.2.0", *TORCH),
        ("torch_diffsim.py", "implicit"),
    ),
    Peer(
        "torch-diffsim, explicit",
        ("torch-diffsim[ipc]==0.2.0", *TORCH),
        ("torch_diffsim.py", "explicit"),
    ),
    Peer("torch-fem, statics", ("torch-fem==0.14.0", *TORCH), ("torch_fem.py",)),
    Peer("Newton, VBD", ("newton==1.8.0", "warp-lang==1.19.0"), ("newton_beam.py", "vbd")),
    Peer("MJX", ("mujoco-mjx==3.17.0", "mujoco==3.17.0", "jax==0.10.2"), ("mjx_beam.py",)),
)


def python_with(packages: tuple[str, ...], folder: Path) -> str:
    """Path of a Python that has the packages, made at the first call."""
    if not packages:
        return sys.executable
    home = folder / packages[0].split("==")[0].split("[")[0]
    python = home / "bin" / "python"
    if not python.exists():
        venv.create(home, with_pip=True)
        subprocess.run([python, "-m", "pip", "install", "-q", *packages], check=True)
    return str(python)


def ask(peer: Peer, folder: Path) -> dict:
    """What the package prints of the beam."""
    python = python_with(peer.packages, folder)
    path = {} if peer.packages else {"PYTHONPATH": str(HERE.parents[1])}
    alone = (
        {k: v for k, v in os.environ.items() if k != "PYTHONPATH"} | {"OMP_NUM_THREADS": "1"} | path
    )
    done = subprocess.run(
        [python, *peer.command], cwd=HERE, env=alone, stdout=subprocess.PIPE, text=True, check=True
    )
    return json.loads(done.stdout.splitlines()[-1])


def row(peer: Peer, said: dict) -> str:
    """The package's row of the table."""
    if "refused" in said:
        return f"| {peer.name} | {said['version']} | - | - | - | {said['refused']} |"
    slopes = [said["derivative_mm"], said["difference_mm"]]
    return f"| {peer.name} | {said['version']} | {said['fall_mm']:.4f} | {slopes[0]:.5g} | {slopes[1]:.5g} | {said['cpu_s']:.2g} s |"


def main() -> None:
    """Print the table, package by package."""
    folder = Path(sys.argv[1]).resolve()
    print(
        "| package | version | fall [mm] | d fall / d log E [mm] | by differences | CPU time, with the derivative |"
    )
    print("|---|---|---|---|---|---|")
    for peer in PEERS:
        print(row(peer, ask(peer, folder)), flush=True)


if __name__ == "__main__":
    main()
