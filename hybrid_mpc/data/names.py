"""Read a column's name: time, count of samples, unit and role.

Names are compared word by word, in small letters, without accents. An ambiguous name (``T``, ``n``, ``valve_time``) is
decided by the column's numbers.
"""

from __future__ import annotations

import re
import unicodedata
from itertools import pairwise
from typing import Literal, NamedTuple

from hybrid_mpc.machine.units import time_factor

Kind = Literal["time", "step", "count", ""]


def _plain(text: str) -> str:
    """A text in small letters, without accents and forms of width."""
    whole = unicodedata.normalize("NFKD", text).casefold()
    return "".join(c for c in unicodedata.normalize("NFKD", whole) if not unicodedata.combining(c))


def words_of(text: str) -> frozenset[str]:
    """Words of a list, in small letters, without accents."""
    return frozenset(_plain(text).split())


TIME = words_of(  # words for time; a name made only of these, units and ``AROUND`` is the time
    "time times timestamp timestamps stamp tout datetime date dates clock elapsed runtime uptime walltime simtime "
    "rostime systime daytime epoch t zeit zeiten zeitstempel zeitpunkt zeitachse uhrzeit datum messzeit laufzeit "
    "systemzeit versuchszeit temps heure horodatage horodate tiempo tempo hora fecha instante orario tijd "
    "tijdstip tijdstempel tid tidpunkt tidsstempel aika aikaleima czas cas vreme vrijeme ido idopont zaman timp "
    "waktu laikas laiks время дата час χρονος χρόνος الوقت الزمن זמן समय 시간 sekunden sekunde secondes segundos "
    "secondi"
)
STAMPS = words_of("timestamp timestamps datetime zeitstempel horodatage tijdstempel tidsstempel")
"""Words that mean time whatever stands beside them."""
WITHIN = tuple(_plain(text) for text in ("时间", "時間", "时刻", "時刻", "시간"))
"""The same for languages that do not separate words."""
DATES = words_of("datetime date dates datum fecha дата")  # words for dates: their numbers may count days
AROUND = words_of(  # words that may stand beside words for time
    "elapsed relative rel absolute abs sim simulation simulated ros unix posix utc gmt local system sys since "
    "start from begin recording recorded record log logger logging measurement measured meas test run real wall "
    "host pc plc device header stamp field total global master base axis vector in the of at and day"
)
PERHAPS = words_of("T ts s ms us ns min h d data")  # single words that may mean time: the numbers decide
COUNT = words_of(  # words for a count of samples
    "index indices idx sample samples row rows record records seq sequence unnamed datapoint datapoints messpunkt "
    "zeile"
)
PAIRS = ({"data", "point"}, {"data", "points"}, {"lfd", "nr"}, {"step", "number"}, {"line", "number"})
"""Pairs of words for a count of samples."""
STEP = (  # words for the sampling time
    {"dt"}, {"ts"}, {"timestep"}, {"delta", "t"}, {"time", "step"}, {"delta", "time"}, {"step", "size"},
    {"sampling", "time"}, {"sample", "time"}, {"sampling", "period"}, {"sample", "period"}, {"sampling", "interval"},
)  # fmt: skip
BESIDE = words_of(
    "number no nr num nummer id count counter of the s ms"
)  # words that may stand beside a count
COUNT_PERHAPS = words_of(  # single words that may mean a count: the numbers decide
    "n i j k no nr num number nummer count counter id step steps point points frame scan cycle line x"
)
ALONE = ("s", "ms", "us", "ns", "min", "mins", "h", "d", "day", "days")
"""Units of time that may mean something else (a minimum, a height) as a whole name or behind a ``t``."""


FIELD = re.compile(r"(?:[^\W\d]\w*\.)+([^\W\d]\w*)")  # a field of a struct, ``run.phi``, and its own name


