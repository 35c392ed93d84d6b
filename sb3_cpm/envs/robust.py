"""
Worker processes that may die.

A simulator with a software renderer is a large piece of C++: after tens of thousands of steps it may crash, or have grown.
With SB3's ``SubprocVecEnv`` a worker that dies ends the training (or hangs it). Here it costs the rest of one episode.

:class:`RobustSubprocVecEnv` is SB3's class with other ends of its pipes: each :class:`_Worker` behaves like the connection
that it replaces, so that every method of SB3's works as it is, and brings up a new process when the old one does not answer.
"""

import contextlib
import multiprocessing as mp
import time
import warnings
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection, wait
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.vec_env import SubprocVecEnv
from stable_baselines3.common.vec_env.base_vec_env import CloudpickleWrapper
from stable_baselines3.common.vec_env.subproc_vec_env import _worker

MAX_DEATHS = 3
"""A worker that dies so many times without finishing an episode in between is not unlucky but wrong."""

CLOSING = 10.0
"""Seconds that ``close`` gives all workers together to finish what they are doing, before it kills them."""


class RobustSubprocVecEnv(SubprocVecEnv):
    """
    SB3's ``SubprocVecEnv``, in which a worker process that dies (or hangs) is replaced by a new one.

    What the agent sees of it: its episode is truncated. ``done`` is true, the reward of that step is 0, ``infos[i]`` has
    ``TimeLimit.truncated`` (so that values are bootstrapped), ``terminal_observation``: the last observation that is known,
    the one before the step, and ``worker_died``: what happened. There is no ``episode`` entry, since the ``Monitor`` died too.
    A warning tells the user; :attr:`restarts` counts. If it dies between two steps (when ``env_method`` asks it, say), the new
    environment answers, and the next step is not carried out but truncates the episode in the same way.

    The new environment gets a new seed (ruled by the seed of the old one), the attributes that were set with ``set_attr``, and
    the start that was asked for with ``start_next_from`` if no episode began there yet.
    An environment that raises an exception dies of it as well; after three deaths without a finished episode the training
    stops with a RuntimeError.

    :param env_fns: environments to run in processes of their own
    :param start_method: as for ``SubprocVecEnv``
    :param episodes_per_worker: a worker is replaced after so many episodes, which gives back memory that its simulator lost;
        None for never. No episode is cut for it
    :param timeout: seconds after which a worker that does not answer is taken for dead; None to wait for ever. Must be longer
        than the making of an environment
    :raises ValueError: for a number that is of no use
    """

    def __init__(
        self,
        env_fns: Sequence[Callable[[], gym.Env]],
        start_method: str | None = None,
        episodes_per_worker: int | None = None,
        timeout: float | None = None,
    ):
        if episodes_per_worker is not None and episodes_per_worker < 1:
            raise ValueError(f"episodes_per_worker must be at least 1 or None for never, got {episodes_per_worker!r}.")
        if timeout is not None and not timeout > 0:
            raise ValueError(f"timeout must be a positive number of seconds or None, got {timeout!r}.")
        try:
            super().__init__(list(env_fns), start_method)
        except (EOFError, ConnectionError) as error:
            raise RuntimeError("A worker process died while it made its environment; its own message is above.") from error
        context = mp.get_context(start_method or ("forkserver" if "forkserver" in mp.get_all_start_methods() else "spawn"))
        self.workers = [
            _Worker(i, env_fn, context, remote, process, episodes_per_worker, timeout)
            for i, (env_fn, remote, process) in enumerate(zip(env_fns, self.remotes, self.processes, strict=True))
        ]
        self.remotes = tuple(self.workers)

    @property
    def restarts(self) -> list[int]:
        """How many times each worker died."""
        return [worker.deaths for worker in self.workers]

    def close(self) -> None:
        if self.closed:
            return
        deadline = time.monotonic() + CLOSING
        for worker in self.workers:
            worker.drain(max(0.0, deadline - time.monotonic()))
        self.waiting = False
        self.processes = []  # the workers wait for theirs
        super().close()


