"""The thread that draws: newest first, clients take turns, full resolution at rest, nothing ends it."""

import threading
import time

from browser import PATIENCE, wait_for

from spacesim.viewer.loop import RenderLoop, Wish


class Drawn:
    """What was drawn, in order; the first picture may be held up."""

    def __init__(self):
        self.made, self.threads, self.gate, self.begun = [], set(), threading.Event(), threading.Event()

    def wish(self, name, held=False):
        def draw(full):
            self.threads.add(threading.get_ident())
            if held:
                self.begun.set()
                assert self.gate.wait(PATIENCE)
            self.made.append((name, full))

        return Wish(draw)


def test_only_the_newest_wish_of_a_client_is_drawn():
    loop, drawn = RenderLoop(rest=60), Drawn()
    loop.start()
    loop.wish("a", drawn.wish(0, held=True))
    assert drawn.begun.wait(PATIENCE)
    for k in range(1, 100):
        loop.wish("a", drawn.wish(k))
    loop.wish("b", drawn.wish("b"))
    drawn.gate.set()
    wait_for(lambda: len(drawn.made) == 3, "three pictures")
    time.sleep(0.1)
    assert drawn.made == [(0, False), (99, False), ("b", False)]
    loop.stop()
    assert len(drawn.threads) == 1
    assert threading.get_ident() not in drawn.threads


def test_full_resolution_comes_at_rest_and_once():
    loop, drawn = RenderLoop(rest=1.0), Drawn()
    loop.wish("a", drawn.wish(1))
    loop.wish("b", drawn.wish(2), moving=False)
    assert not loop.idle
    loop.start()
    wait_for(lambda: loop.idle, "all pictures")
    loop.stop()
    assert drawn.made == [(1, False), (2, True), (1, True)]


def test_a_view_at_rest_is_not_kept_waiting_by_one_that_moves_for_ever():
    loop, drawn = RenderLoop(rest=0.05), Drawn()
    loop.start()
    loop.wish("still", drawn.wish("still"))

    def draw(_full):
        time.sleep(0.01)
        drawn.made.append(("moving", False))
        if len(drawn.made) < 400:
            loop.wish("moving", Wish(draw))

    loop.wish("moving", Wish(draw))
    wait_for(lambda: ("still", True) in drawn.made, "the picture at rest")
    loop.stop()
    assert 5 < drawn.made.index(("still", True)) < 400


def test_a_client_that_has_gone_gets_nothing():
    loop, drawn = RenderLoop(rest=0.05), Drawn()
    loop.start()
    loop.wish("a", drawn.wish(0, held=True))
    assert drawn.begun.wait(PATIENCE)
    loop.wish("b", drawn.wish("b"))
    loop.forget("a")
    loop.forget("b")
    drawn.gate.set()
    loop.wish("c", drawn.wish("c"))
    wait_for(lambda: ("c", True) in drawn.made, "the picture of c")
    loop.stop()
    assert drawn.made == [(0, False), ("c", False), ("c", True)]


def test_a_picture_that_fails_ends_no_others(caplog):
    loop, drawn = RenderLoop(rest=0.05), Drawn()
    loop.start()

    def fail(_full):
        raise RuntimeError("out of\nmemory")

    loop.wish("a", Wish(fail), moving=False)
    done = threading.Event()
    loop.do(done.set)
    assert done.wait(PATIENCE)
    loop.wish("b", drawn.wish("b"), moving=False)
    wait_for(lambda: drawn.made, "the picture of b")
    loop.stop()
    assert "out of memory" in caplog.text
    assert not loop._thread.is_alive()


def test_it_tidies_up_in_pauses_once_after_pictures():
    drawn, tidied = Drawn(), []
    loop = RenderLoop(0.01, lambda: tidied.append((len(drawn.made), threading.current_thread().name)), 0.5)
    loop.start()
    assert loop._tidy_at is None  # nothing was drawn
    loop.wish("a", drawn.wish(1))
    wait_for(lambda: tidied, "the tidying")
    time.sleep(1.2)
    assert tidied == [(2, "render")]
    loop.wish("a", drawn.wish(2), moving=False)
    wait_for(lambda: len(tidied) == 2, "another one")
    loop.stop()


def test_it_tidies_up_between_pictures_that_never_end():
    drawn, tidied = [], []
    loop = RenderLoop(60, lambda: tidied.append(len(drawn)), 0.1)

    def draw(_full):
        time.sleep(0.002)
        drawn.append(True)
        loop.wish("a", Wish(draw))

    loop.start()
    loop.wish("a", Wish(draw))
    wait_for(lambda: len(tidied) > 1, "the tidying")
    loop.stop()
    assert 0 < tidied[0] < tidied[1] <= len(drawn)
