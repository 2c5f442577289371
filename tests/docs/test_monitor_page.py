"""The tables of docs/energy-guard.md are those that the study wrote."""

from pathlib import Path

DOCS = Path(__file__).parents[2] / "docs"
SHOWN = ("False alarms", "Median delay [s] at a wanted rate of 0.25", "Mean costs")


def test_page_has_the_tables_of_the_study():
    blocks = (DOCS / "results" / "monitor" / "table.md").read_text().split("\n\n")
    page = (DOCS / "energy-guard.md").read_text().split("\n\n")
    for start in SHOWN:
        (place,) = (i for i, block in enumerate(blocks) if block.startswith(start))
        table = blocks[place + 1].strip()
        assert len(table.splitlines()) > 6  # head, rule, and a row for each method, fault or reaction
        head = table.splitlines()[0]
        assert [block.strip() for block in page if block.startswith(head)] == [table]
