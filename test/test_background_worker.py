"""The background worker: newest job first, in a thread of lower priority."""

import os
import sys
import threading

import pytest

from monoforce_ros.nodes.background_worker import BackgroundWorker


def test_the_newest_waiting_job_is_processed_and_the_others_are_counted():
    entered, leave, done, all_done = threading.Event(), threading.Event(), [], threading.Event()

    def work(job):
        entered.set()
        leave.wait(10)
        done.append(job)
        if job == 4:
            all_done.set()

    worker = BackgroundWorker("test", work)
    worker.submit(0)
    assert entered.wait(10)
    for job in range(1, 5):
        worker.submit(job)
    leave.set()
    assert all_done.wait(10)
    worker.stop()
    assert done == [0, 4] and worker.dropped == 3


@pytest.mark.skipif(sys.platform != "linux", reason="threads have a niceness of their own on Linux alone")
@pytest.mark.parametrize("niceness", [0, 7])
def test_the_niceness_applies_to_the_thread_and_to_threads_that_it_starts(niceness):
    found, done = {}, threading.Event()
    normal = os.getpriority(os.PRIO_PROCESS, threading.get_native_id())

    def note(name):
        found[name] = os.getpriority(os.PRIO_PROCESS, threading.get_native_id())

    def work(_):
        note("thread")
        helper = threading.Thread(target=note, args=("helper",))
        helper.start()
        helper.join()
        done.set()

    worker = BackgroundWorker("test", work, niceness)
    worker.submit("job")
    assert done.wait(10)
    worker.stop()
    # Relative to the niceness of the process.
    wanted = min(19, normal + niceness)
    assert found == {"thread": wanted, "helper": wanted}
    assert os.getpriority(os.PRIO_PROCESS, threading.get_native_id()) == normal
