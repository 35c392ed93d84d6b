"""
Challenge choice in NumPy: one module per step of the method (report, section 4.4).

===================  =======================================================
``targeting``        dynamic hyperparameter targeting (Algorithm 2)
``origin``           where rewards are measured from, for rewards that are negative
``quality``          challenge quality score S
``filters``          filter F with self-balancing strictness, reward memory
``rewards``          artificial reward R
``curator``          the others applied to a trajectory in turn
===================  =======================================================
"""

from sb3_cpm.challenges.curator import ChallengeCurator, Proposal
from sb3_cpm.challenges.filters import CRITERIA, ChallengeFilter
from sb3_cpm.challenges.origin import OriginKind, RewardOrigin
from sb3_cpm.challenges.quality import ChallengeQuality
from sb3_cpm.challenges.rewards import REWARD_TERMS, ArtificialReward, ArtificialRewards
from sb3_cpm.challenges.targeting import DynamicCoefficient

__all__ = [
    "CRITERIA",
    "REWARD_TERMS",
    "ArtificialReward",
    "ArtificialRewards",
    "ChallengeCurator",
    "ChallengeFilter",
    "ChallengeQuality",
    "DynamicCoefficient",
    "OriginKind",
    "Proposal",
    "RewardOrigin",
]
