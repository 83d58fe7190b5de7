"""One process at a time in a folder: a lock file that says who holds it."""

import contextlib
import datetime
import errno
import json
import os
import platform
import secrets
import stat
import subprocess
import time
import weakref
from pathlib import Path

from miricigale.utils.exceptions import DataError
from miricigale.utils.files import writing

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

# what link says where there are no hard links
_NO_LINKS = {errno.EPERM, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS, errno.EMLINK}
# longer than another process takes to finish a lock file, in seconds
_SETTLED = 10.0
_PATIENCE = 2.0
# handle of a lock that is held by its file alone
_CLOSED = -1


class FolderLock:
    """
    Context manager that keeps other processes out of a folder.

    The file names host, boot, process and the start time of the process, so that a number that
    the system gave to another process since is not taken for the owner. A lock whose owner is
    gone is taken over, by one process only. A lock of another host is never taken for left over,
    for its processes cannot be seen from here.

    Parameters
    ----------
    folder : path-like
        The folder, which must exist.
    name : str, optional
        Name of the lock file in it.
    purpose : str, optional
        What the folder is used for, for the message.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        On entering, if another process (or this one) holds the lock; the message names the
        process and the file.

    Notes
    -----
    While it is held the file is also locked by ``flock``, where the file system knows that. The
    kernel frees that lock with the process, whatever its number, so that two containers on one
    machine that share a folder and a host name see each other. It also decides which of several
    processes takes over what was left.
    """

    def __init__(self, folder, *, name="run.lock", purpose="run"):
        self.folder = Path(folder)
        self.path = self.folder / name
        self.purpose = purpose
        self._handle = self._text = None

    def __enter__(self):
        if self._handle is not None:
            raise self._refusal(_identity())
        # a file of its own that becomes the lock in one step: no lock is ever half written
        spare = self.path.with_name(f"{self.path.name}.{secrets.token_hex(8)}")
        try:
            self._write(spare)
            give_up = time.monotonic() + _PATIENCE
            while not (self._place(spare) or self._replace(spare, give_up)):
                time.sleep(0.02)
        except BaseException:
            self._close()
            raise
        finally:
            spare.unlink(missing_ok=True)
        _HELD.add(self)
        return self

    def __exit__(self, *exc):
        if self._handle is None:
            # a forked child, which does not hold what its parent holds
            return
        # only one's own: the file may have been removed by hand and made by another process
        with contextlib.suppress(FileNotFoundError):
            if self.path.read_text(encoding="utf-8") == self._text:
                self.path.unlink()
        self._close()

    def _close(self):
        handle, self._handle = self._handle, None
        if handle not in (None, _CLOSED):
            os.close(handle)

    def _write(self, spare):
        self._text = json.dumps(_identity()) + "\n"
        self._handle = os.open(spare, os.O_CREAT | os.O_EXCL | os.O_RDWR, 0o644)
        data = self._text.encode()
        with writing(self.path):
            while data:
                # on a disk that is nearly full a part is written first
                data = data[os.write(self._handle, data) :]
        self._flocks = _flock(self._handle) is True
        if not self._flocks:
            # nothing is held by it, and Windows removes no open file
            os.close(self._handle)
            self._handle = _CLOSED

    def _place(self, spare):
        """Whether the lock could be made, for there was none."""
        try:
            os.link(spare, self.path)
        except FileExistsError:
            return False
        except OSError as err:
            if err.errno not in _NO_LINKS:
                raise
            try:
                os.close(os.open(self.path, os.O_CREAT | os.O_EXCL | os.O_RDWR, 0o644))
            except FileExistsError:
                return False
            os.replace(spare, self.path)
        return True

    def _replace(self, spare, give_up):
        """Whether the lock of a process that is gone was taken over; False to try again."""
        try:
            # a link that leads nowhere could neither be made nor read, a pipe be waited for
            if not stat.S_ISREG(os.lstat(self.path).st_mode):
                msg = f"{self.path} is no plain file, as locks are: remove it"
                raise DataError(msg)
            handle = os.open(self.path, os.O_RDWR)
        except FileNotFoundError:
            return False
        except PermissionError as err:
            msg = f"{self.folder} is locked by {self.path}, which this user may not open"
            raise DataError(msg) from err
        try:
            return self._judge(handle, spare, give_up)
        finally:
            os.close(handle)

    def _judge(self, handle, spare, give_up):
        state = os.fstat(handle)
        owner = _owner(os.read(handle, 65536).decode("utf-8", "replace"))
        if owner and _in_use(owner):
            raise self._refusal(owner)
        held = _flock(handle)
        if held is False or (not owner and abs(time.time() - state.st_mtime) < _SETTLED):
            # another process is at it: it takes the lock over, or writes it, or cannot be seen
            if time.monotonic() < give_up:
                return False
            raise self._refusal(owner)
        if held is None or not self._flocks:
            raise self._refusal(owner, gone=True)
        # of all who find this file only one holds it by flock, and while the name stands for it
        # no other process replaces it
        with contextlib.suppress(FileNotFoundError):
            if os.path.samestat(state, os.stat(self.path)):
                os.replace(spare, self.path)
                return True
        return False

    def _refusal(self, owner, *, gone=False):
        owner = owner or {}
        where = f"process {owner.get('pid', '(unknown)')} on {owner.get('host', 'unknown host')}"
        if owner.get("started"):
            where += f", started {owner['started']}"
        if gone:
            msg = (
                f"{self.folder} was left by a {self.purpose} that is gone ({where}); this file "
                f"system has no flock to take it over with: remove {self.path}"
            )
        elif owner and not _same_host(owner):
            msg = (
                f"{self.folder} is in use by a {self.purpose} on another host: {where}; whether it "
                f"still runs cannot be seen from {platform.node()}: if it is gone, remove {self.path}"
            )
        else:
            msg = (
                f"{self.folder} is in use by a {self.purpose}: {where}; "
                f"if that process is gone, remove {self.path}"
            )
        return DataError(msg)


