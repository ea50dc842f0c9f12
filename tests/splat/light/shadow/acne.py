"""Prints the tables of a flat plate in docs/research/shadows.md: python tests/splat/light/shadow/acne.py     a minute

Acne is the share of a bare plate's discs that count as shadowed (mapping), and their mean occlusion (splatting, which
darkens by degrees), in percent; recession, how far the shadow of a screen that stands on it has withdrawn from its
foot, and how far its tip is beyond where it should be, in millimetres.
"""

import math
from dataclasses import replace

from walls import BIASES, acne, screen_shadow, way

from spacesim.splat.light.shadow.cast import ShadowConfig
from spacesim.splat.light.shadow.mapping import MappingConfig

COUNT = 20_000
ELEVATIONS = (1, 2, 3, 5, 10, 15, 20, 30, 45, 60, 75, 90)


def main() -> None:
    for method in ("mapping", "splatting"):
        ways = {name: way(name, method) for name in (*BIASES, "fast")}
        if method == "mapping":
            ways["fine"] = way("fine", method)  # splatting's are alike
            ways["lift, variance"] = replace(ways["lift"], method=MappingConfig("variance"))
        print(f"\n| {method}: Sun [°] | {' | '.join(ways)} |")
        for elevation in ELEVATIONS:
            print(f"| {elevation} | {' | '.join(cell(elevation, config) for config in ways.values())} |", flush=True)


def cell(elevation: float, config: ShadowConfig) -> str:
    mean, share = acne(elevation, config, COUNT)
    found = (math.nan, math.nan) if elevation > 80 else screen_shadow(elevation, config, COUNT)
    lengths = ["–" if math.isnan(metres) else f"{1000 * metres:.0f}" for metres in found]
    return " · ".join([f"{100 * (share if config.method.kind == 'mapping' else mean):.1f}", *lengths])


if __name__ == "__main__":
    main()
