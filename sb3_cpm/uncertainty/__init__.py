"""
Who says "this is new": novelty of transitions behind one seam (:class:`~sb3_cpm.uncertainty.base.Uncertainty`).

===================== ============================================= ======================== ===========================
name                  new is                                        on noise that stays      in imagination
===================== ============================================= ======================== ===========================
plan2explore          where predictors of the next latent disagree  calm                     the same as on real data
observation_ensemble  the same for embeddings, without memory       calm                     from the dreamt embedding
rnd                   a state unlike those seen so far              as new as its states     of the imagined next latent
prediction_error      what was predicted badly                      high for ever            against the dreamt outcome
===================== ============================================= ======================== ===========================
"""

from sb3_cpm.uncertainty.base import Transitions, Uncertainty
from sb3_cpm.uncertainty.choice import UNCERTAINTY_CLASSES, check_uncertainties, choose_uncertainty
from sb3_cpm.uncertainty.latent_disagreement import LatentDisagreement
from sb3_cpm.uncertainty.observation_ensemble import ObservationEnsemble
from sb3_cpm.uncertainty.prediction_error import PredictionError
from sb3_cpm.uncertainty.rnd import RandomNetworkDistillation

__all__ = [
    "UNCERTAINTY_CLASSES",
    "LatentDisagreement",
    "ObservationEnsemble",
    "PredictionError",
    "RandomNetworkDistillation",
    "Transitions",
    "Uncertainty",
    "check_uncertainties",
    "choose_uncertainty",
]
