"""``hybrid-mpc doctor``: installed packages, and the hardware that a job will use; imports nothing heavy."""

from __future__ import annotations

import os
import platform
import re
import shlex
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path
from typing import Literal

from hybrid_mpc import __version__
from hybrid_mpc.engine import THREADS

PACKAGE = "hybrid-mpc"
WAIT_S = 1.0
"""Longest wait [s] for another program."""
State = Literal["ok", "absent", "wrong"]


@dataclass(frozen=True)
class Finding:
    """One result: name, what was found, its state, and a remedy if it is not ok."""

    name: str
    found: str
    state: State = "ok"
    remedy: str = ""


def examine() -> list[Finding]:
    """All findings, in the order in which they are printed."""
    return [
        Finding("hybrid-mpc", f"{__version__}, Python {platform.python_version()}, {platform.platform(terse=True)}"),
        *_packages(),
        _compiler(),
        _threads(),
        _gpu(),
        *_folders(),
    ]  # fmt: skip


def _packages() -> Iterator[Finding]:
    """Required packages, then the extras."""
    try:
        needed = requires(PACKAGE) or []
    except PackageNotFoundError:
        yield Finding(
            "packages", "hybrid-mpc itself is not installed, so its requirements are unknown", "wrong",
            "pip install 'hybrid-mpc[all]', or in the source tree pip install -e '.[all]'",
        )  # fmt: skip
        return
    extras: dict[str, list[str]] = {"": []}
    for line in needed:
        marker = re.search(r"extra\s*==\s*['\"]([\w-]+)['\"]", line)
        named = re.match(r"[\w.-]+", line)
        if named and named[0].lower().replace("_", "-") != PACKAGE:
            extras.setdefault(marker[1] if marker else "", []).append(named[0])
    for extra, names in extras.items():
        there = {name: _version(name) for name in dict.fromkeys(names)}
        text = ", ".join(f"{name} {found or 'missing'}" for name, found in there.items())
        if not text:
            continue
        complete = all(there.values())
        state: State = "ok" if complete else "absent" if extra else "wrong"
        remedy = (
            "" if complete else f"pip install 'hybrid-mpc[{extra}]'" if extra else "pip install hybrid-mpc"
        )
        yield Finding(f"extra {extra}" if extra else "needed", text, state, remedy)


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return ""


def _compiler() -> Finding:
    """The compiler that :func:`nn_export.compile_function` uses: ``CC``, else cc, gcc or clang."""
    named = os.environ.get("CC")
    for command in [named] if named else ["cc", "gcc", "clang"]:
        words = shlex.split(command)
        if words and shutil.which(words[0]):
            lines = _told([*words, "--version"]).splitlines()
            text = f"{command}: {lines[0]}" if lines else f"{command}, version unknown"
            return Finding("C compiler", text)
    what = f"CC = {named} is not a command" if named else "none found (cc, gcc, clang)"
    remedy = "install a compiler: without one, models run slower in CasADi's virtual machine"
    return Finding("C compiler", what, "absent", remedy)


def _threads() -> Finding:
    try:
        cores = len(os.sched_getaffinity(0))
    except AttributeError:  # not on every system
        cores = os.cpu_count() or 1
    settings = ", ".join(f"{name}={os.environ[name]}" for name in THREADS if name in os.environ)
    return Finding("threads", f"{cores} cores; BLAS and OpenMP: {settings or 'one thread per core'}")


def _gpu() -> Finding:
    """GPUs that the driver lists, and whether the installed torch can use them."""
    torch = _version("torch")
    names = (
        re.findall(r"GPU \d+: ([^(\n]+)", _told(["nvidia-smi", "-L"])) if shutil.which("nvidia-smi") else []
    )
    if not names:
        return Finding("GPU", "none found (nvidia-smi); networks train on the CPU")
    text = ", ".join(name.strip() for name in names)
    if torch.endswith("+cpu"):
        remedy = "install torch with CUDA, then use --device cuda"
        return Finding("GPU", f"{text}, but torch {torch} cannot use this GPU", "absent", remedy)
    return Finding("GPU", f"{text}; train with --device cuda" if torch else text)


def _told(command: list[str]) -> str:
    """The output of a program; empty if it fails."""
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=WAIT_S, check=False)
    except (OSError, subprocess.SubprocessError):
        return ""
    return done.stdout if done.returncode == 0 else ""


def _folders() -> Iterator[Finding]:
    """Folders that jobs write besides ``--out``: compiled models, matplotlib's fonts, temporary files."""
    cache = os.environ.get("XDG_CACHE_HOME") or os.environ.get("LOCALAPPDATA") or ""
    home = Path(cache) if cache and Path(cache).is_absolute() else Path.home() / ".cache"
    for name, folder, variable in (
        ("cache", home, "XDG_CACHE_HOME"), ("temporary files", Path(tempfile.gettempdir()), "TMPDIR"),
    ):  # fmt: skip
        if _can_be_written(folder):
            yield Finding(name, f"{folder} is writable")
        else:
            remedy = f"set {variable} to a writable folder"
            yield Finding(name, f"{folder} is not writable", "wrong", remedy)


def _can_be_written(folder: Path) -> bool:
    """Whether a file can be created in a folder, or in its nearest existing parent."""
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    try:
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False
