"""
Learning from demonstrations: recorded episodes of somebody who can do the task, for agents of Stable-Baselines3.

================  ==============================================================================
``recording``     episodes of the scripted expert that an environment has, as training sees them
``loading``       demonstrations from wherever they are: an expert, files, a list
``callback``      :class:`DemonstrationsCallback` fills the replay buffer when training starts
================  ==============================================================================
"""

from sb3_cpm.imitation.callback import DemonstrationsCallback, demonstrations_for
from sb3_cpm.imitation.loading import load_demonstrations
from sb3_cpm.imitation.recording import record_demonstrations

__all__ = ["DemonstrationsCallback", "demonstrations_for", "load_demonstrations", "record_demonstrations"]
