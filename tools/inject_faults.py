"""
Faults of the system at each write of a study and of a fit: is the result the same after going on?

    python tools/inject_faults.py [--step 1] [--only study fit] [--faults kill torn ENOSPC EIO EROFS]

A small study (tables, images, text) and a fit of a catalog in pieces are done once as they are. Then, at each call
of the system that writes, renames, makes, removes or flushes a file of their folder, they are done with a fault
there: the process is killed before the call, or after half of it, or the call fails (on a full and on a read-only
disk all later calls fail too). What failed must end with an error that names a file. Then it is done again without
a fault: all files must have the bytes of the undisturbed run, and no other may be left. The calls are those of
the C library, in front of which a small library is loaded (``LD_PRELOAD``), so that this needs Linux and ``cc``.
"""

import argparse
import ctypes
import errno
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

SHIM = r"""
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <signal.h>
#include <stdarg.h>
#include <stdio.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

static char folder[PATH_MAX];
static long calls, at = -1;
static int fault;  /* an error number, -1 to be killed before, -2 after half of a write */

void fault_set(const char *place, long number, int what)
{
    strncpy(folder, place, sizeof folder - 1);
    calls = 0; at = number; fault = what;
}
long fault_calls(void) { return calls; }

static int inside(const char *path) { return folder[0] && strncmp(path, folder, strlen(folder)) == 0; }
static int inside_fd(int fd)
{
    char link[64], path[PATH_MAX];
    if (!folder[0]) return 0;
    snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
    ssize_t n = readlink(link, path, sizeof path - 1);
    if (n < 0) return 0;
    path[n] = 0;
    return inside(path);
}
/* 1 if the call fails, 2 if it is cut in half and is the last */
static int now(void)
{
    long k = calls++;
    if (at < 0 || k < at) return 0;
    if (fault == -1) kill(getpid(), SIGKILL);
    if (fault == -2) return 2;
    if (k > at && fault == EIO) return 0;
    errno = fault;
    return 1;
}
#define REAL(type, name, ...) \
    static type (*real)(__VA_ARGS__); \
    if (!real) real = dlsym(RTLD_NEXT, #name)

ssize_t write(int fd, const void *data, size_t n)
{
    REAL(ssize_t, write, int, const void *, size_t);
    int what = inside_fd(fd) ? now() : 0;
    if (what == 1) return -1;
    if (what == 2) { real(fd, data, n / 2); kill(getpid(), SIGKILL); }
    return real(fd, data, n);
}
size_t fwrite(const void *data, size_t size, size_t n, FILE *file)
{
    REAL(size_t, fwrite, const void *, size_t, size_t, FILE *);
    int what = inside_fd(fileno(file)) ? now() : 0;
    if (what == 1) return 0;
    if (what == 2) { real(data, size, n / 2, file); fflush(file); kill(getpid(), SIGKILL); }
    return real(data, size, n, file);
}
static int path_fails(const char *path)
{
    int what = inside(path) ? now() : 0;
    if (what == 2) kill(getpid(), SIGKILL);
    return what;
}
int rename(const char *from, const char *to)
{
    REAL(int, rename, const char *, const char *);
    return path_fails(to) ? -1 : real(from, to);
}
int renameat(int a, const char *from, int b, const char *to)
{
    REAL(int, renameat, int, const char *, int, const char *);
    return path_fails(to) ? -1 : real(a, from, b, to);
}
int mkdir(const char *path, mode_t mode)
{
    REAL(int, mkdir, const char *, mode_t);
    return path_fails(path) ? -1 : real(path, mode);
}
int unlink(const char *path)
{
    REAL(int, unlink, const char *);
    return path_fails(path) ? -1 : real(path);
}
int fsync(int fd)
{
    REAL(int, fsync, int);
    return inside_fd(fd) && now() ? -1 : real(fd);
}
#define OPEN(name) \
int name(const char *path, int flags, ...) \
{ \
    REAL(int, name, const char *, int, ...); \
    va_list rest; va_start(rest, flags); mode_t mode = va_arg(rest, mode_t); va_end(rest); \
    if ((flags & O_CREAT) && path_fails(path)) return -1; \
    return real(path, flags, mode); \
}
OPEN(open)
OPEN(open64)
"""
FAULTS = {"kill": -1, "torn": -2} | {
    name: getattr(errno, name) for name in ("ENOSPC", "EIO", "EROFS")
}
#: Files that differ from run to run: they have times, or say who works.
OWN = ("manifest.json", ".manifest.copy.json", "run.lock", ".run.lock", "fit.lock", ".fit.lock")


def build(folder):
    """Compile the library; its path."""
    source, library = folder / "shim.c", folder / "shim.so"
    source.write_text(SHIM)
    subprocess.run(["cc", "-shared", "-fPIC", "-O1", "-o", library, source, "-ldl"], check=True)
    return library