def name_and_unit(column: str) -> tuple[str, str]:
    """A column's name and the unit in brackets behind it; ``""`` without a unit.

    A whole number in brackets is an index, as in ``state[0]`` and ``y(1)``; ``[1]`` after a blank is the unit 1.

    Example:
        >>> name_and_unit("level [mm]"), name_and_unit("time (s)"), name_and_unit("phi")
        (('level', 'mm'), ('time', 's'), ('phi', ''))
        >>> name_and_unit("state[0]"), name_and_unit("slip [1]")
        (('state[0]', ''), ('slip', '1'))
    """
    for opening, closing in ("[]", "()"):
        name, bracket, unit = column.removesuffix(closing).rpartition(opening)
        if column.endswith(closing) and bracket and name.strip():
            index = re.fullmatch(r"[\d\s,;:]*", unit) and not (unit.strip() == "1" and name[-1].isspace())
            return (column, "") if index else (name.strip(), unit.strip())
    return column, ""


class Said(NamedTuple):
    """The meaning of a name: ``kind``, whether its numbers must confirm it, and the unit of time [s] (None: unknown).

    A ``step`` is the sampling period; if its numbers increase it may be a time stamp as well. ``unit`` is the unit as
    written, empty without one; ``is_date``: the name means dates.
    """

    kind: Kind = ""
    perhaps: bool = False
    unit: str = ""
    seconds: float | None = None
    is_date: bool = False


def said_by(column: str) -> Said:
    """The meaning of a column's name.

    Example:
        >>> said_by("Time (ms)").kind, said_by("Time (ms)").seconds, said_by("t_us").seconds
        ('time', 0.001, 1e-06)
        >>> said_by("Data_Point").kind, said_by("T").perhaps, said_by("level [m]").kind
        ('count', True, '')
    """
    text = unicodedata.normalize("NFKC", column)
    name, unit = name_and_unit(text)
    if path := FIELD.fullmatch(name):
        name = path[1]
    split = re.sub(r"(?<=[^\W\d_A-Z])(?=[A-Z])", " ", name)
    written = [word for word in re.split(r"[\W_]+", split) if word]
    words = [re.sub(r"(?<=..)\d+$", "", _plain(word)) for word in written]
    words = [word for word in words if word and not word.isdigit()]
    if not words:
        return Said("count")
    if not unit and len(words) > 1 and time_factor(words[-1]) is not None:
        return _of(words[:-1], written[0], words[-1], behind=True)
    if not unit and len(words) == 1 and time_factor(words[0]) is not None:
        return Said("time", words[0] in ALONE, words[0], time_factor(words[0]))
    return _of(words, written[0], unit, behind=False)


def _of(words: list[str], first: str, unit: str, behind: bool) -> Said:
    """The meaning of ``words`` (``first`` as written) and a unit in brackets or ``behind`` the name."""
    seconds = time_factor(unit) if unit else None
    zone = unit.casefold().split("+")[0] in ("utc", "gmt", "local", "cet", "cest", "est", "pst", "z")
    unit, seen = "" if zone or unit in ("-", "1") else unit, set(words)
    is_date = bool(seen & DATES)
    if seen in STEP:
        return Said("step", False, unit, seconds)
    if seen in PAIRS or (seen & COUNT and seen <= COUNT | BESIDE):
        return Said("count", False, unit, seconds)
    if seen & STAMPS or any(part in word for part in WITHIN for word in words):
        return Said("time", False, unit, seconds, is_date)
    if words == ["t"]:
        if unit and seconds is None:  # t [degC]
            return Said()
        large = first == "T" and (behind or not unit)
        return Said(
            "time", large or (behind and unit in ALONE and unit not in ("s", "ms", "us", "ns")), unit, seconds
        )
    if seen & TIME and seen <= TIME | AROUND:
        return Said("time", False, unit, seconds, is_date)
    if unit and seconds is None:
        return Said()
    if seen & (TIME - {"t"}) or (len(words) == 1 and seen & PERHAPS) or words == ["x", "value"]:
        return Said("time", True, unit, seconds, is_date)
    return Said("count", True) if len(words) == 1 and seen & COUNT_PERHAPS and not unit else Said()


