"""telescope: an orbiting observatory of the size and layout of the Hubble Space Telescope.

Body axes: +x the line of sight (V1), solar arrays along -y and +y (V2), high-gain antennas along -z and +z (V3),
the aperture door hinged on the +z side. The origin is half-way along the tube.

Public figures that it keeps to (NASA, "Hubble Space Telescope Servicing Mission 4 Media Reference Guide", 2009,
and NASA's "Hubble by the numbers"): length 13.2 m, largest diameter 4.2 m, light shield and forward shell about
4 m long and 3.1 m wide each, equipment section about 1.5 m and aft shroud 3.5 m long, primary mirror 2.4 m,
secondary 0.3 m, arrays of 7.1 m by 2.6 m, door opened by up to 105 degrees, antenna dishes 1.3 m wide. Everything
smaller is placed by eye after public photographs.

All is built upright first, z along the line of sight, x along V2, y along V3.
"""

import numpy as np
import trimesh

from spacesim.scenes import shapes as s
from spacesim.scenes.materials.table import SOLAR_CELL, Material, lambertian, material
from spacesim.scenes.spacecraft.part import Part, Spacecraft

LENGTH, DIAMETER = 13.2, 4.2  #: of the tube; of the aft shroud, metres
ARRAY = (7.1, 2.6)  #: edge lengths of a solar array, metres
DOOR_DEG = 105.0  #: the door's angle from closed

_FRONT, _SHELL, _BAY, _SHROUD, _AFT = 0.5 * LENGTH, 2.6, -1.5, -3.1, -0.5 * LENGTH  # stations along the tube, metres
_TUBE, _WALL = 1.55, 0.06  # radius of light shield and forward shell; thickness
_BAYS = 12

_SOLAR_TURN_DEG = 20.0  # of the arrays about V2, cells from +V3 towards +V1
_V1_FROM_Z = np.array([[0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]], dtype=np.float64)

HANDRAIL = lambertian("handrail-yellow", (0.62, 0.42, 0.04), "yellow paint of handrails, chosen after photographs")

Solids = list[tuple[str, trimesh.Trimesh, Material]]


def telescope() -> Spacecraft:
    """A Hubble-like telescope of 13.2 m with its door open."""
    solids = [
        *_tube(),
        *_optics(),
        *_door(),
        *_equipment(),
        *_shroud(),
        *_aft(),
        *_array("left", -1.0),
        *_array("right", 1.0),
        *_antenna("front", 1.0),
        *_antenna("back", -1.0),
        *_fittings(),
        ("handrails", _handrails(), HANDRAIL),
    ]
    flat = {name: s.whole_cells(mesh, SOLAR_CELL) for name, mesh, _ in solids if name.startswith("array_cells")}
    return Spacecraft(
        "telescope",
        tuple(
            Part(name, mesh.copy().apply_transform(_V1_FROM_Z), surface, flat.get(name))
            for name, mesh, surface in solids
        ),
    )


def _tube() -> Solids:
    """Light shield and forward shell, the rings around them, and the black baffled tube inside."""
    inner = _TUBE - _WALL
    shield = s.tube([0, 0, _SHELL], [0, 0, _FRONT], inner, _TUBE)
    shell = s.tube([0, 0, _BAY], [0, 0, _SHELL - 0.01], inner, _TUBE)
    rings = [_ring(z, _TUBE + 0.035, 0.05) for z in (_SHELL - 0.35, 0.55, _BAY + 0.45)]
    seams = [_ring(z, _TUBE + 0.012, 0.025) for z in (3.35, 4.25, 5.15, 6.0)]
    return [
        ("light_shield", shield, material("silver-mli")),
        ("forward_shell", shell, material("silver-mli")),
        ("shell_rings", s.join_meshes(rings), material("white-paint")),
        ("blanket_seams", s.join_meshes(seams), material("anodised-aluminium")),
        ("aperture_rim", _ring(_FRONT - 0.09, _TUBE + 0.05, 0.1), material("white-paint")),
        ("interior", _interior(inner), material("black-paint")),
    ]


def _interior(radius: float) -> trimesh.Trimesh:
    """The black lining of the tube with its baffle rings, deeper ones narrower."""
    lining, pitch, back = radius - 0.03, 0.42, -2.6
    teeth = [(lining, _FRONT - 0.02)]
    for z in np.arange(_FRONT - 0.35, back + 0.5, -pitch):
        reach = 0.07 + 0.012 * (_FRONT - z)
        teeth += [(lining, z), (lining - reach, z - 0.006), (lining - reach, z - 0.014), (lining, z - 0.02)]
    outside = [(0.0, back), (radius + 0.01, back), (radius + 0.01, _FRONT - 0.02)]
    return s.revolve([*outside, *teeth, (lining, back + 0.02), (0.0, back + 0.02)])


