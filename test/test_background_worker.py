"""Work beside the predictions: the newest of what waits, in a thread that lets others go first."""

import os
import sys
import threading

import pytest

from monoforce_ros.nodes.background_worker import BackgroundWorker


def test_of_what_waits_the_newest_is_done_and_the_rest_is_counted():
    entered, leave, done, all_done = threading.Event(), threading.Event(), [], threading.Event()

    def work(job):
        entered.set()
        leave.wait(10)
        done.append(job)
        if job == 4:
            all_done.set()

    beside = BackgroundWorker("test", work)
    beside.give(0)
    assert entered.wait(10)
    for job in range(1, 5):
        beside.give(job)
    leave.set()
    assert all_done.wait(10)
    beside.stop()
    assert done == [0, 4] and beside.dropped == 3


@pytest.mark.skipif(sys.platform != "linux", reason="threads have a niceness of their own on Linux alone")
@pytest.mark.parametrize("niceness", [0, 7])
def test_it_steps_back_for_others_and_so_do_the_threads_that_it_starts(niceness):
    found, done = {}, threading.Event()
    own = os.getpriority(os.PRIO_PROCESS, threading.get_native_id())

    def note(name):
        found[name] = os.getpriority(os.PRIO_PROCESS, threading.get_native_id())

    def work(_):
        note("thread")
        helper = threading.Thread(target=note, args=("helper",))
        helper.start()
        helper.join()
        done.set()

    beside = BackgroundWorker("test", work, niceness)
    beside.give("job")
    assert done.wait(10)
    beside.stop()
    # Counted from what the process has been given already.
    wanted = min(19, own + niceness)
    assert found == {"thread": wanted, "helper": wanted}
    assert os.getpriority(os.PRIO_PROCESS, threading.get_native_id()) == own
