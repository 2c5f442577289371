"""Codes of error messages: each message has one, no two share one, and the page of the docs lists them."""

from __future__ import annotations

import ast
import re
import runpy
from collections import Counter
from pathlib import Path

import pytest

from hybrid_mpc.errors import CODE, Collected, InputError, refuse

ROOT = Path(__file__).resolve().parents[1]
PAGE = runpy.run_path(str(ROOT / "docs" / "site" / "errors.py"))
PROSE = 3
"""Words from which on a message is one of its own, and not only a place before another's."""


def _message(node: ast.AST) -> str:
    """Text of a message's literal parts; empty of one that is computed elsewhere."""
    if isinstance(node, ast.JoinedStr | ast.Constant):
        return str(PAGE["_text"](node))
    if isinstance(node, ast.BinOp | ast.IfExp):
        return " ".join(_message(part) for part in ast.iter_child_nodes(node))
    return ""


def test_no_two_messages_share_a_code() -> None:
    counts = Counter(code for code, _ in PAGE["codes"]())
    assert len(counts) > 900
    assert not [code for code, count in counts.items() if count > 1]


@pytest.mark.parametrize("package", PAGE["PACKAGES"])
def test_every_input_error_has_a_code(package: str) -> None:
    lacking = []
    for path in sorted((ROOT / package).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not (isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call) and node.exc.args):
                continue
            if getattr(node.exc.func, "id", "") not in ("InputError", "StorageError", "ProgramError"):
                continue
            text = _message(node.exc.args[0])
            if len(re.findall(r"[a-z]{2,}", text)) >= PROSE and not CODE.search(text):
                lacking.append(f"{path.relative_to(ROOT)}:{node.lineno}: {text[:80]}")
    assert not lacking


def test_the_page_lists_every_code() -> None:
    """``python docs/site/errors.py > docs/errors.md`` writes it."""
    assert (ROOT / "docs" / "errors.md").read_text(encoding="utf-8") == PAGE["page"]()


def test_an_error_tells_the_codes_of_all_its_problems() -> None:
    own = Collected()
    own.add("a.csv: is empty. [HM-DATA-001]")
    own.add("b.csv: no time. [HM-DATA-002]")
    with pytest.raises(InputError) as caught:
        own.refuse()
    assert caught.value.codes == ("HM-DATA-001", "HM-DATA-002")
    with pytest.raises(InputError) as one:
        refuse(["a: not positive [HM-MODEL-003]"])
    assert one.value.codes == ("HM-MODEL-003",)
