"""Migration of a kit from an older format to the present one."""

from __future__ import annotations

import math
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeVar

from hybrid_mpc.errors import InputError
from hybrid_mpc.files import check_folder, is_file, read_document, read_object, replacing_folder, sha256
from hybrid_mpc.kit.assembly import sensor_steps
from hybrid_mpc.kit.parts import (
    HYBRID,
    KIT,
    MODELS,
    OBSERVER,
    OLD_FILE,
    OLD_FILES,
    OLD_SCHEMA,
    PROGRAMS,
    SPLIT_SCHEMA,
    TASKS,
    Description,
    LoopSettings,
    ModelInfo,
    ObserverSettings,
    Parts,
    Provenance,
    TaskList,
    TaskProblem,
    WatchFile,
    read_parts,
    write_description,
    write_observer,
    write_tasks,
    write_watch,
)
from hybrid_mpc.kit.prediction import Predicting
from hybrid_mpc.kit.promises import PROMISES
from hybrid_mpc.records import record
from hybrid_mpc.rules import Line, Name, NameOrNone, Text
from hybrid_mpc.watch.detector import ChannelLimit, WatchLimits
from hybrid_mpc.watch.energy import FORCES
from hybrid_mpc.watch.lengths import LONG_S, SHORT_S, machine_second
from hybrid_mpc.watch.readings import ENERGY, FROZEN_STEPS, RESIDUALS
from hybrid_mpc.watch.residuals import free_run_of

R = TypeVar("R")


@dataclass(frozen=True)
class OldDetector:
    """Detector of the energy in version 5 and older."""

    dt: float
    force: tuple[tuple[float, ...], ...]
    energy: tuple[float, ...]
    drift: float
    force_threshold: float
    energy_threshold: float = math.inf
    release: float = 0.5
    rest_speed: tuple[float, ...] = ()
    false_alarms_per_hour: float = math.nan
    hours: float = 0.0
    interval: tuple[float, ...] = ()
    method: Line = ""
    data_hash: Line = ""
    time_unit: float = 1.0

    def limits(self, info: ModelInfo, sensor_sigma: tuple[float, ...]) -> WatchLimits:
        """The detector's thresholds as limits of channels."""
        n_q = len(info.states) // 2
        (rate,) = (b.rate_unit for b in info.balances if b.name == ENERGY)
        low = [self.interval[i : i + 2] for i in (0, 2)]
        channels = [
            ChannelLimit(
                f"force of {q.name}", FORCES.get((rate, v.unit), f"{rate}/({v.unit})"), 0, self.force_threshold,
                self.release * self.force_threshold, scale, self.drift, low[0],
            )
            for q, v, scale in zip(info.states[:n_q], info.states[n_q:], self.force, strict=True)
        ]  # fmt: skip
        if self.energy:
            least = self.energy_threshold
            power = "power of the free run"
            channels.append(
                ChannelLimit(power, rate, 1, least, self.release * least, self.energy, 0.0, low[1])
            )
        far = tuple(FROZEN_STEPS * step for step in sensor_steps(sensor_sigma)) or (math.inf,) * n_q
        return WatchLimits(
            kind=ENERGY,
            dt=self.dt,
            channels=tuple(channels),
            travel=far,
            repeats=(0,) * n_q,
            false_alarms_per_hour=self.false_alarms_per_hour,
            hours=self.hours,
            method=self.method,
            rated=True,
            rest_speed=self.rest_speed,
            data_hash=self.data_hash,
            time_unit=self.time_unit,
        )


@dataclass(frozen=True)
class OldCalibration:
    """Calibration in version 5 and older: unused thresholds of the energy's levels, detector, rest speeds."""

    threshold_w: float | None
    release_w: float | None
    false_alarms_per_hour: float
    n_samples: int
    hours: float
    method: Line
    data_hash: Line = ""
    residual_threshold: float | None = None
    residual_release: float | None = None
    detector: OldDetector | None = None
    rest_speed: tuple[float, ...] | None = None


