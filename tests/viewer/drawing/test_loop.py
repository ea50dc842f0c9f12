"""The thread that draws: newest first, clients take turns, full resolution at rest, nothing ends it."""

import threading
import time
from types import SimpleNamespace

import pytest
from browser import PATIENCE, wait_for

from spacesim.viewer.drawing.loop import PATIENCE as PATIENCE_AT_REST
from spacesim.viewer.drawing.loop import RenderLoop, RenderRequest


class Drawn:
    """What was drawn, in order; the first picture may be held up."""

    def __init__(self):
        self.made, self.threads, self.released, self.begun = [], set(), threading.Event(), threading.Event()

    def request(self, name, held=False):
        def draw(full):
            self.threads.add(threading.get_ident())
            if held:
                self.begun.set()
                assert self.released.wait(PATIENCE)
            self.made.append((name, full))

        return RenderRequest(draw)


def test_only_the_newest_request_of_a_client_is_drawn():
    loop, drawn = RenderLoop(rest=60), Drawn()
    loop.start()
    loop.request("a", drawn.request(0, held=True))
    assert drawn.begun.wait(PATIENCE)
    for k in range(1, 100):
        loop.request("a", drawn.request(k))
    loop.request("b", drawn.request("b"))
    drawn.released.set()
    wait_for(lambda: len(drawn.made) == 3, "three pictures")
    time.sleep(0.1)
    assert drawn.made == [(0, False), (99, False), ("b", False)]
    loop.stop()
    assert len(drawn.threads) == 1
    assert threading.get_ident() not in drawn.threads


@pytest.fixture
def clock(monkeypatch):
    """The loop's time, which passes as a test says: tasks are taken from the loop without its thread."""
    now = SimpleNamespace(seconds=100.0)
    monkeypatch.setattr("spacesim.viewer.drawing.loop.time", SimpleNamespace(monotonic=lambda: now.seconds))
    return now


def test_full_resolution_comes_at_rest_and_once(clock):
    loop, drawn = RenderLoop(rest=1.0), Drawn()
    loop.request("a", drawn.request(1))
    loop.request("b", drawn.request(2), moving=False)
    assert not loop.idle
    for _ in range(2):
        loop._next()()
    for seconds in (0.5, 0.4):
        clock.seconds += seconds
        assert loop._next() is None
    clock.seconds += 0.2
    loop._next()()
    assert drawn.made == [(1, False), (2, True), (1, True)]
    assert loop.idle


def test_a_view_at_rest_is_not_kept_waiting_by_one_that_moves_for_ever(clock):
    loop, drawn = RenderLoop(rest=0.05), Drawn()
    loop.request("still", drawn.request("still"))
    for _ in range(100):
        loop.request("moving", drawn.request("moving"))
        loop._next()()
        clock.seconds += 0.01
    assert drawn.made[0] == ("still", False)
    assert drawn.made.index(("still", True)) == pytest.approx((0.05 + PATIENCE_AT_REST) / 0.01, abs=2)
    assert drawn.made.count(("moving", False)) == 98  # it never rests


def test_a_client_that_has_gone_gets_nothing():
    loop, drawn = RenderLoop(rest=0.05), Drawn()
    loop.start()
    loop.request("a", drawn.request(0, held=True))
    assert drawn.begun.wait(PATIENCE)
    loop.request("b", drawn.request("b"))
    loop.forget("a")
    loop.forget("b")
    drawn.released.set()
    loop.request("c", drawn.request("c"))
    wait_for(lambda: ("c", True) in drawn.made, "the picture of c")
    loop.stop()
    assert drawn.made == [(0, False), ("c", False), ("c", True)]


def test_a_picture_that_fails_ends_no_others(caplog):
    loop, drawn = RenderLoop(rest=0.05), Drawn()
    loop.start()

    def fail(_full):
        raise RuntimeError("out of\nmemory")

    loop.request("a", RenderRequest(fail), moving=False)
    done = threading.Event()
    loop.submit(done.set)
    assert done.wait(PATIENCE)
    loop.request("b", drawn.request("b"), moving=False)
    wait_for(lambda: drawn.made, "the picture of b")
    loop.stop()
    assert "out of memory" in caplog.text
    assert not loop._thread.is_alive()


def test_other_work_piles_up_of_no_kind_and_lets_pictures_through(clock):
    loop, drawn, done = RenderLoop(rest=1.0), Drawn(), []
    for k in range(100):
        loop.submit(lambda k=k: done.append(k), "save")
    loop.submit(lambda: done.append("file"))
    loop.submit(lambda: done.append("another"))
    loop.request("a", drawn.request("a"), moving=False)
    loop.request("b", drawn.request("b"), moving=False)
    order = []
    while not loop.idle and (task := loop._next()) is not None:
        task()
        order.append((len(done), len(drawn.made)))
    assert done == [99, "file", "another"]
    assert order == [(1, 0), (1, 1), (2, 1), (2, 2), (3, 2)]


def test_it_tidies_up_in_pauses_once_after_pictures(clock):
    drawn, tidied = Drawn(), []
    loop = RenderLoop(0.2, lambda: tidied.append(len(drawn.made)), 20.0)

    def pass_by(seconds):
        """All that is to do, every tenth of a second."""
        for _ in range(round(10 * seconds)):
            clock.seconds += 0.1
            while (task := loop._next()) is not None:
                task()

    pass_by(50)
    assert tidied == []  # nothing was drawn
    loop.request("a", drawn.request(1))
    pass_by(19.5)
    assert tidied == []
    pass_by(100)
    assert tidied == [2]
    loop.request("a", drawn.request(2), moving=False)
    pass_by(100)
    assert tidied == [2, 3]


def test_it_tidies_up_on_its_thread_between_pictures_that_never_end():
    drawn, tidied = [], []
    loop = RenderLoop(60, lambda: tidied.append((len(drawn), threading.current_thread().name)), 0.1)

    def draw(_full):
        time.sleep(0.002)
        drawn.append(True)
        loop.request("a", RenderRequest(draw))

    loop.start()
    loop.request("a", RenderRequest(draw))
    wait_for(lambda: len(tidied) > 1, "the tidying")
    loop.stop()
    (first, thread), (second, _) = tidied[:2]
    assert 0 < first < second <= len(drawn)
    assert thread == "render"
