"""Tasks on machines of different memory."""

from concurrent.futures import Future

from miricigale.workflow.engine.schedule import Place, Task, run_tasks


class Machine:
    """Its tasks end when all machines have as many as they can."""

    def __init__(self, memory, log):
        self.memory, self.running, self.most = memory, [], 0
        self.log = log

    def submit(self, task):
        future = Future()
        self.running.append(task.memory)
        self.most = max(self.most, sum(self.running))
        self.log.append((task.title, self))
        future.set_result(lambda: self.running.remove(task.memory))
        return future


def test_a_large_task_goes_to_the_machine_that_has_the_memory():
    log, gone = [], []
    small, large, late = (Machine(memory, log) for memory in (3, 10, 4))

    def places():
        # the small one is lost after two tasks, and another one replaces it
        machines = {"large": large} | ({"late": late} if gone else {"small": small})
        return {name: Place(one.submit, 2, 4, one.memory) for name, one in machines.items()}

    def task(k, memory, needs=()):
        def begin(submit, n_threads):
            # of six threads of tasks, no more than the machine has
            assert 1 <= n_threads <= 4
            gone.extend([True] if len(log) == 2 else [])
            return submit(one)

        one = Task(f"{k}", f"{k}", begin, lambda end: end(), frozenset(needs), memory)
        return one

    sizes = [2, 5, 5, 1, 11, 3, 3, 2]
    tasks = [task(k, memory, {"0"} if k == 6 else ()) for k, memory in enumerate(sizes)]
    run_tasks(tasks, places=places, n_threads=6)
    order = [title for title, _ in log]
    assert sorted(order) == [str(k) for k in range(8)]
    assert order.index("6") > order.index("0")
    where = dict(log)
    assert where["1"] is where["2"] is where["4"] is large
    # what is larger than every machine is done alone where there is most
    assert large.most == 11
    assert 0 < small.most <= 3
    assert 0 < late.most <= 4


def test_many_tasks_begin_in_their_order():
    done = []

    class Inline:
        def submit(self, k):
            future = Future()
            future.set_result(k)
            return future

    def task(k):
        needs = frozenset([f"{k - 100}"]) if k >= 100 else frozenset()
        return Task(f"{k}", "", lambda submit, _: submit(k), done.append, needs)

    place = {"here": Place(Inline().submit, 1, 1, 1.0)}
    run_tasks([task(k) for k in range(300)], places=lambda: place, n_threads=1)
    assert done == list(range(300))
