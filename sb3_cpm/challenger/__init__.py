"""
The challenger C: DreamerV2 world model, Plan2Explore ensemble, exploration actor (report, sections 4.1, 4.4.1, B.1 and B.2).

==============  ================================================================
``challenger``  :class:`Challenger`: its networks; it acts and judges
``learning``    one update of all of them; ``log_names``: what its numbers are called
``file``        what a saved one looks like, and what is checked before it is read
==============  ================================================================
"""

from sb3_cpm.challenger.challenger import Challenger, choose_device
from sb3_cpm.challenger.learning import rate_entry

__all__ = ["Challenger", "choose_device", "rate_entry"]
