"""Two threads of Python on the same bodies and flows: a program for ThreadSanitizer.

    python -m tests.sanitizers.two_threads         # ends with "same"
    python -m tests.sanitizers.two_threads race    # both write to one memory: must be seen

Systems, patterns and analyses are made when they are first asked for, here by both threads at once;
what one thread finds alone is computed afterwards, from fresh ones.
"""

import math
import sys
from collections.abc import Callable

import torch

from diffsim import stokes
from diffsim.core.compiled import core
from tests.test_two_threads import Answer, at_once, channel, landing

WORK: dict[str, Callable[[], Callable[[], Answer]]] = {
    "soft": lambda: landing(None),
    "contact without friction": lambda: landing(0.0),
    "contact": lambda: landing(0.4),
    "sticking": lambda: landing(math.inf),
    "stokes": channel,
    "stokes, slip": lambda: channel("no_separation"),
    "stokes, iterative": lambda: channel(solver=stokes.SolverOptions(method="iterative")),
    "stokes, incompressible": lambda: channel(incompressible=True),
    "stokes, incompressible, iterative": lambda: channel(
        incompressible=True, solver=stokes.SolverOptions(method="iterative")
    ),
}


def shared_memory() -> Callable[[], Answer]:
    """Cut cells, written to the same memory whoever asks: a race."""
    grid = stokes.Grid((12, 12), size=1.0)
    phi = (0.3 - (grid.nodes - 0.5).norm(dim=-1)).flatten().contiguous()
    shape = core.make_grid_shape(tuple(grid.shape), tuple(grid.spacing))
    out = {name: torch.zeros(288, dtype=torch.float64) for name in ("volume", "area", "normal")}

    def run() -> Answer:
        places = {name: each.data_ptr() for name, each in out.items()}
        for _ in range(300):  # longer than a slice of a busy processor: the threads take turns
            core.cut_cells(shape=shape, phi=phi.data_ptr(), num_threads=1, **places)
        return []

    return run


def main(race: bool) -> None:
    torch.set_num_threads(1)
    for name, make in {"race": shared_memory}.items() if race else WORK.items():
        found = at_once(make())
        alone = make()()
        assert all(all(map(torch.equal, each, alone)) for each in found), name
    print("same")


if __name__ == "__main__":
    main("race" in sys.argv[1:])