@dataclass(frozen=True)
class OldResidualLimits:
    """Limits of residuals in version 5 and older."""

    channels: tuple[str, ...]
    dt: float
    threshold: tuple[tuple[float, float], ...]
    release: tuple[tuple[float, float], ...]
    travel: tuple[float, ...]
    repeats: tuple[int, ...]
    false_alarms_per_hour: float
    hours: float
    method: Line = ""
    rated: bool = True

    def limits(self, info: ModelInfo) -> WatchLimits:
        """The limits as limits of channels."""
        units = {s.name: s.unit for s in (*info.outputs, *info.disturbances)}
        units |= {b.name: b.rate_unit for b in info.balances}
        units |= {free_run_of(s.name): s.unit for s in info.outputs}
        second = machine_second(info.dt, info.time_unit)
        lengths = [max(1, round(length * second / info.dt)) for length in (SHORT_S, LONG_S)]
        channels = tuple(
            ChannelLimit(name, units[name], length, most, least)
            for name, tops, ends in zip(self.channels, self.threshold, self.release, strict=True)
            for length, most, least in zip(lengths, tops, ends, strict=True)
        )
        return WatchLimits(
            kind=RESIDUALS,
            dt=self.dt,
            channels=channels,
            travel=self.travel,
            repeats=self.repeats,
            false_alarms_per_hour=self.false_alarms_per_hour,
            hours=self.hours,
            method=self.method,
            rated=self.rated,
            time_unit=info.time_unit,
        )


@dataclass(frozen=True)
class OldEnergy:
    """Content of ``watch/energy.json`` in version 5."""

    calibration: OldCalibration
    of: Line = ""


@dataclass(frozen=True)
class OldChannels:
    """Content of ``watch/residuals.json`` in version 5."""

    limits: Mapping[Name, OldResidualLimits]
    of: Mapping[Name, Line] = field(default_factory=dict)


@dataclass(frozen=True)
class OldGuard:
    """Content of ``guard.json`` in version 5."""

    detector: OldDetector | None
    reason: Text = ""
    of: Line = ""


@dataclass(frozen=True)
class OldDescription:
    """Content of ``model.json`` in version 4; its fields are those of the present files."""

    models: tuple[Name, ...]
    programs_sha256: Line
    model: ModelInfo
    calibration: OldCalibration | None
    provenance: Provenance
    loop: LoopSettings = field(default_factory=LoopSettings)
    recommended: NameOrNone = ""
    residuals: Mapping[Name, OldResidualLimits] = field(default_factory=dict)
    members: int = 0
    predicting: Predicting | None = None


