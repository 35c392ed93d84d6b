"""
sheeprl 0.8.4 (PyPI) as a peer: its own ``train()`` of DreamerV2 and of Plan2Explore on a batch of ours, with a clock.

Nothing of its algorithm is written again here: agents come from its ``build_agent``, optimizers from its
``build_optimizer``, and one update is one call of its ``train()``, which calls its ``update()`` once for every optimizer. A
clock that looks at each of those calls says what the phases in between cost.

One thing is exchanged: the convolutions of its DreamerV2 (no padding) fit 64x64 images only, so those of its DreamerV3
(kernel 4, stride 2, padding 1, without layer norm) take their place; they are the same as ours, weight by weight.
``own_convolutions`` leaves the original ones in.
"""

import importlib
from collections.abc import Mapping
from contextlib import nullcontext, suppress
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from clock import Clock, Enough, Lap, clocked
from gymnasium import spaces
from hydra import compose, initialize_config_module
from lightning.fabric import Fabric
from omegaconf import OmegaConf
from sheeprl.algos.dreamer_v2 import agent as dreamer_v2_agent
from sheeprl.algos.dreamer_v2.utils import build_optimizer
from sheeprl.algos.dreamer_v3 import agent as dreamer_v3_agent
from sheeprl.utils.utils import dotdict
from torch import nn
from torch.distributions import Distribution

from sb3_cpm.type_aliases import SequenceBatch


