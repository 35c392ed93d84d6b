"""
What one update of the challenger's default preset costs, on a vector of two numbers (MountainCarContinuous-v0's) and on two
32x32 cameras with a state of 29 numbers (PickCube-v1's), beside the same of another checkout.

::

    OMP_NUM_THREADS=1 python benchmarks/challenger_update.py
    git worktree add ../before COMMIT; OMP_NUM_THREADS=1 python benchmarks/challenger_update.py --against ../before

Processes of both take turns, each with one thread, a few updates to warm up and the CPU seconds of those that follow; what is
printed is the median of the turns' medians, their minimum, the ratio, and the number of tensor operations of one update.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import torch
from gymnasium import spaces

HERE = Path(__file__).resolve().parents[1]
#: Number of cameras, size of the state, size of the action.
SIZES = {"vector": (0, 2, 1), "cameras": (2, 29, 7)}


def measure(kind: str, updates: int) -> dict[str, float]:
    """:return: CPU milliseconds of the median update, and tensor operations"""
    from world_model import make_batch, make_space

    from sb3_cpm.challenger import Challenger

    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    torch.manual_seed(0)
    cameras, state_dim, action_dim = SIZES[kind]
    space = make_space(32, cameras, state_dim)
    challenger = Challenger(space, spaces.Box(-1.0, 1.0, (action_dim,), np.float32), "cpu")
    batch = make_batch(space, (challenger.sequence_length, challenger.batch_size), action_dim)
    for _ in range(3):
        challenger.train(batch)
    seconds = []
    for _ in range(updates):
        start = time.process_time()
        challenger.train(batch)
        seconds.append(time.process_time() - start)
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CPU]) as profiled:
        challenger.train(batch)
    operations = sum(one.count for one in profiled.key_averages() if one.key.startswith("aten::"))
    return {"ms": 1000.0 * statistics.median(seconds), "operations": operations}


def turn(checkout: Path, kind: str, updates: int) -> dict[str, float]:
    """One process of a checkout."""
    command = [sys.executable, __file__, "--measure", kind, "--updates", str(updates)]
    environment = {**os.environ, "PYTHONPATH": str(checkout), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, env=environment, cwd=checkout, check=True, stdout=subprocess.PIPE, text=True)
    return json.loads(done.stdout.splitlines()[-1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--against", type=Path, help="another checkout")
    parser.add_argument("--turns", type=int, default=4)
    parser.add_argument("--updates", type=int, default=25, help="per turn")
    parser.add_argument("--measure", choices=list(SIZES), help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.measure:
        print(json.dumps(measure(args.measure, args.updates)))
        return
    checkouts = {"this": HERE} | ({"other": args.against.resolve()} if args.against else {})
    print("| default preset, on | checkout | CPU ms | least | tensor operations | this / other |")
    print("| --- | --- | --- | --- | --- | --- |")
    for kind in SIZES:
        found: dict[str, list[dict[str, float]]] = {name: [] for name in checkouts}
        for _ in range(args.turns):
            for name, checkout in checkouts.items():
                found[name].append(turn(checkout, kind, args.updates))
        for name, turns in found.items():
            each = [one["ms"] for one in turns]
            ratio = ""
            if args.against and name == "this":
                pairs = zip(each, (one["ms"] for one in found["other"]), strict=True)
                ratio = f"{statistics.median(ours / theirs for ours, theirs in pairs):.2f}"
            numbers = f"{statistics.median(each):.1f} | {min(each):.1f} | {turns[0]['operations']:.0f}"
            print(f"| {kind} | {name} | {numbers} | {ratio} |")


if __name__ == "__main__":
    main()
