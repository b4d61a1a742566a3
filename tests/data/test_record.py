"""Faults of a record are named, with the keys that mend them, before any physics is asked."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
import yaml

from diffsim.cli.main import main
from diffsim.data.codes import unfolded
from diffsim.data.record.columns import find_copies, find_unit_changes, find_units
from diffsim.data.record.encodings import find_codes, find_folded, find_signs, find_wraps
from diffsim.data.record.shapes import _flat_at, find_far, find_flat, find_frozen, find_lasting
from diffsim.data.record.signals import Record, Samples, Signal
from diffsim.data.study import Channel, Run, Study
from diffsim.data.study_check import check_study
from diffsim.data.study_file import load_study
from labs.records import blame
from labs.records.__main__ import told
from labs.records.damages import DAMAGES, damaged
from labs.records.rigs import ALIKE, SOUND, joint, pendulum, servo, servo_at_zero


@pytest.mark.parametrize("damage", DAMAGES, ids=lambda d: d.name)
def test_a_damaged_copy_is_named_with_its_remedy(damage, tmp_path):
    _, folder = damaged(np.random.default_rng(7), damage)
    said = told(folder, tmp_path / "rig")
    assert [text for _, text, _ in said if re.search(damage.remedy, text)], said


@pytest.mark.parametrize("make", (*SOUND, *ALIKE), ids=lambda m: getattr(m, "__name__", "rig"))
def test_a_sound_record_is_not_accused(make, tmp_path):
    assert told(make(np.random.default_rng(11)), tmp_path / "rig") == []


@pytest.mark.parametrize(
    ("step", "unit", "is_unit"),
    [(0.00879, "rad/s", False), (1e-6, "rad/s", True), (1e-6, "N m", False)],
)
def test_a_sensor_whose_step_stays_is_in_no_other_unit(step, unit, is_unit):
    """A swing-up that failed: rates and their scatter were a fiftieth of those of other runs."""
    rng, time = np.random.default_rng(5), 0.005 * np.arange(1000.0)

    def rate(run: str, size: float, sd: float) -> Samples:
        values = size * np.sin(3.0 * time) + rng.normal(0.0, sd, len(time))
        return Samples(run, np.arange(1000), time, step * np.round(values / step))

    scatter = {"a": 0.3, "b": 0.15, "c": 0.01, "d": 0.9}
    runs = [rate(run, 3.0, sd) for run, sd in scatter.items()]
    seen = Signal("rate", "channel", "rate", unit, (*runs, rate("e", 0.052, 0.004)))
    found = list(find_units(Record(Study("rig", "ode", (), ()), (seen,), ())))
    assert [f.where for f in found] == (["run e"] if is_unit else [])


def mended(folder, tmp_path, **channel):
    """First channel of a study whose first channel has further keys, by run, and the study."""
    entries = [{**folder.study["channels"][0], **channel}, *folder.study["channels"][1:]]
    study = load_study(folder.changed(folder.tables, channels=entries).write(tmp_path / "rig"))
    return {run.name: run.measured[:, 0] for run in study.runs}, study


@pytest.mark.parametrize(
    ("make", "code", "decode"),
    [
        (servo_at_zero, lambda x: np.where(x < 0, 2.0**15 - x, x), {"sign_bit": 15}),
        (servo_at_zero, lambda x: np.mod(x, 2.0**16), {"signed": 16}),
        (servo, lambda x: np.mod(x, 2048.0), {"wrap": 2048}),
        (joint, lambda x: np.where(np.arange(len(x)) % 9 == 3, -999.0, x), {"missing": -999}),
    ],
)
def test_what_a_column_is_coded_by_is_undone_and_told(make, code, decode, tmp_path):
    sound = make(np.random.default_rng(3))
    column = sound.study["channels"][0]["column"]
    tables = {r: {**t, column: code(t[column])} for r, t in sound.tables.items()}
    values, study = mended(sound.changed(tables), tmp_path, decode=decode)
    for run, seen in values.items():
        unit = np.pi / 180.0 if column.endswith("deg") else 1.0
        true = unit * np.round(sound.tables[run][column], 10)
        off = seen - true
        good = np.isfinite(off)
        turns = np.round(off[good][0] / 2048.0) * 2048.0 if "wrap" in decode else 0.0
        assert good.mean() > 0.85
        np.testing.assert_allclose(off[good], turns, atol=2e-3)
    assert study.mended and next(iter(decode)).split("_")[0] in str(decode)
    assert not [p for p in check_study(study) if p.severity == "error"]


def test_repeats_of_a_slow_sensor_are_left_out(tmp_path):
    damage = next(d for d in DAMAGES if d.name == "slow_sensor")
    _, copy = damaged(np.random.default_rng(4), damage)
    (said,) = {found[1] for found in told(copy, tmp_path / "copy") if "repeats: drop" in found[1]}
    rate = float(re.search(r"one of ([\d.]+) rows", said)[1])
    for entry in copy.study["channels"]:
        entry["decode"] = {"repeats": "drop"}
    study = load_study(copy.write(tmp_path / "mended"))
    kept = np.mean([np.isfinite(run.measured).mean(0) for run in study.runs], axis=0)
    assert min(kept) == pytest.approx(1.0 / rate, rel=0.05)
    assert not [p for p in check_study(study) if "repeats: drop" in str(p)]


@pytest.mark.parametrize(("together", "stops"), [(2, False), (4, True)])
def test_far_values_stop_where_the_diagnosis_would_not_leave_them_out(tmp_path, together, stops):
    sound = joint(np.random.default_rng(8))
    x = sound.tables["e"]["angle_deg"].copy()
    x[200 : 200 + together] += 900.0
    tables = {**sound.tables, "e": {**sound.tables["e"], "angle_deg": x}}
    found = told(sound.changed(tables), tmp_path / "rig")
    assert ("far", stops) in [(rule, is_stop) for rule, _, is_stop in found], found


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_range_of_a_flat_top_is_in_si_units_where_signs_are_turned(tmp_path, sign):
    sound = joint(np.random.default_rng(8))
    column = sound.study["channels"][0]["column"]
    high = 0.7 * max(t[column].max() for t in sound.tables.values())
    tables = {r: {**t, column: np.minimum(t[column], high)} for r, t in sound.tables.items()}
    first, *rest = sound.study["channels"]
    turned = [{**first, "scale": sign * first.get("scale", 1.0)}, *rest]
    (said,) = (t for rule, t, _ in told(sound.changed(tables, channels=turned), tmp_path / "rig")
               if rule == "flat")  # fmt: skip
    low, top = (float(end) for end in re.search(r": \[(\S+), (\S+)\]", said).groups())
    end = sign * np.deg2rad(high)
    assert (low, top) == pytest.approx((-1e9, end) if sign > 0.0 else (end, 1e9), rel=1e-4)


@pytest.mark.parametrize(("longest", "is_flat"), [(7, False), (8, True)])
def test_a_flat_top_of_one_stretch_has_eight_samples(longest, is_flat):
    rng, time = np.random.default_rng(6), 0.01 * np.arange(300.0)
    values = 0.9 * np.sin(4.0 * time) + rng.normal(0.0, 0.01, len(time))
    values[100 : 100 + longest] = values[[20, 200]] = 1.5
    seen = Signal("q", "channel", "q", "m", (Samples("a", np.arange(300), time, values),))
    assert (_flat_at(seen, 1.5) is not None) is is_flat


@pytest.mark.parametrize("levels", [(-255.0, 0.0, 255.0), (0.0, 255.0), (0.0, 100.0, 255.0)])
@pytest.mark.parametrize("seed", range(2))
def test_a_level_of_a_switch_is_no_code(levels, seed):
    """A pulsed bridge: 255 was "a number for nothing measured" in 2 % of a record."""
    rng, time = np.random.default_rng(seed), 0.01 * np.arange(2000.0)
    values = np.zeros(len(time))
    values[600:760] = np.repeat(rng.choice(levels, 40), 4)
    seen = Signal("u", "command", "u", None, (Samples("a", np.arange(2000), time, values),))
    assert not list(find_codes(Record(Study("rig", "ode", (), ()), (), (seen,))))
    swept = values + np.where(values < 250.0, rng.normal(0.0, 5.0, len(time)), 0.0)
    swept = Signal("u", "command", "u", None, (Samples("a", np.arange(2000), time, swept),))
    found = list(find_codes(Record(Study("rig", "ode", (), ()), (), (swept,))))
    assert len(found) == (levels[0] == 0.0)  # beyond all others alone


@pytest.mark.parametrize("role", ["channel", "command"])
@pytest.mark.parametrize("closed", [0.1, 0.45])
def test_a_valve_that_is_read_is_no_missing_value(role, closed):
    """Closed in 45 % of a record it was a number for nothing measured."""
    rng, rows = np.random.default_rng(3), np.arange(2000)
    values = np.repeat((rng.random(200) > closed).astype(float), 10)
    seen = Signal("in1", role, "in1", None, (Samples("a", rows, 0.01 * rows, values),))
    told = list(find_codes(Record(Study("rig", "ode", (), ()), (), (seen,))))
    assert bool(told) is (role == "channel" and closed < 0.2)  # a sensor may fail so often


@pytest.mark.parametrize("code", [-9999.0, 65535.0, -32768.0])
@pytest.mark.parametrize("levels", [(0.0, 1.0), (-1.0, 0.0, 1.0)])
def test_a_switch_has_codes_of_nothing_measured_too(code, levels):
    values = np.repeat(np.random.default_rng(0).choice(levels, 200), 10)
    values[[300, 301, 700, 1200]] = code
    rows = np.arange(2000)
    seen = Signal("u", "command", "u", None, (Samples("a", rows, 0.01 * rows, values),))
    (found,) = find_codes(Record(Study("rig", "ode", (), ()), (), (seen,)))
    assert f"column u is {code:g} in 4 samples" in found.says


@pytest.mark.parametrize(
    ("goal", "since", "is_flat"), [(-0.6, 0, False), (1.4, 0, True), (-0.6, 46, True)]
)
def test_a_servo_that_rests_at_its_goal_shows_more(goal, since, is_flat):
    """It rested within one count of a goal that no other run went to: "it shows no more"."""
    time, rng = 0.02 * np.arange(50.0), np.random.default_rng(3)
    rest = np.where(rng.uniform(size=26) > 0.3, -0.6, -0.5995)
    rest[8:16] = -0.6
    stops = Samples("a", np.arange(50), time, np.append(np.linspace(0.0, -0.59, 24), rest))
    wave = 0.3 * np.sin(9.0 * time)
    moves = Samples("b", np.arange(50), time, wave)
    seen = Signal("angle", "channel", "angle", "rad", (stops, moves))
    rows = np.arange(50)[since:]  # before that, nothing was asked
    told = [Samples("a", rows, time[since:], np.full(len(rows), goal))]
    told += [Samples("b", np.arange(50), time, -np.sign(np.cos(40.0 * time)))]
    asked = Signal("u", "command", "u", "rad", tuple(told))
    u = {c.run: np.full(50, np.nan) for c in told}
    for c in told:
        u[c.run][c.at] = c.values
    run = [Run(s.run, time, s.values[:, None], {"u": u[s.run]}, s.run) for s in seen.runs]
    study = Study("rig", "ode", (Channel("angle", "rad", "angle", 0.001),), run)
    assert bool(list(find_flat(Record(study, (seen,), (asked,))))) is is_flat


def test_a_folded_angle_gets_its_sign_back(tmp_path):
    sound = pendulum(np.random.default_rng(5))
    true = sound.tables["a"]["angle_rad"]
    found = unfolded(np.abs(true))
    moves = np.abs(true) > 0.1 * np.abs(true).max()
    same = np.sign(found[moves]) == np.sign(true[moves])
    assert max(same.mean(), 1.0 - same.mean()) > 0.95


STAMPS = {
    "equal": ({"duplicates": "first"}, lambda t: np.insert(t, 5, t[4])),
    "spread": ({"duplicates": "spread"}, lambda t: 0.05 * np.floor(t / 0.05 + 1e-9)),
    "missing": (
        {"stamps": {"missing": "line"}},
        lambda t: np.where(np.arange(len(t)) == 7, np.nan, t),
    ),
    "set": ({"stamps": {"jumps": "close"}}, lambda t: t - 3600.0 * (np.arange(len(t)) > 60)),
    "on": ({"stamps": {"jumps": "close"}}, lambda t: t + 3600.0 * (np.arange(len(t)) > 60)),
}


@pytest.mark.parametrize("name", STAMPS)
def test_stamps_are_mended_as_stated(name, tmp_path):
    keys, change = STAMPS[name]
    t = 0.01 * np.arange(120)
    stamps = change(t)
    x = np.sin(9.0 * np.interp(np.arange(len(stamps)), np.arange(len(t)), t))
    lines = ["time_s,x"] + [
        f"{'' if np.isnan(s) else f'{s:.6f}'},{v:.9f}" for s, v in zip(stamps, x, strict=True)
    ]
    for run in "ab":
        (tmp_path / f"{run}.csv").write_text("\n".join(lines) + "\n")
    study = {"name": "s", "system": "soft_body", "runs": [{"name": "a"}, {"name": "b"}]}
    study["channels"] = [{"name": "x", "unit": "m", "sd": 1e-3}]
    (tmp_path / "study.yaml").write_text(yaml.safe_dump({**study, "defaults": keys}))
    read = load_study(tmp_path).runs[0].time_s
    assert len(read) == 120
    np.testing.assert_allclose(read, t, atol=1e-5)
    if name != "on":  # forward it is found by the rules, for which this study is too poor
        (tmp_path / "study.yaml").write_text(yaml.safe_dump(study))
        with pytest.raises(ValueError, match=next(iter(keys))):
            load_study(tmp_path)


@pytest.mark.parametrize(
    ("column", "change", "remedy"),
    [
        ("present_counts", lambda x: np.mod(x, 2048.0), "`decode: {wrap: 2048}`"),
        ("time_s", STAMPS["missing"][1], "`stamps: {missing: line}`"),
        ("time_s", lambda t: np.where(np.arange(len(t)) == 9, t[8], t), "`duplicates: first`"),
        ("time_s", lambda t: t[[*range(7), 8, 7, *range(9, len(t))]], "{backward: sort}"),
    ],
    ids=["wrapped", "missing", "equal", "reversed"],
)
def test_a_fault_of_the_record_stops_before_physics(
    tmp_path, capsys, monkeypatch, column, change, remedy
):
    monkeypatch.chdir(tmp_path)
    sound = servo(np.random.default_rng(1))
    tables = {run: {**t, column: change(t[column])} for run, t in sound.tables.items()}
    folder = str(sound.changed(tables).write(tmp_path / "rig"))
    assert main(["diagnose", "explain", folder]) == 0
    first, second, *_ = capsys.readouterr().out.splitlines()
    assert first.startswith("The record is at fault") and remedy in first
    assert second == "verdict: record"
    told = json.loads(next(tmp_path.rglob("report.json")).read_text())
    *others, way = told["sentences"]
    assert told["faults"][0]["message"] in told["headline"] and "--accept-record" in way
    assert len(others) == len(told["faults"]) - 1
    assert all(f["message"] in said for f, said in zip(told["faults"][1:], others, strict=True))
    for step in ("check", "fit"):
        assert main(["diagnose", step, folder]) == 2
        assert "--accept-record" in capsys.readouterr().err
    assert main(["diagnose", "check", folder, "--accept-record"]) == 0
    said = capsys.readouterr().out
    assert "ready for a diagnosis" in said and remedy in said
    assert ("done to the record: rows whose stamps" in said) == (column == "time_s")


def test_first_answers_of_damaged_copies_are_counted_and_kept(tmp_path, capsys):
    call = ["--seed", "3", "--num", "4", "--only", "3/4", "--out", str(tmp_path)]
    assert blame.main(call) == 0
    said = capsys.readouterr().out
    assert "read_unsigned on servo_at_zero: record () The record is at fault" in said
    assert "seed 3: of 1 damaged copies 1 record" in said
    assert [p.stem for p in tmp_path.glob("*.json")] == ["3_0002"]
    with pytest.raises(SystemExit):
        blame.main(["--only", "5/4", "--out", str(tmp_path)])


@pytest.mark.parametrize("is_stuck", [True, False])
def test_a_sensor_that_comes_free_is_no_marker_that_slipped(is_stuck):
    """A carriage was at its goal while its encoder still showed the place before: the leap at the
    end was taken for a slip, and moving it back would have spoiled what follows."""
    rng, time = np.random.default_rng(3), 0.02 * np.arange(240.0)
    goal = np.where(time < 1.4, 0.2, np.where(time < 3.0, 0.1, 0.25))
    shown = np.where(time < 1.4, 0.2, np.where(time < 1.55, 0.2, 0.1))  # it takes 0.15 s
    shown = np.where(time < 3.0, shown, 0.25 - 0.15 * np.exp(-(time - 3.0) / 0.2))
    shown = shown + rng.normal(0.0, 2e-4, len(time))
    if is_stuck:
        shown[68:86] = shown[68]
    else:
        shown[70:86] = 0.2 - 0.1 * (1.0 - np.exp(-(time[70:86] - 1.4) / 0.05))
        shown[120:] += 0.04  # a slip while nothing was asked for
    index = np.arange(len(time))
    signals = [
        Signal(name, role, name, "m", (Samples("job", index, time, values),))
        for name, role, values in (("x", "channel", shown), ("goal", "command", goal))
    ]
    record = Record(Study("rig", "ode", (), ()), tuple(signals[:1]), tuple(signals[1:]))
    told = [f.says for find in (find_frozen, find_lasting) for f in find(record)]
    assert len(told) == 1
    assert ("stands still from 1.36 to 1.7 s" in told[0]) is is_stuck
    assert ("jumps by 0.04" in told[0]) is not is_stuck


def test_the_remedy_of_a_sensor_that_stood_still_ends_the_finding(tmp_path):
    """It was found again in the file's own column, as an error that nothing could mend."""
    damage = next(d for d in DAMAGES if d.name == "frozen")
    _, copy = damaged(np.random.default_rng(7), damage)
    path = copy.write(tmp_path / "copy") / "study.yaml"
    found = [p for p in check_study(load_study(path)) if "missing_if" in p.message]
    assert found
    study = yaml.safe_load(path.read_text())
    for p in found:
        formula = re.search(r"`missing_if: (.+?)`", p.message)[1]
        (run,) = [r for r in study["runs"] if p.where == f"run {r['name']}"]
        run["missing_if"] = formula
    path.write_text(yaml.safe_dump(study))
    assert not [p for p in check_study(load_study(path)) if "missing_if" in p.message]


