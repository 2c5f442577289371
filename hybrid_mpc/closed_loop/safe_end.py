"""The end of a run on a machine: whatever ends it, the safe input is handed over before anything else."""

from __future__ import annotations

import atexit
import signal
import threading
import time
import traceback
from collections.abc import Callable, Sequence
from types import FrameType, TracebackType
from typing import Any

from hybrid_mpc.errors import SafeInputError

ENDING = tuple(
    getattr(signal, name)
    for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "SIGBREAK", "SIGXCPU", "SIGTSTP")
    if hasattr(signal, name)
)
"""Signals that ask a program to end or to stand still, as far as the operating system has them: Ctrl-C, ``kill``, a
terminal that closes, Ctrl-\\, Ctrl-Break, a used-up limit of computing time, Ctrl-Z."""
PAUSES_S = (0.0, 0.01, 0.1, 1.0)
"""Pauses [s] before each further try to hand the safe input over: none after a message that a signal has cut off, then
what a bus or its driver may need to recover. No more, since a process that is to end must end."""


class Ended(BaseException):
    """Leads out of the block of a :class:`SafeEnd`, and never leaves it."""


class SafeEnd:
    """A block at whose end the safe input is handed over, however the block ends.

    When it ends by itself, or by any exception: ``hand_over()`` comes first, the exception is raised on. In the main
    thread also when a signal ends it (``ENDING``): the signal breaks off what the block is doing, the safe input is
    handed over, and only then the signal has the effect that it would have had without this block: the process ends by
    it, or ``KeyboardInterrupt`` is raised, or the program's own handler is called. If the program lives on, it goes on
    behind the block. Handlers are installed for the time of the block alone. Signals that are ignored, as under
    ``nohup``, stay so. While the safe input is handed over no signal interrupts; it waits.

    Another thread gets no signals. There the block ends when the interpreter does, which waits for it.

    Args:
        hand_over: Hands the safe input to the actuator. Where it raises it is called again after ``PAUSES_S``.

    Raises:
        SafeInputError: At the end of the block, if the safe input could not be handed over, from the first failure of
            ``hand_over``. If a signal then ends the process, the error is printed.

    Example:
        >>> held = [0.7]
        >>> with SafeEnd(lambda: held.append(0.0)) as end:
        ...     end.check()
        ...     raise OSError("the sensor's cable")
        Traceback (most recent call last):
        ...
        OSError: the sensor's cable
        >>> held
        [0.7, 0.0]
    """

    def __init__(self, hand_over: Callable[[], object]) -> None:
        self._hand_over = hand_over
        self._handler, self._armed = self._signalled, False
        self._previous: dict[int, Any] = {}
        self._signals: list[int] = []
        self._exiting, self._over = False, threading.Event()

    @property
    def cause(self) -> str:
        """What asked the block to end: the name of the first signal, ``"exit"`` of the interpreter, or nothing."""
        if self._signals:
            return signal.Signals(self._signals[0]).name
        return "exit" if self._exiting else ""

    def check(self) -> None:
        """End the block if that has been asked for. Call it often: a callback may have swallowed what a signal raised.

        Raises:
            Ended: If so.
        """
        if self.cause:
            raise Ended(self.cause)

    def __enter__(self) -> SafeEnd:
        self._thread = threading.current_thread()
        if self._thread is threading.main_thread():
            for number in ENDING:
                before = signal.getsignal(number)
                if before not in (signal.SIG_IGN, None):  # None: not Python's, so it could not be put back
                    self._previous[number] = before
                    signal.signal(number, self._handler)
        else:
            atexit.register(self._at_exit)
        self._armed = True
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> bool:
        self._armed = False
        failure = self._handed_over()
        for number, before in self._previous.items():
            if signal.getsignal(number) is self._handler:
                signal.signal(number, before)
        self._over.set()
        if not self._exiting:
            atexit.unregister(self._at_exit)
        if failure is not None and self._signals:  # the signal may leave no time to say so
            traceback.print_exception(failure)
        _deliver(list(dict.fromkeys(self._signals)))
        if failure is not None:
            raise failure
        return isinstance(error, Ended)

    def _handed_over(self) -> SafeInputError | None:
        failures: list[BaseException] = []
        for pause in (0.0, *PAUSES_S):
            try:
                time.sleep(pause)
                self._hand_over()
            except BaseException as failure:
                failures.append(failure)
            else:
                return None
        error = SafeInputError(
            f"the safe input could not be handed over: the actuator failed {len(failures)} times, at last with "
            f"{failures[-1]!r}. The machine may still follow the last input: cut its power"
        )
        error.__cause__ = failures[0]
        return error

    def _signalled(self, number: int, frame: FrameType | None) -> None:
        self._signals.append(number)
        entering_or_leaving = frame is not None and frame.f_code in _OWN
        if self._armed and not entering_or_leaving:
            raise Ended(self.cause)

    def _at_exit(self) -> None:
        """The interpreter ends: wait for the block's end, unless its thread is one of a parent process."""
        self._exiting = True
        if self._thread.is_alive():
            self._over.wait()


_OWN = (SafeEnd.__enter__.__code__, SafeEnd.__exit__.__code__)
"""A signal that arrives between the block and the first or last statement of these would else get past them."""


def _deliver(signals: Sequence[int]) -> None:
    """Let signals have their effect, each whatever those before it raise."""
    if signals:
        try:
            signal.raise_signal(signals[0])
        finally:
            _deliver(signals[1:])
