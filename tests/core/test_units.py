"""Units as people write them, and the SI units they stand for."""

import math
import random
import re
import time

import pytest

from diffsim.core.units import factor, in_si, in_unit, small_scale, to_si


@pytest.mark.parametrize(
    ("unit", "si", "size"),
    [
        ("mm", "m", 1e-3),
        ("m", "m", 1.0),
        ("deg", "rad", math.pi / 180.0),
        ("rpm", "rad/s", 2.0 * math.pi / 60.0),
        ("rev/min", "rad/s", 2.0 * math.pi / 60.0),
        ("RPM", "rad/s", 2.0 * math.pi / 60.0),
        ("mm/rev", "m/rad", 1e-3 / (2.0 * math.pi)),
        ("dps", "rad/s", math.pi / 180.0),
        ("lpm", "m^3/s", 1e-3 / 60.0),
        ("pct", "-", 0.01),  # pint: a pico-carat
        ("mbar", "Pa", 100.0),
        ("mN m", "N m", 1e-3),
        ("N m", "N m", 1.0),
        ("Nm", "N m", 1.0),
        ("N.m", "N m", 1.0),
        ("mN.m", "N m", 1e-3),
        ("tr/min", "rad/s", 2.0 * math.pi / 60.0),
        ("U/min", "rad/s", 2.0 * math.pi / 60.0),
        ("points", "points", 1.0),  # of an encoder; pint: a length of 0.35 mm
        ("cts", "cts", 1.0),  # pint: a carat
        ("m/s2", "m/s^2", 1.0),
        ("m/sec/sec", "m/s^2", 1.0),
        ("m*s**-2", "m/s^2", 1.0),
        ("m s⁻²", "m/s^2", 1.0),
        ("W m-2 K-1", "W/m^2/K", 1.0),  # of climate models
        ("min-1", "Hz", 1.0 / 60.0),
        ("Meters", "m", 1.0),
        ("radians", "rad", 1.0),
        ("Newtons/Volt", "N/V", 1.0),
        ("amps", "A", 1.0),  # pint: atto of meters per second
        ("Degrees/sec", "rad/s", math.pi / 180.0),
        ("Nms/rad", "N m s/rad", 1.0),  # pint: a textile number
        ("cNm", "N m", 0.01),
        ("Vs/rad", "V s/rad", 1.0),
        ("kgm^2", "kg m^2", 1.0),
        ("gcm2", "kg m^2", 1e-7),
        ("rad/Nm", "rad/N/m", 1.0),
        ("N-m", "N m", 1.0),
        ("kg-cm", "N m", 0.0980665),  # a torque, not a mass times a length
        ("oz-in", "N m", 0.00706155181422604),
        ("ft-lbs", "N m", 1.3558179483314004),
        ("Nm/A", "N m/A", 1.0),
        ("mm/s^2", "m/s^2", 1e-3),
        ("ml/s", "m^3/s", 1e-6),
        ("mV", "V", 1e-3),
        ("kHz", "Hz", 1e3),
        ("%", "-", 1e-2),
        ("-", "-", 1.0),
        ("px", "px", 1.0),
        ("mm⁻²", "1/m^2", 1e6),
        ("kN·mm / (deg s^(-1))", "kg m^2/rad/s", 180.0 / math.pi),
        ("V^0.5/s", "V^0.5/s", 1.0),
        ("µΩ", "ohm", 1e-6),
        ("W/degC", "W/degC", 1.0),
    ],
)
def test_si_of_a_unit(unit, si, size):
    found = to_si(unit)
    assert (found.unit, found.offset) == (si, 0.0)
    assert found.factor == pytest.approx(size, rel=1e-14)


@pytest.mark.parametrize("unit", ["degC", "deg C", "Deg C", "deg. C", "degrees Celsius", "° C"])
def test_degrees_celsius_have_an_offset(unit):
    """In two words they were an angle times a charge."""
    assert to_si(unit) == ("K", 1.0, 273.15)


def test_degrees_in_two_words_stand_in_a_product_too():
    assert to_si("W/deg C") == to_si("W/degC")
    assert to_si("deg F") == to_si("degF")


def test_a_coherent_unit_means_the_same_in_any_spelling():
    assert factor("m/s2", "m/s^2") == 1.0
    assert {to_si(u).unit for u in ("rad/s", "rad s^-1", "radians/second", "rad·s⁻¹")} == {"rad/s"}
    assert in_unit("30 mm3", "m^3") == pytest.approx(3e-8, rel=1e-14)


@pytest.mark.parametrize(
    "unit",
    [
        "furlongs/fn",
        "A-1",
        "left-arm",
        "N-1",
        "Mps",
        "A-B",
        "L-N",
        "pk-pk",
        "deg-C",
        "kg-cm^2",
        "g-cm2",
        "kg-m/s",
        "J/(kg-K)",
        "kgcm",
        "RAD/S",
    ],
)
def test_an_unknown_unit_is_told(unit):
    with pytest.raises(ValueError, match=f"unit {re.escape(repr(unit))} is unknown"):
        to_si(unit)


