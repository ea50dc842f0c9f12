"""boxsat: a box satellite with two solar panels, a dish, a camera barrel and a boom.

Body axes: +x the camera looks along, +z the deck with the antenna dish, solar panels along -y and +y.
"""

import numpy as np
import trimesh

from spacesim.data.geometry import normalize
from spacesim.scenes import shapes as s
from spacesim.scenes.materials.table import SOLAR_CELL, material
from spacesim.scenes.spacecraft.part import Part, Spacecraft

BUS = np.array([1.4, 1.2, 1.5])
"""Edge lengths of boxsat's bus, metres."""


def boxsat() -> Spacecraft:
    """A box satellite, 4.7 m across its panels: the thesis's kind of test object, modelled from scratch."""
    parts = [
        *_bus(),
        *_panel("left", -1.0),
        *_panel("right", 1.0),
        *_camera(),
        *_dish(),
        *_sensors(),
        *_boom(),
    ]
    return Spacecraft("boxsat", tuple(parts))


def _bus() -> list[Part]:
    x, y, z = 0.5 * BUS
    deck = [BUS[0] + 0.09, BUS[1] + 0.09, 0.04]
    ring = s.tube([0, 0, -z - 0.14], [0, 0, -z - 0.03], 0.38, 0.43)
    nozzle = s.revolve([(0.155, -0.26), (0.17, -0.26), (0.05, 0), (0.035, 0)])
    nozzle.apply_translation([0, 0, -z - 0.03])
    rails = [s.box([0.05, 0.05, BUS[2]], [i * x, j * y, 0]) for i in (-1, 1) for j in (-1, 1)]
    return [
        Part("bus", s.crumpled_box(BUS, levels=4, depth=0.007, seed=1), material("gold-mli")),
        Part("deck_top", s.box(deck, [0, 0, z + 0.01]), material("carbon-fibre")),
        Part("deck_bottom", s.box(deck, [0, 0, -z - 0.01]), material("carbon-fibre")),
        Part("rails", s.join_meshes(rails), material("bare-aluminium")),
        Part("radiator", s.box([0.03, 0.9, 1.0], [-x - 0.01, 0, 0.1]), material("white-paint")),
        Part("adapter_ring", ring, material("bare-aluminium")),
        Part("nozzle", nozzle, material("bare-aluminium")),
    ]


def _panel(name: str, side: float) -> list[Part]:
    """A solar panel on two struts at side -1 or +1 of the y axis, cells towards +z and, by 25 degrees, +x."""
    width, length, inner = 1.2, 1.3, 1.05
    rows, columns, gap = 6, 5, 0.012
    turn = trimesh.transformations.rotation_matrix(np.radians(25.0), [0, 1, 0])
    pitch = np.array([width / columns, length / rows])
    cells = [
        s.box(
            [pitch[0] - gap, pitch[1] - gap, 0.012],
            [(i + 0.5) * pitch[0] - 0.5 * width, side * (inner + (j + 0.5) * pitch[1]), 0.0105],
        )
        for i in range(columns)
        for j in range(rows)
    ]
    substrate = s.box([width + 0.03, length + 0.03, 0.03], [0, side * (inner + 0.5 * length), 0])
    bar = s.rod([-0.5 * width, side * (inner - 0.03), 0], [0.5 * width, side * (inner - 0.03), 0], 0.03)
    hub = s.rod([0, side * (0.5 * BUS[1] - 0.04), 0], [0, side * (0.5 * BUS[1] + 0.1), 0], 0.11, s.SEGMENTS)
    struts = [
        s.rod([x * 0.07, side * (0.5 * BUS[1] + 0.06), 0], [x * 0.45, side * (inner - 0.03), 0], 0.02)
        for x in (-1.0, 1.0)
    ]
    solids = [
        ("panel", substrate, material("carbon-fibre")),
        ("cells", s.join_meshes(cells), material("solar-cell")),
        ("yoke", bar, material("bare-aluminium")),
        ("hinge", hub, material("bare-aluminium")),
        ("strut_1", struts[0], material("bare-aluminium")),
        ("strut_2", struts[1], material("bare-aluminium")),
    ]
    for _, mesh, _ in solids:
        mesh.apply_transform(turn)
    flat = {"cells": s.whole_cells(solids[1][1], SOLAR_CELL)}
    return [Part(f"{part}_{name}", mesh, surface, flat.get(part)) for part, mesh, surface in solids]


