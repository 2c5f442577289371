"""A kit of the former format, of one file that several stages edited, written in the present one."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from hybrid_mpc.errors import InputError
from hybrid_mpc.files import check_folder, is_file, read_document, read_object, replacing_folder, sha256
from hybrid_mpc.kit.parts import (
    HYBRID,
    MODELS,
    OLD_FILE,
    OLD_FILES,
    OLD_SCHEMA,
    PROGRAMS,
    ChannelLimits,
    Description,
    EnergyLimits,
    GuardLimits,
    LoopSettings,
    ModelInfo,
    ObserverSettings,
    Provenance,
    read_parts,
    write_description,
    write_energy,
    write_guard,
    write_observer,
    write_residuals,
    write_tasks,
)
from hybrid_mpc.kit.prediction import Predicting
from hybrid_mpc.kit.promises import PROMISES
from hybrid_mpc.monitor.calibrate import Calibration
from hybrid_mpc.monitor.residuals import ResidualLimits
from hybrid_mpc.records import record
from hybrid_mpc.rules import Line, Name, NameOrNone


@dataclass(frozen=True)
class OldDescription:
    """What ``model.json`` held of a kit in the former format; the fields are those of the present files."""

    models: tuple[Name, ...]
    programs_sha256: Line
    model: ModelInfo
    calibration: Calibration | None
    provenance: Provenance
    loop: LoopSettings = field(default_factory=LoopSettings)
    recommended: NameOrNone = ""
    residuals: Mapping[Name, ResidualLimits] = field(default_factory=dict)
    members: int = 0
    predicting: Predicting | None = None


def migrate_kit(old: str | Path, new: str | Path) -> Path:
    """Write a kit of the former format (``model.json``) in the present one, into a new folder.

    Nothing is computed: numbers, programs and promises are the old ones.

    Args:
        old: The old kit's folder, or the folder of the run that holds it as ``model``; it stays as it is.
        new: Folder to make; new or empty.

    Returns:
        The new folder.

    Raises:
        InputError: If ``old`` holds no kit of the former format, or one that is still older or damaged; or if ``new``
            holds something.
        StorageError: If it cannot be written; nothing half-written is left.

    Example:
        ``migrate_kit("runs/old", "kit")``
    """
    folder, target = _old_folder(Path(old)), Path(new)
    check_folder(target)
    held = _read(folder)
    with replacing_folder(target) as place:
        (place / MODELS).mkdir()
        for name in OLD_FILES[1:]:
            shutil.copyfile(folder / name, place / MODELS / name)
        if sha256(place / PROGRAMS) != held.programs_sha256:
            raise InputError(
                f"{folder}: {OLD_FILES[1]} is not the one that {OLD_FILE} was saved with; take the folder from its run "
                "again"
            )
        write_description(
            place,
            Description(
                held.models, held.programs_sha256, held.model, held.provenance, held.recommended, held.members,
                held.predicting,
            ),
        )  # fmt: skip
        _write_rest(place, held)
        if is_file(folder / PROMISES):
            shutil.copyfile(folder / PROMISES, place / PROMISES)
    return target


def _write_rest(place: Path, held: OldDescription) -> None:
    loop, calibration = held.loop, held.calibration
    write_tasks(place, loop)
    models = read_parts(place).models
    write_observer(
        place,
        ObserverSettings(
            loop.sensor_sigma, loop.first_sigma, loop.process_noise, loop.disturbance_model, models
        ),
    )
    parts = read_parts(place)  # the old file was written whole, so its limits are of its observer
    if calibration is not None:
        observer = parts.observer(HYBRID)
        write_energy(place, EnergyLimits(replace(calibration, detector=None), observer))
        if calibration.detector is not None:
            write_guard(place, GuardLimits(calibration.detector, of=observer))
    if held.residuals:
        of = {name: parts.observer(name) for name in held.residuals}
        write_residuals(place, ChannelLimits(held.residuals, of))


def _old_folder(folder: Path) -> Path:
    for place in (folder, folder / "model"):
        if is_file(place / OLD_FILE):
            return place
    raise InputError(f"{folder} holds no kit of the former format ({OLD_FILE}); there is nothing to migrate")


def _read(folder: Path) -> OldDescription:
    path = folder / OLD_FILE
    if (version := read_object(path).get("schema_version")) != OLD_SCHEMA:
        raise InputError(
            f"{path} is of version {version!r} of the format (field schema_version); version {OLD_SCHEMA} alone can be "
            "migrated: train the models anew"
        )
    document = read_document(path, "take the folder from its run again")
    del document["schema_version"]
    return record(OldDescription, document, str(path))
