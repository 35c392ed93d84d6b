"""
What an update of SAC costs on point clouds (306 points of six numbers and a state of 29, as PickCube-v1 has them), with

* a PointNet as everybody writes it (shared layers, then the maximum, SB3's policy),
* ``PointNetPolicy``: the same numbers, with gradients along critical points only, and clouds in parts that fit the cache,
* ``PointNetPolicy(critics_extractor=True)``: one PointNet, trained by the critic's loss.

::

    OMP_NUM_THREADS=1 python benchmarks/clouds.py

All take turns in one process; printed are medians in CPU milliseconds (on a GPU of the clock), and ratios to the first.
"""

import argparse
import time
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.torch_layers import create_mlp
from torch import nn

from sb3_cpm import PointNetPolicy
from sb3_cpm.extractors import PointNetExtractor

N_POINTS, N_FEATURES, STATE, ACTION, BATCH = 306, 6, 29, 7, 64


class PlainPointNet(nn.Module):
    def __init__(self, n_features: int, sizes: Any) -> None:
        super().__init__()
        self.shared = nn.Sequential(*create_mlp(n_features, -1, list(sizes)))

    def forward(self, points: th.Tensor) -> th.Tensor:
        return self.shared(points).max(dim=1).values


class PlainExtractor(PointNetExtractor):
    def __init__(self, observation_space: spaces.Dict, sizes: Any = (32, 64, 128)) -> None:
        super().__init__(observation_space, sizes)
        self.clouds = nn.ModuleList([PlainPointNet(N_FEATURES, sizes)])


KINDS: dict[str, tuple[Any, dict[str, Any]]] = {
    "plain": ("MultiInputPolicy", {"features_extractor_class": PlainExtractor}),
    "PointNetPolicy": (PointNetPolicy, {}),
    "critics_extractor": (PointNetPolicy, {"critics_extractor": True}),
}


class Noise(gym.Env):
    """Its clouds say nothing."""

    observation_space = spaces.Dict(
        {
            "pointcloud": spaces.Box(-np.inf, np.inf, (N_POINTS, N_FEATURES), np.float32),
            "state": spaces.Box(-np.inf, np.inf, (STATE,), np.float32),
        }
    )
    action_space = spaces.Box(-1, 1, (ACTION,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        self.t = 0
        return self._observation(), {}

    def step(self, action: np.ndarray) -> Any:
        self.t += 1
        return self._observation(), 0.0, False, self.t == 50, {}

    def _observation(self) -> dict[str, np.ndarray]:
        return {key: self.np_random.normal(size=box.shape).astype(np.float32) for key, box in self.observation_space.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--turns", type=int, default=25)
    parser.add_argument("--updates", type=int, default=4, help="per turn")
    parser.add_argument("--device", default="cpu")
    args = parser.parse_args()
    th.set_flush_denormal(True)
    models = {}
    for name, (policy, policy_kwargs) in KINDS.items():
        models[name] = SAC(
            policy, Noise(), policy_kwargs=policy_kwargs, buffer_size=500, learning_starts=300, device=args.device
        )
        models[name].learn(300)
    clock = time.process_time if args.device == "cpu" else time.perf_counter
    taken: dict[str, list[float]] = {name: [] for name in models}
    for _ in range(args.turns):
        for name, model in models.items():
            began = clock()
            model.train(args.updates, BATCH)  # its losses are read, so that a GPU has finished
            taken[name].append(1e3 * (clock() - began) / args.updates)
    plain = float(np.median(taken["plain"]))
    for name, times in taken.items():
        print(f"{name:18} {np.median(times):6.1f} ms per update of {BATCH}, {plain / np.median(times):4.2f} times as fast")


if __name__ == "__main__":
    main()
