"""One process a folder: a lock that ends with the process that holds it, however that ends."""

import os
from pathlib import Path

try:
    import fcntl
except ImportError:  # Windows has no such locks: there nobody is kept out
    fcntl = None


class FolderLock:
    """The lock of a folder, held from here until ``release``.

    The system gives it up when the process ends, also when that is killed, so that no lock is ever left behind: the
    file ``.lock`` that stays means nothing by itself.

    Raises:
      ValueError: another process, or this one, holds it; the message names the folder and the process.
    """

    def __init__(self, folder: Path) -> None:
        self._file = (folder / ".lock").open("a+")
        if fcntl is None:
            return
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self._file.seek(0)
            holder = self._file.read(20).strip()
            self._file.close()
            who = f"process {holder}" if holder.isdigit() else "another process"
            raise ValueError(f"{folder}: {who} is training here; wait for its end or use another folder") from None
        except OSError:  # some network file systems have no locks
            return
        self._file.truncate(0)
        self._file.write(f"{os.getpid()}\n")
        self._file.flush()

    def release(self) -> None:
        """Lets others have it."""
        self._file.close()
