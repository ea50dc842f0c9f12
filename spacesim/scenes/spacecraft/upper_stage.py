"""upper-stage: a spent upper stage of the size and layout of the H-IIA's second stage.

Body axes: +x towards the payload, the nozzle opens towards -x. The origin is half-way along the stage.

Public figures that it keeps to: about 11 m long and 4 m wide (Astroscale, ADRAS-J mission, "an unprepared upper
stage of 11 m by 4 m"), liquid-hydrogen tank of 4 m with sprayed foam, a smaller liquid-oxygen tank hung below it on a
truss, one LE-5B engine 2.8 m long (JAXA, "H-IIA Launch Vehicle" brochure; Mitsubishi Heavy Industries, LE-5B-2),
and a conical adapter with the common 1,194 mm clamp-band ring. Everything else is estimated from public photographs.

All is built upright first, z towards the payload.
"""

import numpy as np
import trimesh

from spacesim.data.geometry import Array
from spacesim.scenes import shapes as s
from spacesim.scenes.materials.table import Material, lambertian, material
from spacesim.scenes.spacecraft.part import Part, Spacecraft

LENGTH, DIAMETER = 11.0, 4.0  #: over nozzle and adapter; of the hydrogen tank, metres
ADAPTER = 1.194  #: diameter of the adapter's front ring, metres

_TOP, _SHELF, _FRONT, _BACK, _SKIRT, _EXIT = 0.5 * LENGTH, 4.45, 4.0, 0.05, -0.5, -0.5 * LENGTH  # stations
_RADIUS = 0.5 * DIAMETER
_OXYGEN, _OXYGEN_RADIUS, _OXYGEN_HALF = -1.55, 1.55, 0.95  # middle of the oxygen tank, its half axes, metres
_THROAT = -3.25
_AVIONICS = (  # azimuth in degrees, width and height in metres of the boxes on the shelf
    *((12, 0.5, 0.3), (52, 0.35, 0.22), (95, 0.6, 0.26), (140, 0.4, 0.35)),
    *((185, 0.5, 0.2), (228, 0.32, 0.3), (275, 0.55, 0.24), (322, 0.42, 0.3)),
)
_X_FROM_Z = np.array([[0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]], dtype=np.float64)

FOAM = lambertian(
    "foam-insulation",
    (0.36, 0.19, 0.065),
    "sprayed polyisocyanurate foam, browned by sunlight; chosen after photographs",
)

Solids = list[tuple[str, trimesh.Trimesh, Material]]


def upper_stage() -> Spacecraft:
    """A spent upper stage, 11 m long."""
    solids = [*_hydrogen_tank(), *_skirts(), *_adapter(), *_oxygen_tank(), *_engine(), *_fittings()]
    parts = [Part(name, mesh.copy().apply_transform(_X_FROM_Z), surface) for name, mesh, surface in solids]
    return Spacecraft("upper-stage", tuple(parts))


def _hydrogen_tank() -> Solids:
    """The foam-covered cylinder between two domes, uneven as sprayed foam is."""
    heights = np.linspace(_BACK, _FRONT, 43)
    wall = [(_RADIUS - 0.03, z) for z in heights]
    front = [(r, _FRONT + z) for r, z in s.dome(_RADIUS - 0.03, 0.38)[1:]]
    back = [(r, _BACK - z) for r, z in s.dome(_RADIUS - 0.03, 0.55)[:0:-1]]
    tank = s.revolve([*back, *wall, *front], 144)
    vertices = np.array(tank.vertices)
    radius = np.linalg.norm(vertices[:, :2], axis=1)
    rough = np.random.default_rng(3).uniform(-1.0, 1.0, len(vertices))
    vertices[:, :2] *= (1.0 + 0.006 * rough * (radius > 0.5) / np.maximum(radius, 0.5))[:, None]
    foam = trimesh.Trimesh(vertices, tank.faces, process=False)
    seams = [s.tube([0, 0, z - 0.03], [0, 0, z + 0.03], _RADIUS - 0.06, _RADIUS - 0.012) for z in (1.0, 2.0, 3.0)]
    return [("hydrogen_tank", foam, FOAM), ("tank_seams", s.join_meshes(seams), FOAM)]


