"""Units of columns: the value in the signal's unit, or why there is none."""

import math

import pytest

from hybrid_mpc.machine.units import Conversion, conversion, time_factor

TURN = 2 * math.pi
RIGHT = [
    # rotation and frequency, by turns
    ("1/min", "rad/s", 60, TURN), ("min^-1", "rad/s", 60, TURN), ("min-1", "Hz", 60, 1), ("Hz", "rad/s", 1, TURN),
    ("rpm", "1/min", 60, 60), ("rpm", "Hz", 60, 1), ("RPM", "rad/s", 60, TURN), ("U/min", "rad/s", 60, TURN),
    ("kHz", "rad/s", 1, 1e3 * TURN), ("rad/s", "Hz", TURN, 1), ("deg/s", "rpm", 6, 1), ("rev/s", "Hz", 1, 1),
    ("Hz", "1/s", 3, 3), ("rpm/s", "rad/s^2", 60, TURN), ("rad", "deg", math.pi, 180), ("rev", "rad", 1, TURN),
    # temperatures have zeros of their own; their differences do not
    ("K", "degC", 300, 26.85), ("degF", "degC", 50, 10),
    ("\u00b0C", "K", 0, 273.15), ("\u00b0C", "\u00b0F", 100, 212),
    ("degR", "K", 9, 5), ("degC", "degC", 20, 20), ("K/min", "degC/s", 60, 1), ("W/K", "W/degC", 2, 2),
    # what engineers write
    ("psi", "kPa", 1, 6.894757293168), ("t/h", "kg/s", 3.6, 1),
    ("gal/min", "l/s", 60, 3.785411784), ("inch", "mm", 1, 25.4),
    ("kmh", "m/s", 3.6, 1), ("mNm", "N m", 1, 1e-3), ("N.m", "Nm", 1, 1), ("m3/h", "l/min", 60, 1000),
    ("\u00b5s", "ms", 1, 1e-3), ("m/s\u00b2", "m/s^2", 1, 1), ("kJ/kg/K", "J/(kg K)", 1, 1e3), ("msec", "s", 1, 1e-3),
    ("hr", "min", 1, 60), ("%", "-", 5, 0.05),
    ("mAh", "C", 1, 3.6), ("volts", "mV", 1, 1e3), ("mmHg", "Pa", 1, 133.322387415),
]  # fmt: skip


@pytest.mark.parametrize(("one", "other", "value", "wanted"), RIGHT)
def test_values_are_those_of_the_other_unit(one, other, value, wanted):
    there, back = conversion(one, other), conversion(other, one)
    assert there.factor * value + there.offset == pytest.approx(wanted, rel=1e-12, abs=1e-12)
    assert back.factor * wanted + back.offset == pytest.approx(value, rel=1e-12, abs=1e-12)


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("lpm/x", "l/s"), ("counts", "V"), ("furlong", "m"), ("m", "kg"), ("W", "K"), ("1/s", "rad/s"),
        ("rad/s", "1/s"), ("1/s^2", "rad/s^2"), ("", "m"), ("bar(g)", "bar"), ("m//s", "m/s"), ("degC", "V"),
    ],
)  # fmt: skip
def test_what_is_unknown_ambiguous_or_of_another_quantity_is_not_converted(one, other):
    assert isinstance(conversion(one, other), str)


def test_a_unit_that_nobody_knows_is_itself():
    assert conversion("counts", "counts") == Conversion(1.0)


@pytest.mark.parametrize(("unit", "seconds"), [
    ("\u00b5s", 1e-6), ("\u03bcs", 1e-6), ("us", 1e-6), ("msec", 1e-3), ("ms", 1e-3), ("hr", 3600.0), ("Min", 60.0),
    ("V", None),
])  # fmt: skip
def test_one_table_of_times(unit, seconds):
    assert time_factor(unit) == seconds