def _ring(z: float, radius: float, width: float) -> trimesh.Trimesh:
    """A band around the tube, centred at station `z`."""
    return s.tube([0, 0, z - 0.5 * width], [0, 0, z + 0.5 * width], _TUBE - 0.01, radius)


def _optics() -> Solids:
    """Primary and secondary mirror, the black baffles of both, and the spider that holds the secondary."""
    vertex, curvature, secondary = -2.1, 11.04, 2.8
    radius = np.linspace(0.3, 1.2, 13)
    face = np.stack([radius, vertex + radius**2 / (2.0 * curvature)], axis=-1)
    primary = s.revolve([(0.3, vertex - 0.3), (1.2, vertex - 0.3), *face[::-1]])
    chimney = s.revolve([(0.27, vertex - 0.32), (0.3, vertex - 0.32), (0.19, vertex + 2.9), (0.17, vertex + 2.9)])
    cone = s.revolve([(0.34, secondary - 0.45), (0.35, secondary - 0.45), (0.29, secondary), (0.28, secondary)])
    hub = s.revolve([(0, secondary - 0.02), (0.3, secondary - 0.02), (0.3, secondary + 0.45), (0, secondary + 0.45)])
    mirror = s.revolve([(0, secondary - 0.06), (0.15, secondary - 0.05), (0.15, secondary), (0, secondary)])
    vanes = [
        s.rotate_mesh(s.box([1.2, 0.02, 0.14], [0.88, 0, secondary + 0.2]), 45.0 + 90.0 * i, [0, 0, 1])
        for i in range(4)
    ]
    return [
        ("primary_mirror", primary, material("bare-aluminium")),
        ("primary_baffle", chimney, material("black-paint")),
        ("secondary_mirror", mirror, material("bare-aluminium")),
        ("secondary_baffle", cone, material("black-paint")),
        ("secondary_hub", hub, material("black-paint")),
        ("spider", s.join_meshes(vanes), material("black-paint")),
    ]


def _door() -> Solids:
    """The aperture door, silver outside, black inside, with its hinge on the +V3 side."""
    hinge = [0.0, _TUBE + 0.07, _FRONT + 0.03]
    plate = s.rod([0, 0, _FRONT + 0.02], [0, 0, _FRONT + 0.08], _TUBE, s.SEGMENTS)
    lining = s.rod([0, 0, _FRONT], [0, 0, _FRONT + 0.021], _TUBE - 0.06, s.SEGMENTS)
    ribs = [
        s.box([2.0 * reach, 0.05, 0.04], [0, y, _FRONT + 0.095]) for y, reach in ((-0.7, 1.3), (0.0, 1.5), (0.7, 1.3))
    ]
    arms = [s.box([0.12, 0.5, 0.05], [x, _TUBE - 0.16, _FRONT + 0.1]) for x in (-0.45, 0.45)]
    lugs = [s.box([0.14, 0.12, 0.22], [x, _TUBE + 0.06, _FRONT - 0.06]) for x in (-0.45, 0.45)]
    axle = s.rod([-0.6, *hinge[1:]], [0.6, *hinge[1:]], 0.04)
    swung = [
        ("door", plate, material("silver-mli")),
        ("door_inside", lining, material("black-paint")),
        ("door_ribs", s.join_meshes(ribs), material("anodised-aluminium")),
        ("door_arms", s.join_meshes(arms), material("bare-aluminium")),
    ]
    return [
        *((name, s.rotate_mesh(mesh, -DOOR_DEG, [1, 0, 0], hinge), surface) for name, mesh, surface in swung),
        ("door_lugs", s.join_meshes(lugs), material("bare-aluminium")),
        ("door_axle", axle, material("bare-aluminium")),
    ]


