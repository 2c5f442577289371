"""Tables of random style and known content: read as they were written, or refused; none is read wrong."""

import datetime
import random
import re

import numpy as np
import pytest

from hybrid_mpc import InputError
from hybrid_mpc.data.files import opened

TOPS = ("Logger 5", "Rate: 10 Hz", "", "# remark", "Operator{}Ann", "Key{}3", "Test 12.5", "Date{}2023-01-01")


def stamps(r, comma, n, dt):
    """Time stamps as text, and as they are read."""
    t = [dt * k for k in range(n)]
    begin = datetime.datetime(
        2023, r.randint(1, 12), r.randint(1, 28), *(r.randint(0, m) for m in (23, 59, 59))
    )
    dates = [begin + datetime.timedelta(seconds=one) for one in t]
    kind = r.choice(["number", "number", "iso", "german", "us", "clock", "since 1970", "ms"])
    if kind in ("number", "since 1970", "ms"):
        form = {"number": "{:.3f}", "since 1970": "{:.3f}", "ms": "{:.0f}"}[kind]
        texts = [form.format({"number": one, "since 1970": 1.7e9 + one, "ms": 1e3 * one}[kind]) for one in t]
        return [text.replace(".", "," if comma else ".") for text in texts], [float(text) for text in texts]
    if kind == "clock":
        midnight = begin.replace(hour=0, minute=0, second=0)
        return [f"{d:%H:%M:%S.%f}" for d in dates], [(begin - midnight).total_seconds() + one for one in t]
    forms = {"iso": "%Y-%m-%d %H:%M:%S.%f", "german": "%d.%m.%Y %H:%M:%S.%f", "us": "%m/%d/%Y %I:%M:%S.%f %p"}
    return [d.strftime(forms[kind]) for d in dates], t


def numbers(r, g, n):
    """A column of numbers with as many decimals in all rows."""
    size, decimals = 10.0 ** r.randint(-2, 5), r.choice([0, 1, 2, 3, 3, 4, 6])
    return [f"{(g.standard_normal() + r.choice([0, 1])) * size:.{decimals}f}" for _ in range(n)]


def table(seed):
    """A file's bytes, its columns' names (none without a header) and numbers ``(n, m)``."""
    r, g = random.Random(seed), np.random.default_rng(seed)
    n, m = r.choice([4, 6, 12, 40, 150]), r.choice([1, 2, 3, 6])
    separator = r.choice([",", ";", "\t", "|", " ", ", ", "; "])
    comma = r.random() < 0.4 and separator.strip() != ","
    texts, t = stamps(r, comma, n, r.choice([0.01, 0.1, 1.0, 0.5, 0.125]))
    if separator == " ":
        texts = [f'"{text}"' if " " in text else text for text in texts]
    columns, values = [texts], [t]
    for _ in range(m):
        column = numbers(r, g, n)
        values.append([float(text) for text in column])
        columns.append([text.replace(".", ",") if comma else text for text in column])
        if r.random() < 0.15 and separator != " ":
            k = r.randrange(n)
            columns[-1][k], values[-1][k] = r.choice(["", "NaN", "n/a", "-"]), np.nan
    rows = [list(row) for row in zip(*columns, strict=True)]
    if r.random() < 0.1 and separator != " ":
        rows = [[f'"{cell}"' for cell in row] for row in rows]
    trailing = separator if r.random() < 0.1 and separator.strip() else ""
    lines = [separator.join(row) + trailing for row in rows]
    names = ["t", *(f"x{j}" for j in range(m))] if r.random() < 0.85 else []
    top = [
        re.sub("{}", lambda _: separator, r.choice(TOPS))
        for _ in range(r.randint(1, 8) if r.random() < 0.35 else 0)
    ]
    top += [separator.join(names) + (trailing if r.random() < 0.5 else "")] if names else []
    top += [separator.join(["s", *["V"] * m])] if names and r.random() < 0.25 else []
    if r.random() < 0.1:
        lines.insert(r.randrange(n), "")
    bottom = (
        [r.choice([separator.join(["Mean", *["1"] * m]), "# end", "End of file"])] if r.random() < 0.1 else []
    )
    end = r.choice(["\n", "\n", "\r\n"])
    text = end.join([*top, *lines, *bottom]) + (end if r.random() < 0.8 else "")
    return text.encode(r.choice(["utf-8", "utf-8", "utf-8-sig", "utf-16"])), names, np.array(values).T


def tried(path, seed):
    """Whether a table is read; if it is, then as it was written."""
    content, names, values = table(seed)
    path.write_bytes(content)
    try:
        source = opened(path)
        columns = source.read(None, source.header, source.header)
        if columns.faults:
            return False
    except InputError as error:
        assert str(path) in str(error)  # noqa: PT017  (both outcomes are right)
        return False
    assert columns.values.shape == values.shape, seed
    np.testing.assert_allclose(columns.values[:, 0], values[:, 0], rtol=0, atol=1e-6, err_msg=str(seed))
    np.testing.assert_array_equal(columns.values[:, 1:], values[:, 1:], err_msg=str(seed))
    if names:
        assert [name.split(" [")[0] for name in source.header] == names, seed
    return True


def test_thirty_tables(tmp_path):
    assert np.mean([tried(tmp_path / "run.csv", seed) for seed in range(30)]) > 0.85


@pytest.mark.full
def test_two_thousand_tables(tmp_path):
    assert np.mean([tried(tmp_path / "run.csv", seed) for seed in range(30, 2030)]) > 0.95
