"""7. Radiance fields: train one on the data of 01_simulate.py, and draw two of it on each ray (algorithm 1).

python examples/07_radiance_fields.py        minutes on two cores; reads 07_radiance_fields.toml beside it, writes
out/examples/field and out/examples/fields
"""

import spacesim as ss


def main(data="out/examples/data", run="out/examples/field", scene="examples/07_radiance_fields.toml", **options):
    trained = ss.train(ss.read_dataset(data), run, method="nerf", preset="demo", **options)
    done = ss.compose(ss.load_scene(scene), f"{run}s")
    print(f"field: {run}; two of it: {done.sheet}")
    return trained


if __name__ == "__main__":
    main()
