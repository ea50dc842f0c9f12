"""Two spacecraft as mesh files: a station of modules, truss and wings, and a lander on four legs."""

from pathlib import Path

import numpy as np
import trimesh

from spacesim.scenes.shapes import box, dish, dome, pipe, place_mesh, revolve, rod, rotate_mesh

STATION = {
    "module*": "white-paint",
    "node*": "silver-mli",
    "port*": "bare-aluminium",
    "truss*": "bare-aluminium",
    "wing*": "solar-cell",
    "radiator*": "white-paint-matt",
    "antenna*": "grey-paint",
}
LANDER = {
    "bus*": "gold-mli",
    "deck*": "black-paint",
    "tank*": "silver-mli",
    "leg*": "bare-aluminium",
    "pad*": "anodised-aluminium",
    "bell*": "nozzle-alloy",
    "dish*": "white-paint",
    "mast*": "grey-paint",
    "cells*": "solar-cell",
}
NAMES = "station", "lander"
SCENE = """[[objects]]
mesh = "{name}.glb"
units = "m"
up = "z"
materials = {{ {materials} }}
"""


def write(name: str, folder: Path) -> Path:
    """The scene file of "station" or "lander" in `folder`, which is made, beside its mesh file."""
    parts, materials = {"station": (station(), STATION), "lander": (lander(), LANDER)}[name]
    folder.mkdir(parents=True, exist_ok=True)
    scene = trimesh.Scene()
    for part, mesh in parts.items():
        scene.add_geometry(mesh, node_name=part, geom_name=part)
    scene.export(folder / f"{name}.glb")
    path = folder / f"{name}.toml"
    path.write_text(SCENE.format(name=name, materials=", ".join(f'"{key}" = "{of}"' for key, of in materials.items())))
    return path


def station() -> dict[str, trimesh.Trimesh]:
    parts = {
        "module-aft": rod((-5.2, 0, 0), (-1.0, 0, 0), 1.05, 48),
        "module-fore": rod((1.0, 0, 0), (4.4, 0, 0), 1.05, 48),
        "module-nadir": rod((0, 0, -1.0), (0, 0, -3.6), 0.9, 48),
        "node": trimesh.creation.icosphere(3, 1.2),
        "port-fore": rod((4.4, 0, 0), (4.9, 0, 0), 0.55, 32),
        "port-aft": rod((-5.2, 0, 0), (-5.6, 0, 0), 0.6, 32),
        "truss-mast": box((0.35, 0.35, 1.6), (0, 0, 1.7)),
        "antenna": place_mesh(dish(1.0, 0.4, 0.03), (3.0, 0, 1.35), (0.4, 0.3, 1)),
        "antenna-mast": rod((3.0, 0, 1.0), (3.0, 0, 1.36), 0.05),
    }
    for side, sign in ("port", -1), ("starboard", 1):
        for i, z in enumerate((2.3, 2.7)):
            for j, x in enumerate((-0.2, 0.2)):
                parts[f"truss-{side}-{i}{j}"] = rod((x, sign * 0.1, z), (x, sign * 6.6, z), 0.05, 12)
        for i in range(9):
            y = sign * (0.3 + 0.75 * i)
            parts[f"truss-{side}-brace-{i}"] = pipe(
                [(-0.2, y, 2.3), (0.2, y, 2.3), (0.2, y, 2.7), (-0.2, y, 2.7)], 0.035
            )
        for i, y in enumerate((3.1, 5.6)):
            for k, x in enumerate((-2.6, 2.6)):
                wing = box((4.2, 1.7, 0.04), (x, sign * y, 2.5))
                parts[f"wing-{side}-{i}{k}"] = rotate_mesh(wing, 25, (1, 0, 0), (x, sign * y, 2.5))
        parts[f"radiator-{side}"] = box((0.05, 1.5, 2.0), (-0.5, sign * 1.4, 3.7))
    return parts


def lander() -> dict[str, trimesh.Trimesh]:
    parts = {
        "bus": rod((0, 0, -0.5), (0, 0, 0.5), 1.1, 8),
        "deck": rod((0, 0, 0.5), (0, 0, 0.56), 1.2, 8),
        "bell": revolve([(0.0, -0.5), (0.12, -0.55), (0.45, -1.05), (0.48, -1.05), (0.16, -0.5)][::-1], 48),
        "dish": place_mesh(dish(1.1, 0.4, 0.03), (0.55, 0.35, 1.35), (0.5, 0.3, 1)),
        "mast-dish": rod((0.55, 0.35, 0.56), (0.55, 0.35, 1.36), 0.05),
        "mast": rod((-0.7, -0.4, 0.56), (-0.7, -0.4, 2.0), 0.04),
        "mast-head": box((0.35, 0.2, 0.16), (-0.7, -0.4, 2.05)),
        "cells-lid": rotate_mesh(box((1.6, 1.1, 0.04), (-1.9, 0.5, 0.6)), 20, (0, 1, 0), (-1.1, 0.5, 0.6)),
        "tank-dome": place_mesh(revolve([(0, 0), *dome(0.42, 0.42)], 48), (-0.1, 0.6, 0.56), (0, 0, 1)),
    }
    for i, angle in enumerate(np.deg2rad((45, 135, 225, 315))):
        c, s = np.cos(angle), np.sin(angle)
        foot = (1.9 * c, 1.9 * s, -1.25)
        parts[f"leg-{i}"] = rod((1.05 * c, 1.05 * s, 0.3), foot, 0.06)
        parts[f"leg-{i}-strut"] = rod((0.95 * c, 0.95 * s, -0.45), (1.6 * c, 1.6 * s, -0.8), 0.04)
        parts[f"pad-{i}"] = rod((foot[0], foot[1], -1.32), (foot[0], foot[1], -1.24), 0.28, 32)
    for i, angle in enumerate(np.deg2rad((0, 90, 180, 270))):
        parts[f"tank-{i}"] = trimesh.creation.icosphere(3, 0.33).apply_translation(
            (1.15 * np.cos(angle), 1.15 * np.sin(angle), -0.15)
        )
    return parts
