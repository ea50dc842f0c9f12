"""Pictures of training: decoded ahead of the steps that show them."""

import gc
import threading
import time

import numpy as np
import pytest

from spacesim.data.errors import InputError
from spacesim.splat.train.views import AHEAD, DECODERS, TrainingViews


def test_pictures_are_decoded_ahead_in_other_threads(small_dataset, monkeypatch):
    plain, views = TrainingViews(small_dataset, 3), TrainingViews(small_dataset, 3)
    threads, load = [], views._load
    monkeypatch.setattr(views, "_load", lambda index: threads.append(threading.current_thread()) or load(index))
    count = len(small_dataset.train)
    for step in range(3 * count):
        shown = views.at_step(step)
        assert shown.index == plain._shown(step)
        np.testing.assert_array_equal(shown.rgba, plain[shown.index].rgba)
    assert len(threads) == count, "each once"
    assert threading.main_thread() not in threads


def test_a_picture_that_cannot_be_read_ends_the_step_that_shows_it(small_dataset, monkeypatch):
    views, broken = TrainingViews(small_dataset, 3), 2
    load, bad = views._load, views._shown(broken)

    def fails(index):
        if index == bad:
            raise InputError("train_00002: broken")
        return load(index)

    monkeypatch.setattr(views, "_load", fails)
    assert broken < AHEAD
    for step in range(broken):
        views.at_step(step)
    with pytest.raises(InputError, match="broken"):
        views.at_step(broken)
    with pytest.raises(InputError, match="broken"):
        views.at_step(broken)


def test_nobody_waits_for_threads_that_decode(small_dataset):
    """Neither Python when it exits, whatever was interrupted, nor they themselves for views that are gone."""
    before = set(threading.enumerate())
    views = TrainingViews(small_dataset, 3)
    for step in range(2):
        views.at_step(step)
    started = set(threading.enumerate()) - before
    assert len(started) == DECODERS
    assert all(thread.daemon for thread in started)
    del views
    deadline = time.monotonic() + 10
    while any(thread.is_alive() for thread in started) and time.monotonic() < deadline:
        gc.collect()  # once what is being decoded is
        time.sleep(0.01)
    assert not any(thread.is_alive() for thread in started)
