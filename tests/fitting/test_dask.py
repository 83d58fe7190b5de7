"""Workers in other processes: the same numbers, and the grid travels once."""

import operator
import os
import pickle
import signal
import time
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from functools import partial
from multiprocessing import get_context

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from helpers.grids import draw_photometry, make_grid
from helpers.results import assert_same
from miricigale.fitting import BayesFitter, FitFlags, fit_file
from miricigale.utils.parallel import parallel_map


class Weighing(ProcessPoolExecutor):
    """Processes, and what the tasks that were sent to them weigh."""

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.n_bytes = []

    def submit(self, function, *args):
        self.n_bytes.append(len(pickle.dumps((function, args))))
        return super().submit(function, *args)


@pytest.fixture(scope="module")
def photometry(fitter):
    return draw_photometry(fitter.grid, 24, missing=0.1)[0]


@pytest.fixture(scope="module")
def fitter():
    # half a megabyte, as pickled
    return BayesFitter(make_grid(n_z=20, n_tau=12, n_age=12, n_b=20))


@pytest.fixture(scope="module")
def process():
    with Weighing(1, mp_context=get_context("spawn")) as executor:
        yield executor


@pytest.fixture(scope="module")
def whole(fitter, photometry, process):
    """
    A fit in one other process, which loads the kernels that this one has compiled.

    Code that was compiled a moment ago, with all that it calls in sight, and the same from
    numba's cache may differ in the last digits: only the latter is what workers run.
    """
    fitter.fit(photometry[:1])
    return fitter.fit(photometry, executor=process)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*an id that occurred before")
def test_two_dask_workers_give_the_numbers_of_one_process(
    fitter, photometry, whole, process, tmp_path
):
    """And the bytes of its files, where one of them is killed."""
    distributed = pytest.importorskip("distributed")
    photometry = photometry.copy()
    photometry["id"][20] = photometry["id"][3]
    photometry.write(tmp_path / "catalog.fits")
    one, two = (tmp_path / name for name in ("one", "two"))
    arguments = {"path_in": tmp_path / "catalog.fits", "chunk_rows": 4}
    options = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": ":0"}
    with (
        distributed.LocalCluster(**options) as cluster,
        distributed.Client(cluster) as client,
        ThreadPoolExecutor(1) as other,
    ):
        pids = list(client.run(os.getpid).values())
        assert len(pids) == 2

        def kill():
            while not (two / "part-00002.fits").exists():
                time.sleep(0.01)
            os.kill(pids[0], signal.SIGKILL)

        executor, done = client.get_executor(), other.submit(kill)
        fit_file(fitter, path_out=two, executor=executor, **arguments)
        done.result()
    results = fit_file(fitter, path_out=one, executor=process, **arguments)
    names = sorted(path.name for path in one.iterdir())
    assert sorted(path.name for path in two.iterdir()) == names
    for name in names[1:]:
        assert (one / name).read_bytes() == (two / name).read_bytes(), name
    table = results.to_table()
    assert np.flatnonzero(table["flags"] & FitFlags.DUPLICATE_ID)[0] == 20
    for name, column in whole.to_table().items():
        mine, theirs = (np.delete(np.asarray(one), 20) for one in (table[name], column))
        assert_array_equal(mine, theirs, err_msg=name)


@pytest.mark.slow
def test_workers_that_are_left_or_start_later_keep_a_function():
    """Seconds after it was sent, when dask has taken back copies of data, with one worker after the other lost."""
    distributed = pytest.importorskip("distributed")
    from miricigale.utils.dask_workers import call_kept, kept_by_workers

    options = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": ":0"}
    with distributed.LocalCluster(**options) as cluster, distributed.Client(cluster) as client:
        with kept_by_workers(client, partial(operator.add, 1)) as name:
            time.sleep(3.0)
            for pid in list(client.run(os.getpid).values()):
                os.kill(pid, signal.SIGKILL)
                futures = client.map(partial(call_kept, name), range(4), pure=False)
                assert client.gather(futures) == [1, 2, 3, 4]
        client.wait_for_workers(2)
        kept = client.run(lambda dask_worker: name in dask_worker.plugins)
        assert not any(kept.values())


@pytest.mark.slow
def test_processes_get_the_grid_once(fitter, photometry, whole, process):
    assert len(pickle.dumps(fitter)) > 400_000
    process.n_bytes.clear()
    assert_same(fitter.fit(photometry, executor=process, chunk_size=4), whole)
    assert len(process.n_bytes) == 6
    # 4 objects, 20 bands and redshifts
    assert max(process.n_bytes) < 3750


def test_a_fault_in_a_worker_is_reported_and_leaves_no_file(process, tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    heavy = partial(operator.getitem, list(range(100_000)))
    with pytest.raises(IndexError, match="out of range"):
        parallel_map(heavy, [1, 2, 100_000, 4], executor=process)
    assert parallel_map(heavy, [4, 5], executor=process) == [4, 5]
    assert list(tmp_path.iterdir()) == []