def test_what_was_left_out_between_two_ends_is_no_wrap():
    """A servo that answers in one sample of ten seemed to count modulo 1024."""
    index = np.arange(200)
    values = np.mod(900.0 + 3.0 * index, 1024.0)
    whole = Signal("x", "channel", "x", "-", (Samples("a", index, 0.1 * index, values),))
    kept = (index < 41) | (index > 42)  # the turn is among what is left out
    cut = Samples("a", index[kept], 0.1 * index[kept], values[kept])
    alone = Samples("b", index[:1], 0.1 * index[:1], values[:1])  # of a run of one sample
    signals = (whole, replace(whole, runs=(cut, alone)))
    record = Record(Study("rig", "ode", (), ()), signals, ())
    assert [f.says.split(":")[0] for f in find_wraps(record)] == ["column x counts modulo 1024"]


def test_what_leaps_from_the_end_of_its_way_is_still_told():
    """A rest at the lowest reading is no sensor that was stuck, and its leap is a slip."""
    rng, time = np.random.default_rng(0), 0.02 * np.arange(400.0)
    goal = np.where(time < 2.0, 0.2, 0.1)
    shown = np.where(time < 2.0, 0.2, 0.1 + 0.1 * np.exp(-(time - 2.0) / 0.1))
    shown = shown + rng.normal(0.0, 2e-4, len(time))
    shown[150:300] = shown.min() - 1e-4
    shown[300:] += 0.04
    index = np.arange(len(time))
    signals = [
        Signal(name, role, name, "m", (Samples("job", index, time, values),))
        for name, role, values in (("x", "channel", shown), ("goal", "command", goal))
    ]
    record = Record(Study("rig", "ode", (), ()), tuple(signals[:1]), tuple(signals[1:]))
    (told,) = [f.says for find in (find_frozen, find_lasting) for f in find(record)]
    assert "jumps by 0.04" in told


