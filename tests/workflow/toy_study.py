"""A study of small stages, run as a script or here: what is killed and compared in the tests."""

import contextlib
import os
import signal
import sys
import time
from pathlib import Path

from miricigale.utils.parallel import process_pool
from miricigale.workflow.config import StudyConfig
from miricigale.workflow.engine.cluster import cluster_executor
from miricigale.workflow.engine.runner import StudyRunner
from miricigale.workflow.engine.stage import Stage


def first(context, unit):
    time.sleep(0.05)
    # deaths of the process that does unit c, as many as the file beside the folder says
    deaths = Path(f"{context.products.folder}.deaths")
    if unit == "c" and deaths.is_file() and (left := int(deaths.read_text())):
        deaths.write_text(str(left - 1))
        context.save("c/0.txt", lambda path: os.kill(os.getpid(), signal.SIGKILL))
    text = f"{unit} {context.plan}"
    for k in range(3):
        context.save(f"{unit}/{k}.txt", lambda path, k=k: path.write_text(f"{text} {k}" * 1000))


def second(context, _):
    time.sleep(0.05)
    text = "".join(context.path(f"{unit}/{k}.txt").read_text() for unit in "abcd" for k in range(3))
    context.save("second.txt", lambda path: path.write_text(text))


def brightness(config, unit):
    """What units c and d take from the configuration."""
    return config.scene.background_scale if unit in "cd" else "nothing"


def stages():
    one = Stage("first", first, "first", units=lambda _: "abcd", plan=brightness)
    return one, Stage("second", second, "second", needs=("first",))


def main(folder, n_processes, *options):
    """Options are ``cluster``, ``redo``, and a number for units c and d; no process is this one."""
    numbers = [float(one) for one in options if one not in ("cluster", "redo")]
    scene = {"background_scale": numbers[0]} if numbers else {}
    config = StudyConfig.from_dict({"run": {"threads": n_processes}, "scene": scene})
    pool = on_cluster if "cluster" in options else process_pool
    with pool(n_processes) if n_processes else contextlib.nullcontext() as executor:
        StudyRunner(config, folder, stages, executor=executor, redo="redo" in options).run()


@contextlib.contextmanager
def on_cluster(n_workers):
    from distributed import LocalCluster

    with (
        LocalCluster(
            n_workers=n_workers, threads_per_worker=1, dashboard_address=":0", memory_limit="1GB"
        ) as cluster,
        cluster_executor(cluster.scheduler_address) as workers,
    ):
        places = workers.places().values()
        assert [place.slots for place in places] == n_workers * [1]
        assert all(abs(place.memory - 5e8) < 1 for place in places)
        yield workers


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), *sys.argv[3:])
