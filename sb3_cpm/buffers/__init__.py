"""
The replay buffer: trajectories (D), challenges (I), demonstrations.

==================  ==================================================
``cpm_buffer``      :class:`CPMBuffer`: D and I and the mix of both
``episode_buffer``  D by itself: episodes, sampling, hindsight, saving
``books``           which slots hold which episodes
``storage``         its ring of observations
``compact``         how a key is stored, ``allocation``: where
``sequences``       sequences for the world model
``imaginary``       I
``demonstrations``  reading recorded trajectories
``checks``          error messages
==================  ==================================================
"""

from sb3_cpm.buffers.cpm_buffer import EXECUTED_ACTION, CPMBuffer
from sb3_cpm.buffers.demonstrations import Demonstration
from sb3_cpm.buffers.episode_buffer import EpisodeBuffer
from sb3_cpm.buffers.imaginary import Challenge, ChallengeCounters
from sb3_cpm.buffers.storage import Episode

__all__ = [
    "EXECUTED_ACTION",
    "CPMBuffer",
    "Challenge",
    "ChallengeCounters",
    "Demonstration",
    "Episode",
    "EpisodeBuffer",
]
