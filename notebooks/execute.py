"""Execute notebooks and keep their outputs in them: ``python notebooks/execute.py [FILE.ipynb ...]``; default: all."""

from __future__ import annotations

import base64
import io
import os
import sys
import tempfile
from pathlib import Path
from typing import Any

import nbformat
from nbclient import NotebookClient
from PIL import Image

HERE = Path(__file__).parent
COLOURS = 128
"""Colours of a kept picture: it looks the same and takes half the bytes."""
LONGEST = 900
"""Most seconds one cell may take, on a machine that is busy otherwise."""
VARIABLE = "HYBRID_MPC_RECORDINGS"
"""Environment variable with the folder of real recordings, a folder a machine."""
RECORDINGS = Path(os.environ.get(VARIABLE, HERE.parents[1] / "shared" / "data"))
"""That folder; default: the one beside the repository that tests and benchmarks read."""


def execute(path: Path) -> nbformat.NotebookNode:
    """The notebook with fresh outputs, executed in a folder of its own; the file is left alone.

    Args:
        path: The notebook.

    Raises:
        nbclient.exceptions.CellExecutionError: If a cell fails.
    """
    notebook = nbformat.read(path, as_version=4)
    python = os.pathsep.join(p for p in (str(HERE.parent), str(HERE), os.environ.get("PYTHONPATH")) if p)
    with tempfile.TemporaryDirectory() as folder:
        where = {"metadata": {"path": folder}}
        client = NotebookClient(notebook, timeout=LONGEST, resources=where, record_timing=False)
        own = {"PYTHONPATH": python, "OMP_NUM_THREADS": "1", VARIABLE: str(RECORDINGS)}
        client.execute(env={**os.environ, **own})
    return notebook


def clean(notebook: nbformat.NotebookNode) -> nbformat.NotebookNode:
    """What is committed: no metadata of the machine that it ran on, small pictures."""
    kernel = {"name": "python3", "display_name": "Python 3", "language": "python"}
    notebook.metadata = nbformat.from_dict({"kernelspec": kernel, "language_info": {"name": "python"}})
    for cell in notebook.cells:
        cell.metadata = nbformat.from_dict({})
        for output in cell.get("outputs", []):
            picture = output.get("data", {}).get("image/png")
            if picture is not None:
                output["data"]["image/png"] = _smaller(picture)
                output["metadata"] = nbformat.from_dict({})
    return notebook


def _smaller(picture: str) -> str:
    image: Any = Image.open(io.BytesIO(base64.b64decode(picture))).convert("RGB")
    buffer = io.BytesIO()
    image.quantize(COLOURS, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE).save(
        buffer, "PNG", optimize=True
    )
    return base64.b64encode(buffer.getvalue()).decode()


def main(files: list[str]) -> None:
    """Execute the files and replace them, each whole or not at all."""
    for path in [Path(name) for name in files] or sorted(HERE.glob("[0-9][0-9]_*.ipynb")):
        text = nbformat.writes(clean(execute(path)))
        part = path.with_suffix(".part")
        part.write_text(text + "\n", encoding="utf-8")
        part.replace(path)
        print(f"{path.name}: {len(text) // 1000} kB")


if __name__ == "__main__":
    main(sys.argv[1:])