def _skirts() -> Solids:
    """The rings that the tank's wall ends in, the front one with its stringers."""
    inner = _RADIUS - 0.09
    front = s.tube([0, 0, _FRONT - 0.08], [0, 0, _SHELF], inner, _RADIUS)
    back = s.tube([0, 0, _SKIRT], [0, 0, _BACK + 0.08], inner, _RADIUS)
    frames = [
        s.tube([0, 0, z - 0.025], [0, 0, z + 0.025], _RADIUS - 0.02, _RADIUS + 0.03)
        for z in (_SHELF - 0.03, _FRONT - 0.05, _BACK + 0.05, _SKIRT + 0.03)
    ]
    stringers = [
        s.rotate_mesh(s.box([0.03, 0.03, high - low], [_RADIUS + 0.005, 0, 0.5 * (low + high)]), angle, [0, 0, 1])
        for low, high in ((_FRONT - 0.02, _SHELF - 0.06), (_SKIRT + 0.06, _BACK + 0.02))
        for angle in np.arange(0, 360, 7.5)
    ]
    return [
        ("front_skirt", front, material("white-paint")),
        ("aft_skirt", back, material("white-paint")),
        ("skirt_frames", s.join_meshes(frames), material("anodised-aluminium")),
        ("skirt_stringers", s.join_meshes(stringers), material("anodised-aluminium")),
    ]


def _adapter() -> Solids:
    """The equipment shelf with its boxes, and the payload adapter: an open cone with a clamp-band ring."""
    foot, top, wall = 1.35, 0.5 * ADAPTER, 0.02
    low, high = _SHELF - 0.07, _SHELF - 0.02
    shelf = s.revolve([(1.2, low), (_RADIUS - 0.08, low), (_RADIUS - 0.08, high), (1.2, high)])
    cone = s.revolve([(foot - wall, high - 0.02), (foot, high - 0.02), (top, _TOP - 0.1), (top - wall, _TOP - 0.1)])
    ring = s.tube([0, 0, _TOP - 0.12], [0, 0, _TOP], top - 0.05, top)
    collar = s.tube([0, 0, high - 0.01], [0, 0, high + 0.05], foot - 0.04, foot + 0.03)
    ribs = []
    for angle in range(0, 360, 15):
        spine = s.pipe([[foot - 0.012, 0, high], [top + 0.008, 0, _TOP - 0.12]], 0.02, 8)
        ribs.append(s.rotate_mesh(spine, angle + 7.5, [0, 0, 1]))
    boxes: dict[str, list[trimesh.Trimesh]] = {"black": [], "silver": [], "white": []}
    for i, (angle, width, height) in enumerate(_AVIONICS):
        case = s.box([0.32, width, height], [1.65, 0, high + 0.5 * height - 0.01])
        boxes[("black", "silver", "white")[i % 3]].append(s.rotate_mesh(case, angle, [0, 0, 1]))
    return [
        ("equipment_shelf", shelf, material("anodised-aluminium")),
        ("payload_adapter", cone, material("carbon-fibre")),
        ("adapter_ribs", s.join_meshes(ribs), material("anodised-aluminium")),
        ("adapter_ring", ring, material("bare-aluminium")),
        ("adapter_collar", collar, material("bare-aluminium")),
        ("avionics_black", s.join_meshes(boxes["black"]), material("black-paint")),
        ("avionics_silver", s.join_meshes(boxes["silver"]), material("silver-mli")),
        ("avionics_white", s.join_meshes(boxes["white"]), material("white-paint")),
    ]


