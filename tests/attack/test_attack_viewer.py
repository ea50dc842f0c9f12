"""The attack on the viewer finds nothing, and would find what it looks for."""

import attack_viewer
import pytest
from attack_viewer import attack, floods, foreign_pages, rebinding, slow_sockets

pytest.importorskip("viser", reason="viser is not installed")

IMPORT = "from spacesim.viewer.network import message_filter; "


def test_nothing_gets_through(tmp_path):
    found = attack(0, 0.1, tmp_path)
    assert found.finds == []
    assert found.tried["own page"] == 1
    assert found.tried["client too many"] == 20
    assert len(found.tried) == 19
    assert list(tmp_path.iterdir()) == []


def test_it_finds_that_pages_of_others_are_let_in(tmp_path):
    finds = "; ".join(
        attack(
            1, 0.1, tmp_path, (foreign_pages, rebinding), f"{IMPORT}message_filter.refusal_reason = lambda *_: None"
        ).finds
    )
    for words in (
        "another site got a connection",
        "another site changed",
        "gave a connection",
        "gave the page",
        "obeys",
    ):
        assert words in finds


def test_it_finds_that_memory_has_no_bounds(tmp_path, monkeypatch):
    monkeypatch.setattr(attack_viewer, "ANSWER", 1.0)
    monkeypatch.setattr(attack_viewer, "MAX_MEMORY_MB", 50.0)
    bounds = "message_filter.MAX_MESSAGE_BYTES = message_filter.MAX_REQUEST_BYTES = 2**26; "
    bounds += "message_filter.MAX_FRAGMENTS = message_filter.MAX_PONG_BYTES = message_filter.MAX_CLIENTS = 10**9"
    finds = "; ".join(attack(2, 0.1, tmp_path, (floods, slow_sockets), IMPORT + bounds).finds)
    for words in ("messages of 49 MB", "empty pieces", "all let in", "more than 50"):
        assert words in finds


@pytest.mark.parametrize(
    ("weakened", "words"),
    [
        ("import spacesim.viewer.drawing.loop as loop; loop.RenderLoop.request = lambda *_: None", "no picture"),
        (f"{IMPORT}message_filter.refusal_reason = lambda *_: 'no'", "own page got no connection"),
        (f"{IMPORT}message_filter.is_allowed = lambda _: False", "proves nothing"),
        (f"import os; {IMPORT}message_filter.is_allowed = lambda _: os._exit(3)", "the viewer ended, code 3"),
    ],
)
def test_it_finds_that_nobody_gets_in_or_sees_anything(tmp_path, monkeypatch, weakened, words):
    monkeypatch.setattr(attack_viewer, "PATIENCE", 3.0)
    monkeypatch.setattr(attack_viewer, "ANSWER", 1.0)
    assert words in "; ".join(attack(3, 0.1, tmp_path, (foreign_pages,), weakened).finds)
