"""The journal of a search: Optuna's, in lines of JSON, bound to its search."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import optuna
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend
from optuna.trial import TrialState

from hybrid_mpc.errors import InputError
from hybrid_mpc.files import MOST_CONTENT, read_bytes

STUDY = "hybrid-mpc search"


def open_study(storage: Path, identity: Mapping[str, str]) -> optuna.Study:
    """The study of a journal, whose trials are all finished or given up.

    Args:
        storage: The journal; made if missing.
        identity: Hashes by name of everything that decides what the trials are.

    Raises:
        InputError: If the journal is damaged or another search's.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     open_study(Path(folder) / "search.jsonl", {"seed": "0"}).user_attrs
        {'identity': {'seed': '0'}}
    """
    storage.parent.mkdir(parents=True, exist_ok=True)
    _mend(storage)
    try:
        # whole path: a lock is a link to it, which has to lead somewhere
        journal = JournalStorage(JournalFileBackend(str(storage.resolve())))
        names = optuna.get_all_study_names(journal)
        with _quiet():
            make = optuna.load_study if STUDY in names else optuna.create_study
            study = make(storage=journal, study_name=STUDY)
        held = study.user_attrs.get("identity", {})
    except (ValueError, KeyError, TypeError, AttributeError, OSError) as error:
        raise InputError(
            f"{storage} is no journal of a search or is damaged ({type(error).__name__}: {error}); choose another "
            "file or delete it to search anew"
        ) from error
    if not held and not study.trials:  # new, or killed before it was named
        study.set_user_attr("identity", dict(identity))
    elif differ := [name for name in identity if held.get(name) != identity[name]]:
        raise InputError(
            f"{storage} holds another search ({', '.join(differ)} differ); go on with the same ones or choose "
            "another file"
        )
    for _ in study.get_trials(states=(TrialState.WAITING,)):  # drawn, not begun, when the search was ended
        study.ask()
    for trial in study.get_trials(states=(TrialState.RUNNING,)):
        study.tell(trial.number, state=TrialState.FAIL)
    return study


def _mend(storage: Path) -> None:
    """Cut off a line that a kill left unfinished."""
    if storage.is_file():
        content = read_bytes(storage, MOST_CONTENT)
        whole = content.rfind(b"\n") + 1
        if whole < len(content):
            os.truncate(storage, whole)


@contextmanager
def _quiet() -> Iterator[None]:
    """Without Optuna's word that a study was made or found."""
    before = optuna.logging.get_verbosity()
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    try:
        yield
    finally:
        optuna.logging.set_verbosity(before)
