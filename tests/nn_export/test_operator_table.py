"""The document of the operators is the one the code makes, and lists all of them."""

from pathlib import Path

from nn_export.operators import OPERATORS
from nn_export.operators.table import GROUPS, document


def test_the_document_is_up_to_date():
    text = (Path(__file__).parents[2] / "docs" / "operators.md").read_text()
    assert text == document(), "run: python -m nn_export.operators.table > docs/operators.md"


def test_all_operators_are_in_a_group_and_in_the_document():
    grouped = [name for group in GROUPS.values() for name in group]
    assert sorted([*grouped, "getitem"]) == sorted(OPERATORS)
    rows = [line for line in document().splitlines() if line.startswith("| `")]
    assert len(rows) == len(grouped)
