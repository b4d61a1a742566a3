"""A rubber stop that is hardly stiffer than the spring beside it."""

import numpy as np

from diffsim.identify import fit
from diffsim.systems.registry import setup_of
from tests.systems.toy_cart import cart_study

RUBBER, AT, LOSS = 60.0, -0.05, 0.3  # N/m, m, s/m: the cart's spring has 41 N/m


def test_a_stop_of_rubber_leaves_noise():
    """Stops had to be harder: where forces have no scale, masses doubled to make up for that."""
    study = cart_study(force=lambda x, v: RUBBER * max(AT - x, 0.0) * (1.0 - np.tanh(LOSS * v)))
    setup = setup_of(study)
    (stop,) = (e for e in setup.effects if e.name == "stop_below")
    start = np.zeros(len(setup.model.base) + 1)
    start[-1] = 0.7
    found = fit(setup.model, study.fit_runs, study.channels, effects=[stop], start=start)
    assert found.chi2 < 1.1 * found.num_samples
    assert abs(found.values["k"] / 41.0 - 1.0) < 0.02
    *words, at, unit = stop.words(found.values["stop_below"]).partition(",")[0].split()
    assert (words, unit) == (["stop", "below"], "m") and abs(float(at) - AT) < 2e-3