# Roles


Role = Literal[
    "set-point", "flag", "label", "command", "actuator", "answer", "disturbance", "measured", "quantity", ""
]
"""Role of a column by its name: ``command`` is surely an input, ``actuator`` probably; ``answer`` is the sensor of an
actuator, ``label`` an annotation of the recording (a fault, a correction), ``measured`` a sensor's output, ``quantity``
a physical quantity that may belong to the machine or to its surroundings."""
SET_POINT = words_of(  # words for a set-point
    "ref refs reference references referencia referencias referenz set setpoint setpoints setpt setvalue sp target "
    "targets desired des goal goals wanted soll sollwert fuhrungsgrosse consigne consigna riferimento demand planned "
)
FLAG = words_of(  # words for switches of the recording or the controller
    "flag enable enabled enabling status alarm valid invalid active mode trigger event marker bool boolean ok ready "
    "fehler freigabe moving running busy"
)
LABEL = words_of(  # words for what is computed, noted by hand, or added to a command
    "feedforward ff offset fault faults label anomaly correction bias calibration error err residual residuum deviation"
)
COMMAND = words_of(  # words for a command
    "u command commands cmd commanded control controle controller ctrl input inputs eingang stellgrosse stellwert "
    "steuerung manipulated mv op actuation actuator excitation entrada entree commande comando mando pwm duty dac"
)
ACTUATOR = words_of(  # words for an actuator
    "pump valve heater heating cooler cooling coolant voltage volt volts torque tau force thrust throttle "
    "steering steer brake fan pumpe ventil heizung spannung drehmoment moment kraft bomba valvula tensao "
    "tension chauffage pompe vanne power burner damper rudder elevator aileron propeller rotor"
)
DISTURBANCE = words_of(  # words for what acts on a machine without being commanded
    "ambient outside outdoor environment umgebung umgebungstemperatur aussentemperatur "
    "aussen weather wind disturbance disturbances disturb supply battery "
    "mains reservoir storung sun solar radiation irradiance push kick"
)
MEASURED = words_of(  # words for a sensor's output, whatever it measures
    "output outputs ausgang saida sortie salida measured measure measurement meas mes actual ist istwert sensor pv "
    "feedback fb encoder enc tacho gyro imu"
)
QUANTITY = words_of(  # words for quantities of a machine
    "temperature temp temperatur temperatura level fullstand niveau nivel position pos angle ang winkel angulo "
    "speed vel velocity geschwindigkeit drehzahl velocidade rate pressure druck concentration height altitude "
    "heading yaw pitch roll theta phi psi alpha beta gamma q dq qd x z omega distance displacement "
    "acceleration acc accel hohe weg pendulum cart room raum raumtemperatur hallentemperatur zulauftemperatur"
)
IN_UNITS = {"tension": ("", "V", "mV", "kV"), "wind": ("", "m/s", "km/h", "mph", "kn", "deg")}
"""Units in which a word of these lists has its role: a tension in N is no voltage, a wind in rpm is a winder."""
DRIVING_UNITS = frozenset(  # units of most inputs
    ("V", "mV", "kV", "%", "N m", "Nm", "mNm", "Ncm", "kNm", "N", "kN", "mN", "W", "kW")
)
REACHED_UNITS = frozenset((  # units of most outputs
    "rad", "deg", "°", "mrad", "rev", "turn", "m", "mm", "cm", "km", "K", "degC", "°C", "degF", "rad/s", "deg/s",
    "m/s", "mm/s", "cm/s", "km/h", "rpm", "rad/s^2", "deg/s^2", "m/s^2", "mol/l",
))  # fmt: skip
ENDINGS = {  # units by the last words of a name, in small letters
    "deg": "deg", "rad": "rad", "mrad": "mrad", "rpm": "rpm", "degc": "degC", "celsius": "degC", "degf": "degF",
    "kelvin": "K", "pct": "%", "percent": "%", "mm": "mm", "cm": "cm", "km": "km", "mps": "m/s", "kmh": "km/h",
    "kph": "km/h", "hz": "Hz", "khz": "kHz", "nm": "N m", "mnm": "mNm", "ncm": "Ncm", "bar": "bar",
    "mbar": "mbar", "pa": "Pa", "kpa": "kPa", "hpa": "hPa", "psi": "psi", "mv": "mV", "ma": "mA", "kw": "kW",
    "kg": "kg", "lpm": "l/min", "gpm": "gpm", "ppm": "ppm", "volt": "V", "volts": "V", "amp": "A", "amps": "A",
    "watt": "W", "watts": "W", "newton": "N", "newtons": "N", "rad s": "rad/s", "rads": "rad/s", "deg s": "deg/s",
    "degs": "deg/s", "m s": "m/s", "mm s": "mm/s", "cm s": "cm/s", "km h": "km/h", "rad s2": "rad/s^2",
    "deg s2": "deg/s^2", "m s2": "m/s^2", "l min": "l/min", "l s": "l/s", "l h": "l/h", "ml min": "ml/min",
    "m3 h": "m^3/h", "m3 s": "m^3/s", "kg h": "kg/h", "kg s": "kg/s", "kg min": "kg/min", "g s": "g/s",
    "mol l": "mol/l", "w m2": "W/m^2", "knot": "kn", "knots": "kn", "kts": "kn", "mph": "mph", "dps": "deg/s",
    "rps": "rps",
}  # fmt: skip
LETTERS = {"K": "K", "V": "V", "A": "A", "N": "N", "W": "W", "m": "m", "kn": "kn", "kN": "kN"}
"""Units as written; a single letter may also be an index."""


