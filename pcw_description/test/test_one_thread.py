"""Linear algebra on one thread."""

import json
import os
import subprocess
import sys

import pytest

pytest.importorskip("threadpoolctl")

SCRIPT = """
import json, numpy, threadpoolctl
from pcw_description.one_thread import one_thread
before = [pool["num_threads"] for pool in threadpoolctl.threadpool_info()]
one_thread()
print(json.dumps([before, [pool["num_threads"] for pool in threadpoolctl.threadpool_info()]]))
"""


def test_a_library_of_several_threads_is_kept_to_one():
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "2", "OMP_NUM_THREADS": "2", "MKL_NUM_THREADS": "2"}
    done = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True, env=environment)
    before, after = json.loads(done.stdout)
    if set(before) <= {1}:
        pytest.skip("numpy has a library of one thread here")
    assert set(after) == {1}