def migrate_kit(old: str | Path, new: str | Path) -> Path:
    """Write a kit of format version 4 (``model.json``) or 5 in the present format, into a new folder.

    Numbers, programs and promises are copied; nothing is computed. Unused thresholds of the energy's levels are left
    out.

    Args:
        old: The old kit's folder, or the folder of its run; it is not changed.
        new: Folder to write; it must be new or empty.

    Returns:
        The new folder.

    Raises:
        InputError: If ``old`` holds no kit of version 4 or 5, or a damaged one, or if ``new`` is not empty.
        StorageError: If the new folder cannot be written; no partial folder is left.

    Example:
        ``migrate_kit("runs/old", "kit")``
    """
    folder, target = _old_folder(Path(old)), Path(new)
    check_folder(target)
    single = is_file(folder / OLD_FILE)
    held = _single(folder) if single else _split(folder)
    with replacing_folder(target) as place:
        (place / MODELS).mkdir()
        for name in OLD_FILES[1:]:
            shutil.copyfile(folder / name if single else folder / MODELS / name, place / MODELS / name)
        if sha256(place / PROGRAMS) != held.programs_sha256:
            raise InputError(
                f"{folder}: {OLD_FILES[1]} was changed after the kit was saved. Copy the folder from its run again "
                "[HM-KIT-026]"
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
    loop, calibration, info = held.loop, held.calibration, held.model
    write_tasks(place, loop)
    models = read_parts(place).models
    write_observer(
        place,
        ObserverSettings(
            loop.sensor_sigma, loop.first_sigma, loop.process_noise, loop.disturbance_model, models
        ),
    )
    parts = read_parts(place)  # limits of another observer have been left out
    watch = {
        name: WatchFile({RESIDUALS: own.limits(info)}, of=parts.observer(name))
        for name, own in held.residuals.items()
    }
    if calibration is not None:
        known = watch.get(HYBRID) or WatchFile({}, of=parts.observer(HYBRID))
        energy = {} if calibration.detector is None else {
            ENERGY: calibration.detector.limits(info, loop.sensor_sigma)
        }  # fmt: skip
        watch[HYBRID] = replace(
            known, limits={**energy, **known.limits}, rest_speed=calibration.rest_speed or ()
        )
    write_watch(place, watch)


def _old_folder(folder: Path) -> Path:
    for place in (folder, folder / "model"):
        if is_file(place / OLD_FILE):
            return place
        if is_file(place / KIT) and read_object(place / KIT).get("schema_version") == SPLIT_SCHEMA:
            return place
    raise InputError(
        f"{folder}: no kit of an older format, so there is nothing to migrate. Give the folder of such a kit "
        "[HM-KIT-027]"
    )


def _single(folder: Path) -> OldDescription:
    """A kit of version 4."""
    path = folder / OLD_FILE
    if (version := read_object(path).get("schema_version")) != OLD_SCHEMA:
        raise InputError(
            f"{path}: format version {version!r} (field schema_version); only versions {OLD_SCHEMA} and {SPLIT_SCHEMA} "
            "can be migrated. Run the scenario again [HM-KIT-028]"
        )
    found = _read(folder, OLD_FILE, OldDescription)
    assert found is not None
    return found


def _split(folder: Path) -> OldDescription:
    """A kit of version 5, without limits of other models or another observer."""
    known = _read(folder, KIT, Description)
    assert known is not None
    observer, tasks = (
        _read(folder, OBSERVER, ObserverSettings) or ObserverSettings(),
        _read(folder, TASKS, TaskList),
    )
    tasks = tasks or TaskList()
    control = {} if tasks.control is None else {"": tasks.control}
    for name in tasks.own:
        problem = _read(folder, f"tasks/{name}.json", TaskProblem)
        if problem is not None:
            control[name] = problem.control
    loop = LoopSettings(
        control, observer.sensor_sigma, observer.first_sigma, observer.process_noise, tasks.causes, tasks.safe_input,
        tasks.tasks, observer.disturbance_model,
    )  # fmt: skip
    parts = Parts(known, loop, {}, {})
    energy, guard = _read(folder, "watch/energy.json", OldEnergy), _read(folder, "guard.json", OldGuard)
    calibration, of = None, ("", parts.observer(HYBRID))
    if energy is not None and energy.of in of:
        calibration = energy.calibration
    if guard is not None and guard.of in of and guard.detector is not None:
        none = OldCalibration(None, None, 0.0, 0, 0.0, "", rest_speed=guard.detector.rest_speed or None)
        calibration = replace(calibration or none, detector=guard.detector)
    channels = _read(folder, "watch/residuals.json", OldChannels) or OldChannels({})
    residuals = {
        m: own for m, own in channels.limits.items() if channels.of.get(m, "") in ("", parts.observer(m))
    }
    return OldDescription(
        models=known.models,
        programs_sha256=known.programs_sha256,
        model=known.model,
        calibration=calibration,
        provenance=known.provenance,
        loop=loop,
        recommended=known.recommended,
        residuals=residuals,
        members=known.members,
        predicting=known.predicting,
    )


def _read(folder: Path, file: str, kind: type[R]) -> R | None:
    path = folder / file
    if not is_file(path):
        return None
    document = read_document(path, "take the folder from its run again")
    del document["schema_version"]
    return record(kind, document, str(path))
