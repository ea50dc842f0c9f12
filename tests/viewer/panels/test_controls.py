"""The Sun's part of the panel, and the box of the Earth that it lights."""

import asyncio
from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace

import numpy as np

from spacesim.data.earth import Earth
from spacesim.data.records import Sun
from spacesim.viewer.panels.controls import SunControls
from spacesim.viewer.state import SceneState, SharedScene

EARTH = Earth([0, 0, -1])
SUN = replace(Sun.from_angles(40, 30), earth=EARTH)


class Panel:
    """Of viser what the controls ask for: handles with a value, and who listens to them."""

    def __init__(self) -> None:
        self.handles: dict[str, SimpleNamespace] = {}

    def add_folder(self, _name: str, order: int):
        return nullcontext()

    def add_slider(self, name: str, _least: float, _most: float, _step: float, value: float, hint: str):
        return self.add_checkbox(name, value, hint)

    def add_checkbox(self, name: str, value: float, hint: str):
        handle = self.handles[name] = SimpleNamespace(value=value, listeners=[])
        handle.on_update = handle.listeners.append
        return handle

    def use(self, name: str, value: float) -> None:
        """As someone in a browser."""
        handle = self.handles[name]
        handle.value = value
        for listener in handle.listeners:
            asyncio.run(listener(SimpleNamespace(client=1)))


def controls(sun: Sun = SUN) -> tuple[Panel, SharedScene, SunControls]:
    panel, shared = Panel(), SharedScene(SceneState((), sun))
    return panel, shared, SunControls(panel, shared)


def test_the_box_takes_the_earth_away_and_brings_it_back():
    panel, shared, _ = controls()
    seen: list[Earth | None] = []
    shared.listen(lambda state: seen.append(state.sun.earth))
    panel.use("Earth", False)
    panel.use("Earth", True)
    assert seen == [None, EARTH]
    np.testing.assert_allclose(shared.state.sun.angles, (40, 30), atol=1e-9)


def test_the_earth_stays_where_the_sun_is_moved():
    panel, shared, sun = controls()
    panel.use("Azimuth", 90)
    assert shared.state.sun.earth == EARTH
    sun.drag(Sun.from_angles(10, 20))
    assert shared.state.sun.earth == EARTH
    other = Earth([0, 1, 0])
    sun.drag(replace(SUN, earth=other))  # a frame of the data
    assert shared.state.sun.earth == other
    panel.use("Earth", False)
    sun.drag(SUN)
    assert shared.state.sun.earth is None
    panel.use("Earth", True)
    assert shared.state.sun.earth == EARTH
    sun.follow(replace(SUN, earth=other))  # a path that is played
    panel.use("Azimuth", 80)
    assert shared.state.sun.earth == other
    sun.follow(Sun(SUN.direction))
    assert panel.handles["Earth"].value is False


def test_there_is_no_box_without_an_earth():
    panel, shared, control = controls(Sun(SUN.direction))
    assert set(panel.handles) == {"Azimuth", "Elevation"}
    control.drag(Sun.from_angles(0, 0))
    assert shared.state.sun.earth is None