def _equipment() -> Solids:
    """The twelve-sided equipment section around the tube, a door on each bay."""
    corner, width = 2.06, _BAY - _SHROUD
    flat = corner * np.cos(np.pi / _BAYS)
    inner = _TUBE - _WALL
    body = s.revolve([(inner, _SHROUD), (corner, _SHROUD), (corner, _BAY), (inner, _BAY)], _BAYS)
    middle = 0.5 * (_BAY + _SHROUD)
    doors: dict[str, list[trimesh.Trimesh]] = {"silver": [], "white": []}
    latches = []
    for i in range(_BAYS):
        angle = (i + 0.5) * 360.0 / _BAYS
        door = s.box([0.04, 0.88, width - 0.22], [flat, 0, middle])
        doors["white" if i % 3 == 1 else "silver"].append(s.rotate_mesh(door, angle, [0, 0, 1]))
        for z in (middle - 0.5, middle + 0.5):
            for y in (-0.36, 0.36):
                latches.append(s.rotate_mesh(s.box([0.03, 0.07, 0.07], [flat + 0.03, y, z]), angle, [0, 0, 1]))
    return [
        ("equipment_section", body, material("grey-paint")),
        ("bay_doors_silver", s.join_meshes(doors["silver"]), material("silver-mli")),
        ("bay_doors_white", s.join_meshes(doors["white"]), material("white-paint")),
        ("bay_latches", s.join_meshes(latches), material("anodised-aluminium")),
        (
            "forward_collar",
            s.tube([0, 0, _BAY - 0.01], [0, 0, _BAY + 0.12], _TUBE - 0.02, 1.72),
            material("white-paint"),
        ),
    ]


def _shroud() -> Solids:
    """The aft shroud: a cylinder with doors, bands, vents and two radiators."""
    radius = 0.5 * DIAMETER
    skin = radius - 0.03
    body = s.revolve([(0, _AFT), (skin - 0.04, _AFT), (skin, _AFT + 0.04), (skin, _SHROUD), (0, _SHROUD)])
    bands = [
        s.tube([0, 0, z], [0, 0, z + 0.07], skin - 0.01, radius) for z in (_AFT + 0.06, _AFT + 1.72, _SHROUD - 0.09)
    ]
    low, high = _AFT + 0.16, _SHROUD - 0.13
    upper = [_patch(skin, 0.018, low + 1.68, high, a - 17, a + 17) for a in (0, 90, 180, 270)]
    lower = [_patch(skin, 0.018, low, low + 1.5, a - 19, a + 19) for a in (40, 140, 220, 320)]
    vents = [_patch(skin, 0.05, low + 0.3, low + 0.75, a - 4, a + 4, 4) for a in (8, 172, 188, 352)]
    return [
        ("aft_shroud", body, material("silver-mli")),
        ("shroud_bands", s.join_meshes(bands), material("white-paint")),
        ("guidance_doors", s.join_meshes(upper), material("anodised-aluminium")),
        ("instrument_doors", s.join_meshes(lower), material("anodised-aluminium")),
        ("vents", s.join_meshes(vents), material("black-paint")),
        ("camera_radiator", _patch(skin, 0.08, low + 1.75, high - 0.1, 241, 254), material("white-paint")),
        ("cooling_radiator", _patch(skin + 0.05, 0.04, low + 0.1, high - 0.2, 62, 82), material("white-paint")),
        ("radiator_feet", s.join_meshes(_feet(skin, low, high)), material("anodised-aluminium")),
    ]


def _feet(skin: float, low: float, high: float) -> list[trimesh.Trimesh]:
    return [_patch(skin, 0.06, z, z + 0.08, a, a + 2, 2) for z in (low + 0.3, high - 0.6) for a in (64, 78)]


def _patch(
    radius: float, height: float, low: float, high: float, start: float, end: float, segments: int = 16
) -> trimesh.Trimesh:
    """A curved plate on a cylinder of `radius`, between two stations and two azimuths in degrees."""
    inner, outer = radius - 0.01, radius + height
    return s.sector([(inner, low), (outer, low), (outer, high), (inner, high)], start, end, segments)


def _aft() -> Solids:
    """What stands on the aft bulkhead: the soft-capture ring on its posts, boxes, a low-gain antenna."""
    ring = s.tube([0, 0, _AFT - 0.42], [0, 0, _AFT - 0.34], 0.83, 0.91)
    posts = [
        s.rod(
            [0.87 * np.cos(a), 0.87 * np.sin(a), _AFT - 0.01], [0.87 * np.cos(a), 0.87 * np.sin(a), _AFT - 0.35], 0.04
        )
        for a in np.radians([30.0, 150.0, 270.0])
    ]
    boxes = [s.box([0.5, 0.3, 0.16], [x, y, _AFT - 0.08]) for x, y in ((1.3, 0.7), (-1.3, 0.7), (-1.2, -0.8))]
    pins = [
        s.rod(
            [1.65 * np.cos(a), 1.65 * np.sin(a), _AFT + 0.05], [1.65 * np.cos(a), 1.65 * np.sin(a), _AFT - 0.22], 0.06
        )
        for a in np.radians([10.0, 130.0, 250.0])
    ]
    cone = s.revolve([(0, 0), (0.11, 0), (0.04, 0.3), (0, 0.3)])
    return [
        (
            "aft_bulkhead",
            s.rod([0, 0, _AFT - 0.02], [0, 0, _AFT + 0.01], 1.95, s.SEGMENTS),
            material("white-paint-matt"),
        ),
        ("capture_ring", ring, material("bare-aluminium")),
        ("capture_posts", s.join_meshes(posts), material("bare-aluminium")),
        ("berthing_pins", s.join_meshes(pins), material("bare-aluminium")),
        ("aft_boxes", s.join_meshes(boxes), material("silver-mli")),
        ("low_gain_antenna_aft", s.place_mesh(cone, [1.2, -0.9, _AFT - 0.01], [0, 0, -1]), material("white-paint")),
    ]


