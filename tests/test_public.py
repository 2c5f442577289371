"""The public names of ``hybrid_mpc``: all there, documented, lazy; and what users read imports nothing else."""

import ast
import importlib
import inspect
import json
import pkgutil
import re
import subprocess
import sys
from pathlib import Path

import pytest

import hybrid_mpc as hm
from hybrid_mpc import plots

ROOT = Path(__file__).parents[1]
NAMESPACES = ("hybrid_mpc", "hybrid_mpc.plots")
"""What a machine, a notebook or an example may import from, of this package."""


def checked_types(module):
    """Home by name, as the TYPE_CHECKING block of a package says."""
    tree = ast.parse(Path(module.__file__).read_text())
    (block,) = [n for n in tree.body if isinstance(n, ast.If) and "TYPE_CHECKING" in ast.dump(n.test)]
    assert all(isinstance(node, ast.ImportFrom) for node in block.body)
    assert module is plots or all(
        a.asname == a.name for n in block.body for a in n.names
    )  # public in strict checks
    return {a.name: n.module.removeprefix(module.__name__).lstrip(".") for n in block.body for a in n.names}


def test_the_tables_agree():
    assert checked_types(hm) == {**hm._HOME, "plots": "", "terms": "machine"}
    assert len(hm._HOME) == sum(map(len, hm._ROOMS.values()))  # no name has two homes
    assert list(hm._ROOMS) == sorted(hm._ROOMS)
    assert checked_types(plots) == plots._HOME
    assert set(plots._HOME) < set(plots.__all__)


@pytest.mark.parametrize("package", [hm, plots], ids=lambda p: p.__name__)
def test_no_name_is_that_of_a_module(package):
    """A module that is imported becomes an attribute of its package, and would hide the name."""
    modules = {m.name for m in pkgutil.iter_modules(package.__path__)}
    assert modules & set(package.__all__) <= {"plots"}


@pytest.mark.parametrize("package", [hm, plots], ids=lambda p: p.__name__)
def test_every_name_is_there_and_documented(package):
    for name in package._HOME:
        found = getattr(package, name)
        if inspect.isclass(found) or inspect.isroutine(found):
            text = inspect.getdoc(found) or ""
            assert text, name
            assert not text.startswith(f"{name}("), (
                name
            )  # what a dataclass without a docstring says of itself
        else:
            home = importlib.import_module(f"{package.__name__}.{package._HOME[name]}")
            body = ast.parse(inspect.getsource(home)).body
            (place,) = (
                i
                for i, n in enumerate(body)
                if isinstance(n, ast.Assign | ast.AnnAssign) and name in assigned(n)
            )
            after = body[place + 1]
            assert isinstance(after, ast.Expr), name
            assert isinstance(after.value.value, str), name


def assigned(node):
    targets = node.targets if isinstance(node, ast.Assign) else [node.target]
    return {n.id for t in targets for n in ast.walk(t) if isinstance(n, ast.Name)}


def test_names_are_listed_and_others_refused():
    assert set(hm.__all__) <= set(dir(hm))
    with pytest.raises(AttributeError, match="'hybrid_mpc' has no attribute 'no_such_name'"):
        hm.no_such_name  # noqa: B018
    with pytest.raises(AttributeError, match=r"'hybrid_mpc.plots' has no attribute 'no_such_name'"):
        plots.no_such_name  # noqa: B018


def test_nothing_is_loaded_before_it_is_used():
    code = (
        "import sys\nimport hybrid_mpc as hm\ndir(hm)\n"
        "print({'numpy', 'scipy', 'pandas', 'matplotlib', 'casadi', 'torch'} & set(sys.modules))\n"
        "hm.DataSpec, hm.Scenario, hm.Parameter, hm.InputError\n"
        "print({'casadi', 'torch', 'pandas', 'matplotlib'} & set(sys.modules))\n"
        "hm.OCP, hm.HybridModel, hm.load, hm.Loop, hm.simulate, hm.Runner, hm.Monitor, hm.linearize\n"
        "print('torch' in sys.modules)\n"
        "hm.Prior, hm.MechanicalPrior, hm.fit_prior\nprint('torch' in sys.modules)\n"
        "hm.TorchPrior\nprint('torch' in sys.modules)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split("\n")[:-1] == ["set()", "set()", "False", "False", "True"]


def test_the_reference_lists_every_name():
    pages = [p.read_text() for p in (ROOT / "docs/api").glob("*.md")]
    lists = {package: [] for package in NAMESPACES}
    for page in pages:
        for package, names in re.findall(r"^Names of `([\w.]+)`: (.*?)\.$", page, re.S | re.M):
            lists[package] += re.findall(r"`(\w+)`", names)
    assert sorted(lists["hybrid_mpc"]) == sorted([*hm._HOME, "terms"])
    assert sorted(lists["hybrid_mpc.plots"]) == sorted(plots.__all__)


def python_of(path):
    """The Python in a file: itself, a notebook's cells, a page's examples."""
    text = path.read_text()
    if path.suffix == ".ipynb":
        cells = ["".join(c["source"]) for c in json.loads(text)["cells"] if c["cell_type"] == "code"]
        return [re.sub(r"^%.*", "", cell, flags=re.M) for cell in cells]
    return re.findall(r"^```python\n(.*?)^```", text, re.S | re.M) if path.suffix == ".md" else [text]


def imported(source):
    """``(module, name)`` of what a source imports of hybrid_mpc; the name of a whole module is None."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ImportFrom):
            pairs = [(node.module, alias.name) for alias in node.names]
        elif isinstance(node, ast.Import):
            pairs = [(alias.name, None) for alias in node.names]
        else:
            continue
        yield from (pair for pair in pairs if pair[0].split(".")[0] == "hybrid_mpc")


def foreign(source):
    """What a source imports of hybrid_mpc that is not public."""
    public = {"hybrid_mpc": hm.__all__, "hybrid_mpc.plots": plots.__all__}
    return [
        (module, name)
        for module, name in imported(source)
        if module not in public or (name is not None and name not in public[module])
    ]


USERS = [
    *(p for p in sorted((ROOT / "scenarios").rglob("*.py")) if not {"paper", "monitor_study"} & set(p.parts)),
    *sorted((ROOT / "notebooks").glob("*.ipynb")),
    *sorted((ROOT / "docs").rglob("*.md")),
    ROOT / "README.md",
]


def test_users_import_public_names_only():
    for path in USERS:
        assert not [found for source in python_of(path) for found in foreign(source)], path


def test_examples_were_found():
    found = [path for path in USERS if any(list(imported(source)) for source in python_of(path))]
    assert len([p for p in found if p.suffix == ".ipynb"]) >= 7
    assert len([p for p in found if p.suffix == ".md"]) >= 8
    assert len([p for p in found if p.suffix == ".py"]) >= 25
