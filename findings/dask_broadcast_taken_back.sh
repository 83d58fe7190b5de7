#!/usr/bin/env bash
# Data that dask sends to all workers are on one worker alone after two seconds.
#
# Seen with distributed 2026.8.0, two workers and client.scatter(data, broadcast=True), whose documentation says that the
# data go to all workers: two copies at once, one copy five seconds later. The scheduler's active memory manager takes
# back copies that no task waits for. If the worker with the last copy is lost, tasks that need the data end in a
# CancelledError, for scattered data cannot be made again. A good guess would be that copies stay until they are
# released. No warning is given. Prints what is seen, and fails if that changes.
set -euo pipefail
folder="$(mktemp -d)"
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q "distributed==2026.8.0" "dask==2026.8.0"
cd "$folder"
cat > run.py <<'PYTHON'
import time

from dask.distributed import Client, LocalCluster

if __name__ == "__main__":
    options = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": None}
    with LocalCluster(**options) as cluster, Client(cluster) as client:
        data = client.scatter(b"grid of models", broadcast=True)
        copies = [len(workers) for workers in client.who_has([data]).values()]
        time.sleep(5.0)
        copies += [len(workers) for workers in client.who_has([data]).values()]
    print(f"copies at once and after 5 s: {copies}")
    assert copies == [2, 1], copies
PYTHON
"$folder/venv/bin/python" run.py
