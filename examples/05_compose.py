"""5. Compose: the run of 02_reconstruct.py twice in one scene; one of the two flies past while the Sun moves.

python examples/05_compose.py        a few seconds; reads 05_compose.toml beside it, writes out/examples/composed
"""

import spacesim as ss


def main(scene="examples/05_compose.toml", out="out/examples/composed", size=256):
    posed = ss.load_scene(scene)  # the file is one for `spacesim compose` and `spacesim view`, too
    done = ss.compose(posed, out, size=size)
    print(f"scene: {scene}; pictures: {out}; {done.video or done.note or done.sheet}")
    return posed


if __name__ == "__main__":
    main()
