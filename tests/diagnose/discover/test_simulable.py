"""A law that leaves the range of numbers is left out, and the answer stands."""

import numpy as np

from diffsim.diagnose.diagnosis import _simulable
from diffsim.diagnose.search.gauss_newton import gauss_newton
from diffsim.identify import Problem
from diffsim.identify.linearization import linearization_at
from diffsim.identify.whitening import WhiteNoise
from diffsim.systems.registry import setup_of
from tests.systems.toy_cart import cart_study, described


def rows(*laws):
    return [
        {"name": name, "adds_to": "v", "term": term, "typical": 1.0, "family": name}
        for name, term in laws
    ]


def test_an_exponential_that_overflows_at_size_zero_is_no_law():
    own = rows(("soft", "size*(exp(3*x) - 1)"), ("steep", "size*(exp(9e4*x) - 1)"))
    plain = setup_of(cart_study())
    setup = setup_of(cart_study(model=described(effects={"own": own})))
    study = plain.study or cart_study()
    problem = Problem(plain.model, study.fit_runs, WhiteNoise(study.channels))
    fit, _ = gauss_newton(problem, linearization_at(problem, np.zeros(problem.num_base)))
    assert _simulable(fit, setup, {"soft", "steep"}) == {"soft"}