def runs_of(*values: np.ndarray) -> tuple[Samples, ...]:
    """Runs "0", "1", .. at 0.1 s."""
    rows = [np.arange(len(x)) for x in values]
    return tuple(
        Samples(str(i), k, 0.1 * k, x) for i, (k, x) in enumerate(zip(rows, values, strict=True))
    )


@pytest.mark.parametrize("rest", [0, 300])
def test_what_rests_most_of_the_time_moves_within_its_range(rest):
    """A servo's speed in counts: "far outside of all other values in 115 samples", left out."""
    rng = np.random.default_rng(4)
    moves = [np.concatenate([np.zeros(15 + rest // 20), 50.0 * rng.integers(1, 9, 4)])
             for _ in range(20)]  # fmt: skip
    values = np.concatenate(moves)
    seen = Signal("speed", "channel", "speed", None, runs_of(values))
    assert not list(find_far(Record(Study("rig", "ode", (), ()), (seen,), ())))
    values[[100, 101]] = 32767.0
    seen = Signal("speed", "channel", "speed", None, runs_of(values))
    (found,) = find_far(Record(Study("rig", "ode", (), ()), (seen,), ()))
    assert "in 2 samples" in found.says


@pytest.mark.parametrize(("before", "is_flat"), [(0, False), (20, True)])
def test_a_car_that_starts_from_rest_can_show_less(before, is_flat):
    """Speeds of 0 at the start of every run were the end of the sensor's range."""
    rng = np.random.default_rng(2)
    ahead = 1.0 + 0.1 * rng.normal(size=before)
    runs = [np.concatenate([ahead, np.zeros(9), 0.3 + 0.1 * np.arange(60.0)
            + 0.02 * rng.normal(size=60)]) for _ in range(3)]  # fmt: skip
    seen = Signal("speed", "channel", "speed", "m/s", runs_of(*runs))
    assert (_flat_at(seen, 0.0) is not None) is is_flat


def test_a_sign_that_a_bit_holds_was_not_lost_as_well():
    true = np.round(90.0 * np.sin(0.11 * np.arange(600.0)))
    words = np.where(true < 0.0, 128.0 - true, true)
    seen = Signal("load", "channel", "load", None, runs_of(words))
    asked = Signal("u", "command", "u", None, runs_of(true))
    record = Record(Study("rig", "ode", (), ()), (seen,), (asked,))
    assert len(list(find_signs(record))) == 1 and not list(find_folded(record))
    lost = Signal("load", "channel", "load", None, runs_of(np.abs(true)))
    assert list(find_folded(Record(record.study, (lost,), (asked,))))


def take_off(seed: int, size: float = 1.0) -> dict[str, np.ndarray]:
    """A vehicle that idles for 3 s, hovers to 5.5 s and flies away; positions to 0.1 mm."""
    rng, t = np.random.default_rng(seed), 0.02 * np.arange(500.0)
    hover, away = np.clip(t - 3.0, 0.0, None), np.clip(t - 5.5, 0.0, None)
    x = 0.01 * size * np.sin(2.0 * hover) ** 2 + size * away * np.sin(3.0 * away)
    z = 0.5 * np.tanh(hover) ** 2
    noise = 3e-5 * rng.normal(size=(3, len(t)))
    v = np.gradient(x, t) + 100.0 * noise[2] * (1.0 + 2.0 * (away > 0.0))
    x, z = (
        1e-4 * np.round(1e4 * (p + n * (hover > 0.0))) for p, n in ((x, noise[0]), (z, noise[1]))
    )
    motor = np.where(t < 2.8, 0.05, 0.6 + 0.01 * rng.normal(size=len(t)))
    return {"x": x, "z": z, "v": v, "motor": motor}


def of_flights(*flights: dict[str, np.ndarray]) -> Record:
    """A record of flights."""
    units = {"x": "m", "z": "m", "v": "m/s", "motor": None}
    seen = {
        name: Signal(name, "command" if name == "motor" else "channel", name, unit,
                     runs_of(*(f[name] for f in flights)))
        for name, unit in units.items()
    }  # fmt: skip
    motor = seen.pop("motor")
    return Record(Study("rig", "ode", (), ()), tuple(seen.values()), (motor,))


def test_a_vehicle_that_takes_off_was_not_stuck_on_the_ground():
    flights = [take_off(seed) for seed in range(4)]
    assert not list(find_frozen(of_flights(*flights)))
    stuck = {name: values[160:].copy() for name, values in flights[0].items()}
    stuck["x"][170:240] = stuck["x"][170]
    assert [f.where for f in find_frozen(of_flights(stuck, *flights[1:]))] == ["run 0"]


def test_a_short_stop_beside_a_command_that_always_moves_is_told():
    """In 8 rows it hardly moves before the last five of them: 11 of 20 were not told."""
    found, t = 0, 0.02 * np.arange(600.0)
    for seed in range(10):
        rng = np.random.default_rng(seed)
        rate = 2.0 + 2.0 * rng.uniform()
        values = np.sin(rate * t - 0.3) + 2e-3 * rng.normal(size=600)
        first = int(rng.integers(100, 500))
        values[first : first + 8] = values[first]
        seen = Signal("x", "channel", "x", "m", runs_of(values))
        asked = Signal("u", "command", "u", "V", runs_of(np.sin(rate * t)))
        found += len(list(find_frozen(Record(Study("rig", "ode", (), ()), (seen,), (asked,)))))
    assert found >= 9


@pytest.mark.parametrize("is_unit", [False, True])
def test_a_flight_along_the_other_axis_is_in_no_other_unit(is_unit):
    """Another unit changes one column; another course changes what is beside it as well."""
    flights = [take_off(seed, 1.0 + 0.1 * seed) for seed in range(4)]
    along = {**take_off(3), "x": flights[3]["x"] / 25.4}
    if not is_unit:
        along["v"] = flights[3]["v"] / 9.0
    found = list(find_units(of_flights(*flights[:3], along)))
    assert [f.where for f in found] == (["run 3"] if is_unit else [])


@pytest.mark.parametrize("more", [1.0, 5.0])
def test_a_unit_that_changes_changes_one_column(more):
    """75 real flights: "its unit changes there, by 25.4 (inches)", where a vehicle flew away."""
    rng = np.random.default_rng(1)
    later = np.arange(400) >= 200
    x = 0.001 * rng.normal(size=400) * np.where(later, 25.4, 1.0)
    v = rng.normal(size=400) * np.where(later, more, 1.0)
    flight = {"x": x, "z": rng.normal(size=400), "v": v, "motor": rng.normal(size=400)}
    assert bool(list(find_unit_changes(of_flights(flight)))) is (more == 1.0)


def test_one_of_twelve_channels_beside_hides_no_change_of_unit():
    """Of few samples one of them scatters twice as much by chance: 29 of 40 were not told."""
    found, t, later = 0, 0.02 * np.arange(600.0), np.arange(600) >= 300
    for seed in range(10):
        noise = 1e-3 * np.random.default_rng(seed).normal(size=(13, 600))
        courses = [np.sin((1.0 + 0.3 * k) * t + k) + noise[k] for k in range(12)]
        courses.append((0.5 + 0.1 * np.sin(2.0 * t) + noise[12]) * np.where(later, 25.4, 1.0))
        seen = [Signal(f"x{k}", "channel", f"x{k}", "m", runs_of(x)) for k, x in enumerate(courses)]
        asked = Signal("u", "command", "u", "V", runs_of(np.sin(3.0 * t)))
        changes = find_unit_changes(Record(Study("rig", "ode", (), ()), tuple(seen), (asked,)))
        found += any("x12 is 25.4 times" in change.says for change in changes)
    assert found >= 9


def test_a_warmth_that_is_another_in_each_run_hides_no_unit():
    """What beside a channel differs anyway tells nothing of one run."""
    rng, t = np.random.default_rng(0), 0.02 * np.arange(500.0)
    moves = [np.sin(2.0 * t) + 1e-3 * rng.normal(size=500) for _ in range(5)]
    moves[4] *= 25.4
    warmth = [20.0 + size * np.sin(0.3 * t) for size in (1.0, 1.0, 9.0, 9.0, 12.0)]
    seen = Signal("x", "channel", "x", "m", runs_of(*moves))
    warm = Signal("warmth", "channel", "warmth", "K", runs_of(*warmth))
    (unit,) = find_units(Record(Study("rig", "ode", (), ()), (seen, warm), ()))
    assert unit.where == "run 4" and "channel x" in unit.says


@pytest.mark.parametrize("is_peak", [True, False])
def test_a_peak_reaches_far_through_what_lies_between(is_peak):
    """Rates of a servo that reverses: "far outside of all other values in 38 samples"."""
    rng = np.random.default_rng(6)
    values = rng.normal(size=2000)
    for k in range(100, 2000, 100):
        top = 8.0 + 4.0 * rng.uniform()
        values[k : k + 3] = (0.8 * top, top, 0.7 * top) if is_peak else 3.0 * top
    seen = Signal("rate", "channel", "rate", "rad/s", runs_of(values))
    assert bool(list(find_far(Record(Study("rig", "ode", (), ()), (seen,), ())))) is not is_peak


def test_peaks_on_one_side_hide_nothing_on_the_other():
    """Three dropouts below, among peaks above."""
    rng = np.random.default_rng(6)
    values = rng.normal(size=2000)
    for k in range(100, 2000, 100):
        values[k : k + 3] = np.array([0.8, 1.0, 0.7]) * (8.0 + 4.0 * rng.uniform())
    values[[555, 1222, 1777]] = -60.0
    seen = Signal("rate", "channel", "rate", "rad/s", runs_of(values))
    (found,) = find_far(Record(Study("rig", "ode", (), ()), (seen,), ()))
    assert "in 3 samples" in found.says


def test_a_copy_is_told_once_and_with_the_constant_that_it_adds():
    """Four motors that a log derives of one were six sentences, which called them equal."""
    index, course = np.arange(300), 36000.0 + 3000.0 * np.sin(0.05 * np.arange(300.0))
    signals = [
        Signal(f"m{k}", "channel", f"m{k}", "-", (Samples("a", index, 0.1 * index, course + add),))
        for k, add in enumerate((0.0, 50.0, -30.0, 0.0))
    ]
    record = Record(Study("rig", "ode", (), ()), tuple(signals), ())
    said = [found.says for found in find_copies(record)]
    assert len(said) == 3
    assert ["but for a constant" in one for one in said] == [True, True, False]
    assert "m3 is equal to column m0 of channel m0 in all rows: nothing" in said[2]


@pytest.mark.parametrize("times,is_unit", [(180.0 / np.pi, True), (1.0, False), (100.0, False)])
def test_a_rate_whose_integral_is_degrees_beside_an_angle_is_in_another_unit(times, is_unit):
    """A gyro's degrees stated as radians: the flight diverged, and nothing said why. A gear of
    100 between a motor and its joint is none."""
    rng, t = np.random.default_rng(5), 0.01 * np.arange(500)
    runs = []
    for k in range(2):
        angle = 0.2 * np.sin(3.0 * t + k) + 0.1 * np.sin(7.0 * t)
        rate = np.gradient(angle, t)
        read = [angle + rng.normal(0.0, 4e-3, 500), times * (rate + rng.normal(0.0, 0.03, 500))]
        runs.append(Run(f"r{k}", t, np.stack(read, 1), {}, f"r{k}"))
    channels = (Channel("roll", "rad", "angle"), Channel("gyro", "rad/s", "angular velocity"))
    found = [*find_units(Record.of(Study("flight", "multicopter", channels, tuple(runs))))]
    assert [f.where for f in found] == (["channel gyro"] if is_unit else [])
    assert all("degrees" in f.says and not f.stops for f in found)


@pytest.mark.parametrize("further", ["laser", "force"])
def test_the_remedy_of_clocks_that_run_apart_sets_them_right(further, tmp_path):
    """The laser's box ran 0.6 % slow and its file came second: the remedy had the wrong sign, and
    followed, it doubled what was wrong."""
    time, rng = 0.02 * np.arange(1500.0), np.random.default_rng(5)
    for run in "ab":
        phase = rng.uniform(0.0, 6.0, 4)
        force = sum(np.sin(w * time + p) for w, p in zip((1.3, 2.9, 5.1, 8.3), phase, strict=True))
        place = np.zeros(len(time))  # a cart on a damper follows it
        for k in range(1, len(time)):
            place[k] = place[k - 1] + 0.02 * (force[k - 1] - place[k - 1]) / 0.3
        place += rng.normal(0.0, 0.01, len(time))
        for what, values in (("force", force), ("laser", place)):
            clock = time * (0.994 if what == further else 1.0)
            rows = np.column_stack([clock, values])
            path, header = tmp_path / f"{run}_{what}.csv", f"t,{what}"
            np.savetxt(path, rows, delimiter=",", header=header, comments="", fmt="%.5f")
    files = ["{run}_force.csv", "{run}_laser.csv"]
    stated = {
        "name": "cart",
        "time": {"column": "t", "unit": "s"},
        "channels": [{"name": "laser", "unit": "m", "sd": 0.01}],
        "commands": [{"name": "force", "unit": "N"}],
        "runs": [
            {
                "name": k,
                "file": [f.format(run=k) for f in files[:: -1 if further == "force" else 1]],
            }
            for k in "ab"
        ],
        "model": {
            "system": "ode",
            "states": {"x": 0},
            "inputs": ["force"],
            "rates": {"x": "(force - x)/0.3"},
            "readings": {"laser": "x"},
        },
    }
    path = tmp_path / "study.yaml"
    path.write_text(yaml.safe_dump(stated))
    (said,) = (p.message for p in check_study(load_study(path)) if "run apart" in str(p))
    drift = float(re.search(r"drift: (-?[\d.e+]+)", said)[1])
    assert drift == pytest.approx(-6000.0, rel=0.03)


@pytest.mark.parametrize("is_meter", [True, False])
def test_a_meter_that_reads_nothing_below_a_value_is_no_marker_that_slipped(is_meter):
    """A turbine stands still below 6 l/min: its jumps were slips of a marker, an error."""
    time, runs = 0.2 * np.arange(300.0), []
    index, rng = np.arange(len(time)), np.random.default_rng(1)
    for k, low in enumerate((2.0, 3.0)):
        flow = np.interp(time, (0.0, 20.0, 30.0, 40.0, 60.0), (10.0, 12.0, low, low + 6.0, 13.0))
        read = np.where(flow < 6.0, 0.0, flow) if is_meter else flow + 6.0 * (time > 9.9 + 20.0 * k)
        runs.append(Samples(f"r{k}", index, time, read + rng.normal(0.0, 0.05, len(time))))
    record = Record(
        Study("rig", "ode", (), ()), (Signal("q", "channel", "q", "-", tuple(runs)),), ()
    )
    told = list(find_lasting(record))
    assert len(told) == (0 if is_meter else 2)
