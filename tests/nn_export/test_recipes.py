"""The code in docs/export.md and docs/program-files.md runs, from top to bottom."""

import re
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[2] / "docs"
PAGES = DOCS / "export.md", DOCS / "program-files.md"


@pytest.mark.full
def test_the_recipes_run(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    text = "".join(page.read_text() for page in PAGES)
    blocks = re.findall(r"^```python\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    assert len(blocks) == 6  # the introduction, three recipes, expressions, limits
    namespace = {}
    for block in blocks:
        exec(compile(block, "docs", "exec"), namespace)
    printed = capsys.readouterr().out
    assert "Hessian-vector products" in printed
    assert "(1, 20)" in printed
    assert "Prior:(x[2],u)->(output[2])" in printed
    assert "\n0.6\n" in printed  # the power
    assert "program:(input[2100])->(output[2000])" in printed
    assert (tmp_path / "c_code" / "Step_test.c").is_file()
    report = namespace["parity"](namespace["module"], namespace["step"], n=10)
    assert report.value_rel < 1e-12  # the package's promise
