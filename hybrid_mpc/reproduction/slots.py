"""Which process a job runs in, as the terminal shows it. No torch in here."""

from __future__ import annotations


class Slots:
    """Gives every running job a place, so that the terminal has a bar a process and not one a job.

    Args:
        count: Processes side by side.

    Example:
        >>> slots = Slots(2)
        >>> slots.name("one"), slots.name("two"), slots.name("one")
        ('process 1', 'process 2', 'process 1')
        >>> slots.free("one")
        >>> slots.name("three")
        'process 1'
    """

    def __init__(self, count: int) -> None:
        self._held: dict[int, str] = {}
        self._count = count

    def name(self, key: str) -> str:
        """Place of a job; a new one takes the first that is free."""
        slot = next((i for i, held in self._held.items() if held == key), None)
        if slot is None:
            slot = next((i for i in range(self._count) if i not in self._held), self._count)
            self._held[slot] = key
        return f"process {slot + 1}"

    def free(self, key: str) -> None:
        """The job is over."""
        self._held = {i: held for i, held in self._held.items() if held != key}
