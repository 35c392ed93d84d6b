"""
The experiments of the report: runs as data, results as tidy CSV, figures from these.

>>> from sb3_cpm.experiments import draw, run_experiment, summary_table
>>> run_experiment("mountaincar", "quick", jobs=2)  # doctest: +SKIP
>>> draw("mountaincar", version="quick")  # doctest: +SKIP
"""

from sb3_cpm.extras import needed

with needed("Experiments", "experiments"):
    from sb3_cpm.experiments.catalog import EXPERIMENTS, find_experiment
    from sb3_cpm.experiments.reports import draw, ensure_data, find_data, listing, reproduce, run_experiment, summary_table
    from sb3_cpm.experiments.specification import Contender, Experiment, Plan, RunResult, RunSpec, Task

__all__ = [
    "EXPERIMENTS",
    "Contender",
    "Experiment",
    "Plan",
    "RunResult",
    "RunSpec",
    "Task",
    "draw",
    "ensure_data",
    "find_data",
    "find_experiment",
    "listing",
    "reproduce",
    "run_experiment",
    "summary_table",
]
