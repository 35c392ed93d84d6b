"""Where the physics run: one environment per process on the CPU, or a batch of environments on an NVIDIA GPU."""

import platform
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch as th

from sb3_cpm.extras import check_installed

SIM_BACKENDS = ("auto", "physx_cpu", "physx_cuda")


def choose_simulation(
    num_envs: int, sim_backend: str, task_kwargs: Mapping[str, Any], renderer: str = "gpu", visual: bool = False
) -> tuple[str, dict[str, Any]]:
    """
    :param num_envs: environments in one simulation
    :param sim_backend: ``"physx_cpu"``, ``"physx_cuda"`` (``"physx_cuda:1"`` for the second GPU), or ``"auto"``: the GPU for
        more than one environment
    :param task_kwargs: further arguments of the task
    :param renderer: who draws: ``"gpu"``, ``"cpu"`` or ``"none"``
    :param visual: whether observations have pictures
    :return: ManiSkill's name of the simulation, and the arguments with what a batch needs
    :raises ValueError: if these do not go together
    :raises RuntimeError: if this machine cannot simulate on a GPU, with the cure
    """
    if not isinstance(num_envs, int) or num_envs < 1:
        raise ValueError(f"num_envs must be a whole number of at least 1, got {num_envs!r}.")
    if sim_backend.split(":")[0] not in SIM_BACKENDS:
        raise ValueError(f"sim_backend must be one of {', '.join(SIM_BACKENDS)}, got {sim_backend!r}.")
    if sim_backend == "auto":
        sim_backend = "physx_cpu" if num_envs == 1 else "physx_cuda"
    kwargs = dict(task_kwargs)
    if sim_backend == "physx_cpu" and num_envs > 1:
        raise ValueError(
            f"The CPU simulates one environment per process, num_envs={num_envs} needs sim_backend='physx_cuda'. Several on "
            "the CPU: stable_baselines3's make_vec_env(make_maniskill_env, n_envs, env_kwargs=..., vec_env_cls=SubprocVecEnv)."
        )
    if num_envs > 1 and kwargs.setdefault("reconfiguration_freq", 0) != 0:
        raise ValueError(
            f"reconfiguration_freq={kwargs['reconfiguration_freq']} rebuilds the scene between episodes, but the environments "
            "of a batch end theirs at different times. Leave it at 0, or use num_envs=1 in several processes."
        )
    if sim_backend != "physx_cpu":
        check_gpu_simulation(sim_backend)
        if visual and renderer != "gpu":
            raise RuntimeError(
                "Pictures of a simulation on the GPU are drawn on the GPU, but SAPIEN finds no Vulkan driver of the GPU. "
                "Install the one that belongs to its driver (`vulkaninfo` should list the card), or use obs_mode='state'."
            )
    return sim_backend, kwargs


def gpu_library() -> Path:
    """:return: where SAPIEN looks for PhysX's GPU library"""
    import sapien

    name = "PhysXGpu_64.dll" if platform.system() == "Windows" else "libPhysXGpu_64.so"
    return Path.home() / ".sapien" / "physx" / sapien.physx.version() / name


def check_gpu_simulation(sim_backend: str = "physx_cuda") -> None:
    """
    :param sim_backend: with the number of the GPU, if not the first
    :raises ValueError: if SAPIEN is not installed
    :raises RuntimeError: if something is missing for simulations on an NVIDIA GPU, with the cure
    """
    index = int(sim_backend.partition(":")[2] or 0)
    if not th.cuda.is_available() or index >= th.cuda.device_count():
        raise RuntimeError(
            f"sim_backend={sim_backend!r} needs an NVIDIA GPU that PyTorch can use; PyTorch {th.__version__} sees "
            f"{th.cuda.device_count()}. Use sim_backend='physx_cpu' with num_envs=1, in several processes for more; "
            "or, if there is such a GPU, install its driver and a PyTorch that was built for CUDA."
        )
    check_installed("Simulations on the GPU", ("sapien",), "maniskill")
    import sapien

    if sapien.physx.is_gpu_enabled():
        return
    library = gpu_library()
    try:
        sapien.physx.enable_gpu()  # downloads the library if it is not there
    except Exception as error:
        # what is left of a broken download would be taken for the library for ever after
        where = f"It is there, but cannot be loaded ({error}): delete it" if library.exists() else f"It is not there ({error})"
        raise RuntimeError(
            f"Simulation on the GPU needs PhysX's GPU library, {library}. {where}. SAPIEN downloads it if there is a network "
            "(unchecked: it knows no digest of it); else unzip https://github.com/sapien-sim/physx-precompiled/releases/download/"
            f"{library.parent.name}/linux-so.zip into {library.parent}."
        ) from error
