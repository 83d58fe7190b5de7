"""One process at a time in a folder: a lock, and a file that says who holds it."""

import datetime
import json
import os
import platform
from pathlib import Path

from filelock import FileLock, Timeout

from miricigale.utils.exceptions import DataError, data_error
from miricigale.utils.files import replacing

# a child that a killed process has just forked holds the lock until it runs; in seconds
_PATIENCE = 0.3


class FolderLock:
    """
    Context manager that keeps other processes out of a folder.

    The lock is one of the operating system (``flock``, or its like), which frees it with the process
    that held it, whatever ended that process. A file names host, process and start time. One of
    another host is never taken for left over, for not every network file system passes
    locks on to other hosts.

    Parameters
    ----------
    folder : path-like
        The folder, which must exist.
    name : str, optional
        Name of the file that says who holds the lock; the lock itself is the same name behind a
        dot, an empty file that stays.
    purpose : str, optional
        What the folder is used for, for the message.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        On entering, if another process (or this one) holds the lock, with the process and the file in the
        message, or the file system has no locks.
    """

    def __init__(self, folder, *, name="run.lock", purpose="run"):
        self.folder = Path(folder)
        self.path = self.folder / name
        self.purpose = purpose
        self._lock = FileLock(self.folder / f".{name}", timeout=_PATIENCE)

    def __enter__(self):
        if self._lock.is_locked:
            raise self._refusal()
        try:
            self._lock.acquire(poll_interval=0.02)
        except Timeout:
            raise self._refusal() from None
        except PermissionError as err:
            raise data_error(self._lock.lock_file, "is a lock that this user may not open") from err
        except OSError as err:
            problem = (
                f"cannot be locked ({err.strerror}): choose a folder on a file system with locks"
            )
            raise data_error(self._lock.lock_file, problem) from err
        try:
            # where locks are not passed on to other hosts the file alone says who was first
            if _is_elsewhere(self._owner()):
                raise self._refusal()
            begin = datetime.datetime.now(datetime.UTC)
            owner = _this_process() | {
                "pid": os.getpid(),
                "started": f"{begin:%Y-%m-%d %H:%M:%S} UTC",
            }
            with replacing(self.path) as partial:
                partial.write_text(json.dumps(owner) + "\n", encoding="utf-8")
        except BaseException:
            self._lock.release()
            raise
        return self

    def __exit__(self, *exc):
        # a forked child does not hold what its parent holds
        if self._lock.is_locked:
            self.path.unlink(missing_ok=True)
            self._lock.release()

    def _owner(self):
        """What the file says of the owner; empty if it says nothing that can be used."""
        try:
            owner = json.loads(self.path.read_text(encoding="utf-8"))
            if isinstance(owner["host"], str):
                return owner
            return {}
        except (FileNotFoundError, ValueError, KeyError, TypeError, RecursionError):
            return {}

    def _refusal(self):
        owner = self._owner()
        holder = f"process {owner.get('pid', '(unknown)')} on {owner.get('host', 'unknown host')}"
        if owner.get("started"):
            holder += f", started {owner['started']}"
        # where locks are not passed on, the file that names the owner is the lock
        elsewhere = _is_elsewhere(owner)
        if elsewhere:
            place = " on another host"
            file = self.path
        else:
            place = ""
            file = self._lock.lock_file
        return DataError(
            f"{self.folder} is in use by a {self.purpose}{place}: {holder}; "
            f"if that process is gone, remove {file}"
        )


def _is_elsewhere(owner):
    """Whether a file names an owner on another host."""
    return bool(owner) and not _this_process().items() <= owner.items()


def _this_process():
    """This host; the machine's id distinguishes hosts of the same name."""
    try:
        machine = Path("/etc/machine-id").read_text(encoding="utf-8").strip()
    except (OSError, ValueError):
        machine = ""
    return {"host": platform.node() or "localhost", "machine": machine}
