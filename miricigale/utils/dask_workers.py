"""
Functions that every worker of dask keeps, so that one with much data is not sent with each piece of work.

Data that ``client.scatter(broadcast=True)`` sent are on one worker alone after two seconds: the scheduler takes
back copies (its active memory manager, distributed 2026.8.0), and what is lost with a worker cannot be made again.
Plugins of workers stay, and workers that start later get them.
"""

import contextlib
import uuid

from distributed import WorkerPlugin, get_worker


class KeptFunction(WorkerPlugin):
    """
    A function that a worker keeps.

    Parameters
    ----------
    function : callable
        A function that can be pickled.
    """

    def __init__(self, function):
        self.function = function


@contextlib.contextmanager
def kept_by_workers(client, function):
    """
    Let all workers keep a function, in a ``with`` block.

    Parameters
    ----------
    client : `distributed.Client`
        Of the workers.
    function : callable
        A function that can be pickled. The scheduler keeps it too.

    Yields
    ------
    name : str
        For `call_kept`, which workers are sent.
    """
    name = f"miricigale-{uuid.uuid4().hex}"
    client.register_plugin(KeptFunction(function), name=name)
    try:
        yield name
    finally:
        if client.status == "running":
            client.unregister_worker_plugin(name)


def call_kept(name, *arguments):
    """Call a function that this worker keeps."""
    return get_worker().plugins[name].function(*arguments)
