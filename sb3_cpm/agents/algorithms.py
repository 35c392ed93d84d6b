"""
Names that configurations may use. rl_zoo3 reads them, so that is where the names are put: algorithms beside its own
(:data:`ALGORITHMS`), and what may stand in ``replay_buffer_class``, ``replay_buffer_kwargs`` and ``policy_kwargs``, which it
evaluates in the namespace of its experiment manager (:data:`NAMES`).
"""

from typing import Any

from stable_baselines3 import SAC
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_cpm.arguments import nearest
from sb3_cpm.buffers import CPMBuffer
from sb3_cpm.dreamer import Dreamer, Plan2Explore
from sb3_cpm.extractors import PointNetExtractor, PointNetPolicy
from sb3_cpm.extras import needed
from sb3_cpm.imitation import DAPG
from sb3_cpm.policies import LayerNormPolicy, RLPDPolicy, SimbaPolicy

NAMES: dict[str, Any] = {
    "CPMBuffer": CPMBuffer,
    # `enjoy` passes an environment to `load`, without which SB3 makes no such buffer, only if it reads "HerReplayBuffer"
    "CPMHerReplayBuffer": CPMBuffer,
    "LayerNormPolicy": LayerNormPolicy,
    "PointNetExtractor": PointNetExtractor,
    "PointNetPolicy": PointNetPolicy,
    "RLPDPolicy": RLPDPolicy,
    "SimbaPolicy": SimbaPolicy,
}

#: RLPD is SAC with a policy and settings of its own, which its files have.
ALGORITHMS: dict[str, Any] = {"dreamer": Dreamer, "plan2explore": Plan2Explore, "dapg": DAPG, "rlpd": SAC}


def add_names() -> None:
    """
    Put the names into rl_zoo3. Can be repeated.

    :raises MissingExtra: if rl_zoo3 is not installed
    """
    with needed("Configurations", "zoo"):
        import rl_zoo3.exp_manager
        from rl_zoo3.utils import ALGOS

    vars(rl_zoo3.exp_manager).update(NAMES)
    ALGOS.update(ALGORITHMS)


def algorithms() -> dict[str, type[BaseAlgorithm]]:
    """:return: rl_zoo3's algorithms by name, ours included"""
    add_names()
    from rl_zoo3.utils import ALGOS

    return ALGOS


def algorithm_of(name: str) -> str:
    """
    The algorithm that a file is for: the one that is a part of its name.

    >>> algorithm_of("cpm_sac_report")
    'sac'

    :raises ValueError: if no part is one
    """
    known = algorithms()
    padded = f"_{name}_"
    matches = [algo for algo in known if f"_{algo}_" in padded]
    if not matches:
        raise ValueError(f"The name {name!r} contains no algorithm (one of {', '.join(known)}): rename the file, my_sac.yml.")
    return max(matches, key=len)  # ppo_lstm, not ppo


def evaluated(value: Any, where: str) -> Any:
    """
    :param value: of a key in whose place rl_zoo3 allows Python, in a string
    :param where: it stands, for the message
    :return: what rl_zoo3 makes of it
    :raises ValueError: if Python cannot evaluate it
    """
    if not isinstance(value, str):
        return value
    add_names()
    from rl_zoo3 import exp_manager

    try:
        return eval(value, vars(exp_manager))
    except Exception as error:  # it may be any Python
        guess = nearest(error.name or "", vars(exp_manager)) if isinstance(error, NameError) else ""
        raise ValueError(f"{where}: Python cannot evaluate {value!r} ({error}).{guess}") from error