_HELD = weakref.WeakSet()


def _leave_to_parent():
    """In a forked child: what is open there would outlive the parent."""
    for lock in list(_HELD):
        lock._close()
    _HELD.clear()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_leave_to_parent)


def _flock(handle):
    """Lock an open file: True if it is ours now, False if another has it, None if unknown here."""
    if fcntl is None:
        return None
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except (BlockingIOError, PermissionError):
        return False
    except OSError:
        return None
    return True


def _owner(text):
    """What a lock file says of its owner; None if it says nothing that can be used."""
    text = text.strip()
    if text.isascii() and text.isdigit():
        # an earlier form: the number of a process, taken to be of this host
        return _place_of_birth() | {"pid": int(text), "old": True}
    try:
        owner = json.loads(text)
        return owner if isinstance(owner["pid"], int) and isinstance(owner["host"], str) else None
    except (ValueError, KeyError, TypeError, RecursionError):
        return None


def _in_use(owner):
    """Whether the process that wrote a lock runs, or may run."""
    if not _same_host(owner):
        return True
    here = _place_of_birth()
    if owner.get("boot") and here["boot"] and owner["boot"] != here["boot"]:
        return False
    if owner.get("old") and owner["pid"] == os.getpid():
        # this version does not write such locks: the number was another process's
        return False
    start = _process_start(owner["pid"])
    if start is None:
        return False
    return not (owner.get("start") and start and owner["start"] != start)


def _same_host(owner):
    here = _place_of_birth()
    return owner["host"] == here["host"] and owner.get("machine") == here["machine"]


def _identity():
    """What a lock says of this process."""
    now = datetime.datetime.now(datetime.UTC)
    pid = os.getpid()
    return _place_of_birth() | {
        "pid": pid,
        "start": _process_start(pid) or "",
        "started": now.strftime("%Y-%m-%d %H:%M:%S UTC"),
        "token": secrets.token_hex(8),
    }


def _place_of_birth():
    """Host and boot; the machine's id distinguishes hosts of the same name."""
    return {
        "host": platform.node() or "localhost",
        "machine": _first_line("/etc/machine-id"),
        "boot": _first_line("/proc/sys/kernel/random/boot_id"),
    }


def _first_line(path):
    try:
        return Path(path).read_text(encoding="utf-8").strip()
    except (OSError, ValueError):
        return ""


def _process_start(pid):
    """When a process started, as text to compare; "" if not known, None without such a process."""
    if os.name == "nt":
        # there the signal 0 is Ctrl+C
        return ""
    try:
        if pid <= 0:
            return None
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return None
    except PermissionError:
        pass
    # the name of the program, in parentheses, may hold anything
    state, _, rest = _first_line(f"/proc/{pid}/stat").rpartition(")")[2].strip().partition(" ")
    if state:
        # a process that ended and was not waited for holds nothing any more
        return None if state in "ZX" else rest.split()[18]
    try:
        return subprocess.run(
            ["ps", "-o", "lstart=", "-p", str(pid)],
            env=os.environ | {"LC_ALL": "C", "TZ": "UTC"},
            capture_output=True,
            text=True,
            timeout=10,
            check=False,
        ).stdout.strip()
    except (OSError, subprocess.TimeoutExpired):
        return ""
