"""The generators that one run draws from, so that a resumed run draws what an unbroken one would have drawn."""

import random
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces

RandomState = dict[str, Any]


def random_state(action_space: spaces.Space) -> RandomState:
    """
    :param action_space: the model's, which the random warm-up samples from
    :return: states of Python's, NumPy's, torch's and the space's generators, plain data and arrays
    """
    return {
        "python": random.getstate(),
        "numpy": np.random.get_state(),
        "torch": th.get_rng_state().numpy(),
        "cuda": [state.cpu().numpy() for state in th.cuda.get_rng_state_all()] if th.cuda.is_available() else [],
        "action_space": action_space.np_random.bit_generator.state,
    }


def restore_random_state(state: RandomState, action_space: spaces.Space) -> None:
    """
    :param state: of :func:`random_state`
    :param action_space: the model's
    """
    random.setstate(state["python"])
    np.random.set_state(state["numpy"])
    th.set_rng_state(th.from_numpy(state["torch"].copy()))
    if th.cuda.is_available() and len(state["cuda"]) == th.cuda.device_count():
        th.cuda.set_rng_state_all([th.from_numpy(one.copy()) for one in state["cuda"]])
    action_space.np_random.bit_generator.state = state["action_space"]


@contextmanager
def own_randomness(*words: int) -> Iterator[None]:
    """
    Within it NumPy's and torch's generators are seeded from these numbers; after it they go on where they were.

    :param words: numbers from 0 on; others give other random numbers
    """
    numpy_seed, torch_seed = (int(word) for word in np.random.SeedSequence(words).generate_state(2))
    state = np.random.get_state()
    with th.random.fork_rng(range(th.cuda.device_count())):
        np.random.seed(numpy_seed)
        th.manual_seed(torch_seed)
        try:
            yield
        finally:
            np.random.set_state(state)