def make_work(only):
    """Two functions that fill a folder: a study and a fit of a catalog in pieces."""
    import astropy.units as u
    import numpy as np
    from astropy.nddata import CCDData
    from astropy.table import QTable

    from miricigale import BayesFitter, SEDModel
    from miricigale.fitting import GridSettings, fit_file
    from miricigale.workflow.config import StudyConfig
    from miricigale.workflow.engine.runner import StudyRunner
    from miricigale.workflow.engine.stage import Stage

    flux = np.linspace(1, 2, 40) * u.uJy

    def first(context, unit):
        context.save_table(f"{unit}/table.ecsv", QTable({"id": np.arange(40), "flux": flux}))
        context.save_table(f"{unit}/table.fits", QTable({"id": np.arange(40), "flux": flux}))
        image = np.random.default_rng(1).normal(size=(64, 64)).astype("f4")
        context.save_image(f"{unit}/image.fits", CCDData(image, unit="MJy/sr"))

    def second(context, _):
        text = "".join(context.path(f"{unit}/table.ecsv").read_text() for unit in "ab")
        context.save("report/index.html", lambda path: path.write_text(text))

    stages = (
        Stage("first", first, "first", units=lambda _: "ab"),
        Stage("second", second, "second", needs=("first",)),
    )
    axes = SEDModel.yang2021_axes("quick") | {"redshift": [0.5, 1.0]}
    axes = {key: values[:2] for key, values in axes.items()}
    bands = ["wfc3.f160w", "miri.f770w", "miri.f1500w"]
    settings = GridSettings(interpolate=0)
    fitter = BayesFitter(SEDModel.yang2021().grid(axes, bands), settings=settings)
    catalog = QTable({"id": np.arange(6)})
    for band in bands:
        catalog[band], catalog[f"{band}_err"] = (
            np.linspace(1, 2, 6) * u.uJy,
            np.full(6, 0.1) * u.uJy,
        )

    def study(folder):
        StudyRunner(StudyConfig(), folder, stages).run()

    def fit(folder):
        fit_file(fitter, catalog_path, folder, chunk_rows=3)

    catalog_path = Path(tempfile.mkdtemp()) / "catalog.fits"
    catalog.write(catalog_path)
    # everything that is read, compiled or kept on the way is so before
    work = {name: one for name, one in {"study": study, "fit": fit}.items() if name in only}
    for one in work.values():
        with tempfile.TemporaryDirectory() as folder:
            one(Path(folder) / "out")
    return work


def contents(folder):
    """Bytes of the files of a folder by name, but for those that have times."""
    files = {p.relative_to(folder): p for p in folder.rglob("*") if p.is_file()}
    return {str(name): path.read_bytes() for name, path in files.items() if name.name not in OWN}


def products(folder):
    """What the manifest says of the files."""
    values = json.loads((folder / "manifest.json").read_text())
    records = next(v for k, v in values.items() if k in ("stages", "parts"))
    return {key: (record["hash"], record["products"]) for key, record in records.items()}


def in_child(function, folder, library, at=-1, fault=0):
    """Do it in a forked process with a fault; its status, its error in words, and the calls that it made."""
    reads, writes = os.pipe()
    child = os.fork()
    if not child:
        os.close(reads)
        shim, said = ctypes.CDLL(library), ""
        shim.fault_set(os.fsencode(folder), ctypes.c_long(at), fault)
        try:
            function(folder)
        except BaseException as err:
            said = f"{type(err).__name__}: {err}"
        calls = shim.fault_calls()
        shim.fault_set(b"", ctypes.c_long(-1), 0)
        os.write(writes, json.dumps([said, calls]).encode())
        os._exit(0)
    os.close(writes)
    with os.fdopen(reads) as stream:
        text = stream.read()
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    said, calls = json.loads(text) if text else ("", 0)
    return status, said, calls


def wrong(function, whole, place, library, at, name):
    """What is wrong after a fault at a call; empty if nothing is."""
    folder = place / "out"
    shutil.rmtree(folder, ignore_errors=True)
    status, said, _ = in_child(function, folder, library, at, FAULTS[name])
    if FAULTS[name] < 0:
        if status != -signal.SIGKILL:
            return f"was not killed: {status} {said}"
    elif said and str(folder) not in said:
        return f"the error names no file: {said}"
    elif said and not said.startswith(
        ("OSError", "DataError", "PermissionError", "FileNotFoundError")
    ):
        return f"another error: {said}"
    status, again, _ = in_child(function, folder, library)
    if status or again:
        return f"cannot go on: {again or status} (before: {said})"
    found, made = contents(folder), products(folder)
    if found != whole[0] or made != whole[1]:
        names = sorted(k for k in found.keys() | whole[0].keys() if found.get(k) != whole[0].get(k))
        return f"other files: {names} (before: {said})"
    return ""


def main(step, only, faults, library):
    work = make_work(only)
    n_wrong = 0
    for what, function in work.items():
        with tempfile.TemporaryDirectory() as place:
            place = Path(place)
            calls = in_child(function, place / "out", library)[2]
            whole = contents(place / "out"), products(place / "out")
            begin, n = time.time(), 0
            for name in faults:
                for at in range(0, calls, step):
                    n += 1
                    if text := wrong(function, whole, place, library, at, name):
                        n_wrong += 1
                        print(f"{what}, call {at}, {name}: {text}", flush=True)
                print(f"{what}, {name}: {calls} calls, {time.time() - begin:.0f} s", flush=True)
        seconds = time.time() - begin
        print(f"{what}: {calls} calls, {n} faults, {seconds:.0f} s", flush=True)
    print(f"{n_wrong} went wrong")
    return n_wrong > 0


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--step", type=int, default=1, help="every which call")
    parser.add_argument("--only", nargs="+", default=["study", "fit"], help="what is done")
    parser.add_argument("--faults", nargs="+", choices=FAULTS, default=list(FAULTS))
    args = parser.parse_args()
    if "MIRICIGALE_FAULTS" in os.environ:
        sys.exit(main(args.step, args.only, args.faults, os.environ["MIRICIGALE_FAULTS"]))
    with tempfile.TemporaryDirectory() as folder:
        library = str(build(Path(folder)))
        # one thread: forks of a process with threads can hang
        limits = {"NUMBA_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        environment = {**os.environ, **limits, "LD_PRELOAD": library, "MIRICIGALE_FAULTS": library}
        sys.exit(subprocess.run([sys.executable, *sys.argv], env=environment).returncode)