@pytest.mark.parametrize("unit", ["slm", "SLPM", "sccm"])
def test_a_standard_flow_is_no_volume(unit):
    with pytest.raises(ValueError, match=f"{unit}.*mass flow.*kg/s"):
        to_si(unit)


def test_differences_of_temperatures_have_no_offset():
    assert factor("K", "degC") == 1.0 and factor("degC", "K") == 1.0
    assert in_si("22 degC") == (295.15, "K")
    assert in_si(2, "degC", difference=True) == (2.0, "K")


def test_a_temperature_moves_with_the_zero_of_its_unit_and_a_difference_does_not():
    assert in_unit("22 degC", "K") == pytest.approx(295.15, rel=1e-14)
    assert in_unit("300 K", "degC") == pytest.approx(26.85, rel=1e-12)
    assert in_unit("2 degC", "K", difference=True) == pytest.approx(2.0, rel=1e-14)
    assert in_unit("9 degF", "degC", difference=True) == pytest.approx(5.0, rel=1e-14)


PIECES = (
    *(
        "m",
        "kg",
        "s",
        "N",
        "rad",
        "degC",
        "px",
        "%",
        "µ",
        "dB",
        "e",
        "Nm",
        "lambda",
        "m2",
        "[length]",
    ),
    *(
        "*",
        "/",
        "^",
        "**",
        "^-",
        "(",
        ")",
        " ",
        "·",
        "²",
        "⁹⁹",
        "⁻",
        ",",
        ".",
        "_",
        "per",
        "-",
        "+",
    ),
    *("9", "(9)", "1", "99", "0x9", "1_0", "1e9", "0.5", "\n", "'", "=", "٣"),
)


@pytest.mark.property
def test_no_text_takes_long():
    """Pint evaluates powers of numbers, however they are written, without hearing Ctrl-C."""
    rng, began, read = random.Random(0), time.process_time(), 0
    factor("degC", "K")  # pint is loaded
    for _ in range(10_000):
        text = "".join(rng.choices(PIECES, k=rng.randint(1, 9)))
        try:
            size = to_si(text).factor
        except ValueError as error:
            assert str(error).startswith("unit ")
        else:
            read += 1
            assert 1e-100 <= abs(size) <= 1e100
    assert read > 300
    assert time.process_time() - began < 4.0  # 0.7 s on a quiet core


@pytest.mark.parametrize(
    "unit",
    ["(9)**(9)**(9)", "m⁹⁹⁹", "9,**9,**9", "1_0**1_0**9", "m*(9)^(9)^(9)", "0x9**0x9**0x9", "m^9^9",
     "((m^99)^99)^99", "cm**9999", "m" * 100_000, "m" + " " * 100_000 + "s", "dB", "m\n/s:"],
)  # fmt: skip
def test_what_is_no_product_of_powers_is_refused(unit):
    with pytest.raises(ValueError, match="is unknown") as refused:
        to_si(unit)
    assert len(str(refused.value)) < 350
    with pytest.raises(ValueError, match="unit"):
        in_si(f"3 {unit}")


@pytest.mark.parametrize("unit", ["km^99", "mm**-99"])
def test_a_unit_beyond_what_numbers_hold_is_refused(unit):
    """Their factors were 0, so that every reading became 0, or an error of Python's."""
    with pytest.raises(ValueError, match="of its SI unit"):
        to_si(unit)


@pytest.mark.parametrize(
    ("unit", "value", "shown", "read"),
    [
        ("m3/s", 1.49e-10, "ul/s", 0.149),  # stood as 1.49e-10 m3/s in a first sentence
        ("m^3/s", 3e-6, "ml/s", 3.0),
        ("m3/s", 2e-2, "l/s", 20.0),
        ("m3/s", 0.5, "m3/s", 0.5),
        ("m", 2e-4, "mm", 0.2),
        ("m", 1e-6, "um", 1.0),
        ("rad", 0.0123, "mrad", 12.3),
        ("rad/s", 0.004, "mrad/s", 4.0),
        ("N m", 0.02, "mN m", 20.0),
        ("N", 1e-3, "mN", 1.0),
        ("N", 0.2, "N", 0.2),
        ("N m s/rad", 1e-3, "N m s/rad", 1e-3),  # as the model's formula has it
        ("m", 0.0, "m", 0.0),
    ],
)
def test_what_is_small_is_read_in_the_unit_that_keeps_its_digits(unit, value, shown, read):
    found, times = small_scale(unit, (0.5 * value, -value))
    assert found == shown and times * value == pytest.approx(read)
    assert small_scale(unit, (math.nan, value, math.inf)) == (found, times), "no number decides"


@pytest.mark.parametrize(
    ("written", "meant"),
    [("мс", "ms"), ("об/мин", "rpm"), ("рад/с", "rad/s"), ("град", "deg"), ("мН·м", "mN m"),
     ("кПа", "kPa"), ("мкм", "um"), ("м/с²", "m/s^2"), ("МПа", "MPa")],
)  # fmt: skip
def test_symbols_in_cyrillic_letters_are_those_of_si(written, meant):
    """GOST 8.417."""
    assert to_si(written).factor == pytest.approx(to_si(meant).factor, rel=1e-12)
    assert factor(written, meant) == pytest.approx(1.0, rel=1e-12)
