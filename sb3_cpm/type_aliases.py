"""What travels between the buffer, the challenger and the callback: plain NumPy bundles, no torch, no SB3."""

from typing import NamedTuple

import numpy as np


class Evaluation(NamedTuple):
    """
    The challenger's opinion of one complete episode of ``n_steps`` transitions.

    Everything about transition ``t`` is about *arriving* in state ``t + 1``: what was predicted from
    (latent of state t, action t) against what state ``t + 1`` turned out to be (report, section 4.4.1 and B.2).

    :param disagreement: DISAG of every transition, shape ``(n_steps,)``, at least 0 for the ``exp`` metric
    :param kl: KL(posterior of state t+1 || prior of state t+1) in nats, shape ``(n_steps,)``
    :param embeddings: encoder output of every state, shape ``(n_steps + 1, embed_dim)``
    """

    disagreement: np.ndarray
    kl: np.ndarray
    embeddings: np.ndarray


class SequenceBatch(NamedTuple):
    """
    Time-major sequences for the world model, ``length`` rows of ``batch`` columns.

    A row is a *state*, with what led to it. An episode of T transitions has T + 1 rows. Worked example, an episode of
    two transitions (s0, a0, r0, s1), (s1, a1, r1, s2) that ends in a true termination, followed by another episode:

    ======== ===== ===== ===== ======
    row      0     1     2     3
    ======== ===== ===== ===== ======
    state    s0    s1    s2    s0'
    action   0     a0    a1    0
    reward   0     r0    r1    0
    first    1     0     0     1
    terminal 0     0     1     0
    ======== ===== ===== ===== ======

    s2 is the true last observation, not the one after the automatic reset. A truncated episode (time limit) has no
    terminal row. Sequences may cross episode boundaries: the model resets its state wherever ``is_first`` is set.

    :param observations: one array per key, each of shape ``(length, batch, *observation_shape)``, dtype as stored
    :param actions: the action that led to the row's state, shape ``(length, batch, action_dim)``, within [-1, 1]
    :param rewards: the reward for arriving in the row's state, shape ``(length, batch)``
    :param is_first: the row is the first state of an episode, shape ``(length, batch)``, bool
    :param is_terminal: the environment terminated in the row's state, shape ``(length, batch)``, bool
    :param mask: False for padding after the last stored row, shape ``(length, batch)``, bool
    """

    observations: dict[str, np.ndarray]
    actions: np.ndarray
    rewards: np.ndarray
    is_first: np.ndarray
    is_terminal: np.ndarray
    mask: np.ndarray
