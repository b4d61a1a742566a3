"""What a GPU would bring to soft bodies: large ones and batches, beside this project's own kernels.

python -m studies.soft_gpu --eigen FOLDER        needs nvcc, g++ and an NVIDIA GPU

``soft_gpu/step.cu`` takes one implicit step of the cantilever of thesis 4.1.5, and its adjoint;
``soft_gpu/batch.cu`` linearly implicit steps of many small bodies. Both compare answers and times
with the kernels of ``csrc``, compiled for AVX2.
"""

from __future__ import annotations

import argparse
import subprocess
import tempfile
from pathlib import Path

HERE = Path(__file__).resolve().parent
SOURCES = HERE.parent / "csrc"
STUDY = HERE / "soft_gpu"


def run(command: list[str]) -> None:
    """A command that must succeed."""
    subprocess.run(command, check=True)


def compiled(eigen: Path, arch: str, folder: Path) -> list[Path]:
    """The two programs."""
    kernels = [
        *(SOURCES / "kernels/linalg").glob("*.cpp"),
        *(SOURCES / "kernels/soft").glob("*.cpp"),
    ]
    own = [path for path in kernels if path.name != "water_force.cpp"]
    flags = ["-std=c++20", "-O3", "-march=x86-64-v3", "-w", f"-I{SOURCES}", f"-I{STUDY}"]
    objects = []
    for source in [*sorted(own), STUDY / "scene.cpp"]:
        objects.append(str(folder / f"{source.stem}.o"))
        run(["g++", *flags, "-isystem", str(eigen), "-c", str(source), "-o", objects[-1]])
    programs = []
    for name in ("step", "batch"):
        programs.append(folder / name)
        own_flags = ["-std=c++20", "-O3", f"-arch={arch}", f"-I{STUDY}"]
        run(["nvcc", *own_flags, str(STUDY / f"{name}.cu"), *objects, "-o", str(programs[-1])])
    return programs


def main() -> None:
    """Compile and run both."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--eigen", type=Path, default=Path("/usr/include/eigen3"))
    parser.add_argument("--arch", default="sm_90", help="of the GPU")
    parser.add_argument("--cells", type=int, nargs="+", default=[8, 29], help="across the beam")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        step, batch = compiled(args.eigen, args.arch, Path(name))
        run([str(step), *map(str, args.cells)])
        run([str(batch)])


if __name__ == "__main__":
    main()
