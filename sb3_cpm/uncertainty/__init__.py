"""Who says "this is new": novelty of transitions behind one seam (:class:`~sb3_cpm.uncertainty.base.Uncertainty`)."""

from sb3_cpm.uncertainty.base import Transitions, Uncertainty
from sb3_cpm.uncertainty.plan2explore import Plan2Explore

UNCERTAINTY_CLASSES: dict[str, type[Uncertainty]] = {"plan2explore": Plan2Explore}

__all__ = ["UNCERTAINTY_CLASSES", "Plan2Explore", "Transitions", "Uncertainty"]
