"""The table of operators as a document: ``python -m nn_export.operators.table > docs/operators.md``."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Mapping
from typing import Any

from nn_export.operators import OPERATORS, elementwise, linear, recurrent, reduce, shape, systems

GROUPS: dict[str, Mapping[str, Any]] = {
    "Element by element, with broadcasting": elementwise.OPERATORS,
    "Moving elements, constants": shape.OPERATORS,
    "Products, linear layers, normalisations": linear.OPERATORS,
    "Systems of a few linear equations": systems.OPERATORS,
    "Reductions": reduce.OPERATORS,
    "Recurrent layers and cells": recurrent.OPERATORS,
}
HEAD = """# Operators

A torch module exports if `torch.export` reduces it to the operators below. Other operators, and arguments that are not
in the third column, are refused by name.

This page is generated: `python -m nn_export.operators.table > docs/operators.md`.
"""


def document() -> str:
    """The table as Markdown."""
    parts = [HEAD]
    for title, group in GROUPS.items():
        parts.append(f"## {title}\n\n| operator | does | arguments |\n| --- | --- | --- |")
        parts += [_row(name) for name in sorted(group)]
        parts.append("")
    return "\n".join(parts)


def _row(name: str) -> str:
    f = OPERATORS[name]
    words = (f.__doc__ or "").strip().splitlines()
    text = words[0].rstrip(".") if words else "as in torch"
    text = text.replace("``", "`").replace("|", "\\|")
    arguments = ", ".join(p for p in inspect.signature(f).parameters)
    return f"| `{name.removeprefix('aten.').removesuffix('.default')}` | {text} | {arguments} |"


if __name__ == "__main__":
    sys.stdout.write(document())
