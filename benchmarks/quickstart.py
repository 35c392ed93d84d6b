"""
The quickstart of the README on Pendulum-v1: environment steps per second of CPM-SAC beside plain SAC.

Both make one update of the player per step with SAC's defaults; runs are interleaved, medians are printed.

    python benchmarks/quickstart.py [--steps 1500] [--rounds 3] [--threads 1]
"""

import argparse
import statistics
import time

import gymnasium as gym
import torch
from stable_baselines3 import SAC

from sb3_cpm import ChallengerCallback, CPMBuffer
from sb3_cpm.envs.wrappers import DictObservation


def run(challenger: bool, steps: int, seed: int) -> tuple[float, float]:
    """:return: wall-clock and CPU seconds of one run"""
    env = DictObservation(gym.make("Pendulum-v1"))
    kwargs = {"replay_buffer_class": CPMBuffer} if challenger else {}
    model = SAC("MultiInputPolicy", env, learning_starts=200, seed=seed, device="cpu", **kwargs)
    wall, cpu = time.perf_counter(), time.process_time()
    model.learn(steps, callback=ChallengerCallback() if challenger else None)
    return time.perf_counter() - wall, time.process_time() - cpu


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=1500)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--threads", type=int, default=1)
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    run(True, 300, seed=0)  # warm-up

    walls: dict[str, list[float]] = {"SAC": [], "CPM-SAC": []}
    cpus: dict[str, list[float]] = {"SAC": [], "CPM-SAC": []}
    for seed in range(args.rounds):
        for name in walls:
            wall, cpu = run(name == "CPM-SAC", args.steps, seed)
            walls[name].append(wall)
            cpus[name].append(cpu)

    print(f"| Pendulum-v1, {args.steps} steps, {args.threads} thread(s) | steps/s | CPU ms per step | wall clock / SAC |")
    print("| --- | --- | --- | --- |")
    for name in walls:
        ratio = statistics.median(ours / sac for ours, sac in zip(walls[name], walls["SAC"], strict=True))
        speed, cpu = args.steps / statistics.median(walls[name]), 1e3 * statistics.median(cpus[name]) / args.steps
        print(f"| {name} | {speed:.0f} | {cpu:.1f} | {ratio:.2f} |")


if __name__ == "__main__":
    main()