def _oxygen_tank() -> Solids:
    """The ellipsoidal tank under its blanket, hung on a truss of struts from the aft skirt."""
    lower = [(r, _OXYGEN - z) for r, z in s.dome(_OXYGEN_RADIUS, _OXYGEN_HALF, 20)[::-1]]
    upper = [(r, _OXYGEN + z) for r, z in s.dome(_OXYGEN_RADIUS, _OXYGEN_HALF, 20)[1:]]
    tank = s.revolve([*lower, *upper])
    belt = s.tube([0, 0, _OXYGEN - 0.16], [0, 0, _OXYGEN - 0.02], _OXYGEN_RADIUS - 0.03, _OXYGEN_RADIUS + 0.05)
    struts = []
    for i in range(16):
        head = _around(_RADIUS - 0.06, 22.5 * i, _SKIRT + 0.06)
        struts += [
            s.rod(head, _around(_OXYGEN_RADIUS + 0.03, 22.5 * i + side, _OXYGEN - 0.09), 0.028, 14)
            for side in (-10, 10)
        ]
    return [
        ("oxygen_tank", tank, material("gold-mli")),
        ("oxygen_belt", belt, material("anodised-aluminium")),
        ("truss", s.join_meshes(struts), material("carbon-fibre")),
    ]


def _around(radius: float, angle_deg: float, z: float) -> Array:
    angle = np.radians(angle_deg)
    return np.array([radius * np.cos(angle), radius * np.sin(angle), z])


def _engine() -> Solids:
    """An engine like the LE-5B: chamber, bell with its bands, two turbopumps, ducts, gimbal and thrust cone."""
    throat, exit_radius, wall = 0.11, 0.84, 0.018
    along = np.linspace(0.0, 1.0, 25)
    contour = throat + (exit_radius - throat) * (1.75 * along - 0.75 * along**2) ** 0.85
    z = _THROAT + along * (_EXIT - _THROAT)
    outside = np.stack([contour + wall, z], axis=-1)
    inside = np.stack([contour, z], axis=-1)
    bell = s.revolve([*inside, *outside[::-1]])
    bands = [
        s.revolve([(r + 0.004, h - 0.02), (r + 0.05, h - 0.02), (r + 0.05, h + 0.02), (r + 0.004, h + 0.02)])
        for r, h in ((np.interp(-h, -z, contour), h) for h in (-5.46, -4.8, -4.2, -3.75))
    ]
    chamber = s.revolve(
        [(0, _THROAT - 0.02), (throat + 0.02, _THROAT - 0.02), (throat + 0.04, _THROAT + 0.06), (0.2, _THROAT + 0.2),
         (0.2, _THROAT + 0.45), (0.27, _THROAT + 0.46), (0.27, _THROAT + 0.54), (0, _THROAT + 0.54)]
    )  # fmt: skip
    cone = s.revolve([(0.2, -2.68), (0.26, -2.68), (0.76, -2.32), (0.7, -2.32)])
    mount = s.rod([0, 0, _THROAT + 0.5], [0, 0, -2.47], 0.09, 36)
    pumps = [
        s.join_meshes([s.rod([x, y, -3.42], [x, y, -2.75], 0.13, 36), s.rod([x, y, -3.2], [x, y, -3.08], 0.2, 36)])
        for x, y in ((0.48, 0.12), (-0.46, -0.18))
    ]
    ducts = [
        s.pipe([[-0.46, -0.18, -2.8], [-0.5, -0.2, -2.6], [-0.68, -0.36, -2.3]], 0.07, 16),
        s.pipe([[0.6, 0.14, -3.16], [0.72, 0.1, -3.4], [0.55, 0.05, -3.75], [0.42, 0.02, -3.8]], 0.045, 14),
        s.pipe([[-0.58, -0.2, -3.16], [-0.7, -0.1, -3.4], [-0.5, 0.0, -3.7], [-0.36, 0.0, -3.73]], 0.045, 14),
    ]
    actuators = [s.rod(_around(0.23, a, _THROAT + 0.4), _around(1.15, a, -2.15), 0.04, 16) for a in (100.0, 190.0)]
    return [
        ("nozzle", bell, material("nozzle-alloy")),
        ("nozzle_bands", s.join_meshes(bands), material("nozzle-alloy")),
        ("chamber", chamber, material("nozzle-alloy")),
        ("thrust_cone", cone, material("anodised-aluminium")),
        ("engine_mount", mount, material("bare-aluminium")),
        ("turbopumps", s.join_meshes(pumps), material("bare-aluminium")),
        ("engine_ducts", s.join_meshes(ducts), material("bare-aluminium")),
        ("actuators", s.join_meshes(actuators), material("anodised-aluminium")),
    ]


