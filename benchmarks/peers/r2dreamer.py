"""
r2dreamer (github.com/NM512/r2dreamer, a Dreamer in PyTorch) as a peer: its own ``Dreamer.update()`` on a batch of ours.

It is not on PyPI: the path of a checkout is given, and nothing of its algorithm is written again here. The agent is made from
its own configuration with ``model.rep_loss=dreamer`` (reconstruction) and ``model.compile=False``; the batch reaches it in the
form of its replay buffer, whose place :class:`OneBatch` takes, so that neither side samples or writes latents back. World
model, actor and critic share one loss, one backward pass and one step of its optimizer, so only whole updates can be clocked.

What the configuration can say equals the preset's: images, batch x length, numbers and sizes of layers, latent and
deterministic state, channels and kernels of convolutions, imagined steps. Its images are one key, whose channels are those of
all cameras. The rest is DreamerV3's and differs from ours, which is DreamerV2's:

* a block GRU (8 blocks) behind one layer for each of its inputs, in place of a GRU; 1% of uniform in its categorical latents;
* convolutions of stride 1, with max pooling after each in the encoder and nearest-neighbour upsampling before each in the
  decoder, in place of stride 2: as many weights, several times the operations; RMSNorm and SiLU in place of ELU alone;
* two-hot heads of 255 bins for reward and value, in place of normal distributions;
* an actor that learns by REINFORCE, so that imagination has no gradient (ours: through the dynamics), with normalised returns;
  16 steps of the prior for 15 of the return; a value loss also on the batch itself; means and deviations for its logs;
* LaProp with adaptive clipping of each tensor, in place of Adam and clipping of the whole norm.

So the ratio says what an update costs that learns from the same data, not whose code is better. One thing is exchanged: its
autocast to float16, which its code always turns on and a CPU may have to emulate, is off.
"""

import importlib
import io
import subprocess
import sys
from collections.abc import Mapping
from contextlib import nullcontext, redirect_stdout
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from clock import Lap, timed
from gymnasium import spaces
from hydra import compose, initialize_config_dir
from tensordict import TensorDict

from sb3_cpm.type_aliases import SequenceBatch


class OneBatch:
    """
    Stands where its replay buffer does, with one batch in it.

    :param data: what its buffer would sample, batch size ``(sequences, rows)``
    :param initial: stochastic and deterministic state before the first row
    """

    def __init__(self, data: TensorDict, initial: tuple[torch.Tensor, torch.Tensor]) -> None:
        self.data = data
        self.initial = initial

    def sample(self) -> tuple[TensorDict, list[torch.Tensor], tuple[torch.Tensor, torch.Tensor]]:
        """:return: batch, indices of its rows (none: there is nothing to write to), and the initial latents"""
        return self.data, [], self.initial

    def update(self, index: list[torch.Tensor], stoch: torch.Tensor, deter: torch.Tensor) -> None:
        """Where its buffer keeps the new latents."""


