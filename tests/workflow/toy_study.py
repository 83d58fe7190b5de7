"""A study of small stages, run as a script: what is killed and compared in the tests."""

import sys
import time

from miricigale.utils.parallel import process_pool
from miricigale.workflow.config import StudyConfig
from miricigale.workflow.runner import StudyRunner
from miricigale.workflow.stage import Stage


def first(context, unit):
    time.sleep(0.05)
    for k in range(3):
        context.save(f"{unit}/{k}.txt", lambda path, k=k: path.write_text(f"{unit} {k}" * 1000))


def second(context, _):
    time.sleep(0.05)
    text = "".join(context.path(f"{unit}/{k}.txt").read_text() for unit in "abcd" for k in range(3))
    context.save("second.txt", lambda path: path.write_text(text))


def stages():
    return (
        Stage("first", first, "first", units=lambda _: "abcd"),
        Stage("second", second, "second", needs=("first",)),
    )


def main(folder, n_processes):
    config = StudyConfig.from_dict({"run": {"threads": n_processes}})
    with process_pool(n_processes) as executor:
        StudyRunner(config, folder, stages, executor=executor).run()


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
