"""Prints the first table of docs/shadows.md's section on bias: python tests/splat/shadow/acne.py     5 seconds

Acne is the share of a bare plate's discs that count as shadowed; recession, how far the shadow of a screen that stands
on it has withdrawn from its foot, and its tip from where it should be.
"""

from walls import BIASES, acne, screen_shadow

from spacesim.splat.shadow.mapping import MappingConfig

COUNT = 20_000


def main() -> None:
    print(f"| Sun [deg] | {' | '.join(BIASES)} | variance |")
    for elevation in (1, 2, 3, 5, 10, 15, 20, 30, 45, 60, 75, 90):
        cells = [cell(elevation, bias, None) for bias in BIASES]
        cells.append(cell(elevation, "lifted", MappingConfig("variance")))
        print(f"| {elevation} | {' | '.join(cells)} |", flush=True)


def cell(elevation: float, bias: str, config: MappingConfig | None) -> str:
    share = 100 * acne(elevation, bias, COUNT, config)
    if elevation > 80:
        return f"{share:.1f} % · – · –"
    foot, tip = (f"{1000 * metres:.0f}" for metres in screen_shadow(elevation, bias, COUNT, config))
    return f"{share:.1f} % · {foot} · {tip.replace('nan', '–')}"


if __name__ == "__main__":
    main()
