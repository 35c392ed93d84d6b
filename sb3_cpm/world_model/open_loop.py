"""
What the world model believes it will see (Hafner et al. 2021, fig. 4): some frames of context, and from there on its own.

Rows are states, as in :class:`sb3_cpm.type_aliases.SequenceBatch`. In the context the model has seen each row before it draws
it (that is its reconstruction); after it only the actions are known to it.
"""

from typing import NamedTuple

import numpy as np
import torch as th

from sb3_cpm.world_model.observations import Inputs
from sb3_cpm.world_model.rssm import LatentState
from sb3_cpm.world_model.world_model import WorldModel


class OpenLoop(NamedTuple):
    """
    One episode of ``rows`` states as the world model draws it.

    :param observations: per key, in the space's own units and as floats, shape ``(rows, *observation_shape)``
    :param rewards: predicted for arriving in the states 1.., shape ``(rows - 1,)``
    :param context: the rows before this one were seen, this one and all after it are imagined
    """

    observations: dict[str, np.ndarray]
    rewards: np.ndarray
    context: int


@th.no_grad()
def open_loop(model: WorldModel, inputs: Inputs, actions: th.Tensor, context: int) -> OpenLoop:
    """
    :param model: the world model; modes only, so no random numbers
    :param inputs: preprocessed observations of the context, or of more rows, of one episode from its first state on
    :param actions: action ``t`` was taken in state ``t``, shape ``(rows - 1, action_dim)``
    :param context: rows to look at
    """
    embed = model.encoder(Inputs(*(None if part is None else part[:context] for part in inputs))).unsqueeze(1)
    led_here = th.cat((th.zeros_like(actions[:1]), actions[: context - 1])).unsqueeze(1)
    first = th.zeros(context, 1, dtype=th.bool, device=actions.device)
    first[0] = True
    seen = model.rssm.observe(embed, led_here, first, deterministic=True)
    state = LatentState(*(part[-1] for part in seen))
    feats = [seen.feat]
    for action in actions[context - 1 :]:
        state = model.rssm.imagine_step(state, action.unsqueeze(0), deterministic=True)
        feats.append(state.feat.unsqueeze(0))
    feat = th.cat(feats).squeeze(1)
    drawn = model.spec.split(model.decoder(feat), (len(feat),))
    rewards = model.reward(feat[1:])
    return OpenLoop({key: value.cpu().numpy() for key, value in drawn.items()}, rewards.cpu().numpy(), context)
