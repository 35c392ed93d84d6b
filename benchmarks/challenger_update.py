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
from typing import Any

import numpy as np
import torch
from gymnasium import spaces

HERE = Path(__file__).resolve().parents[1]
ACTIONS = {"vector": 1, "cameras": 7}


def space(kind: str) -> spaces.Dict:
    if kind == "vector":
        return spaces.Dict({"state": spaces.Box(-np.inf, np.inf, (2,), np.float32)})
    camera = spaces.Box(0, 255, (32, 32, 3), np.uint8)
    return spaces.Dict({"base": camera, "hand": camera, "state": spaces.Box(-np.inf, np.inf, (29,), np.float32)})


def measure(kind: str, updates: int) -> dict[str, float]:
    """:return: CPU milliseconds of the median update, and tensor operations"""
    from sb3_cpm.challenger import Challenger
    from sb3_cpm.type_aliases import SequenceBatch

    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    torch.manual_seed(0)
    challenger = Challenger(space(kind), spaces.Box(-1.0, 1.0, (ACTIONS[kind],), np.float32), "cpu")
    rng, shape = np.random.default_rng(0), (challenger.sequence_length, challenger.batch_size)
    observations: dict[str, Any] = {
        key: rng.integers(0, 256, (*shape, *sub.shape), dtype=np.uint8)
        if sub.dtype == np.uint8
        else rng.normal(size=(*shape, *(sub.shape or ()))).astype(np.float32)
        for key, sub in space(kind).items()
    }
    first = np.zeros(shape, bool)
    first[0] = True
    actions = rng.uniform(-1, 1, (*shape, ACTIONS[kind])).astype(np.float32) * ~first[..., None]
    rewards = rng.uniform(size=shape).astype(np.float32) * ~first
    batch = SequenceBatch(observations, actions, rewards, first, np.zeros(shape, bool), np.ones(shape, bool))
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
    parser.add_argument("--measure", choices=list(ACTIONS), help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.measure:
        print(json.dumps(measure(args.measure, args.updates)))
        return
    checkouts = {"this": HERE} | ({"other": args.against.resolve()} if args.against else {})
    print("| default preset, on | checkout | CPU ms | least | tensor operations | this / other |")
    print("| --- | --- | --- | --- | --- | --- |")
    for kind in ACTIONS:
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