class _Worker:
    """
    One worker process and the parent's end of its pipe, with the methods of a connection that ``SubprocVecEnv`` uses.

    :param index: of the environment, for messages and seeds
    :param env_fn: makes the environment
    :param context: starts processes
    :param remote: the parent's end
    :param process: the process that is running
    :param episodes_per_worker: see :class:`RobustSubprocVecEnv`
    :param timeout: see :class:`RobustSubprocVecEnv`
    """

    def __init__(
        self,
        index: int,
        env_fn: Callable[[], gym.Env],
        context: Any,
        remote: Connection,
        process: Any,
        episodes_per_worker: int | None,
        timeout: float | None,
    ):
        self.index = index
        self.env_fn = env_fn
        self.context = context
        self.remote = remote
        self.process = process
        self.episodes_per_worker = episodes_per_worker
        self.timeout = timeout
        self.deaths = 0
        self._deaths_in_a_row = 0
        self._episodes = 0  # of this process
        self._generations = 0
        self._seed: int | None = None
        self._asked: tuple[str, Any] = ("", None)
        self._owes_answer = False
        self._attributes: dict[str, Any] = {}
        self._next_start: Any = None  # the call of `start_next_from` whose episode has not begun
        self._last_observation: Any = None  # that the agent saw
        self._untold: tuple[Any, ...] | None = None  # the answer to the next step, where the worker died between two steps

    # ------------------------------------------------------------------ a connection
    def send(self, message: tuple[str, Any]) -> None:
        self._asked = message
        command, data = message
        if command == "step" and self._untold is not None:
            return
        # if it is dead, `recv` sees to that, when the other workers have their message, too
        with contextlib.suppress(OSError):
            self.remote.send(message)
            self._owes_answer = True
        # not before: what cannot be pickled was never asked
        if command == "set_attr":
            self._attributes[data[0]] = data[1]
        if command == "reset":
            self._seed = self._seed if data[0] is None else data[0]
            self._untold = None

    def recv(self) -> Any:
        command, data = self._asked
        if command == "step" and self._untold is not None:
            answer = self._tell()
        else:
            try:
                answer = self._receive(self.timeout)
            except (EOFError, OSError) as error:
                answer = self._recover(command, data, error)
        if command == "env_method" and data[0] == "start_next_from":
            self._next_start = data
        elif command == "reset":
            self._last_observation = answer[0]
            self._next_start = None
        elif command == "step":
            self._last_observation = answer[0]
            if answer[2]:
                answer = self._episode_ended(answer)
        return answer

    def close(self) -> None:
        self.process.join(timeout=10)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()
        self.remote.close()

    def drain(self, timeout: float) -> None:
        """
        Forget the answer that is under way, if there is one: a worker that cannot get rid of it would not close.

        :param timeout: seconds after which the process is killed
        """
        if self._owes_answer:
            try:
                self._receive(timeout)
            except (EOFError, OSError):  # nobody replaces a dead one any more
                self.process.kill()

    def _receive(self, timeout: float | None) -> Any:
        # Also look at the process: of a worker that was forked, its brothers hold copies of the pipe's other end, so that the
        # pipe stays open when it dies.
        ready = wait([self.remote, self.process.sentinel], timeout)
        if not ready:
            raise TimeoutError(f"gave no answer for {timeout:g} s")
        self._owes_answer = False
        if self.remote not in ready and not self.remote.poll():
            raise EOFError
        return self.remote.recv()

    # ------------------------------------------------------------------ a life after death
    def _recover(self, command: str, data: Any, error: Exception) -> Any:
        """:return: the answer to the command that the old process left unanswered"""
        self.process.kill()
        self.process.join()
        self._owes_answer = False
        reason = str(error) if isinstance(error, TimeoutError) else f"died with exit code {self.process.exitcode}"
        self.deaths += 1
        self._deaths_in_a_row += 1
        if self._deaths_in_a_row >= MAX_DEATHS:
            raise RuntimeError(
                f"Worker {self.index} {reason}: {MAX_DEATHS} deaths without a finished episode between them. The last thing "
                f"that it was asked for was {command!r}; its own message, if it had one, is above."
            ) from error
        warnings.warn(f"Worker {self.index} {reason}: a new one takes its place, its episode is truncated.", stacklevel=2)
        if command == "reset":
            return self._replace(*data)
        start = self._next_start
        if command != "step":
            self._next_start = None
        observation, info = self._replace()
        lost = {"TimeLimit.truncated": True, "terminal_observation": self._last_observation, "worker_died": reason}
        answer = observation, 0.0, True, lost, info
        if command == "step":
            return answer
        self._untold = answer
        if start is not None:  # kept for the episode that the agent gets to see: it may call `reset` instead of `step`
            self._call("env_method", start)
            self._next_start = start
        return self._call(command, data)

    def _tell(self) -> tuple[Any, ...]:
        """:return: the answer to a step of an episode that was lost before"""
        assert self._untold is not None
        answer, self._untold = self._untold, None
        if self._next_start is None:
            return answer
        # Meant for the episode that begins now, as the agent sees it. In a new process: there are environments that refuse to
        # be reset in the middle of an episode.
        self.process.kill()
        self.process.join()
        observation, info = self._replace()
        return observation, *answer[1:4], info

    def _episode_ended(self, answer: tuple[Any, ...]) -> tuple[Any, ...]:
        if "worker_died" in answer[3]:
            return answer
        self._deaths_in_a_row = 0
        self._episodes += 1
        if self._episodes != self.episodes_per_worker:
            self._next_start = None
            return answer
        with contextlib.suppress(OSError):
            self.remote.send(("close", None))
        self.close()
        observation, info = self._replace()
        self._last_observation = observation
        return observation, *answer[1:4], info

    def _replace(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """
        A new process with a new episode.

        :param seed: of the episode, None for one that follows from the old process's
        :param options: of its reset
        :return: what its reset returned
        """
        self._start()
        self._generations += 1
        if seed is None:
            own = np.random.SeedSequence([self._seed or 0, self.index, self._generations])
            # without a seed for the old one, SB3 seeds NumPy's generator
            seed = int(np.random.randint(2**31)) if self._seed is None else int(own.generate_state(1)[0] >> 1)
        start, self._next_start = self._next_start, None
        if start is not None:
            self._call("env_method", start)
        return self._call("reset", (seed, options))

    def _start(self) -> None:
        self.remote.close()
        self.remote, theirs = self.context.Pipe()
        arguments = (theirs, self.remote, CloudpickleWrapper(self.env_fn))
        self.process = self.context.Process(target=_worker, args=arguments, daemon=True)
        self.process.start()
        theirs.close()
        self._episodes = 0
        for name, value in self._attributes.items():
            self._call("set_attr", (name, value))

    def _call(self, command: str, data: Any) -> Any:
        try:
            self.remote.send((command, data))
            self._owes_answer = True
            return self._receive(self.timeout)
        except (EOFError, OSError) as error:
            raise RuntimeError(
                f"Worker {self.index}: the process that replaces another one died, too, when it was asked for {command!r}. "
                "Its own message is above."
            ) from error
