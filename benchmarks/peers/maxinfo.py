"""
MaxInfoSAC (Sukhija et al. 2024, the authors' own code for Stable-Baselines3) on an experiment of ours, beside our agents.

::

    python benchmarks/peers/maxinfo.py PATH_OF_A_CHECKOUT --experiment exploration --seed 10 11 12

The checkout is of ``sukhijab/maxinforl_sb3``, which is not on PyPI. Task, player and its hyperparameters are those of
``zoo_configs/sac.yml``, evaluation and tables those of ``reproduce``; the ensemble has the sizes and the learning rate of the
authors' experiments on control tasks. Results lie beside our agents' in ``results/``.
"""

import argparse
import sys
from pathlib import Path
from typing import Any
from unittest.mock import patch

from sb3_cpm.agents import agent
from sb3_cpm.agents.algorithms import algorithms
from sb3_cpm.experiments.catalog import SAC as PLAYER
from sb3_cpm.experiments.catalog import find_experiment
from sb3_cpm.experiments.single_run import perform
from sb3_cpm.experiments.specification import Contender, RunSpec

RESULTS = Path(__file__).parents[2] / "results"
#: "features", "learn_std" and "optimizer_kwargs" of examples/dmc
ENSEMBLE = {"learn_std": False, "optimizer_kwargs": {"lr": 3e-4, "weight_decay": 0.0}, "features": (256, 256)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkout", type=Path)
    parser.add_argument("--experiment", default="exploration")
    parser.add_argument("--seed", nargs="+", type=int, default=list(range(10, 20)))
    parser.add_argument("--results", type=Path, default=RESULTS)
    args = parser.parse_args()
    sys.path.insert(0, str(args.checkout))
    from maxinforl_torch.commons.maxinfo_sac import MaxInfoSAC

    class Peer(MaxInfoSAC):
        def __init__(self, policy: Any, env: Any, **kwargs: Any) -> None:
            super().__init__(policy=policy, env=env, ensemble_model_kwargs=ENSEMBLE, **kwargs)

    experiment = find_experiment(args.experiment)
    plan = experiment.plan("full")
    contender = Contender("MaxInfoSAC", PLAYER.config)
    for seed in args.seed:
        spec = RunSpec(
            experiment.folder_name(), contender.name, plan.tasks[0].name, seed, contender.config, plan.tasks[0].env_id, {},
            plan.steps, plan.eval_every, plan.eval_episodes, plan.eval_seed,
        )  # fmt: skip
        with (
            patch.object(agent, "algorithms", lambda: {**algorithms(), "sac": Peer}),
            # it cannot be loaded again, so that a run goes from beginning to end
            patch("sb3_cpm.checkpoint.save_checkpoint", lambda *arguments: None),
            patch("sb3_cpm.experiments.single_run.find_same_run", lambda *arguments: None),
        ):
            print(perform(spec, args.results, print), flush=True)


if __name__ == "__main__":
    main()
