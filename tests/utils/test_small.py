"""Errors, provenance, optional packages, parallel maps and progress bars."""

import datetime
import math
import os
from concurrent.futures import ThreadPoolExecutor

import pytest
import threadpoolctl

import miricigale
from helpers.errors import refuses
from miricigale.utils.exceptions import argument_error, unknown_name
from miricigale.utils.meta import provenance
from miricigale.utils.optional_packages import require
from miricigale.utils.parallel import chunks, parallel_map, single_threaded, thread_count, threads
from miricigale.utils.progress import progress


def test_errors_name_the_argument():
    error = argument_error("n", "positive", -1)
    assert isinstance(error, ValueError)
    assert str(error) == "'n' must be positive, got -1"
    assert "no filter 'a'; known: b, c" in str(unknown_name("filter", "a", {"c": 1, "b": 2}))


def test_provenance():
    meta = provenance(citations=["b", "a", "b"], seed=3, nothing=None)
    assert meta["package"] == "miricigale"
    assert meta["citations"] == ["a", "b"]
    assert meta["seed"] == 3
    assert "nothing" not in meta
    made = datetime.datetime.fromisoformat(meta["created"])
    assert abs(datetime.datetime.now(datetime.UTC) - made) < datetime.timedelta(minutes=1)


def test_optional_packages():
    assert require("math", extra="none") is math
    with pytest.raises(ImportError, match=r"pip install 'miricigale\[stpsf\]'"):
        require("no_such_package", extra="stpsf")


def test_number_of_threads():
    assert thread_count(3) == 3
    assert 1 <= thread_count(None) <= os.cpu_count()
    for wrong in (0, -1, 1.5):
        refuses("'n_threads' must be at least 1 and an integer", thread_count, wrong)


def test_one_thread_is_no_executor():
    with threads(1) as executor:
        assert executor is None


def test_parallel_map_gives_the_same_answer_in_order_and_passes_errors_on():
    wanted = [math.sqrt(i) for i in range(20)]
    assert parallel_map(math.sqrt, range(20)) == wanted
    with threads(3) as executor:
        assert parallel_map(math.sqrt, range(20), executor=executor) == wanted
        match = r"math domain|nonneg"
        refuses(match, parallel_map, math.sqrt, [1, -1, 2], executor=executor)
    refuses("'executor' must be a", parallel_map, math.sqrt, range(3), executor=2)


def test_threads_are_handed_runs_of_many_items():
    submitted = []

    class Counting(ThreadPoolExecutor):
        def submit(self, *args):
            submitted.append(args)
            return super().submit(*args)

    with Counting(3) as executor:
        for n in (100, 5000):
            submitted.clear()
            wanted = [math.sqrt(i) for i in range(n)]
            assert parallel_map(math.sqrt, range(n), executor=executor) == wanted
            assert len(submitted) <= 128
        items = [*range(500), -1]
        refuses(r"math domain|nonneg", parallel_map, math.sqrt, items, executor=executor)


def test_chunks_cover_everything_once():
    pieces = [i for part in chunks(10, 4) for i in range(10)[part]]
    assert pieces == list(range(10))
    assert list(chunks(0, 4)) == []


def test_progress_is_silent_unless_asked(capsys):
    assert list(progress(range(3))) == [0, 1, 2]
    assert capsys.readouterr().err == ""
    assert list(progress(range(3), show=True, desc="work")) == [0, 1, 2]
    assert "work" in capsys.readouterr().err


def test_progress_is_lines_where_no_bar_can_be_drawn(capsys):
    bar = progress(show=True, total=5, desc="work", unit="step")
    bar.set_description("more work")
    bar.update(3)
    bar.close()
    bar.close()
    text = capsys.readouterr().err
    assert text.startswith("more work: 3 of 5 step, ")
    assert text.count("\n") == 1
    assert not {"\r", "\x1b"} & set(text)


def test_package_lists_its_classes_without_loading_them():
    assert {"Filter", "SEDModel", "Detector", "BayesFitter"} <= set(dir(miricigale))
    assert miricigale.Filter.__name__ == "Filter"
    with pytest.raises(AttributeError, match="no attribute 'Nonsense'; its classes are"):
        miricigale.Nonsense  # noqa: B018


def test_linear_algebra_stays_on_one_core_until_the_last_thread_is_done():
    def cores():
        pools = threadpoolctl.threadpool_info()
        return {pool["num_threads"] for pool in pools if pool["user_api"] == "blas"}

    # the thread that set the limits first is another one
    with threadpoolctl.threadpool_limits(2), ThreadPoolExecutor(1) as thread:
        before = cores()
        first, second = single_threaded(), single_threaded()
        thread.submit(first.__enter__).result()
        assert cores() == {1}
        with second:
            thread.submit(first.__exit__, None, None, None).result()
            assert cores() == {1}
        assert cores() == before
