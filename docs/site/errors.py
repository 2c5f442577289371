"""The page of error codes, from the source: ``python docs/site/errors.py > docs/errors.md``."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from itertools import groupby
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("hybrid_mpc", "nn_export", "scenarios")
CODE = re.compile(r"\[((?:HM-[A-Z]+|NN)-\d{3})\]")
HEAD = """# Error codes

Every error message ends with a code, for example `[HM-DATA-085]`. The middle part names the room of the library that
found the problem: `DATA` reads recordings, `IDENTIFY` fits the prior. `NN` codes come from the exporter `nn_export`.
A code stays with its problem when the message is improved: search for the code, not for the words.
In Python, `error.codes` holds the codes of an `InputError`.

In the tables, `…` stands for a name or value of your case. What a message says about the remedy applies here too.
"""


def codes() -> Iterator[tuple[str, str]]:
    """Each code with the text of its message, values replaced by an ellipsis.

    Example:
        >>> dict(codes())["HM-RECORDS-003"]
        '……is missing'
    """
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            tree = ast.parse(path.read_text(encoding="utf-8"))
            own = {
                id(part) for node in ast.walk(tree) if isinstance(node, ast.JoinedStr) for part in node.values
            }
            prose = {
                id(node.body[0].value)
                for node in ast.walk(tree)
                if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef)
                if node.body and isinstance(node.body[0], ast.Expr)
            }
            for node in ast.walk(tree):
                if id(node) in own | prose:
                    continue
                for code in CODE.findall(text := _text(node)):
                    yield code, " ".join(text.replace(f"[{code}]", "").split())


def _text(node: ast.AST) -> str:
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if isinstance(node, ast.JoinedStr):
        return "".join(_text(part) if isinstance(part, ast.Constant) else "…" for part in node.values)
    return ""


def _cell(text: str) -> str:
    return re.sub(r"([<>*_`|\[\]])", r"\\\1", text)


def page() -> str:
    """The page in Markdown."""
    parts = [HEAD]
    for room, rows in groupby(sorted(codes()), lambda row: row[0].rpartition("-")[0]):
        parts.append(f"\n## {room}\n\n| code | message |\n| --- | --- |\n")
        parts += [f'| <span class="nowrap">{code}</span> | {_cell(text)} |\n' for code, text in rows]
    return "".join(parts)


if __name__ == "__main__":
    print(page(), end="")