def _array(name: str, side: float) -> Solids:
    """A rigid solar array on its mast: two halves of four panels each, cells towards +V3."""
    length, width = ARRAY
    inner, middle, slot = 2.95, -0.75, 0.24
    half = 0.5 * (length - slot)
    pitch = (half - 0.1) / 4
    plates, frames, cells = [], [], []
    for end in (-1.0, 1.0):
        centre = [side * (inner + 0.5 * width), 0.0, end * 0.5 * (slot + half)]
        plates.append(s.box([width - 0.04, 0.03, half - 0.04], centre))
        for x in (-1.0, 1.0):
            frames.append(s.box([0.05, 0.05, half], centre + np.array([x * (0.5 * width - 0.025), 0, 0])))
        for z in (-1.0, 1.0):
            frames.append(s.box([width - 0.1, 0.05, 0.05], centre + np.array([0, 0, z * (0.5 * half - 0.025)])))
        for i in range(4):
            z = end * (0.5 * slot + 0.05 + (i + 0.5) * pitch)
            cells.append(s.box([width - 0.14, 0.012, pitch - 0.05], [centre[0], 0.02, z]))
    mast = s.rod([side * (inner - 0.02), 0, 0], [side * (inner + width), 0, 0], 0.06)
    arm = s.rod([side * 1.66, 0, 0], [side * (inner - 0.01), 0, 0], 0.09)
    braces = [
        s.rod([side * (inner + x), 0, 0], [side * (inner + x), 0, z], 0.03, 12)
        for x in (0.4, width - 0.4)
        for z in (-0.2, 0.2)
    ]
    solids = [
        (f"array_plates_{name}", s.join_meshes(plates), material("grey-paint")),
        (f"array_frames_{name}", s.join_meshes(frames), material("anodised-aluminium")),
        (f"array_cells_{name}", s.join_meshes(cells), material("solar-cell")),
        (f"array_mast_{name}", mast, material("bare-aluminium")),
        (f"array_braces_{name}", s.join_meshes(braces), material("bare-aluminium")),
        (f"array_arm_{name}", arm, material("white-paint")),
        (f"array_drive_{name}", s.rod([side * 1.5, 0, 0], [side * 1.72, 0, 0], 0.2, 48), material("silver-mli")),
    ]
    return [
        (part, s.translate_mesh(s.rotate_mesh(mesh, _SOLAR_TURN_DEG, [1, 0, 0]), [0, 0, middle]), surface)
        for part, mesh, surface in solids
    ]


def _antenna(name: str, side: float) -> Solids:
    """A high-gain antenna dish at the end of a boom along V3."""
    foot = np.array([0.0, side * (_TUBE - 0.02), 1.75])
    tip = foot + np.array([0.0, side * 3.6, 0.0])
    place = s.axis_frame(tip + np.array([0, side * 0.15, 0.3]), [0.25 * side, 0.35 * side, 1.0])
    focal, rim = 0.5, 0.52
    feed = [0.0, 0.0, focal]
    legs = [
        s.rod([rim * np.cos(a), rim * np.sin(a), rim**2 / (4 * focal) - 0.01], feed, 0.012, 12)
        for a in np.radians([90.0, 210.0, 330.0])
    ]
    horn = s.rod([0, 0, focal - 0.07], [0, 0, focal + 0.07], 0.06)
    hub = s.rod([0, 0, -0.2], [0, 0, -0.01], 0.14, 48)
    dish = [
        (f"dish_{name}", s.dish(1.3, focal, 0.02), material("white-paint-matt")),
        (f"dish_feed_{name}", s.join_meshes([horn, *legs]), material("anodised-aluminium")),
        (f"dish_hub_{name}", hub, material("silver-mli")),
    ]
    hinge = s.box([0.3, 0.2, 0.36], foot + np.array([0, side * 0.07, 0]))
    return [
        (f"boom_{name}", s.rod(foot, tip, 0.05), material("white-paint")),
        (f"boom_hinge_{name}", hinge, material("bare-aluminium")),
        (
            f"dish_gimbal_{name}",
            s.box([0.2, 0.3, 0.26], tip + np.array([0, side * 0.05, 0.02])),
            material("silver-mli"),
        ),
        *((part, mesh.apply_transform(place), surface) for part, mesh, surface in dish),
    ]


