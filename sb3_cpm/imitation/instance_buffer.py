"""
CLIB, the category-level instance buffer (Shen et al. 2022, section 4.3): what the discriminator takes for expert, in a ring
per object, so that the objects that are easy do not push out those that are not.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces

from sb3_cpm.arguments import SHARE, check, integer
from sb3_cpm.buffers import EpisodeBuffer
from sb3_cpm.buffers.compact import StorageSpec
from sb3_cpm.files import Archive

#: Where objects have no names, or are not told apart.
ANY = "any"
#: Rings of an instance: what may be pushed out, and demonstrations that may not.
OWN, KEPT = "own", "kept"


class InstanceBuffer:
    """
    A ring of whole episodes per instance. Demonstrations come first; then the player's episodes with a success, up to and
    including the first successful step. The oldest episodes of an instance make room for its new ones.

    :param observation_space: of the keys that the discriminator reads
    :param action_space: Box space
    :param quota: transitions per instance [30,000]
    :param max_instances: refuse more instances than that; None: as many as there are
    :param balance: a ring per instance, equally sampled; False: one for all
    :param keep_demonstrations: share of a quota from which demonstrations are not pushed out [0]
    :param storage_dtypes: see :class:`~sb3_cpm.buffers.CPMBuffer`
    :param device: of the samples
    """

    def __init__(
        self,
        observation_space: spaces.Dict,
        action_space: spaces.Box,
        quota: int = 30_000,
        max_instances: int | None = None,
        balance: bool = True,
        keep_demonstrations: float = 0.0,
        storage_dtypes: dict[str, StorageSpec] | None = None,
        device: th.device | str = "cpu",
    ) -> None:
        check("quota", quota, integer(1))
        if max_instances is not None:
            check("max_instances", max_instances, integer(1))
        check("keep_demonstrations", keep_demonstrations, SHARE)
        self.observation_space, self.action_space = observation_space, action_space
        self.quota, self.max_instances, self.balance = quota, max_instances, balance
        self.keep_demonstrations = keep_demonstrations
        self.storage_dtypes, self.device = storage_dtypes, device
        self._rings: dict[str, dict[str, EpisodeBuffer]] = {}

    @property
    def instances(self) -> list[str]:
        """Those that have a ring, in the order in which they came."""
        return list(self._rings)

    def sizes(self) -> dict[str, int]:
        """:return: transitions of each instance"""
        return {name: sum(ring.books.n_drawable for ring in rings.values()) for name, rings in self._rings.items()}

    def add(
        self, instance: str | None, observations: Mapping[str, np.ndarray], actions: np.ndarray, demonstration: bool = False
    ) -> None:
        """
        :param instance: whose episode it is; None where there are no names
        :param observations: by key, shape ``(T + 1, *shape)`` or ``(T, *shape)``
        :param actions: within [-1, 1], shape ``(T, action_dim)``
        :param demonstration: whether it may be kept
        :raises ValueError: if an instance's ring is shorter than the episode, or there are too many instances
        """
        name = ANY if instance is None or not self.balance else instance
        if len(actions) > self._size(OWN):
            raise ValueError(
                f"An episode of {len(actions)} transitions does not fit into the ring of instance {name!r}, which holds "
                f"{self._size(OWN)}: give GAILCallback a larger quota (now {self.quota})."
            )
        rings = self._rings.get(name)
        if rings is None:
            rings = self._open(name)
        kept = rings.get(KEPT)
        fits = kept is not None and kept.books.n_drawable + len(actions) <= kept.buffer_size
        ring = kept if demonstration and kept is not None and fits else rings[OWN]
        for step in range(len(actions)):
            here = {key: observations[key][step][None] for key in self.observation_space.spaces}
            after = min(step + 1, len(observations[next(iter(here))]) - 1)  # nobody reads what the last action led to
            there = {key: observations[key][after][None] for key in here}
            last = step == len(actions) - 1
            ring.add(here, there, actions[step][None], np.zeros(1), np.array([last]), [{}])

    def _open(self, name: str) -> dict[str, EpisodeBuffer]:
        if self.max_instances is not None and len(self._rings) >= self.max_instances:
            raise ValueError(
                f"Instance {name!r} would be number {len(self._rings) + 1}, and max_instances is {self.max_instances}. They "
                f"are {self.instances}."
            )
        self._rings[name] = {kind: self._ring(kind) for kind in (OWN, KEPT) if self._size(kind)}
        return self._rings[name]

    def _size(self, kind: str) -> int:
        kept = int(self.keep_demonstrations * self.quota)
        return kept if kind == KEPT else max(self.quota - kept, 1)

    def _ring(self, kind: str) -> EpisodeBuffer:
        return EpisodeBuffer(
            self._size(kind), self.observation_space, self.action_space, device=self.device, storage_dtypes=self.storage_dtypes
        )

    def sample(self, n: int) -> tuple[dict[str, th.Tensor], th.Tensor]:
        """
        :param n: how many at most: as many of each instance, ``n // number of instances``, at least one
        :return: observations by key, each of shape ``(m, *shape)``, and actions, shape ``(m, action_dim)``
        :raises RuntimeError: while there is nothing to sample
        """
        filled = [rings for rings in self._rings.values() if any(ring.episodes_ended for ring in rings.values())]
        if not filled:
            raise RuntimeError("There is no expert transition to sample: add demonstrations first.")
        share = max(n // len(filled), 1)
        parts = []
        for rings in filled:
            sizes = np.array([ring.books.n_drawable for ring in rings.values()])
            counts = np.random.multinomial(share, sizes / sizes.sum()) if len(sizes) > 1 else [share]
            parts += [ring.sample(int(count)) for ring, count in zip(rings.values(), counts, strict=True) if count]
        keys = self.observation_space.spaces
        return {key: th.cat([part.observations[key] for part in parts]) for key in keys}, th.cat(
            [part.actions for part in parts]
        )

    # ------------------------------------------------------------------ files

    def state(self, prefix: str) -> tuple[list[Any], dict[str, np.ndarray]]:
        """
        :param prefix: before the names of the arrays
        :return: what JSON can say, and arrays
        """
        content: list[Any] = []
        arrays: dict[str, np.ndarray] = {}
        for number, (name, rings) in enumerate(self._rings.items()):
            entry = {}
            for kind, ring in rings.items():
                entry[kind], theirs = ring._state(f"{prefix}{number}/{kind}/")
                arrays |= theirs
            content.append([name, entry])
        return content, arrays

    def restore(self, content: Sequence[Any], archive: Archive, prefix: str) -> None:
        """
        :param content: of :meth:`state`
        :param archive: has its arrays
        :param prefix: before their names
        """
        self._rings = {}
        for number, (name, entry) in enumerate(content):
            rings = {kind: EpisodeBuffer._made_from(one, archive, f"{prefix}{number}/{kind}/") for kind, one in entry.items()}
            for ring in rings.values():
                ring.device = th.device(self.device)
            self._rings[name] = rings
