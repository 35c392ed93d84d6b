"""
What one update of stock SAC costs with ten critics of RLPD, beside two of them, beside the ten computed one after another, and
beside two of LayerNormPolicy, on a state of 42 numbers and actions of seven (PickCube-v1's).

::

    OMP_NUM_THREADS=1 python benchmarks/rlpd.py

All take turns in one process with one thread; what is printed is the smallest of the turns' means, in CPU milliseconds.
"""

import argparse
import time
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3 import SAC

from sb3_cpm import LayerNormPolicy, RLPDPolicy

SIZES = [(256, [256, 256]), (128, [256, 256]), (256, [128, 128]), (128, [128, 128])]
STATE, ACTION = 42, 7
KINDS: dict[str, tuple[Any, dict[str, Any]]] = {
    "2 critics": (RLPDPolicy, {"n_critics": 2}),
    "10 critics": (RLPDPolicy, {"n_critics": 10}),
    "10 in a loop": (LayerNormPolicy, {"n_critics": 10, "actor_layer_norm": False}),
    "LayerNormPolicy": (LayerNormPolicy, {}),
}


class Noise(gym.Env):
    """Its states say nothing."""

    observation_space = spaces.Box(-1, 1, (STATE,), np.float32)
    action_space = spaces.Box(-1, 1, (ACTION,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        return self.observation_space.sample(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        return self.observation_space.sample(), 0.0, False, False, {}


def make(kind: str, batch_size: int, net_arch: list[int]) -> SAC:
    """:return: a model whose buffer is filled"""
    policy, kwargs = KINDS[kind]
    kwargs = {"net_arch": net_arch, **kwargs}
    model = SAC(policy, Noise(), batch_size=batch_size, learning_starts=500, policy_kwargs=kwargs, device="cpu")
    return model.learn(505)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--turns", type=int, default=5)
    parser.add_argument("--updates", type=int, default=10)
    arguments = parser.parse_args()
    th.set_num_threads(1)
    print(f"{'batch, hidden layers':<24}", *(f"{kind:>16}" for kind in KINDS), f"{'10 : 2':>8}")
    for batch_size, net_arch in SIZES:
        models = {kind: make(kind, batch_size, net_arch) for kind in KINDS}
        best = dict.fromkeys(models, np.inf)
        for _ in range(arguments.turns):
            for kind, model in models.items():
                start = time.process_time()
                model.train(arguments.updates, batch_size)
                best[kind] = min(best[kind], 1000 * (time.process_time() - start) / arguments.updates)
        ratio = best["10 critics"] / best["2 critics"]
        print(f"{batch_size}, {net_arch!s:<19}", *(f"{best[kind]:13.1f} ms" for kind in KINDS), f"{ratio:8.2f}", flush=True)


if __name__ == "__main__":
    main()
