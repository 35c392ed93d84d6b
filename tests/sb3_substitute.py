"""
A pytest plugin for SB3's own tests: puts CPMBuffer in the place of HerReplayBuffer and DictReplayBuffer.

Loaded with ``-p sb3_substitute`` by ``test_sb3_own_tests.py``, before SB3's test files import the names.
"""

from typing import Any

import stable_baselines3
import stable_baselines3.common.buffers as buffers

from sb3_cpm.buffers import CPMBuffer


class InPlaceOfHer(CPMBuffer):
    """With HerReplayBuffer's default of four hindsight goals, and nobody who proposes challenges."""

    def __init__(self, *args: Any, challenge_ratio: float = 0, n_sampled_goal: int = 4, **kwargs: Any):
        super().__init__(*args, challenge_ratio=challenge_ratio, n_sampled_goal=n_sampled_goal, **kwargs)


class InPlaceOfDict(CPMBuffer):
    """Nobody proposes challenges."""

    def __init__(self, *args: Any, challenge_ratio: float = 0, **kwargs: Any):
        super().__init__(*args, challenge_ratio=challenge_ratio, **kwargs)


stable_baselines3.HerReplayBuffer = InPlaceOfHer  # type: ignore[misc]
buffers.DictReplayBuffer = InPlaceOfDict  # type: ignore[misc]
