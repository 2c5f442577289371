"""Studies in YAML files."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

from hybrid_mpc.errors import InputError
from hybrid_mpc.files import read_bytes
from hybrid_mpc.records import record
from hybrid_mpc.scenario import scenario_of
from hybrid_mpc.studies.configuration import Study

MOST_YAML = 2**16
"""Largest study [bytes] that is read."""


def read_study(path: str | Path, **instead: Any) -> Study:
    r"""The study that a YAML file describes: its keys are the fields of :class:`~hybrid_mpc.studies.Study`.

    Folders of models are meant from the folder of the YAML file. The name is that of the file if it gives none. A
    settings file runs nothing: its scenario is a registered name; a ``.py`` file is given as ``scenario=`` (on the
    command line ``--scenario FILE.py``).

    Args:
        path: The file.
        instead: Fields that replace those of the file, e.g. ``models``.

    Raises:
        InputError: If the file is missing or no YAML, its scenario is not registered, a key is unknown (with the
            nearest valid one), or the study is not valid.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "mine.yaml"
        >>> _ = path.write_text("scenario: golf_robot\nmodels: {z32: runs/golf}\nseeds: 2\n")
        >>> study = read_study(path)
        >>> study.name, study.seeds, study.folders["z32"] == path.parent / "runs/golf"
        ('mine', (0, 1), True)
    """
    path = Path(path)
    keys = _mapping(path)
    models, here = keys.get("models"), path.parent
    if isinstance(models, str):
        models = {"model": models}
    if isinstance(models, dict):
        keys["models"] = {label: here / str(folder) for label, folder in models.items()}
    keys.update(instead)
    if "scenario" not in instead and isinstance(keys.get("scenario"), str):
        scenario_of(keys["scenario"], path)
    if "models" not in keys:
        raise InputError(f"{path}: no models; add 'models: {{label: FOLDER}}', or give --model FOLDER")
    study = record(Study, keys, str(path))
    return study if "name" in keys else replace(study, name=path.stem)


def _mapping(path: Path) -> dict[str, Any]:
    import yaml

    try:
        found = yaml.load(read_bytes(path, MOST_YAML), Loader=_loader())
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path} is no YAML: {' '.join(str(error).split())[:300]}") from error
    if not isinstance(found, dict):
        raise InputError(f"{path}: a mapping of keys to values is needed, got {type(found).__name__}")
    return {str(key): value for key, value in found.items()}


@cache
def _loader() -> Any:
    """A YAML loader of plain data: texts, numbers, true, false, null, lists and mappings with each key once.

    YAML 1.1, which PyYAML reads, makes of ``on`` a flag, of ``2024-01-01`` a date and of ``1:30`` a number; here they
    are the texts that they look like (YAML 1.2, core schema). Anchors and aliases, with which a small file becomes a
    huge one, are refused.
    """
    import yaml

    class Loader(yaml.SafeLoader):
        yaml_implicit_resolvers: dict[str, Any] = {}  # noqa: RUF012  its own, none of YAML 1.1

        def compose_node(self, parent: Any, index: Any) -> Any:
            event = self.peek_event()
            if getattr(event, "anchor", None) is not None:
                raise yaml.composer.ComposerError(
                    None,
                    None,
                    "anchors (&) and aliases (*) are not read; write the value out",
                    event.start_mark,
                )
            return super().compose_node(parent, index)

        def construct_mapping(self, node: Any, deep: bool = False) -> Any:
            keys = [key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode)]
            if len(set(keys)) < len(keys):
                twice = next(key for key in keys if keys.count(key) > 1)
                raise yaml.constructor.ConstructorError(
                    None, None, f"{twice!r} stands twice", node.start_mark
                )
            return super().construct_mapping(node, deep)

    for tag, pattern, first in _PLAIN:
        Loader.add_implicit_resolver(f"tag:yaml.org,2002:{tag}", re.compile(rf"^(?:{pattern})$"), list(first))
    return Loader


_PLAIN = (
    ("bool", "true|True|TRUE|false|False|FALSE", "tTfF"),
    ("null", "~|null|Null|NULL|", ["~", "n", "N", ""]),
    ("int", r"[-+]?[0-9]{1,20}", "-+0123456789"),
    ("float", r"[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)",
     "-+.0123456789"),
)  # fmt: skip
"""Kinds of plain words of YAML 1.2's core schema, with the letters that they begin with."""
