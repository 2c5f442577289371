"""A file that one process at a time may hold; the system lets go of it when the process ends, however it ends."""

from __future__ import annotations

import sys
from typing import IO

if sys.platform == "win32":
    import msvcrt

    def hold(file: IO[str]) -> None:
        """Hold an open file until it is closed.

        Raises:
            OSError: If another process, or another open of the same file, holds it.
        """
        file.seek(0)
        msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)  # its first byte, which need not be there

else:
    import fcntl

    def hold(file: IO[str]) -> None:
        """Hold an open file until it is closed.

        Raises:
            OSError: If another process, or another open of the same file, holds it.

        Example:
            >>> import tempfile
            >>> with tempfile.NamedTemporaryFile("w") as one, open(one.name, "w") as two:
            ...     hold(one)
            ...     try:
            ...         hold(two)
            ...     except OSError:
            ...         print("it is held")
            it is held
        """
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
