"""
Learning from demonstrations: recorded episodes of somebody who can do the task, for agents of Stable-Baselines3.

==================  ============================================================================
``recording``       episodes of the scripted expert that an environment has, as training sees them
``loading``         demonstrations from wherever they are: an expert, files, a list
``datasets``        those of Minari and LeRobot
``callback``        :class:`DemonstrationsCallback` fills the replay buffer when training starts
``cloning``         :func:`clone`: an actor learns demonstrated actions; as a callback, before PPO
``dapg``            :class:`DAPG`: PPO beside demonstrations
``gail``            :class:`GAILCallback`: rewards from a discriminator, beside off-policy agents
``regularization``  :class:`BCLossCallback`: an off-policy actor keeps to its demonstrations
==================  ============================================================================
"""

from sb3_cpm.imitation.callback import DemonstrationsCallback, demonstrations_for
from sb3_cpm.imitation.cloning import CloneCallback, CloneResult, clone
from sb3_cpm.imitation.dapg import DAPG
from sb3_cpm.imitation.discriminator import Discriminator, ProgressiveDiscriminator, VectorDiscriminator
from sb3_cpm.imitation.gail import GAILCallback
from sb3_cpm.imitation.instance_buffer import InstanceBuffer
from sb3_cpm.imitation.loading import load_demonstrations
from sb3_cpm.imitation.recording import record_demonstrations
from sb3_cpm.imitation.regularization import BCLossCallback

__all__ = [
    "DAPG",
    "BCLossCallback",
    "CloneCallback",
    "CloneResult",
    "DemonstrationsCallback",
    "Discriminator",
    "GAILCallback",
    "InstanceBuffer",
    "ProgressiveDiscriminator",
    "VectorDiscriminator",
    "clone",
    "demonstrations_for",
    "load_demonstrations",
    "record_demonstrations",
]