def _fittings() -> Solids:
    """Lines and a cable tunnel along the tank, helium bottles and thrusters around the aft skirt, antennas."""
    tunnel = s.rotate_mesh(s.box([0.16, 0.34, 4.6], [_RADIUS + 0.03, 0, 2.0]), 35.0, [0, 0, 1])
    covers = [
        s.rotate_mesh(s.box([0.12, 0.42, 0.07], [_RADIUS + 0.06, 0, z]), 35.0, [0, 0, 1])
        for z in (0.25, 1.4, 2.6, 3.75)
    ]
    way = [(0.6, -2.6), (1.6, -2.2), (_RADIUS + 0.1, -0.9), (_RADIUS + 0.1, 3.5), (_RADIUS - 0.05, 3.7)]
    line = s.pipe([[0.48, 0.12, -2.8], *([x, 0, z] for x, z in way)], 0.075, 20)
    clamps = [s.box([0.22, 0.24, 0.05], [_RADIUS + 0.04, 0, z]) for z in (0.3, 1.2, 2.3, 3.2)]
    bottles, straps, brackets = [], [], []
    for a in (67.5, 112.5, 247.5, 292.5):
        centre = _around(1.8, a, -2.1)
        bottles.append(s.translate_mesh(trimesh.creation.icosphere(subdivisions=3, radius=0.3), centre))
        straps.append(s.translate_mesh(s.tube([0, 0, -0.03], [0, 0, 0.03], 0.29, 0.315, 48), centre))
        brackets += [
            s.rod(_around(1.55, a + side, -1.66), _around(1.8, a + side, -1.95), 0.025, 12) for side in (-5, 5)
        ]
    pods, jets = [], []
    jet = s.revolve([(0.015, -0.01), (0.02, -0.01), (0.055, 0.12), (0.05, 0.12)])
    for a in (90.0, 270.0):
        pods.append(s.rotate_mesh(s.box([0.26, 0.5, 0.42], [_RADIUS + 0.1, 0, -0.2]), a, [0, 0, 1]))
        for y, axis in ((0.25, [0, 1, 0]), (-0.25, [0, -1, 0])):
            jets += [
                s.rotate_mesh(s.place_mesh(jet, [_RADIUS + 0.14, y, -0.2 + h], axis), a, [0, 0, 1]) for h in (-0.1, 0.1)
            ]
        jets.append(s.rotate_mesh(s.place_mesh(jet, [_RADIUS + 0.14, 0, -0.41], [0, 0, -1]), a, [0, 0, 1]))
    antennas = [
        s.rotate_mesh(s.box([0.05, 0.2, 0.2], [_RADIUS + 0.02, 0, 4.22]), a, [0, 0, 1]) for a in (60.0, 180.0, 300.0)
    ]
    return [
        ("cable_tunnel", tunnel, material("white-paint")),
        ("tunnel_covers", s.join_meshes(covers), material("anodised-aluminium")),
        ("feed_line", line, material("bare-aluminium")),
        ("feed_line_clamps", s.join_meshes(clamps), material("anodised-aluminium")),
        ("helium_bottles", s.join_meshes(bottles), material("carbon-fibre")),
        ("bottle_straps", s.join_meshes([*straps, *brackets]), material("bare-aluminium")),
        ("thruster_pods", s.join_meshes(pods), material("gold-mli")),
        ("thrusters", s.join_meshes(jets), material("nozzle-alloy")),
        ("antennas", s.join_meshes(antennas), material("kapton")),
    ]
