"""Trains the learned peers, all for the same time, on the pairs that ours learns from.

    python experiments/learned/train.py --data PATH

This is a short training, for two CPU cores; `--minutes 600 --out runs/long` is a longer one. A run that was stopped
goes on with the same command; other minutes need another folder. Weights and their cards are written to the folder
`weights` beside this file, where they replace those of the run before.
"""

import argparse
import shutil
from pathlib import Path

from urrt_jax.cli.train import PairFlags, Train

HERE = Path(__file__).parent
RATES: dict[str, tuple[int, int]] = {
    "rienet": (512, 60),
    "rpmnet": (256, 22),
    "dcp_v2": (256, 34),
    "prnet": (256, 10),
    "deepgmr": (512, 90),
    "dcp_v1": (256, 70),
    "pointnetlk": (256, 55),
    "pointnetlk_revisited": (256, 45),
}
"""Points of a training pair, and steps of eight pairs that two cores do in a minute: the learning rate's schedule."""


def flags(method: str, data: str, out: Path, minutes: float) -> Train:
    """What `urrt train` is given for one method."""
    points, rate = RATES[method]
    steps = max(1, round(rate * minutes))
    return Train(
        method=method,  # pyright: ignore[reportArgumentType]
        data=data,
        out=out / method,
        steps=steps,
        minutes=minutes,
        batch=8,
        learning_rate=1e-3,
        warmup=steps // 10,
        every=max(1, steps // 4),
        log_every=max(1, steps // 40),
        validation_pairs=32,
        pairs=PairFlags(points=points),
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", required=True, help="as for `urrt train --data`")
    parser.add_argument("--methods", nargs="+", choices=RATES, default=list(RATES), help="by default all of them")
    parser.add_argument("--minutes", type=float, default=8, help="of training, for each method; 8 unless given")
    parser.add_argument("--out", type=Path, default=Path("runs/learned"), help="of the runs; runs/learned unless given")
    options = parser.parse_args()
    weights = HERE / "weights"
    weights.mkdir(exist_ok=True)
    for method in options.methods:
        run = flags(method, options.data, options.out, options.minutes)
        try:
            stopped = run.run()
        except (OSError, ValueError) as error:
            parser.error(str(error))
        if stopped:
            raise SystemExit(f"{method} was stopped; the same command goes on with it")
        for suffix in (".npz", ".json"):
            shutil.copyfile(run.out / f"model{suffix}", weights / f"{method}{suffix}")


if __name__ == "__main__":
    main()
