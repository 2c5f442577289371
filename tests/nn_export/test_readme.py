"""The ten lines of the package's README run, and its own wheel takes every folder of it."""

import re
import tomllib
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[2] / "nn_export"


def test_the_lines_of_the_readme():
    (source,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    names = {}
    exec(source, names)
    found = names["ca"].Function("hessian", [names["x"], names["h"]], [names["hessian"]])
    value = found(np.ones(3), np.zeros(16)).full()
    np.testing.assert_allclose(value, value.T, atol=1e-14)
    assert np.abs(value).max() > 1e-3


def test_the_wheel_takes_every_folder_with_code():
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())
    folders = {p.parent.relative_to(ROOT.parent).as_posix().replace("/", ".") for p in ROOT.rglob("*.py")}
    assert set(settings["tool"]["setuptools"]["packages"]) == folders
