"""cubesat: a 6U cubesat with two deployed wings, as for proximity operations.

Body axes: +x the camera looks along, +z the side with cells and star tracker, wings along -y and +y. The origin is
the middle of the body.

The body has the size of the CubeSat Design Specification (Cal Poly, revision 14.1, 2022) for 6U: 226.3 mm by 100 mm
by 366 mm with rails 8.5 mm wide. Cells are 40 mm by 80 mm, as common triple-junction ones are. The rest is
that of no real one.
"""

import numpy as np

from spacesim.data.geometry import normalize
from spacesim.scenes import shapes as s
from spacesim.scenes.materials.table import SOLAR_CELL, material
from spacesim.scenes.spacecraft.part import Part, Spacecraft

SIZE = np.array([0.366, 0.2263, 0.1])
"""Edge lengths of the body, metres."""

_RAIL = 0.0085
_X, _Y, _Z = 0.5 * SIZE


def cubesat() -> Spacecraft:
    """A 6U cubesat, 1.2 m across its wings."""
    parts = [
        *_body(),
        *_wing("left", -1.0),
        *_wing("right", 1.0),
        *_front(),
        *_back(),
        *_top(),
    ]
    return Spacecraft("cubesat", tuple(parts))


def _body() -> list[Part]:
    """Rails, ribs and the panels between them."""
    edge = 0.5 * _RAIL
    rails = [s.box([SIZE[0], _RAIL, _RAIL], [0, i * (_Y - edge), j * (_Z - edge)]) for i in (-1, 1) for j in (-1, 1)]
    ribs = [
        s.box([0.006, 2 * _Y - 2 * _RAIL, 0.004], [x, 0, j * (_Z - 0.0028)]) for x in (-0.06, 0.06) for j in (-1, 1)
    ]
    ends = [
        s.box([_RAIL, 2 * _Y - 2 * _RAIL, _RAIL], [i * (_X - 1.5 * edge), 0, j * (_Z - edge)])
        for i in (-1, 1)
        for j in (-1, 1)
    ]
    posts = [
        s.box([_RAIL, _RAIL, 2 * _Z - 2 * _RAIL], [i * (_X - 1.5 * edge), j * (_Y - edge), 0])
        for i in (-1, 1)
        for j in (-1, 1)
    ]
    core = s.box(SIZE - [0.014, 0.008, 0.008], [0, 0, 0])
    sides = [s.box([0.15, 0.003, 0.074], [x, i * (_Y - 0.0035), 0]) for x in (-0.085, 0.085) for i in (-1, 1)]
    return [
        Part("structure", core, material("black-paint")),
        Part("rails", s.join_meshes(rails), material("anodised-aluminium")),
        Part("end_frames", s.join_meshes([*ends, *posts]), material("anodised-aluminium")),
        Part("ribs", s.join_meshes(ribs), material("anodised-aluminium")),
        Part("side_panels", s.join_meshes(sides), material("gold-mli")),
        Part("radiator", s.box([0.10, 0.19, 0.003], [0.0, 0, -_Z + 0.0033]), material("white-paint")),
    ]


def _wing(name: str, side: float) -> list[Part]:
    """Two boards of 20 cells, hinged to the upper edge of the body and to each other.

    Cells start at whole multiples of their size, as their pattern does (80 mm along x, 40 mm along y).
    """
    length, margin, thick, z = 0.336, 0.011, 0.0024, _Z - 0.006
    rows, columns = 5, 4
    width = rows * SOLAR_CELL[1]
    boards, cells, diodes, hinges = [], [], [], []
    for first in (0.16, 0.40):
        y = first + 0.5 * width
        boards.append(s.box([length, width + 2 * margin, thick], [0, side * y, z]))
        cells.append(s.box([columns * SOLAR_CELL[0], width, 0.001], [0, side * y, z + 0.5 * thick + 0.0003]))
        diodes += [
            s.box([0.012, 0.02, 0.003], [x, side * (y + 0.05), z - 0.5 * thick - 0.0012]) for x in (-0.12, 0, 0.12)
        ]
    for inner, outer in ((_Y - 0.002, 0.16 - margin), (0.36 + margin, 0.40 - margin)):
        for x in (-0.11, 0.11):
            y = 0.5 * (inner + outer)
            hinges.append(s.rod([x - 0.014, side * y, z - 0.001], [x + 0.014, side * y, z - 0.001], 0.0045, 16))
            hinges.append(s.box([0.02, outer - inner + 0.02, 0.002], [x, side * y, z - 0.5 * thick - 0.0008]))
    return [
        Part(f"wing_boards_{name}", s.join_meshes(boards), material("carbon-fibre")),
        Part(f"wing_cells_{name}", s.join_meshes(cells), material("solar-cell")),
        Part(f"wing_diodes_{name}", s.join_meshes(diodes), material("kapton")),
        Part(f"wing_hinges_{name}", s.join_meshes(hinges), material("bare-aluminium")),
    ]


