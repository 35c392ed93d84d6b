"""A small image world and small challengers for the tests of C."""

from typing import Any

import numpy as np
import torch
from gymnasium import spaces

from sb3_cpm.challenger import Challenger
from sb3_cpm.type_aliases import SequenceBatch
from sb3_cpm.world_model.behavior import RewardFunction
from sb3_cpm.world_model.rssm import LatentState

SMALL = {
    "batch_size": 4,
    "sequence_length": 8,
    "cnn_depth": 4,
    "vector_units": 32,
    "stoch_size": 6,
    "deter_size": 16,
    "hidden_size": 16,
    "head_units": 16,
    "actor_units": 16,
    "critic_units": 16,
    "horizon": 5,
    "imagination_starts": 16,
    "uncertainty_class": "plan2explore",
    "uncertainty": {"plan2explore": {"heads": 3, "layers": 1, "units": 16}},
}


def image(size: int = 32, channels: int = 3) -> spaces.Box:
    return spaces.Box(0, 255, (size, size, channels), np.uint8)


def vector(size: int = 3) -> spaces.Box:
    return spaces.Box(-np.inf, np.inf, (size,), np.float32)


VECTOR = spaces.Dict({"state": vector()})
IMAGES = spaces.Dict({"base": image(), "hand": image()})
BOTH = spaces.Dict({"base": image(), "hand": image(), "state": vector()})


def box(action_dim: int) -> spaces.Box:
    return spaces.Box(-1.0, 1.0, (action_dim,), np.float32)


def small(space: spaces.Dict = VECTOR, action_dim: int = 2, **kwargs: Any) -> Challenger:
    return Challenger(space, box(action_dim), device="cpu", **{"preset": SMALL, **kwargs})


def random_batch(space: spaces.Dict, action_dim: int, length: int = 8, n: int = 4, seed: int = 0) -> SequenceBatch:
    """Noise with an episode boundary in the middle of every other column."""
    rng = np.random.default_rng(seed)
    observations = {
        key: rng.integers(0, 256, (length, n, *sub.shape), dtype=np.uint8)
        if sub.dtype == np.uint8
        else rng.normal(size=(length, n, *sub.shape)).astype(np.float32)
        for key, sub in space.items()
    }
    is_first = np.zeros((length, n), bool)
    is_first[0] = is_first[length // 2, ::2] = True
    actions = rng.uniform(-1, 1, (length, n, action_dim)).astype(np.float32) * ~is_first[..., None]
    rewards = rng.normal(size=(length, n)).astype(np.float32) * ~is_first
    is_terminal = np.zeros((length, n), bool)
    is_terminal[length // 2 - 1, 0] = True
    return SequenceBatch(observations, actions, rewards, is_first, is_terminal, np.ones((length, n), bool))


def weights(challenger: Challenger) -> dict[str, np.ndarray]:
    return {
        f"{name}.{key}": value.detach().cpu().numpy().copy()
        for name, network in challenger.networks.items()
        for key, value in network.state_dict().items()
    }


def update(challenger: Challenger, start: LatentState, reward: RewardFunction) -> dict[str, torch.Tensor]:
    """Of the exploration behaviour alone."""
    exploration, optimizers = challenger.exploration, challenger.optimizers
    return exploration.step(exploration.losses(challenger.world_model, start, reward, optimizers), optimizers)


class MovingSquare:
    """A bright square that the action moves over a 16x16 image with two shades of ground, and its position as the reward."""

    size = 16
    space = spaces.Dict({"camera": image(16, 1)})

    def episode(
        self, rng: np.random.Generator, n_steps: int, right_half: bool = True
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """
        :param right_half: whether the square may enter the right half of the image
        :return: images ``(T + 1, 16, 16, 1)``, actions ``(T, 2)``, rewards ``(T,)``
        """
        limit = 12 if right_half else 5
        position = np.array([rng.uniform(0, 12), rng.uniform(0, limit)])
        images, actions, rewards = [self.render(position)], [], []
        for _ in range(n_steps):
            action = rng.uniform(-1, 1, 2)
            position = np.clip(position + 3 * action, 0, [12, limit])
            images.append(self.render(position))
            actions.append(action)
            rewards.append(position[0] / 12)
        return np.stack(images), np.float32(actions), np.float32(rewards)

    def render(self, position: np.ndarray) -> np.ndarray:
        picture = np.full((self.size, self.size, 1), 60, np.uint8)
        row, column = np.round(position).astype(int)
        picture[row : row + 4, column : column + 4] = 255
        return picture

    def batch(self, rng: np.random.Generator, n: int, n_steps: int, right_half: bool = True) -> SequenceBatch:
        """Whole episodes, one per column."""
        columns = [self.episode(rng, n_steps, right_half) for _ in range(n)]
        images = np.stack([column[0] for column in columns], axis=1)
        nothing = np.zeros((1, n), np.float32)
        actions = np.concatenate([nothing[..., None].repeat(2, -1), np.stack([column[1] for column in columns], axis=1)])
        rewards = np.concatenate([nothing, np.stack([column[2] for column in columns], axis=1)])
        is_first = np.zeros((n_steps + 1, n), bool)
        is_first[0] = True
        return SequenceBatch({"camera": images}, actions, rewards, is_first, np.zeros_like(is_first), np.ones_like(is_first))
