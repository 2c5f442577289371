"""The page of ``results.json`` from the dataclasses of the stages.

``python docs/site/results_schema.py > docs/results-schema.md``
"""

from __future__ import annotations

import dataclasses
import inspect
import re
import types
import typing
from collections.abc import Iterator, Mapping
from typing import Any

from hybrid_mpc.records import BESIDE
from hybrid_mpc.workflow import control, predict, tune
from hybrid_mpc.workflow.stages.results import SCHEMA_VERSION, SHOWN, Results

SIMPLE = {
    float: "number",
    int: "whole number",
    str: "text",
    bool: "true or false",
    Any: "any",
    complex: "list (real part, imaginary part)",
}
HEAD = f"""# `results.json`

`hybrid-mpc run` writes its numbers to `results.json`: one object for each stage of the run, with the fields of the
stage's dataclass. In Python, `read_results` (`hybrid_mpc/workflow/stages/results.py`) checks a file and returns the
dataclass `Results`. Schema version: **{SCHEMA_VERSION}**. The files of [`hybrid-mpc control`](#hybrid-mpc-control),
[`predict`](#hybrid-mpc-predict) and [`tune`](#hybrid-mpc-tune) are below.

`python docs/site/results_schema.py > docs/results-schema.md` writes this page from the dataclasses.

## Rules

- A stage without a result has `reason` (text) and `failed` (true after an error) in place of its keys.
- Times have their unit in the key (`_s`, `_ms`). Values of signals and balances are objects whose keys are names with
  units, such as `"phi [rad]"` or `"energy [W]"`.
- JSON has no infinite numbers. An error of a free run that diverged is the text `"inf"`; an unknown number is `"nan"`.
- Models are `phy_nominal`, `phy` (the fitted prior), `rnn`, `pgrnn` and `mopgrnn`. A prior without balances has no
  `mopgrnn`.
- Means and intervals of closed loops, and ratios of costs, follow from the rows. In Python: `results.control.means`,
  `.comparisons` and `.gap`. [Early stopping](seeds.md) widens the intervals.
- The same seed on the same computer gives the same file except durations: `control.step_ms`, `timing_ms` of loops, and
  the row `step time` of `promises`.
- Unknown keys are refused, and files of another schema version too. `hybrid-mpc run SCENARIO --out FOLDER --resume`
  writes the file again.
"""
COMMANDS = (
    ("control", "results.json", control, control.ControlResults, "read_control"),
    ("predict", "predict.json", predict, predict.PredictResults, "read_predictions"),
    ("tune", "results.json", tune, tune.TuneResults, "read_tuning"),
)
"""Commands with a file of their own: name, file, module, dataclass, and the function that reads it."""
VERSIONS = """## Versions

| version | differs from the one before |
| --- | --- |
| 14 | "lacking_delay" in "prior.fit" |
| 13 | modes in "analysis", "nis_band" in "estimation", alarms by recording in "watch"; no "plants" in "on_model" |
| 12 | has the stages' own dataclasses; rows of all loops in place of their means |
| 11 | has "watch" in place of "residuals", "monitor" and "guard" |
| 10 | has "promises" |
| 7 | has "on_model" |
| 6 | has "residuals" |
| 5 | errors of all outputs and balances, "error", "fit_percent"; "e_sim" over the rates' spreads |
| 4 | first output's error, "e_sim_s" as the paper's sum; names with units; means with interval |
| 3 | has "guard" |
| 2 | has "estimation" |
"""


def fields_of(kind: Any) -> list[str]:
    """Names of the fields that the file holds."""
    return [f.name for f in dataclasses.fields(kind) if f.metadata != BESIDE]


def meanings(kind: Any) -> dict[str, str]:
    """Meaning of each field: its text under ``Args:`` in the docstring of the class or of a base class.

    Raises:
        LookupError: If a field has none.
    """
    found: dict[str, str] = {}
    for own in reversed(kind.__mro__):
        block = inspect.cleandoc(own.__dict__.get("__doc__") or "").partition("Args:\n")[2]
        block = re.split(r"\n(?=\S)", block)[0]
        for entry in re.split(r"\n(?=    \S)", block):
            name, _, text = entry.strip().partition(":")
            found[name] = " ".join(text.split())
    if lacking := [name for name in fields_of(kind) if not found.get(name)]:
        raise LookupError(f"{kind.__name__}: no text under Args: for {', '.join(lacking)}")
    return {name: prose(found[name]) for name in fields_of(kind)}


