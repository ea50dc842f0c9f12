"""3. Evaluate: evaluate the run of 02_reconstruct.py on held-out views, print the metrics, write the report.

python examples/03_evaluate.py        a few seconds; writes out/examples/eval
"""

import spacesim as ss


def main(data="out/examples/data", run="out/examples/run", out="out/examples/eval"):
    scores = ss.evaluate(run, data, out)
    for group in "image", "shadow", "shadow_mask":
        for name, value in (scores[group] or {}).items():
            print(f"{group:>11} {name:<20}", f"{value['mean']:.4f} ± {value['std']:.4f}" if value else "null")
    print(*scores["notes"], sep="\n")
    print(f"report: {out}/report.html")
    return scores


if __name__ == "__main__":
    main()
