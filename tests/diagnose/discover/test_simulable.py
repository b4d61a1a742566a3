"""Laws that leave the range of numbers: the answer without them stands, and says so."""

import pytest

from diffsim.diagnose import diagnosis
from diffsim.identify.problem import PredictionError
from tests.diagnose.discover.answers import few_laws, found
from tests.diagnose.discover.pump_rig import recorded


@pytest.mark.story  # a whole diagnosis
def test_an_answer_stands_where_laws_cannot_be_simulated(monkeypatch):
    answer, asked = diagnosis._answer, []

    def fails_with_laws(question, model, effects, unknowns, *begins):
        asked.append([e.name for e in effects])
        if any(name.startswith("law_of") for name in asked[-1]):
            raise PredictionError("the prediction of run day_1 has 3 NaN entries")
        return answer(question, model, effects, unknowns, *begins)

    monkeypatch.setattr(diagnosis, "_answer", fails_with_laws)
    warm = lambda p_a, p_b, temperature: p_a + 1.5 * (temperature - 298.0)  # noqa: E731
    with few_laws():
        report = found(recorded(show=warm, uses=("fit", "fit", "select", "test")))
    assert len(asked) == 2 and report.verdict == "unknown"
    (gate,) = [g for g in report.gates if g.name == "laws_in_simulation"]
    assert not gate.passed and "none is told" in gate.note and "day_1" in gate.note