class Ending(NamedTuple):
    """The unit at the end of a column's name, empty without one; ``perhaps``: the end may be something else."""

    unit: str = ""
    perhaps: bool = False


def _written(name: str, camel: bool) -> list[str]:
    """The words of a name as written; ``camel``: a capital letter within a word begins another."""
    text = unicodedata.normalize("NFKC", name)
    text = re.sub(r"(?<=[^\W\d_A-Z])(?=[A-Z])", " ", text) if camel else text
    return [word for word in re.split(r"[\W_]+", text) if word and word.casefold() != "per"]


def unit_behind(name: str, small: bool = False) -> Ending:
    """The unit at the end of a name, as in ``_deg``, ``_rad_s``, ``_pct``; a single letter (``_K``) may be an index.

    ``small`` also accepts small letters (``_v``), if other names of the recording end with units, too.

    Example:
        >>> unit_behind("angle_deg").unit, unit_behind("vel_rad_s").unit, unit_behind("T_K")
        ('deg', 'rad/s', Ending(unit='K', perhaps=True))
        >>> unit_behind("deg"), unit_behind("level")
        (Ending(unit='', perhaps=False), Ending(unit='', perhaps=False))
    """
    ending = _parted(name)[1]
    if ending.unit or not small:
        return ending
    words = _written(name, camel=False)
    letter = words[-1].upper() if len(words) > 1 and len(words[-1]) == 1 and words[-1].islower() else ""
    return Ending(LETTERS[letter], True) if letter in LETTERS else ending


def _parted(name: str) -> tuple[list[str], Ending]:
    """The words of a name before its unit, and the unit; blanks and underscores separate first (``_degC``)."""
    for camel in (False, True):
        words = _written(name, camel)
        for count in (2, 1):
            if len(words) > count and (unit := ENDINGS.get(" ".join(words[-count:]).casefold())):
                return _written(" ".join(words[:-count]), camel=True), Ending(unit)
        if len(words) > 1 and words[-1] in LETTERS:
            return _written(" ".join(words[:-1]), camel=True), Ending(LETTERS[words[-1]], len(words[-1]) == 1)
    return words, Ending()