def _front() -> list[Part]:
    """+x: a telescope with its hood, a laser rangefinder, a patch antenna."""
    start = [_X - 0.012, 0.055, 0.0]
    barrel = s.revolve([(0.036, 0), (0.043, 0), (0.043, 0.062), (0.041, 0.062), (0.036, 0.03)])
    flange = s.revolve([(0.04, 0.005), (0.047, 0.005), (0.047, 0.018), (0.04, 0.018)])
    angle = np.linspace(0.0, np.arcsin(0.036 / 0.08), 9)
    bulge = np.stack([0.08 * np.sin(angle), 0.016 + 0.08 * (np.cos(angle) - np.cos(angle[-1]))], axis=-1)
    lens = s.revolve([(0, 0.012), (0.0365, 0.012), (0.0365, 0.016), *bulge[::-1]])
    finder = s.box([0.018, 0.07, 0.036], [_X - 0.003, -0.058, 0.024])
    eyes = [s.rod([_X + 0.004, y, 0.024], [_X + 0.016, y, 0.024], 0.012, 32) for y in (-0.075, -0.041)]
    board = s.box([0.003, 0.074, 0.038], [_X - 0.004, -0.058, -0.024])
    patches = [s.box([0.0016, 0.028, 0.028], [_X - 0.002, y, -0.024]) for y in (-0.076, -0.04)]
    return [
        Part("camera_barrel", s.place_mesh(barrel, start, [1, 0, 0]), material("black-paint")),
        Part("camera_flange", s.place_mesh(flange, start, [1, 0, 0]), material("bare-aluminium")),
        Part("camera_lens", s.place_mesh(lens, start, [1, 0, 0]), material("glass")),
        Part("rangefinder", finder, material("anodised-aluminium")),
        Part("rangefinder_eyes", s.join_meshes(eyes), material("glass")),
        Part("patch_board", board, material("white-paint")),
        Part("patches", s.join_meshes(patches), material("gold-mli")),
    ]


def _back() -> list[Part]:
    """-x: four monopoles at the corners, a cold-gas thruster block with four nozzles, a plug."""
    rods, feet = [], []
    for i in (-1.0, 1.0):
        for j in (-1.0, 1.0):
            foot = np.array([-_X - 0.002, i * 0.085, j * 0.032])
            rods.append(s.rod(foot, foot + 0.17 * normalize([-0.35, i * 1.0, j * 0.75]), 0.0016, 10))
            feet.append(s.box([0.014, 0.016, 0.012], foot + np.array([0.002, 0, 0])))
    nozzle = s.revolve([(0.005, -0.002), (0.007, -0.002), (0.013, 0.024), (0.0115, 0.024)])
    nozzles = [s.place_mesh(nozzle, [-_X - 0.006, y, z], [-1, 0, 0]) for y in (-0.03, 0.03) for z in (-0.018, 0.018)]
    return [
        Part("monopoles", s.join_meshes(rods), material("bare-aluminium")),
        Part("monopole_feet", s.join_meshes(feet), material("white-paint")),
        Part("thruster_block", s.box([0.014, 0.1, 0.07], [-_X - 0.001, 0, 0]), material("bare-aluminium")),
        Part("nozzles", s.join_meshes(nozzles), material("nozzle-alloy")),
        Part("plug", s.box([0.008, 0.02, 0.026], [-_X + 0.004, -0.064, 0.0]), material("black-paint")),
    ]


def _top() -> list[Part]:
    """+z: body cells, a star tracker with its baffle, a GNSS antenna, sun sensors."""
    plate = s.box([0.17, 0.172, 0.0025], [-0.08, 0, _Z - 0.0025])
    cells = s.box([2 * SOLAR_CELL[0], 4 * SOLAR_CELL[1], 0.001], [-0.08, 0, _Z - 0.0009])
    baffle = s.revolve([(0, 0), (0.02, 0), (0.034, 0.06), (0.0325, 0.06), (0.018, 0.012), (0, 0.012)])
    block = s.box([0.055, 0.055, 0.026], [0.10, 0.05, _Z + 0.008])
    tracker = s.place_mesh(baffle, [0.10, 0.054, _Z + 0.016], [0.25, 0.45, 1.0])
    sensors = [
        s.box([0.016, 0.016, 0.006], [x, y, _Z + 0.001]) for x, y in ((0.155, -0.09), (0.155, 0.09), (0.04, -0.09))
    ]
    return [
        Part("top_plate", plate, material("white-paint-matt")),
        Part("top_cells", cells, material("solar-cell")),
        Part("tracker_block", block, material("anodised-aluminium")),
        Part("tracker_baffle", tracker, material("black-paint")),
        Part("navigation_antenna", s.box([0.045, 0.045, 0.009], [0.10, -0.045, _Z + 0.001]), material("white-paint")),
        Part("sun_sensors", s.join_meshes(sensors), material("glass")),
    ]
