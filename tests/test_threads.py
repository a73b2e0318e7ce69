"""Work in threads: in order, and in no more threads than were asked for."""

import threading
import time

import pytest
from commandline import SAMPLES, volcli

from volcli.grids import threads
from volcli.grids.threads import in_threads, threads_limited_to


def where(item):
    """The thread that worked on it; long enough that a second one takes the next."""
    time.sleep(0.01)
    return threading.get_ident()


@pytest.mark.parametrize("count", [1, 2, 5])
def test_no_more_threads_are_taken_than_asked_for(count):
    with threads_limited_to(count):
        used = set(in_threads(where, range(20)))
    assert len(used) == count
    if count == 1:
        assert used == {threading.get_ident()}


def test_a_limit_ends_with_its_block():
    with threads_limited_to(1), threads_limited_to(3):
        pass
    with threads_limited_to(1):
        with threads_limited_to(None), threads_limited_to(2):
            assert len(set(in_threads(where, range(8)))) == 2
        assert set(in_threads(where, range(3))) == {threading.get_ident()}


@pytest.mark.parametrize("count", [1, 4])
def test_results_and_errors_come_in_the_order_of_the_items(count):
    def slower_first(item):
        time.sleep(0.002 * (4 - item))
        return 1 / (3 - item)

    results = []
    with threads_limited_to(count), pytest.raises(ZeroDivisionError):
        for result in in_threads(slower_first, range(6)):
            results.append(result)
    assert results == [1 / 3, 1 / 2, 1]


def test_one_thread_renders_a_picture_without_a_pool_to_load_it(tmp_path, monkeypatch):
    def refuse(*_):
        raise AssertionError("a pool of threads")

    monkeypatch.setattr(threads, "ThreadPoolExecutor", refuse)
    # Of the stand-in that the kernels are made ready on in a thread of its own.
    monkeypatch.setattr("volcli.run._use_kernels", lambda prepared: None)
    arguments = ["render", SAMPLES / "rotated.vdb", "--size", "8x6", "-o", tmp_path / "a.exr"]
    assert volcli(*arguments, "--threads", "1").code == 0
    assert volcli(*arguments, "--threads", "2").code == 1