def _camera() -> list[Part]:
    """A barrel with a black recess, 0.37 m deep, and a lens at its bottom."""
    start, axis = [0.5 * BUS[0] - 0.03, 0.05, -0.1], [1, 0, 0]
    barrel = s.revolve([(0.26, 0), (0.26, 0.45), (0.225, 0.45), (0.225, 0)])
    flange = s.revolve([(0.24, 0), (0.33, 0), (0.33, 0.06), (0.24, 0.06)])
    recess = s.revolve([(0, 0.02), (0.235, 0.02), (0.235, 0.44), (0.205, 0.44), (0.205, 0.07), (0, 0.07)])
    angle = np.linspace(0.0, np.arcsin(0.17 / 0.4), 9)
    bulge = np.stack([0.4 * np.sin(angle), 0.05 + 0.4 * np.cos(angle) - 0.4 * np.cos(angle[-1])], axis=-1)
    lens = s.revolve(np.concatenate([[(0, 0.05)], bulge[::-1]]))
    solids = [
        ("camera_barrel", barrel, material("white-paint")),
        ("camera_flange", flange, material("bare-aluminium")),
        ("camera_recess", recess, material("black-paint")),
        ("camera_lens", lens, material("glass")),
    ]
    return [Part(name, s.place_mesh(mesh, start, axis), surface) for name, mesh, surface in solids]


def _dish() -> list[Part]:
    """A dish of 0.9 m on a stem over the top deck, tilted towards +x, its feed on three struts at the
    focus."""
    foot = np.array([-0.25, 0.15, 0.5 * BUS[2]])
    vertex = foot + np.array([0.0, 0.0, 0.48])
    axis = normalize([0.55, -0.2, 1.0])
    focal = 0.36
    place = s.axis_frame(vertex, axis)
    feed = [0.0, 0.0, focal]
    rim = [(0.4 * np.cos(a), 0.4 * np.sin(a)) for a in np.radians([30.0, 150.0, 270.0])]
    struts = [s.rod([x, y, 0.16 / (4 * focal) - 0.005], feed, 0.008, 12) for x, y in rim]
    horn = s.revolve([(0, focal - 0.04), (0.055, focal - 0.04), (0.035, focal + 0.05), (0, focal + 0.05)])
    solids = [
        ("dish", s.dish(0.9, focal, 0.015), material("white-paint-matt")),
        ("dish_struts", s.join_meshes(struts), material("carbon-fibre")),
        ("dish_feed", horn, material("bare-aluminium")),
        ("dish_hub", s.rod([0, 0, -0.12], [0, 0, -0.01], 0.09, s.SEGMENTS), material("bare-aluminium")),
    ]
    parts = [Part(name, mesh.apply_transform(place), surface) for name, mesh, surface in solids]
    stem = s.rod(foot, vertex - 0.07 * axis, 0.04, 36)
    return [Part("dish_stem", stem, material("bare-aluminium")), *parts]


def _sensors() -> list[Part]:
    """Two star trackers with black baffles and a patch antenna on the top deck, a sun sensor on the front."""
    top = 0.5 * BUS[2] + 0.03
    baffle = s.revolve([(0, 0), (0.06, 0), (0.105, 0.2), (0.098, 0.2), (0.054, 0.03), (0, 0.03)])
    trackers = [
        s.place_mesh(baffle, [0.42, y, top + 0.1], direction)
        for y, direction in ((0.38, [0.5, 0.7, 0.8]), (-0.38, [0.5, -0.7, 0.8]))
    ]
    blocks = [s.box([0.16, 0.16, 0.13], [0.42, y, top + 0.06]) for y in (0.38, -0.38)]
    return [
        Part("tracker_1_block", blocks[0], material("bare-aluminium")),
        Part("tracker_1_baffle", trackers[0], material("black-paint")),
        Part("tracker_2_block", blocks[1], material("bare-aluminium")),
        Part("tracker_2_baffle", trackers[1], material("black-paint")),
        Part("patch_antenna", s.box([0.3, 0.3, 0.05], [-0.42, -0.33, top + 0.02]), material("white-paint")),
        Part("electronics", s.box([0.22, 0.26, 0.3], [0.5 * BUS[0] + 0.09, -0.38, 0.42]), material("black-paint")),
    ]


def _boom() -> list[Part]:
    """A thin boom of 1.2 m behind the bus with a magnetometer at its end."""
    start = np.array([-0.5 * BUS[0] + 0.02, -0.4, -0.55])
    end = start + 1.2 * normalize([-1.0, -0.25, -0.2])
    head = s.box([0.12, 0.12, 0.16], end)
    return [
        Part("boom", s.rod(start, end, 0.018, 18), material("grey-paint")),
        Part("magnetometer", head, material("white-paint")),
    ]