def _fittings() -> Solids:
    """Magnetic torquers, grapple fixtures, boxes and a low-gain antenna on the tube."""
    torquers, brackets, grapples, pads, boxes = [], [], [], [], []
    for angle in (40.0, 140.0, 220.0, 320.0):
        torquers.append(
            s.rotate_mesh(s.rod([_TUBE + 0.14, 0, -0.85], [_TUBE + 0.14, 0, 1.65], 0.043), angle, [0, 0, 1])
        )
        for z in (-0.6, 0.4, 1.4):
            brackets.append(s.rotate_mesh(s.box([0.16, 0.1, 0.1], [_TUBE + 0.06, 0, z]), angle, [0, 0, 1]))
        boxes.append(s.rotate_mesh(s.box([0.2, 0.3, 0.24], [_TUBE + 0.08, 0, _FRONT - 0.5]), angle, [0, 0, 1]))
    for angle in (65.0, 295.0):
        pads.append(s.rotate_mesh(s.rod([_TUBE - 0.02, 0, -0.2], [_TUBE + 0.05, 0, -0.2], 0.28, 48), angle, [0, 0, 1]))
        grapples.append(s.rotate_mesh(s.rod([_TUBE + 0.04, 0, -0.2], [_TUBE + 0.4, 0, -0.2], 0.02), angle, [0, 0, 1]))
    electronics = [
        s.rotate_mesh(s.box([0.22, 0.5, 0.7], [_TUBE + 0.09, 0, z]), a, [0, 0, 1])
        for z, a in ((-0.9, 20.0), (-0.9, 160.0), (1.05, 10.0), (1.05, 190.0), (-0.9, 250.0))
    ]
    cone = s.revolve([(0, 0), (0.11, 0), (0.04, 0.3), (0, 0.3)])
    return [
        ("torquers", s.join_meshes(torquers), material("anodised-aluminium")),
        ("torquer_brackets", s.join_meshes(brackets), material("white-paint")),
        ("sun_sensors", s.join_meshes(boxes), material("white-paint")),
        ("grapple_pads", s.join_meshes(pads), material("white-paint")),
        ("grapple_pins", s.join_meshes(grapples), material("bare-aluminium")),
        ("electronics", s.join_meshes(electronics), material("silver-mli")),
        ("low_gain_antenna_front", s.place_mesh(cone, [0, -_TUBE + 0.01, 5.9], [0, -1, 0]), material("white-paint")),
    ]


def _handrails() -> trimesh.Trimesh:
    """Yellow rails along and around the tube and the aft shroud."""
    rails = []
    for radius, low, high, angles in (
        (_TUBE - 0.01, 2.9, 4.1, (30, 90, 150, 210, 270, 330)),
        (_TUBE - 0.01, 4.5, 5.7, (30, 150, 210, 330)),
        (0.5 * DIAMETER - 0.04, _AFT + 0.3, _AFT + 1.5, (20, 60, 120, 160, 200, 240, 300, 340)),
        (0.5 * DIAMETER - 0.04, _AFT + 1.95, _SHROUD - 0.3, (25, 65, 115, 155, 205, 235, 305, 335)),
    ):
        for a in np.radians(angles):
            out = np.array([np.cos(a), np.sin(a), 0.0])
            rails.append(s.handrail(radius * out + [0, 0, low], radius * out + [0, 0, high], out, 0.1, 0.016))
    for angle in range(15, 360, 30):
        a, b = np.radians([angle - 11.0, angle + 11.0])
        ends = [1.98 * np.array([np.cos(x), np.sin(x), 0.0]) + [0, 0, _BAY - 0.06] for x in (a, b)]
        rails.append(s.handrail(ends[0], ends[1], ends[0] + ends[1] - [0, 0, 2 * _BAY - 0.12], 0.13, 0.016))
    return s.join_meshes(rails)
