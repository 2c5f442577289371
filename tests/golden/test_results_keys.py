"""Keys of ``results.json``: what other programs read. A change of them is to be seen as a change of two text files."""

from golden_parts import HERE, schema_lines


def lines(name):
    return [line.partition(": ")[::2] for line in (HERE / name).read_text().splitlines()]


def test_the_schema_is_the_one_written_down():
    assert schema_lines() == (HERE / "results_schema.txt").read_text().splitlines()


def test_the_demo_has_what_the_schema_says():
    found = {path for path, _ in lines("results_keys.txt")}
    kinds = {path.rstrip("?"): kind for path, kind in lines("results_schema.txt")}
    assert not set(kinds) - found
    inside = tuple(f"{path}{sign}" for path, kind in kinds.items() if kind != "an object" for sign in ".[")
    free = {path for path in found - set(kinds) if not path.startswith(inside)}
    beside = {path for path in free if "details" in path.split(".") or path.endswith("reason")}
    assert free == beside
