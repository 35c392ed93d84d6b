"""
Reading sequences of states for the world model out of the ring (see :class:`~sb3_cpm.type_aliases.SequenceBatch`).
"""

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from sb3_cpm.buffers.storage import ObservationRing
from sb3_cpm.type_aliases import SequenceBatch


class Stored(Protocol):
    """What is read here of a replay buffer: the ring and SB3's arrays beside it, each of shape ``(buffer_size, n_envs)``."""

    ring: ObservationRing
    actions: np.ndarray
    rewards: np.ndarray
    dones: np.ndarray
    timeouts: np.ndarray
    ep_start: np.ndarray


def draw_starts(n_valid: np.ndarray, batch_size: int, length: int) -> tuple[np.ndarray, np.ndarray]:
    """
    Uniform over the transitions that at least ``length - 1`` transitions of complete episodes follow in the same environment.
    An environment with fewer gives what it has.

    :param n_valid: transitions of complete episodes per environment, shape ``(n_envs,)``
    :return: environments, and transition numbers counted from the oldest, each of shape ``(batch_size,)``
    """
    n_starts = np.where(n_valid > 0, np.maximum(n_valid - length + 1, 1), 0)
    ends = np.cumsum(n_starts)
    picks = np.random.randint(ends[-1], size=batch_size)
    envs = np.searchsorted(ends, picks, side="right")
    return envs, picks - (ends - n_starts)[envs]


def read_sequences(
    stored: Stored,
    oldest: np.ndarray,
    n_valid: np.ndarray,
    envs: np.ndarray,
    offsets: np.ndarray,
    length: int,
    keys: Sequence[str],
) -> SequenceBatch:
    """
    Walk ``length`` rows along each environment, from the state that transition number ``offset`` starts in.

    Row and transition numbers differ, as an episode of T transitions has T + 1 states: after the transition that ends
    an episode, its next observation is a row of its own, and only then comes the following transition's state.

    :param stored: the buffer
    :param oldest: slot of each column's oldest transition, shape ``(batch_size,)``
    :param n_valid: number of transitions that each column may walk over, shape ``(batch_size,)``
    :param envs: environment of each column, shape ``(batch_size,)``
    :param offsets: transition number that each column starts with, shape ``(batch_size,)``
    :param length: rows
    :param keys: observation keys
    """
    ring = stored.ring
    slots = np.empty((length, len(envs)), dtype=np.int64)  # of the transition that starts in, or led to, the state
    final = np.zeros((length, len(envs)), dtype=bool)  # the row is the last state of its episode
    mask = np.ones((length, len(envs)), dtype=bool)
    at_final = np.zeros(len(envs), dtype=bool)
    for row in range(length):
        mask[row] = offsets < n_valid
        slots[row] = (oldest + np.minimum(offsets, n_valid - 1)) % ring.size
        final[row] = at_final
        ends_episode = ring.final_slot[slots[row], envs] >= 0
        # next row: the final state of this episode, or the state of the following transition
        offsets = np.where(ends_episode & ~at_final, offsets, offsets + 1)
        at_final = ends_episode & ~at_final
    final &= mask

    is_first = (stored.ep_start[slots, envs] == slots) & ~final
    led_here = np.where(final, slots, (slots - 1) % ring.size)
    inside = mask & ~is_first
    return SequenceBatch(
        observations=_states(ring, keys, slots, np.broadcast_to(envs, slots.shape), final),
        actions=stored.actions[led_here, envs].astype(np.float32) * inside[..., None],
        rewards=stored.rewards[led_here, envs] * inside,
        is_first=is_first & mask,
        is_terminal=final & (stored.dones[slots, envs] > 0) & (stored.timeouts[slots, envs] == 0),
        mask=mask,
    )


def _states(
    ring: ObservationRing, keys: Sequence[str], slots: np.ndarray, envs: np.ndarray, final: np.ndarray
) -> dict[str, np.ndarray]:
    at = ring.locate(slots.reshape(-1), envs.reshape(-1))
    at_final = ring.locate(slots[final], envs[final])
    observations = {}
    for key in keys:
        states = ring.read(key, at).reshape(*slots.shape, *ring.codecs[key].shape)
        if final.any():
            states[final] = ring.read_next(key, at_final)
        observations[key] = states
    return observations


def side_by_side(batches: Sequence[SequenceBatch]) -> SequenceBatch:
    """:return: the columns of several batches of equal length in one"""
    if len(batches) == 1:
        return batches[0]
    return SequenceBatch(
        observations={key: np.concatenate([b.observations[key] for b in batches], axis=1) for key in batches[0].observations},
        actions=np.concatenate([b.actions for b in batches], axis=1),
        rewards=np.concatenate([b.rewards for b in batches], axis=1),
        is_first=np.concatenate([b.is_first for b in batches], axis=1),
        is_terminal=np.concatenate([b.is_terminal for b in batches], axis=1),
        mask=np.concatenate([b.mask for b in batches], axis=1),
    )
