"""Laws that nobody listed, as the page shows them: pictures, formulas, what else was weighed.

Formulas are as readers see them: numbers put in, as text and as LaTeX.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import torch

from diffsim.core.arrays import Array, Mask
from diffsim.core.expression import Name, Node, NumberNode, parse_expression
from diffsim.core.figures import figure, unit_of, with_interval
from diffsim.core.optional import optional
from diffsim.data.study import Study
from diffsim.diagnose.discover.answer import PERIODS_SHOWN
from diffsim.diagnose.discover.stage import TABLE
from diffsim.diagnose.judge.records import HALF_LEVEL
from diffsim.diagnose.say.law_records import DescribedLaw, LawAnswer, LawCurve, Number, ScreenRow
from diffsim.diagnose.say.report import Report
from diffsim.diagnose.say.wording import opened
from diffsim.identify.law import SIZE, VALUE, Entry, Where
from diffsim.viz import charts
from diffsim.viz import report as page
from diffsim.viz.charts import EXTENDED
from diffsim.viz.figures import INK, LINE

MOST_ROWS = 15  # of the table of all that was weighed
NUM_FINE = 400  # points of a formula's line
#: one for each run, told apart without red and green
RUN_COLORS = ("#4477aa", "#ccbb44", "#aa3377", "#66ccee", "#228833", "#ee6677", "#777777")


def laws_section(r: Report) -> list[page.Section]:
    """What laws were found, and what was weighed for it; nothing where none were looked for."""
    if r.described is None:
        return []
    answer = r.described
    content: list[page.Item] = [*_pictures(r, answer)]
    content += [_law_table(r, law) for law in answer.laws]
    if answer.screen:
        content.append(_screen_table(answer))
    return [page.Section(title="Laws that nobody listed", text=_words(answer), content=content)]


def _words(answer: LawAnswer) -> list[str]:
    if answer.laws:
        return []  # the picture says it
    return ["No law of one variable stands: the library, or something unknown, does as well."]


def _pictures(r: Report, answer: LawAnswer) -> list[page.Chart]:
    """The missing term over its variable, once for each place and variable of the laws."""
    made: dict[tuple[str, str, tuple[str, ...]], page.Chart] = {}
    for law in answer.laws:
        curve = next((c for c in answer.curves if c.law == law.name), None)
        if curve is not None:
            made.setdefault(law.place, _picture(r, law, curve))
    return list(made.values())


def _picture(r: Report, law: DescribedLaw, curve: LawCurve) -> page.Chart:
    caption = (
        f"{opened(law.sentence)}. Dark line: the term as the fitted runs ask for it, before it has "
        "a form; grey: its 90 % band."
    )
    if curve.runs:
        caption += " Thin, a color each: what each run alone says of it, where it went."
    values = _values_of(r, law)
    if values is not None:
        caption += (
            " Colored: the formula, at the level of the line, since the model's own numbers take "
            "up what is constant."
        )
    kept = _seen_part(law, np.array(curve.u))
    return page.Chart(figure=law_over_variable(r.study, law, curve, values, kept), caption=caption)


def _seen_part(law: DescribedLaw, u: Array) -> Mask:
    """Points that are drawn: all, or a few periods in the middle."""
    number = law.numbers.get("wave_number")
    if number is None:
        return np.ones(len(u), dtype=bool)
    half = 0.5 * PERIODS_SHOWN * 2.0 * np.pi / abs(number.value)
    return np.abs(u - 0.5 * (u[0] + u[-1])) <= half


def law_over_variable(
    study: Study,
    law: DescribedLaw,
    curve: LawCurve,
    values: dict[str, float] | None,
    kept: Mask,
) -> Any:
    """A missing term over its variable, with its band and its formula.

    Args:
        study: Study that knows units.
        curve: The term before it has a form.
        values: Numbers of the formula by name; None: it is not drawn.
        kept: Points of the curve that are drawn.
    """
    u, middle, sd = (np.array(a)[kept] for a in (curve.u, curve.value, curve.sd))
    around = np.concatenate([u, u[::-1]])
    edge = np.concatenate([middle + HALF_LEVEL * sd, (middle - HALF_LEVEL * sd)[::-1]])
    look: dict[str, Any] = {
        "fill": "toself",
        "fillcolor": LINE,
        "line": {"width": 0},
        "hoverinfo": "skip",
    }
    drawn = [
        charts.line(around, edge, "90 % band", LINE, **look),
        *_run_lines(curve, float(u[0]), float(u[-1])),
        charts.line(u, middle, "as the runs ask for it", INK),
    ]
    if values is not None:
        color = {"color": EXTENDED, "width": 2.4, "dash": "dash"}
        fine = np.linspace(u[0], u[-1], NUM_FINE)
        formula = _level_with(law, _at(law, values, fine), _at(law, values, u), middle, sd)
        drawn.append(charts.line(fine, formula, "formula", EXTENDED, line=color))
    shown = charts.styled(charts.graph_objects().Figure(drawn), height=380)
    shown.update_xaxes(title_text=_with_unit(_value_of(law), _unit_in(study, _value_of(law))))
    shown.update_yaxes(title_text=_with_unit(_term_at(law.entry), curve.unit))
    return shown


def _run_lines(curve: LawCurve, low: float, high: float) -> list[Any]:
    """What each run alone says, within what is drawn."""
    out = []
    for k, run in enumerate(curve.runs):
        u, value = np.array(run.u), np.array(run.value)
        kept = (u >= low) & (u <= high)
        color = RUN_COLORS[k % len(RUN_COLORS)]
        thin = {"color": color, "width": 1.0}
        out.append(charts.line(u[kept], value[kept], run.run, color, line=thin))
    return out


def _level_with(law: DescribedLaw, formula: Array, at_u: Array, middle: Array, sd: Array) -> Array:
    """A formula where the term lies that it was made from.

    Both were fitted with numbers of their own. What is constant in a term may be theirs; of a
    change of a number, a factor may.
    """
    weight = 1.0 / np.maximum(sd, 1e-3 * sd.max() + 1e-300) ** 2
    if law.entry["kind"] == "number":
        factor = np.sum(weight * (1.0 + middle) * (1.0 + at_u)) / np.sum(weight * (1.0 + at_u) ** 2)
        return np.asarray(factor * (1.0 + formula) - 1.0)
    return np.asarray(formula + np.sum(weight * (middle - at_u)) / np.sum(weight))


def _values_of(r: Report, law: DescribedLaw) -> dict[str, float] | None:
    """Numbers of a formula at the best set; None where that is without the law."""
    names = [n for n in parse_expression(law.formula).names if n != VALUE]
    own = {n: law.name if n == SIZE else f"{n}_of_{law.name}" for n in names}
    values = r.best.values
    if not all(full in values for full in own.values()):
        return None
    return {short: float(values[full]) for short, full in own.items()}


def _at(law: DescribedLaw, values: dict[str, float], u: Array) -> Array:
    given = {name: torch.tensor(v, dtype=torch.float64) for name, v in values.items()}
    term = parse_expression(law.formula)({**given, VALUE: torch.from_numpy(u)})
    return np.asarray(term.expand(u.shape).numpy(), dtype=np.float64)


def _unit_in(study: Study, name: str) -> str:
    """SI unit of what a study names; nothing where it does not."""
    units = {c.name: c.unit for c in study.channels}
    units |= {c.name: c.unit or "" for c in study.commands}
    units |= {c.name: c.unit or "" for c in study.columns}
    return units.get(name, "")


def _value_of(law: DescribedLaw) -> str:
    """What the formula is of, in words: a variable, or what a hidden state keeps of it."""
    return f"{law.memory} of {law.variables[0]}" if law.memory else law.variables[0]


def _with_unit(words: str, unit: str) -> str:
    return f"{words} [{unit}]" if unit_of(unit) else words


def _enters(entry: dict[str, str]) -> str:
    return Entry(cast(Where, entry["kind"]), entry["target"], "-", 0.0).words


def _term_at(entry: dict[str, str]) -> str:
    return (
        f"change of {entry['target']}, as a share" if entry["kind"] == "number" else _enters(entry)
    )


def _law_table(r: Report, law: DescribedLaw) -> page.Table:
    """A law with its formula and numbers, a row each."""
    rows = [
        ["in words", law.sentence],
        ["where it enters", _enters(law.entry)],
        ["on what it depends", ", ".join(law.variables)],
        ["form", law.form],
        *([] if law.form == TABLE else _formula_rows(r, law)),
        *([name.replace("_", " "), _number(n)] for name, n in law.numbers.items()),
        ["looks like", " or ".join(law.looks_like) or "–"],
        ["how sure", law.status],
    ]
    if law.memory:
        rows.insert(3, ["hidden state", law.memory])
    caption = "Numbers in SI units with 90 % intervals. The saved model holds the law in full."
    return page.Table(columns=[law.name.replace("_", " "), ""], rows=rows, caption=caption)


def _factor_of(law: DescribedLaw) -> str:
    return f", all of it times {law.variables[1]}" if len(law.variables) > 1 else ""


def _formula_rows(r: Report, law: DescribedLaw) -> list[list[str]]:
    """The formula, and with its numbers, as text and as LaTeX."""
    formula = ["formula", f"{law.formula}, {VALUE} being {_value_of(law)}{_factor_of(law)}"]
    values = _values_of(r, law)
    written = values and write_formula(law.formula, values, {VALUE: _value_of(law)})
    if not written:
        return [formula]
    return [formula, ["with its numbers", written.text], ["as LaTeX", written.latex]]


def _number(number: Number) -> str:
    interval = with_interval(number.value, number.low, number.high)
    return f"{interval} {unit_of(number.unit)}".rstrip()


def _screen_table(answer: LawAnswer) -> page.Table:
    """What laws of all variables would explain at all places, before they have a form."""
    shown = answer.screen[:MOST_ROWS]
    places = [(s.kind, s.target, (s.of or s.variable,), s.memory) for s in shown]
    found = {(*law.place, law.memory or "") for law in answer.laws}
    return page.Table(
        columns=[
            "where it enters",
            "on what it depends",
            "taken from the misfit of runs left out [%]",
            "nats over none",
            "wave number [1/SI unit]",
        ],
        rows=[_screen_row(row) for row in shown],
        caption=f"The best {len(shown)} of {answer.num_tried} laws without a form, smooth or "
        "periodic, by evidence and by runs left out. The choice among them has its price. In bold: "
        "laws of the answer.",
        emphasis=[i for i, place in enumerate(places) if place in found],
        folded=range(len(shown)),
        folded_words=f"{len(shown)} laws that were weighed, by evidence",
    )


def _screen_row(row: ScreenRow) -> list[str]:
    return [
        _enters({"kind": row.kind, "target": row.target}),
        row.variable,
        f"{100.0 * row.share:.0f}",
        figure(row.nats),
        figure(row.wave_number) if row.wave_number else "–",
    ]


DIGITS = 4  # of numbers in a formula; files have all of them
_ARITHMETIC: dict[str, Callable[..., Any]] = {
    "add": operator.add,
    "sub": operator.sub,
    "mul": operator.mul,
    "div": operator.truediv,
    "pow": operator.pow,
    "neg": operator.neg,
}
_CALLED = {"abs": "Abs", "min": "Min", "max": "Max"}  # where sympy has another name


@dataclass(frozen=True)
class WrittenFormula:
    """A formula with its numbers put in."""

    text: str  # as text
    latex: str  # as LaTeX


def write_formula(
    formula: str, values: Mapping[str, float], words: Mapping[str, str]
) -> WrittenFormula | None:
    """A formula with numbers in place of some names, and other names in words.

    Args:
        formula: Such as ``"size*sin(k*u)"``.
        words: What other names are called, such as "heat of current^2".

    Returns:
        None where sympy is not installed, or has no word for an operation.
    """
    try:
        sympy = optional("sympy", purpose="formulas as LaTeX")
    except ImportError:
        return None
    symbols = {name: sympy.Symbol(_in_brackets(text)) for name, text in words.items()}
    known = {**symbols, **{name: sympy.Float(v, DIGITS) for name, v in values.items()}}
    made = _build(sympy, parse_expression(formula).root, known)
    if made is None:
        return None
    upright = {symbols[name]: _upright(text) for name, text in words.items()}
    text = str(made)
    for name, called in _CALLED.items():
        text = text.replace(f"{called}(", f"{name}(")
    return WrittenFormula(text, sympy.latex(made, symbol_names=upright))


def _build(sympy: Any, node: Node, known: Mapping[str, Any]) -> Any | None:
    if isinstance(node, NumberNode):
        is_whole = node.value.is_integer()
        return sympy.Integer(int(node.value)) if is_whole else sympy.Float(node.value, DIGITS)
    if isinstance(node, Name):
        return known.get(node.name, sympy.Symbol(node.name))
    parts = [_build(sympy, part, known) for part in node.parts]
    name = _CALLED.get(node.operation, node.operation)
    join = _ARITHMETIC.get(node.operation) or getattr(sympy, name, None)
    return None if join is None or None in parts else join(*parts)


def _in_brackets(words: str) -> str:
    return words if words.isidentifier() else f"({words})"


def _upright(words: str) -> str:
    escaped = words.replace("_", r"\_").replace(" ", r"\ ")
    return rf"\mathrm{{{escaped}}}"