def is_named(column: str, name: str) -> bool:
    """Whether ``column`` is ``name``, apart from the unit at its end.

    Example:
        >>> is_named("level_m", "level"), is_named("clock_ms", "clock"), is_named("temp_min", "temp")
        (True, True, False)
    """
    words, ending = _parted(column)
    if (said := said_by(column)).kind == "time" and said.unit == _plain(words[-1]):
        words, ending = words[:-1], Ending(said.unit)
    return bool(ending.unit) and words == _written(name, camel=True)


def role_said_by(column: str, unit: str = "", switches: bool = False) -> Role:
    """The role of a column by the words of its name; empty if they say nothing, or contradict each other.

    Words for a function (a set-point, a command) take precedence over words for a quantity. A ``unit`` can only
    contradict: a heater in degC is its temperature. Words for flags count if the numbers are a few whole ones
    (``switches``).

    Example:
        >>> role_said_by("Referencia"), role_said_by("tau1_command_nm"), role_said_by("tau_meas_Nm", "N m")
        ('set-point', 'command', 'answer')
        >>> role_said_by("heater", "%"), role_said_by("steering", "rad"), role_said_by("level", "V")
        ('actuator', '', 'quantity')
        >>> role_said_by("tension", "V"), role_said_by("tension", "N"), role_said_by("n_wind", "rpm")
        ('actuator', '', '')
    """
    written = _parted(name_and_unit(column)[0])[0]
    words = [re.sub(r"(?<=.)\d+$", "", _plain(word)) for word in written]
    whole = frozenset(words) | {"".join(pair) for pair in pairwise(words)}
    whole -= {word for word, units in IN_UNITS.items() if unit not in units}
    if switches and whole & FLAG:
        return "flag"
    if whole & SET_POINT:
        return "set-point"
    if whole & LABEL:
        return "label"
    if whole & (TIME - {"t"}):
        return ""
    if whole & MEASURED or ("y" in whole and not whole & (ACTUATOR | COMMAND)):
        return "answer" if whole & (ACTUATOR | COMMAND) else "measured"
    if whole & (COMMAND - {"u"}):
        return "command"
    if whole & DISTURBANCE or ("load" in whole and whole & ACTUATOR):
        return "disturbance"
    if "u" in whole:
        return "command"
    if whole & ACTUATOR:
        return "" if unit in REACHED_UNITS or whole & (QUANTITY | {"y"}) else "actuator"
    # a sensor may give V or % for any quantity; a heat flow q [W] is no position
    return "quantity" if whole & QUANTITY and unit not in DRIVING_UNITS - {"V", "%"} else ""


def is_command_of(command: str, other: str) -> bool:
    """Whether two names differ only by words for a command: ``tau1_command_nm`` and ``tau1_nm``.

    Example:
        >>> is_command_of("tau1_command_nm", "tau1_nm"), is_command_of("tau1_command_nm", "tau2_nm")
        (True, False)
    """
    one, two = ([_plain(word) for word in _parted(name_and_unit(name)[0])[0]] for name in (command, other))
    return one != two and [word for word in one if word not in COMMAND] == two


def is_set_point_of(goal: str, other: str) -> bool:
    """Whether a name is another one and a word for a set-point, written as one word: ``xset_mm`` and ``x_mm``.

    Example:
        >>> is_set_point_of("xset_mm", "x_mm"), is_set_point_of("offset", "x_mm")
        (True, False)
    """
    one, two = (
        "".join(_plain(word) for word in _parted(name_and_unit(name)[0])[0]) for name in (goal, other)
    )
    return one != two and one.startswith(two) and one[len(two) :] in SET_POINT
