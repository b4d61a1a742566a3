"""Every public function by every floating tensor: the right derivative in both modes, or refused.

What is public is found, not listed. A function that is new and takes tensors fails here until it
has an example in ``tests.derivatives``.
"""

import gc
import re

import pytest
import torch

pytest.importorskip("gymnasium", reason="environments need the extra 'rl'")

from diffsim import copter, mesh, soft, stokes
from tests.derivatives import models  # noqa: F401 fills the tables
from tests.derivatives.check import check
from tests.derivatives.examples import ABSTRACT, CALL, FACTORIES, LATER, LOOK, MAKE, USE
from tests.derivatives.public import Public, find_public

pytestmark = [pytest.mark.grad, pytest.mark.filterwarnings("ignore")]
PUBLIC = find_public()


def example_of(public: Public):
    """What a public function is called as, of given arguments, and the arguments."""
    kind, method = public.owner, public.name.rpartition(".")[2]
    of_kind = {"make": MAKE[kind]()} if kind in MAKE else {}
    if method == "__init__":
        return (lambda given: USE[kind](kind(**given["make"]))), of_kind
    names = [name for name in public.names if name in CALL]
    assert names, f"{public.name} takes tensors: give it an example in tests/derivatives"
    given = {**of_kind, "call": CALL[names[0]]()}

    def called(given):
        if kind is None:
            out = FACTORIES.get(names[0], public.function)(**given["call"])
            return LOOK[names[0]](out) if names[0] in LOOK else out
        made = FACTORIES.get(kind, kind)
        return getattr(made(**given["make"]) if of_kind else made, method)(**given["call"])

    return called, given


def needs_example(public: Public) -> bool:
    """Whether it is to be called; an object whose methods are called is looked at through these."""
    if any(re.search(pattern, public.name) for pattern in LATER):
        return False
    if not public.name.endswith(".__init__"):
        return public.owner is None or public.owner not in ABSTRACT
    return public.owner in USE or not any(
        other.owner is public.owner and other is not public for other in PUBLIC
    )


@pytest.mark.parametrize(
    "public", filter(needs_example, PUBLIC), ids=lambda p: p.name.removeprefix("diffsim.")
)
def test_derivatives_are_right_or_refused(public):
    check(*example_of(public))


@pytest.mark.parametrize(
    "public", filter(needs_example, PUBLIC), ids=lambda p: p.name.removeprefix("diffsim.")
)
def test_numbers_as_tensors_are_right_or_refused(public):
    check(*example_of(public), kind=float)


def first_of_each_kind():
    """All functions, and of each class, which keeps what it is made of, one method."""
    found = {p.owner or p.name: p for p in reversed(PUBLIC) if needs_example(p)}
    return found.values()


@pytest.mark.parametrize(
    "public", first_of_each_kind(), ids=lambda p: p.name.removeprefix("diffsim.")
)
def test_tensors_in_lists_are_right_or_refused(public):
    """Torch makes plain numbers of them, without a word."""
    check(*example_of(public), kind=list)


def test_what_has_an_example_is_public():
    used = {name for public in PUBLIC for name in public.names}
    assert not set(CALL) - used


@pytest.mark.parametrize(
    ("function", "words"),
    [
        (lambda given: given["x"].detach() ** 2 + 0.01 * given["x"], "reverse mode gives"),
        (lambda given: torch.relu(given["x"]).square() * float(given["x"][0]), "reverse mode"),
        (lambda given: torch.from_numpy(given["x"].numpy()), "numpy"),
        (lambda given: given["x"] * (1 if given["x"].requires_grad else given["x"].detach()), ""),
    ],
)
def test_what_is_silent_is_found(function, words):
    with pytest.raises((AssertionError, RuntimeError), match=words):
        check(function, {"x": torch.tensor([1.5, 0.5], dtype=torch.float64)})


def wrapped_tensors():
    gc.collect()
    is_wrapped = torch._C._functorch.is_functorch_wrapped_tensor
    return [o for o in gc.get_objects() if type(o) is torch.Tensor and is_wrapped(o)]


def test_what_is_made_within_torch_func_serves_outside():
    """A mesh, a design's matrices, a kernel's masks: made within, kept, and free of wrappers."""
    design, kept = copter.load_design("x_quadcopter"), []

    def inside(p):
        bar = mesh.hex_box((2, 1, 1))
        grid = stokes.Grid((2, 2), 0.5)
        kept.extend(
            [
                bar,
                soft.Tendon(bar, [[0.1, 0.5, 0.5], [0.9, 0.5, 0.5]], axial_stiffness=1.0),
                soft.PressureChamber(mesh.surface_triangles(bar).faces),
                stokes.StokesFlow(grid, [stokes.Inlet("x-"), stokes.Open("x+")]),
            ]
        )
        return design.multicopter(p).mass

    # what other tests left: a second derivative that is refused ends within torch.func, too
    before = wrapped_tensors()
    torch.func.grad(inside)(design.values)
    assert not [o for o in wrapped_tensors() if not any(o is known for known in before)]
    assert kept[1].length(kept[0].x_rest) == pytest.approx(0.8)
