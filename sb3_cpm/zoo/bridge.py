"""
What ``import sb3_cpm.zoo`` changes in rl_zoo3, all of it here and in the two modules that are called from here.

* Names that YAML files may use, and our algorithms beside rl_zoo3's: :mod:`sb3_cpm.agents.algorithms`. ``--algo`` fixes its
  choices before it imports ``--gym-packages``, so only ``python -m sb3_cpm.zoo train`` can offer them.
* Search spaces for ``--optimize``, see :mod:`sb3_cpm.zoo.search`.
* Four methods of rl_zoo3's ``ExperimentManager``, see :mod:`sb3_cpm.zoo.manager`. They are replaced on the class, since
  ``rl_zoo3.train`` holds the class before it imports ``--gym-packages``.
"""

from sb3_cpm.agents.algorithms import add_names
from sb3_cpm.zoo.manager import install as wrap_manager
from sb3_cpm.zoo.search import install as add_search_spaces


def install() -> None:
    """
    Make all of the above so. Can be repeated.

    :raises MissingExtra: if rl_zoo3 is not installed
    """
    add_names()
    add_search_spaces()
    wrap_manager()