class SheeprlDreamer:
    """
    :param preset: sizes, as in :mod:`sb3_cpm.presets`
    :param observation_space: uint8 images ``(H, W, C)`` and vectors, as our side gets them
    :param action_dim: number of action dimensions
    :param ensemble: Plan2Explore (``p2e_dv2_exploration``) instead of DreamerV2
    :param own_convolutions: see the module's docstring
    :param device: where it trains
    :param amp: bfloat16 mixed precision
    :param compiled: its ``algo.compile`` (DreamerV2 only)
    """

    def __init__(
        self,
        preset: Mapping[str, Any],
        observation_space: spaces.Dict,
        action_dim: int,
        ensemble: bool = False,
        own_convolutions: bool = False,
        device: str = "cpu",
        amp: bool = False,
        compiled: bool = False,
    ) -> None:
        self.images = [key for key, space in observation_space.items() if space.shape and len(space.shape) == 3]
        self.cfg = self._configure(preset, [key for key in observation_space if key not in self.images], ensemble, compiled)
        Distribution.set_default_validate_args(self.cfg.distribution.validate_args)  # as its command line does
        self.fabric = Fabric(accelerator=device, devices=1, precision="bf16-mixed" if amp else "32-true")
        self.action_dim = action_dim
        name = "p2e_dv2" if ensemble else "dreamer_v2"
        self.module = importlib.import_module(f"sheeprl.algos.{name}.{self.cfg.algo.name}")
        build_agent = importlib.import_module(f"sheeprl.algos.{name}.agent").build_agent
        first = {
            key: spaces.Box(0, 255, (space.shape[2], *space.shape[:2]), np.uint8) if key in self.images else space
            for key, space in observation_space.items()
            if space.shape
        }
        arguments = (self.fabric, (action_dim,), True, self.cfg, spaces.Dict(first))
        with nullcontext() if own_convolutions else padded_convolutions(preset["cnn_layers"]):
            parts = build_agent(*arguments)
        self.modules = self._p2e(parts) if ensemble else self._dreamer(parts)

    def _configure(self, preset: Mapping[str, Any], vectors: list[str], ensemble: bool, compiled: bool) -> Any:
        """Its own experiment with our sizes."""
        sizes = {
            "cnn_keys.encoder": self.images,
            "cnn_keys.decoder": self.images,
            "mlp_keys.encoder": vectors,
            "mlp_keys.decoder": vectors,
            "per_rank_batch_size": preset["batch_size"],
            "per_rank_sequence_length": preset["sequence_length"],
            "horizon": preset["horizon"],
            "world_model.stochastic_size": preset["stoch_size"],
            "world_model.discrete_size": preset["stoch_classes"],
            "world_model.use_continues": preset["continue_head"],
            "world_model.encoder.cnn_channels_multiplier": preset["cnn_depth"],
            "world_model.encoder.mlp_layers": preset["vector_layers"],
            "world_model.encoder.dense_units": preset["vector_units"],
            "world_model.observation_model.mlp_layers": preset["vector_layers"],
            "world_model.observation_model.dense_units": preset["vector_units"],
            "world_model.recurrent_model.recurrent_state_size": preset["deter_size"],
            "world_model.transition_model.hidden_size": preset["hidden_size"],
            "world_model.representation_model.hidden_size": preset["hidden_size"],
            "world_model.reward_model.mlp_layers": preset["head_layers"],
            "world_model.reward_model.dense_units": preset["head_units"],
            "world_model.discount_model.mlp_layers": preset["head_layers"],
            "world_model.discount_model.dense_units": preset["head_units"],
            "actor.mlp_layers": preset["actor_layers"],
            "actor.dense_units": preset["actor_units"],
            "critic.mlp_layers": preset["critic_layers"],
            "critic.dense_units": preset["critic_units"],
            "compile.enabled": compiled and not ensemble,
        }
        if ensemble:
            heads = preset["uncertainty"]["plan2explore"]
            sizes |= {"ensembles.n": heads["heads"], "ensembles.mlp_layers": heads["layers"]}
            sizes |= {"ensembles.dense_units": heads["units"]}
        with initialize_config_module("sheeprl.configs", version_base="1.3"):
            cfg = compose("config", ["exp=p2e_dv2_exploration" if ensemble else "exp=dreamer_v2", "env=dummy"])
        for key, value in sizes.items():
            OmegaConf.update(cfg.algo, key, value)
        return dotdict(
            {part: OmegaConf.to_container(cfg[part], resolve=True) for part in ("algo", "distribution", "fabric", "env")}
            | {"seed": 0}
        )

    def _optimizers(self, *parts: tuple[str, nn.Module]) -> list[Any]:
        made = [build_optimizer(self._entry(name), module.parameters()) for name, module in parts]
        return list(self.fabric.setup_optimizers(*made))

    def _entry(self, name: str) -> Any:
        return self.cfg.algo[name].optimizer

    def _dreamer(self, parts: Any) -> dict[str, Any]:
        world_model, actor, critic, target_critic, _ = parts
        optimizers = self._optimizers(("world_model", world_model), ("actor", actor), ("critic", critic))
        self.parameters = {"world model": count(world_model), "actor": count(actor), "critic": count(critic)}
        names = ("world_optimizer", "actor_optimizer", "critic_optimizer")
        modules = {"world_model": world_model, "actor": actor, "critic": critic, "target_critic": target_critic}
        return modules | dict(zip(names, optimizers, strict=True))

    def _p2e(self, parts: Any) -> dict[str, Any]:
        world_model, ensembles, actor_task, critic_task, target_task, actor, critic, target, _ = parts
        optimizers = self._optimizers(
            ("world_model", world_model),
            ("ensembles", ensembles),
            ("actor", actor_task),
            ("critic", critic_task),
            ("actor", actor),
            ("critic", critic),
        )
        self.parameters = {"world model": count(world_model), "ensemble": count(ensembles)}
        names = (
            "world_optimizer",
            "ensemble_optimizer",
            "actor_task_optimizer",
            "critic_task_optimizer",
            "actor_exploration_optimizer",
            "critic_exploration_optimizer",
        )
        return {
            "world_model": world_model,
            "ensembles": ensembles,
            "actor_task": actor_task,
            "critic_task": critic_task,
            "target_critic_task": target_task,
            "actor_exploration": actor,
            "critic_exploration": critic,
            "target_critic_exploration": target,
            "is_continuous": True,
            **dict(zip(names, optimizers, strict=True)),
        }

    def tensors(self, batch: SequenceBatch) -> dict[str, torch.Tensor]:
        """A batch of ours in the form that its replay buffer gives, on its device."""
        arrays = {
            key: value.transpose(0, 1, 4, 2, 3) if key in self.images else value for key, value in batch.observations.items()
        }
        columns = {"rewards": batch.rewards, "terminated": batch.is_terminal, "is_first": batch.is_first}
        arrays |= {"actions": batch.actions, **{key: value[..., None] for key, value in columns.items()}}
        return {key: torch.as_tensor(value, device=self.fabric.device).float() for key, value in arrays.items()}

    def train(self, batch: SequenceBatch, phases: int | None = None) -> list[Lap]:
        """
        One update.

        :param batch: as our side gets it
        :param phases: stop after so many of its optimizers' steps; None for the whole update
        :return: what each phase cost, in the order of its steps: world model, (ensemble,) actor, critic, ...
        """
        laps: list[Lap] = []
        clock = Clock(self.fabric.device)
        update = clocked(self.module.update, clock, laps, phases)
        with patch.object(self.module, "update", update), suppress(Enough):
            self.module.train(
                fabric=self.fabric,
                data=self.tensors(batch),
                aggregator=None,
                cfg=self.cfg,
                actions_dim=(self.action_dim,),
                **self.modules,
            )
        return laps


def padded_convolutions(stages: int) -> Any:
    """Context in which its DreamerV2 agents are built with the convolutions of its DreamerV3, without layer norm."""

    def encoder(layer_norm: bool, **kwargs: Any) -> nn.Module:
        return dreamer_v3_agent.CNNEncoder(layer_norm_cls=nn.Identity, stages=stages, **kwargs)

    def decoder(layer_norm: bool, **kwargs: Any) -> nn.Module:
        return dreamer_v3_agent.CNNDecoder(layer_norm_cls=nn.Identity, stages=stages, **kwargs)

    return patch.multiple(dreamer_v2_agent, CNNEncoder=encoder, CNNDecoder=decoder)


def count(module: nn.Module) -> int:
    """Number of parameters."""
    return sum(parameter.numel() for parameter in module.parameters())
