"""Training runs with everything around them: what ``python -m sb3_cpm train`` does."""

from typing import TYPE_CHECKING, Any

from sb3_cpm.run.settings import TrainSettings

if TYPE_CHECKING:
    from sb3_cpm.run.training import train
    from sb3_cpm.run.two_stage import TwoStageResult, train_two_stages

__all__ = ["TrainSettings", "TwoStageResult", "train", "train_two_stages"]


def __getattr__(name: str) -> Any:
    """These need matplotlib and more (the extra ``run``), so they are imported when they are asked for."""
    if name == "train":
        from sb3_cpm.run.training import train

        return train
    if name in __all__:
        from sb3_cpm.run import two_stage

        return getattr(two_stage, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
