"""3. Evaluate: judge the run of 02_reconstruct.py on held-out views, print the metrics, write the report.

python examples/03_evaluate.py        a few seconds; writes out/examples/eval
"""

from pathlib import Path
from typing import Any

from spacesim.data.store import read_dataset
from spacesim.eval.evaluate import EvaluateConfig, evaluate
from spacesim.eval.report import write_report
from spacesim.splat.run import load_run

DATA, RUN, OUT = Path("out/examples/data"), Path("out/examples/run"), Path("out/examples/eval")


def main(data: Path = DATA, run: Path = RUN, out: Path = OUT) -> dict[str, Any]:
    metrics = evaluate(load_run(run), read_dataset(data), out, EvaluateConfig(split="test"))
    for group in "image", "shadow":
        for name, value in metrics[group].items():
            known = f"{value['mean']:.4f} ± {value['std']:.4f}" if value else "null"
            print(f"{group:>6} {name:<16} {known}")
    for note in metrics["notes"]:
        print(f"note: {note}")
    write_report([out], out / "report.html")
    print(f"report: {out / 'report.html'}")
    return metrics


if __name__ == "__main__":
    main()
