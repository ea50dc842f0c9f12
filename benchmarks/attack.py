"""Attacks the program with damaged inputs, wrong command lines, kills, flipped bits and hostile clients of the viewer.

python benchmarks/attack.py --inputs 20000 --kills 100 --bits 5000 [--viewer 4] [--seed N] [--trial N]

tests/attack/attack.py says what counts as a find. --trial does one of the inputs again, and shows what it says.
Two cores take about 40 minutes for the numbers above.
"""

import argparse
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from support import common

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "attack"))

import attack
import attack_viewer
import corpus

EVERY = 10.0  #: seconds between two lines of progress


def main() -> None:
    """Attack, and print one table and the finds. Ends with code 1 where there are any."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--inputs", type=common.natural, default=2000, help="damaged files, wrong command lines (2000)")
    parser.add_argument("--kills", type=common.natural, default=10, help="commands that are ended and done again (10)")
    parser.add_argument("--bits", type=common.natural, default=500, help="bits that are flipped (500)")
    parser.add_argument("--viewer", type=float, default=1.0, help="size of the attack on the viewer, 0 for none (1)")
    parser.add_argument("--seed", type=common.natural, default=int(time.time()), help="(the time)")
    parser.add_argument("--trial", type=common.natural, help="number of one input to try again, with --seed")
    parser.add_argument("--processes", type=common.positive, default=2, help="at work at once (2)")
    parser.add_argument("--json", action="store_true", help="print the result as JSON alone")
    options = parser.parse_args()
    with TemporaryDirectory(prefix="spacesim-attack-") as folder:
        place = Path(folder)
        root = _quietly(lambda: corpus.build(place / "corpus"))
        if options.trial is not None:
            _once_more(root, place / "once", options.seed, options.trial)
            return
        tallies = _attacked(options, root, place)
    finds = [find for _, tally in tallies for find in tally.finds]
    rows = [{"": name, "tried": t.tried, "held": t.held, "finds": len(t.finds)} for name, t in tallies]
    if options.json:
        print(json.dumps({"seed": options.seed, "rows": rows, "finds": finds}, indent=1))
    else:
        print(f"seed {options.seed}\n\n{common.table(rows, markdown=True)}", *finds, sep="\n")
    sys.exit(bool(finds))


def _attacked(options: argparse.Namespace, root: Path, place: Path) -> list[tuple[str, attack.Tally]]:
    seed, processes = options.seed, options.processes
    parts: list[tuple[str, int, Callable[[Path, attack.Tell], attack.Tally]]] = [
        (
            "damaged inputs, command lines",
            options.inputs,
            lambda work, tell: attack.attack_inputs(root, work, seed, options.inputs, processes, tell),
        ),
        (
            "kills and signals",
            options.kills,
            lambda work, tell: attack.attack_kills(root, work, seed, options.kills, processes, tell),
        ),
        ("flipped bits", options.bits, lambda work, tell: attack.attack_bits(root, work, seed, options.bits, tell)),
    ]
    tallies = []
    for number, (name, count, do) in enumerate(parts):
        if count:
            work = place / str(number)
            work.mkdir()
            tallies.append((name, do(work, _teller(name, count))))
    if options.viewer > 0:
        (place / "viewer").mkdir()
        result = attack_viewer.attack(seed, max(options.viewer, 0.1), place / "viewer")
        tallies.append(("the viewer", attack.Tally(sum(result.tried.values()), result.finds)))
    return tallies


def _teller(name: str, count: int) -> attack.Tell:
    last, printed = time.monotonic(), 0

    def tell(tally: attack.Tally) -> None:
        nonlocal last, printed
        for find in tally.finds[printed:]:
            print(find, file=sys.stderr, flush=True)
        printed = len(tally.finds)
        if time.monotonic() - last >= EVERY or tally.tried == count:
            last = time.monotonic()
            print(f"{name}: {tally.tried}/{count}, {len(tally.finds)} finds", file=sys.stderr, flush=True)

    return tell


def _once_more(root: Path, place: Path, seed: int, number: int) -> None:
    place.mkdir()
    (place / "out").mkdir()
    trial = attack.prepared(attack.Copy(root, place / "in"), place / "out", seed, number)
    worker = attack.Worker(trial.folder)
    answer = worker.run(trial.words, trial.folder)
    worker.stop()
    print(trial.what, *(f"{key}: {value}" for key, value in answer.items()), attack.verdict(answer), sep="\n")


def _quietly(work: Callable[[], Any]) -> Any:
    """What `work` returns, without what the commands in it say."""
    import contextlib
    import io

    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        return work()


if __name__ == "__main__":
    common.run_main(main)
