"""The notebooks: numbered without gaps, committed with sound outputs, and they run."""

import importlib.util
import re
from pathlib import Path

import nbformat
import pytest

from hybrid_mpc import Loop
from hybrid_mpc import load as load_kit

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "notebooks"
FILES = sorted(FOLDER.glob("*.ipynb"))
# "/a/b" where no word, number, "." , ":" (of an address) or "<" (of a closing tag) stands before it, or "C:\"
ABSOLUTE = re.compile(r"(?<![\w.:/<~*)])/[A-Za-z_][\w.-]*/|\b[A-Z]:\\\\?\w")
MODULE = re.compile(r"^\s*(?:from|import) ((?:hybrid_mpc|nn_export|scenarios)[\w.]*)", re.MULTILINE)


def load(name):
    spec = importlib.util.spec_from_file_location(name, FOLDER / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def read(path):
    return nbformat.read(path, as_version=4)


def code(notebook):
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def texts(notebook):
    """Everything textual in the outputs."""
    for cell in code(notebook):
        for output in cell.outputs:
            yield output.get("text", "")
            yield from (v for mime, v in output.get("data", {}).items() if mime.startswith("text/"))


def errors(notebook):
    return [o.ename for cell in code(notebook) for o in cell.outputs if o.output_type == "error"]


def test_cells_are_short_and_the_last_one_says_what_to_try_next():
    for path in FILES:
        notebook = read(path)
        longest = max(len(cell.source.splitlines()) for cell in code(notebook))
        assert longest <= 25, (path.name, longest)
        assert notebook.cells[-1].cell_type == "markdown", path.name
        assert "## Next\n" in notebook.cells[-1].source, path.name


def test_the_model_of_the_notebooks_can_be_used():
    """It has the present format: a kit with models, noise and control problem."""
    kit = load_kit(FOLDER / "golf_robot")
    assert set(kit.models) == {"prior", "hybrid"}
    loop = Loop(kit.observer(), kit.controller())
    assert loop.start([0.1]).shape == (1,)


def test_there_are_notebooks_and_they_are_numbered():
    assert FILES
    assert all(re.fullmatch(r"\d\d_[a-z0-9_]+\.ipynb", path.name) for path in FILES)
    numbers = [int(path.name[:2]) for path in FILES]
    assert sorted(numbers) == list(range(1, len(numbers) + 1))


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_committed_outputs(path):
    notebook = read(path)
    nbformat.validate(notebook)
    counts = [cell.execution_count for cell in code(notebook)]
    assert counts == list(range(1, len(counts) + 1))  # executed whole and in order
    assert not errors(notebook)
    assert any("image/png" in o.get("data", {}) for cell in code(notebook) for o in cell.outputs)
    assert not [m.group() for text in texts(notebook) for m in [ABSOLUTE.search(text)] if m]
    assert not [o.text for cell in code(notebook) for o in cell.outputs if o.get("name") == "stderr"]
    assert notebook.metadata.kernelspec.name == "python3"
    assert set(notebook.metadata) == {"kernelspec", "language_info"}
    assert not any(cell.metadata for cell in notebook.cells)


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_only_what_the_reference_shows(path):
    shown = set(
        re.findall(r"^::: ([\w.]+)", "\n".join(p.read_text() for p in (ROOT / "docs/api").glob("*.md")), re.M)
    )
    used = {name for cell in code(read(path)) for name in MODULE.findall(cell.source)}
    assert used <= shown | {"hybrid_mpc"}


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_links_between_the_notebooks(path):
    prose = "\n".join(cell.source for cell in read(path).cells if cell.cell_type == "markdown")
    for link in re.findall(r"\]\(([^)\s]+)\)", prose):
        assert link.startswith("http") or (FOLDER / link).exists(), link


def test_a_notebook_on_recordings_says_what_it_needs(monkeypatch, tmp_path):
    """Without its recordings the first cell ends with where they are from, their columns and where to put them."""
    monkeypatch.setenv("HYBRID_MPC_RECORDINGS", str(tmp_path))
    monkeypatch.syspath_prepend(FOLDER)
    for path in FILES:
        first, *_ = code(read(path))
        if "HYBRID_MPC_RECORDINGS" in first.source:
            cells = re.sub("(?m)^%.*", "", first.source)
            with pytest.raises(FileNotFoundError, match=r"https://.*columns time_s.*HYBRID_MPC_RECORDINGS"):
                exec(compile(cells, path.name, "exec"), {})


@pytest.mark.full
@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_it_runs(path):
    tool = load("execute")
    if tool.VARIABLE in code(read(path))[0].source and not tool.RECORDINGS.is_dir():
        pytest.skip("its recordings are not here")
    fresh = tool.clean(tool.execute(path))  # a cell that fails raises
    assert not [m.group() for text in texts(fresh) for m in [ABSOLUTE.search(text)] if m]
    assert [len(c.outputs) > 0 for c in code(fresh)] == [len(c.outputs) > 0 for c in code(read(path))]


@pytest.mark.full
def test_the_cells_that_a_newcomer_opens_first_run():
    """In this process, with a short training; nothing is drawn that a cell only shows."""
    cells = "\n".join(cell.source for cell in code(read(FILES[0])))
    cells, changed = re.subn(r"(teacher|free_run)_steps=\d+", r"\1_steps=20", re.sub("(?m)^%.*", "", cells))
    assert changed == 2
    found = {}
    exec(compile(cells, FILES[0].name, "exec"), found)
    assert found["model"].n_h > 0
