"""One heap for all threads."""

import platform
import re
import subprocess
import sys

import pytest

pytestmark = pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="the C library here is not glibc")

# Every thread asks for memory while all others live; the C library tells of its heaps on standard output.
SCRIPT = """
import ctypes, sys, threading
from pcw_description.one_heap import one_heap
if sys.argv[1] == "one":
    one_heap()
together = threading.Barrier(4)
def ask():
    kept = [bytearray(100000 + k) for k in range(50)]
    together.wait()
threads = [threading.Thread(target=ask) for _ in range(4)]
[thread.start() for thread in threads]
[thread.join() for thread in threads]
libc = ctypes.CDLL(None)
libc.malloc_info(0, ctypes.c_void_p.in_dll(libc, "stdout"))
libc.fflush(None)
"""


def heaps(which: str) -> int:
    done = subprocess.run([sys.executable, "-c", SCRIPT, which], capture_output=True, text=True, check=True)
    return len(re.findall(r"<heap nr=", done.stdout))


def test_all_threads_share_one_heap():
    assert heaps("many") > 1
    assert heaps("one") == 1