def prose(text: str) -> str:
    """A docstring's text as Markdown in a table's cell."""
    text = re.sub(
        r":(?:class|func|meth|attr|data|mod):`~?([^`]*)`", lambda m: f"`{m[1].split('.')[-1]}`", text
    )
    text = re.sub(r"\bNone\b", "null", text.replace("``", "`"))
    return text.replace("|", "\\|")


def kind_text(hint: Any) -> str:
    """An annotation as words."""
    origin, arms = typing.get_origin(hint), typing.get_args(hint)
    if origin is typing.Annotated:
        return kind_text(arms[0])
    if origin in (typing.Union, types.UnionType):
        return " or ".join("null" if arm is type(None) else kind_text(arm) for arm in arms)
    if origin is typing.Literal:
        return " or ".join(f"`{arm}`" for arm in arms)
    if origin is tuple and arms[-1] is not Ellipsis:
        return f"list ({', '.join(kind_text(arm) for arm in arms)})"
    if origin is tuple:
        return f"list: {kind_text(arms[0])}"
    if origin in (dict, Mapping):
        return f"by name: {kind_text(arms[1])}"
    if dataclasses.is_dataclass(hint):
        return f"[{hint.__name__}](#{hint.__name__.lower()})"  # type: ignore[union-attr]
    return SIMPLE[hint]


def inner(hint: Any) -> Iterator[Any]:
    """Dataclasses in an annotation."""
    if dataclasses.is_dataclass(hint):
        yield hint
    for arm in typing.get_args(hint):
        yield from inner(arm)


def parts(kind: Any) -> list[Any]:
    """Dataclasses in the fields of a dataclass that the file holds."""
    hints = typing.get_type_hints(kind)
    return [part for name in fields_of(kind) for part in inner(hints[name])]


def table(kind: Any, names: list[str]) -> Iterator[str]:
    """Rows of some fields of a dataclass."""
    hints, texts = typing.get_type_hints(kind), meanings(kind)
    yield from ("| key | kind | meaning |", "| --- | --- | --- |")
    for name in names:
        yield f"| `{name}` | {kind_text(hints[name])} | {texts[name]} |"


def summary(kind: Any) -> str:
    """The docstring before ``Args:``, as Markdown."""
    text = inspect.cleandoc(kind.__doc__).partition("\n\nArgs:")[0]
    return "\n\n".join(prose(" ".join(part.split())) for part in text.split("\n\n"))


def page() -> str:
    """The page's text."""
    stages = {stage.name: stage.result for stage in SHOWN}
    lines = [HEAD, "## Head", "", *table(Results, [n for n in fields_of(Results) if n not in stages]), ""]
    ahead: list[Any] = []
    for name, kind in stages.items():
        lines += [f"## `{name}`", "", summary(kind), "", *table(kind, fields_of(kind)), ""]
        ahead += parts(kind)
    for name, file, module, kind, reader in COMMANDS:
        lines += [
            f"## `hybrid-mpc {name}`",
            "",
            f"The `{file}` of [`hybrid-mpc {name}`]({name}.md) is the dataclass `{kind.__name__}`. In Python,",
            f"`{reader}` (`hybrid_mpc/workflow/{name}.py`) reads it. Schema version: **{module.SCHEMA_VERSION}**.",
            "",
            *table(kind, fields_of(kind)),
            "",
        ]
        ahead += parts(kind)
    lines += ["## Objects in them", ""]
    seen: set[Any] = set()
    while ahead:
        kind = ahead.pop(0)
        if kind not in seen:
            seen.add(kind)
            lines += [f"### {kind.__name__}", "", summary(kind), "", *table(kind, fields_of(kind)), ""]
            ahead += parts(kind)
    return "\n".join([*lines, VERSIONS])


if __name__ == "__main__":
    print(page(), end="")
