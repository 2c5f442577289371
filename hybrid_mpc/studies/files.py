"""Studies in YAML files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from hybrid_mpc.errors import InputError
from hybrid_mpc.studies.configuration import Study
from hybrid_mpc.studies.words import built


def read_study(path: str | Path, **instead: Any) -> Study:
    r"""The study that a YAML file describes: its keys are the fields of :class:`~hybrid_mpc.studies.Study`.

    Folders of models, and a scenario that is a ``.py`` file, are meant from the folder of the YAML file. The name is
    that of the file if it gives none.

    Args:
        path: The file.
        instead: Fields that replace those of the file, e.g. ``models``.

    Raises:
        InputError: If the file is missing or no YAML, a key is unknown (with the nearest valid one), or the study is
            not valid.

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
    if str(keys.get("scenario", "")).endswith(".py"):
        keys["scenario"] = str(here / keys["scenario"])
    keys.update(instead)
    if "models" not in keys:
        raise InputError(f"{path}: no models; add 'models: {{label: FOLDER}}', or give --model FOLDER")
    study = built(Study, keys, str(path))
    return study if "name" in keys else replace(study, name=path.stem)


def _mapping(path: Path) -> dict[str, Any]:
    import yaml

    try:
        found = yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise InputError(f"{path} is no YAML: {' '.join(str(error).split())}") from error
    if not isinstance(found, dict):
        raise InputError(f"{path}: a mapping of keys to values is needed, got {type(found).__name__}")
    return found