class R2Dreamer:
    """
    :param checkout: folder of the repository
    :param preset: sizes, as in :mod:`sb3_cpm.presets`, with categorical latents
    :param observation_space: uint8 images ``(H, W, C)`` of one size and vectors, as our side gets them
    :param action_dim: number of action dimensions
    """

    def __init__(
        self,
        checkout: Path,
        preset: Mapping[str, Any],
        observation_space: spaces.Dict,
        action_dim: int,
    ) -> None:
        checkout = checkout.resolve()
        if str(checkout) not in sys.path:
            sys.path.insert(0, str(checkout))
        self.module: Any = importlib.import_module("dreamer")
        shapes = {key: space.shape for key, space in observation_space.items() if space.shape}
        self.images = [key for key, shape in shapes.items() if len(shape) == 3]
        self.vectors = [key for key in shapes if key not in self.images]
        height, width, _ = shapes[self.images[0]]
        image = spaces.Box(0, 255, (height, width, sum(shapes[key][2] for key in self.images)), np.uint8)
        space = spaces.Dict({"image": image, **{key: observation_space[key] for key in self.vectors}})
        with initialize_config_dir(str(checkout / "configs"), version_base=None):
            config = compose("configs", [f"{key}={value}" for key, value in self._sizes(preset).items()])
        torch.manual_seed(0)
        with redirect_stdout(io.StringIO()):  # it prints every layer
            self.agent = self.module.Dreamer(config.model, space, spaces.Box(-1.0, 1.0, (action_dim,), np.float32))

    def _sizes(self, preset: Mapping[str, Any]) -> dict[str, Any]:
        """Overrides of its configuration, in the order and syntax of its command line."""
        multiples = [2**layer for layer in range(preset["cnn_layers"])]
        sizes: dict[str, Any] = {
            "device": "cpu",
            "model.compile": False,
            "model.rep_loss": "dreamer",
            "model.imag_horizon": preset["horizon"],
            "model.deter": preset["deter_size"],
            "model.hidden": preset["hidden_size"],
            "model.discrete": preset["stoch_classes"],
            "model.depth": preset["cnn_depth"],
            "model.units": preset["vector_units"],
            "model.rssm.stoch": preset["stoch_size"],
            "model.rssm.img_layers": 1,
            "model.rssm.obs_layers": 1,
        }
        for side in ("encoder", "decoder"):
            sizes |= {
                f"model.{side}.cnn_keys": "image",
                f"model.{side}.mlp_keys": f"'{'|'.join(self.vectors) or '$^'}'",
                f"model.{side}.mlp.layers": preset["vector_layers"],
                f"model.{side}.cnn.mults": str(multiples).replace(" ", ""),
                f"model.{side}.cnn.kernel_size": 4,
            }
        for head, ours in (("reward", "head"), ("cont", "head"), ("actor", "actor"), ("critic", "critic")):
            sizes |= {
                f"model.{head}.layers": preset[f"{ours}_layers"],
                f"model.{head}.units": preset[f"{ours}_units"],
            }
        return sizes

    @property
    def parameters(self) -> dict[str, int]:
        """Numbers of parameters that learn, by our names."""
        agent = self.agent
        parts = {
            "world model": [agent.encoder, agent.rssm, agent.decoder, agent.reward, agent.cont],
            "actor": [agent.actor],
            "critic": [agent.value],
        }
        return {
            name: sum(parameter.numel() for module in modules for parameter in module.parameters())
            for name, modules in parts.items()
        }

    def _stored(self, batch: SequenceBatch) -> OneBatch:
        """A batch of ours, time-major, as its buffer would give it."""
        arrays = {key: batch.observations[key] for key in self.vectors}
        arrays["image"] = np.concatenate([batch.observations[key] for key in self.images], axis=-1)
        columns = {"reward": batch.rewards, "is_first": batch.is_first, "is_terminal": batch.is_terminal}
        # an episode's last row is the one before another's first
        columns["is_last"] = np.concatenate([batch.is_first[1:], np.zeros_like(batch.is_first[:1])])
        arrays |= {"action": batch.actions, **{key: value[..., None] for key, value in columns.items()}}
        length, sequences = batch.rewards.shape
        tensors = {key: torch.as_tensor(value).transpose(0, 1).contiguous() for key, value in arrays.items()}
        state = self.agent.get_initial_state(sequences)
        return OneBatch(TensorDict(tensors, batch_size=(sequences, length)), (state["stoch"], state["deter"]))

    def train(self, batch: SequenceBatch) -> list[Lap]:
        """
        One update of world model, actor and critic.

        :param batch: as our side gets it
        :return: one lap, what all of it cost
        """
        with patch.object(self.module, "autocast", lambda **kwargs: nullcontext()):
            return [timed(lambda: self.agent.update(self._stored(batch)))]


def commit(checkout: Path) -> str:
    """:return: hash of what is checked out"""
    git = subprocess.run(["git", "-C", str(checkout), "rev-parse", "HEAD"], check=True, capture_output=True, text=True)
    return git.stdout.strip()
